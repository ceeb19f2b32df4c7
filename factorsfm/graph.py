"""The incremental factor graph: keyframes, landmarks and prior affines in iSAM2, updated as transactions."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, T, X
from numpy.typing import NDArray

from factorsfm.factors import (
    affine_of_native,
    camera_from_pose,
    native_affine,
    native_affine_noise,
    native_depth_factor,
    pose_from_camera,
    virtual_offset,
)
from factorsfm.registration import KNOWN_SHIFT_SIGMA, SCALE_SIGMA, SHIFT_SIGMA

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_LANDMARK_SIGMA = 1.0  # weak prior of every landmark, in units of its depth: keeps the system determined
_ROBUST_KERNEL = 2.0


@dataclass(frozen=True, slots=True)
class DepthMeasurements:
    """Prior values of a keyframe: track ids, inverse depths, standard deviations, first guess of the affine.

    `free_shift` is False where the prior knows its zero (depth, metric depth).
    """

    ids: Index
    inverse_depth: Array
    sigma: Array
    affine: tuple[float, float]
    free_shift: bool = True


@dataclass(frozen=True, slots=True)
class Keyframe:
    """What enters the graph with a keyframe.

    Attributes:
        position: identity of the keyframe.
        rotation, translation: `cam_from_world`, first guess.
        ids, xy: tracks that are landmarks, and their undistorted normalised observations.
        depth: prior at some of them.
    """

    position: int
    rotation: Array
    translation: Array
    ids: Index
    xy: Array
    depth: DepthMeasurements | None = None


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """Outcome of an update: committed or rolled back, and why."""

    committed: bool
    reason: str


class FactorGraph:
    """Poses X(position), landmarks L(track), prior affines A(position) in one iSAM2.

    Every update runs on a copy and is committed only if the result is finite, in front of the cameras and not mirrored;
    a failed iSAM2 object is never used again.
    """

    def __init__(self, focal: float, pixel_sigma: float) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(0.003)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._isam = gtsam.ISAM2(parameters)
        self._calibration = gtsam.Cal3_S2(focal, focal, 0.0, 0.0, 0.0)
        self._focal = focal
        robust = gtsam.noiseModel.mEstimator.Cauchy.Create(_ROBUST_KERNEL)
        self._pixel_noise = gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Isotropic.Sigma(2, pixel_sigma))
        self._robust = robust
        self._estimate = gtsam.Values()
        self.landmarks: Index = np.zeros(0, np.int64)
        self.keyframes: list[int] = []
        self._has_offset = False

    def update(
        self,
        keyframe: Keyframe,
        new_ids: Index,
        new_points: Array,
        earlier: list[tuple[int, Index, Array]],
    ) -> UpdateResult:
        """Add a keyframe and new landmarks.

        Args:
            new_ids, new_points: landmarks that the graph does not know yet, with their first position.
            earlier: observations of the new landmarks in earlier keyframes: (position, ids, normalised xy).
        """
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = pose_from_camera(keyframe.rotation, keyframe.translation)
        values.insert(X(keyframe.position), pose)
        if not self.keyframes:
            graph.add(gtsam.PriorFactorPose3(X(keyframe.position), pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-5)))
        distance = np.linalg.norm(new_points, axis=1)
        for track, point, length in zip(new_ids.tolist(), new_points, distance.tolist(), strict=True):
            values.insert(L(track), point)
            noise = gtsam.noiseModel.Isotropic.Sigma(3, _LANDMARK_SIGMA * max(length, 1e-3))
            graph.add(gtsam.PriorFactorPoint3(L(track), point, noise))
        for position, ids, xy in [*earlier, (keyframe.position, keyframe.ids, keyframe.xy)]:
            for track, pixel in zip(ids.tolist(), xy * self._focal, strict=True):
                graph.add(
                    gtsam.GenericProjectionFactorCal3_S2(
                        pixel, self._pixel_noise, X(position), L(track), self._calibration
                    )
                )
        if keyframe.depth is not None:
            self._add_depth(graph, values, keyframe.position, keyframe.depth)
        return self._commit(graph, values, keyframe, new_ids)

    def _add_depth(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, position: int, depth: DepthMeasurements
    ) -> None:
        if not self._has_offset:
            values.insert(T(0), virtual_offset())
            graph.add(gtsam.PriorFactorPose3(T(0), virtual_offset(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-8)))
        scale, shift = depth.affine
        values.insert(A(position), native_affine(scale, shift))
        shift_sigma = SHIFT_SIGMA if depth.free_shift else KNOWN_SHIFT_SIGMA
        center = float(np.median(depth.inverse_depth))
        graph.add(
            gtsam.PriorFactorCal3_S2(
                A(position),
                native_affine(scale, 0.0),
                native_affine_noise(SCALE_SIGMA * scale, shift_sigma * center),
            )
        )
        for track, value, sigma in zip(
            depth.ids.tolist(), depth.inverse_depth.tolist(), depth.sigma.tolist(), strict=True
        ):
            noise = gtsam.noiseModel.Robust.Create(
                self._robust, gtsam.noiseModel.Diagonal.Sigmas(np.array([sigma, 1e6]))
            )
            graph.add(native_depth_factor(X(position), T(0), L(track), A(position), value, noise))

    def _commit(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keyframe: Keyframe, new_ids: Index
    ) -> UpdateResult:
        trial = gtsam.ISAM2(self._isam)
        try:
            trial.update(graph, values)
            trial.update()  # a second relinearisation: translations are millimetres, the first step is long
            estimate = trial.calculateEstimate()
        except Exception as error:  # gtsam raises several types; any of them leaves the trial unusable
            logger.warning("update at frame %d rolled back: %s", keyframe.position, str(error).strip().split("\n")[0])
            return UpdateResult(False, "the linear system of the update is indeterminate")
        reason = self._fault(estimate, keyframe)
        if reason:
            logger.warning("update at frame %d rolled back: %s", keyframe.position, reason)
            return UpdateResult(False, reason)
        self._isam, self._estimate = trial, estimate
        self.landmarks = np.union1d(self.landmarks, new_ids)
        self.keyframes.append(keyframe.position)
        self._has_offset |= keyframe.depth is not None
        return UpdateResult(True, "committed")

    def _fault(self, estimate: gtsam.Values, keyframe: Keyframe) -> str:
        """What speaks against a result; empty if nothing does."""
        rotation, translation = camera_from_pose(estimate.atPose3(X(keyframe.position)))
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            return "the pose is not finite"
        if not len(keyframe.ids):
            return "the keyframe observes no landmark"
        points = np.array([estimate.atPoint3(L(track)) for track in keyframe.ids.tolist()]).reshape(-1, 3)
        q = points @ rotation.T + translation
        front = q[:, 2] > 1e-6
        if front.mean() < 0.7:
            return f"{int((~front).sum())} of {len(front)} landmarks lie behind the camera"
        error = np.linalg.norm(q[front, :2] / q[front, 2:] - keyframe.xy[front], axis=1) * self._focal
        if np.median(error) > 10.0:
            return f"the median reprojection error is {np.median(error):.1f} pixels, at most 10 expected"
        if keyframe.depth is not None and affine_of_native(estimate.atCal3_S2(A(keyframe.position)))[0] <= 0.0:
            return "the depth is mirrored: the prior's scale is negative"
        return ""

    def poses(self) -> dict[int, tuple[Array, Array]]:
        """`cam_from_world` of every keyframe."""
        return {k: camera_from_pose(self._estimate.atPose3(X(k))) for k in self.keyframes}

    def points(self) -> tuple[Index, Array]:
        """Track ids (ascending) and positions (n, 3) of the landmarks."""
        return self.landmarks, np.asarray(gtsam.utilities.extractPoint3(self._estimate)).reshape(-1, 3)

    def affine(self, position: int) -> tuple[float, float] | None:
        """Scale and shift of a keyframe's prior, None where it has none."""
        if not self._estimate.exists(A(position)):
            return None
        return affine_of_native(self._estimate.atCal3_S2(A(position)))
