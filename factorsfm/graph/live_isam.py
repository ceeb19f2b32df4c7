"""iSAM2 with the variables and factors of a window, and the slot of each factor."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, K, L, T, X
from numpy.typing import NDArray

from factorsfm.graph.added_factors import AddedFactors, held_prior
from factorsfm.graph.changes import Changes
from factorsfm.graph.factors import (
    HELD,
    affine_of_native,
    affine_prior,
    camera_from_pose,
    constant_projection_factor,
    depth_noise,
    landmark_prior,
    lens_of,
    lens_prior,
    lens_projection_factor,
    native_affine,
    native_depth_factor,
    pixel_noise,
    pose_from_camera,
    pose_prior,
    projection_factor,
    virtual_offset,
)
from factorsfm.graph.keys import part_of
from factorsfm.graph.slots import Slots
from factorsfm.graph.window import Window

Array = NDArray[np.float64]
Index = NDArray[np.int64]

YOUNG = 7  # keyframes up to which the unit of length is free: the graph is built anew at every update, in a unit that
# keeps the length of the path, so that poses already given fit those to come
_NOISE_CHANGE = 1.7  # factor by which the noise of the observations may differ from that of the graph
_FREE = 1e2  # standard deviation of what is not held
_SIZE_SIGMA = 1e-4  # relative, of the distance that holds the unit of length
LANDMARK_SIGMA = 3.0  # of the weak prior of a landmark, in units of its distance
_DEPTHS = 100  # depth factors of a keyframe, beside one for each landmark that has none yet: errors of a network repeat
_FREE_LENS = 0.3  # relative standard deviation of a focal length that is estimated
_LANDMARK = ord("l")  # character of the symbols L


class LiveIsam:
    """iSAM2 with the slots of its factors."""

    def __init__(self, landmark_sigma: float = LANDMARK_SIGMA) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(0.0)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._isam = gtsam.ISAM2(parameters)
        self._projections, self._constants, self._depths = Slots(), Slots(), Slots()
        self._priors: dict[int, int] = {}  # slot by the key of the variable
        self._held: set[int] = set()  # keys of the variables that are constant
        self._added: dict[int, int] = {}  # slot by the number of the caller's factor
        self._own: set[int] = set()  # keys of the caller's variables
        self._constant_poses: dict[int, gtsam.Pose3] = {}  # of the constant keyframes, by index
        self._size: int | None = None  # slot of the distance that holds the unit of length
        self._landmark_sigma = landmark_sigma
        self._focal = self._sigma = self._unit = 0.0
        self.free_lens = False  # whether the focal length is estimated

    def copy(self) -> LiveIsam:
        """An independent copy."""
        copy = LiveIsam(self._landmark_sigma)
        copy._isam = gtsam.ISAM2(self._isam)
        copy._projections, copy._constants = self._projections.copy(), self._constants.copy()
        copy._depths, copy._priors = self._depths.copy(), dict(self._priors)
        copy._held, copy._added, copy._own = set(self._held), dict(self._added), set(self._own)
        copy._constant_poses = dict(self._constant_poses)
        copy._size, copy._focal, copy._sigma, copy._unit = self._size, self._focal, self._sigma, self._unit
        copy.free_lens = self.free_lens
        return copy

    def fits(self, window: Window) -> bool:
        """Whether the graph can go on, or must be built anew: for another focal length, noise or unit of length."""
        if len(window.keyframes) <= YOUNG and not window.constant.any():
            return False
        same = window.unit == self._unit and abs(window.focal / self._focal - 1.0) < 1e-9
        return same and 1.0 / _NOISE_CHANGE < window.sigma / self._sigma < _NOISE_CHANGE

    # --- one update -----------------------------------------------------------------------------------------------

    def update(self, window: Window, iterations: int, added: AddedFactors, constants: gtsam.Values) -> Window:
        """The window with its values after the update.

        Args:
            added: the caller's factors; constants: values of the variables that these name besides those of the window.
        """
        if not self._focal:
            self._focal, self._sigma, self._unit = window.focal, window.sigma, window.unit
        changes = Changes()
        self._leave(window, changes, added, constants)
        self._enter(window, changes)
        self._hold(window, changes, constants)
        self._hold_size(window, changes)
        self._observe(window, changes)
        self._measure_depths(window, changes)
        self._add(changes, added)
        last = self._apply(changes)
        for _ in range(iterations - 1):
            self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], last)
        return self.solved(window)

    def _apply(self, changes: Changes) -> gtsam.KeyGroupMap:
        """One step of iSAM2, with what changes; what it eliminates last."""
        last = self._eliminated_last(changes)
        result = self._isam.update(changes.graph, changes.values, changes.removed, last)
        changes.settle(np.array(result.getNewFactorsIndices(), np.int64))
        return last

    def step_with_free_lens(self) -> None:
        """Estimate the focal length from here on, and make a step."""
        self.free_lens = True
        focal = self.estimated_focal()
        self._set_lens_prior(focal, _FREE_LENS * focal)

    def step_with_held_lens(self, focal: float) -> None:
        """Hold another focal length (pixels), and make a step."""
        self._set_lens_prior(focal, HELD)

    def _set_lens_prior(self, focal: float, sigma: float) -> None:
        key, changes = K(0), Changes()
        changes.removed.append(self._priors[key])
        changes.add([lens_prior(key, focal, sigma)], partial(self._note_prior, key))
        self._apply(changes)

    def _eliminated_last(self, changes: Changes) -> gtsam.KeyGroupMap:
        """Poses and affines, after the landmarks.

        Left alone, iSAM2 eliminates all variables of new factors last, landmarks among them, which fills the tree.
        """
        groups = gtsam.KeyGroupMap()
        for key in {*self._priors, *self._own, *changes.values.keys()}:
            if gtsam.symbolChr(key) != _LANDMARK:
                groups.insert2(key, 1)
        return groups

    def _leave(self, window: Window, changes: Changes, added: AddedFactors, constants: gtsam.Values) -> None:
        """Landmarks, keyframes and factors of the caller that are in the graph no more, with their factors."""
        free = window.keyframes[~window.constant]
        seen = window.keyframes if window.unknown_lens else free
        for slots, keyframes in (
            (self._projections, seen),
            (self._depths, free),
            (self._constants, window.keyframes[window.constant]),
        ):
            stay = np.isin(slots.keyframe, keyframes) & np.isin(slots.track, window.ids)
            changes.removed += slots.take(~stay).tolist()
        known = {
            *map(X, seen.tolist()),
            *map(L, window.ids.tolist()),
            *map(A, free.tolist()),
            *constants.keys(),
            T(0),
            K(0),
        }
        for key in [key for key in self._priors if key not in known]:
            changes.removed.append(self._priors.pop(key))
            self._held.discard(key)
        if self._size is not None and (window.constant.any() or window.unit_held):
            changes.removed.append(self._size)
            self._size = None
        for number in [number for number in self._added if number not in added.numbers]:
            changes.removed.append(self._added.pop(number))

    def _enter(self, window: Window, changes: Changes) -> None:
        """New keyframes and landmarks, each with a weak prior: few observations leave a lot open."""
        world = not window.constant.any()
        for row, keyframe in enumerate(window.keyframes.tolist()):
            if not window.constant[row] and (key := X(keyframe)) not in self._priors:
                pose = pose_from_camera(window.rotation[row], window.translation[row])
                self._add_variable(changes, key, pose, pose_prior(key, pose, HELD if world and row == 0 else _FREE))
        distance = np.linalg.norm(window.points, axis=1)
        for track, point, far in zip(window.ids.tolist(), window.points, distance.tolist(), strict=True):
            if (key := L(track)) not in self._priors:
                prior = landmark_prior(key, point, self._landmark_sigma * max(far, 1e-3))
                self._add_variable(changes, key, point, prior)
        if window.unknown_lens and (key := K(0)) not in self._priors:
            lens = lens_of(self._focal)
            self._add_variable(changes, key, lens, lens_prior(key, self._focal, HELD))

    def _hold(self, window: Window, changes: Changes, constants: gtsam.Values) -> None:
        """What does not change, but is named by factors: the caller's, or those on an unknown lens."""
        held = gtsam.Values(constants)
        if window.unknown_lens:
            for row in np.flatnonzero(window.constant).tolist():
                pose = pose_from_camera(window.rotation[row], window.translation[row])
                held.insert_or_assign(X(int(window.keyframes[row])), pose)
        for key in [key for key in list(held.keys()) if key not in self._held]:
            self._held.add(key)
            if key in self._priors:  # it was free before
                changes.removed.append(self._priors[key])
            else:
                changes.values.insert(part_of(held, [key]))
            changes.add([held_prior(key, held)], partial(self._note_prior, key))

    def _add(self, changes: Changes, added: AddedFactors) -> None:
        """New factors of the caller, and the variables of their own."""
        if not added.numbers and not self._own:
            return
        graph, own = added.graph(), added.values()
        changes.values.insert(part_of(own, set(own.keys()) - self._own))
        self._own = set(own.keys())
        rows = [row for row, number in enumerate(added.numbers) if number not in self._added]
        numbers = [added.numbers[row] for row in rows]

        def told(slots: Index) -> None:
            self._added.update(zip(numbers, slots.tolist(), strict=True))

        changes.add((graph.at(row) for row in rows), told)

    def _add_variable(
        self, changes: Changes, key: int, value: gtsam.Pose3 | gtsam.Cal3_S2 | Array, prior: gtsam.NonlinearFactor
    ) -> None:
        changes.values.insert(key, value)
        changes.add([prior], partial(self._note_prior, key))

    def _note_prior(self, key: int, slots: Index) -> None:
        self._priors[key] = int(slots[0])

    def _hold_size(self, window: Window, changes: Changes) -> None:
        """Hold the unit of length by the distance of two keyframes, until constant ones hold it."""
        if window.unit_held or self._size is not None or window.constant.any() or len(window.keyframes) <= YOUNG:
            return
        key, first = X(int(window.keyframes[-2])), X(int(window.keyframes[0]))
        centers = [-window.rotation[row].T @ window.translation[row] for row in (0, -2)]
        length = float(np.linalg.norm(centers[1] - centers[0]))
        noise = gtsam.noiseModel.Isotropic.Sigma(1, _SIZE_SIGMA * length + 1e-9)

        def told(slots: Index) -> None:
            self._size = int(slots[0])

        changes.add([gtsam.RangeFactorPose3(first, key, length, noise)], told)

    def _observe(self, window: Window, changes: Changes) -> None:
        """Projection factors of new observations; those of constant keyframes are on the landmarks alone."""
        lens, noise = lens_of(window.focal), pixel_noise(self._sigma)
        keyframe, track, constant = (
            window.keyframes[window.frame],
            window.ids[window.point],
            window.constant[window.frame],
        )
        poses = {
            row: pose_from_camera(window.rotation[row], window.translation[row])
            for row in np.flatnonzero(window.constant)
        }
        self._constant_poses = {int(window.keyframes[row]): pose for row, pose in poses.items()}
        cameras = {i: gtsam.PinholePoseCal3_S2(pose, lens) for i, pose in self._constant_poses.items()}
        if window.unknown_lens:
            constant = np.zeros_like(constant)

        def factor(i: int, j: int, pixels: Array) -> gtsam.NonlinearFactor:
            if window.unknown_lens:
                return lens_projection_factor(pixels, noise, X(i), L(j), K(0))
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

    def _measure_depths(self, window: Window, changes: Changes) -> None:
        """Depth-consistency factors: of every landmark at least one, of every keyframe a number well spread."""
        d = window.depths
        if d is None:
            return
        free = ~window.constant[d.image]
        for row in np.flatnonzero(free).tolist():
            if (key := A(int(window.keyframes[d.image[row]]))) not in self._priors:
                value = native_affine(float(d.scale[row]), float(d.shift[row]))
                prior = affine_prior(key, window.unit, 0.0, window.unit * d.scale_sigma, d.shift_sigma)
                self._add_variable(changes, key, value, prior)
        if T(0) not in self._priors:
            self._add_variable(changes, T(0), virtual_offset(), pose_prior(T(0), virtual_offset(), HELD))
        rows = self._chosen_depths(window)
        keyframe, track = window.keyframes[d.image[d.row[rows]]], window.ids[d.point[rows]]
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
            image = window.keyframes[d.image[row]]
            mine = np.flatnonzero(d.row == row)
            first = ~covered[d.point[mine]]
            others = mine[~first]
            chosen_before = bool((self._depths.keyframe == image).any())
            room = 0 if chosen_before else max(0, _DEPTHS - int(first.sum()))
            step = max(1, len(others) // room) if room else len(others) + 1
            chosen.append(np.concatenate([mine[first], others[::step][:room]]))
            covered[d.point[chosen[-1]]] = True
        return np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.int64)

    # --- values ---------------------------------------------------------------------------------------------------

    def solved(self, window: Window) -> Window:
        """The window with the values as they are estimated now."""
        estimate = self.estimate()
        rotation, translation = window.rotation.copy(), window.translation.copy()
        for row in np.flatnonzero(~window.constant).tolist():
            rotation[row], translation[row] = camera_from_pose(estimate.atPose3(X(int(window.keyframes[row]))))
        points = np.array([estimate.atPoint3(L(track)) for track in window.ids.tolist()])
        depths = window.depths
        if depths is not None:
            scale, shift = depths.scale.copy(), depths.shift.copy()
            for row, keyframe in enumerate(window.keyframes[depths.image].tolist()):
                if A(keyframe) in self._priors:
                    scale[row], shift[row] = affine_of_native(estimate.atCal3_S2(A(keyframe)))
            depths = replace(depths, scale=scale, shift=shift)
        focal = estimate.atCal3_S2(K(0)).fx() if self.free_lens else window.focal
        self._focal = focal
        return replace(window, rotation=rotation, translation=translation, points=points, depths=depths, focal=focal)

    def contents(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """A copy of the factors, and the estimate, constant keyframes among the variables.

        GTSAM has no text for the factors of constant cameras: the copy has the same projections on held poses.
        """
        slots, graph, values = self._isam.getFactorsUnsafe(), gtsam.NonlinearFactorGraph(), self.estimate()
        seen = dict(zip(self._constants.slot.tolist(), self._constants.keyframe.tolist(), strict=True))
        lens = lens_of(self._focal)
        for keyframe in sorted(set(seen.values())):
            if not values.exists(key := X(keyframe)):
                values.insert(key, self._constant_poses[keyframe])
                graph.add(held_prior(key, values))
        for slot in range(slots.size()):
            if not slots.exists(slot):
                continue
            factor = slots.at(slot)
            if slot in seen:
                landmark = factor.keys()[0]
                constant: Any = factor
                factor = projection_factor(constant.measured(), constant.noiseModel(), X(seen[slot]), landmark, lens)
            graph.add(factor)
        return graph, values

    def estimate(self) -> gtsam.Values:
        """Of all variables."""
        return self._isam.calculateEstimate()

    def estimated_focal(self) -> float:
        """Of an unknown lens, pixels."""
        return float(self.estimate().atCal3_S2(K(0)).fx())

    def focal_std(self) -> float:
        """Relative standard deviation of the focal length."""
        return float(np.sqrt(self._isam.marginalCovariance(K(0))[0, 0])) / self._focal

    def covariances(self, window: Window) -> dict[int, Array]:
        """(6, 6) of each pose that is solved for, by keyframe."""
        solved = window.keyframes[window.solved].tolist()
        return {keyframe: np.asarray(self._isam.marginalCovariance(X(keyframe))) for keyframe in solved}
