"""Registration of one image on the map: PnP, then robust refinement, with the depth prior where it is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.noise import block_inflation
from factorsfm.adjustment.residuals import camera_points, cauchy, projection_by_pose
from factorsfm.graph.factors import image_depth_factor, image_reprojection_factor
from factorsfm.graph.image_pose import AFFINE, POSE, solve_pose_and_affine
from factorsfm.priors.affine import fit_affine
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.semidefinite import covariance_of, solution

Array = NDArray[np.float64]

_KERNEL = 2.0  # Cauchy scale in standard deviations
_ALIGN_STEPS = 20  # at most
_NARROWINGS = 10  # of the kernel, at most
_SETTLED = 0.95  # ratio of the spread of the residuals to that before, above which the kernel narrows no more
_ROUGHLY, _FULLY = 1e-3, 1e-6  # relative decrease of the cost with which the alignment ends
_BEHIND = 1e3  # residual of a point behind the camera, standard deviations
_DEPTH_FLOOR = 0.03  # smallest believable relative error of a depth network


@dataclass(frozen=True, slots=True)
class Registration:
    """Pose of an image on the map.

    Attributes:
        rotation, translation: `cam_from_world`.
        inliers: (n,) which correspondences the pose explains.
        error: median reprojection error of the inliers (pixels).
        threshold: reprojection error up to which a correspondence is an inlier (pixels).
        covariance: (6, 6) of the pose on a map without error (`FrameResult.covariance`).
        affine: scale and shift (or gamma and beta) where depth took part.
    """

    rotation: Array
    translation: Array
    inliers: NDArray[np.bool_]
    error: float
    threshold: float
    covariance: Array
    affine: tuple[float, float] | None = None


def register_image(
    points: Array,
    observed: Array,
    rotation: Array,
    translation: Array,
    *,
    focal: float,
    sigma: float,
    inlier_px: float,
    depth: ImageDepth | None = None,
    domain: Literal["inverse", "depth"] = "inverse",
    depth_weight: float = 1.0,
) -> Registration:
    """Pose of an image from 3-D points, started at a nearby pose, or by PnP-RANSAC where that start fails.

    Paper, section 3.2: ``min over R, t, gamma, beta of sum E_PR + lambda E_DC`` with the points fixed.

    Args:
        points: (n, 3) world coordinates; observed: (n, 2) normalised; rotation, translation: first guess.
        focal: pixels; sigma: noise of a keypoint (pixels); inlier_px: see `MapperOptions`.
        depth: prior at the same n keypoints; with ``domain="depth"`` the paper's residual with lambda `depth_weight`.
    """
    result = _refine(points, observed, rotation, translation, focal, sigma, inlier_px)
    doubtful = result.inliers.mean() < 0.6 or result.threshold > inlier_px
    if doubtful and len(points) >= 6:
        start = _pnp_ransac(points, observed, focal, max(inlier_px, 2.0))
        if start is not None:
            other = _refine(points, observed, *start, focal, sigma, inlier_px)
            # Compared at the narrow threshold: a wide one counts what it was widened for.
            errors = [residuals(points, observed, r.rotation, r.translation, focal) for r in (result, other)]
            if (errors[1] < inlier_px).sum() > (errors[0] < inlier_px).sum():
                result = other
    if depth is None or not (use := result.inliers & depth.valid).sum() >= 10:
        return result
    return _refine_with_depth(result, points, observed, use, focal, sigma, depth, domain, depth_weight)


def residuals(points: Array, observed: Array, rotation: Array, translation: Array, focal: float) -> Array:
    """(n,) reprojection errors in pixels, infinite behind the camera; arguments as in `register_image`."""
    x, y, z = rotation @ points.T + translation[:, None]
    behind = z <= 1e-6
    z[behind] = 1.0
    error = focal * np.hypot(x / z - observed[:, 0], y / z - observed[:, 1])
    error[behind] = np.inf
    return np.asarray(error)


def _typical(error: Array) -> float:
    """What the median of the errors would be without outliers, which may be up to two thirds of them."""
    rank = int(0.3 * (len(error) - 1))
    return 1.39 * float(np.partition(error, rank)[rank])


def _spread(error: Array, sigma: float) -> float:
    """Width of a kernel that follows the errors, and no narrower than the noise of a keypoint, pixels."""
    return min(max(sigma, _typical(error)), 100.0 * sigma)


def inlier_threshold(error: Array, inlier_px: float) -> float:
    """Error (pixels) up to which an observation is an inlier among these: wider on a map that is not yet exact."""
    return max(inlier_px, min(4.0 * _typical(error), 8.0 * inlier_px))


def _turned(points: Array, observed: Array, rotation: Array, translation: Array, focal: float, sigma: float) -> Array:
    """Rotation with which most points are seen where they are, the camera's centre held.

    From one image to the next a camera turns by more pixels than it translates. A person before the scene is taken for
    parallax more easily than for a turn.
    """
    rows, center, spread = np.ascontiguousarray(points.T), -rotation.T @ translation, np.inf
    q, seen = rotation @ (rows - center[:, None]), focal * observed.T
    for _ in range(_NARROWINGS):
        before = spread
        front = q[2] > 1e-6
        prediction, by_pose = projection_by_pose(np.where(front, q, 1.0), focal)
        residual = prediction - seen
        residual[:, ~front] = _BEHIND
        error = np.hypot(*residual)
        spread = _spread(error, sigma)
        if spread > _SETTLED * before:
            break
        weight = front / (1.0 + (error / (_KERNEL * spread)) ** 2)
        jacobian = by_pose[:3].reshape(3, -1)
        weighted = (by_pose[:3] * weight).reshape(3, -1)
        normal = weighted @ jacobian.T
        step = solution(normal + 1e-9 * np.trace(normal) * np.eye(3), weighted @ residual.ravel())
        turn = cv2.Rodrigues(step)[0]
        rotation, q = turn @ rotation, turn @ q
    return rotation


def _align(
    points: Array,
    observed: Array,
    rotation: Array,
    translation: Array,
    focal: float,
    sigma: float,
    tolerance: float = _FULLY,
) -> tuple[Array, Array, Array]:
    """Minimum of `image_reprojection_factor` over the pose, in numpy: it is asked for several times a frame.

    Returns:
        Rotation, translation, and the information matrix of the pose.
    """
    rows, seen = np.ascontiguousarray(points.T), (focal / sigma) * observed.T
    damping, best = 1e-6, np.inf
    normal, gradient = np.eye(6), np.zeros(6)
    candidate = rotation, translation
    for _ in range(_ALIGN_STEPS):
        q = candidate[0] @ rows + candidate[1][:, None]
        behind = q[2] <= 1e-6
        q[2, behind] = 1.0
        prediction, by_pose = projection_by_pose(q, focal / sigma)
        residual = prediction - seen
        residual[:, behind], by_pose[:, :, behind] = _BEHIND, 0.0
        costs, weight = cauchy(residual.T, _KERNEL)
        cost = float(costs.sum())
        if cost < best:
            settled = best - cost < tolerance * cost
            rotation, translation = candidate
            best, damping = cost, damping / 10.0
            if settled:
                break
            jacobian, weighted = by_pose.reshape(6, -1), (by_pose * weight).reshape(6, -1)
            normal, gradient = weighted @ jacobian.T, weighted @ residual.ravel()
        else:
            damping = max(10.0 * damping, 1e-4)
        step = -solution(normal + damping * np.diag(normal.diagonal() + 1e-12), gradient)
        turn = cv2.Rodrigues(-step[:3])[0]
        candidate = turn @ rotation, turn @ (translation - step[3:])
    return rotation, translation, normal


def _refine(
    points: Array,
    observed: Array,
    rotation: Array,
    translation: Array,
    focal: float,
    sigma: float,
    inlier_px: float,
) -> Registration:
    """Robust pose; the kernel follows the spread of the residuals, since a young map is not yet exact.

    From far away it is wide, and lets what moves by itself draw the pose; so it narrows until the spread settles.
    """
    turned = _turned(points, observed, rotation, translation, focal, sigma)
    rotation, translation = turned, turned @ rotation.T @ translation
    error = residuals(points, observed, rotation, translation, focal)
    information, spread = np.eye(6), np.inf
    for _ in range(_NARROWINGS):
        before, spread = spread, _spread(error, sigma)
        settled = spread == sigma or spread > _SETTLED * before
        tolerance = _FULLY if settled else _ROUGHLY
        rotation, translation, information = _align(points, observed, rotation, translation, focal, spread, tolerance)
        error = residuals(points, observed, rotation, translation, focal)
        if settled:
            break
    threshold = inlier_threshold(error, inlier_px)
    inliers = error < threshold
    typical = float(np.median(error[inliers])) if inliers.any() else float("inf")
    covariance = covariance_of(information + 1e-9 * np.diag(information.diagonal() + 1e-12))
    if threshold > inlier_px and inliers.any():  # what is wrong then is not noise: errors of neighbours are alike
        q = points[inliers] @ rotation.T + translation
        vectors = focal * (q[:, :2] / q[:, 2:] - observed[inliers])
        covariance *= block_inflation(vectors, np.zeros(len(vectors), np.int64), observed[inliers])
    return Registration(rotation, translation, inliers, typical, threshold, covariance)


def _pnp_ransac(points: Array, observed: Array, focal: float, threshold_px: float) -> tuple[Array, Array] | None:
    """SQPnP in RANSAC (the iterative default of OpenCV 5 fails on some planar scenes)."""
    found, vector, translation, _ = cv2.solvePnPRansac(
        points, observed, np.eye(3), None,
        iterationsCount=300, reprojectionError=threshold_px / focal, confidence=0.999, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not found or not np.isfinite(vector).all() or not np.isfinite(translation).all():
        return None
    return cv2.Rodrigues(vector)[0], translation.ravel()


def _refine_with_depth(
    result: Registration,
    points: Array,
    observed: Array,
    use: NDArray[np.bool_],
    focal: float,
    sigma: float,
    depth: ImageDepth,
    domain: Literal["inverse", "depth"],
    depth_weight: float,
) -> Registration:
    q = camera_points(result.rotation, result.translation, points[use], np.ones(int(use.sum())))
    measured = depth.inverse_depth[use]
    if domain == "inverse":
        scale, shift, spread = fit_affine(1.0 / q[:, 2], measured, free_shift=depth.free_shift)
        # All keypoints together count as one measurement per cell of correlated error (see `prior_weight`).
        depth_sigma = np.full(len(measured), max(spread, _DEPTH_FLOOR) * np.sqrt(max(1.0, len(measured) / 100.0)))
    else:
        measured = 1.0 / measured
        scale, shift, _ = fit_affine(measured, q[:, 2])
        depth_sigma = np.full(len(measured), 1.0 / np.sqrt(depth_weight))
        sigma = 1.0  # the paper weighs pixels by one
    inliers = result.inliers
    reprojections = image_reprojection_factor(POSE, points[inliers], observed[inliers], focal, sigma, _KERNEL)
    depths = image_depth_factor(POSE, AFFINE, points[use], measured, depth_sigma, _KERNEL, domain=domain)
    rotation, translation, scale, shift = solve_pose_and_affine(
        [reprojections, depths], result.rotation, result.translation, scale, shift
    )
    error = residuals(points, observed, rotation, translation, focal)
    inliers = error < result.threshold
    if inliers.sum() < 0.8 * result.inliers.sum():
        return result
    return Registration(
        rotation,
        translation,
        inliers,
        float(np.median(error[inliers])),
        result.threshold,
        result.covariance,
        (scale, shift),
    )
