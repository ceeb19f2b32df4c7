"""Streams of footage as it comes: repeated frames, uneven times, pixels that are not square, fields."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

import factorsfm
from factorsfm import Frame, Options, Stream
from tests.rendered import FRAMES, errors_of, rendered, with_fewer_tracks

QUICK = with_fewer_tracks(Options())


def solved(frames, camera=None, **options) -> tuple[list[factorsfm.FrameUpdate], factorsfm.Reconstruction]:
    with Stream(camera or rendered("dolly").camera, options=replace(QUICK, **options)) as stream:
        return [stream.push(frame) for frame in frames], stream.finish()


def frames_at(times, images=None) -> list[Frame]:
    images = images or rendered("dolly").images
    pairs = zip(images, times, strict=True)
    return [Frame(k, image, f"{k:06d}", time) for k, (image, time) in enumerate(pairs)]


def grainy() -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    return [
        np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image in rendered("dolly").images
    ]


SHOWN = [0, 1, *(k for k in range(2, FRAMES) for _ in range(2))]  # animation on twos: 12 in 24


@pytest.fixture(scope="module")
def with_repeats():
    images = grainy()
    return solved(frames_at(np.arange(len(SHOWN)) / 24, [images[k] for k in SHOWN]))


def test_repeated_frames_are_no_evidence_and_have_the_pose_of_their_twins(with_repeats):
    updates, result = with_repeats
    _, once = solved(frames_at(np.arange(FRAMES) / 12, grainy()))
    assert [frame.index for frame in result.frames] == list(range(len(SHOWN)))
    repeats = [k for k in range(1, len(SHOWN)) if SHOWN[k] == SHOWN[k - 1]]
    assert [frame.index for frame in result.frames if frame.repeats is not None] == repeats
    for frame, k in zip(result.frames, SHOWN, strict=True):
        np.testing.assert_array_equal(frame.cam_from_world.matrix(), once.frames[k].cam_from_world.matrix())
    new = [frame.index for frame in result.frames if frame.repeats is None]
    assert [new.index(i) for i in np.array(range(len(SHOWN)))[result.observation_frame]] == list(once.observation_frame)
    for k in repeats:
        assert updates[k].repeats == result.frames[k].repeats == k - 1
        assert updates[k].message.startswith(f"repeats frame {k - 1}: ")
        assert updates[k].cam_from_world == updates[k - 1].cam_from_world
        assert not result.frames[k].keyframe


def test_the_cadence_is_named(with_repeats):
    _, result = with_repeats
    said = "Every second frame repeats the one before: 12 in 24 frames a second."
    assert sum(note.startswith(said) for note in result.notes) == 1
    assert not any("uneven" in note for note in result.notes)


def test_a_result_with_repeats_is_written_read_and_made_a_graph(with_repeats, tmp_path):
    _, result = with_repeats
    result.write(tmp_path / "out")
    read = factorsfm.read_result(tmp_path / "out")
    assert [frame.repeats for frame in read.frames] == [frame.repeats for frame in result.frames]
    assert len((tmp_path / "out" / "trajectory.tum").read_text().splitlines()) == len(SHOWN)
    graph, values = factorsfm.factor_graph(result)
    new = [frame.index for frame in result.frames if frame.repeats is None]
    assert [key for key in (ord("x") << 56 | i for i in range(len(SHOWN))) if values.exists(key)] == [
        ord("x") << 56 | i for i in new
    ]
    assert graph.size() > 100
    _, poses = factorsfm.pose_factors(result)
    assert poses.size() == len(new)


def test_a_snapshot_keeps_the_repeats(tmp_path):
    images = grainy()
    frames = frames_at(np.arange(len(SHOWN)) / 24, [images[k] for k in SHOWN])
    with Stream(rendered("dolly").camera, options=QUICK) as stream:
        for frame in frames[:8]:
            stream.push(frame)
        stream.save(tmp_path / "snapshot")
    with Stream.load(tmp_path / "snapshot") as stream:
        for frame in frames[8:]:
            stream.push(frame)
        assert len(stream.trajectory()) == len(frames)
        result = stream.finish()
    assert [frame.index for frame in result.frames] == list(range(len(SHOWN)))
    assert result.frames[7].repeats == 6


def test_uneven_times_are_noted():
    times = np.arange(FRAMES) / 24
    times[FRAMES // 2 :] += 1 / 24 * np.arange(FRAMES - FRAMES // 2)
    _, result = solved(frames_at(times))
    (note,) = [note for note in result.notes if "uneven" in note]
    assert note.startswith("Frames come at uneven times, 42 to 83 ms after one another")
    assert [frame.timestamp for frame in result.frames] == times.tolist()


def test_times_that_jump_back_are_noted():
    times = np.arange(FRAMES) / 24
    times[FRAMES // 2 :] -= times[FRAMES // 2]
    _, result = solved(frames_at(times))
    (note,) = [note for note in result.notes if "do not rise" in note]
    assert note.startswith(f"Times of frames do not rise, before frame {FRAMES // 2}: all frames count as recorded")


@pytest.fixture(scope="module")
def in_bars() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The shot under bars of unlike height, and the part of it that is left."""
    pictures = [image[36:150] for image in rendered("dolly").images]
    return [cv2.copyMakeBorder(picture, 36, 30, 0, 0, cv2.BORDER_CONSTANT) for picture in pictures], pictures


def test_bars_cost_nothing(in_bars):
    shot, (barred, pictures) = rendered("dolly"), in_bars
    cut = pycolmap.Camera(shot.camera.todict())
    cut.height = len(pictures[0])
    cut.params = [*shot.camera.params[:-1], shot.camera.params[-1] - 36]
    _, expected = solved(pictures, cut)
    _, result = solved(barred)
    y = result.observation_xy[:, 1]
    assert y.min() > 36 + 4
    assert y.max() < 149 - 4
    error, without = (np.sqrt(np.mean(errors_of(r, shot).ate ** 2)) for r in (result, expected))
    assert error < 2 * without
    assert (
        "Black bars, 36 pixels above and 30 pixels below, are no part of the picture: nothing is tracked in them."
        in (result.notes)
    )


def test_an_unknown_lens_is_that_of_the_picture(in_bars, tmp_path):
    with Stream(options=QUICK) as stream:
        for image in in_bars[0][:3]:
            stream.push(image)
        assert stream.camera.principal_point_y == pytest.approx(36 + 57, abs=2)
        stream.save(tmp_path / "s")
    with Stream.load(tmp_path / "s") as stream:
        for image in in_bars[0][3:]:
            stream.push(image)
        assert stream.finish().notes[-1].startswith("Black bars, 36 pixels above")


def squeezed(image: np.ndarray, factor: tuple[int, int]) -> np.ndarray:
    height, width = image.shape[:2]
    return cv2.resize(image, (width // factor[0], height // factor[1]), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(("factor", "aspect", "field"), [((2, 1), 2.0, False), ((1, 2), 0.5, True)])
def test_pixels_that_are_not_square_are_solved_as_exactly(factor, aspect, field):
    shot = rendered("dolly")
    frames = [
        Frame(k, squeezed(image, factor), f"{k:06d}", k / 24, pixel_aspect=aspect, is_field=field)
        for k, image in enumerate(shot.images)
    ]
    _, square = solved(frames_at(np.arange(FRAMES) / 24))
    _, result = solved(frames)  # with the camera of the images before they were squeezed
    assert isinstance(result.camera, pycolmap.Camera)
    assert result.camera.focal_length_y / result.camera.focal_length_x == pytest.approx(aspect)
    assert np.sqrt(np.mean(errors_of(result, shot).ate ** 2)) < 4 * np.sqrt(np.mean(errors_of(square, shot).ate ** 2))
    assert any(note.startswith(f"Pixels are {aspect:g} times as wide as high") for note in result.notes)
    assert any(note.startswith("Interlaced video") for note in result.notes) == field
