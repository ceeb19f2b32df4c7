import json
import math

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm.camera.files import camera_to_json, check_camera, fitted_camera, open_camera, read_camera
from factorsfm.camera.guess import guess_camera
from factorsfm.camera.projection import normalized_from_pixels, pixels_from_normalized
from factorsfm.support.errors import InputError
from tests.image_files import jpeg_with_focal_length

PLAIN = {"width": 640, "height": 480, "fx": 500.0, "fy": 510.0, "cx": 319.5, "cy": 239.5}
LENSES = {
    "PINHOLE": [500.0, 510.0, 319.0, 241.0],
    "SIMPLE_RADIAL": [500.0, 319.0, 241.0, -0.1],
    "OPENCV": [500.0, 510.0, 319.0, 241.0, -0.1, 0.02, 0.001, -0.002],
}


def write(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(("width", "height", "aspect"), [(320, 360, 2.0), (640, 180, 0.5), (720, 576, 16 / 15)])
def test_a_guess_for_pixels_that_are_not_square(width, height, aspect):
    camera = guess_camera(width, height, pixel_aspect=aspect)
    assert camera.model_name == "PINHOLE"
    assert camera.focal_length_y / camera.focal_length_x == pytest.approx(aspect)
    longer = max(width / camera.focal_length_x, height / camera.focal_length_y)
    assert 2 * np.degrees(np.arctan(longer / 2)) == pytest.approx(50)


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [600, 321, 179]),
        ("PINHOLE", [600, 601, 321, 179]),
        ("SIMPLE_RADIAL", [600, 321, 179, -0.1]),
        ("RADIAL", [600, 321, 179, -0.1, 0.02]),
        ("OPENCV", [600, 602, 321, 179, -0.1, 0.02, 0.001, 0.002]),
        ("SIMPLE_RADIAL_FISHEYE", [600, 321, 179, -0.1]),
        ("RADIAL_FISHEYE", [600, 321, 179, -0.1, 0.02]),
    ],
)
@pytest.mark.parametrize(("width", "height", "aspect"), [(320, 360, 2.0), (640, 180, 0.5)])
def test_a_camera_for_square_pixels_is_scaled_to_squeezed_images_and_fields(model, params, width, height, aspect):
    camera = pycolmap.Camera(model=model, width=640, height=360, params=params)
    fitted = fitted_camera(camera, width, height, aspect)
    assert (fitted.width, fitted.height) == (width, height)
    rays = np.array([[0.3, -0.2, 1.0], [0.0, 0.1, 1.0], [-0.4, 0.25, 1.0]])
    scale = np.array([width / 640, height / 360])
    assert fitted.img_from_cam(rays) == pytest.approx(camera.img_from_cam(rays) * scale, abs=1e-9)
    assert fitted_camera(camera, 640, 360, 1.0) == camera


@pytest.mark.parametrize(("width", "height", "aspect"), [(320, 180, 1.0), (320, 360, 1.0), (320, 360, 1.5)])
def test_a_camera_for_another_picture_is_refused(width, height, aspect):
    with pytest.raises(InputError, match=f"made for 640x360 pixels, but the images have {width}x{height}"):
        fitted_camera(guess_camera(640, 360), width, height, aspect)


def test_plain_file_gives_a_pinhole_with_shifted_centre(tmp_path):
    camera = read_camera(write(tmp_path / "camera.json", {**PLAIN, "fps": 24}))
    assert camera.model_name == "PINHOLE"
    assert (camera.width, camera.height) == (640, 480)
    assert camera.params.tolist() == [500.0, 510.0, 320.0, 240.0]
    assert camera.has_prior_focal_length


def test_model_and_params_win_and_their_centre_is_shifted(tmp_path):
    content = {**PLAIN, "model": "OPENCV", "params": LENSES["OPENCV"]}
    camera = read_camera(write(tmp_path / "camera.json", content))
    assert camera.model_name == "OPENCV"
    assert camera.params.tolist() == [500.0, 510.0, 319.5, 241.5, -0.1, 0.02, 0.001, -0.002]


@pytest.mark.parametrize("model", LENSES)
def test_file_round_trip(tmp_path, model):
    content = {"width": 640, "height": 480, "model": model, "params": LENSES[model]}
    camera = read_camera(write(tmp_path / "first.json", content))
    written = camera_to_json(camera)
    assert written["params"] == LENSES[model]
    assert (written["cx"], written["cy"]) == (319.0, 241.0)
    again = read_camera(write(tmp_path / "second.json", written))
    assert again == camera


@pytest.mark.parametrize("model", LENSES)
def test_pixels_agree_with_opencv_and_return(tmp_path, model):
    content = {"width": 640, "height": 480, "model": model, "params": LENSES[model]}
    camera = read_camera(write(tmp_path / "camera.json", content))
    xy = np.random.default_rng(0).uniform([-0.5, -0.5], [639.5, 479.5], (200, 2))
    uv = normalized_from_pixels(camera, xy)
    np.testing.assert_allclose(pixels_from_normalized(camera, uv), xy, rtol=0, atol=2e-8)

    fx, fy, cx, cy = (camera_to_json(camera)[key] for key in ("fx", "fy", "cx", "cy"))
    distortion = {
        "PINHOLE": [0, 0, 0, 0],
        "SIMPLE_RADIAL": [-0.1, 0, 0, 0],
        "OPENCV": [-0.1, 0.02, 0.001, -0.002],
    }
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    rays = np.column_stack([uv, np.ones(len(uv))])
    projected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(distortion[model], float))
    np.testing.assert_allclose(projected[:, 0], xy, rtol=0, atol=2e-8)


def test_no_points_stay_no_points():
    camera = guess_camera(640, 480)
    assert normalized_from_pixels(camera, np.empty((0, 2))).shape == (0, 2)
    assert pixels_from_normalized(camera, np.empty((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("{broken", "not JSON"),
        ([1, 2], "JSON object"),
        ({key: PLAIN[key] for key in PLAIN if key != "cx"}, '"cx" is missing'),
        ({**PLAIN, "fx": -500}, "not positive"),
        ({**PLAIN, "fy": 0}, "not positive"),
        ({**PLAIN, "fy": 1e-3}, r"focal length is 0.001 pixels, of images of \d+x\d+; \d+ to \d+ is expected"),
        ({**PLAIN, "fx": 1e9}, "focal length is 1e\\+09 pixels"),
        ({**PLAIN, "fx": float("nan")}, '"fx" is nan; a finite number'),
        ({**PLAIN, "cy": float("inf")}, '"cy" is inf'),
        ({**PLAIN, "cy": "12"}, "\"cy\" is '12'"),
        ({**PLAIN, "width": 0}, '"width" is 0'),
        ({**PLAIN, "height": -480}, '"height" is -480'),
        ({**PLAIN, "width": 640.5}, '"width" is 640.5'),
        ({**PLAIN, "width": True}, '"width" is True'),
        ({**PLAIN, "model": "OPENCV"}, "go together"),
        ({**PLAIN, "model": "NIKON", "params": [1, 2, 3]}, "'NIKON'"),
        ({**PLAIN, "model": ["PINHOLE"], "params": [1, 2, 3]}, "COLMAP camera model"),
        ({**PLAIN, "model": "EQUIRECTANGULAR", "params": [640, 480]}, "focal length"),
        ({**PLAIN, "model": "PINHOLE", "params": [1, 2, 3]}, "has 3 numbers; PINHOLE takes fx, fy, cx, cy"),
        ({**PLAIN, "model": "PINHOLE", "params": [1, 2, 3, None]}, r"params\[3\]"),
        ({**PLAIN, "model": "PINHOLE", "params": "1 2 3 4"}, "list of numbers"),
    ],
)
def test_bad_file_is_refused_in_one_sentence(tmp_path, content, reason):
    path = write(tmp_path / "camera.json", content)
    with pytest.raises(InputError, match=reason) as caught:
        read_camera(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_byte_order_mark_is_no_part_of_the_file(tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(PLAIN), encoding="utf-8-sig")
    assert read_camera(tmp_path / "camera.json").width == PLAIN["width"]


def test_a_camera_is_itself_or_its_file(tmp_path):
    camera = open_camera(write(tmp_path / "camera.json", PLAIN))
    assert camera.width == 640
    assert open_camera(camera) is camera
    assert open_camera(None) is None


def test_missing_file_and_folder_are_refused(tmp_path):
    for path in (tmp_path / "absent.json", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_camera(path)


def test_contradicting_size_is_named():
    camera = guess_camera(640, 480)
    check_camera(camera, 640, 480)
    with pytest.raises(InputError, match=r"640x480 .* 480x640"):
        check_camera(camera, 480, 640)


@pytest.mark.parametrize(("width", "height"), [(1920, 1080), (1080, 1920)])
def test_guess_without_exif_spans_50_degrees(width, height):
    camera = guess_camera(width, height)
    assert camera.model_name == "SIMPLE_PINHOLE"
    assert not camera.has_prior_focal_length
    assert camera.params[1:].tolist() == [width / 2, height / 2]
    assert math.degrees(2 * math.atan(960 / camera.params[0])) == pytest.approx(50, abs=1e-9)


@pytest.mark.parametrize("size", [(480, 270), (270, 480), (960, 540)])
def test_guess_from_exif(tmp_path, size):
    camera = guess_camera(*size, jpeg_with_focal_length(tmp_path / "a.jpg", 35))
    assert camera.has_prior_focal_length
    expected = 35 / math.hypot(36, 24) * math.hypot(480, 270) * max(size) / 480
    assert camera.params[0] == pytest.approx(expected, rel=1e-3)
    assert (camera.width, camera.height) == size


def test_exif_of_no_use_gives_the_guess(tmp_path, caplog):
    absurd = jpeg_with_focal_length(tmp_path / "absurd.jpg", 60000)
    text = write(tmp_path / "text.jpg", "no image")
    for path in (absurd, text, tmp_path / "absent.jpg"):
        camera = guess_camera(480, 270, path)
        assert not camera.has_prior_focal_length
        assert camera == guess_camera(480, 270)
    assert "ignoring the EXIF focal length" in caplog.text


def test_cameras_of_the_development_sets_read(shared_data):
    paths = sorted(shared_data.glob("*/*/camera.json"))
    assert paths
    for path in paths:
        camera = read_camera(path)
        assert isinstance(camera, pycolmap.Camera)
        assert 0 < camera.principal_point_x < camera.width
