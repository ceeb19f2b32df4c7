"""Where the solution under control starts: the world alignment, the marked points, and the frames that are held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.state import State
from factorsfm.control.known import KnownPose
from factorsfm.control.residuals import ALIGNMENT, ControlTerm, Place
from factorsfm.control.solved_control import SolvedControl, rotation_of
from factorsfm.control.world_alignment import Correspondences, align_worlds
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.semidefinite import solution
from factorsfm.support.similarity import Similarity

Array = NDArray[np.float64]

KERNEL = 3.0  # Cauchy scale of the control, standard deviations
_COLLAPSE = 10.0  # fall of the logarithm of the scale with which a scene vanishes
_STEPS = 30
_EXACT = 1e-5  # of the extent of the known positions: sigma of exact poses
_EXACT_DEG = 1e-3


def start_under_control(control: SolvedControl, state: State) -> tuple[State, ControlTerm, NDArray[np.bool_]]:
    """The state with world alignment and marked points, the control as a term on it, and (k,) which frames are held.

    Raises:
        ReconstructionError: the control does not determine scale, rotation or place of its world, or contradicts the
            images so much that the scene vanishes.
    """
    alignment = align_worlds(_correspondences(control, state), control.placed)
    held = np.zeros(len(state.rotation), bool)
    held[[row for row, _ in control.held] or [0]] = True
    if control.held:
        alignment, state = _through_held(alignment, state, control.held)
    first = int(np.argmax(held))
    anchor = -state.rotation[first].T @ state.translation[first]  # about which the alignment turns
    free = np.append(np.full(ALIGNMENT, control.placed and not control.held), np.repeat(control.usable, 3))
    free[6] = len(control.held) < 2
    places = _start_places(control, alignment)
    variables = np.concatenate(
        [np.zeros(3), alignment.points(anchor[None])[0], [np.log(alignment.scale)], places.ravel()]
    )
    term = ControlTerm(control.items(), alignment.rotation, anchor, free, KERNEL)
    state = replace(state, control=variables)
    # No narrower than the residuals: it would take all control for outliers, and no wider: one wild pose would drag it.
    term.kernel = wide_kernel(term, state)
    state = _with_best_alignment(state, term)
    check_size(term, state, float(variables[6]))
    return state, term, held


def wide_kernel(term: ControlTerm, state: State) -> float:
    """Cauchy scale, standard deviations, that is as wide as most of the residuals."""
    sizes = [float(np.linalg.norm(r)) for r in term.residuals(state)]
    return max(KERNEL, 2.0 * float(np.median(sizes))) if sizes else KERNEL


def check_size(term: ControlTerm, state: State, begin: float) -> None:
    """Insist that the scene has not vanished.

    Args:
        begin: logarithm of its scale before.

    Raises:
        ReconstructionError: it has; names the control that is off most.
    """
    if state.control[6] >= begin - _COLLAPSE:
        return
    sizes = [float(np.linalg.norm(r)) for r in term.residuals(state)]
    worst = int(np.argmax(sizes))
    raise ReconstructionError(
        "control: it contradicts the images so much that the scene shrinks to a point; "
        f"{term.items[worst].name} is then off by {sizes[worst]:.0f} sigma"
    )


def _correspondences(control: SolvedControl, state: State) -> Correspondences:
    """Positions, rotations and lengths that both worlds know."""
    centers, points = -np.einsum("kji,kj->ki", state.rotation, state.translation), control.points
    placed = [(row, pose) for row, pose in control.poses if pose.position is not None]
    turned = [(row, pose) for row, pose in control.poses if pose.cam_from_world is not None]
    marked = [row for row, p in enumerate(points) if p.position is not None and np.isfinite(control.places[row, 0])]
    target = np.array([*(pose.position for _, pose in placed), *(points[row].position for row in marked)], np.float64)
    target = target.reshape(-1, 3)
    exact = _EXACT * max(float(np.ptp(target, axis=0).max()) if len(target) > 1 else 1.0, 1e-12)
    sigma = [*((pose.sigma or exact) for _, pose in placed), *(points[row].sigma or exact for row in marked)]
    source_length, target_length = _lengths(control, centers)
    return Correspondences(
        np.concatenate([centers[[row for row, _ in placed]].reshape(-1, 3), control.places[marked].reshape(-1, 3)]),
        target,
        np.array(sigma, np.float64),
        state.rotation[[row for row, _ in turned]].reshape(-1, 3, 3).transpose(0, 2, 1),
        np.array([rotation_of(pose).T for _, pose in turned]).reshape(-1, 3, 3),
        np.radians([pose.rotation_sigma or _EXACT_DEG for _, pose in turned]),
        source_length,
        target_length,
    )


def _lengths(control: SolvedControl, centers: Array) -> tuple[Array, Array]:
    """(d,) distances and heights in the world of the solution, and as they are known."""

    def at(place: Place) -> Array:
        return np.asarray((centers if place.camera else control.places)[place.row])

    source, target = [], []
    for _, (first, second), distance in control.distances:
        source.append(float(np.linalg.norm(at(first) - at(second))))
        target.append(distance.length)
    for _, row, three, height in control.heights:
        a, b, c = (at(place) for place in three)
        normal = np.cross(b - a, c - a)
        source.append(abs(float(normal @ (centers[row] - a))) / max(float(np.linalg.norm(normal)), 1e-12))
        target.append(height.length)
    lengths = np.array(source)
    good = np.isfinite(lengths) & (lengths > 1e-9)
    return lengths[good], np.array(target)[good]


def _through_held(alignment: Similarity, state: State, held: list[tuple[int, KnownPose]]) -> tuple[Similarity, State]:
    """The alignment and the state in which the held poses are as given."""
    rotation, translation = state.rotation.copy(), state.translation.copy()
    if len(held) == 1:
        ((row, pose),) = held
        center = -rotation[row].T @ translation[row]
        turn = rotation_of(pose).T @ rotation[row]
        shift = np.asarray(pose.position) - alignment.scale * turn @ center
        return Similarity(alignment.scale, turn, shift), state
    for row, pose in held:
        rotation[row] = rotation_of(pose) @ alignment.rotation
        center = alignment.rotation.T @ (np.asarray(pose.position) - alignment.translation) / alignment.scale
        translation[row] = -rotation[row] @ center
    return alignment, replace(state, rotation=rotation, translation=translation)


def _start_places(control: SolvedControl, alignment: Similarity) -> Array:
    """(p, 3) marked points: triangulated, or where they are known to be; zero where they take no part."""
    places = control.places.copy()
    for row, point in enumerate(control.points):
        if not np.isfinite(places[row, 0]) and point.position is not None:
            off = np.asarray(point.position) - alignment.translation
            places[row] = alignment.rotation.T @ off / alignment.scale
    return np.nan_to_num(places)


def _with_best_alignment(state: State, term: ControlTerm) -> State:
    """World alignment and marked points at their best for the poses as they are (Levenberg-Marquardt)."""
    columns, damping = Columns.of(state), 1e-4
    cost = term.cost(state)
    for _ in range(_STEPS):
        information, gradient = np.zeros((columns.size, columns.size)), np.zeros(columns.size)
        term.add(state, information, gradient)
        mine = columns.control.start + np.nonzero(term.free)[0]
        normal = information[np.ix_(mine, mine)]
        normal[np.diag_indices_from(normal)] *= 1.0 + damping
        normal += 1e-12 * np.eye(len(normal))
        control = state.control.copy()
        control[term.free] -= solution(normal, gradient[mine])
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
