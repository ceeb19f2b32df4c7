from dataclasses import replace

import numpy as np
import pytest

from factorsfm.mapping.starts import NoStart, Start, lift, start_essential, start_lifted, start_pair
from factorsfm.priors.image_depth import ImageDepth
from tests.estimation_problems import angles_between, make_problem, tracks_at

PAIR = {"focal": 628.0, "sigma": 0.25, "inlier_px": 3.0}


def image_of(problem, frame, *, depth=True, position=None):
    """The image with its true inverse depth in units of its median, as a prior that is perfect up to scale."""
    ids, xy = problem.of_frame(frame)
    prior = None
    if depth:
        inverse = 1 / problem.depth(frame, ids)
        prior = ImageDepth(inverse / np.median(inverse), np.ones(len(ids)), unit=np.median(inverse))
    return tracks_at(frame if position is None else position, ids * 3 + 1, xy, prior, focal=problem.focal)


def essential(problem, frame, **kwargs):
    options = {"focal": problem.focal, "sigma": 0.25, "angle_deg": 1.0} | kwargs
    return start_essential(image_of(problem, 0), image_of(problem, frame), 30, **options)


def assert_similar(start, problem, *, angle_rad, relative):
    """Poses and points of a start equal the truth up to the unit of length."""
    truth, points = problem.truth, problem.points[(start.ids - 1) // 3]
    unit = np.median(np.linalg.norm(start.points, axis=1) / np.linalg.norm(points, axis=1))
    length = np.linalg.norm(points, axis=1)
    assert np.median(np.linalg.norm(start.points / unit - points, axis=1) / length) < relative
    for position, rotation, translation in zip(start.images, start.rotation, start.translation, strict=True):
        assert angles_between(rotation[None], truth.rotation[position][None])[0] < angle_rad
        assert np.linalg.norm(translation / unit - truth.translation[position]) < relative


# --- lifting ----------------------------------------------------------------------------------------------------


def test_lift_puts_points_on_their_rays_at_their_depth():
    problem = make_problem("truck")
    image = image_of(problem, 3)
    points, valid = lift(image.xy, image.depth)
    np.testing.assert_allclose(points[:, :2] / points[:, 2:], image.xy, atol=1e-12)
    z = problem.depth(3, problem.of_frame(3)[0])
    np.testing.assert_allclose(points[:, 2] / np.median(1 / z), z, rtol=1e-9)
    assert valid.all()


def test_lift_refuses_invalid_depth_and_limits_the_distance():
    depth = ImageDepth(np.array([np.nan, np.inf, 0.0, 1e-3, 0.03, 1.0]), np.ones(6), unit=1.0)
    points, valid = lift(np.zeros((6, 2)), depth)
    np.testing.assert_array_equal(valid, [False, False, False, False, True, True])
    assert np.isfinite(points).all()
    np.testing.assert_allclose(points[4:, 2], [20.0, 1.0])


def test_one_image_is_a_start():
    problem = make_problem("truck")
    start = start_lifted(image_of(problem, 0), 30)
    assert isinstance(start, Start)
    assert start.images == [0]
    assert_similar(start, problem, angle_rad=1e-14, relative=1e-14)
    np.testing.assert_array_equal(start.ids, np.arange(len(problem.points)) * 3 + 1)


def test_a_lifted_start_uses_the_valid_tracks_alone():
    problem = make_problem("truck")
    image = image_of(problem, 0)
    image.depth.inverse_depth[::2] = np.nan
    start = start_lifted(image, 30)
    assert isinstance(start, Start)
    np.testing.assert_array_equal(start.ids, image.ids[1::2])
    assert_similar(start, problem, angle_rad=1e-14, relative=1e-14)


def test_why_an_image_is_no_start():
    problem = make_problem("truck")
    image = image_of(problem, 0, position=7)
    nothing = start_lifted(replace(image, depth=None), 30)
    assert isinstance(nothing, NoStart)
    assert nothing.reason == "frame 7 has no depth map to lift"
    image.depth.inverse_depth[12:] = np.nan
    few = start_lifted(image, 30)
    assert isinstance(few, NoStart)
    assert few.reason == "12 of 30 needed tracks have a valid depth"


# --- the paper's pair -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("motion", ["dolly", "truck", "rotation", "static"])
def test_the_pair_recovers_pose_and_points(motion):
    """Depth makes a start of pairs without parallax, too."""
    problem = make_problem(motion)
    start = start_pair([image_of(problem, 0), image_of(problem, 9)], 30, **PAIR)
    assert isinstance(start, Start)
    assert start.images == [0, 9]
    assert_similar(start, problem, angle_rad=1e-14, relative=1e-14)


def test_the_pair_with_most_valid_matches_is_chosen():
    problem = make_problem("truck")
    images = [image_of(problem, k) for k in range(4)]
    images[0].depth.inverse_depth[:40] = np.nan  # most matches, but with less depth
    images[1] = replace(images[1], depth=None)
    few = np.arange(len(problem.points) - 10)
    images[3] = replace(images[3].of(few), depth=None)
    start = start_pair(images, 30, **PAIR)
    assert isinstance(start, Start)
    assert start.images[0] == 2
    assert start.images[1] in (0, 1)  # both see all that frame 2 sees


def test_outliers_of_the_pair():
    problem = make_problem("truck", points=200, noise_px=0.25)
    images = [image_of(problem, 0), image_of(problem, 9)]
    rng = np.random.default_rng(0)
    images[1].pixels[::5] += problem.focal * rng.choice([-0.1, 0.1], images[1].pixels[::5].shape)
    images[0].depth.inverse_depth[1::7] *= rng.choice([0.5, 1.5], images[0].depth.inverse_depth[1::7].shape)
    start = start_pair(images, 30, **PAIR)
    assert isinstance(start, Start)
    rotation = problem.truth.rotation[9]
    assert angles_between(start.rotation[1][None], rotation[None])[0] < 2e-3


def test_why_there_is_no_pair():
    problem = make_problem("truck")
    images = [image_of(problem, 0), image_of(problem, 9)]
    no_depth = start_pair([replace(i, depth=None) for i in images], 30, **PAIR)
    assert isinstance(no_depth, NoStart)
    assert no_depth.reason == "the best pair has 0 of 30 needed matches with a valid depth"
    shuffled = replace(images[1], pixels=np.random.default_rng(0).permutation(images[1].pixels))
    nonsense = start_pair([images[0], shuffled], 60, **PAIR)
    assert isinstance(nonsense, NoStart)
    assert "of 30 needed inliers" in nonsense.reason
    assert isinstance(start_pair([], 30, **PAIR), NoStart)
    assert isinstance(start_pair(images[:1], 30, **PAIR), NoStart)


# --- without depth ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("motion", ["dolly", "truck", "arc"])
def test_the_essential_matrix_recovers_pose_and_points(motion):
    problem = make_problem(motion, parallax=0.2)
    start = essential(problem, 9)
    assert isinstance(start, Start)
    assert len(start.ids) > 0.8 * len(problem.points)
    assert_similar(start, problem, angle_rad=1e-5, relative=5e-5)
    assert np.median(1 / np.linalg.norm(start.points, axis=1)) == pytest.approx(1.0, rel=1e-6)  # the unit of the map


@pytest.mark.parametrize("parallax", [0.005, 0.015])
def test_points_a_hundred_baselines_away(parallax):
    problem = make_problem("truck", parallax=parallax, noise_px=0.05)
    start = essential(problem, 9, angle_deg=0.1)
    assert isinstance(start, Start)
    assert len(start.ids) > 0.9 * len(problem.points)
    assert_similar(start, problem, angle_rad=3e-4, relative=0.04)


def test_the_essential_matrix_with_noise_and_outliers():
    problem = make_problem("truck", parallax=0.2, points=300, noise_px=0.2)
    o = problem.observations
    wild = (o.point % 4 == 0) & (o.frame == 9)
    o.pixels[wild] += problem.focal * np.random.default_rng(0).uniform(0.02, 0.1, (wild.sum(), 2))
    start = essential(problem, 9)
    assert isinstance(start, Start)
    assert_similar(start, problem, angle_rad=5e-3, relative=0.007)
    assert ((start.ids - 1) // 3 % 4 != 0).mean() > 0.95


@pytest.mark.parametrize("noise_px", [0.0, 0.1, 0.25])
@pytest.mark.parametrize("motion", ["rotation", "static"])
def test_no_translation_is_no_start(motion, noise_px):
    problem = make_problem(motion, points=200, noise_px=noise_px)
    assert isinstance(essential(problem, 9), NoStart)


def test_too_small_an_angle_is_no_start():
    problem = make_problem("truck", parallax=0.05)
    start = essential(problem, 2)
    assert isinstance(start, NoStart)
    assert "of 1.00 degrees needed" in start.reason
    assert isinstance(essential(problem, 2, angle_deg=0.3), Start)


def test_too_few_shared_tracks_are_no_start():
    problem = make_problem("truck", parallax=0.2)
    first, second = image_of(problem, 0), image_of(problem, 9)
    strangers = replace(second, ids=second.ids + 10_000)
    for other, shared in [(strangers, 0), (second.of(np.arange(20)), 20)]:
        start = start_essential(first, other, 30, focal=problem.focal, sigma=0.25, angle_deg=1.0)
        assert isinstance(start, NoStart)
        assert start.reason == f"{shared} of 30 needed tracks join frames 0 and 9"
