"""Letterbox and pillarbox: what of an image is picture."""

import cv2
import numpy as np
import pytest

from factorsfm.frames.bars import BarDetector
from factorsfm.support.picture_area import PictureArea
from tests.rendered import rendered
from tests.video_files import moving_texture

WIDTH, HEIGHT = 320, 240


def with_bars(image: np.ndarray, left: int, right: int, top: int, bottom: int) -> np.ndarray:
    """The image under black bars, as strong JPEG leaves it."""
    image = image.copy()
    height, width = image.shape[:2]
    image[:top] = image[height - bottom :] = 0
    image[:, :left] = image[:, width - right :] = 0
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 40])[1], cv2.IMREAD_COLOR)


def found(images: list[np.ndarray]) -> list[PictureArea | None]:
    detector = BarDetector()
    return [detector.push(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)) for image in images]


@pytest.mark.parametrize("bars", [(0, 0, 30, 30), (60, 60, 0, 0), (40, 40, 24, 24), (0, 0, 40, 16)])
@pytest.mark.parametrize("level", [0, 16])
def test_bars_are_found_in_the_first_frame(bars, level):
    images = [np.maximum(with_bars(image, *bars), level) for image in moving_texture(12)]
    left, right, top, bottom = bars
    for area in found(images):
        expected = (left, top, WIDTH - right, HEIGHT - bottom)
        assert np.abs(np.array([area.left, area.top, area.right, area.bottom]) - expected).max() <= 4


def test_subtitles_lie_in_a_bar():
    images = [with_bars(image, 0, 0, 30, 30) for image in moving_texture(12)]
    for image in images[5:]:
        cv2.putText(image, "We should go.", (90, HEIGHT - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (230, 230, 230), 2)
    areas = found(images)
    assert abs(areas[-1].bottom - (HEIGHT - 30)) <= 4
    assert abs(areas[-1].top - 30) <= 4


@pytest.mark.parametrize("later", ["whole", "narrower"])
def test_bars_that_another_frame_does_not_have_are_none(later):
    images = [with_bars(image, 0, 0, 40, 40) for image in moving_texture(12)]
    images[6:] = [with_bars(image, 0, 0, *(0, 0) if later == "whole" else (20, 20)) for image in moving_texture(6)]
    assert found(images)[5] is not None
    assert found(images)[-1] is None


@pytest.mark.parametrize("exposure", [1.0, 0.3, 0.1, 0.03])
def test_a_dark_picture_is_whole(exposure):
    shot = rendered("dolly").images
    assert set(found([np.round(image * exposure).astype(np.uint8) for image in shot])) == {None}


def test_dark_at_one_side_is_picture():
    images = moving_texture(8)
    for image in images:
        image[:60] = 2  # a sky at night, over a straight horizon
    assert set(found(images)) == {None}


def test_blank_frames_say_nothing():
    images = [with_bars(image, 0, 0, 30, 30) for image in moving_texture(8)]
    images[3:5] = [np.zeros_like(images[0])] * 2
    assert None not in found(images)
    assert found(images[3:])[:2] == [None, None]


def test_nothing_beside_the_bars_is_tracked():
    area = PictureArea(0, 30, WIDTH, 200)
    mask = area.outside((HEIGHT, WIDTH), 11)
    assert np.flatnonzero(~mask.all(axis=1))[[0, -1]].tolist() == [41, 188]
    assert area.said(WIDTH, HEIGHT) == "30 pixels above and 40 pixels below"
