"""How certain a pose is when it is given."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from factorsfm.mapping.keyframes import suddenly_rough
from factorsfm.mapping.live_covariance import carried, live_covariance, window_covariance
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.support.rotations import exponential
from factorsfm.support.status import FrameStatus
from factorsfm.tracks.image_tracks import ImageTracks

CAMERA = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50.0, 50.0, 32.0, 24.0])
ORIGIN = exponential(np.array([[0.1, -0.3, 0.2]]))[0], np.array([0.3, -0.1, 0.5])
POSE = exponential(np.array([[-0.2, 0.4, 0.1]]))[0], np.array([-0.4, 0.2, 1.0])


def image(position: int, *, threshold: float = 3.0, inliers: int = 90, pose=POSE, covariance=None) -> MappedImage:
    tracks = ImageTracks(position, np.arange(100), np.zeros((100, 2)), CAMERA)
    return MappedImage(
        tracks,
        FrameStatus.REGISTERED,
        "",
        *pose,
        inliers=inliers,
        mapped=100,
        threshold=threshold,
        covariance=covariance,
    )


def perturbed(pose, step):
    """``world_from_cam`` perturbed on the right by a rotation vector and a translation."""
    rotation, translation = pose
    turn = exponential(step[None, :3])[0]
    return turn.T @ rotation, turn.T @ (translation - step[3:])


def step_between(pose, other):
    """The perturbation that takes a pose to another one, to first order."""
    turn = pose[0] @ other[0].T
    skew = 0.5 * (turn - turn.T)
    return np.r_[skew[2, 1], skew[0, 2], skew[1, 0], pose[1] - turn @ other[1]]


def test_what_moves_with_an_uncertain_pose_is_as_uncertain() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((6, 6)) * np.repeat([1e-4, 3e-4], 3)[:, None]
    steps = rng.standard_normal((4000, 6)) @ root.T
    turn = POSE[0] @ ORIGIN[0].T
    shift = POSE[1] - turn @ ORIGIN[1]
    moved = []
    for step in steps:
        rotation, translation = perturbed(ORIGIN, step)
        moved.append(step_between(POSE, (turn @ rotation, turn @ translation + shift)))
    expected = carried(root @ root.T, ORIGIN, POSE)
    ratio = np.linalg.solve(expected, np.cov(np.array(moved).T))
    assert np.abs(np.linalg.eigvals(ratio).real - 1.0).max() < 0.12


def test_the_uncertainty_of_constant_keyframes_is_that_of_what_hangs_on_them() -> None:
    given, held = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), 0.5 * np.eye(6)
    constant = [image(0, pose=ORIGIN), image(1, pose=ORIGIN, covariance=held)]
    found = window_covariance(POSE, given, constant)
    np.testing.assert_allclose(found - given, 0.5 * carried(held, ORIGIN, POSE), atol=1e-12)
    np.testing.assert_array_equal(window_covariance(POSE, given, constant[:1]), given)


@pytest.mark.parametrize(
    ("threshold", "inliers", "keyframes", "rough"),
    [
        (6.0, 50, 2, True),
        (6.0, 90, 2, False),
        (3.5, 50, 2, False),
        (6.0, 50, 1, False),
        (3.0, 70, 5, True),
        (3.0, 80, 5, False),
        (3.0, 70, 4, False),
    ],
)
def test_an_image_is_rough_where_fewer_tracks_agree_and_in_a_young_map_less_well(
    threshold: float, inliers: int, keyframes: int, rough: bool
) -> None:
    before = [image(k, threshold=9.0 if k < 2 else 3.0) for k in range(7)]
    assert suddenly_rough(image(7, threshold=threshold, inliers=inliers), before, keyframes) is rough


def test_a_map_that_stays_rough_is_rough_no_more() -> None:
    before = [image(k) for k in range(3)] + [image(k, threshold=6.0, inliers=50) for k in range(3, 8)]
    assert not suddenly_rough(image(8, threshold=6.0, inliers=50), before, 2)


def test_the_whole_step_of_a_rough_image_is_in_doubt() -> None:
    images = [image(0, pose=ORIGIN), image(1)]
    sure = live_covariance(images[1], 1e-6 * np.eye(6), images, [])
    images[1].rough = True
    doubted = live_covariance(images[1], 1e-6 * np.eye(6), images, [])
    turn = POSE[0] @ ORIGIN[0].T
    far = np.linalg.norm(POSE[1] - turn @ ORIGIN[1])
    assert np.sqrt(np.linalg.eigvalsh((doubted - sure)[3:, 3:])[-1]) == pytest.approx(far)
