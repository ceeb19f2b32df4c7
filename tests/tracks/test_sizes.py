"""Images that are larger than the one in which motion is sought, and what is cut from them."""

import cv2
import numpy as np
import pytest

from factorsfm import TrackerOptions
from factorsfm.tracks.flow import FlowTracker
from factorsfm.tracks.grey import GreyFrame, at_full_size, at_scale
from factorsfm.tracks.tiles import cut_tiles, tile_atlas

OPTIONS = TrackerOptions(max_tracks=300)


def plane(size: tuple[int, int], k: int) -> tuple[np.ndarray, np.ndarray]:
    """View k of a plane whose finest texture is 4 pixels wide at any size (width, height): image and homography."""
    width, height = size
    generator = np.random.default_rng(5)
    side = round(1.2 * width)
    cells = [side // n for n in (4, 16, 64)]
    texture = sum(
        cv2.resize(
            generator.uniform(0, 255 / 3, (n, n)).astype(np.float32), (side, side), interpolation=cv2.INTER_CUBIC
        )
        for n in cells
    )
    a = np.radians(0.3 * k)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) * 1.004**k
    matrix = np.eye(3)
    matrix[:2, :2] = turn
    matrix[:2, 2] = np.array([width, height]) / 2 - turn @ np.full(2, side / 2) + 0.006 * width * np.array([k, 0.4 * k])
    noise = np.random.default_rng(k).normal(0, 2, (height, width))
    view = cv2.warpPerspective(texture, matrix, size) + noise
    return np.clip(np.rint(view), 0, 255).astype(np.uint8), matrix


@pytest.mark.parametrize("size", [(960, 540), (1600, 900), pytest.param((3840, 2160), marks=pytest.mark.slow)])
def test_errors_in_pixels_are_the_same_at_all_sizes(size: tuple[int, int]) -> None:
    views, homographies = zip(*(plane(size, k) for k in range(5)), strict=True)
    with FlowTracker(OPTIONS) as tracker:
        tracked = [tracker.track(view) for view in views]
    _, first, last = np.intersect1d(tracked[0].ids, tracked[-1].ids, return_indices=True)
    transfer = homographies[-1] @ np.linalg.inv(homographies[0])
    truth = cv2.perspectiveTransform(tracked[0].xy[first][:, None], transfer)[:, 0]
    error = np.linalg.norm(tracked[-1].xy[last] - truth, axis=1)
    assert len(first) > 0.85 * len(tracked[0].ids)
    assert 0.01 < np.median(error) < 0.04
    assert np.percentile(error, 90) < 0.08


def test_a_place_is_the_same_in_the_reduced_image() -> None:
    image = np.zeros((1400, 2600), np.uint8)
    x, y = np.meshgrid(np.arange(2600), np.arange(1400))
    image[:] = np.rint(250 * np.exp(-((x - 1234.0) ** 2 + (y - 567.0) ** 2) / (2 * 20.0**2)))
    frame = GreyFrame.of(image)
    assert frame.scale == 4
    assert frame.reduced.shape == (350, 650)
    assert frame.half.shape == (175, 325)
    moments = cv2.moments(frame.reduced)
    center = np.array([[moments["m10"], moments["m01"]]]) / moments["m00"]
    np.testing.assert_allclose(at_full_size(center, 4), [[1234.0, 567.0]], atol=0.05)
    np.testing.assert_allclose(at_scale(at_full_size(center, 4), 4), center)


def test_a_small_image_is_not_reduced() -> None:
    image = np.zeros((540, 960), np.uint8)
    frame = GreyFrame.of(image)
    assert frame.scale == 1
    assert frame.reduced is image


@pytest.mark.parametrize("shape", [(540, 960), (40, 33), (32, 400)])
@pytest.mark.parametrize("half", [15, 22])
def test_tiles_are_reflected_at_borders(shape: tuple[int, int], half: int) -> None:
    generator = np.random.default_rng(0)
    grey = generator.integers(0, 255, shape, dtype=np.uint8)
    xy = generator.uniform(-3, max(shape), (300, 2)).astype(np.float32)
    padded = cv2.copyMakeBorder(grey, half, half, half, half, cv2.BORDER_REFLECT_101)
    x, y = np.clip(np.rint(xy), 0, np.array(shape[::-1]) - 1).astype(int).T
    expected = np.stack([padded[b : b + 2 * half + 1, a : a + 2 * half + 1] for a, b in zip(x, y, strict=True)])
    np.testing.assert_array_equal(cut_tiles(grey, xy, half), expected)


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_tiles_lie_in_the_middle_of_their_cells(count: int) -> None:
    tiles = np.random.default_rng(0).integers(1, 255, (count, 5, 5), dtype=np.uint8)
    atlas, centers = tile_atlas(tiles, 9)
    for tile, (x, y) in zip(tiles, centers.astype(int), strict=True):
        np.testing.assert_array_equal(atlas[y - 2 : y + 3, x - 2 : x + 3], tile)
        assert atlas[y - 4 : y + 5, x - 4 : x + 5].astype(int).sum() == tile.astype(int).sum()
