"""Clock and axes of an IMU against a camera, from the rotation of the camera and the gyroscope.

The turn of the camera over a fifth of a second is compared with that of the gyroscope. A turn has the same angle in all
axes, and its rotation vector turns with the axes: ``log(C) = cam_from_imu @ log(G)``, exactly. A search finds the time
offset of the largest correlation, each with its best rotation (Kabsch 1976); least squares refine both there.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.inertial.recording import ImuRecording
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.rotations import cross_matrices, exponential, logarithm, nearest_rotation
from factorsfm.support.semidefinite import covariance_of, deviations

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

_SPAN = 0.2  # seconds of a turn: about half a swing of a hand, which makes it as large as it gets
_REACH = 2.0  # seconds of the search to both sides
_STEP = 0.01  # seconds of the search
_LOBE = 0.25  # seconds around the best offset in which the correlation is high, too
_SEARCHED = 2000  # turns in the search; all of them are in the fit
_LEAST_TURNS = 10
_LEAST_SHARE = 0.5  # of the turns of the camera that the recording must cover
_CAMERA_NOISE = np.radians(0.1)  # of a rotation of the camera, in the residual that is expected
_LOWEST_CORRELATION = 0.8
_SECOND_BEST = 2.0  # times the best unexplained variance, which an offset elsewhere must exceed
_LARGEST_OFFSET_SIGMA = 0.01  # seconds
_LARGEST_ROTATION_SIGMA = np.radians(3.0)
_ITERATIONS = 10


@dataclass(frozen=True, slots=True, eq=False)
class ImuTiming:
    """The fit of a gyroscope to the rotation of a camera.

    Attributes:
        time_offset: seconds to add to the IMU's time to get the video's.
        time_offset_sigma: its standard deviation, seconds; 0 if it was given.
        cam_from_imu: (3, 3) rotation from the IMU's axes to the camera's.
        rotation_covariance: (3, 3) of its error, a rotation vector in the camera's axes, radians squared; zero if the
            rotation was given.
        gyroscope_bias: (3,) in the IMU's axes, rad/s.
        correlation: of the turns of camera and gyroscope, 0 to 1.
        residual: of the angular velocity along one axis, root of the mean square, rad/s.
    """

    time_offset: float
    time_offset_sigma: float
    cam_from_imu: Array
    rotation_covariance: Array
    gyroscope_bias: Array
    correlation: float
    residual: float

    @property
    def rotation_sigma(self) -> float:
        """Standard deviation of the rotation about its worst axis, radians."""
        return float(np.sqrt(np.linalg.eigvalsh(self.rotation_covariance)[-1]))

    def applied(self, recording: ImuRecording) -> ImuRecording:
        """The recording with this rotation and time offset."""
        return dataclasses.replace(recording, cam_from_imu=self.cam_from_imu, time_offset=self.time_offset)


def fit_timing(recording: ImuRecording, time: Array, world_from_cam: Array) -> ImuTiming:
    """Estimate what is unknown of the time offset and the rotation to the camera; what is known is checked.

    The offset is searched within 2 s of equal clocks, or of equal starts where the clocks do not overlap so.

    Args:
        recording: of the IMU; its `time_offset` and `cam_from_imu` are held where they are known.
        time: (n,) seconds on the video's clock, ascending, of the middle row where the shutter rolls.
        world_from_cam: (n, 3, 3) rotations of successive frames; NaN where a frame has none.

    Raises:
        InputError: shapes that do not agree, times that do not ascend, or a recording that does not cover the frames.
        ReconstructionError: the rotations do not agree, or leave the time offset or the rotation to the camera open.
    """
    time, turns = _camera_turns(time, world_from_cam)
    start = _search_center(recording, time)
    gyroscope = _Gyroscope(recording, time.min() - start - _REACH - _SPAN, time.max() - start + _REACH + _SPAN)
    if recording.time_offset is None:
        offset = _search(gyroscope, time, turns, start, recording.cam_from_imu)
    else:
        offset = recording.time_offset
    return _fit(recording, gyroscope, time, turns, offset)


def _camera_turns(time: Array, world_from_cam: Array) -> tuple[Array, Array]:
    """Start and end (n, 2) and rotation vector (n, 3) of the turns of a camera, each over `_SPAN` or a little more."""
    time, rotations = np.asarray(time, np.float64), np.asarray(world_from_cam, np.float64)
    n = np.size(time)
    if time.shape != (n,) or rotations.shape != (n, 3, 3):
        raise InputError(
            f"times and rotations have the shapes {time.shape} and {rotations.shape}; (n,), (n, 3, 3) are expected"
        )
    known = np.isfinite(rotations).all(axis=(1, 2))
    time, rotations = time[known], rotations[known]
    if not np.isfinite(time).all() or (np.diff(time) <= 0).any():
        raise InputError("the times of the frames do not ascend")
    last = np.searchsorted(time, time + _SPAN - 1e-6)
    first = np.flatnonzero(last < len(time))
    last = last[first]
    close = time[last] - time[first] < 2 * _SPAN
    first, last = first[close], last[close]
    if len(first) < _LEAST_TURNS:
        raise InputError(f"{known.sum()} frames with a rotation are too few to compare with a gyroscope")
    turns = logarithm(rotations[first].swapaxes(1, 2) @ rotations[last])
    return np.column_stack([time[first], time[last]]), turns


def _search_center(recording: ImuRecording, time: Array) -> float:
    """Seconds to add to the IMU's time so that its clock is about the video's."""
    if recording.time_offset is not None:
        return recording.time_offset
    shared = min(recording.time[-1], time.max()) - max(recording.time[0], time.min())
    together = shared + _REACH > _LEAST_SHARE * (time.max() - time.min())
    return 0.0 if together else float(time.min() - recording.time[0])


class _Gyroscope:
    """Turns of the gyroscope between any two times of a part of a recording, in the IMU's axes."""

    def __init__(self, recording: ImuRecording, start: float, end: float) -> None:
        part = (recording.time >= start) & (recording.time <= end)
        if part.sum() < 2:
            raise InputError(
                f"the recording of the IMU covers {recording.time[0]:.3f} to {recording.time[-1]:.3f} s of its clock, "
                f"the frames are about {start + _REACH:.3f} to {end - _REACH:.3f} s"
            )
        self.time = recording.time[part]
        samples = recording.gyroscope[part]
        self._rate = (samples[1:] + samples[:-1]) / 2
        self._rotation = np.empty((len(samples), 3, 3))
        self._rotation[0] = np.eye(3)
        for k, step in enumerate(exponential(self._rate * np.diff(self.time)[:, None])):
            self._rotation[k + 1] = self._rotation[k] @ step

    def covers(self, time: Array) -> Bools:
        """(n,) whether intervals (n, 2) lie in the recording."""
        return np.asarray((time[:, 0] >= self.time[0]) & (time[:, 1] <= self.time[-1]))

    def turns(self, time: Array) -> Array:
        """Rotation vectors (n, 3) over intervals (n, 2), which it covers."""
        start, end = (self._orientation(t) for t in time.T)
        return logarithm(start.swapaxes(1, 2) @ end)

    def _orientation(self, time: Array) -> Array:
        k = np.clip(np.searchsorted(self.time, time, "right") - 1, 0, len(self._rate) - 1)
        return self._rotation[k] @ exponential(self._rate[k] * (time - self.time[k])[:, None])


def _search(gyroscope: _Gyroscope, time: Array, turns: Array, start: float, cam_from_imu: Array | None) -> float:
    """The offset with the largest correlation."""
    thin = slice(None, None, -(-len(time) // _SEARCHED))
    time, turns = time[thin], turns[thin]
    offsets = start + np.arange(-_REACH, _REACH + _STEP / 2, _STEP)
    correlation = np.full(len(offsets), -1.0)
    for k, offset in enumerate(offsets):
        inside = gyroscope.covers(time - offset)
        if inside.sum() >= max(_LEAST_TURNS, _LEAST_SHARE * len(time)):
            seen = gyroscope.turns(time[inside] - offset)
            correlation[k] = _correlation(turns[inside], seen, time[inside], cam_from_imu)[0]
    best = int(np.argmax(correlation))
    if correlation[best] < 0:
        raise InputError(
            f"the recording of the IMU covers too little of the frames: {gyroscope.time[0]:.3f} to "
            f"{gyroscope.time[-1]:.3f} s of its clock, the frames are {time.min():.3f} to {time.max():.3f} s"
        )
    peaks = np.flatnonzero((correlation[1:-1] >= correlation[:-2]) & (correlation[1:-1] >= correlation[2:])) + 1
    peaks = peaks[abs(offsets[peaks] - offsets[best]) > _LOBE]
    if len(peaks) and correlation[best] > _LOWEST_CORRELATION:  # a lower one is refused for itself
        second = peaks[np.argmax(correlation[peaks])]
        if 1 - correlation[second] ** 2 < _SECOND_BEST * (1 - correlation[best] ** 2):
            raise ReconstructionError(
                f"the time offset of the IMU is open: {offsets[best]:.2f} s (correlation {correlation[best]:.3f}) and "
                f"{offsets[second]:.2f} s ({correlation[second]:.3f}) fit the video about as well"
            )
    return float(offsets[best])


def _correlation(turns: Array, seen: Array, time: Array, cam_from_imu: Array | None) -> tuple[float, Array]:
    """Correlation of the angular velocities of camera and gyroscope, less their means; and the best rotation."""
    duration = np.diff(time, axis=1)
    a, b = turns / duration, seen / duration
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    rotation = nearest_rotation(a.T @ b) if cam_from_imu is None else cam_from_imu
    return float(np.sum(a * (b @ rotation.T)) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)), rotation


def _fit(recording: ImuRecording, gyroscope: _Gyroscope, time: Array, turns: Array, offset: float) -> ImuTiming:
    """Least squares for offset, rotation and bias from a first offset."""
    inside = gyroscope.covers(time - offset + [-2 * _STEP, 2 * _STEP])
    if inside.sum() < max(_LEAST_TURNS, _LEAST_SHARE * len(time)):
        raise InputError(f"the recording of the IMU covers {inside.mean():.0%} of the frames; half of them is needed")
    time, turns = time[inside], turns[inside]
    duration = np.diff(time, axis=1)
    rotation = _correlation(turns, gyroscope.turns(time - offset), time, recording.cam_from_imu)[1]
    bias, first = np.zeros(3), offset
    held = np.repeat([recording.time_offset is not None, recording.cam_from_imu is not None, False], [1, 3, 3])
    for _ in range(_ITERATIONS):
        seen = gyroscope.turns(time - offset) - duration * bias
        turned = seen @ rotation.T
        slope = np.zeros((len(turns), 3, 7))  # by offset, rotation, bias
        slope[:, :, 0] = (
            (gyroscope.turns(time - offset + 1e-3) - gyroscope.turns(time - offset - 1e-3)) @ rotation.T / 2e-3
        )
        slope[:, :, 1:4] = cross_matrices(turned)
        slope[:, :, 4:] = duration[:, :, None] * rotation
        slope[:, :, held] = 0.0
        residual = turns - turned
        spread = float(np.sqrt(np.mean(residual**2)))
        covariance, step = _normal_equations(slope, residual, max(spread, 1e-9), recording.noise.gyroscope_bias, time)
        offset = float(np.clip(offset - step[0], first - _STEP, first + _STEP))
        rotation = exponential(-step[None, 1:4])[0] @ rotation
        bias = bias - step[4:]
    covariance[held], covariance[:, held] = 0.0, 0.0
    timing = ImuTiming(
        time_offset=offset,
        time_offset_sigma=float(deviations(covariance)[0]),
        cam_from_imu=rotation,
        rotation_covariance=covariance[1:4, 1:4],
        gyroscope_bias=bias,
        correlation=_correlation(turns, gyroscope.turns(time - offset), time, rotation)[0],
        residual=float(np.sqrt(np.mean((residual / duration) ** 2))),
    )
    _check(timing, recording, turns)
    return timing


def _normal_equations(
    slope: Array, residual: Array, spread: float, bias_sigma: float, time: Array
) -> tuple[Array, Array]:
    """Covariance (7, 7) and step (7,) of offset, rotation and bias.

    Turns overlap, so that their errors are correlated: the covariance is that of Newey and West (1987), with the
    correlation over two spans.
    """
    loose = np.diag(1.0 / np.repeat([_REACH, np.pi, bias_sigma], [1, 3, 3]) ** 2)  # holds what the motion leaves open
    rows = slope.reshape(-1, 7)
    inverse = covariance_of(rows.T @ rows / spread**2 + loose)
    scores = np.einsum("nri,nr->ni", slope, residual) / spread**2
    lags = min(len(scores) - 1, int(np.ceil(2 * _SPAN / np.median(np.diff(time[:, 0])))))
    middle = scores.T @ scores + loose
    for lag in range(1, lags + 1):
        product = scores[lag:].T @ scores[:-lag]
        middle += (1 - lag / (lags + 1)) * (product + product.T)
    return inverse @ middle @ inverse, inverse @ scores.sum(axis=0)


def _check(timing: ImuTiming, recording: ImuRecording, turns: Array) -> None:
    """Refuse a recording that does not fit, or a motion that leaves something open."""
    rate = np.degrees(np.sqrt(np.mean((turns - turns.mean(axis=0)) ** 2))) / _SPAN
    expected = np.degrees(np.hypot(recording.noise.gyroscope / _SPAN**0.5, _CAMERA_NOISE * 2**0.5 / _SPAN))
    if timing.correlation < _LOWEST_CORRELATION:
        raise ReconstructionError(
            f"the gyroscope does not fit the video: the correlation of its angular velocity with the camera's is "
            f"{timing.correlation:.2f} at best, at an offset of {timing.time_offset:.2f} s, and their difference "
            f"{np.degrees(timing.residual):.2g} deg/s; {_LOWEST_CORRELATION:g} and about {expected:.2g} deg/s are "
            f"expected (the camera's own changes by {rate:.2g} deg/s)"
        )
    if timing.time_offset_sigma > _LARGEST_OFFSET_SIGMA:
        raise ReconstructionError(
            f"the motion leaves the time offset of the IMU open: its standard deviation is "
            f"{1e3 * timing.time_offset_sigma:.0f} ms, at most {1e3 * _LARGEST_OFFSET_SIGMA:.0f} ms is accepted; "
            f"the camera's angular velocity changes by {rate:.2g} deg/s only"
        )
    if timing.rotation_sigma > _LARGEST_ROTATION_SIGMA:
        axis = np.linalg.eigh(timing.rotation_covariance)[1][:, -1]
        raise ReconstructionError(
            f"the motion leaves the rotation between the IMU and the camera open: its standard deviation about the "
            f"camera's axis ({', '.join(f'{value:.2f}' for value in axis)}) is {np.degrees(timing.rotation_sigma):.0f} "
            "degrees, since the camera turns about this axis alone; this rotation must be given"
        )
