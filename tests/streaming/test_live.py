"""`factorsfm.track`: every frame of a source gives an update; and what the stream makes of views that go and return."""

from collections.abc import Iterator

import numpy as np
import pytest

import factorsfm
from factorsfm import Frame, FrameStatus, FrameUpdate, InputError, Options, RawFormat, ReconstructionError, Stream
from factorsfm.camera.guess import guess_camera
from factorsfm.synthetic import RenderedShot, render_shot, simulate_prior
from tests.image_files import jpeg_with_focal_length
from tests.rendered import FRAMES, Maps, quick_presets, rendered, simulated_maps, with_fewer_tracks

BLACK = np.zeros((180, 320, 3), np.uint8)


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr("factorsfm.support.options.PRESETS", quick_presets())


def follow(source, **arguments) -> factorsfm.Live:
    arguments.setdefault("depth", Maps(simulated_maps("dolly")))
    return factorsfm.track(source, camera=rendered("dolly").camera, **arguments)


def test_every_frame_gives_an_update_and_the_end_is_that_of_the_one_call():
    shot = rendered("dolly")
    with follow(shot.images) as live:
        updates = list(live)
        result = live.finish()
    assert [update.index for update in updates] == list(range(FRAMES))
    assert all(update.cam_from_world is not None for update in updates)
    assert live.source.ended == f"the sequence of images ended after {FRAMES} frames"
    once = factorsfm.reconstruct(shot.images, camera=shot.camera, depth=Maps(simulated_maps("dolly")))
    np.testing.assert_array_equal(result.points, once.points)
    assert len(live.stream.trajectory()) == FRAMES


def test_a_part_of_the_source():
    with follow(rendered("dolly").images, frames=slice(1, 6, 2), preset="geometry", depth="no such network") as live:
        assert [update.index for update in live] == [1, 3, 5]


def test_the_lens_comes_from_exif_of_the_images(tmp_path):
    for index in (1, 2):
        jpeg_with_focal_length(tmp_path / f"{index}.jpg", 35)
    with factorsfm.track(tmp_path, depth=None, preset="geometry") as live:
        next(live)
        camera = live.stream.camera
    assert camera.has_prior_focal_length
    assert camera.focal_length == guess_camera(480, 270, tmp_path / "1.jpg").focal_length
    assert live.stream.options.lens == "distortion"


def test_a_source_that_breaks_off_leaves_what_came():
    def frames() -> Iterator[np.ndarray]:
        yield from rendered("dolly").images[:6]
        raise RuntimeError("the cable")

    with follow(frames()) as live:
        assert len(list(live)) == 6
        assert live.source.broke_off
        assert "the cable" in live.source.ended
        assert len(live.finish().registered) == 6


def test_ended_early_by_the_consumer():
    with follow(rendered("dolly").images) as live:
        for update in live:
            if update.index == 4:
                break
        result = live.finish()
        assert [frame.index for frame in result.frames] == [0, 1, 2, 3, 4]
        assert list(live) == []


def test_a_consumer_that_is_too_slow_is_told_what_was_dropped():
    def frames() -> Iterator[np.ndarray]:
        yield from rendered("dolly").images

    with follow(frames(), drop=True, depth=None) as live:
        updates = [next(live)]
        live.source._thread.join()  # it has read everything meanwhile
        updates += live
    assert sum(update.dropped for update in updates) == live.source.dropped > 0
    assert updates[-1].index == FRAMES - 1


def test_raw_frames(tmp_path):
    (tmp_path / "raw").write_bytes(b"".join(image.tobytes() for image in rendered("dolly").images[:4]))
    with (tmp_path / "raw").open("rb") as file, follow(file, raw=RawFormat(320, 180)) as live:
        assert [update.status for update in live] == [FrameStatus.REGISTERED] * 4


def test_bad_input_and_too_little():
    with pytest.raises(InputError, match="does not exist"):
        follow("absent.mp4")
    with pytest.raises(InputError, match="unknown preset"):
        follow(rendered("dolly").images, preset="best")
    with follow(rendered("dolly").images[:1]) as live:
        list(live)
        with pytest.raises(ReconstructionError, match="frames in the shot: 1"):
            live.finish()


# --- views that go and return -------------------------------------------------------------------------------------


def streamed(shot: RenderedShot, images: list[np.ndarray], order: list[int]) -> tuple[list[FrameUpdate], Stream]:
    """Images with the depth of the shot's frames in `order`."""
    prior = simulate_prior(shot)
    stream = Stream(shot.camera, depth=Maps([prior[k] for k in order]), options=with_fewer_tracks(Options()))
    return [stream.push(Frame(k, image, str(k))) for k, image in enumerate(images)], stream


def mapped(stream: Stream) -> int:
    stream.trajectory()
    return len(stream.points[0])


def test_back_and_forth_builds_no_second_map():
    shot = render_shot("truck", 20, 320, 180, parallax=0.1)
    there, back = list(range(20)), list(range(18, -1, -1))
    _, once = streamed(shot, [shot.images[k] for k in there + back], there + back)
    order = [*there, *back, *there[1:], *back]
    updates, stream = streamed(shot, [shot.images[k] for k in order], order)
    assert {update.status for update in updates} == {FrameStatus.REGISTERED}
    assert 0.98 * mapped(once) < mapped(stream) < 1.25 * mapped(once)  # what was lost on the way began anew
    start, end = updates[0].cam_from_world.inverse().translation, updates[-1].cam_from_world.inverse().translation
    farthest = max(np.linalg.norm(u.cam_from_world.inverse().translation - start) for u in updates)
    assert np.linalg.norm(end - start) < 0.01 * farthest


AWAY = 14  # frames of another room, which are more than half a second


@pytest.fixture(scope="module")
def interrupted() -> tuple[RenderedShot, list[FrameUpdate], Stream]:
    """Ten frames, some of another room, and back."""
    shot = render_shot("truck", 18, 320, 180, parallax=0.1)
    other = render_shot("truck", AWAY, 320, 180, seed=5)
    order = [*range(10), *[0] * AWAY, *range(14, 18)]  # of the maps
    return shot, *streamed(shot, shot.images[:10] + other.images + shot.images[14:], order)


def test_a_foreign_stretch_is_lost_and_the_view_is_found_again(interrupted):
    _, updates, stream = interrupted
    status = [update.status for update in updates]
    assert status[:10] == [FrameStatus.REGISTERED] * 10
    assert set(status[10:-4]) <= {FrameStatus.LOST, FrameStatus.TOO_FEW_INLIERS, FrameStatus.TOO_FEW_TRACKS}
    assert FrameStatus.LOST in status[10:-4]
    assert all("needed" in update.message for update in updates[10:-4])
    assert status[-4:] == [FrameStatus.REGISTERED] * 4
    assert updates[-4].message.startswith("found again: ")
    result = stream.finish()
    assert [frame.registered for frame in result.frames] == [True] * 10 + [False] * AWAY + [True] * 4
    known = [frame for frame in result.registered if frame.covariance is not None]
    assert len(known) >= 13  # a frame may be left without points, and the others do not suffer
    assert all(np.isfinite(frame.covariance).all() for frame in known)


def test_the_poses_after_the_return_are_right(interrupted):
    shot, updates, _ = interrupted
    centers = np.array([u.cam_from_world.inverse().translation if u.cam_from_world else [np.nan] * 3 for u in updates])
    true = np.array([pose.inverse().translation for pose in shot.cam_from_world])
    scale = np.nansum(centers[5:10] * true[5:10]) / np.sum(true[5:10] ** 2)
    assert np.linalg.norm(centers[-4:] / scale - true[-4:], axis=1).max() < 0.05 * np.linalg.norm(true[-1])


def test_a_black_stretch_is_blank_and_nothing_else_changes():
    shot = rendered("dolly")
    images = shot.images[:4] + [BLACK] * 3 + shot.images[4:]
    updates, stream = streamed(shot, images, [0, 1, 2, 3, 3, 3, 3, 4, 5, 6, 7])
    expected = [FrameStatus.REGISTERED] * 4 + [FrameStatus.BLANK] * 3 + [FrameStatus.REGISTERED] * 4
    assert [update.status for update in updates] == expected
    assert all("contrast 0.00" in update.message for update in updates[4:7])
    result = stream.finish()
    assert [frame.status for frame in result.frames] == expected
    plain, _ = streamed(shot, shot.images, list(range(FRAMES)))
    assert updates[-1].tracks > 0.8 * plain[-1].tracks


def test_noise_has_no_pose():
    shot = rendered("dolly")
    noise = np.random.default_rng(0).integers(0, 256, (12, 180, 320, 3), np.uint8)
    order = [0, 1, 2, 3, *[3] * len(noise), 4, 5, 6, 7]
    updates, stream = streamed(shot, [*shot.images[:4], *noise, *shot.images[4:]], order)
    assert [update.cam_from_world is not None for update in updates] == [True] * 4 + [False] * 12 + [True] * 4
    assert sum(frame.registered for frame in stream.finish().frames) == FRAMES


def test_black_frames_at_the_start_are_waited_out():
    shot = rendered("dolly")
    updates, _ = streamed(shot, [BLACK, BLACK, *shot.images], [0, 0, *range(FRAMES)])
    assert [update.cam_from_world is None for update in updates] == [True, True] + [False] * FRAMES
    assert {update.status for update in updates[2:]} == {FrameStatus.REGISTERED}
