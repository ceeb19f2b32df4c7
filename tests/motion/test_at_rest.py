"""What rests in the image speaks for a fixed camera, unless one motion explains the others."""

from dataclasses import replace

import numpy as np

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.motion.at_rest import at_rest, resting_share, share_explained
from factorsfm.motion.shot_kind import classify_motion
from factorsfm.polish.camera_starts import best_solution
from factorsfm.polish.simple_readings import unless_at_rest
from factorsfm.support.options import Options, PolishOptions
from factorsfm.support.status import ShotKind
from tests.estimation_problems import make_problem, perturbed


def before_a_fixed_camera(share=0.6):
    """A fixed camera, and which of the points are of somebody who moves and bends before it."""
    problem = make_problem("static", frames=24, points=160, noise_px=0.1)
    o = problem.observations
    person = np.abs(problem.xy[o.first, 0]) <= np.quantile(np.abs(problem.xy[o.first, 0]), share)
    rng = np.random.default_rng(2)
    time = np.arange(problem.frames) / problem.frames
    phase, size = rng.uniform(0.0, 6.0, (2, len(person), 1)), rng.uniform(4.0, 30.0, (2, len(person), 1))
    way = np.stack([s * np.sin(6.0 * time + p) for s, p in zip(size, phase, strict=True)], -1)
    moved = (way * person[:, None, None]).reshape(-1, 2)
    return replace(problem, observations=replace(o, pixels=o.pixels + moved)), person


def test_a_fixed_camera_is_told_from_what_moves_before_it():
    problem, person = before_a_fixed_camera()
    rests = at_rest(problem.observations)
    np.testing.assert_array_equal(rests, ~person)
    assert 0.35 < resting_share(problem.observations, rests) < 0.65
    found = best_solution(perturbed(problem.truth), problem.observations, Options())
    fixed = unless_at_rest(found, problem.truth, problem.observations, Options())
    np.testing.assert_array_equal(fixed.kept, np.nonzero(~person)[0])
    assert fixed.rest is not None
    assert fixed.rest.explained < 0.3
    assert classify_motion(fixed.adjustment, PolishOptions()).kind is ShotKind.STATIC


def test_nothing_rests_before_a_camera_in_the_hand():
    observations = make_problem("handheld", frames=24, points=160, parallax=0.01, noise_px=0.1).observations
    assert resting_share(observations, at_rest(observations)) == 0.0


def test_a_slow_start_is_no_rest():
    problem = make_problem("truck", frames=24, points=160, parallax=0.1, noise_px=0.1)
    o, truth = problem.observations, problem.truth
    first = o.pixels[o.first][o.point]
    late = replace(o, pixels=np.where((o.frame < 12)[:, None], first, o.pixels))
    short = late.at((o.frame < 12) | (o.point % 2 == 0))  # half of the tracks end before the camera starts
    assert at_rest(short).sum() == len(truth.bearing) // 2
    assert resting_share(short, at_rest(short)) == 0.0


def test_what_is_far_may_rest_where_one_motion_explains_the_others():
    problem = make_problem("truck", frames=24, points=160, parallax=0.1, noise_px=0.1)
    o = problem.observations
    far = np.arange(len(problem.points)) % 3 == 0
    pixels = np.where(far[o.point, None], problem.observations.pixels[o.first][o.point], o.pixels)
    truth = replace(problem.truth, rotation=np.tile(np.eye(3), (24, 1, 1)))
    sideways = BundleAdjustment(truth, replace(o, pixels=pixels), PolishOptions(), ErrorModel(0.1))
    errors = np.where(far[o.point], 0.0, sideways.reprojection_errors())
    seen = replace(o, pixels=pixels)
    assert resting_share(seen, at_rest(seen)) > 0.2
    assert share_explained(seen, errors, far) > 0.9
