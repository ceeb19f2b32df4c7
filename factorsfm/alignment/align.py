"""The alignment of a result: level, on its ground, with an origin and a unit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from factorsfm.alignment.ground import Ground, level_ground
from factorsfm.alignment.picks import (
    Pick,
    PickedPoint,
    check_direction,
    length_between,
    picked_point,
    plane_normal,
    ray,
)
from factorsfm.alignment.planes import TOLERANCE
from factorsfm.alignment.up import Up, camera_up, find_up
from factorsfm.export.options import ExportOptions
from factorsfm.export.shot import Defaults, Shot, make_shot
from factorsfm.result.alignment import FREE_SCALE, Alignment
from factorsfm.result.other_world import in_other_world
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError
from factorsfm.support.similarity import Similarity

Array = NDArray[np.float64]

_LONGEST = 1e9  # metres of a length: beyond, no format of an export holds the scene, nor below the inverse


@dataclass(frozen=True, slots=True)
class Length:
    """A distance between two picked points that is known.

    Attributes:
        a, b: the points.
        metres, sigma: the distance and its standard deviation.
    """

    a: Pick | str
    b: Pick | str
    metres: float
    sigma: float = 0.0


def align(
    reconstruction: Reconstruction,
    *,
    origin: Pick | str | None = None,
    axis: Pick | str | None = None,
    plane: Pick | str | None = None,
    distance: Length | None = None,
    camera_height: float | None = None,
    footage: str | Path | None = None,
) -> Reconstruction:
    """The result in a world that stands on its ground: x right, -y up, z ahead.

    Up comes from an IMU, from straight edges in the footage, or from the ground; the ground is the lowest level on
    which many points lie. Without picks the origin is below the first camera on the ground, and x is the camera's
    right, made level. What nothing tells stays as it is, and `Reconstruction.alignment` says so.

    Args:
        origin: of the point that becomes the origin: a pixel, ``Pick`` or "FRAME:X,Y", or the name of a track.
        axis: of a point in the direction of the x axis.
        plane: of a third point; origin, axis and this one lie on the ground then.
        distance: known between two picked points: the unit becomes the metre.
        camera_height: of the first camera above the ground, metres: the unit becomes the metre.
        footage: the shot, see `ExportOptions.footage`.

    Raises:
        InputError: a pick or a length cannot be used, or the result is in the world of its control.
    """
    given = {"origin": origin, "axis": axis, "plane": plane}
    picks = {name: _pick(reconstruction, pick) for name, pick in given.items() if pick is not None}
    _check(reconstruction, picks, distance, camera_height)
    aligning = _Aligning(reconstruction, picks, footage)
    world = aligning.world()
    scale, scale_from, scale_std = _scale(reconstruction, aligning.height, aligning.ground, distance, camera_height)
    aligned = in_other_world(reconstruction, Similarity(scale, world.rotation, scale * world.translation))
    aligned.alignment = aligning.said(world, scale, scale_from, scale_std)
    aligned.metric = reconstruction.metric or scale_from in ("distance", "height")
    return aligned


def survey(result: Reconstruction) -> Literal["world", "lengths"] | None:
    """What a result has from its control, which no alignment replaces: its world, only its lengths, or nothing."""
    if result.control is None or result.control.source != "control":
        return None
    return "world" if result.control.placed else "lengths"


def _pick(result: Reconstruction, pick: Pick | str) -> Pick:
    return pick if isinstance(pick, Pick) else Pick.of(result, pick)


def _check(
    result: Reconstruction, picks: dict[str, Pick], distance: Length | None, camera_height: float | None
) -> None:
    if not result.registered:
        raise InputError("no frame of this result has a pose; there is nothing to align")
    surveyed = survey(result)
    if surveyed == "world":
        raise InputError("the result is in the world of its control, and aligning would take it out of it")
    if surveyed and (distance is not None or camera_height is not None):
        raise InputError("the result has the lengths of its control; a further one belongs into the control file")
    if distance is not None and camera_height is not None:
        raise InputError("a distance and the height of the camera are given; one of them sets the scale")
    if ("axis" in picks and "origin" not in picks) or ("plane" in picks and "axis" not in picks):
        raise InputError("an axis needs an origin, and a plane needs origin and axis; they are picked together")
    lengths = {"distance": None if distance is None else distance.metres, "camera height": camera_height}
    for name, length in lengths.items():
        if length is not None and not 1.0 / _LONGEST <= length <= _LONGEST:
            raise InputError(
                f"the {name} is {length:g}; a number of metres from {1.0 / _LONGEST:g} to {_LONGEST:g} is expected"
            )
    if distance is not None and not 0.0 <= distance.sigma <= _LONGEST:
        raise InputError(
            f"the standard deviation of the distance is {distance.sigma:g}; 0 to {_LONGEST:g} metres are expected"
        )


class _Aligning:
    """Finds up, ground and origin, in the world and unit of the result."""

    def __init__(self, result: Reconstruction, picks: dict[str, Pick], footage: str | Path | None) -> None:
        self._result, self._picks = result, picks
        self._notes: list[str] = []
        self._first = result.camera_centers()[0]
        self._origin: PickedPoint | None = None
        self.ground: Ground | None = None
        self._up = self._picked_up() if "plane" in picks else self._found_up(footage)
        if self._up is None:
            self._notes.append("Up and the ground are not known: the world keeps the up of the first camera.")
        elif "plane" not in picks:
            self.ground = level_ground(result, self._up.direction, self._up.std)
            if self.ground is None:
                self._notes.append("The ground is not known: too few points lie on a level below the camera.")
        if "origin" in picks and self._origin is None:
            self._origin = self._on_ground(picks["origin"])

    @property
    def direction(self) -> Array:
        """(3,) up, that of the first camera where it is not known."""
        if self._up is not None:
            return self._up.direction
        pose = self._result.registered[0].cam_from_world
        assert pose is not None
        return np.asarray(-pose.rotation.matrix()[1])

    @property
    def height(self) -> float | None:
        """Of the first camera above the ground."""
        return None if self.ground is None else float(self._first @ self.direction) - self.ground.height

    def _found_up(self, footage: str | Path | None) -> Up | None:
        shot: Shot | None = None
        try:
            shot = make_shot(self._result, ExportOptions(footage=footage), Defaults())
            if shot.footage is not None:
                return find_up(self._result, shot)
        except InputError as error:  # photographs of several sizes, other footage in the place of the shot
            if footage is not None:
                raise
            self._notes.append(f"The footage is not looked at: {error}.")
            return find_up(self._result, None)
        self._notes.append("The footage is not where it was: edges in the images are not looked for.")
        return find_up(self._result, None)

    def _picked_up(self) -> Up:
        picks = [self._picks[name] for name in ("origin", "axis", "plane")]
        points = [picked_point(self._result, pick) for pick in picks]
        normal, std = plane_normal(points, [ray(self._result, pick)[0] for pick in picks])
        up = Up(normal * np.sign(normal @ camera_up(self._result)), std, ["picks"])
        self._origin = points[0]
        height = float(points[0].position @ up.direction)
        away = float(np.linalg.norm(self._first - points[0].position))
        vertical = float(np.sqrt(up.direction @ points[0].covariance @ up.direction))
        lie = np.abs(self._result.points @ up.direction - height)
        on = lie < TOLERANCE * np.linalg.norm(self._result.points - self._first, axis=1)
        self.ground = Ground(height, float(np.hypot(vertical, away * np.radians(std))), np.flatnonzero(on))
        return up

    def _on_ground(self, pick: Pick) -> PickedPoint:
        """The point of a track, or the one behind a pixel, which is on the ground if it is as near as can be told."""
        if pick.track is not None:
            return picked_point(self._result, pick)
        up, ground = self.direction, self.ground
        hit: PickedPoint | None = None
        if ground is not None:
            center, direction = ray(self._result, pick)
            if direction @ up < -1e-3 * np.linalg.norm(direction):
                reach = (ground.height - center @ up) / (direction @ up)
                along = ground.std / abs(direction @ up) * direction
                hit = PickedPoint(center + reach * direction, np.outer(along, along))
        try:
            point = picked_point(self._result, pick)
        except InputError:
            if hit is None:
                raise
            return hit
        if hit is None or ground is None:
            return point
        above = abs(float(point.position @ up) - ground.height)
        near = TOLERANCE * float(np.linalg.norm(point.position - self._first))
        return hit if above <= max(3 * float(np.sqrt(up @ point.covariance @ up)), 2 * near) else point

    def world(self) -> Similarity:
        """From the world of the result to the aligned one, in the unit of the result."""
        up = self.direction
        pose = self._result.registered[0].cam_from_world
        assert pose is not None
        ahead = pose.rotation.matrix()
        right = ahead[0] if abs(ahead[0] @ up) < 0.9 else ahead[2]  # a camera on its side
        if "axis" in self._picks:
            assert self._origin is not None
            point = self._on_ground(self._picks["axis"])
            check_direction(self._result, self._picks["origin"], self._picks["axis"], point)
            right = point.position - self._origin.position
        level = right - (right @ up) * up
        if np.linalg.norm(level) <= 0.05 * np.linalg.norm(right):
            raise InputError("the point of the axis lies above or below the origin; pick one beside it")
        level = level / np.linalg.norm(level)
        rotation = np.array([level, -up, np.cross(level, -up)])
        foot = self._first if self.height is None else self._first - self.height * up
        return Similarity(1.0, rotation, -rotation @ (foot if self._origin is None else self._origin.position))

    def said(self, world: Similarity, scale: float, scale_from: str | None, scale_std: float | None) -> Alignment:
        """What has been found, in the new unit."""
        ground, up, height = self.ground, self._up, self.height
        zero = -world.rotation.T @ world.translation
        notes = self._notes if scale_from is not None else [*self._notes, FREE_SCALE]
        return Alignment(
            up_from=[] if up is None else up.sources,
            up_std=None if up is None else up.std,
            ground_from=None if ground is None else "picks" if "plane" in self._picks else "points",
            ground_height=None if ground is None else scale * (ground.height - float(zero @ self.direction)),
            ground_std=None if ground is None else scale * ground.std,
            ground_points=0 if ground is None else len(ground.points),
            camera_height=None if height is None else scale * height,
            origin_from="pick" if self._origin is not None else "foot" if ground is not None else "camera",
            origin_std=None if self._origin is None else scale * self._origin.std,
            x_from="pick" if "axis" in self._picks else "camera",
            scale_from=scale_from,
            scale_std=scale_std,
            notes=notes,
        )


def _scale(
    result: Reconstruction,
    height: float | None,
    ground: Ground | None,
    distance: Length | None,
    camera_height: float | None,
) -> tuple[float, str | None, float | None]:
    """New units in one of the result, where they come from, and the relative standard deviation of all lengths."""
    if distance is not None:
        length, std = length_between(*(picked_point(result, _pick(result, pick)) for pick in (distance.a, distance.b)))
        return distance.metres / length, "distance", float(np.hypot(std / length, distance.sigma / distance.metres))
    if camera_height is not None:
        if height is None or ground is None:
            raise InputError("the ground is not known, so the height of the camera above it gives no scale")
        if height <= 2 * ground.std:
            raise InputError(
                f"the first camera is {height:.2g} above the ground, with a standard deviation of {ground.std:.2g} "
                "units: its height gives no scale"
            )
        return camera_height / height, "height", ground.std / height
    if result.imu is not None:
        return 1.0, "imu", result.imu.scale_std
    if result.control is not None and np.isfinite(result.control.scale_std):
        return 1.0, "control", result.control.scale_std
    if result.alignment is not None and result.alignment.scale_from is not None:
        return 1.0, result.alignment.scale_from, result.alignment.scale_std
    return (1.0, "prior", _spread_of_prior(result)) if result.metric else (1.0, None, None)


def _spread_of_prior(result: Reconstruction) -> float | None:
    """By how much the metres of a metric prior differ from frame to frame; what it has wrong in all is not in it."""
    fits = [frame.prior for frame in result.registered if frame.prior is not None]
    if len(fits) < 2:
        return None
    scale = np.log([fit.scale for fit in fits])
    own = float(np.median([fit.scale_std / fit.scale for fit in fits]))
    return float(np.hypot(1.4826 * np.median(np.abs(scale - np.median(scale))), own))
