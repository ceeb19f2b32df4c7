"""From the free solution to the one under control: where the control's world is, then all of it in one adjustment."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.marginals import Marginals, in_scene_unit
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import Free, Known
from factorsfm.adjustment.state import State
from factorsfm.control.fit import ControlFit, ControlResidual
from factorsfm.control.known import KnownDistance, KnownHeight, KnownPose, LocatedControl
from factorsfm.control.residuals import (
    DATUM,
    ControlTerm,
    ControlView,
    DistanceItem,
    HeightItem,
    Item,
    MarkItem,
    Place,
    PositionItem,
    RotationItem,
)
from factorsfm.control.world_alignment import Correspondences, start_datum
from factorsfm.mapping.triangulation import triangulate
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.similarity import Similarity

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_KERNEL, _WIDE = 3.0, 1e6  # Cauchy scale of the control, standard deviations; and practically none
_CONTRADICTION = 4.0  # standard deviations
_DATUM_STEPS, _STEPS, _TOLERANCE = 30, 25, 2e-5
_COLLAPSE = 10.0  # fall of the logarithm of the scale with which a scene vanishes
_POINT_STEPS = 5  # of the points alone, after cameras were put where they are held
_EXACT = 1e-5  # of the extent of what is known: sigma of exact poses where the datum starts
_EXACT_DEG = 1e-3
_POINT_SIGMA = 5.0  # the weak prior of the points must not hold the shape that the control is to change
_MARK_PX = 5.0  # largest error of a mark where its point starts


@dataclass(frozen=True, slots=True)
class Controlled:
    """The solution under control.

    Attributes:
        adjustment: at its minimum, in the world of the polish; datum: from that to the world of the control.
        covariance: (k, 6, 6) of the poses in the control's world, in the polish's unit of length.
        camera_covariance: (c, c) of the camera side relative to the scene's unit.
    """

    adjustment: BundleAdjustment
    datum: Similarity
    covariance: Array
    marginals: Marginals
    camera_covariance: Array
    fit: ControlFit


class _Known:
    """The control as far as registered frames are concerned, in rows of a state.

    Attributes:
        poses: row and pose; held: those that are exact.
        distances: name, ends, and what is known; heights: name, frame, three points, likewise.
        marks: of the points in the frames (rows).
        places: (p, 3) marked points in the world of the polish, NaN where they are not known yet; usable: (p,).
        names: of the frames; unused: what is left out, and why.
    """

    def __init__(self, located: LocatedControl, frames: list[int], state: State) -> None:
        control = located.control
        self.points, self.unused = control.points, list[str]()
        self.names = [located.names[position] for position in frames]
        row_of = {position: row for row, position in enumerate(frames)}
        rows = {key: row_of[position] for key, position in located.position.items() if position in row_of}
        for key in control.frames:
            if key not in rows:
                self.unused.append(f"frame {key} is not registered, or not among those that are solved together")
        kept = np.isin(located.marks.frame, frames)
        seen_from = np.array([row_of[p] for p in located.marks.frame[kept].tolist()], np.int64)
        self.marks = Observations(seen_from, located.marks.point[kept], located.marks.xy[kept])
        seen = np.bincount(self.marks.point, minlength=len(control.points))
        self.places = _triangulated(state, self.marks, seen)
        ends: dict[str, Place] = {}
        self.usable = np.zeros(len(seen), bool)
        for row, point in enumerate(control.points):
            if np.isfinite(self.places[row, 0]) or (point.position is not None and seen[row]):
                ends[point.name], self.usable[row] = Place(row), True
            else:
                self.unused.append(f"point {point.name} cannot be placed: {seen[row]} usable marks")
        self.poses = [(rows[pose.frame], pose) for pose in control.poses if pose.frame in rows]
        self.held = [(row, pose) for row, pose in self.poses if pose.held]
        self.distances: list[tuple[str, tuple[Place, ...], KnownDistance]] = []
        for known in control.distances:
            places = [Place(rows[key], camera=True) for key in known.frames if key in rows]
            places += [ends[name] for name in known.points if name in ends]
            if len(places) == 2:
                name = " to ".join([*(f"frame {key}" for key in known.frames), *known.points])
                self.distances.append((f"distance {name}", tuple(places), known))
        self.heights: list[tuple[str, int, tuple[Place, ...], KnownHeight]] = []
        for height in control.heights:
            if height.frame in rows and all(name in ends for name in height.above):
                three = tuple(ends[name] for name in height.above)
                self.heights.append((f"height of frame {height.frame}", rows[height.frame], three, height))


def solve_under_control(adjustment: BundleAdjustment, located: LocatedControl, frames: list[int]) -> Controlled:
    """Solve once more, with everything that is known beforehand at its sigma.

    Args:
        adjustment: the free solution; frames: position of each of its frames in the source.

    Raises:
        ReconstructionError: what is known of the registered frames leaves open where the scene is, or contradicts
            the images so much that the scene vanishes.
    """
    known = _Known(located, frames, adjustment.state)
    placed = bool(located.control.poses) or any(point.position is not None for point in located.control.points)
    state, term, held = _start(known, adjustment.state, placed)
    options = replace(adjustment.options, point_sigma=_POINT_SIGMA, iterations=_STEPS, tolerance=_TOLERANCE)
    if known.held:
        moved = BundleAdjustment(state, adjustment.observations, options, adjustment.errors, free=Free(cameras=False))
        state = moved.solve(_POINT_STEPS)
    sizes = [float(np.linalg.norm(r)) for r in term.residuals(state)]
    typical = float(np.median(sizes)) if sizes else 0.0
    begin = float(state.control[6])  # log of the scale
    solved = adjustment
    # From afar the kernel must not take all control for wrong.
    for kernel in sorted({max(_KERNEL, 2.0 * typical), _KERNEL}, reverse=True):
        term.kernel = kernel
        solved = BundleAdjustment(
            state,
            adjustment.observations,
            options,
            adjustment.errors,
            prior=adjustment.prior,
            free=Free(held=held),
            known=Known(control=term),
        )
        state = solved.solve()
        logger.debug("control: kernel %.1f sigma, %d iterations", kernel, solved.iterations)
    if state.control[6] < begin - _COLLAPSE:
        residuals = [_residual(item, r) for item, r in zip(term.items, term.residuals(state), strict=True)]
        worst = max(residuals, key=lambda residual: residual.sigmas)
        raise ReconstructionError(
            "control: it contradicts the images so much that the scene shrinks to a point; "
            f"{worst.name} is then off by {worst.sigmas:.0f} sigma"
        )
    return _described(solved, term, known, placed)


def _start(known: _Known, state: State, placed: bool) -> tuple[State, ControlTerm, NDArray[np.bool_]]:
    """The state with the datum and the marked points, the control as a term on it, and the frames that are held."""
    datum = start_datum(_correspondences(known, state), placed)
    held = np.zeros(len(state.rotation), bool)
    held[[row for row, _ in known.held] or [0]] = True
    if known.held:
        datum, state = _through_held(datum, state, known.held)
    first = int(np.argmax(held))
    anchor = -state.rotation[first].T @ state.translation[first]  # about which the datum turns
    free = np.append(np.full(DATUM, placed and not known.held), np.repeat(known.usable, 3))
    free[6] = len(known.held) < 2
    places = _start_places(known, datum)
    control = np.concatenate([np.zeros(3), datum.points(anchor[None])[0], [np.log(datum.scale)], places.ravel()])
    term = ControlTerm(_items(known), datum.rotation, anchor, free, _WIDE)
    return _with_datum(replace(state, control=control), term), term, held


def _described(solved: BundleAdjustment, term: ControlTerm, known: _Known, placed: bool) -> Controlled:
    """The solution with everything that is to be said of it."""
    state, marginals = solved.state, solved.marginals()
    view = term.view(state)
    relative = in_scene_unit(marginals, state, _by_size(state, view))
    covariance = _pose_covariance(marginals, state, view)
    log_scale = Columns.of(state).control.start + 6
    scale_variance = float(relative[log_scale, log_scale])
    spread = view.scale * np.sqrt(np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2))
    residuals = [_residual(item, r) for item, r in zip(term.items, term.residuals(state), strict=True)]
    logger.info("control: %d items, %d contradict", len(residuals), sum(r.contradicts for r in residuals))
    fit = ControlFit(
        residuals,
        [known.names[row] for row, _ in known.held],
        known.unused,
        placed,
        float(np.sqrt(max(scale_variance, 0.0))),
        float(np.median(spread)),
    )
    datum = Similarity(view.scale, view.rotation, view.shift - view.scale * view.rotation @ view.anchor)
    return Controlled(solved, datum, covariance, marginals, relative, fit)


def frames_under_control(registered: list[int], control: LocatedControl, limit: int) -> list[int]:
    """Registered frames of which something is known; of very many, those that are held and some of the others."""
    held = {control.position[pose.frame] for pose in control.control.poses if pose.held}
    others = sorted({*control.position.values()} - held)
    if len(others) > limit:
        others = [others[k] for k in np.linspace(0, len(others) - 1, limit).astype(int)]
    return sorted({*held, *others} & {*registered})


# --- where the control's world is -------------------------------------------------------------------------------


def _triangulated(state: State, marks: Observations, seen: Index) -> Array:
    """(p, 3) points that two frames see, in the world of the polish; NaN for the others."""
    places = np.full((len(seen), 3), np.nan)
    several = np.nonzero(seen >= 2)[0]
    if not len(several):
        return places
    mine = np.isin(marks.point, several)
    some = Observations(marks.frame[mine], np.searchsorted(several, marks.point[mine]), marks.xy[mine])
    found = triangulate(
        state.rotation, state.translation, some, focal=float(np.median(state.focal)), inlier_px=_MARK_PX, sigma=1.0,
        fallback=np.full(len(several), float(np.median(state.inverse_distance))),
    )  # fmt: skip
    good = found.inverse_distance > 1e-3
    places[several[good]] = found.bearing[good] / found.inverse_distance[good, None]
    return places


def _correspondences(known: _Known, state: State) -> Correspondences:
    centers = -np.einsum("kji,kj->ki", state.rotation, state.translation)
    points = known.points
    placed = [(row, pose) for row, pose in known.poses if pose.position is not None]
    turned = [(row, pose) for row, pose in known.poses if pose.cam_from_world is not None]
    marked = [row for row, p in enumerate(points) if p.position is not None and np.isfinite(known.places[row, 0])]
    target = np.array([*(pose.position for _, pose in placed), *(points[row].position for row in marked)], np.float64)
    target = target.reshape(-1, 3)
    exact = _EXACT * max(float(np.ptp(target, axis=0).max()) if len(target) > 1 else 1.0, 1e-12)
    sigma = [*((pose.sigma or exact) for _, pose in placed), *(points[row].sigma or exact for row in marked)]

    def at(place: Place) -> Array:
        return np.asarray((centers if place.camera else known.places)[place.row])

    source_length, target_length = [], []
    for _, (first, second), distance in known.distances:
        source_length.append(float(np.linalg.norm(at(first) - at(second))))
        target_length.append(distance.length)
    for _, row, three, height in known.heights:
        a, b, c = (at(place) for place in three)
        normal = np.cross(b - a, c - a)
        source_length.append(abs(float(normal @ (centers[row] - a))) / max(float(np.linalg.norm(normal)), 1e-12))
        target_length.append(height.length)
    source_lengths, target_lengths = np.array(source_length), np.array(target_length)
    good = np.isfinite(source_lengths) & (source_lengths > 1e-9)
    return Correspondences(
        np.concatenate([centers[[row for row, _ in placed]].reshape(-1, 3), known.places[marked].reshape(-1, 3)]),
        target,
        np.array(sigma, np.float64),
        state.rotation[[row for row, _ in turned]].reshape(-1, 3, 3).transpose(0, 2, 1),
        np.array([_rotation(pose).T for _, pose in turned]).reshape(-1, 3, 3),
        np.radians([pose.rotation_sigma or _EXACT_DEG for _, pose in turned]),
        source_lengths[good],
        target_lengths[good],
    )


def _rotation(pose: KnownPose) -> Array:
    """(3, 3) cam_from_world."""
    return np.asarray(pycolmap.Rotation3d(np.asarray(pose.cam_from_world, np.float64)).matrix())


def _through_held(datum: Similarity, state: State, held: list[tuple[int, KnownPose]]) -> tuple[Similarity, State]:
    """The datum and the state in which the held poses are as given."""
    rotation, translation = state.rotation.copy(), state.translation.copy()
    if len(held) == 1:
        ((row, pose),) = held
        center = -rotation[row].T @ translation[row]
        turn = _rotation(pose).T @ rotation[row]
        datum = Similarity(datum.scale, turn, np.asarray(pose.position) - datum.scale * turn @ center)
        return datum, state
    for row, pose in held:
        rotation[row] = _rotation(pose) @ datum.rotation
        center = datum.rotation.T @ (np.asarray(pose.position) - datum.translation) / datum.scale
        translation[row] = -rotation[row] @ center
    return datum, replace(state, rotation=rotation, translation=translation)


def _start_places(known: _Known, datum: Similarity) -> Array:
    """(p, 3) marked points: triangulated, or where they are known to be; zero where they take no part."""
    places = known.places.copy()
    for row, point in enumerate(known.points):
        if not np.isfinite(places[row, 0]) and point.position is not None:
            places[row] = datum.rotation.T @ (np.asarray(point.position) - datum.translation) / datum.scale
    return np.nan_to_num(places)


def _with_datum(state: State, term: ControlTerm) -> State:
    """Datum and marked points at their best for the poses as they are (Levenberg-Marquardt)."""
    columns, damping = Columns.of(state), 1e-4
    cost = term.cost(state)
    for _ in range(_DATUM_STEPS):
        information, gradient = np.zeros((columns.size, columns.size)), np.zeros(columns.size)
        term.add(state, information, gradient)
        mine = columns.control.start + np.nonzero(term.free)[0]
        normal = information[np.ix_(mine, mine)]
        normal[np.diag_indices_from(normal)] *= 1.0 + damping
        normal += 1e-12 * np.eye(len(normal))
        control = state.control.copy()
        control[term.free] -= np.linalg.solve(normal, gradient[mine])
        candidate = replace(state, control=control)
        new_cost = term.cost(candidate)
        if new_cost < cost:
            state, damping = candidate, damping / 5.0
            if cost - new_cost < 1e-9 * cost:
                break
            cost = new_cost
        else:
            damping *= 8.0
    return state


# --- the joint solution -----------------------------------------------------------------------------------------


def _items(known: _Known) -> list[Item]:
    items: list[Item] = []
    for row, pose in known.poses:
        name = known.names[row]
        if pose.position is not None and pose.sigma:
            place = Place(row, camera=True)
            items.append(PositionItem(f"position of {name}", place, np.asarray(pose.position, np.float64), pose.sigma))
        if pose.cam_from_world is not None and pose.rotation_sigma:
            items.append(RotationItem(f"rotation of {name}", row, _rotation(pose), pose.rotation_sigma))
    for row, point in enumerate(known.points):
        if known.usable[row] and point.position is not None and point.sigma:
            items.append(PositionItem(f"point {point.name}", Place(row), np.asarray(point.position), point.sigma))
    for row, mark, xy in zip(known.marks.frame.tolist(), known.marks.point.tolist(), known.marks.xy, strict=True):
        if known.usable[mark]:
            name = f"point {known.points[mark].name} in {known.names[row]}"
            items.append(MarkItem(name, row, Place(mark), xy, known.points[mark].pixel_sigma))
    for name, (a, b), distance in known.distances:
        items.append(DistanceItem(name, (a, b), distance.length, distance.sigma))
    for name, row, (a, b, c), height in known.heights:
        items.append(HeightItem(name, row, (a, b, c), height.length, height.sigma))
    return items


def _residual(item: Item, residual: Array) -> ControlResidual:
    sigmas = float(np.linalg.norm(residual))
    return ControlResidual(item.name, item.unit, sigmas * item.sigma, item.sigma, sigmas, sigmas > _CONTRADICTION)


def _pose_covariance(marginals: Marginals, state: State, view: ControlView) -> Array:
    """(k, 6, 6) of the poses in the control's world (GTSAM's convention), in the polish's unit of length.

    A change of the datum turns and moves all cameras: ``R (s x) + T`` by its variables, seen from the camera.
    """
    frames, own = len(state.rotation), Columns.of(state)
    blocks = np.empty((frames, 6, 6))
    for row in range(frames):
        _, _, by_place = view.known_place(Place(row, camera=True))
        world_from_cam = view.rotation @ state.rotation[row].T
        derivative = np.zeros((6, 6 + DATUM))
        derivative[:, :6] = np.eye(6)
        derivative[:3, 6:9] = state.rotation[row] @ view.own_turn
        derivative[3:, 6:] = world_from_cam.T @ by_place[:, 3:] / view.scale
        columns = np.append(own.pose(row), own.control.start + np.arange(DATUM))
        blocks[row] = derivative @ marginals.camera[np.ix_(columns, columns)] @ derivative.T
    return blocks


def _by_size(state: State, view: ControlView) -> Array:
    """(7 + 3 p,) by how much datum and marked points change with the logarithm of the scene's size."""
    by_size = np.zeros(len(state.control))
    by_size[3:6] = view.scale * view.rotation @ view.anchor
    by_size[6] = 1.0
    by_size[DATUM:] = -state.control[DATUM:]
    return by_size
