"""Lens files of other programs as cameras, and a lens in the models of other programs."""

import json
import logging
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from factorsfm.camera.files import read_camera
from factorsfm.camera.openlensio import distortion_of
from factorsfm.camera.other_models import distorting, dividing, undistorting
from factorsfm.support.errors import InputError

Array = NDArray[np.float64]

SIZE = {"width": 640, "height": 480}
MATRIX = np.array([[600.0, 0, 310.5], [0, 640.0, 250.5], [0, 0, 1]])  # OpenCV: pixel centres at integers
RAYS = np.array([[x, y, 1.0] for x in (-0.45, -0.2, 0.1, 0.4) for y in (-0.3, 0.05, 0.3)])


def opencv_file(path: Path, coefficients: list[float]) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", np.array([coefficients]))
    storage.release()
    return path


@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml"])
@pytest.mark.parametrize(
    ("coefficients", "model"),
    [
        ([-0.1, 0.02, 0.001, -0.002], "OPENCV"),
        ([-0.1, 0.02, 0.001, -0.002, 0.0], "OPENCV"),
        ([-0.1, 0.02, 0.001, -0.002, 0.03], "FULL_OPENCV"),
        ([-0.1, 0.02, 0.001, -0.002, 0.03, 0.01, -0.004, 0.002], "FULL_OPENCV"),
    ],
)
def test_opencv_s_calibration(tmp_path: Path, suffix: str, coefficients: list[float], model: str) -> None:
    camera = read_camera(opencv_file(tmp_path / f"lens{suffix}", coefficients))
    assert (camera.width, camera.height, camera.model_name) == (640, 480, model)
    expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients))[0][:, 0]
    np.testing.assert_allclose(camera.img_from_cam(RAYS) - 0.5, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("kind", "coefficients", "model"),
    [
        ("plumb_bob", [-0.1, 0.02, 0.001, -0.002, 0.0], "OPENCV"),
        ("equidistant", [0.1, 0.02, 0.003, 0.001], "OPENCV_FISHEYE"),
    ],
)
def test_ros_camera_info(tmp_path: Path, kind: str, coefficients: list[float], model: str) -> None:
    path = tmp_path / "ost.yaml"
    path.write_text(
        f"image_width: 640\nimage_height: 480\ncamera_name: narrow\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        f"  data: {MATRIX.ravel().tolist()}\ndistortion_model: {kind}\ndistortion_coefficients:\n  rows: 1\n"
        f"  cols: {len(coefficients)}\n  data: {coefficients}\n"
    )
    camera = read_camera(path)
    assert camera.model_name == model
    rays = RAYS[:, None]
    if model == "OPENCV":
        expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients))[0]
    else:
        expected = cv2.fisheye.projectPoints(rays, np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients))[0]
    np.testing.assert_allclose(camera.img_from_cam(RAYS) - 0.5, expected.reshape(-1, 2), atol=1e-9)


ECHOED = """header:
  stamp:
    sec: 1700000000
  frame_id: ''
height: 480
width: 640
distortion_model: plumb_bob
{d}
{k}
roi:
  height: 0
  width: 0
  do_rectify: false
"""


@pytest.mark.parametrize("block", [True, False])
@pytest.mark.parametrize("names", ["DK", "dk"])  # of ROS 1 and 2
def test_ros_camera_info_as_it_is_echoed(block: bool, names: str, tmp_path: Path) -> None:
    """Its message, with lists in lines of their own or in one, and further messages behind it."""

    def listed(name: str, values: list[float]) -> str:
        return f"{name}:" + ("".join(f"\n- {value}" for value in values) if block else f" {values}")

    coefficients = [-0.1, 0.02, 0.001, -0.002, 0.0]
    message = ECHOED.format(d=listed(names[0], coefficients), k=listed(names[1], MATRIX.ravel().tolist()))
    (tmp_path / "info.yaml").write_text(f"# echoed\n---\n{message}---\n{message}---\n")
    camera = read_camera(tmp_path / "info.yaml")
    assert (camera.width, camera.height, camera.model_name) == (640, 480, "OPENCV")
    expected = cv2.projectPoints(RAYS, np.zeros(3), np.zeros(3), MATRIX, np.array(coefficients))[0][:, 0]
    np.testing.assert_allclose(camera.img_from_cam(RAYS) - 0.5, expected, atol=1e-9)


def test_colmap_s_cameras(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="RADIAL", params=[600, 321, 241, -0.1, 0.02], camera_id=3, **SIZE)
    model.add_camera(camera)
    model.write_text(tmp_path)
    found = read_camera(tmp_path / "cameras.txt")
    assert (found.model_name, found.width, found.height) == ("RADIAL", 640, 480)
    np.testing.assert_allclose(found.params, camera.params, atol=1e-12)


def sample(**lens: object) -> dict[str, object]:
    camera = {"activeSensorPhysicalDimensions": {"width": 32.0, "height": 22.5}, "activeSensorResolution": SIZE}
    offset = {"x": -0.45, "y": 0.515625}  # 11 pixels to the left, 11 down
    return {"static": {"camera": camera}, "lens": {"pinholeFocalLength": 30.0, "projectionOffset": offset, **lens}}


def openlensio_places(rays: Array, radial: list[float], tangential: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Pixels from the corner, by the formulas of OpenLensIO: mm on the sensor, coefficients in turn above and below."""
    x, y = 30.0 * rays[:, :2].T
    square = x**2 + y**2
    l1, l2, l3, l4, l5, l6 = [*radial, *(0.0,) * (6 - len(radial))]
    factor = (1 + l1 * square + l3 * square**2 + l5 * square**3) / (1 + l2 * square + l4 * square**2 + l6 * square**3)
    q1, q2 = tangential
    mm = np.column_stack(
        [
            x * factor + 2 * q1 * x * y + q2 * (square + 2 * x**2),
            y * factor + q1 * (square + 2 * y**2) + 2 * q2 * x * y,
        ]
    )
    return (mm + [-0.45, 0.515625]) * [640 / 32.0, 480 / 22.5] + [320, 240]


@pytest.mark.parametrize(
    ("radial", "tangential", "model"),
    [
        ([], (), "PINHOLE"),
        ([-1e-4], (), "OPENCV"),
        ([-1e-4, 0.0, 2e-8], (3e-5, -2e-5), "OPENCV"),
        ([-1e-4, 3e-5, 2e-8, 1e-8, 1e-11, -2e-12], (), "FULL_OPENCV"),
    ],
)
@pytest.mark.parametrize("lines", [1, 2])
def test_opentrackio(
    tmp_path: Path, radial: list[float], tangential: tuple[float, ...], model: str, lines: int
) -> None:
    distortion = {"model": "Brown-Conrady U-D", "radial": radial, **({"tangential": tangential} if tangential else {})}
    text = json.dumps(sample(**({"distortion": [{"radial": [9.0]}, distortion]} if radial else {})))
    (tmp_path / "lens.json").write_text("\n".join([text] * lines))
    camera = read_camera(tmp_path / "lens.json")
    assert camera.model_name == model
    expected = openlensio_places(RAYS, radial, tangential or (0.0, 0.0))
    np.testing.assert_allclose(camera.img_from_cam(RAYS), expected, atol=1e-9)


@pytest.mark.parametrize(("tangential", "tolerance"), [((0.0, 0.0), 0.002), ((2e-5, 1e-5), 0.05)])
def test_opentrackio_from_distorted_to_undistorted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, tangential: tuple[float, float], tolerance: float
) -> None:
    distortion = [{"radial": [1e-4, 0.0, 3e-8], "tangential": tangential}]
    (tmp_path / "lens.json").write_text(json.dumps(sample(distortion=distortion, projectionOffset={"x": 0, "y": 0})))
    camera = read_camera(tmp_path / "lens.json")
    pixels = np.array([[u, v] for u in (5.0, 200.0, 635.0) for v in (5.0, 300.0, 475.0)])
    bent = np.column_stack([(pixels - [320, 240]) / [600, 640], np.ones(9)])
    middle = openlensio_places(np.array([[0, 0, 1.0]]), [])
    undone = openlensio_places(bent, [1e-4, 0.0, 3e-8], tangential) - middle
    np.testing.assert_allclose(camera.cam_from_img(pixels) * [600, 640], undone, atol=tolerance)
    assert not caplog.records
    (tmp_path / "lens.json").write_text(json.dumps(sample(distortion=[{"radial": [4e-3, 0.0, 3e-5]}])))
    with caplog.at_level(logging.WARNING):
        read_camera(tmp_path / "lens.json")
    assert "of the image's width away" in caplog.text


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.yml", "image_width: 640", "no 3x3 matrix"),
        ("a.yml", "width: 640\nheight: 480\nK: [1, 0, 1]\n", "it has no 3x3 matrix under camera_matrix, .*, K, k"),
        ("a.yml", "width: 640\nheight: 480\nK: [[1, 0, 1], [0, 1, 1], [0, 0, 1]]\n", "K holds something else than"),
        ("a.yml", "width: 640\nheight: 480\nK: [a, b, c, d, e, f, g, h, i]\n", "K holds something else than"),
        ("a.yml", f"width: 640\nheight: 480\nK: {MATRIX.ravel().tolist()}\nD: [much]\n", "D holds something else than"),
        ("a.yml", "---\n# nothing\n", "no 3x3 matrix"),
        ("a.yml", "{{{", "it has no 3x3 matrix|not YAML"),
        ("a.txt", "# nothing\n", "it holds 0 cameras; one is expected"),
        ("a.txt", "1 PINHOLE 640\n", "CAMERA_ID, MODEL, WIDTH, HEIGHT"),
        ("a.txt", "1 LENS 640 480 1 2 3\n", "'LENS'; the name of a COLMAP camera model"),
        ("a.txt", "1 PINHOLE 640 480 600\n", "1 numbers; PINHOLE takes fx, fy, cx, cy"),
        ("a.json", '{"width": 1}\n{"width": 2}', "it is not JSON: Extra data"),
        ("a.json", json.dumps({"static": {"camera": {}}, "lens": {}}), "activeSensorPhysicalDimensions"),
        ("a.json", json.dumps(sample(distortionOffset={"x": 1.0}, distortion=[{"radial": [0.1]}])), "distortionOffset"),
        ("a.json", json.dumps(sample(distortion=[{"radial": [1e-4], "model": "Anamorphic"}])), '"Anamorphic"; "Brown'),
    ],
)  # fmt: skip
def test_bad_lens_files_are_refused_in_one_sentence(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_camera(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert str(tmp_path / name) in str(caught.value)


@pytest.mark.parametrize(("coefficients", "word"), [([0.1] * 6, "6 distortion"), ([0.1] * 12, "no thin prism")])
def test_opencv_s_further_models_are_refused(tmp_path: Path, coefficients: list[float], word: str) -> None:
    with pytest.raises(InputError, match=word):
        read_camera(opencv_file(tmp_path / "lens.yml", coefficients))


# --- other models -------------------------------------------------------------------------------------------------

LENS = pycolmap.Camera(model="OPENCV", params=[600, 600, 325, 236, -0.12, 0.03, 0, 0], **SIZE)
STRONG = pycolmap.Camera(model="SIMPLE_RADIAL_FISHEYE", params=[400, 320, 240, 0.02], **SIZE)


def corner_places(camera: pycolmap.Camera) -> tuple[Array, Array]:
    """Distorted pixels over the image, and the undistorted ones, both from the corner."""
    pixels = np.array([[u, v] for u in (0.0, 100.0, 320.0, 640.0) for v in (0.0, 240.0, 480.0)])
    focal = [camera.focal_length_x, camera.focal_length_y]
    return pixels, camera.cam_from_img(pixels) * focal + [camera.principal_point_x, camera.principal_point_y]


@pytest.mark.parametrize(("camera", "low", "high"), [(LENS, 0.0, 1e-7), (STRONG, 1.0, 4.0)])
def test_polynomial_of_the_undistorted_radius(camera: pycolmap.Camera, low: float, high: float) -> None:
    fit = distorting(camera, 3, 1.0)
    bent, straight = corner_places(camera)
    center, focal = np.array(camera.params[[1, 2]] if camera is STRONG else camera.params[[2, 3]]), camera.params[0]
    place = (straight - center) / focal
    square = (place**2).sum(axis=1)
    factor = 1 + sum(k * square**power for power, k in enumerate(fit.coefficients, 1))
    away = np.linalg.norm(place * factor[:, None] * focal + center - bent, axis=1).max()
    assert low <= fit.deviation_px < high
    assert away == pytest.approx(fit.deviation_px, abs=0.4 * fit.deviation_px + 1e-7)


def test_polynomial_of_the_distorted_radius() -> None:
    unit = 0.5  # focal lengths
    fit = undistorting(LENS, 2, unit)
    bent, straight = corner_places(LENS)
    place = bent - [325, 236]
    square = ((place / (600 * unit)) ** 2).sum(axis=1)
    factor = 1 + fit.coefficients[0] * square + fit.coefficients[1] * square**2
    away = np.linalg.norm(place * factor[:, None] + [325, 236] - straight, axis=1).max()
    assert 0.001 < fit.deviation_px < 0.2
    assert away <= fit.deviation_px + 1e-9
    assert away > 0.4 * fit.deviation_px


def test_division_about_the_middle() -> None:
    bent, straight = corner_places(LENS)
    fit = dividing(LENS, 2)
    place = bent - [320, 240]
    square = ((place / 320) ** 2).sum(axis=1)
    factor = 1 + fit.coefficients[0] * square + fit.coefficients[1] * square**2
    away = np.linalg.norm(place / factor[:, None] + [320, 240] - straight, axis=1).max()
    assert 0.2 < fit.deviation_px < 2.0  # the principal point is off the middle
    assert away == pytest.approx(fit.deviation_px, rel=0.4)
    centered = pycolmap.Camera(model="SIMPLE_RADIAL", params=[600, 320, 240, -0.12], **SIZE)
    assert dividing(centered, 2).deviation_px < 0.15


def test_a_lens_that_cannot_be_inverted_is_refused() -> None:
    folded = pycolmap.Camera(model="SIMPLE_RADIAL", params=[300, 320, 240, -0.9], **SIZE)
    with pytest.raises(InputError, match="SIMPLE_RADIAL cannot be inverted in"):
        distorting(folded, 3, 1.0)


@pytest.mark.parametrize("camera", [LENS, STRONG])
def test_openlensio_distorts_as_the_camera(camera: pycolmap.Camera) -> None:
    found, deviation = distortion_of(camera, 30.0)
    assert found is not None
    factor = openlensio_places(RAYS, found["radial"]) - openlensio_places(np.array([[0, 0, 1.0]]), [])
    expected = (camera.img_from_cam(RAYS) - camera.img_from_cam(np.array([[0, 0, 1.0]]))) / camera.params[0]
    np.testing.assert_allclose(factor / [600, 640], expected, atol=deviation / camera.params[0] + 1e-12)
    assert distortion_of(pycolmap.Camera(model="PINHOLE", params=[600, 600, 320, 240], **SIZE), 30.0) == (None, 0.0)
