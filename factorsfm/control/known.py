"""Control: poses, points, distances and heights of a scene that are known, in a world of their own.

Positions and lengths are in the unit of that world, which the result takes over and calls metres. Every value comes
with its standard deviation (`sigma`). Frames are named by their name, with or without suffix, or by their index.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.control.world_alignment import check_enough
from factorsfm.support.errors import InputError

Array = NDArray[np.float64]
Vector = Sequence[float] | Array
FrameKey = str | int

STILL = 1e-9  # of a coordinate: a camera whose positions differ by less does not move
_LARGEST = 1e12  # of a number, and of the inverse of one that is not 0: their squares and products stay finite


@dataclass(frozen=True, slots=True)
class KnownPose:
    """Where a camera is, and how it is turned if that is known, too.

    Attributes:
        frame: name or index.
        position: (3,) centre of the camera; sigma: of each coordinate. 0 holds the whole pose exactly.
        cam_from_world: (4,) quaternion x, y, z, w of the rotation from the world to the camera, or None.
        rotation_sigma: of the rotation about each axis, degrees. 0 holds the whole pose exactly.
        path_share: what `sigma` is of the path of all poses with a share, where it is not known; see `Control.within`.

    Raises:
        InputError: a value is missing or is none, or one of two sigmas is 0.
    """

    frame: FrameKey
    position: Vector | None = None
    sigma: float | None = None
    cam_from_world: Vector | None = None
    rotation_sigma: float | None = None
    path_share: float | None = None

    def __post_init__(self) -> None:
        _check_frame(self.frame)
        if self.position is None and self.cam_from_world is None:
            raise InputError('neither "position" nor "cam_from_world" is given')
        _check_vector("position", self.position, 3)
        _check_vector("cam_from_world", self.cam_from_world, 4)
        if self.cam_from_world is not None and abs(float(np.linalg.norm(self.cam_from_world)) - 1.0) > 1e-3:
            raise InputError(f'"cam_from_world" is {list(self.cam_from_world)}; a unit quaternion is expected')
        _check_sigma("sigma", self.sigma, self.position is not None, zero=True)
        _check_sigma("rotation_sigma", self.rotation_sigma, self.cam_from_world is not None, zero=True)
        _check_sigma("path_share", self.path_share, False)
        if 0.0 in (self.sigma, self.rotation_sigma) and self.sigma != self.rotation_sigma:
            raise InputError(
                f'"sigma" is {self.sigma} and "rotation_sigma" {self.rotation_sigma}; '
                "a pose that is held exactly needs a position and a rotation with 0 for both"
            )

    @classmethod
    def at(
        cls, frame: FrameKey, cam_from_world: pycolmap.Rigid3d, sigma: float = 0.0, rotation_sigma: float = 0.0
    ) -> KnownPose:
        """A pose as a result has it; it is held exactly unless sigmas are given."""
        center = np.asarray(cam_from_world.inverse().translation, np.float64)
        return cls(frame, center, sigma, np.asarray(cam_from_world.rotation.quat, np.float64), rotation_sigma)

    @property
    def held(self) -> bool:
        """Whether the pose is exact."""
        return self.sigma == 0.0


@dataclass(frozen=True, slots=True)
class MarkedPoint:
    """A point that was marked in images by hand, and its position if that is known.

    Attributes:
        name: by which distances and heights refer to it.
        pixels: where frames see it, pixels of the image with centres at integers; one frame at least, two where the
            position is unknown. None: where the track of the user with this name is.
        pixel_sigma: of each coordinate of a mark, pixels.
        position: (3,) or None; sigma: of each coordinate.

    Raises:
        InputError: a value is missing or is none.
    """

    name: str
    pixels: Mapping[FrameKey, Vector] | None = None
    pixel_sigma: float = 1.0
    position: Vector | None = None
    sigma: float | None = None

    def __post_init__(self) -> None:
        if self.pixels is not None and not isinstance(self.pixels, Mapping):
            raise InputError(f'"pixels" is {self.pixels!r}; frames with their [x, y] are expected')
        needed = 1 if self.position is not None else 2
        if self.pixels is not None and len(self.pixels) < needed:
            raise InputError(f'"{self.name}" is marked in {len(self.pixels)} of {needed} needed frames')
        for frame, xy in self.marks.items():
            _check_vector(f"pixels of {frame}", xy, 2)
        _check_vector("position", self.position, 3)
        _check_sigma("pixel_sigma", self.pixel_sigma, True)
        _check_sigma("sigma", self.sigma, self.position is not None)

    @property
    def marks(self) -> Mapping[FrameKey, Vector]:
        """The pixels, as far as they are given."""
        return self.pixels or {}


@dataclass(frozen=True, slots=True)
class KnownDistance:
    """The distance between two cameras, two marked points, or a camera and a marked point.

    Attributes:
        length, sigma: the distance.
        frames, points: the two ends.

    Raises:
        InputError: a value is missing or is none.
    """

    length: float
    sigma: float
    frames: Sequence[FrameKey] = ()
    points: Sequence[str] = ()

    def __post_init__(self) -> None:
        _check_sigma("length", self.length, True)
        _check_sigma("sigma", self.sigma, True)
        if len(self.frames) + len(self.points) != 2 or len({*self.frames}) + len({*self.points}) != 2:
            raise InputError(
                f'"frames" is {list(self.frames)} and "points" {list(self.points)}; two different ends are expected'
            )


@dataclass(frozen=True, slots=True)
class KnownHeight:
    """The height of a camera above the plane through three marked points, on the ground or elsewhere.

    Attributes:
        frame: the camera.
        above: names of three points that are not on a line.
        length, sigma: the height, a positive number on whichever side the camera is.

    Raises:
        InputError: a value is missing or is none.
    """

    frame: FrameKey
    above: Sequence[str]
    length: float
    sigma: float

    def __post_init__(self) -> None:
        _check_frame(self.frame)
        _check_sigma("length", self.length, True)
        _check_sigma("sigma", self.sigma, True)
        if len({*self.above}) != 3 or len(self.above) != 3:
            raise InputError(f'"above" is {list(self.above)}; the names of three points are expected')


@dataclass(frozen=True, slots=True)
class Control:
    """All known poses, points, distances and heights of a scene.

    Attributes:
        spare: whether poses of frames that the source does not have are left out; else they are an error.

    Raises:
        InputError: nothing is known, a frame or a point is there twice, a point that is not there is referred to, or
            the control does not determine where the scene is in its world.
    """

    poses: Sequence[KnownPose] = ()
    points: Sequence[MarkedPoint] = ()
    distances: Sequence[KnownDistance] = ()
    heights: Sequence[KnownHeight] = ()
    spare: bool = False

    def __post_init__(self) -> None:
        names = [point.name for point in self.points]
        for what, keys in (("frame", [str(pose.frame) for pose in self.poses]), ("point", names)):
            counts = Counter(map(repr, keys))
            twice = [key for key in keys if counts[repr(key)] > 1]
            if twice:
                raise InputError(f'{what} "{twice[0]}" is there twice')
        for name in (*(n for d in self.distances for n in d.points), *(n for h in self.heights for n in h.above)):
            if name not in names:
                raise InputError(f'point "{name}" is not among the marked points')
        known = any(point.position is not None for point in self.points)
        if not (self.poses or known or self.distances or self.heights):
            raise InputError("it holds no known pose, point, distance or height")
        if self.poses or known:
            self._check_enough()

    def _check_enough(self) -> None:
        """As far as that can be said without the images."""
        known = [(pose.position, pose.sigma) for pose in self.poses]
        known += [
            (point.position, point.sigma) for point in self.points if point.pixels is None or len(point.pixels) > 1
        ]
        given = [(position, sigma) for position, sigma in known if position is not None]
        check_enough(
            np.array([position for position, _ in given], np.float64).reshape(-1, 3),
            np.array([sigma for _, sigma in given], np.float64),
            any(pose.cam_from_world is not None for pose in self.poses),
            bool(self.distances or self.heights),
        )

    def within(self, frames: Collection[FrameKey]) -> Control:
        """Without the poses of other frames than these, if they may be left out.

        A sigma that is a share of the path is that of the path in these frames: what is left out may be of another
        shot, far away.

        Raises:
            InputError: none of the poses is of one of these frames, or those that are do not determine where it is.
        """
        poses = [pose for pose in self.poses if pose.frame in frames] if self.spare else self.poses
        if self.poses and not poses:
            raise InputError(
                f"control: none of the {len(self.poses)} poses, of frames {self.poses[0].frame} to "
                f"{self.poses[-1].frame}, is of a frame of the source; a control file can name the first_frame, "
                "and the fps of an Alembic archive"
            )
        return replace(self, poses=_with_shares(poses))

    @property
    def frames(self) -> list[FrameKey]:
        """All frames that are referred to, each once."""
        marked = [frame for point in self.points for frame in point.marks]
        ends = [frame for distance in self.distances for frame in distance.frames]
        every = [*marked, *ends, *(height.frame for height in self.heights), *(pose.frame for pose in self.poses)]
        return list(dict.fromkeys(every))


def _with_shares(poses: Sequence[KnownPose]) -> Sequence[KnownPose]:
    """With the sigmas that are shares of the path of these poses, which is the diagonal of the box around them."""
    path = np.array([pose.position for pose in poses if pose.path_share is not None], np.float64)
    extent = float(np.linalg.norm(np.ptp(path, axis=0))) if len(path) else 0.0
    if extent <= STILL * max(1.0, np.abs(path).max(initial=0.0)):  # it keeps what it was in a longer path
        return poses
    return [pose if pose.path_share is None else replace(pose, sigma=pose.path_share * extent) for pose in poses]


def _check_vector(name: str, value: Any, length: int) -> None:
    if value is None:
        return
    good = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str) and len(value) == length
    if not good or not all(_is_number(v) for v in value):
        raise InputError(f'"{name}" is {value!r}; {length} finite numbers are expected')


def _check_frame(key: Any) -> None:
    if isinstance(key, bool) or not isinstance(key, str | int):
        raise InputError(f'"frame" is {key!r}; the name or the index of a frame is expected')


def _check_sigma(name: str, value: Any, needed: bool, *, zero: bool = False) -> None:
    if value is None and needed:
        raise InputError(f'"{name}" is missing')
    if value is not None and not (_is_number(value) and (value >= 1.0 / _LARGEST or (value == 0 and zero))):
        raise InputError(f'"{name}" is {value!r}; a positive number{" or 0" if zero else ""} is expected')


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and abs(float(value)) <= _LARGEST
