"""Objects from exact tracks with noise: motion, points, scale, covariance, and what cannot be solved."""

from dataclasses import replace
from functools import cache

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from factorsfm.objects.object_result import ObjectResult
from factorsfm.objects.scale import PriorOnScene, scale_from_prior
from factorsfm.objects.solve import SceneCamera, solve_object
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.options import Options
from factorsfm.support.rotations import adjoint
from tests.objects.moving_points import FRAME_STEP, FRAMES, POINTS, MovingPoints, moving_points

COLORS = np.arange(3 * POINTS, dtype=np.uint8).reshape(-1, 3)


@cache
def truth() -> MovingPoints:
    return moving_points()


@cache
def solved(*, prior: bool = True) -> ObjectResult:
    moving = truth() if prior else moving_points(prior=False)
    return solve_object("box", moving.images, COLORS, moving.cameras, Options())


def places(found: ObjectResult) -> NDArray[np.float64]:
    """(frames, n, 3) of the points in the world."""
    return np.array([frame.world_from_object * found.points for frame in found.frames])


def turn_errors(found: ObjectResult, moving: MovingPoints) -> NDArray[np.float64]:
    """Degrees, of the rotation since the first frame."""
    first, true_first = found.frames[0].world_from_object.rotation, moving.world_from_object[0].rotation
    errors = []
    for frame, true in zip(found.frames, moving.world_from_object, strict=True):
        turn = frame.world_from_object.rotation * first.inverse()
        errors.append(np.degrees((turn * (true.rotation * true_first.inverse()).inverse()).angle()))
    return np.array(errors)


def test_points_are_where_they_are_in_the_world_at_all_times() -> None:
    found = solved()
    assert [frame.index for frame in found.frames] == [FRAME_STEP * k for k in range(FRAMES)]
    assert len(found.points) == POINTS
    error = np.linalg.norm(places(found) - truth().places(), axis=2)
    length = np.linalg.norm(np.diff(truth().places().mean(1), axis=0), axis=1).sum()
    assert 0.001 * length < np.median(error) < 0.02 * length
    assert 0.01 < turn_errors(found, truth()).max() < 0.5
    assert 0.02 < found.reprojection_error < 0.12
    assert (found.colors == COLORS).all()


def test_origin_and_axes() -> None:
    found = solved()
    np.testing.assert_allclose(found.points.mean(0), 0.0, atol=1e-9)
    np.testing.assert_allclose(found.frames[0].world_from_object.rotation.matrix(), np.eye(3), atol=1e-9)


def test_scale_comes_from_the_prior_with_its_uncertainty() -> None:
    found = solved()
    assert found.scale_std is not None
    assert 0.02 < found.scale_std < 0.15
    assert "depth prior" in found.note
    nearer = moving_points(prior_factor=1.25)
    smaller = solve_object("box", nearer.images, COLORS, nearer.cameras, Options())
    size, other = (np.linalg.norm(thing.points, axis=1).mean() for thing in (found, smaller))
    assert other / size == pytest.approx(1 / 1.25, rel=0.01)


@pytest.mark.parametrize("sway", [0.03, 0.1])
def test_a_rest_gives_the_scale_of_the_scene(sway: float) -> None:
    """Whatever the prior says; as exactly as the tracks say where the thing is."""
    moving = moving_points(prior_factor=1.4, rests=0.6, sway=sway)
    found = solve_object("box", moving.images, COLORS, moving.cameras, Options())
    assert found.scale_from == "rest"
    assert found.scale_std is not None
    assert 0.0004 < found.scale_std < 0.004
    assert "It rests in the scene for 10 frames" in found.note
    size, true_size = (np.linalg.norm(p - p.mean(0), axis=1).mean() for p in (found.points, moving.points))
    assert abs(size / true_size - 1.0) < 3.0 * found.scale_std


@pytest.mark.parametrize(
    ("sway", "drift"),
    [(0.0, 0.0), (0.0, 0.15), (0.02, 0.1), (0.1, 0.02), (0.1, 0.1)],
    ids=["steady camera", "both steady", "sway hides no drift", "slow drift", "drift"],
)
def test_what_moves_with_the_camera_does_not_seem_to_rest(sway: float, drift: float) -> None:
    """Beside a steady camera, what moves steadily looks like a rest in another scale."""
    moving = moving_points(rests=0.6, sway=sway, drift=drift)
    found = solve_object("box", moving.images, COLORS, moving.cameras, Options())
    assert found.scale_from == "prior"


def test_without_a_prior_the_scale_is_open_and_a_note_says_so() -> None:
    found = solved(prior=False)
    assert (found.scale_std, found.scale_from) == (None, None)
    assert "Nothing gives its scale" in found.note
    # At the scene's median depth, which is 4; up to that factor everything is as it is with the scale.
    first = truth().cameras[0].cam_from_world * found.frames[0].world_from_object.translation
    assert first[2] == pytest.approx(4.0, rel=0.01)
    assert turn_errors(found, truth()).max() < 0.5
    distance, true_distance = (
        np.array([
            np.linalg.norm((camera.cam_from_world * points).mean(0))
            for camera, points in zip(truth().cameras.values(), where, strict=True)
        ])
        for where in (places(found), truth().places())
    )  # fmt: skip
    np.testing.assert_allclose(distance / true_distance / (distance[0] / true_distance[0]), 1.0, atol=0.003)


def test_covariance_says_how_far_the_path_is_off() -> None:
    """Beside the errors of five draws of the noise; relative to the first frame, whose covariance is zero."""
    turns, stds = [], []
    for seed in range(1, 6):
        moving = moving_points(noise_px=0.1, prior=False, seed=seed)
        found = solve_object("box", moving.images, COLORS, moving.cameras, Options())
        first, true_first = found.frames[0].world_from_object, moving.world_from_object[0]
        last, true_last = found.frames[-1].world_from_object, moving.world_from_object[-1]
        turn = last.rotation * first.rotation.inverse() * (true_last.rotation * true_first.rotation.inverse()).inverse()
        turns.append(np.degrees(turn.angle()))
        stds.append(np.degrees(np.sqrt(found.frames[-1].covariance[:3, :3].trace())))
        np.testing.assert_allclose(found.frames[0].covariance, 0.0, atol=1e-15)
        assert found.rotation_std >= np.degrees(np.sqrt(found.frames[-1].covariance[0, 0]))
    assert 0.4 < np.sqrt(np.mean(np.square(turns)) / np.mean(np.square(stds))) < 1.8


def test_adjoint_carries_a_perturbation_to_the_other_side() -> None:
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.4, -0.7, 0.2])), np.array([0.5, -2.0, 3.0]))
    for axis in range(6):
        small = 1e-6 * np.eye(6)[axis]
        moved = pose * pycolmap.Rigid3d(pycolmap.Rotation3d(small[:3]), small[3:]) * pose.inverse()
        found = np.r_[moved.rotation.quat[:3] * 2.0, moved.translation]
        np.testing.assert_allclose(found, adjoint(pose.rotation.matrix(), pose.translation) @ small, atol=1e-11)


def test_a_small_thing_is_not_solved() -> None:
    moving = moving_points(size=0.15)
    with pytest.raises(ReconstructionError, match=r"too small in the image.*5\.2 needed"):
        solve_object("box", moving.images, COLORS, moving.cameras, Options())


def test_two_motions_are_not_one_thing() -> None:
    """Every third point goes its own way, up and down by a few pixels."""
    moving = truth()
    own = np.arange(POINTS) % 3 == 0
    images = [
        replace(image, pixels=image.pixels + np.outer(own, [0.0, 12.0 * np.sin(1.3 * image.position)]))
        for image in moving.images
    ]
    with pytest.raises(ReconstructionError, match=r"^it is not rigid: one motion explains (5\d|60) of 90 tracks"):
        solve_object("box", images, COLORS, moving.cameras, Options())


def test_too_few_tracks_and_frames() -> None:
    moving = truth()
    with pytest.raises(ReconstructionError, match=r"^4 frames have 20 tracks on it, at least 5 needed$"):
        solve_object("box", moving.images[:4], COLORS, moving.cameras, Options())
    torn = [replace(image, ids=image.ids + 1000 * image.position) for image in moving.images]
    with pytest.raises(ReconstructionError, match="no three frames share 20 tracks"):
        solve_object("box", torn, COLORS, moving.cameras, Options())


def test_frames_without_a_camera_are_left_out() -> None:
    moving = truth()
    cameras: dict[int, SceneCamera] = {k: camera for k, camera in moving.cameras.items() if k not in (0, 7)}
    found = solve_object("box", moving.images, COLORS, cameras, Options())
    assert [frame.index // FRAME_STEP for frame in found.frames] == sorted(cameras)


# --- scale from the prior -----------------------------------------------------------------------------------------


def maps(count: int, sigma: float, factor: float = 2.0) -> list[tuple[NDArray[np.float64], ...]]:
    depth = np.linspace(1.0, 1.2, 30)
    prior = PriorOnScene(3.0, 0.5, 0.0, 0.0, 0.8 * sigma, 0.6 * sigma)
    return [(3.0 / (factor * depth) + 0.5, depth, prior) for _ in range(count)]


def test_scale_of_exact_maps() -> None:
    found = scale_from_prior(maps(4, 0.1))
    assert found is not None
    assert (found.value, found.frames) == (pytest.approx(2.0, rel=1e-12), 4)
    # sigma over what the map says of the object, shift taken away; as much with one map as with a hundred
    assert found.std == pytest.approx(0.1 / (3.0 / 2.2), rel=1e-3)
    assert scale_from_prior(maps(100, 0.1)).std == pytest.approx(found.std, rel=1e-9)


def test_scale_that_changes_from_map_to_map_is_as_uncertain() -> None:
    unlike = [maps(1, 1e-6, factor)[0] for factor in (1.6, 1.8, 2.0, 2.2, 2.4)]
    assert scale_from_prior(unlike).std == pytest.approx(1.4826 * 0.1, rel=1e-3)


def test_no_scale_from_maps_that_say_nothing() -> None:
    (inverse, depth, prior) = maps(1, 0.1)[0]
    assert scale_from_prior([]) is None
    assert scale_from_prior(maps(4, 0.75)) is None  # to more than a half
    assert scale_from_prior(maps(4, 0.6)) is not None
    assert scale_from_prior([(inverse[:4], depth[:4], prior)]) is None
    assert scale_from_prior([(0.0 * inverse, depth, prior)]) is None  # beyond infinity
    assert scale_from_prior([(inverse, depth, replace(prior, scale=-1.0))]) is None
