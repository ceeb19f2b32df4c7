"""Cameras and the unknowns of their lenses."""

import numpy as np
import pycolmap
import pytest

from factorsfm.adjustment.residuals import distort
from factorsfm.camera.projection import normalized_from_pixels
from factorsfm.lens.camera_model import distortion_of, with_distortion
from factorsfm.support.errors import InputError


def camera(model: str, params: list[float]) -> pycolmap.Camera:
    return pycolmap.Camera(camera_id=1, model=model, width=640, height=480, params=params)


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        ("SIMPLE_PINHOLE", [500, 320, 240], (0.0, 0.0)),
        ("PINHOLE", [500, 510, 320, 240], (0.0, 0.0)),
        ("SIMPLE_RADIAL", [500, 320, 240, -0.1], (-0.1, 0.0)),
        ("RADIAL", [500, 320, 240, -0.1, 0.02], (-0.1, 0.02)),
        ("OPENCV", [500, 510, 320, 240, -0.1, 0.02, 0.0, 0.0], (-0.1, 0.02)),
    ],
)
def test_radial_distortion_is_the_start(model, params, expected):
    assert distortion_of(camera(model, params)).tolist() == [*expected, 0.0, 0.0]


@pytest.mark.parametrize(
    ("model", "params", "reason"),
    [
        ("OPENCV", [500, 510, 320, 240, -0.1, 0.02, 1e-3, 0.0], "OPENCV with p1 cannot be estimated"),
        ("FULL_OPENCV", [500, 510, 320, 240, *[0.0] * 8], "FULL_OPENCV cannot be estimated; one of SIMPLE_PINHOLE"),
    ],
)
def test_more_than_radial_distortion_is_refused(model, params, reason):
    with pytest.raises(InputError, match=reason):
        distortion_of(camera(model, params))


@pytest.mark.parametrize(("aspect", "model"), [(1.0, "RADIAL"), (1.02, "OPENCV")])
def test_a_camera_with_distortion_projects_as_the_residual_does(aspect, model):
    before = camera("PINHOLE", [500.0, 500.0 * aspect, 320.0, 240.0])
    lens = np.array([-0.1, 0.02, 0.01, -0.02])
    after = with_distortion(before, 520.0, lens)
    assert after.model_name == model
    assert after.mean_focal_length() == pytest.approx(520.0, rel=1e-12)
    uv = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    pixels = distort(uv, lens)[0] * [after.focal_length_x, after.focal_length_y] + [319.5, 239.5]
    np.testing.assert_allclose(normalized_from_pixels(after, pixels), uv, rtol=0, atol=1e-9)
