"""Focal lengths that change from frame to frame, read back from each format that can hold them."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pycolmap
import pytest

from factorsfm.camera.projection import with_focal
from factorsfm.export import ExportOptions, export
from factorsfm.graph.explicit_graph import factor_graph
from factorsfm.imagesets.add_images import add_images
from factorsfm.report.data import reconstruction_data
from factorsfm.report.overlay import Projector
from factorsfm.report.page import report_html
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError
from factorsfm.support.status import ShotKind
from tests.export_problems import hard_reconstruction, noise_images, numbers
from tests.exported_files import after_effects_tracks, nuke_curves, nuke_nodes


def zooming(model: str = "PINHOLE") -> tuple[Reconstruction, np.ndarray]:
    """A reconstruction whose frames have lenses of their own, and the fx of the registered ones."""
    reconstruction = hard_reconstruction(model)
    mean = reconstruction.camera.mean_focal_length()
    factor = 1.0 + 0.05 * np.arange(len(reconstruction.registered))
    for k, frame in zip(factor, reconstruction.registered, strict=True):
        frame.camera = with_focal(reconstruction.camera, mean * k)
    return reconstruction, 600.0 * factor


@pytest.mark.parametrize("format", ["colmap", "colmap-binary"])
def test_colmap_has_a_camera_per_image(tmp_path: Path, format: str) -> None:
    reconstruction, _ = zooming("OPENCV")
    export(reconstruction, tmp_path / "out", format=format)
    model = pycolmap.Reconstruction(tmp_path / "out")
    assert len(model.cameras) == len(reconstruction.registered)
    for frame in reconstruction.registered:
        np.testing.assert_array_equal(model.images[frame.index + 1].camera.params, frame.camera.params)


def test_nerfstudio_has_intrinsics_per_frame(tmp_path: Path) -> None:
    reconstruction, focal = zooming("OPENCV")
    export(reconstruction, tmp_path / "out", format="nerfstudio")
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    np.testing.assert_allclose([frame["fl_x"] for frame in frames], focal)
    np.testing.assert_allclose([frame["fl_y"] for frame in frames], focal * 1200 / 600)
    assert {frame["k1"] for frame in frames} == {0.06}


def test_nuke_s_focal_length_has_keys(tmp_path: Path) -> None:
    reconstruction, focal = zooming()
    export(reconstruction, tmp_path / "out", format="nuke", options=ExportOptions(sensor_width=24.89))
    camera = nuke_nodes((tmp_path / "out" / "camera.nk").read_text())["Camera"]
    keys = nuke_curves(camera["focal"])
    assert list(keys) == numbers(reconstruction, 1001)
    np.testing.assert_allclose(np.ravel(list(keys.values())), focal * 24.89 / 640)


@pytest.mark.parametrize("first", [None, 5])
def test_maps_have_the_numbers_of_the_plates(first: int | None, tmp_path: Path) -> None:
    reconstruction, _ = zooming("OPENCV")
    options = ExportOptions(footage=noise_images(tmp_path / "shot", 21, name="{:02d}.png"), first_frame=first)
    for format in ("stmap", "undistorted"):
        export(reconstruction, tmp_path / format, format=format, options=options)
    frames = numbers(reconstruction, first or 1001)
    for name in ("undistort", "distort"):
        assert sorted(path.name for path in (tmp_path / "stmap").glob(f"{name}.*")) == [
            f"{name}.{frame:04d}.exr" for frame in frames
        ]
    assert {f"plate.{frame:04d}.png" for frame in frames} <= {
        path.name for path in (tmp_path / "undistorted").iterdir()
    }


def test_nuke_reads_a_map_for_every_frame(tmp_path: Path) -> None:
    reconstruction, _ = zooming("OPENCV")
    export(reconstruction, tmp_path / "out", format="nuke")
    nodes = nuke_nodes((tmp_path / "out" / "camera.nk").read_text())
    assert nodes["Map_undistort"]["file"].endswith('undistort.%04d.exr"')
    frames = numbers(reconstruction, 1001)
    assert (nodes["Map_distort"]["first"], nodes["Map_distort"]["last"]) == (str(frames[0]), str(frames[-1]))
    for number, frame in zip(frames, reconstruction.registered, strict=True):
        assert (tmp_path / "out" / f"distort.{number}.exr").exists()
        with OpenEXR.File(str(tmp_path / "out" / f"undistort.{number}.exr")) as file:
            found = file.channels()["RGB"].pixels[100, 50, :2]
        camera = frame.camera
        ray = [(50.5 - 290) / camera.focal_length_x, (100.5 - 262) / camera.focal_length_y, 1.0]
        x, y = camera.img_from_cam(np.array([ray]))[0]
        np.testing.assert_allclose(found, [x / 640, 1 - y / 480], atol=1e-6)


def test_undistorted_plates_follow_the_zoom(tmp_path: Path) -> None:
    reconstruction, _ = zooming("OPENCV")
    footage = noise_images(tmp_path / "shot", 21)
    export(reconstruction, tmp_path / "zoom", format="undistorted", options=ExportOptions(footage=footage))
    export(hard_reconstruction(), tmp_path / "fixed", format="undistorted", options=ExportOptions(footage=footage))
    first, last = numbers(reconstruction, 1001)[0], numbers(reconstruction, 1001)[-1]
    same = [
        (tmp_path / "zoom" / name).read_bytes() == (tmp_path / "fixed" / name).read_bytes()
        for name in (f"plate.{first}.png", f"plate.{last}.png")
    ]
    assert same == [True, False]


def test_chan_has_the_field_of_view_of_each_frame(tmp_path: Path) -> None:
    reconstruction, focal = zooming()
    export(reconstruction, tmp_path / "c.chan", format="chan")
    expected = [math.degrees(2 * math.atan(240 / (f * 1200 / 600))) for f in focal]
    np.testing.assert_allclose(np.loadtxt(tmp_path / "c.chan")[:, 7], expected)


def test_after_effects_zooms(tmp_path: Path) -> None:
    reconstruction, focal = zooming()
    export(reconstruction, tmp_path / "out", format="after-effects")
    _, tracks = after_effects_tracks((tmp_path / "out" / "camera.txt").read_text())
    np.testing.assert_allclose(np.ravel(list(tracks["Camera Options\tZoom"].values())), focal)


def test_usd_has_samples_of_the_focal_length(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="usd-core (extra vfx) is not installed")
    from pxr import Usd, UsdGeom

    reconstruction, focal = zooming()
    export(reconstruction, tmp_path / "shot.usda", format="usd")
    stage = Usd.Stage.Open(str(tmp_path / "shot.usda"))
    attribute = UsdGeom.Camera(stage.GetPrimAtPath("/factorsfm/camera")).GetFocalLengthAttr()
    assert attribute.GetTimeSamples() == numbers(reconstruction, 1001)
    found = [attribute.Get(number) for number in numbers(reconstruction, 1001)]
    np.testing.assert_allclose(found, focal * 36 / 640, rtol=1e-6)


def test_alembic_has_samples_of_the_focal_length(tmp_path: Path) -> None:
    pytest.importorskip("alembic3d", reason="alembic3d (extra alembic) is not installed")
    from alembic3d.Abc import IArchive, ISampleSelector
    from alembic3d.AbcGeom import ICamera, IXform

    reconstruction, focal = zooming()
    export(reconstruction, tmp_path / "shot.abc", format="alembic", options=ExportOptions(fps=25))
    schema = ICamera(IXform(IArchive(str(tmp_path / "shot.abc")).getTop(), "camera"), "cameraShape").getSchema()
    times = np.array(numbers(reconstruction, 1001)) / 25
    found = [schema.getValue(ISampleSelector(float(time))).getFocalLength() for time in times]
    np.testing.assert_allclose(found, focal * 36 / 640, rtol=1e-9)


def test_graph_report_and_overlay_see_through_the_lens_of_the_frame() -> None:
    reconstruction, focal = zooming()
    np.testing.assert_allclose(reconstruction_data(reconstruction)["focals"], focal)
    mean = [frame.camera.mean_focal_length() for frame in reconstruction.registered]
    assert f"{mean[0]:.1f} to {mean[-1]:.1f} px" in report_html(reconstruction)
    last = reconstruction.registered[-1]
    projector = Projector.of(reconstruction).through(last.camera)
    point = last.cam_from_world.inverse() * np.array([[0.2, -0.1, 3.0]])
    expected = last.camera.img_from_cam(np.array([[0.2, -0.1, 3.0]])) - 0.5
    np.testing.assert_allclose(projector(last.cam_from_world, point), expected)
    graph, values = factor_graph(reconstruction)
    fixed, _ = factor_graph(hard_reconstruction("PINHOLE"))
    assert graph.size() == fixed.size()
    assert graph.error(values) != pytest.approx(fixed.error(values))


def test_no_images_are_added_to_a_zoom() -> None:
    reconstruction, _ = zooming()
    with pytest.raises(InputError, match="this one zooms"):
        add_images(replace(reconstruction, kind=ShotKind.GENERAL), [])
