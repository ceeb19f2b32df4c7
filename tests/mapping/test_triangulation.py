import numpy as np
import pytest

from factorsfm.adjustment.observations import Observations, PriorObservations
from factorsfm.mapping.triangulation import triangulate
from tests.estimation_problems import make_problem

SETTINGS = {"inlier_px": 3.0, "sigma": 0.25}


def run(problem, observations=None, *, fallback=1.0, **kwargs):
    return triangulate(
        problem.truth,
        observations or problem.observations,
        fallback=np.full(len(problem.points), fallback),
        **SETTINGS,
        **kwargs,
    )


def points_of(result):
    return result.bearing / result.inverse_distance[:, None]


def angle_between_first_and_farthest_ray(problem):
    """(n,) exact, from the truth."""
    rays = problem.points[:, None] - -np.einsum("kji,kj->ki", problem.truth.rotation, problem.truth.translation)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return np.linalg.norm(np.cross(rays, rays[:, :1]), axis=2).max(1)


def prior_of(problem, images, *, scale=1.3, shift=0.2, sigma=0.02):
    """Exact values of a prior on some frames, and the affine that they have."""
    n, k = len(problem.points), len(images)
    image, point = np.tile(np.arange(k), n), np.repeat(np.arange(n), k)
    frame = np.asarray(images)[image]
    z = np.stack([problem.depth(f, np.arange(n)) for f in images], 1).ravel()
    m = n * k
    prior = PriorObservations(
        image, frame, point, scale / z + shift, np.full(m, sigma),
        np.zeros((m, 4), np.int64), np.zeros((m, 4)), np.eye(1), 1.0, 1.0,
    )  # fmt: skip
    return np.tile([scale, shift], (k, 1)), prior


@pytest.mark.parametrize("motion", ["dolly", "truck", "handheld", "arc"])
@pytest.mark.parametrize("fallback", [0.3, 3.0])
def test_exact_observations_give_exact_points(motion, fallback):
    problem = make_problem(motion, parallax=0.1)
    result = run(problem, fallback=fallback)
    np.testing.assert_allclose(np.linalg.norm(result.bearing, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(result.bearing, problem.truth.bearing, rtol=0.0, atol=1e-14)
    wide = result.angle > 0.005
    assert wide.mean() > 0.8
    np.testing.assert_allclose(
        result.inverse_distance[wide], problem.truth.inverse_distance[wide], rtol=0.0, atol=1e-13
    )
    assert (result.inliers == problem.frames).all()


def test_the_angle_is_that_of_the_rays():
    problem = make_problem("truck", parallax=0.2)
    np.testing.assert_allclose(run(problem).angle, angle_between_first_and_farthest_ray(problem), atol=1e-9)


def test_the_error_follows_the_noise():
    problem = make_problem("truck", parallax=0.2, points=300, noise_px=0.25)
    result = run(problem)
    error = result.inverse_distance - problem.truth.inverse_distance
    # One coordinate of every frame tells depth and direction: the lever of the depth is the centred baseline.
    baseline = np.linalg.norm(problem.truth.translation, axis=1)
    expected = 0.25 / problem.focal / np.linalg.norm(baseline - baseline.mean())
    assert 0.88 < np.sqrt(np.mean(error**2)) / expected < 1.12  # 300 draws know it within 4 %
    assert abs(np.mean(error)) < 1.5 * expected / np.sqrt(len(error))


@pytest.mark.parametrize("wild_frames", [[9], [0], [2, 6, 7]])
def test_outliers_among_the_views_are_left_out(wild_frames):
    problem = make_problem("truck", parallax=0.2, noise_px=0.1)
    o = problem.observations
    every_third = (o.point % 3 == 0) & np.isin(o.frame, wild_frames)
    o.pixels[every_third] += problem.focal * np.array([0.02, 0.05])  # 30 pixels
    result = run(problem)
    expected = np.where(np.arange(len(problem.points)) % 3 == 0, problem.frames - len(wild_frames), problem.frames)
    np.testing.assert_array_equal(result.inliers, expected)
    np.testing.assert_allclose(result.inverse_distance, problem.truth.inverse_distance, rtol=0.0, atol=0.005)


def test_without_parallax_the_fallback_decides():
    problem = make_problem("rotation", noise_px=0.05)
    n = len(problem.points)
    fallback = np.linspace(0.5, 2, n)
    result = triangulate(
        problem.truth,
        problem.observations,
        fallback=fallback,
        **SETTINGS,
    )
    assert result.angle.max() < 1e-3
    assert (result.inliers == problem.frames).all()
    np.testing.assert_allclose(result.bearing, problem.truth.bearing, rtol=0.0, atol=1.5e-4)
    np.testing.assert_allclose(result.inverse_distance, fallback, rtol=1e-12)


def test_one_view_alone_is_lifted_to_the_fallback():
    problem = make_problem("truck")
    o = problem.observations
    lonely = o.frame == 4
    result = run(problem, Observations(o.frame[lonely], o.point[lonely], o.pixels[lonely]), fallback=0.8)
    center = -problem.truth.rotation[4].T @ problem.truth.translation[4]
    rays = np.concatenate([problem.xy[lonely], np.ones((lonely.sum(), 1))], 1) @ problem.truth.rotation[4]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(points_of(result), center + rays / 0.8, rtol=0.0, atol=1e-13)
    assert (result.inliers == 1).all()
    assert (result.angle == 0).all()


def test_tracks_of_different_lengths():
    problem = make_problem("truck", parallax=0.2)
    o = problem.observations
    keep = (o.frame + o.point) % 4 != 0  # every track misses other frames
    keep &= (o.point % 5 != 0) | (o.frame >= 6)
    result = run(problem, Observations(o.frame[keep], o.point[keep], o.pixels[keep]))
    np.testing.assert_array_equal(result.inliers, np.bincount(o.point[keep]))
    seen_long = o.point[keep & (o.frame < 3)]
    some = np.isin(np.arange(len(problem.points)), seen_long)
    np.testing.assert_allclose(
        result.inverse_distance[some], problem.truth.inverse_distance[some], rtol=0.0, atol=1e-13
    )


@pytest.mark.parametrize("inverse_distance", [0.0, 0.03])
def test_distant_points_stay_far_away(inverse_distance):
    problem = make_problem("truck", parallax=0.1)
    truth, o = problem.truth, problem.observations
    q = np.einsum("kij,nj->nki", truth.rotation, truth.bearing) + inverse_distance * truth.translation
    o.pixels[:] = problem.focal * (q[..., :2] / q[..., 2:]).reshape(-1, 2)
    result = run(problem)
    supported = result.inliers == problem.frames
    assert supported.mean() > 0.9  # at infinity itself rounding puts some beyond, where no hypothesis is accepted
    np.testing.assert_allclose(result.inverse_distance[supported], inverse_distance, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(result.bearing[supported], truth.bearing[supported], rtol=0.0, atol=1e-14)


def test_the_prior_gives_depth_where_the_rays_do_not():
    problem = make_problem("static", noise_px=0.1)
    affine, prior = prior_of(problem, [0, 4])
    alone = run(problem, fallback=2.0)
    result = run(problem, fallback=2.0, affine=affine, prior=prior)
    assert np.median(np.abs(alone.inverse_distance - problem.truth.inverse_distance)) > 0.5
    np.testing.assert_allclose(result.inverse_distance, problem.truth.inverse_distance, rtol=0.0, atol=2e-4)


def test_a_wrong_prior_yields_to_wide_rays():
    problem = make_problem("truck", parallax=0.3)
    affine, prior = prior_of(problem, [0, 4], sigma=0.3)
    prior.inverse_depth[:] = 1.0
    result = run(problem, affine=affine, prior=prior)
    np.testing.assert_allclose(result.inverse_distance, problem.truth.inverse_distance, rtol=0.0, atol=1e-4)


def test_it_gives_the_same_points_again():
    problem = make_problem("handheld", noise_px=1.0)
    first, again = run(problem), run(problem)
    np.testing.assert_array_equal(first.inverse_distance, again.inverse_distance)


@pytest.mark.parametrize("motion", ["dolly", "truck", "handheld", "static"])
def test_the_graph_gives_the_same_points(motion):
    """Between noisy rays and a prior that is off; without parallax it is the prior that decides."""
    problem = make_problem(motion, parallax=0.1, noise_px=0.3) if motion != "static" else make_problem(motion)
    affine, prior = prior_of(problem, [0, 4], sigma=0.05)
    prior.inverse_depth[:] *= np.random.default_rng(0).normal(1.0, 0.03, len(prior.inverse_depth))
    alone, by_graph = (run(problem, affine=affine, prior=prior, in_graph=in_graph) for in_graph in (False, True))
    apart = np.linalg.norm(points_of(alone) - points_of(by_graph), axis=1) / np.linalg.norm(points_of(alone), axis=1)
    assert np.median(apart) < 3e-4
    assert np.quantile(apart, 0.95) < 3e-3  # the weak priors of the two differ
    np.testing.assert_array_equal(alone.inliers, by_graph.inliers)
