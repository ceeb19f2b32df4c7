"""The lens in the models of Nuke, Blender and 3DEqualizer, each with how far it is from ours."""

from __future__ import annotations

import json
import math
from pathlib import Path

from factorsfm.camera.other_models import distorting, dividing, undistorting
from factorsfm.export.shot import Lens, Shot
from factorsfm.support.errors import InputError

NUKE, BLENDER, THREE_DE = "nuke.nk", "blender.py", "3de.txt"

_BLENDER = """
import bpy

clips = bpy.data.movieclips
for clip in clips:
    camera = clip.tracking.camera
    camera.units = "MILLIMETERS"
    for name, value in DATA["camera"].items():
        setattr(camera, name, value)
    if hasattr(camera, "principal_point"):
        camera.principal_point = DATA["principal_point"]
    else:  # before Blender 3.5
        camera.principal = [(1 + place) * side / 2 for place, side in zip(DATA["principal_point"], DATA["size"])]
if not clips:
    raise SystemExit("There is no movie clip: open the footage as one, and run this script again.")
"""


def write_lens(shot: Shot, folder: Path) -> None:
    """Write ``nuke.nk``, ``blender.py`` and ``3de.txt``, with the largest deviation over the image in each.

    Nuke's LensDistortion divides by a polynomial of the distorted radius about the middle of the image. Blender's
    movie clips have k1 to k3 of the undistorted radius. 3DE Classic has a distortion of degree 2 and a quartic one of
    the distorted radius, in halves of the film back's diagonal.

    Raises:
        InputError: the lens changes, or its model cannot be inverted in all of the image.
    """
    if shot.zooms:
        raise InputError("lens is for one lens, and this one changes; stmap has maps for every frame")
    lens = shot.lens
    (folder / NUKE).write_text(_nuke(shot), encoding="ascii")
    (folder / BLENDER).write_text(_blender(shot, lens), encoding="ascii")
    (folder / THREE_DE).write_text(_three_de(shot, lens), encoding="ascii")


def _nuke(shot: Shot) -> str:
    fit = dividing(shot.reconstruction.camera, 2)
    k1, k2 = (f"{k:.12g}" for k in fit.coefficients)
    said = _said(fit.deviation_px)
    return (
        f"LensDistortion2 {{\n inputs 1\n distortionDenominator0 {k1}\n distortionDenominator1 {k2}\n"
        f' output Undistort\n name Undistort\n label "{said}"\n}}\n'
    )


def _blender(shot: Shot, lens: Lens) -> str:
    fit = distorting(shot.reconstruction.camera, 3, 1.0)
    values = {
        "distortion_model": "POLYNOMIAL",
        "sensor_width": lens.sensor_width,
        "pixel_aspect": lens.pixel_aspect,
        "focal_length": lens.focal_length,
        **{f"k{power}": k for power, k in enumerate(fit.coefficients, 1)},
    }
    # Blender's principal point counts from the middle, to the right and up, in halves of a side.
    center = [2 * lens.cx / lens.width - 1, 1 - 2 * lens.cy / lens.height]
    data = {"camera": values, "principal_point": center, "size": [lens.width, lens.height]}
    title = f'"""Gives the movie clips in Blender the lens; {_said(fit.deviation_px)}."""'
    return f"{title}\n\nimport json\n\nDATA = json.loads({json.dumps(data)!r})\n{_BLENDER}"


def _three_de(shot: Shot, lens: Lens) -> str:
    half_diagonal = math.hypot(lens.sensor_width, lens.sensor_height) / 2
    fit = undistorting(shot.reconstruction.camera, 2, half_diagonal / lens.focal_length)
    rows = {
        "Filmback Width": f"{lens.sensor_width / 10:.9g} cm",
        "Filmback Height": f"{lens.sensor_height / 10:.9g} cm",
        "Pixel Aspect": f"{lens.pixel_aspect:.9g}",
        "Focal Length": f"{lens.focal_length / 10:.9g} cm",
        "Lens Center X": f"{-lens.right / 10:.9g} cm",
        "Lens Center Y": f"{-lens.up / 10:.9g} cm",
        "Lens Distortion Model": "3DE Classic LD Model",
        "Distortion": f"{fit.coefficients[0]:.9g}",
        "Anamorphic Squeeze": "1",
        "Curvature X": "0",
        "Curvature Y": "0",
        "Quartic Distortion": f"{fit.coefficients[1]:.9g}",
    }
    return "".join([f"# {_said(fit.deviation_px)}\n", *(f"{name}: {value}\n" for name, value in rows.items())])


def _said(deviation_px: float) -> str:
    return f"largest deviation over the image: {deviation_px:.3f} pixels"
