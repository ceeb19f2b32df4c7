"""Of a long shot, cameras, lens and motion are solved on few frames, and the others follow."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment.observations import Observations
from factorsfm.polish import core_frames as module
from factorsfm.polish.core_frames import core_frames
from factorsfm.polish.polish import polish
from factorsfm.polish.shot import Shot
from factorsfm.support.options import Options
from factorsfm.support.status import ShotKind
from tests.estimation_problems import angles_between, make_problem, mapped_images

FRAMES = 24


def tracks_of(length, frames):
    """One track more in each frame, for so many frames; each frame sees so many."""
    point, age = np.indices((frames + length - 1, length)).reshape(2, -1)
    frame = point + age - (length - 1)
    inside = (frame >= 0) & (frame < frames)
    return Observations(frame[inside], point[inside], np.zeros((int(inside.sum()), 2)))


@pytest.mark.parametrize(("length", "expected"), [(100, 60), (6, 120), (3, 240), (2, 400)])
def test_frames_are_few_as_long_as_they_see_the_same(length, expected):
    """Of 400 frames: every third and fourth needs tracks of six, which then have a third in common."""
    rows = core_frames(tracks_of(length, 400), 400, alone=False)
    assert len(rows) == expected
    assert rows[0] == 0
    assert rows[-1] == 399
    assert np.ptp(np.diff(rows)) <= 1


def test_a_view_that_is_lost_asks_for_no_more_frames():
    before, after = tracks_of(50, 200), tracks_of(50, 200)
    both = Observations(
        np.r_[before.frame, after.frame + 200],
        np.r_[before.point, after.point + before.point.max() + 1],
        np.concatenate([before.pixels, after.pixels]),
    )
    assert len(core_frames(both, 400, alone=False)) == 60


@pytest.mark.parametrize(
    ("frames", "alone", "expected"),
    [(48, False, 48), (75, False, 75), (76, False, 60), (50, True, 50), (51, True, 40)],
)
def test_a_short_shot_is_solved_on_all_frames(frames, alone, expected):
    rows = core_frames(tracks_of(12, frames), frames, alone=alone)
    assert len(rows) == expected
    assert rows[-1] == frames - 1


def polished(motion, lens, monkeypatch, few):
    problem = make_problem(motion, frames=FRAMES, points=200, parallax=0.1, noise_px=0.1)
    options = replace(Options.preset_named("geometry"), lens=lens)
    monkeypatch.setattr(module, "_FRAMES_ALONE" if lens == "fixed" else "_FRAMES", few)
    points = np.arange(len(problem.truth.bearing)), problem.truth.points
    guess, shape = (1.0, None) if lens == "fixed" else (1.1, np.zeros(4))  # of the focal length
    focal = np.array([problem.focal * guess])
    images = mapped_images(problem, problem.truth, guess=guess)
    return problem.truth, polish(
        Shot.of(images, points, focal, shape=shape, seconds=np.arange(len(images)) / 24), options
    )


@pytest.mark.parametrize("motion", ["truck", "rotation"])
def test_the_solution_is_that_of_all_frames(motion, monkeypatch):
    truth, all_at_once = polished(motion, "fixed", monkeypatch, FRAMES)
    _, result = polished(motion, "fixed", monkeypatch, 8)
    assert result.frames == list(range(FRAMES))
    assert result.motion.kind is (ShotKind.GENERAL if motion == "truck" else ShotKind.ROTATION)
    wrong, right = (angles_between(r.state.rotation, truth.rotation) for r in (result, all_at_once))
    assert np.median(wrong) < 1.05 * np.median(right)
    assert angles_between(result.state.rotation, all_at_once.state.rotation).max() < 0.2 * right.max()
    np.testing.assert_allclose(np.median(result.errors), np.median(all_at_once.errors), rtol=0.005)


def test_the_lens_is_found_on_few_frames(monkeypatch):
    truth, result = polished("rotation", "focal", monkeypatch, 8)
    lens = result.lens
    assert lens is not None
    assert lens.determined
    off = np.log(lens.lens.focal) - truth.log_focal
    assert np.abs(off).max() < 3.0 * lens.focal_std.max()
    assert 0.0005 < lens.focal_std.max() < 0.02
    assert np.median(result.errors) < 0.118
