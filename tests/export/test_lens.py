"""The lens in the models of other programs, by their formulas, and OpenTrackIO samples by OpenTrackIO's."""

import json
import math
import re
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from factorsfm.camera.files import read_camera
from factorsfm.export import ExportOptions, export
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError
from tests.export.test_zoom_export import zooming
from tests.export_problems import hard_reconstruction, moved, numbers, seen_points

Array = NDArray[np.float64]

RADIAL = [600.0, 1200.0, 316.0, 246.0, -0.08, 0.02, 0.0, 0.0]  # anamorphic, 2:1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lens") / "out"
    export(radial(), path, format="lens", options=ExportOptions(sensor_width=24.0))
    return path


def radial() -> Reconstruction:
    reconstruction = hard_reconstruction()
    reconstruction.camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=RADIAL)
    return reconstruction


def places() -> tuple[Array, Array]:
    """(n, 2) pixels from the corner over the image, and where they are without distortion."""
    bent = np.array([[u, v] for u in np.linspace(0, 640, 9) for v in np.linspace(0, 480, 7)])
    matrix, often = np.array([[600, 0, 316], [0, 1200, 246], [0, 0, 1.0]]), (cv2.TERM_CRITERIA_COUNT, 60, 0)
    rays = cv2.undistortPoints(bent, matrix, np.array(RADIAL[4:]), criteria=often)[:, 0]
    return bent, rays * [600, 1200] + [316, 246]


def said(text: str) -> float:
    return float(re.search(r"largest deviation over the image: ([\d.]+) pixels", text)[1])


def test_3de_classic(folder: Path) -> None:
    text = (folder / "3de.txt").read_text()
    values = dict(line.split(": ") for line in text.splitlines()[1:])
    assert values["Lens Distortion Model"] == "3DE Classic LD Model"
    cm = {name: float(value.removesuffix(" cm")) for name, value in values.items() if value.endswith(" cm")}
    delta, quartic = float(values["Distortion"]), float(values["Quartic Distortion"])
    assert float(values["Pixel Aspect"]) == pytest.approx(2.0)
    assert cm["Focal Length"] / cm["Filmback Width"] * 640 == pytest.approx(600)
    size = np.array([cm["Filmback Width"], cm["Filmback Height"]])
    bent, straight = places()
    center = np.array([cm["Lens Center X"], -cm["Lens Center Y"]])
    place = (bent / [640, 480] - 0.5) * size - center  # cm, y down
    square = (place**2).sum(axis=1) / ((size / 2) ** 2).sum()
    undone = place * (1 + delta * square + quartic * square**2)[:, None] + center
    away = np.linalg.norm((undone / size + 0.5) * [640, 480] - straight, axis=1).max()
    assert 0.0005 < said(text) < 0.05
    assert away == pytest.approx(said(text), abs=0.002)


def test_nuke_s_lens_distortion(folder: Path) -> None:
    text = (folder / "nuke.nk").read_text()
    k1, k2 = (float(re.search(rf"distortionDenominator{k} (\S+)", text)[1]) for k in (0, 1))
    assert "output Undistort" in text
    bent, straight = places()
    place = (bent - [320, 240]) / 320
    square = (place**2).sum(axis=1)
    undone = place / (1 + k1 * square + k2 * square**2)[:, None] * 320 + [320, 240]
    away = np.linalg.norm(undone - straight, axis=1).max()
    assert 0.5 < away < 3.0  # an anamorphic lens is round in other places than its pixels
    assert away == pytest.approx(said(text), abs=0.01)


def test_blender_s_script(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = SimpleNamespace(principal_point=None)
    clips = [SimpleNamespace(tracking=SimpleNamespace(camera=camera))]
    monkeypatch.setitem(sys.modules, "bpy", SimpleNamespace(data=SimpleNamespace(movieclips=clips)))
    runpy.run_path(str(folder / "blender.py"))
    bent, straight = places()
    center = (np.array(camera.principal_point) * [1, -1] + 1) / 2 * [640, 480]
    focal = camera.focal_length / camera.sensor_width * 640 * np.array([1.0, camera.pixel_aspect])
    place = (straight - center) / focal
    square = (place**2).sum(axis=1)
    done = place * (1 + camera.k1 * square + camera.k2 * square**2 + camera.k3 * square**3)[:, None] * focal + center
    np.testing.assert_allclose(done, bent, atol=1e-5)
    assert said((folder / "blender.py").read_text()) == 0.0
    clips.clear()
    with pytest.raises(SystemExit, match="no movie clip"):
        runpy.run_path(str(folder / "blender.py"))


def test_a_zoom_has_no_one_lens(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="lens is for one lens, and this one changes"):
        export(zooming()[0], tmp_path / "out", format="lens")


def turn(axis: int, degrees: float) -> Array:
    return cv2.Rodrigues(np.eye(3)[axis] * math.radians(degrees))[0]


def test_opentrackio_projects_as_pycolmap(tmp_path: Path) -> None:
    reconstruction = hard_reconstruction()
    options = ExportOptions(scale=2.5, sensor_width=24.0, fps=30000 / 1001, first_frame=101)
    export(reconstruction, tmp_path / "out.jsonl", format="opentrackio", options=options)
    samples = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert [sample["timing"]["sequenceNumber"] for sample in samples] == numbers(reconstruction, 101)
    assert len({sample["sampleId"] for sample in samples}) == len(samples)
    for position, sample in enumerate(samples):
        assert sample["protocol"] == {"name": "OpenTrackIO", "version": [1, 0, 1]}
        assert re.fullmatch("urn:uuid:[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", sample["sampleId"])
        rate, time = sample["timing"]["sampleRate"], sample["timing"]["sampleTimestamp"]
        assert rate == sample["static"]["camera"]["captureFrameRate"] == {"num": 30000, "denom": 1001}
        seconds = time["seconds"] + time["nanoseconds"] * 1e-9
        assert seconds * rate["num"] / rate["denom"] == pytest.approx(sample["timing"]["sequenceNumber"], abs=1e-6)
        (transform,) = sample["transforms"]
        angle = transform["rotation"]
        rotation = turn(2, angle["pan"]) @ turn(0, angle["tilt"]) @ turn(1, angle["roll"])
        points, _ = seen_points(reconstruction, position)
        local = (moved(points, "z", 2.5) - list(transform["translation"].values())) @ rotation  # right, ahead, up
        lens, size = sample["lens"], sample["static"]["camera"]["activeSensorPhysicalDimensions"]
        x, y = lens["pinholeFocalLength"] * np.array([local[:, 0], -local[:, 2]]) / local[:, 1]
        (bent,) = lens["distortion"]
        assert bent["model"] == "Brown-Conrady U-D"
        l1, l2, l3 = bent["radial"]
        assert l2 == 0  # of the denominator
        q1, q2 = bent["tangential"]
        square = x**2 + y**2
        factor = 1 + l1 * square + l3 * square**2
        u = x * factor + 2 * q1 * x * y + q2 * (square + 2 * x**2) + lens["projectionOffset"]["x"]
        v = y * factor + q1 * (square + 2 * y**2) + 2 * q2 * x * y + lens["projectionOffset"]["y"]
        pixels = np.column_stack([(u / size["width"] + 0.5) * 640, (v / size["height"] + 0.5) * 480])
        pose = reconstruction.registered[position].cam_from_world
        np.testing.assert_allclose(pixels, reconstruction.camera.img_from_cam(pose * points), atol=1e-6)
    camera = read_camera(tmp_path / "out.jsonl")
    np.testing.assert_allclose(camera.params, reconstruction.camera.params, atol=1e-9)
    with pytest.raises(InputError, match="OpenTrackIO has z up"):
        export(reconstruction, tmp_path / "y", format="opentrackio", options=ExportOptions(up_axis="y"))


def test_opentrackio_of_a_zoom_and_of_another_lens_model(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    reconstruction, focal = zooming()
    export(reconstruction, tmp_path / "zoom", format="opentrackio")
    samples = [json.loads(line) for line in (tmp_path / "zoom").read_text().splitlines()]
    assert [s["lens"]["pinholeFocalLength"] for s in samples] == pytest.approx(focal * 36 / 640)
    assert "distortion" not in samples[0]["lens"]
    fisheye = hard_reconstruction()
    fisheye.camera = pycolmap.Camera(model="SIMPLE_RADIAL_FISHEYE", width=640, height=480, params=[400, 320, 240, 0.02])
    export(fisheye, tmp_path / "fisheye", format="opentrackio")
    assert "OpenTrackIO's lens model is up to 2.7" in caplog.text
