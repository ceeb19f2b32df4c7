"""What the camera does by stretches: it stands, pans, then moves; and no path is invented where it does not move."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.motion.stretches import Stretch
from factorsfm.polish.polish import polish
from factorsfm.polish.shot import Shot
from factorsfm.result.notes import stretch_notes
from factorsfm.support.options import Options
from factorsfm.support.status import ShotKind
from tests.estimation_problems import centers, in_unit_of, make_problem, mapped_images, perturbed


def polished(motion, parallax, noise_px=0.1, *, frames=72, rate=24.0):
    problem = make_problem(motion, frames=frames, points=200, parallax=parallax, noise_px=noise_px)
    start = perturbed(problem.truth)
    points = np.arange(len(start.bearing)), start.points
    options = replace(Options.preset_named("geometry"), lens="fixed")
    shot = Shot.of(mapped_images(problem, start), points, np.array([problem.focal]), seconds=np.arange(frames) / rate)
    return problem, polish(shot, options)


@pytest.mark.parametrize("parallax", [0.1, 0.02])
def test_a_shot_that_stands_then_pans_then_moves_is_told_apart(parallax):
    problem, result = polished("stages", parallax)
    assert result.motion.kind is ShotKind.GENERAL
    assert result.stretches == (
        Stretch(0, 23, ShotKind.STATIC), Stretch(24, 47, ShotKind.ROTATION), Stretch(48, 71, ShotKind.GENERAL)
    )  # fmt: skip
    found, truth = in_unit_of(result.state, problem.truth), problem.truth
    error = centers(found.rotation, found.translation) - centers(truth.rotation, truth.translation)
    std = np.sqrt(np.trace(result.covariance[:, 3:, 3:], axis1=1, axis2=2))
    for part in (slice(1, 24), slice(24, 48), slice(48, 72)):
        off = np.sqrt((error[part] ** 2).sum(1).mean())
        assert 0.25 < off / std[part].mean() < 1.6  # neither an arc nor a false certainty
        assert 5e-5 < off < 4e-4


@pytest.mark.parametrize(
    ("motion", "parallax", "kind"),
    [
        ("truck", 0.012, "general"),
        ("handheld", 0.012, "general"),
        ("rotation", 0.0, "rotation"),
        ("static", 0.0, "static"),
    ],
)
def test_a_slow_move_is_one_stretch(motion, parallax, kind):
    _, result = polished(motion, parallax)
    assert result.stretches == (Stretch(0, 71, ShotKind(kind)),)


@pytest.mark.parametrize(("rate", "count"), [(24.0, 3), (120.0, 1)])
def test_a_stretch_lasts_long_enough_to_show_a_slow_move(rate, count):
    """Half a second in which a hand hardly turns the camera is none where all frames together last little longer."""
    _, result = polished("handheld", 0.002, frames=144, rate=rate)
    assert len(result.stretches) == count


def test_the_note_says_what_the_camera_does_when():
    parts = (Stretch(1001, 1024, ShotKind.STATIC), Stretch(1025, 1048, ShotKind.ROTATION))
    assert stretch_notes(parts) == ["By frames, the camera stands in 1001 to 1024, only turns in 1025 to 1048."]
    assert not stretch_notes(parts[:1])
