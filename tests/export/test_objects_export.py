"""Objects in each format: where their points are in the world, as the other tool has it."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from factorsfm.export import ExportOptions, export
from factorsfm.objects.object_result import ObjectFrame, ObjectResult
from factorsfm.result.reconstruction import Reconstruction
from tests.export.test_blender import BLENDER, run_blender
from tests.export.test_formats import degrees_about, nuke_inputs, nuke_rotation
from tests.export_problems import hard_reconstruction, moved
from tests.exported_files import after_effects_tracks, nuke_curves, nuke_nodes

Array = NDArray[np.float64]

INDICES = (10, 12, 14, 18)  # of its frames; the camera has others, too
SCALE = 3.0
EXACT = 1e-5  # single precision of positions of a few units


def moving(name: str = "red car", seed: int = 3) -> ObjectResult:
    rng = np.random.default_rng(seed)
    frames = [
        ObjectFrame(
            index,
            pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.2, -0.5, 0.3]) * k), rng.uniform(-2, 4, 3)),
            np.eye(6),
        )
        for k, index in enumerate(INDICES)
    ]
    colors = rng.integers(0, 256, (7, 3)).astype(np.uint8)
    return ObjectResult(name, tuple(frames), rng.uniform(-1, 1, (7, 3)), colors, 0.1, 0.05, "prior", "")


def with_objects(*objects: ObjectResult) -> Reconstruction:
    return hard_reconstruction("PINHOLE", objects=objects)


def true_places(thing: ObjectResult, up_axis: str, scale: float) -> Array:
    """(k, n, 3) of its points in the exported world."""
    return np.array([moved(frame.world_from_object * thing.points, up_axis, scale) for frame in thing.frames])


def placed(rotation: Array, translation: Array, points: Array) -> Array:
    return points @ rotation.T + translation


def test_nuke_axis_moves_the_points(tmp_path: Path) -> None:
    thing = moving()
    export(with_objects(thing), tmp_path / "out", format="nuke", options=ExportOptions(scale=SCALE))
    text = (tmp_path / "out" / "camera.nk").read_text()
    axis = nuke_nodes(text)["object_red_car"]
    assert (axis["class"], axis["rot_order"]) == ("Axis2", "ZXY")
    translate, rotate = nuke_curves(axis["translate"]), nuke_curves(axis["rotate"])
    assert list(translate) == list(rotate) == [1001 + index for index in INDICES]
    vertices = [line.split()[1:] for line in (tmp_path / "out" / "object_red_car.obj").read_text().splitlines()]
    faces = np.array(vertices[28:], int).reshape(7, 4, 3) - 1
    points = np.array(vertices[:28], float)[faces].mean(axis=(1, 2))
    found = [placed(nuke_rotation(*rotate[frame]), np.array(translate[frame]), points) for frame in translate]
    np.testing.assert_allclose(found, true_places(thing, "y", SCALE), atol=EXACT)
    inputs = nuke_inputs(text)
    assert inputs["object_red_car_moved"] == ["object_red_car_points", "object_red_car"]
    assert inputs["AllPoints"] == ["Points", "object_red_car_moved"]
    assert inputs["PointsOnUndistortedPlate"] == ["Plate", "AllPoints", "Camera"]


def test_after_effects_null(tmp_path: Path) -> None:
    thing = moving()
    export(with_objects(thing), tmp_path / "out", format="after-effects")
    _, tracks = after_effects_tracks((tmp_path / "out" / "object_red_car.txt").read_text())
    found = []
    for (frame, position), (x, y, z) in zip(
        tracks["Transform\tPosition"].items(), tracks["Transform\tOrientation"].values(), strict=True
    ):
        assert frame == INDICES[len(found)]
        rotation = degrees_about(0, x) @ degrees_about(1, y) @ degrees_about(2, z)
        found.append(placed(rotation, np.array(position) - [320, 240, 0], 100.0 * thing.points))
    np.testing.assert_allclose(found, true_places(thing, "-y", 100.0), atol=1e-6)


def test_usd_points_below_their_transform(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core (extra vfx) is not installed")
    from pxr import Gf, Usd, UsdGeom, UsdValidation

    things = moving(), moving("red-car", 4)
    export(with_objects(*things), tmp_path / "shot.usda", format="usd", options=ExportOptions(scale=SCALE))
    stage = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    for thing, name in zip(things, ("object_red_car", "object_red_car_"), strict=True):
        points = UsdGeom.Points(stage.GetPrimAtPath(f"/factorsfm/{name}/points"))
        parent = points.GetPrim().GetParent()
        frames = parent.GetAttribute("xformOp:transform").GetTimeSamples()
        assert frames == [1001 + index for index in INDICES]
        found = []
        for frame in frames:
            to_world = UsdGeom.Imageable(points).ComputeLocalToWorldTransform(Usd.TimeCode(frame))
            found.append([to_world.Transform(Gf.Vec3d(*map(float, p))) for p in points.GetPointsAttr().Get()])
        np.testing.assert_allclose(found, true_places(thing, "y", SCALE), atol=EXACT)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert not UsdValidation.ValidationContext(validators).Validate(stage)


def test_alembic_points_below_their_transform(tmp_path: Path) -> None:
    pytest.importorskip("alembic3d", reason="alembic3d (extra alembic) is not installed")
    from alembic3d.Abc import IArchive, ISampleSelector
    from alembic3d.AbcGeom import IPoints, IXform

    thing = moving()
    export(with_objects(thing), tmp_path / "shot.abc", format="alembic", options=ExportOptions(fps=25, scale=SCALE))
    transform = IXform(IArchive(str(tmp_path / "shot.abc")).getTop(), "object_red_car")
    schema = transform.getSchema()
    times = [schema.getTimeSampling().getSampleTime(i) for i in range(schema.getNumSamples())]
    np.testing.assert_allclose(times, (1001 + np.array(INDICES)) / 25, rtol=1e-12)
    positions = IPoints(transform, "points").getSchema().getValue().getPositions()
    points = np.array([list(p) for p in positions])
    matrices = [schema.getValue(ISampleSelector(time)).getMatrix() for time in times]
    world = np.array([[[m[row][column] for row in range(4)] for column in range(4)] for m in matrices])
    found = [placed(matrix[:3, :3], matrix[:3, 3], points) for matrix in world]
    np.testing.assert_allclose(found, true_places(thing, "y", SCALE), atol=EXACT)


@pytest.mark.skipif(BLENDER is None, reason="Blender is not installed (Debian's package: blender)")
def test_blender_empty_moves_the_points(tmp_path: Path) -> None:
    thing = moving()
    objects = run_blender(tmp_path, None, with_objects(thing))["scene"]["objects"]
    assert list(objects) == ["object_red_car"]
    found = objects["object_red_car"]
    assert found["keys"] == [1 + index for index in INDICES]
    places = [found["places"][str(1 + index)] for index in INDICES]
    np.testing.assert_allclose(places, true_places(thing, "z", SCALE), atol=EXACT)


def test_an_object_begins_along_the_axes_of_the_world(tmp_path: Path) -> None:
    """It is not turned in its first frame, whatever axis points up."""
    thing = moving()
    for up_axis in ("-y", "y", "z"):
        folder = tmp_path / up_axis
        export(with_objects(thing), folder, format="nuke", options=ExportOptions(up_axis=up_axis))
        rotate = nuke_curves(nuke_nodes((folder / "camera.nk").read_text())["object_red_car"]["rotate"])
        np.testing.assert_allclose(nuke_rotation(*rotate[1011]), np.eye(3), atol=1e-9)
        assert np.linalg.norm(cv2.Rodrigues(nuke_rotation(*rotate[1013]))[0]) == pytest.approx(0.6164, abs=1e-4)
