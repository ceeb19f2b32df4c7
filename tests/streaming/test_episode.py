"""A film of several shots: each its own reconstruction."""

import gc
import threading
import weakref

import cv2
import numpy as np
import pytest

from factorsfm import DepthKind, Episode, FrameStatus, ModelError, Options, ShotKind
from factorsfm.streaming.episode import ShotResult
from factorsfm.synthetic import render_shot
from tests.rendered import FRAMES, rendered, with_fewer_tracks

OPTIONS = with_fewer_tracks(Options())


def other() -> list[np.ndarray]:
    return [np.ascontiguousarray(image[::-1, ::-1]) for image in rendered("truck").images]


def film(images: list[np.ndarray]) -> tuple[list[int], list[ShotResult]]:
    """Number of the shot of every frame, and the results."""
    episode = Episode(rendered("dolly").camera, options=OPTIONS)
    updates = [episode.push(image) for image in images]
    assert [update.index for update in updates] == list(range(len(images)))
    return [update.shot for update in updates], episode.finish()


def test_a_hard_cut_gives_two_reconstructions():
    shots, (first, second) = film([*rendered("dolly").images, *other()])
    assert shots == [0] * FRAMES + [1] * FRAMES
    assert (first.first, first.last, second.first, second.last) == (0, FRAMES - 1, FRAMES, 2 * FRAMES - 1)
    for shot in (first, second):
        assert shot.reason == ""
        assert len(shot.reconstruction.registered) == FRAMES
        assert [frame.index for frame in shot.reconstruction.frames] == list(range(shot.first, shot.last + 1))
    assert first.reconstruction.kind is ShotKind.GENERAL


def test_each_result_is_handed_out_as_soon_as_it_is_there_and_not_kept():
    told: list[tuple[int, int]] = []
    kept: list[weakref.ref[np.ndarray]] = []
    there = threading.Event()

    def take(shot: ShotResult) -> None:
        told.append((shot.first, len(shot.reconstruction.registered)))
        kept.append(weakref.ref(shot.reconstruction.points))
        there.set()

    episode = Episode(rendered("dolly").camera, options=OPTIONS, finished=take)
    for image in [*rendered("dolly").images, *other()]:
        episode.push(image)
    assert there.wait(60)
    assert told == [(0, FRAMES)]  # before the end of the film
    assert episode.finish() == []
    assert told == [(0, FRAMES), (FRAMES, FRAMES)]
    gc.collect()
    assert [reference() for reference in kept] == [None, None]


def test_what_a_listener_raises_comes_out_at_the_end():
    def full(shot: ShotResult) -> None:
        raise OSError("disk full")

    episode = Episode(rendered("dolly").camera, options=OPTIONS, finished=full)
    episode.push(rendered("dolly").images[0])
    with pytest.raises(OSError, match="disk full"):
        episode.finish()


def test_a_fade_gives_two_reconstructions():
    dark = np.linspace(1.0, 0.0, 5)
    end, begin = rendered("dolly").images[-1], other()[0]
    fade = [cv2.convertScaleAbs(end, alpha=a) for a in dark] + [cv2.convertScaleAbs(begin, alpha=a) for a in dark[::-1]]
    shots, (first, second) = film([*rendered("dolly").images, *fade, *other()])
    boundary = shots.index(1)
    assert FRAMES + 5 <= boundary <= FRAMES + 8
    assert shots == [0] * boundary + [1] * (len(shots) - boundary)
    assert len(first.reconstruction.registered) >= FRAMES
    assert len(second.reconstruction.registered) >= FRAMES
    assert {FrameStatus.BLANK, FrameStatus.LOST} >= {f.status for f in first.reconstruction.frames if not f.registered}


@pytest.mark.parametrize("foreign", [[0, 1, 2], [0, 30, 1]])
def test_a_short_interruption_splits_nothing(foreign):
    """Three frames of another view, or of two other views."""
    long = render_shot("dolly", 14, 320, 180)
    pictures = {
        0: other()[0],
        1: other()[1],
        2: other()[2],
        30: np.ascontiguousarray(long.images[0].transpose(1, 0, 2)),
    }
    pictures[30] = cv2.resize(pictures[30], (320, 180))
    images = [*long.images[:7], *(pictures[k] for k in foreign), *long.images[10:]]
    shots, (only,) = film(images)
    assert [shots[k] for k in range(14) if not 7 <= k < 10] == [0] * 11
    assert len(only.reconstruction.frames) == 11  # the foreign ones belong to no shot
    assert len(only.reconstruction.registered) == 11


def test_a_shot_that_cannot_be_reconstructed_says_why():
    plain = [np.zeros((180, 320, 3), np.uint8)] * 3
    _, (black,) = film(plain)
    assert black.reconstruction is None
    assert black.reason.startswith("0 of 3 frames registered, at least 2 needed; frame 0: contrast 0.00")
    assert [frame.status for frame in black.frames] == [FrameStatus.BLANK] * 3


def test_errors_of_a_frame_leave_the_film_as_it_was():
    episode = Episode(rendered("dolly").camera, options=OPTIONS)
    with episode:
        episode.push(rendered("dolly").images[0])
        assert len(episode.stream.frames) == 1
        with pytest.raises(Exception, match=r"expected \(180, 320\)"):
            episode.push(rendered("dolly").images[1][:90])
        assert episode.push(rendered("dolly").images[1]).index == 1
        assert len(episode.stream.frames) == 2


def test_no_frame_gives_no_shot():
    assert Episode().finish() == []


def test_a_prior_that_fails_before_a_shot_has_begun_leaves_no_shot():
    def fails(frame):
        raise RuntimeError("no network")

    fails.kind = DepthKind.INVERSE
    episode = Episode(rendered("dolly").camera, depth=fails, options=OPTIONS)
    with pytest.raises(ModelError, match="no network"):
        episode.push(rendered("dolly").images[0])
    assert episode.finish() == []
