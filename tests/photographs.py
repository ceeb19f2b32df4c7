"""Photographs with laser truth at half of their size: features of all of them take a quarter of the time."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from factorsfm.evaluation.readers import Shot, read_shot


@dataclass(frozen=True)
class Photographs:
    """Files by name with their images, the lens at this size, and the truth."""

    images: dict[str, np.ndarray]
    camera: pycolmap.Camera
    shot: Shot

    def write(self, folder: Path, names: list[str] | None = None, prefix: str = "") -> Path:
        folder.mkdir(exist_ok=True)
        for name in self.images if names is None else names:
            cv2.imwrite(str(folder / (prefix + name)), self.images[name])
        return folder


def photographs(folder: Path) -> Photographs:
    files = sorted((folder / "images").iterdir())
    images = {f"{file.stem}.png": cv2.imread(str(file), cv2.IMREAD_REDUCED_COLOR_2) for file in files}
    shot = read_shot(folder)
    camera = pycolmap.Camera(shot.camera.todict())
    height, width = next(iter(images.values())).shape[:2]
    camera.rescale(width, height)
    return Photographs(images, camera, shot)
