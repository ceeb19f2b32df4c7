"""Alembic: an archive with the animated camera and the points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.export.shot import Shot, linear_colors
from factorsfm.support.extras import failures_as_os_errors, require
from factorsfm.support.program import PROGRAM, program_version

CAMERA, POINTS = "camera", "points"


def write_alembic(shot: Shot, path: Path) -> None:
    """Write an archive (Ogawa); the time of a frame is its number divided by the frame rate, which the archive states.

    The focal length is in mm and the film back in cm, as Alembic requires. Only registered frames have a sample; tools
    interpolate between them. An object is a transform with its points below it. Distortion is not included.

    Raises:
        InputError: alembic3d is missing.
    """
    abc, geom, core = (require(f"alembic3d.{name}") for name in ("Abc", "AbcGeom", "AbcCoreAbstract"))
    imath = require("imath")
    samples = len(shot.numbers) + sum(len(thing.numbers) for thing in shot.nulls)
    points = len(shot.reconstruction.points) + sum(len(thing.points) for thing in shot.nulls)
    _check_room(path, 64 * 1024 + 1024 * samples + 64 * points)
    with failures_as_os_errors():
        archive = abc.CreateArchiveWithInfo(str(path), shot.fps, f"{PROGRAM} {program_version()}", "")
        sampling = archive.addTimeSampling(_sampling(shot.numbers, shot.fps, core))
        _write_camera(shot, archive, sampling, geom, imath)
        _write_points(archive.getTop(), shot.reconstruction.points, shot.reconstruction.colors, geom, imath)
        for thing in shot.nulls:
            sampling = archive.addTimeSampling(_sampling(thing.numbers, shot.fps, core))
            null = _write_transform(archive, thing.name, sampling, thing.world_from_object, geom, imath)
            if len(thing.points):
                _write_points(null, thing.points, thing.colors, geom, imath)


def _sampling(numbers: list[int], fps: float, core: Any) -> Any:
    times = core.TimeVector()
    for number in numbers:
        times.append(number / fps)
    return core.TimeSampling(core.TimeSamplingType(core.AcyclicFlag.kAcyclic), times)


def _check_room(path: Path, size: int) -> None:
    """Raise an OSError if the disk is full; Alembic would abort the whole process."""
    with path.open("wb") as file:
        file.write(bytes(size))


def _write_transform(
    archive: Any, name: str, sampling: int, matrices: NDArray[np.float64], geom: Any, imath: Any
) -> Any:
    """A transform with a sample for each of the matrices (k, 4, 4)."""
    transform = geom.OXform(archive.getTop(), name, sampling)
    for matrix in matrices:
        sample = geom.XformSample()
        sample.setMatrix(imath.M44d(*matrix.T.ravel().tolist()))
        transform.getSchema().set(sample)
    return transform


def _write_camera(shot: Shot, archive: Any, sampling: int, geom: Any, imath: Any) -> None:
    lens = shot.lens
    transform = _write_transform(archive, CAMERA, sampling, shot.world_from_film, geom, imath)
    name = f"{CAMERA}Shape"
    camera = geom.OCamera(transform, name, sampling) if shot.zooms else geom.OCamera(transform, name)
    for own in shot.lenses if shot.zooms else [lens]:
        sample = geom.CameraSample()
        sample.setFocalLength(own.focal_length)
        sample.setHorizontalAperture(lens.sensor_width / 10)
        sample.setVerticalAperture(lens.sensor_height / 10)
        sample.setHorizontalFilmOffset(lens.right / 10)
        sample.setVerticalFilmOffset(lens.up / 10)
        sample.setNearClippingPlane(shot.clipping[0])
        sample.setFarClippingPlane(shot.clipping[1])
        camera.getSchema().set(sample)


def _write_points(parent: Any, points: NDArray[np.float64], rgb: NDArray[np.uint8], geom: Any, imath: Any) -> None:
    count = len(points)
    positions, colors, ids = imath.V3fArray(count), imath.C3fArray(count), imath.IntArray(count)
    for i, (point, color) in enumerate(zip(points.tolist(), linear_colors(rgb).tolist(), strict=True)):
        positions[i], colors[i], ids[i] = imath.V3f(*point), imath.Color3f(*color), i
    schema = geom.OPoints(parent, POINTS).getSchema()
    schema.set(geom.OPointsSchemaSample(positions, ids))
    scope = geom.GeometryScope.kVertexScope
    parameter = geom.OC3fGeomParam(schema.getArbGeomParams(), "Cs", False, scope, 1)
    parameter.set(geom.OC3fGeomParamSample(colors, scope))
