"""Photographs in the format of the camera with which they were solved."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm.export.footage import frames_of
from factorsfm.export.options import ExportOptions
from factorsfm.export.shot import Defaults, make_shot
from factorsfm.frames.photographs import in_format_of, turned_left
from factorsfm.support.errors import InputError
from tests.export_problems import hard_reconstruction

CAMERA = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 500.0, 640, 480)


def picture(width, height):
    """Brighter to the right, and more to the bottom, as shares of the sides."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return np.repeat(np.rint(60 * x + 180 * y).astype(np.uint8)[..., None], 3, axis=2)


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (1280, 960), (641, 480)])
def test_a_picture_of_another_size_is_scaled(size):
    found = in_format_of(CAMERA, picture(*size))
    assert found.shape == (480, 640, 3)
    assert np.abs(found.astype(int) - picture(640, 480)).max() <= 2


def test_an_upright_picture_is_turned_left():
    upright = picture(480, 640)
    found = in_format_of(CAMERA, upright)
    np.testing.assert_array_equal(found, turned_left(upright))
    assert found[0, 0, 0] == upright[0, -1, 0]  # its top right corner is the top left one now


def test_another_aspect_ratio_stays():
    assert in_format_of(CAMERA, picture(640, 400)).shape == (400, 640, 3)


@pytest.mark.parametrize("unordered", [True, False])
def test_the_pictures_of_a_set_are_read_as_they_were_solved(tmp_path, unordered):
    result = hard_reconstruction(options={"unordered": unordered})
    camera = result.camera
    sizes = [(camera.width, camera.height), (camera.width // 2, camera.height // 2), (camera.height, camera.width)]
    frames = [replace(result.registered[k], index=k, name=f"{k}.png", timestamp=None) for k in range(3)]
    for frame, size in zip(frames, sizes, strict=True):
        cv2.imwrite(str(tmp_path / frame.name), picture(*size))
    shot = make_shot(replace(result, frames=frames), ExportOptions(footage=tmp_path), Defaults())
    if unordered:
        found = [image.image.shape[1::-1] for image in frames_of(shot, frames)]
        assert found == [sizes[0]] * 3
    else:
        with pytest.raises(InputError, match="pixels"):
            list(frames_of(shot, frames))
