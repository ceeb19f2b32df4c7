"""Image files of shots and of cameras that say how they were set."""

from pathlib import Path

import cv2
import numpy as np

from factorsfm.synthetic import RenderedShot


def jpeg_with_focal_length(path: Path, equivalent_mm: int) -> Path:
    """A 480x270 JPEG whose EXIF holds FocalLengthIn35mmFilm."""
    cv2.imwrite(str(path), np.full((270, 480, 3), 90, np.uint8))
    entry = b"\xa4\x05\0\x03\0\0\0\x01" + equivalent_mm.to_bytes(2, "big") + b"\0\0"
    pointer = b"\x87\x69\0\x04\0\0\0\x01" + (26).to_bytes(4, "big")
    exif = b"Exif\0\0MM\0*\0\0\0\x08" + b"\0\x01" + pointer + b"\0\0\0\0" + b"\0\x01" + entry + b"\0\0\0\0"
    jpeg = path.read_bytes()
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + jpeg[2:])
    return path


def write_images(shot: RenderedShot, folder: Path) -> list[str]:
    """PNG files ``0.png``, ``1.png``, ...; their names."""
    folder.mkdir(exist_ok=True)
    names = [f"{k}.png" for k in range(len(shot.images))]
    for name, image in zip(names, shot.images, strict=True):
        cv2.imwrite(str(folder / name), image)
    return names
