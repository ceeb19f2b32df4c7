"""OpenTrackIO (SMPTE RIS OSVP): one sample of camera and lens for every frame."""

from __future__ import annotations

import json
import logging
import math
import uuid
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from factorsfm.camera.openlensio import distortion_of
from factorsfm.export.rotation import angles_zxy
from factorsfm.export.shot import Lens, Shot
from factorsfm.support.errors import InputError
from factorsfm.support.up_axis import UpAxis

logger = logging.getLogger(__name__)

_VERSION = [1, 0, 1]
_TOLD_PX = 0.01  # deviation of a lens from its sample that is worth a word
_IDS = uuid.UUID("7b0c6a52-6f4d-4a7e-9f2c-5f6f0e0a3c11")  # of samples of this program: the same at every export


def write_opentrackio(shot: Shot, path: Path) -> None:
    """Write one JSON object in a line for each registered frame.

    The world has z up, and y where the camera looks that does not turn; rotations are pan about z, then tilt about x,
    then roll about y. Translations are metres if the world unit is. Distortion is Brown-Conrady from undistorted to
    distorted places, in mm; radial coefficients stand in turn in numerator and denominator.

    Raises:
        InputError: another axis than z is to be up.
    """
    if shot.up_axis is not UpAxis.Z:
        raise InputError(f"up_axis is {shot.up_axis}; OpenTrackIO has z up")
    deviation = 0.0
    lines = []
    rate = Fraction(shot.fps).limit_denominator(1001)
    # Axes of its camera: x right, y ahead, z up. angles_zxy is Ry Rx Rz, and what is wanted is Rz Rx Ry: its inverse.
    rotation = shot.world_from_opencv[:, :3, :3] @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    angles = -angles_zxy(np.swapaxes(rotation, 1, 2))
    rows = zip(shot.numbers, shot.reconstruction.registered, shot.lenses, shot.world_from_opencv, angles, strict=True)
    for number, frame, lens, matrix, (tilt, roll, pan) in rows:
        optics, own = _lens(shot.reconstruction.camera_of(frame), lens)
        deviation = max(deviation, own)
        sample = {
            "protocol": {"name": "OpenTrackIO", "version": _VERSION},
            "sampleId": uuid.uuid5(_IDS, f"sample {number}").urn,
            "sourceId": uuid.uuid5(_IDS, "camera").urn,
            "sourceNumber": 1,
            "static": {"camera": _camera(lens, rate)},
            "timing": {
                "mode": "internal",
                "sampleRate": _rational(rate),
                "sampleTimestamp": _time(Fraction(number) / rate),
                "sequenceNumber": number,
            },
            "lens": optics,
            "transforms": [
                {
                    "id": "Camera",
                    "translation": dict(zip("xyz", matrix[:3, 3].tolist(), strict=True)),
                    "rotation": {"pan": pan, "tilt": tilt, "roll": roll},
                }
            ],
        }
        lines.append(json.dumps(sample, allow_nan=False))
    if deviation > _TOLD_PX:
        logger.warning("OpenTrackIO's lens model is up to %.3f pixels from this lens", deviation)
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _lens(camera: pycolmap.Camera, lens: Lens) -> tuple[dict[str, Any], float]:
    """The lens of a sample, and its largest deviation in pixels."""
    distortion, deviation = distortion_of(camera, lens.focal_length)
    optics: dict[str, Any] = {
        "pinholeFocalLength": lens.focal_length,
        "projectionOffset": {"x": -lens.right, "y": lens.up},  # to the right and down
    }
    if distortion is not None:
        optics["distortion"] = [distortion]
    return optics, deviation


def _camera(lens: Lens, rate: Fraction) -> dict[str, Any]:
    return {
        "activeSensorPhysicalDimensions": {"width": lens.sensor_width, "height": lens.sensor_height},
        "activeSensorResolution": {"width": lens.width, "height": lens.height},
        "captureFrameRate": _rational(rate),
    }


def _rational(value: Fraction) -> dict[str, int]:
    return {"num": value.numerator, "denom": value.denominator}


def _time(seconds: Fraction) -> dict[str, int]:
    whole = math.floor(seconds)
    return {"seconds": whole, "nanoseconds": math.floor((seconds - whole) * 1_000_000_000)}
