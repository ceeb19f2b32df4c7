"""An IMU beside a stream: its factors enter the live graph when the motion shows its clock, its axes and the scale.

Where they cannot, as with a lens that is not known while frames arrive, they join the poses of the polish.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factorsfm.graph.contents import LiveGraph
from factorsfm.graph.inertial_chain import GRAVITY_KEY, inertial_state, next_inertial_factor
from factorsfm.graph.inertial_factors import inertial_graph
from factorsfm.inertial.alignment import InertialAlignment, VisualPoses, align_inertial
from factorsfm.inertial.recording import ImuRecording
from factorsfm.inertial.timing import ImuTiming, fit_timing
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.mapper import Mapper
from factorsfm.support.errors import FactorsfmError, InputError
from factorsfm.support.rotations import camera_centers

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_FIRST_SECONDS, _FIRST_KEYFRAMES = 2.0, 8  # before which the motion hardly determines anything
_AGAIN_SECONDS, _AGAIN_SHARE = 0.5, 0.1  # after an attempt that failed: an attempt takes all frames so far
_MOST_KEYFRAMES = 30  # of the alignment, the newest ones
_LEAST_INTERVAL, _LONGEST_INTERVAL = 0.15, 0.5  # seconds between keyframes with a factor, and between keyframes at all
_POLISHED_INTERVAL = 0.3  # seconds between solved frames with a factor, as it usually is between keyframes
_MOST_POLISHED = 120  # solved frames with a factor: the time of the alignment grows with the cube, and is a second here
_LARGEST_SCALE_STD = 0.05  # of the logarithm, with which the factors begin
_STATE = ("timing", "reason", "_last", "_attempt", "_seen", "_times")
_EXACT = 1e-12  # variance of the pose of the first keyframe, which is the world


@dataclass(frozen=True, slots=True)
class FramePoses:
    """Poses of all frames, NaN where a frame has none.

    Attributes:
        rotation (n, 3, 3), translation (n, 3): `cam_from_world`; covariance: (n, 6, 6).
    """

    rotation: Array
    translation: Array
    covariance: Array

    @classmethod
    def none(cls, n: int) -> FramePoses:
        """Of no frame."""
        return cls(np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan), np.full((n, 6, 6), np.nan))


class ImuSource:
    """Factors from a recording, added to the graph of a mapper.

    Args:
        recording: what is unknown of its clock and axes is estimated.

    Attributes:
        timing: the fit of its clock and axes, once there is one; recording: as an IMU in the camera would have it then.
        reason: why it takes no part yet, empty while it does.

    Raises:
        InputError: another type.
    """

    def __init__(self, recording: ImuRecording) -> None:
        if not isinstance(recording, ImuRecording):
            raise InputError(f"the IMU is of type {type(recording).__name__}; the ImuRecording of open_imu is expected")
        self._given = self.recording = recording
        self.timing: ImuTiming | None = None
        self.reason = "the video has not begun"
        self._last: int | None = None  # position of the newest keyframe with a factor
        self._attempt = -np.inf  # time of the last one to begin
        self._seen = 0  # keyframes of the map so far
        self._times: list[float] = []  # of the frames, seconds

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs beside the recording."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken."""
        for name in _STATE:
            setattr(self, name, state[name])
        if self.timing is not None:
            self._take(self.timing)

    def _take(self, timing: ImuTiming) -> None:
        self.timing, self.recording = timing, timing.applied(self._given).at_camera()

    @property
    def takes_part(self) -> bool:
        """Whether its factors are in the graph, or wait for the next update."""
        return self._last is not None

    def check_time(self, index: int, time: float | None) -> float:
        """The time of the next frame, seconds.

        Raises:
            InputError: it has none, or one before that of the last frame.
        """
        if time is None or not math.isfinite(time):
            raise InputError(
                f"frame {index} has no time; an IMU needs those of all frames, as video files have them, and images "
                "named by times"
            )
        if self._times and not time > self._times[-1]:
            raise InputError(f"frame {index} is at {time:g} s, after one at {self._times[-1]:g} s; times must ascend")
        return time

    def wants_keyframe(self, mapper: Mapper, time: float) -> bool:
        """Whether the next frame shall be a keyframe, since the last one is long ago."""
        last = next((image.tracks.position for image in reversed(mapper.images) if image.keyframe), None)
        return last is not None and time - self._times[last] >= _LONGEST_INTERVAL

    def follow(self, mapper: Mapper, time: float) -> None:
        """After a frame, with its time: begin, or go on with the keyframes that the map has taken over since."""
        self._times.append(time)
        self._add_factors(mapper, finished=False)

    def finish(self, mapper: Mapper) -> None:
        """No more frames come: take part, if that is possible at last."""
        if mapper.started:
            self._add_factors(mapper, finished=True)

    def _add_factors(self, mapper: Mapper, *, finished: bool) -> None:
        if mapper.news.starts_anew:
            self._last, self.reason = None, "the map was started anew"
        if len(mapper.keyframes) == self._seen and not finished:
            return
        self._seen = len(mapper.keyframes)
        if mapper.refines_focal:
            self.reason = "the lens is not known while frames arrive"
            return
        if self._last is not None and not self._is_known(mapper):
            self._last, self.reason = None, "the images contradict its factors"
        try:
            if self._last is None:
                self._begin(mapper, finished)
            if self._last is not None:
                self._go_on(mapper)
        except FactorsfmError as error:
            self.reason = str(error)
            logger.debug("IMU: %s", error)

    def _is_known(self, mapper: Mapper) -> bool:
        """Whether the factors of the last keyframe are in the graph, or wait."""
        assert self._last is not None
        frame = mapper.images[self._last].tracks.frame
        return inertial_state(mapper.additions.present(), frame) is not None

    def _begin(self, mapper: Mapper, finished: bool) -> None:
        times = self._times
        positions = _spaced(mapper.keyframes, times, _LEAST_INTERVAL)[-_MOST_KEYFRAMES:]
        span = times[positions[-1]] - times[mapper.keyframes[0]] if positions else 0.0
        early = len(positions) < _FIRST_KEYFRAMES or span < _FIRST_SECONDS
        if not finished and (early or times[-1] - self._attempt < max(_AGAIN_SECONDS, _AGAIN_SHARE * span)):
            self.reason = f"{len(positions)} keyframes in {span:.1f} s are too few to find its scale"
            return
        self._attempt = times[-1]
        positions, alignment = self._aligned(_live_poses(mapper.images), positions)
        if alignment.log_scale_sigma > _LARGEST_SCALE_STD and not finished:
            raise InputError(f"the motion shows the scale to {100 * alignment.log_scale_sigma:.1f} % so far")
        frames = [mapper.images[position].tracks.frame for position in positions]
        mapper.add_factors(*self._graph(frames, positions, alignment))
        self._last, self.reason = positions[-1], ""

    def join(self, poses: FramePoses, numbers: Sequence[int]) -> tuple[LiveGraph, float] | None:
        """Factors between poses of the polish, and metres in the unit of these; None where it takes no part: `reason`.

        Args:
            poses: of all frames; numbers: of these, the i of ``X(i)``.
        """
        times, solved = self._times, np.flatnonzero(np.isfinite(poses.translation[:, 0])).tolist()
        interval = max(_POLISHED_INTERVAL, (times[solved[-1]] - times[solved[0]]) / _MOST_POLISHED)
        try:
            positions, alignment = self._aligned(poses, _spaced(solved, times, interval))
        except FactorsfmError as error:
            self.reason = str(error)
            return None
        self._last, self.reason = positions[-1], ""
        return self._graph([numbers[k] for k in positions], positions, alignment), alignment.scale

    def _aligned(self, poses: FramePoses, positions: list[int]) -> tuple[list[int], InertialAlignment]:
        """The alignment with some of the poses, and those of these that the recording covers; errors as there."""
        times = np.array(self._times)
        world_from_cam = poses.rotation.transpose(0, 2, 1)
        self._take(fit_timing(self._given, times, world_from_cam))
        start, end = self.recording.time[[0, -1]]
        positions = [position for position in positions if start <= times[position] <= end]
        centers = camera_centers(poses.rotation[positions], poses.translation[positions])
        visual = VisualPoses(times[positions], world_from_cam[positions], centers, poses.covariance[positions])
        return positions, align_inertial(self.recording, visual)

    def _graph(self, frames: list[int], positions: list[int], alignment: InertialAlignment) -> LiveGraph:
        time = np.array(self._times)[positions]
        return inertial_graph(self.recording, frames, time, alignment, GRAVITY_KEY)

    def _go_on(self, mapper: Mapper) -> None:
        times = self._times
        assert self._last is not None
        for position in _spaced(mapper.keyframes, times, _LEAST_INTERVAL):
            if times[position] - times[self._last] < _LEAST_INTERVAL:
                continue
            before, after = mapper.images[self._last], mapper.images[position]
            state = inertial_state(mapper.additions.present(), before.tracks.frame)
            assert state is not None
            frames, time = (before.tracks.frame, after.tracks.frame), (times[self._last], times[position])
            mapper.add_factors(*next_inertial_factor(self.recording, frames, time, before.pose, state))
            self._last = position


def restore_imu(imu: ImuSource | None, state: Mapping[str, Any] | None) -> None:
    """Let the IMU of a stream go on where the `ImuSource.state` of a snapshot was taken.

    Raises:
        InputError: one of them is missing.
    """
    if imu is None and state is not None:
        raise InputError("the snapshot is of a stream with an IMU; its recording must be given, too")
    if imu is not None and state is None:
        raise InputError("the snapshot is of a stream without an IMU; a recording cannot join it")
    if imu is not None and state is not None:
        imu.restore(state)


def _spaced(keyframes: Sequence[int], times: Sequence[float], interval: float) -> list[int]:
    """Keyframes that are not too close to each other, the last ones first chosen, in order of time."""
    chosen: list[int] = []
    for position in reversed(keyframes):
        if not chosen or times[chosen[-1]] - times[position] >= interval:
            chosen.append(position)
    return chosen[::-1]


def _live_poses(images: Sequence[MappedImage]) -> FramePoses:
    poses = FramePoses.none(len(images))
    for k, image in enumerate(images):
        if image.registered:
            poses.rotation[k], poses.translation[k] = image.pose
            poses.covariance[k] = _EXACT * np.eye(6) if image.covariance is None else image.covariance
    return poses
