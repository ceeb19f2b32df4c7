"""Alembic: an archive with the animated camera and the points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from factorsfm.export.shot import Shot
from factorsfm.export.vfx import failures_as_os_errors, require

CAMERA, POINTS = "camera", "points"


def write_alembic(shot: Shot, path: Path) -> None:
    """Write an archive (Ogawa); the time of a frame is its number divided by the frame rate.

    The focal length is in mm and the film back in cm, as Alembic requires. Only registered frames have a sample; tools
    interpolate between them. Distortion is not included.

    Raises:
        InputError: alembic3d is missing.
    """
    abc, geom, core = (require(f"alembic3d.{name}") for name in ("Abc", "AbcGeom", "AbcCoreAbstract"))
    imath = require("imath")
    times = core.TimeVector()
    for number in shot.numbers:
        times.append(number / shot.fps)
    sampling = core.TimeSampling(core.TimeSamplingType(core.AcyclicFlag.kAcyclic), times)

    _check_room(path, 64 * 1024 + 1024 * len(shot.numbers) + 64 * len(shot.reconstruction.points))
    with failures_as_os_errors():
        archive = abc.OArchive(str(path), asOgawa=True)
        _write_camera(shot, archive, archive.addTimeSampling(sampling), geom, imath)
        _write_points(shot, archive, geom, imath)


def _check_room(path: Path, size: int) -> None:
    """Raise an OSError if the disk is full; Alembic would abort the whole process."""
    with path.open("wb") as file:
        file.write(bytes(size))


def _write_camera(shot: Shot, archive: Any, sampling: int, geom: Any, imath: Any) -> None:
    lens = shot.lens
    transform = geom.OXform(archive.getTop(), CAMERA, sampling)
    for matrix in shot.world_from_film:
        sample = geom.XformSample()
        sample.setMatrix(imath.M44d(*matrix.T.ravel().tolist()))
        transform.getSchema().set(sample)
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


def _write_points(shot: Shot, archive: Any, geom: Any, imath: Any) -> None:
    count = len(shot.reconstruction.points)
    positions, colors, ids = imath.V3fArray(count), imath.C3fArray(count), imath.IntArray(count)
    shades = shot.linear_colors.tolist()
    for i, (point, color) in enumerate(zip(shot.reconstruction.points.tolist(), shades, strict=True)):
        positions[i], colors[i], ids[i] = imath.V3f(*point), imath.Color3f(*color), i
    schema = geom.OPoints(archive.getTop(), POINTS).getSchema()
    schema.set(geom.OPointsSchemaSample(positions, ids))
    scope = geom.GeometryScope.kVertexScope
    parameter = geom.OC3fGeomParam(schema.getArbGeomParams(), "Cs", False, scope, 1)
    parameter.set(geom.OC3fGeomParamSample(colors, scope))
