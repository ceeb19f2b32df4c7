"""What an IMU gives to a finished result: up, and the poses of frames that show nothing."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.graph.factors_on_poses import FactorsOnPoses
from factorsfm.graph.inertial_chain import InertialState, posterior_state
from factorsfm.graph.inertial_gap import bridged_poses
from factorsfm.inertial.fit import ImuFit
from factorsfm.inertial.recording import ImuRecording
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.streaming.imu_source import ImuSource
from factorsfm.support.errors import InputError
from factorsfm.support.status import FrameStatus

Array = NDArray[np.float64]

_AROUND = 8  # registered frames to both sides of a gap
_LONGEST_GAP = 3.0  # seconds
_LARGEST_ROTATION_STD = np.radians(3.0)


def add_imu(result: Reconstruction, imu: ImuSource, factors: FactorsOnPoses | None, focal_std: float) -> None:
    """Give a result what the IMU says of it, and a note.

    Args:
        factors: on the poses of the result, None where the IMU took no part.
        focal_std: relative standard deviation of the focal length, by which lengths may be off; 0 where it is known.
    """
    if factors is None or not imu.takes_part or imu.timing is None or result.control is None or not result.metric:
        open_unit = "the camera does not move" if result.control is None else "it leaves the unit of length open"
        if result.control is not None and any(residual.contradicts for residual in result.control.residuals):
            open_unit = "its factors contradict the images"
        result.notes.append(f"IMU: it takes no part: {imu.reason or open_unit}.")
        return
    registered = {frame.index: frame for frame in result.registered}
    state, up_std = posterior_state(factors, {i: (_pose(f), f.covariance) for i, f in registered.items()})
    timing = imu.timing
    bridged = _bridge_gaps(result, imu.recording, state)
    result.imu = ImuFit(
        up=(-state.gravity / np.linalg.norm(state.gravity)).tolist(),
        up_std=float(np.degrees(np.hypot(up_std, timing.rotation_sigma))),
        scale_std=float(np.linalg.norm([result.control.scale_std, imu.recording.noise.accelerometer_scale, focal_std])),
        cam_from_imu=timing.cam_from_imu.tolist(),
        rotation_std=float(np.degrees(timing.rotation_sigma)),
        time_offset=timing.time_offset,
        time_offset_std=timing.time_offset_sigma,
        gyroscope_bias=state.gyroscope_bias.tolist(),
        accelerometer_bias=state.accelerometer_bias.tolist(),
        frames=bridged,
    )
    result.notes.append(_note(result.imu))


def _note(fit: ImuFit) -> str:
    offset, std = abs(fit.time_offset), fit.time_offset_std
    size = f"{1e3 * offset:.1f} ± {1e3 * std:.1f} ms" if offset < 10.0 else f"{offset:.4f} ± {std:.4f} s"
    note = (
        f"IMU: lengths are metres, known to {100 * fit.scale_std:.2g} %; up to {fit.up_std:.2g} degrees; its clock is "
        f"{size} {'behind' if fit.time_offset >= 0 else 'ahead of'} the video's."
    )
    return note + (f" The poses of {fit.frames} frames that show nothing are its own." if fit.frames else "")


def _pose(frame: FrameResult) -> tuple[Array, Array]:
    assert frame.cam_from_world is not None
    return frame.cam_from_world.rotation.matrix(), frame.cam_from_world.translation


def _bridge_gaps(result: Reconstruction, recording: ImuRecording, state: InertialState) -> int:
    """Pose the frames without one that the IMU leads to from those around them; their number."""
    bridged = 0
    for around, gap in _gaps(result.frames):
        time = np.array([result.frames[k].timestamp for k in around], np.float64)
        known = {
            row: (*_pose(result.frames[k]), covariance)
            for row, k in enumerate(around)
            if (covariance := result.frames[k].covariance) is not None
        }
        try:
            rotations, translations, covariances = bridged_poses(recording, time, known, state)
        except (InputError, RuntimeError):  # not covered by the recording, or indeterminate
            continue
        for row, k in enumerate(around):
            std = float(np.sqrt(np.linalg.eigvalsh(covariances[row][:3, :3])[-1]))
            if k in gap and std < _LARGEST_ROTATION_STD:
                _give_pose(result.frames[k], rotations[row], translations[row], covariances[row], std)
                bridged += 1
    return bridged


def _give_pose(frame: FrameResult, rotation: Array, translation: Array, covariance: Array, std: float) -> None:
    frame.cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
    frame.covariance = covariance
    place = 1e3 * float(np.sqrt(np.trace(covariance[3:, 3:])))
    why = f"{frame.status.value.replace('_', ' ')}: {frame.message}"
    frame.status = FrameStatus.INERTIAL
    frame.message = f"pose of the IMU, rotation to {np.degrees(std):.2g} degrees, position to {place:.2g} mm ({why})"


def _gaps(frames: Sequence[FrameResult]) -> Iterator[tuple[list[int], set[int]]]:
    """Runs of frames without a pose that are short enough: with registered ones to both sides, and alone."""
    registered = [frame.registered for frame in frames]
    k = 0
    while k < len(frames):
        end = k
        while end < len(frames) and not registered[end]:
            end += 1
        before = [i for i in range(k) if registered[i]][-_AROUND:]
        after = [i for i in range(end, len(frames)) if registered[i]][:_AROUND]
        first, last = frames[k].timestamp, frames[end - 1].timestamp
        short = first is not None and last is not None and last - first < _LONGEST_GAP
        if end > k and short and len(before) + len(after) >= 3:
            yield [*before, *range(k, end), *after], set(range(k, end))
        k = max(end, k + 1)
