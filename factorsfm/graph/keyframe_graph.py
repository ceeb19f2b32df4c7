"""The live factor graph: keyframe poses, landmarks and prior affines as variables of one persistent iSAM2.

Variables are ``X(i)``, the pose (`world_from_cam`) of the keyframe at position i of the shot; ``L(j)``, the landmark of
track j; ``A(i)``, scale and shift of that keyframe's depth prior. A keyframe that leaves the window becomes a constant:
its projections are replaced by factors on the landmarks alone, so that an update costs the same however long the shot.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, T, X
from numpy.typing import NDArray

from factorsfm.graph.factors import (
    affine_of_native,
    affine_prior,
    camera_from_pose,
    constant_projection_factor,
    depth_noise,
    landmark_prior,
    native_affine,
    native_depth_factor,
    pixel_noise,
    pose_from_camera,
    pose_prior,
    projection_factor,
    virtual_offset,
)
from factorsfm.graph.slots import Slots
from factorsfm.graph.window import Window

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

YOUNG = 7  # keyframes up to which the unit of length is free: the graph is built anew at every update, in a unit that
# keeps the length of the path, so that poses already given fit those to come
_LARGEST_ERROR_PX = 10.0  # median, of the newest keyframe
_LEAST_IN_FRONT = 0.7  # of the landmarks of the newest keyframe
_NOISE_CHANGE = 1.7  # factor by which the noise of the observations may differ from that of the graph
_FIXED, _FREE = 1e-6, 1e2  # standard deviations of what is held, and of what is not
_SIZE_SIGMA = 1e-4  # relative, of the distance that holds the unit of length
_LANDMARK_SIGMA, _FIRM_LANDMARK_SIGMA = 3.0, 0.3  # of the weak prior of a landmark, in units of its distance
_DEPTHS = 100  # depth factors of a keyframe, beside one for each landmark that has none yet: errors of a network repeat
_LANDMARK = ord("l")  # character of the symbols L
_MIRRORED = "the depth is mirrored: the scale of a prior is negative"


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """Outcome of an update: committed or rolled back, and why.

    Attributes:
        window: with the values after the update, or as it was.
        covariance: (6, 6) of each pose that is solved for, by position (`FrameResult.covariance`).
        mirrored: whether it was rolled back because the solution and the prior are each other's mirror image.
    """

    committed: bool
    reason: str
    window: Window
    covariance: dict[int, Array] = field(default_factory=dict)
    mirrored: bool = False


class KeyframeGraph:
    """The graph of the keyframes of one map.

    Every update runs on a copy and is committed only if the result is finite, in front of the cameras and not
    mirrored; a failed iSAM2 object is never used again.
    """

    def __init__(self) -> None:
        self._live = _Live()

    def update(self, window: Window, iterations: int) -> UpdateResult:
        """Add what the graph does not know of the window, remove what has left it, and solve.

        Args:
            window: its first keyframe is the world, or constant; the newest is the last one.
            iterations: steps of iSAM2.
        """
        if not (window.frame == len(window.positions) - 1).any():
            return _rolled_back(window, "the keyframe observes no landmark")
        reason, trials = "", [self._live.copy()] if self._live.fits(window) else []
        # What is indeterminate from where the graph stands may not be so from the map, or with firmer landmarks.
        for live in (*trials, _Live(), _Live(landmark_sigma=_FIRM_LANDMARK_SIGMA)):
            try:
                solved = live.update(window, iterations)
                reason = _fault(solved)
                if not reason:
                    covariance = live.covariances(solved)
                    self._live = live
                    return UpdateResult(True, "committed", solved, covariance)
                break
            except Exception as error:  # gtsam raises several types; any of them leaves the trial unusable
                message = (str(error).strip() or repr(error)).splitlines()[0]
                reason = f"the linear system of the update is indeterminate ({message})"
        return _rolled_back(window, reason)

    def contents(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """A copy of the factors, and the estimate."""
        return self._live.contents()


class _Live:
    """iSAM2 with the slots of its factors."""

    def __init__(self, landmark_sigma: float = _LANDMARK_SIGMA) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(0.0)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._isam = gtsam.ISAM2(parameters)
        self._projections, self._constants, self._depths = Slots(), Slots(), Slots()
        self._priors: dict[int, int] = {}  # slot by the key of the variable
        self._size: int | None = None  # slot of the distance that holds the unit of length
        self._landmark_sigma = landmark_sigma
        self._focal = self._sigma = 0.0

    def copy(self) -> _Live:
        """An independent copy."""
        copy = _Live(self._landmark_sigma)
        copy._isam = gtsam.ISAM2(self._isam)
        copy._projections, copy._constants = self._projections.copy(), self._constants.copy()
        copy._depths, copy._priors = self._depths.copy(), dict(self._priors)
        copy._size, copy._focal, copy._sigma = self._size, self._focal, self._sigma
        return copy

    def fits(self, window: Window) -> bool:
        """Whether the graph can go on, or must be built anew: for another focal length, noise or unit of length."""
        if len(window.positions) <= YOUNG and not window.constant.any():
            return False
        same = abs(window.focal / self._focal - 1.0) < 1e-9 if self._focal else False
        return same and 1.0 / _NOISE_CHANGE < window.sigma / self._sigma < _NOISE_CHANGE

    # --- one update -----------------------------------------------------------------------------------------------

    def update(self, window: Window, iterations: int) -> Window:
        """The window with its values after the update."""
        if not self._focal:
            self._focal, self._sigma = window.focal, window.sigma
        changes = _Changes()
        self._leave(window, changes)
        self._enter(window, changes)
        self._hold_size(window, changes)
        self._observe(window, changes)
        self._measure_depths(window, changes)
        last = self._eliminated_last(changes)
        result = self._isam.update(changes.graph, changes.values, changes.removed, last)
        changes.settle(np.array(result.getNewFactorsIndices(), np.int64))
        for _ in range(iterations - 1):
            self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], last)
        return self._solved(window)

    def _eliminated_last(self, changes: _Changes) -> gtsam.KeyGroupMap:
        """Poses and affines, after the landmarks.

        Left alone, iSAM2 eliminates all variables of new factors last, landmarks among them, which fills the tree.
        """
        groups = gtsam.KeyGroupMap()
        for key in {*self._priors, *changes.values.keys()}:
            if gtsam.symbolChr(key) != _LANDMARK:
                groups.insert2(key, 1)
        return groups

    def _leave(self, window: Window, changes: _Changes) -> None:
        """Landmarks and keyframes that are no variables any more, with their factors."""
        free = window.positions[~window.constant]
        for slots, keyframes in (
            (self._projections, free),
            (self._depths, free),
            (self._constants, window.positions[window.constant]),
        ):
            stay = np.isin(slots.keyframe, keyframes) & np.isin(slots.track, window.ids)
            changes.removed += slots.take(~stay).tolist()
        known = {int(key) for key in (*map(X, free.tolist()), *map(L, window.ids.tolist()), *map(A, free.tolist()))}
        for key in [key for key in self._priors if key not in known and key != T(0)]:
            changes.removed.append(self._priors.pop(key))
        if self._size is not None and window.constant.any():
            changes.removed.append(self._size)
            self._size = None

    def _enter(self, window: Window, changes: _Changes) -> None:
        """New keyframes and landmarks, each with a weak prior: few observations leave a lot open."""
        world = not window.constant.any()
        for row, position in enumerate(window.positions.tolist()):
            if not window.constant[row] and (key := X(position)) not in self._priors:
                pose = pose_from_camera(window.rotation[row], window.translation[row])
                self._add_variable(changes, key, pose, pose_prior(key, pose, _FIXED if world and row == 0 else _FREE))
        distance = np.linalg.norm(window.points, axis=1)
        for track, point, far in zip(window.ids.tolist(), window.points, distance.tolist(), strict=True):
            if (key := L(track)) not in self._priors:
                prior = landmark_prior(key, point, self._landmark_sigma * max(far, 1e-3))
                self._add_variable(changes, key, point, prior)

    def _add_variable(
        self, changes: _Changes, key: int, value: gtsam.Pose3 | gtsam.Cal3_S2 | Array, prior: gtsam.NonlinearFactor
    ) -> None:
        def told(slots: Index) -> None:
            self._priors[key] = int(slots[0])

        changes.values.insert(key, value)
        changes.add([prior], told)

    def _hold_size(self, window: Window, changes: _Changes) -> None:
        """Hold the unit of length by the distance of two keyframes, until constant ones hold it."""
        if self._size is not None or window.constant.any() or len(window.positions) <= YOUNG:
            return
        key, first = X(int(window.positions[-2])), X(int(window.positions[0]))
        centers = [-window.rotation[row].T @ window.translation[row] for row in (0, -2)]
        length = float(np.linalg.norm(centers[1] - centers[0]))
        noise = gtsam.noiseModel.Isotropic.Sigma(1, _SIZE_SIGMA * length + 1e-9)

        def told(slots: Index) -> None:
            self._size = int(slots[0])

        changes.add([gtsam.RangeFactorPose3(first, key, length, noise)], told)

    def _observe(self, window: Window, changes: _Changes) -> None:
        """Projection factors of new observations; those of constant keyframes are on the landmarks alone."""
        lens, noise = gtsam.Cal3_S2(window.focal, window.focal, 0.0, 0.0, 0.0), pixel_noise(self._sigma)
        keyframe, track, constant = (
            window.positions[window.frame],
            window.ids[window.point],
            window.constant[window.frame],
        )
        poses = {
            row: pose_from_camera(window.rotation[row], window.translation[row])
            for row in np.flatnonzero(window.constant)
        }
        cameras = {int(window.positions[row]): gtsam.PinholePoseCal3_S2(pose, lens) for row, pose in poses.items()}

        def factor(i: int, j: int, pixels: Array) -> gtsam.NonlinearFactor:
            if i in cameras:
                return constant_projection_factor(cameras[i], pixels, noise, L(j))
            return projection_factor(pixels, noise, X(i), L(j), lens)

        for slots, kind in ((self._projections, ~constant), (self._constants, constant)):
            rows = np.flatnonzero(kind)
            rows = rows[slots.missing(keyframe[rows], track[rows])]
            measured = zip(keyframe[rows].tolist(), track[rows].tolist(), window.pixels[rows], strict=True)
            changes.add(
                (factor(*measurement) for measurement in measured), partial(slots.add, keyframe[rows], track[rows])
            )

    def _measure_depths(self, window: Window, changes: _Changes) -> None:
        """Depth-consistency factors: of every landmark at least one, of every keyframe a number well spread."""
        d = window.depths
        if d is None:
            return
        free = ~window.constant[d.image]
        for row in np.flatnonzero(free).tolist():
            if (key := A(int(window.positions[d.image[row]]))) not in self._priors:
                value = native_affine(float(d.scale[row]), float(d.shift[row]))
                prior = affine_prior(key, 1.0, 0.0, d.scale_sigma, d.shift_sigma)
                self._add_variable(changes, key, value, prior)
        if T(0) not in self._priors:
            self._add_variable(changes, T(0), virtual_offset(), pose_prior(T(0), virtual_offset(), _FIXED))
        rows = self._chosen_depths(window)
        keyframe, track = window.positions[d.image[d.row[rows]]], window.ids[d.point[rows]]
        measured = zip(
            keyframe.tolist(), track.tolist(), d.inverse_depth[rows].tolist(), d.sigma[rows].tolist(), strict=True
        )
        factors = (
            native_depth_factor(X(i), T(0), L(j), A(i), value, depth_noise(sigma)) for i, j, value, sigma in measured
        )
        changes.add(factors, partial(self._depths.add, keyframe, track))

    def _chosen_depths(self, window: Window) -> Index:
        """Rows of the values of the prior that become factors now."""
        d = window.depths
        assert d is not None
        chosen: list[Index] = []
        covered = np.isin(window.ids, self._depths.track)
        for row in np.flatnonzero(~window.constant[d.image]).tolist():
            position = window.positions[d.image[row]]
            mine = np.flatnonzero(d.row == row)
            first = ~covered[d.point[mine]]
            others = mine[~first]
            chosen_before = bool((self._depths.keyframe == position).any())
            room = 0 if chosen_before else max(0, _DEPTHS - int(first.sum()))
            step = max(1, len(others) // room) if room else len(others) + 1
            chosen.append(np.concatenate([mine[first], others[::step][:room]]))
            covered[d.point[chosen[-1]]] = True
        return np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.int64)

    # --- values ---------------------------------------------------------------------------------------------------

    def _solved(self, window: Window) -> Window:
        estimate = self._isam.calculateEstimate()
        rotation, translation = window.rotation.copy(), window.translation.copy()
        for row in np.flatnonzero(~window.constant).tolist():
            rotation[row], translation[row] = camera_from_pose(estimate.atPose3(X(int(window.positions[row]))))
        points = np.array([estimate.atPoint3(L(track)) for track in window.ids.tolist()])
        depths = window.depths
        if depths is not None:
            scale, shift = depths.scale.copy(), depths.shift.copy()
            for row, position in enumerate(window.positions[depths.image].tolist()):
                if A(position) in self._priors:
                    scale[row], shift[row] = affine_of_native(estimate.atCal3_S2(A(position)))
            depths = replace(depths, scale=scale, shift=shift)
        return replace(window, rotation=rotation, translation=translation, points=points, depths=depths)

    def contents(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """A copy of the factors, and the estimate."""
        slots, graph = self._isam.getFactorsUnsafe(), gtsam.NonlinearFactorGraph()
        for slot in range(slots.size()):
            if slots.exists(slot):
                graph.add(slots.at(slot))
        return graph, self._isam.calculateEstimate()

    def covariances(self, window: Window) -> dict[int, Array]:
        """(6, 6) of each pose that is solved for, by position."""
        solved = window.positions[window.solved].tolist()
        return {position: np.asarray(self._isam.marginalCovariance(X(position))) for position in solved}


class _Changes:
    """What an update adds to iSAM2 and removes from it, and who wants to know the slots of what is added."""

    def __init__(self) -> None:
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.removed: list[int] = []
        self._added: list[tuple[int, Callable[[Index], None]]] = []  # end among the new factors, and who is told

    def add(self, factors: Iterable[gtsam.NonlinearFactor], told: Callable[[Index], None]) -> None:
        """Add factors; `told` is called with their slots after the update."""
        for factor in factors:
            self.graph.add(factor)
        self._added.append((self.graph.size(), told))

    def settle(self, slots: Index) -> None:
        """After the update: the slots of the new factors, in the order in which they were added."""
        begin = 0
        for end, told in self._added:
            told(slots[begin:end])
            begin = end


def _rolled_back(window: Window, reason: str) -> UpdateResult:
    logger.warning("update at frame %d rolled back: %s", window.positions[-1], reason)
    return UpdateResult(False, reason, window, mirrored=reason == _MIRRORED)


def _fault(window: Window) -> str:
    """What speaks against a result, judged at its newest keyframe; empty if nothing does."""
    if not (np.isfinite(window.rotation).all() and np.isfinite(window.translation).all()):
        return "the pose is not finite"
    newest = window.frame == len(window.positions) - 1
    errors, depth = (values[newest] for values in window.reprojection())
    front = depth > 1e-6
    if front.mean() < _LEAST_IN_FRONT:
        return f"{int((~front).sum())} of {len(front)} landmarks lie behind the camera"
    error = float(np.median(errors))
    if not error < _LARGEST_ERROR_PX:
        return f"the median reprojection error is {error:.1f} pixels, at most {_LARGEST_ERROR_PX:.0f} expected"
    if window.depths is not None and (window.depths.scale <= 0.0).any():
        return _MIRRORED
    return ""
