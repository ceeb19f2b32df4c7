"""After Effects: keyframes as text, to be pasted onto a camera and onto the footage's layer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from factorsfm.export.rotation import angles_zyx
from factorsfm.export.shot import Shot

CAMERA, FOOTAGE = "camera.txt", "footage.txt"

_POSITION, _PIXELS = "Transform\tPosition", "X pixels\tY pixels\tZ pixels"
_ORIENTATION, _DEGREES = "Transform\tOrientation", "X degrees\tY degrees\tZ degrees"


def write_after_effects(shot: Shot, folder: Path) -> None:
    """Write ``camera.txt`` and ``footage.txt``, After Effects' keyframe data.

    The user makes a composition of the footage's size with square pixels, goes to its start, and pastes the text of the
    first file onto a one-node camera and the text of the second one onto the footage's 2-D layer. Positions are pixels
    from the top left corner, y down, z into the picture, with the origin of the world in the middle of the composition;
    orientation is in degrees (first z, then y, then x). In After Effects the optical axis goes through the middle of
    the composition and pixels are square. Where the lens differs, the second text moves and stretches the footage.
    Distortion is not included. Unregistered frames have no key. The text of an object goes onto a 3-D null.
    """
    lens = shot.lens
    middle = np.array([lens.width / 2, lens.height / 2, 0.0])
    positions = shot.world_from_opencv[:, :3, 3] + middle
    orientations = angles_zyx(shot.world_from_opencv[:, :3, :3])
    frames = shot.numbers
    camera = [
        _track(_POSITION, _PIXELS, frames, positions),
        _track(_ORIENTATION, _DEGREES, frames, orientations),
        _track("Camera Options\tZoom", "pixels", frames, np.array([[own.fx] for own in shot.lenses])),
    ]
    once = [shot.first]
    footage = [
        _track("Transform\tAnchor Point", _PIXELS, once, np.array([[lens.cx, lens.cy, 0.0]])),
        _track(_POSITION, _PIXELS, once, middle[None]),
        _track(
            "Transform\tScale", "X percent\tY percent\tZ percent", once, np.array([[100, 100 / lens.pixel_aspect, 100]])
        ),
    ]
    objects = [
        (
            f"{thing.name}.txt",
            [
                _track(_POSITION, _PIXELS, thing.numbers, thing.world_from_object[:, :3, 3] + middle),
                _track(_ORIENTATION, _DEGREES, thing.numbers, angles_zyx(thing.world_from_object[:, :3, :3])),
            ],
        )
        for thing in shot.nulls
    ]
    for name, tracks in ((CAMERA, camera), (FOOTAGE, footage), *objects):
        # Line ends as in After Effects' own keyframe data.
        (folder / name).write_text(_keyframe_data(shot, tracks), encoding="ascii", newline="\r\n")


def _keyframe_data(shot: Shot, tracks: list[str]) -> str:
    header = [
        "Adobe After Effects 8.0 Keyframe Data",
        "",
        f"\tUnits Per Second\t{shot.fps:.12g}",
        f"\tSource Width\t{shot.lens.width}",
        f"\tSource Height\t{shot.lens.height}",
        "\tSource Pixel Aspect Ratio\t1",
        "\tComp Pixel Aspect Ratio\t1",
    ]
    return "\n".join(header) + "\n\n" + "\n\n".join(tracks) + "\n\n\nEnd of Keyframe Data\n"


def _track(name: str, units: str, frames: list[int], values: np.ndarray) -> str:
    lines = [name, f"\tFrame\t{units}\t"]
    for frame, row in zip(frames, values, strict=True):
        lines.append("\t".join(["", str(frame), *(f"{value:.12g}" for value in row), ""]))
    return "\n".join(lines)
