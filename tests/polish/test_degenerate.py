"""What the images leave open never ends in a failure: everything is solved, uncertain, or refused in a sentence."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment.observations import Observations
from factorsfm.polish.polish import polish
from factorsfm.polish.shot import Shot
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.options import Options
from tests.estimation_problems import Problem, make_problem, mapped_images, perturbed

LENSES = ("distortion", *(pytest.param(lens, marks=pytest.mark.slow) for lens in ("fixed", "focal", "all", "zoom")))


def seen_by(state, points, noise_px=0.1, seed=0):
    """The problem of some points (n, 3) that all cameras of a state see."""
    n, frames, focal = len(points), len(state.rotation), float(np.exp(state.log_focal[0]))
    distance = np.linalg.norm(points, axis=1)
    truth = replace(state, bearing=points / distance[:, None], inverse_distance=1.0 / distance)
    frame, point = np.tile(np.arange(frames), n), np.repeat(np.arange(n), frames)
    q = truth.camera_points(frame, point)
    pixels = focal * q[:, :2] / q[:, 2:] + noise_px * np.random.default_rng(seed).standard_normal((n * frames, 2))
    return Problem(truth, points, Observations(frame, point, pixels), focal, noise_px)


def degenerate(what):
    """A problem that leaves something open, with a map as wrong as a mapper may leave it."""
    arc = make_problem("arc", frames=8, points=120, parallax=0.3, noise_px=0.1)
    still = make_problem("static", frames=8, points=120, noise_px=0.1)
    truth, points = arc.truth, arc.points
    match what:
        case "few points":
            return seen_by(truth, points[:16])
        case "two images":
            two = make_problem("arc", frames=2, points=80, parallax=0.3, noise_px=0.1)
            return two
        case "plane":
            return seen_by(truth, points / points[:, 2:])
        case "line":
            return seen_by(truth, np.linspace([-0.4, -0.2, 1.0], [0.4, 0.2, 1.0], 40))
        case "one place":
            return seen_by(truth, np.tile([0.1, 0.05, 1.0], (40, 1)))
        case "two places":
            return seen_by(truth, np.repeat([[0.1, 0.05, 1.0], [-0.1, 0.0, 1.2]], 20, 0), noise_px=0.0)
        case "coincident cameras":
            return still
        case "exactly coincident cameras":
            return seen_by(still.truth, still.points, noise_px=0.0)
        case "rotation":
            return make_problem("rotation", frames=8, points=120, noise_px=0.1)
        case "without noise":
            return seen_by(truth, points, noise_px=0.0)
        case "points in a camera":
            centers = -np.einsum("kji,kj->ki", truth.rotation, truth.translation)
            return seen_by(truth, np.concatenate([points, centers[-1] + [[0.0, 0.0, 1e-9], [1e-7, 0.0, 1e-9]]]))
        case "wrong matches":
            rng = np.random.default_rng(0)
            return replace(arc, observations=replace(arc.observations, pixels=rng.permutation(arc.observations.pixels)))
    raise ValueError(what)


CASES = (
    "few points", "two images", "plane", "line", "one place", "two places", "coincident cameras",
    "exactly coincident cameras", "rotation", "without noise", "points in a camera", "wrong matches",
)  # fmt: skip


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("guided", [pytest.param((), marks=pytest.mark.slow), (0, 3)])
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("what", CASES)
def test_nothing_that_the_images_leave_open_makes_a_solve_fail(what, lens, guided):
    problem = degenerate(what)
    guided = tuple(k for k in guided if k < problem.frames)
    start = perturbed(problem.truth)
    images = mapped_images(problem, start, guess=1.2, guided=guided, noise=0.02)
    focal = np.array([1.2 * problem.focal])
    points = np.arange(len(start.bearing)), start.points
    options = replace(Options.preset_named("default" if guided else "geometry"), lens=lens)
    try:
        result = polish(Shot.of(images, points, focal, seconds=np.arange(len(images)) / 24), options)
    except ReconstructionError:  # refused in a sentence
        return
    assert np.isfinite(result.state.rotation).all()
    assert np.isfinite(result.state.translation).all()
    assert (np.linalg.eigvalsh(result.covariance)[:, 0] >= -1e-6 * np.linalg.eigvalsh(result.covariance)[:, -1]).all()
    assert (result.point_std >= 0.0).all()
    if result.lens is not None:
        assert (result.lens.focal_std >= 0.0).all()
