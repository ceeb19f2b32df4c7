"""Errors of trajectories and points against the truth, and the summaries in the paper's tables.

Poses are arrays: rotations `world_from_cam` (n, 3, 3) and camera centres (n, 3), NaN for unregistered frames. Lengths
are in the unit of the truth (metres), angles in degrees, shares in percent.

ATE: absolute trajectory error; T-RPE and R-RPE: translation and rotation part of the relative pose error.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factorsfm.support.errors import InputError
from factorsfm.support.parallax import parallax as path_parallax
from factorsfm.support.similarity import Similarity, align, check_trajectories, registered_frames

Array = NDArray[np.float64]

# Ends of the paper's recall curves: metres, metres, degrees.
ATE_THRESHOLDS = (0.002, 0.02)
T_RPE_THRESHOLDS = (0.001, 0.005)
R_RPE_THRESHOLDS = (0.02, 0.1)
RELATIVE_POSE_THRESHOLDS = (1.0, 5.0, 20.0)  # degrees

_EDGE_RATIO = 1.05  # largest over smallest true depth in 3 x 3 pixels, above which a point is left out


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors after similarity alignment; infinite for an unregistered frame, and for a pair that holds one.

    Attributes:
        ate: (n,) distance between the estimated and the true camera centre.
        t_rpe: (n - 1,) translation error of the motion from each frame to the next.
        r_rpe: (n - 1,) rotation error of the same motion, degrees.
        alignment: truth from estimate; None if no frame is registered.
    """

    ate: Array
    t_rpe: Array
    r_rpe: Array
    alignment: Similarity | None


def trajectory_errors(
    rotations: Array,
    centers: Array,
    true_rotations: Array,
    true_centers: Array,
    scale: float | None = None,
) -> TrajectoryErrors:
    """ATE per frame, and T-RPE and R-RPE per pair of consecutive frames.

    Args:
        rotations, true_rotations: (n, 3, 3) world_from_cam; NaN for unregistered frames.
        centers, true_centers: (n, 3); NaN for unregistered frames.
        scale: see `align`.

    Raises:
        InputError: the shapes do not agree, or the truth is not finite.
    """
    rotations, centers, true_rotations, true_centers = check_trajectories(
        rotations, centers, true_rotations, true_centers
    )
    n = len(centers)
    if not registered_frames(centers).any():
        pairs = max(n - 1, 0)
        return TrajectoryErrors(np.full(n, np.inf), np.full(pairs, np.inf), np.full(pairs, np.inf), None)
    alignment = align(rotations, centers, true_rotations, true_centers, scale)
    centers, rotations = alignment.points(centers), alignment.rotations(rotations)
    first, second = np.arange(n - 1), np.arange(1, n)
    rotation, translation = _relative(rotations, centers, first, second)
    true_rotation, true_translation = _relative(true_rotations, true_centers, first, second)
    return TrajectoryErrors(
        ate=_inf_where_missing(np.linalg.norm(centers - true_centers, axis=1)),
        t_rpe=_inf_where_missing(np.linalg.norm(translation - true_translation, axis=1)),
        r_rpe=_inf_where_missing(rotation_angle(rotation, true_rotation)),
        alignment=alignment,
    )


def rotation_angle(a: Array, b: Array) -> Array:
    """Angle (...) between rotations (..., 3, 3), degrees; from the chord, which is exact for small angles."""
    chord = np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(8.0)
    return np.asarray(np.degrees(2.0 * np.arcsin(np.clip(chord, 0.0, 1.0))))


def relative_pose_errors(rotations: Array, centers: Array, true_rotations: Array, true_centers: Array) -> Array:
    """Relative pose error of every pair of frames: the larger of the rotation and the translation direction error.

    It is 180 for a pair with an unregistered frame. If the true camera does not move between the two frames, only the
    rotation counts; if only the estimated camera does not move, the error is 180.

    Args:
        rotations, true_rotations: (n, 3, 3) world_from_cam; NaN for unregistered frames.
        centers, true_centers: (n, 3); NaN for unregistered frames.

    Returns:
        (n (n - 1) / 2,) degrees.

    Raises:
        InputError: the shapes do not agree, or the truth is not finite.
    """
    rotations, centers, true_rotations, true_centers = check_trajectories(
        rotations, centers, true_rotations, true_centers
    )
    first, second = np.triu_indices(len(centers), k=1)
    rotation, translation = _relative(rotations, centers, first, second)
    true_rotation, true_translation = _relative(true_rotations, true_centers, first, second)
    cross = np.linalg.norm(np.cross(translation, true_translation), axis=1)
    direction = np.degrees(np.arctan2(cross, np.sum(translation * true_translation, axis=1)))
    direction[~translation.any(axis=1)] = 180.0
    direction[~true_translation.any(axis=1)] = 0.0
    errors = np.maximum(rotation_angle(rotation, true_rotation), direction)
    return np.where(np.isfinite(errors), errors, 180.0)


def auc(errors: ArrayLike, threshold: float) -> float:
    """Area under the recall curve from 0 to the threshold, in percent of the full area.

    The recall curve is a step function, so that its exact area is the mean of ``max(0, 1 - error / threshold)``.

    Raises:
        InputError: no errors, a NaN or negative one, or a threshold that is not positive.
    """
    checked = _check_errors(errors)
    if not threshold > 0:
        raise InputError(f"the threshold is {threshold}, expected a positive number")
    return float(100.0 * np.clip(1.0 - checked / threshold, 0.0, None).mean())


def recall_curve(errors: ArrayLike, thresholds: ArrayLike) -> Array:
    """(k,) percent of the errors that do not exceed each of k thresholds.

    Raises:
        InputError: no errors, or a NaN or negative one.
    """
    checked = np.sort(_check_errors(errors))
    return np.asarray(100.0 * np.searchsorted(checked, thresholds, side="right") / len(checked))


def parallax(centers: Array, depths: ArrayLike) -> float:
    """Largest distance of a camera from the first registered one over the median depth of the points, as in the paper.

    Args:
        centers: (n, 3) in the unit of the depths; NaN for unregistered frames.
        depths: (m,) z-depths of the points in the cameras; NaN and negative ones do not count.

    Raises:
        InputError: no registered frame, or no depth.
    """
    known = np.asarray(centers, np.float64)
    known = known[registered_frames(known)]
    z = np.asarray(depths, np.float64).ravel()
    z = z[np.isfinite(z) & (z > 0)]
    if not len(known) or not len(z):
        raise InputError(f"parallax needs cameras and depths: {len(known)} cameras, {len(z)} depths given")
    return path_parallax(known, 1.0 / z)


@dataclass(frozen=True, slots=True)
class DepthErrors:
    """Estimated and true depths of m points.

    Attributes:
        estimate: (m,) estimated depths in the unit of the truth.
        truth: (m,) true depths; NaN where there is none, and at depth edges.
    """

    estimate: Array
    truth: Array

    @property
    def ratio(self) -> Array:
        """(m,) ``max(d / d*, d* / d)``; infinite for points behind the camera, NaN without truth."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.maximum(self.estimate / self.truth, self.truth / self.estimate)
        return np.where(self.estimate > 0, ratio, np.where(np.isnan(self.truth), np.nan, np.inf))

    @property
    def absolute(self) -> Array:
        """(m,) ``|d - d*|``, NaN without truth."""
        return np.asarray(np.abs(self.estimate - self.truth))

    @property
    def relative(self) -> Array:
        """(m,) ``|d - d*| / d*``, NaN without truth."""
        return np.asarray(self.absolute / self.truth)

    @staticmethod
    def pool(parts: Iterable[DepthErrors]) -> DepthErrors:
        """The errors of several images or shots together."""
        kept = list(parts)
        none = [np.empty(0)]
        return DepthErrors(
            np.concatenate([p.estimate for p in kept] or none),
            np.concatenate([p.truth for p in kept] or none),
        )

    def summary(self) -> dict[str, float]:
        """Shares of the points with truth, in percent, whose error is within bounds.

        Keys: ``delta<1.05`` to ``delta<1.05^3`` and ``delta<1.25`` to ``delta<1.25^3`` for the ratio; ``theta<1cm`` to
        ``theta<25cm`` for the absolute error, which must be in metres; ``within 5%`` for the relative error; and
        ``points`` for the number of points. Without points the shares are NaN.
        """
        has_truth = np.isfinite(self.truth)
        points = int(has_truth.sum())
        ratio, absolute = self.ratio[has_truth], self.absolute[has_truth]

        def share(inside: NDArray[np.bool_]) -> float:
            return float(100.0 * inside.mean()) if points else float("nan")

        result = {
            f"delta<{base}" + (f"^{power}" if power > 1 else ""): share(ratio < base**power)
            for base in (1.05, 1.25)
            for power in (1, 2, 3)
        }
        result |= {f"theta<{cm}cm": share(absolute < cm / 100.0) for cm in (1, 2, 5, 10, 25)}
        result["within 5%"] = share(self.relative[has_truth] < 0.05)
        result["points"] = points
        return result


def point_depth_errors(
    xy: Array, depths: Array, truth: NDArray[np.float32], image_size: Sequence[int], scale: float = 1.0
) -> DepthErrors:
    """Estimated and true depths of points in one image.

    The true depth is read at the nearest pixel of its map, which covers the image at any resolution. It is NaN for
    points outside the image, where the map has none, and where it varies by more than 5 % among 3 x 3 pixels.

    Args:
        xy: (m, 2) pixels, centres at integers.
        depths: (m,) z-depth in the camera, in units of the estimate.
        truth: (h, w) true z-depth; none where it is NaN or not positive.
        image_size: width and height of the image of `xy`.
        scale: truth units per estimate unit (`Similarity.scale`).

    Raises:
        InputError: the shapes do not agree.
    """
    xy, depths = np.asarray(xy, np.float64), np.asarray(depths, np.float64)
    if xy.shape != (*depths.shape, 2) or depths.ndim != 1:
        raise InputError(f"points {xy.shape} and depths {depths.shape} given, expected (m, 2) and (m,)")
    if truth.ndim != 2 or len(image_size) != 2:
        raise InputError(f"the depth map has the shape {truth.shape}, expected (h, w)")
    size = np.array([truth.shape[1], truth.shape[0]])
    pixels = np.full((len(xy), 2), -1)
    finite = np.isfinite(xy).all(axis=1)
    pixels[finite] = np.floor((xy[finite] + 0.5) * size / np.asarray(image_size))
    inside = ((pixels >= 0) & (pixels < size)).all(axis=1)
    found = np.full(len(depths), np.nan)
    x, y = pixels[inside].T
    found[inside] = _without_edges(truth)[y, x]
    return DepthErrors(scale * depths, found)


def _without_edges(truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """The depth map with NaN where it has no depth, and where it has a depth edge among 3 x 3 pixels."""
    valid = np.isfinite(truth) & (truth > 0)
    kernel = np.ones((3, 3), np.uint8)
    far = cv2.dilate(np.where(valid, truth, 0.0).astype(np.float32), kernel)
    near = cv2.erode(np.where(valid, truth, np.inf).astype(np.float32), kernel)
    return np.where(valid & (far / near <= _EDGE_RATIO), truth, np.nan).astype(np.float32)


def _relative(
    rotations: Array, centers: Array, first: NDArray[np.int64], second: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Rotations (k, 3, 3) and translations (k, 3) first_from_second of k pairs of poses world_from_cam."""
    inverse = rotations[first].transpose(0, 2, 1)
    return inverse @ rotations[second], np.einsum("nij,nj->ni", inverse, centers[second] - centers[first])


def _inf_where_missing(errors: Array) -> Array:
    return np.where(np.isnan(errors), np.inf, errors)


def _check_errors(errors: ArrayLike) -> Array:
    checked = np.asarray(errors, np.float64).ravel()
    if not checked.size or not (checked >= 0).all():
        raise InputError("errors must be numbers that are not negative, at least one, without NaN")
    return checked
