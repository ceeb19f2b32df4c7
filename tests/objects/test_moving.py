"""What moves by itself, told from exact tracks with noise, and the masks of it."""

from functools import cache

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.objects.moving import MovingThings, moving_things
from factorsfm.support.options import Options
from factorsfm.synthetic import room_camera
from factorsfm.tracks.image_tracks import ImageTracks

FRAMES, SCENE, LARGE, SMALL, SLIDING = 24, 300, 60, 40, 10
CAMERA = room_camera(480, 270)


def on_a_sphere(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """(count, 3) on the half that is seen."""
    rays = rng.standard_normal((count, 3))
    rays[:, 2] = -np.abs(rays[:, 2])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@cache
def found(*, translates: bool = True, with_things: bool = True) -> MovingThings:
    """A scene, two things that go to either side, one before the other for a while, and tracks that slide.

    Args:
        translates: whether the camera does.
    """
    rng = np.random.default_rng(0)
    scene = rng.uniform([-3, -1.6, 4.0], [3, 1.6, 7.0], (SCENE, 3))
    large, small = on_a_sphere(LARGE, rng), on_a_sphere(SMALL, rng)
    large, small = 0.35 * large + [-0.6, 0.2, 2.4], 0.25 * small + [0.7, -0.3, 2.2]
    slide = rng.uniform(-1, 1, (SLIDING, 2))
    count = SCENE + LARGE + SMALL + SLIDING if with_things else SCENE
    images, poses = [], {}
    for k, time in enumerate(np.linspace(0.0, 1.0, FRAMES)):
        pose = pycolmap.Rigid3d(
            pycolmap.Rotation3d(), np.array([-0.3 * time, 0.02 * np.sin(9 * time), 0.0]) * translates
        )
        around = np.array([0.0, 0.4 * time, 0.0])
        turned = (large - large.mean(0)) @ pycolmap.Rotation3d(around).matrix().T + large.mean(0)
        points = [scene, turned + [0.5 * time, 0, 0], small - [0.6 * time, 0, 0], scene[:SLIDING]]
        pixels = CAMERA.img_from_cam(pose * np.concatenate(points)) - 0.5
        pixels += 0.05 * rng.standard_normal(pixels.shape)
        pixels[-SLIDING:] += 12.0 * time * slide  # each along its own edge
        images.append(ImageTracks(k, np.arange(count), pixels[:count], CAMERA, index=2 * k))
        poses[k] = pose
    return moving_things(images, poses, np.arange(SCENE - 20), Options())


def places(things: MovingThings, name: str, frame: int) -> NDArray[np.float64]:
    return things.places[name][frame]


def test_two_things_are_told_from_the_scene_and_from_each_other() -> None:
    for translates in (True, False):
        things = found(translates=translates)
        assert list(things.places) == ["object-1", "object-2"]
        sizes = [{len(seen) for seen in things.places[name].values()} for name in things.places]
        assert [len(size) for size in sizes] == [1, 1]
        assert LARGE - 8 <= max(sizes[0]) <= LARGE
        assert SMALL - 8 <= max(sizes[1]) <= SMALL
        assert list(things.places["object-1"]) == list(range(0, 2 * FRAMES, 2))
        assert 0 < things.loose <= SLIDING + 16


def test_what_is_said_of_a_thing() -> None:
    things = found()
    x, y = places(things, "object-2", FRAMES).T
    (_, said) = things.described()
    assert said.startswith(f"object-2 (frames 0 to {2 * (FRAMES - 1)}; in frame {FRAMES} x from ")
    assert abs(int(said.split("x from ")[1].split(" ")[0]) - x.min()) < 5
    assert abs(int(said.split("and y from ")[1].split(" to ")[1].split(" ")[0]) - y.max()) < 5


def test_masks_hold_the_windows_of_the_tracks_and_what_lies_between() -> None:
    things = found()
    frame = Frame(FRAMES, np.zeros((270, 480, 3), np.uint8), "frame")
    masks = things(frame)
    assert set(masks) == {"object-1", "object-2"}
    for name, mask in masks.items():
        xy = places(things, name, FRAMES)
        to_mask = mask.shape[1] / 480
        low, high = xy.min(0), xy.max(0)
        y, x = np.nonzero(mask)
        np.testing.assert_allclose([x.min(), y.min()], (low - 10) * to_mask, atol=3)
        np.testing.assert_allclose([x.max(), y.max()], (high + 10) * to_mask, atol=3)
        x, y = (xy * to_mask).astype(int).T
        assert mask[y, x].all()
        # An ellipse fills 0.79 of its box; gaps between tracks that lie far apart are holes.
        assert 0.5 < mask.sum() / np.prod((high - low + 20) * to_mask) < 0.85
    assert things(Frame(FRAMES + 1, frame.image, "another")) == {}


def test_a_scene_in_which_nothing_moves_has_no_things() -> None:
    assert found(with_things=False) == MovingThings({}, 0, Options().tracker.window_px)
    assert moving_things([], {}, np.zeros(0, np.int64), Options()).places == {}
