import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.marginals import in_scene, in_scene_unit, scene_weights
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.motion.shot_kind import classify_motion, displacement
from factorsfm.polish.observability import (
    CameraObservability,
    camera_observability,
    pixel_slide,
    pose_blocks,
    triangulation_angles,
)
from factorsfm.polish.polish import polish
from factorsfm.polish.shot import Shot
from factorsfm.result.notes import observability_notes
from factorsfm.result.reconstruction import FrameResult
from factorsfm.result.summary import failure_summary, pooled_observability
from factorsfm.support.json_text import json_text
from factorsfm.support.options import Options, PolishOptions
from factorsfm.support.status import FrameStatus, ShotKind
from tests.calibration import assert_calibrated, normalised, pose_errors
from tests.estimation_problems import angles_between, centers, make_problem, mapped_images, perturbed, with_prior

OPTIONS = PolishOptions()


def classified(problem):
    """The motion of a shot, after cameras and points have converged with the noise that the shot has."""
    start = perturbed(problem.truth, angle_rad=1e-3, shift=1e-3)
    adjustment = BundleAdjustment(start, problem.observations, OPTIONS, ErrorModel(problem.noise_px))
    adjustment.solve()
    return classify_motion(adjustment, OPTIONS)


def shot(motion, *, noise_px=0.1, seed=0, **kwargs):
    return make_problem(motion, **({"frames": 15, "points": 120} | kwargs), noise_px=noise_px, seed=seed)


# --- displacement -----------------------------------------------------------------------------------------------


def test_displacement_is_the_largest_median_over_the_frames():
    frame = np.tile([0, 1, 2], 3)
    point = np.repeat([0, 1, 2], 3)
    xy = np.zeros((9, 2))
    xy[frame == 1, 0] = [0.01, 0.02, 0.09]
    xy[frame == 2, 1] = [0.01, 0.015, 0.02]
    assert displacement(Observations(frame, point, xy), xy) == pytest.approx(0.02)


def test_displacement_counts_from_the_first_appearance():
    frame, point = np.array([0, 1, 1, 2]), np.array([0, 0, 1, 1])
    xy = np.array([[0.0, 0], [0.1, 0], [5.0, 5], [5.0, 5.1]])
    assert displacement(Observations(frame, point, xy), xy) == pytest.approx(0.1)


def test_displacement_of_a_rotation():
    problem = make_problem("rotation")
    moved = displacement(problem.observations, problem.xy)
    assert moved == pytest.approx(np.radians(12), rel=0.1)


# --- kinds ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise_px", [0.05, 0.3])
def test_a_tripod_shot_is_static(noise_px):
    motion = classified(shot("static", noise_px=noise_px))
    assert motion.kind is ShotKind.STATIC
    assert 1.0 * noise_px < motion.displacement_px < 3.5 * noise_px


@pytest.mark.parametrize("noise_px", [0.05, 0.3])
def test_a_pan_on_a_tripod_is_a_rotation(noise_px):
    problem = shot("rotation", noise_px=noise_px)
    motion = classified(problem)
    assert motion.kind is ShotKind.ROTATION
    assert motion.displacement_px == pytest.approx(problem.focal * np.radians(12), rel=0.15)
    error = angles_between(motion.rotation_only.rotation, problem.truth.rotation).max()
    assert 6e-4 * noise_px < error < 3e-3 * noise_px
    assert not motion.rotation_only.translation.any()


@pytest.mark.parametrize("parallax", [0.01, 0.05])
@pytest.mark.parametrize("name", ["dolly", "truck", "handheld", "arc"])
def test_translation_is_general_motion(name, parallax):
    motion = classified(shot(name, parallax=parallax))
    assert motion.kind is ShotKind.GENERAL
    assert motion.gain > 1.0


@pytest.mark.parametrize("name", ["truck", "handheld"])
def test_a_small_but_real_translation_is_general_motion(name):
    assert classified(shot(name, parallax=0.003)).kind is ShotKind.GENERAL


def test_noise_can_hide_a_translation():
    """The same translation under noise that is larger than its parallax is not claimed."""
    assert classified(shot("truck", parallax=0.001, noise_px=1.0)).kind is not ShotKind.GENERAL


def test_the_gain_grows_with_the_parallax():
    gains = [classified(shot("truck", parallax=parallax)).gain for parallax in (0.0, 0.003, 0.01, 0.03)]
    assert gains == sorted(gains)
    assert -0.05 < gains[0] < 0.3


def test_outliers_do_not_make_a_tripod_move():
    """A twentieth of the tracks follow something that moves through the image."""
    problem = shot("static", points=200)
    o = problem.observations
    actor = o.point % 20 == 0
    o.pixels[actor, 0] += 0.01 * problem.focal * o.frame[actor]
    assert classified(problem).kind is ShotKind.STATIC


def test_the_adjustment_is_left_as_it_was():
    problem = shot("truck")
    adjustment = BundleAdjustment(problem.truth, problem.observations, OPTIONS, ErrorModel(0.1))
    state = adjustment.solve()
    before = replace(state, rotation=state.rotation.copy(), translation=state.translation.copy())
    classify_motion(adjustment, OPTIONS)
    np.testing.assert_array_equal(adjustment.state.rotation, before.rotation)
    np.testing.assert_array_equal(adjustment.state.translation, before.translation)


def test_a_last_camera_that_has_lost_its_observations():
    problem = shot("truck")
    o = problem.observations
    kept = o.frame != problem.frames - 1
    rest = replace(o, frame=o.frame[kept], point=o.point[kept], pixels=o.pixels[kept])
    adjustment = BundleAdjustment(problem.truth, rest, OPTIONS, ErrorModel(0.1))
    last = observed(adjustment)[-1]
    assert (len(observed(adjustment)), np.isnan(last.triangulation_angle_deg)) == (problem.frames, True)


# --- the prior's share ------------------------------------------------------------------------------------------


def observed(adjustment):
    marginals = adjustment.marginals()
    return camera_observability(adjustment, marginals, in_scene_unit(marginals, adjustment.state))


def shares(motion, parallax, *, noise=0.02, smooth=0.02, affine_std=0.02):
    """(k,) shares of a prior on three frames, over all directions and along the view axis, at the true solution."""
    problem = make_problem(motion, frames=12, points=150, parallax=parallax, noise_px=0.2)
    prior, truth = with_prior(
        problem, [0, 5, 11], noise=noise, smooth=smooth, scale_std=affine_std, shift_std=affine_std
    )
    cameras = observed(BundleAdjustment(truth, problem.observations, OPTIONS, ErrorModel(0.2), prior=prior))
    return np.array([(c.prior_share, c.prior_share_view_axis) for c in cameras]).T


# Towards the point that a dolly approaches there is little parallax at any distance.
@pytest.mark.parametrize(("motion", "at_most"), [("truck", 0.05), ("dolly", 0.25), ("handheld", 0.02)])
def test_a_good_prior_carries_a_shot_of_tiny_parallax_and_parallax_takes_over(motion, at_most):
    tiny, small, medium, large = (shares(motion, parallax) for parallax in (0.002, 0.01, 0.05, 0.4))
    assert tiny.min() > 0.95
    for more, less in [(tiny, small), (small, medium), (medium, large)]:
        assert (more > less).all()
    assert large.max() < at_most


def test_a_prior_that_knows_little_has_a_small_share():
    good, poor = (shares("truck", 0.01, noise=noise, smooth=noise, affine_std=0.3)[0] for noise in (0.02, 0.5))
    assert good.min() > 0.4
    assert 0.0 < poor.max() < 0.1


def test_without_a_prior_its_share_is_zero():
    problem = make_problem("truck", noise_px=0.2)
    cameras = observed(BundleAdjustment(problem.truth, problem.observations, OPTIONS, ErrorModel(0.2)))
    assert [(c.prior_share, c.prior_share_view_axis) for c in cameras] == [(0.0, 0.0)] * problem.frames


def test_a_prior_without_weight_adds_nothing():
    problem = make_problem("handheld", noise_px=0.2)
    prior, truth = with_prior(problem, [0, 9])
    prior = replace(prior, sigma=np.full_like(prior.sigma, 1e6))
    cameras = observed(BundleAdjustment(truth, problem.observations, OPTIONS, ErrorModel(0.2), prior=prior))
    assert max(c.prior_share for c in cameras) < 1e-6


# --- calibration ------------------------------------------------------------------------------------------------

TRIALS = 60
GAUSSIAN = PolishOptions(kernel=1e6, tolerance=1e-6)
MOTIONS = ["truck", "dolly", "handheld"]


def solutions(motion, noise_px=0.3):
    """Solutions of one problem under many draws of the noise, in the truth's unit, and the last adjustment."""
    problem = make_problem(motion, frames=5, points=60, parallax=0.1)
    found = []
    for seed in range(TRIALS):
        noise = np.random.default_rng([seed, 5]).standard_normal(problem.observations.pixels.shape)
        noisy = replace(problem.observations, pixels=problem.observations.pixels + noise_px * noise)
        adjustment = BundleAdjustment(problem.truth, noisy, GAUSSIAN, ErrorModel(noise_px))
        state = adjustment.solve()
        unit = state.inverse_distance.mean() / problem.truth.inverse_distance.mean()
        found.append(
            replace(state, translation=state.translation * unit, inverse_distance=state.inverse_distance / unit)
        )
    exact = BundleAdjustment(problem.truth, problem.observations, GAUSSIAN, ErrorModel(noise_px))
    return problem, found, exact


@pytest.mark.parametrize("motion", MOTIONS)
def test_poses_points_and_slide_are_calibrated_in_the_scenes_unit(motion):
    problem, found, exact = solutions(motion)
    truth, marginals = problem.truth, exact.marginals()
    covariance = in_scene_unit(marginals, truth)
    poses = covariance[6:30, 6:30]
    assert_calibrated([normalised(pose_errors(state, truth), poses) for state in found])
    std = marginals.inverse_distance_std(covariance)
    ratio = np.array([(state.inverse_distance - truth.inverse_distance) / std for state in found])
    assert 0.9 < (ratio**2).mean() < 1.1

    slides = np.array([c.pixel_slide for c in camera_observability(exact, marginals, covariance)])
    assert slides[0] == 0.0
    for k in range(1, problem.frames):
        ids, _ = problem.of_frame(k)
        rotation, translation = truth.rotation[k], truth.translation[k]
        thing = rotation.T @ (np.array([0.0, 0.0, 1 / np.median(1 / problem.depth(k, ids))]) - translation)
        seen = np.array([state.rotation[k] @ thing + state.translation[k] for state in found])
        pixels = problem.focal * seen[:, :2] / seen[:, 2:]
        drift = np.sqrt(np.linalg.eigvalsh(pixels.T @ pixels / TRIALS)[-1])
        assert 0.75 < drift / slides[k] < 1.35  # the worst of two directions; 60 draws know it within 10 %


@pytest.mark.parametrize("motion", MOTIONS)
def test_positions_are_calibrated_relative_to_the_scene(motion):
    """The covariance that the shares compare, against solutions that are aligned with the true points."""
    problem, found, exact = solutions(motion)
    truth, marginals = problem.truth, exact.marginals()
    weights = scene_weights(marginals, truth)
    covariance = pose_blocks(in_scene(marginals, truth, weights), problem.frames)
    points, path = problem.points, centers(truth.rotation, truth.translation)
    by_similarity = np.concatenate([small_similarity(point) * w for point, w in zip(points, weights, strict=True)])
    errors = []
    for state in found:
        moved = (state.points - points) * weights[:, None]
        similarity = np.linalg.lstsq(by_similarity, moved.ravel(), rcond=None)[0]
        shift = centers(state.rotation, state.translation) - path
        shift -= np.array([small_similarity(center) @ similarity for center in path])
        errors.append(np.einsum("kij,kj->ki", truth.rotation, shift))
    ratio = (np.array(errors) ** 2).mean(0) / np.einsum("kii->ki", covariance)[:, 3:]
    assert 0.8 < ratio.mean() < 1.2
    assert ratio.min() > 0.5
    assert ratio.max() < 1.7


def small_similarity(point):
    """(3, 7) movement of a point by a small translation, rotation and growth."""
    x, y, z = point
    return np.column_stack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]], point])


# --- angles and pixels ------------------------------------------------------------------------------------------


def test_triangulation_angles_are_those_of_the_widest_pair():
    problem = make_problem("arc", frames=6, points=50, parallax=0.2)
    rays = problem.points[:, None] - centers(problem.truth.rotation, problem.truth.translation)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    widest = np.arccos(np.clip(np.einsum("nki,nli->nkl", rays, rays), -1, 1)).max(axis=(1, 2))
    ratio = triangulation_angles(problem.truth, problem.observations) / widest
    assert 0.98 < ratio.min() < ratio.max() < 1.0001


@pytest.mark.parametrize(
    ("axis", "expected"),
    [(0, 500 * 0.01), (1, 500 * 0.01), (2, 0.0), (3, 500 * 0.01 / 4), (4, 500 * 0.01 / 4), (5, 0.0)],
)
def test_pixel_slide_of_one_uncertain_axis(axis, expected):
    covariance = np.zeros((1, 6, 6))
    covariance[0, axis, axis] = 0.01**2
    assert pixel_slide(covariance, np.array([4.0]), 500.0) == pytest.approx([expected])


def test_a_rotation_that_makes_up_for_a_translation_does_not_slide():
    direction = np.array([0, 0.01, 0, -0.04, 0, 0])  # turning right and moving left, at depth 4
    covariance = np.outer(direction, direction)[None]
    assert pixel_slide(covariance, np.array([4.0]), 500.0) == pytest.approx([0.0], abs=1e-9)
    assert pixel_slide(covariance, np.array([8.0]), 500.0) == pytest.approx([2.5])


# --- through the polish -----------------------------------------------------------------------------------------


def polished(problem, **options):
    preset = Options.preset_named("geometry")
    preset = replace(preset, polish=replace(preset.polish, **options))
    points = np.arange(len(problem.points)), problem.points
    return polish(Shot.of(mapped_images(problem, problem.truth), points, np.array([problem.focal])), preset)


def test_the_polish_says_what_carries_each_camera():
    problem = shot("truck", parallax=0.05, points=200)
    result = polished(problem)
    assert len(result.observability) == problem.frames
    assert {c.prior_share for c in result.observability} == {0.0}
    angle = np.degrees(np.median(triangulation_angles(problem.truth, problem.observations)))
    for camera in result.observability:
        assert camera.triangulation_angle_deg == pytest.approx(angle, rel=0.01)
    slides = np.array([c.pixel_slide for c in result.observability])
    assert slides[0] == 0.0
    assert 0.003 < slides[1:].min() <= slides[1:].max() < 0.05
    truth = problem.truth.inverse_distance[result.tracks]
    estimate = result.state.inverse_distance
    error = (estimate / estimate.mean() - truth / truth.mean()) * estimate.mean() / result.point_std
    assert 0.7 < np.sqrt((error**2).mean()) < 1.3


def test_frames_between_have_the_observability_of_the_nearest():
    result = polished(make_problem("truck", frames=12, points=200, noise_px=0.1), max_frames=6)
    assert len(result.observability) == len(result.frames) == 12
    assert len({c.pixel_slide for c in result.observability}) == 6
    assert len(result.covariance) == len(result.relative_covariance) == 12
    assert all(np.linalg.eigvalsh(c)[0] > 0 for c in result.relative_covariance)
    assert len(np.unique(result.relative_covariance, axis=0)) == 5
    assert len(result.observation_sigma) == len(result.errors)
    assert 0.05 < result.observation_sigma.min() < np.median(result.observation_sigma) < 0.2


@pytest.mark.parametrize(("motion", "kind"), [("rotation", ShotKind.ROTATION), ("static", ShotKind.STATIC)])
def test_where_no_translation_is_estimated_there_are_no_shares(motion, kind):
    result = polished(shot(motion, points=200))
    assert result.motion.kind is kind
    assert not result.covariance[:, 3:].any()
    for camera in result.observability:
        assert np.isnan([camera.prior_share, camera.prior_share_view_axis]).all()
        assert camera.triangulation_angle_deg == pytest.approx(0.0, abs=1e-6)
        assert camera.pixel_slide < 0.05
    assert observability_notes(registered(result.observability)) == []


# --- in words ---------------------------------------------------------------------------------------------------


def registered(cameras, first=0):
    return [
        FrameResult(first + k, "", None, FrameStatus.REGISTERED, "", pycolmap.Rigid3d(), observability=camera)
        for k, camera in enumerate(cameras)
    ]


def cameras(view_axis, *, share=0.1, angle=1.0, slide=0.02):
    slide = np.broadcast_to(slide, len(view_axis))
    return [CameraObservability(share, float(v), angle, float(s)) for v, s in zip(view_axis, slide, strict=True)]


def test_what_does_not_matter_is_not_said():
    assert observability_notes([]) == []
    assert observability_notes(registered(cameras(np.full(30, 0.49), share=0.49, slide=0.49))) == []
    assert observability_notes([FrameResult(0, "", None, FrameStatus.BLANK, "")]) == []


def test_a_weak_stretch_is_one_sentence_in_the_numbers_of_the_source():
    view_axis = np.zeros(80)
    view_axis[30:62] = 0.83
    view_axis[[40, 41, 50]] = 0.2  # short gaps
    view_axis[[3, 4]] = 0.9  # too short to tell
    assert observability_notes(registered(cameras(view_axis), first=10)) == [
        "Frames 40 to 71: translation along the view axis comes 83 % from the depth prior."
    ]


def test_a_shot_that_the_prior_carries_is_one_sentence():
    assert observability_notes(registered(cameras(np.full(20, 0.8), share=0.75, angle=0.12))) == [
        "75 % of the information on the camera's positions comes from the depth prior: the median triangulation "
        "angle is 0.12 degrees, and the tracks alone would leave 2 times the error."
    ]


def test_drift_is_told_with_its_largest_value():
    slide = np.r_[np.full(10, 0.1), np.linspace(0.5, 1.4, 10)]
    assert observability_notes(registered(cameras(np.zeros(20), slide=slide))) == [
        "Frames 10 to 19: a virtual object at the scene's median depth may drift by 1.4 pixels "
        "(one standard deviation)."
    ]


def test_there_are_never_more_than_five_notes():
    weak = np.tile(np.r_[np.zeros(10), np.ones(10)], 10)
    strength = np.repeat(np.linspace(0.5, 0.9, 10), 20)
    notes = observability_notes(registered(cameras(weak * strength, share=0.6, slide=weak * strength)))
    assert len(notes) == 5
    assert notes[1].startswith("Frames 170 to 179")  # the two weakest, in order
    assert notes[2].startswith("Frames 190 to 199")


# --- in numbers -------------------------------------------------------------------------------------------------


def test_the_summary_holds_it_per_frame_and_pooled():
    frames = registered(cameras([0.1, 0.2, 0.6], share=0.3, angle=0.5, slide=[0.0, 0.1, 0.4]))
    frames.append(FrameResult(3, "", None, FrameStatus.BLANK, ""))
    statuses = json.loads(json_text(failure_summary("", frames, {}, {})))["statuses"]
    assert statuses[3]["observability"] is None
    assert statuses[2]["observability"] == {
        "prior_share": 0.3,
        "prior_share_view_axis": 0.6,
        "triangulation_angle_deg": 0.5,
        "pixel_slide": 0.4,
    }
    assert pooled_observability(SimpleNamespace(frames=frames)) == {
        "prior_share": 0.3,
        "prior_share_view_axis": 0.2,
        "triangulation_angle_deg": 0.5,
        "pixel_slide": 0.1,
        "largest_pixel_slide": 0.4,
    }
    assert pooled_observability(SimpleNamespace(frames=frames[3:])) is None


def test_shares_that_do_not_exist_are_null():
    frames = registered(cameras([np.nan], share=np.nan))
    status = json.loads(json_text(failure_summary("", frames, {}, {})))["statuses"][0]
    assert status["observability"]["prior_share"] is None
    assert np.isnan(pooled_observability(SimpleNamespace(frames=frames))["prior_share"])


def test_a_camera_without_observations_is_left_out_of_the_pool():
    known = registered(cameras([0.1, 0.3], share=0.3, angle=0.5, slide=[0.1, 0.3]))
    blind = registered(cameras([np.nan], share=np.nan, angle=np.nan, slide=[np.nan]))
    pooled = pooled_observability(SimpleNamespace(frames=blind + known))
    assert pooled == pooled_observability(SimpleNamespace(frames=known))
    assert pooled["largest_pixel_slide"] == 0.3
