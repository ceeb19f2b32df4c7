"""USD: a stage with the animated camera and the points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.export.shot import Shot, linear_colors
from factorsfm.support.errors import InputError
from factorsfm.support.extras import failures_as_os_errors, require
from factorsfm.support.up_axis import UpAxis

CAMERA, POINTS = "/factorsfm/camera", "/factorsfm/points"


def write_usd(shot: Shot, path: Path) -> None:
    """Write the stage; the path's suffix chooses text (.usda) or binary (.usdc, .usd).

    By default the stage is in centimetres and one world unit is a metre. Apertures and focal length are in tenths of
    the stage's unit, as USD requires: millimetres in a stage in centimetres. The principal point is in the aperture
    offsets. There is one sample per registered frame; USD interpolates between them, and the stage's custom data
    ``notRegistered`` lists the other frames. An object is a transform with a sample for each of its frames, and its
    points are below it. Distortion is not included.

    Raises:
        InputError: usd-core is missing, the suffix is not one of USD, or the up axis is not one of USD.
    """
    gf, sdf, usd, geom, vt = (require(f"pxr.{name}") for name in ("Gf", "Sdf", "Usd", "UsdGeom", "Vt"))
    if path.suffix not in (".usd", ".usda", ".usdc"):
        raise InputError(f"the output {path.name} ends in none of .usd, .usda, .usdc")
    if shot.up_axis is UpAxis.MINUS_Y:
        raise InputError("the up axis of a USD stage is y or z, not -y")
    meters_per_unit = 1 / shot.scale
    lens, tenths_per_mm = shot.lens, 0.01 / meters_per_unit

    with failures_as_os_errors():
        layer = sdf.Layer.CreateNew(str(path), args={"format": "usda"} if path.suffix == ".usda" else {})
    stage = usd.Stage.Open(layer)
    geom.SetStageUpAxis(stage, shot.up_axis.upper())
    geom.SetStageMetersPerUnit(stage, meters_per_unit)
    stage.SetTimeCodesPerSecond(shot.fps)
    stage.SetFramesPerSecond(shot.fps)
    stage.SetStartTimeCode(shot.first)
    stage.SetEndTimeCode(shot.last)
    stage.SetMetadataByDictKey("customLayerData", "notRegistered", vt.IntArray(shot.lost))
    stage.SetDefaultPrim(geom.Xform.Define(stage, "/factorsfm").GetPrim())

    camera = geom.Camera.Define(stage, CAMERA)
    camera.CreateHorizontalApertureAttr(tenths_per_mm * lens.sensor_width)
    camera.CreateVerticalApertureAttr(tenths_per_mm * lens.sensor_height)
    camera.CreateHorizontalApertureOffsetAttr(tenths_per_mm * lens.right)
    camera.CreateVerticalApertureOffsetAttr(tenths_per_mm * lens.up)
    focal_length = camera.CreateFocalLengthAttr(tenths_per_mm * lens.focal_length)
    if shot.zooms:
        for number, own in zip(shot.numbers, shot.lenses, strict=True):
            focal_length.Set(tenths_per_mm * own.focal_length, number)
    camera.CreateClippingRangeAttr(gf.Vec2f(*shot.clipping))
    transform = camera.AddTransformOp()
    for number, matrix in zip(shot.numbers, shot.world_from_film, strict=True):
        transform.Set(gf.Matrix4d(matrix.T.tolist()), number)

    _write_points(stage, POINTS, shot.reconstruction.points, shot.reconstruction.colors, shot.point_size)
    for thing in shot.nulls:
        null = geom.Xform.Define(stage, f"/factorsfm/{thing.name}").AddTransformOp()
        for number, matrix in zip(thing.numbers, thing.world_from_object, strict=True):
            null.Set(gf.Matrix4d(matrix.T.tolist()), number)
        if len(thing.points):
            _write_points(stage, f"/factorsfm/{thing.name}/points", thing.points, thing.colors, shot.point_size)
    with failures_as_os_errors():
        stage.Save()


def _write_points(stage: Any, path: str, xyz: NDArray[np.float64], rgb: NDArray[np.uint8], width: float) -> None:
    geom, vt = require("pxr.UsdGeom"), require("pxr.Vt")
    points = geom.Points.Define(stage, path)
    points.CreatePointsAttr(vt.Vec3fArray.FromNumpy(xyz.astype(np.float32)))
    points.CreateWidthsAttr(vt.FloatArray([width]))
    points.SetWidthsInterpolation(geom.Tokens.constant)
    points.CreateDisplayColorPrimvar(geom.Tokens.vertex).Set(vt.Vec3fArray.FromNumpy(linear_colors(rgb)))
    points.CreateExtentAttr(geom.Points.ComputeExtent(points.GetPointsAttr().Get(), points.GetWidthsAttr().Get()))
