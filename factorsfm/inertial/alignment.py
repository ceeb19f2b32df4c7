"""Visual-inertial alignment: scale, gravity, velocities and biases from the poses of keyframes and an IMU.

As the initialisation of VINS-Mono (Qin, Li, Shen, "VINS-Mono", 2018, section V.B) and of ORB-SLAM3 (Campos, Montiel,
Tardos, "Inertial-Only Optimization for Visual-Inertial Initialization", 2020), with the errors of the visual poses in
the weights. The equations stand in units of the map and are linear in the map units per metre, which multiply the
samples of the IMU: the noisy positions are measured, not regressed upon, so that their noise does not shrink the scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.inertial.preintegration import preintegrate
from factorsfm.inertial.recording import GRAVITY, ImuNoise, ImuRecording
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.rotations import cross_matrices, logarithm
from factorsfm.support.semidefinite import root_of, triangular_solution

Array = NDArray[np.float64]

_FEWEST_KEYFRAMES = 5
_LARGEST_SCALE_SIGMA = 0.1  # of ln scale, beyond which the motion does not determine it
_LARGEST_MISFIT = 25.0  # five standard deviations: the recording is another one, or its clock or axes are wrong
_GRAVITY_SIGMA = 0.02  # m/s^2: 9.78 to 9.83 on the Earth
_FREE_GRAVITY_SIGMA = 100.0  # m/s^2
_GRAVITY_TOLERANCE = 1.0  # m/s^2, beside three standard deviations: a phone's accelerometer is off by some per cent
_ITERATIONS = 12
_CONVERGED = 1e-5  # step of the scale, relative

# The unknowns beside the velocities: map units per metre, gravity in map units, biases.
_RHO, _GAMMA, _FORCE_BIAS, _TURN_BIAS, _SHARED = 0, slice(1, 4), slice(4, 7), slice(7, 10), 10


@dataclass(frozen=True, slots=True, eq=False)
class InertialAlignment:
    """What an IMU adds to a reconstruction without scale. Vectors are in the world of the reconstruction.

    Attributes:
        scale: metres per unit of the map.
        log_scale_sigma: standard deviation of ln scale.
        gravity: (3,) m/s^2, of magnitude 9.81, pointing down.
        gravity_sigma: standard deviation of its direction along the worst axis, radians.
        velocities: (m, 3) of the camera at the keyframes, m/s.
        gyroscope_bias, accelerometer_bias: (3,) in the camera's axes, rad/s and m/s^2.
        covariance: (10, 10) of ln scale, gravity (without its magnitude), accelerometer bias and gyroscope bias.
        free_gravity: magnitude of gravity, m/s^2, that the motion shows where 9.81 is not imposed.
        misfit: chi squared per degree of freedom. Above 1, the covariance is that much larger.
    """

    scale: float
    log_scale_sigma: float
    gravity: Array
    gravity_sigma: float
    velocities: Array
    gyroscope_bias: Array
    accelerometer_bias: Array
    covariance: Array
    free_gravity: float
    misfit: float

    @property
    def up(self) -> Array:
        """(3,) unit vector upwards in the world of the reconstruction."""
        return np.asarray(-self.gravity / np.linalg.norm(self.gravity))


@dataclass(frozen=True, slots=True, eq=False)
class VisualPoses:
    """Poses of m keyframes without scale.

    Attributes:
        time: (m,) seconds on the video's clock, ascending, m at least 5; some 0.2 to 0.5 s between two.
        world_from_cam: (m, 3, 3) rotations.
        center: (m, 3) in units of the map.
        covariance: (m, 6, 6) of `world_from_cam` perturbed on the right (rotation vector, translation; radians and map
            units), as `FrameResult.covariance` has it. The errors of different keyframes count as independent.

    Raises:
        InputError: shapes that do not agree, values that are not finite, too few keyframes or times that do not ascend.
    """

    time: Array
    world_from_cam: Array
    center: Array
    covariance: Array

    def __post_init__(self) -> None:
        m = np.size(self.time)
        shapes = {"time": (m,), "world_from_cam": (m, 3, 3), "center": (m, 3), "covariance": (m, 6, 6)}
        for name, shape in shapes.items():
            array = np.asarray(getattr(self, name), np.float64)
            object.__setattr__(self, name, array)
            if array.shape != shape:
                raise InputError(f'"{name}" of keyframes has the shape {array.shape}; {shape} is expected')
            if not np.isfinite(array).all():
                raise InputError(f'"{name}" of keyframes holds values that are not finite')
        if m < _FEWEST_KEYFRAMES:
            raise InputError(f"{m} keyframes are given; an IMU needs at least {_FEWEST_KEYFRAMES} to find the scale")
        if not (np.diff(self.time) > 0).all():
            raise InputError("the times of keyframes do not ascend")
        spread = np.linalg.eigvalsh((self.covariance + self.covariance.swapaxes(1, 2)) / 2)
        if (spread[:, 0] < -1e-9 * spread[:, -1]).any():
            raise InputError("the covariance of a keyframe has a negative eigenvalue; it is none")


def align_inertial(recording: ImuRecording, poses: VisualPoses) -> InertialAlignment:
    """Find metric scale, gravity, velocities and biases; the biases are those at the first keyframe.

    Some ten seconds are enough; the time it takes grows with the cube of the number of keyframes.

    Args:
        recording: its rotation to the camera and time offset must be known; it covers the keyframes.
        poses: of the keyframes.

    Raises:
        InputError: the recording does not cover the keyframes, or its mounting or time offset is unknown.
        ReconstructionError: the motion does not determine the scale, or contradicts the recording.
    """
    recording = recording.at_camera()
    shared, velocities = _first_values(recording, poses)
    free = _solve(recording, poses, shared, velocities, _FREE_GRAVITY_SIGMA)
    _check(free)
    return _alignment(_solve(recording, poses, free.shared, free.velocities, _GRAVITY_SIGMA), free.gravity)


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Unknowns `shared` (10,) and `velocities` (m, 3), map units; covariance of the former; chi squared per degree."""

    shared: Array
    velocities: Array
    covariance: Array
    misfit: float

    @property
    def gravity(self) -> float:
        """Magnitude, m/s^2."""
        return float(np.linalg.norm(self.shared[_GAMMA]) / self.shared[_RHO])

    @property
    def gravity_sigma(self) -> float:
        """Standard deviation of `gravity`, m/s^2."""
        gamma = np.linalg.norm(self.shared[_GAMMA])
        slope = np.zeros(_SHARED)
        slope[_GAMMA] = self.shared[_GAMMA] / gamma / self.shared[_RHO]
        slope[_RHO] = -self.gravity / self.shared[_RHO]
        return float(np.sqrt(slope @ self.covariance @ slope))

    @property
    def log_scale_sigma(self) -> float:
        return float(np.sqrt(self.covariance[_RHO, _RHO]) / self.shared[_RHO])


def _first_values(recording: ImuRecording, poses: VisualPoses) -> tuple[Array, Array]:
    """Unknowns from unweighted equations: the gyroscope's bias from the rotations, then the rest without biases."""
    shared, velocities = np.zeros(_SHARED), np.zeros((len(poses.time), 3))
    for _ in range(2):
        residual, slope, _ = _equations(recording, poses, shared, velocities)
        turns = residual.reshape(-1, 9)[:, :3].ravel()
        by_bias = slope.reshape(-1, 9, slope.shape[1])[:, :3, _TURN_BIAS].reshape(-1, 3)
        shared[_TURN_BIAS] -= np.linalg.lstsq(by_bias, turns, rcond=None)[0]
    residual, slope, _ = _equations(recording, poses, shared, velocities)
    columns = [_RHO, 1, 2, 3, *range(_SHARED, slope.shape[1])]
    basis = np.linalg.qr(slope[:, columns[1:]])[0]  # of what gravity and velocities explain
    camera, imu = (motion - basis @ (basis.T @ motion) for motion in (residual, -slope[:, _RHO]))
    correlation = camera @ imu / max(float(np.linalg.norm(camera) * np.linalg.norm(imu)), 1e-300)
    if not correlation > 0:
        raise ReconstructionError(
            f"the accelerations of the IMU and of the camera have a correlation of {correlation:.2f}, near 1 is "
            "expected: the camera accelerates too little, or the clock or the axes of the IMU are wrong"
        )
    step = np.linalg.lstsq(slope[:, columns], -residual, rcond=None)[0]
    shared[:4] = step[:4]
    return shared, np.asarray(step[4:].reshape(-1, 3), np.float64)


def _solve(
    recording: ImuRecording, poses: VisualPoses, shared: Array, velocities: Array, gravity_sigma: float
) -> _Solution:
    """Gauss-Newton on the weighted equations, with the priors of the biases and of the magnitude of gravity."""
    shared, velocities = shared.copy(), velocities.copy()
    for _ in range(_ITERATIONS):
        residual, slope, covariance = _equations(recording, poses, shared, velocities)
        whitened = triangular_solution(root_of(covariance), np.column_stack([slope, residual]))
        rows = np.vstack([whitened, _priors(recording.noise, shared, gravity_sigma, velocities.size)])
        size = np.linalg.norm(rows[:, :-1], axis=0)
        # The triangle of the unknowns with the residuals as the last column; what they do not explain is its corner.
        triangle = np.asarray(np.linalg.qr(rows / np.append(size, 1.0), mode="r"))
        triangle[:-1, :-1] += 1e-12 * np.eye(len(size))  # what is open altogether stays where it is
        inverse = triangular_solution(triangle[:-1, :-1], np.eye(len(size))) / size[:, None]
        step = -inverse @ triangle[:-1, -1]
        # A ratio must stay positive; far from the solution half of it is enough of a step.
        shared += step[:_SHARED] * min(1.0, shared[_RHO] / 2 / max(abs(step[_RHO]), 1e-300))
        velocities += step[_SHARED:].reshape(-1, 3)
        if abs(step[_RHO]) < _CONVERGED * shared[_RHO]:
            break
    misfit = float(triangle[-1, -1] ** 2 / (len(rows) - len(size)))
    return _Solution(shared, velocities, inverse[:_SHARED] @ inverse[:_SHARED].T * max(1.0, misfit), misfit)


def _equations(
    recording: ImuRecording, poses: VisualPoses, shared: Array, velocities: Array
) -> tuple[Array, Array, Array]:
    """Rotation, velocity and position (9 rows) of each interval, camera less IMU, in the camera's axes at its start.

    Returns:
        The residuals (9 n,), their derivatives by the unknowns and the velocities (9 n, 10 + 3 m), and their
        covariance (9 n, 9 n).
    """
    rho, gamma = shared[_RHO], shared[_GAMMA]
    motion = preintegrate(recording, poses.time[:-1], poses.time[1:], shared[_TURN_BIAS], shared[_FORCE_BIAS])
    n, t = len(motion.duration), motion.duration[:, None]
    cam_from_world = poses.world_from_cam[:-1].swapaxes(1, 2)
    turned = cam_from_world @ poses.world_from_cam[1:]
    faster = np.einsum("nij,nj->ni", cam_from_world, np.diff(velocities, axis=0) - gamma * t)
    moved = np.diff(poses.center, axis=0) - velocities[:-1] * t - gamma * t**2 / 2
    moved = np.einsum("nij,nj->ni", cam_from_world, moved)
    residual = np.hstack(
        [
            logarithm(motion.rotation.swapaxes(1, 2) @ turned),
            faster - rho * motion.velocity,
            moved - rho * motion.position,
        ]
    )
    units = np.repeat([1.0, rho, rho], 3)
    slope = np.zeros((n, 9, _SHARED + velocities.size))
    slope[:, 3:6, _RHO], slope[:, 6:, _RHO] = -motion.velocity, -motion.position
    slope[:, 3:6, _GAMMA] = -cam_from_world * t[:, :, None]
    slope[:, 6:, _GAMMA] = -cam_from_world * t[:, :, None] ** 2 / 2
    by_bias = -units[:, None] * motion.by_bias
    slope[:, :, _TURN_BIAS], slope[:, :, _FORCE_BIAS] = by_bias[:, :, :3], by_bias[:, :, 3:]
    for k in range(n):
        here = _SHARED + 3 * k
        slope[k, 3:6, here : here + 3], slope[k, 3:6, here + 3 : here + 6] = -cam_from_world[k], cam_from_world[k]
        slope[k, 6:, here : here + 3] = -cam_from_world[k] * t[k]
    covariance = _visual_covariance(poses.covariance, turned, faster, moved)
    covariance += _walk_covariance(recording.noise, np.cumsum(motion.duration) - motion.duration / 2, by_bias)
    block = covariance.reshape(n, 9, n, 9)
    block[np.arange(n), :, np.arange(n)] += units[:, None] * motion.covariance * units
    return residual.ravel(), slope.reshape(9 * n, -1), covariance


def _visual_covariance(covariance: Array, turned: Array, faster: Array, moved: Array) -> Array:
    """(9 n, 9 n) covariance of the residuals from the errors of the poses, which neighbouring intervals share."""
    n = len(turned)
    by_pose = np.zeros((n, 9, n + 1, 6))
    here = np.arange(n)
    by_pose[here, :3, here, :3], by_pose[here, :3, here + 1, :3] = -turned.swapaxes(1, 2), np.eye(3)
    by_pose[here, 3:6, here, :3] = cross_matrices(faster)
    by_pose[here, 6:, here, :3] = cross_matrices(moved)
    by_pose[here, 6:, here, 3:], by_pose[here, 6:, here + 1, 3:] = -np.eye(3), turned
    weighed = np.einsum("nrmc,mcd->nrmd", by_pose, covariance)
    return np.asarray(weighed.reshape(9 * n, -1) @ by_pose.reshape(9 * n, -1).T)


def _walk_covariance(noise: ImuNoise, middle: Array, by_bias: Array) -> Array:
    """(9 n, 9 n) covariance of the residuals from the random walks of the biases since the first keyframe.

    Args:
        middle: (n,) seconds from the first keyframe to the middle of each interval.
        by_bias: (n, 9, 6) derivatives of the residuals by the biases.
    """
    n = len(middle)
    walk = np.repeat([noise.gyroscope_walk, noise.accelerometer_walk], 3) * by_bias
    shared = np.minimum(middle[:, None], middle)
    return np.asarray(np.einsum("nri,mci->nrmc", walk, walk) * shared[:, None, :, None]).reshape(9 * n, 9 * n)


def _priors(noise: ImuNoise, shared: Array, gravity_sigma: float, others: int) -> Array:
    """Whitened rows of the biases and of the magnitude of gravity: derivatives and residual, (7, 10 + others + 1)."""
    slope = np.zeros((7, _SHARED))
    slope[:3, _FORCE_BIAS] = np.eye(3) / noise.accelerometer_bias
    slope[3:6, _TURN_BIAS] = np.eye(3) / noise.gyroscope_bias
    gamma = float(np.linalg.norm(shared[_GAMMA]))
    sigma = gravity_sigma * shared[_RHO]
    slope[6, _GAMMA], slope[6, _RHO] = shared[_GAMMA] / gamma / sigma, -GRAVITY / sigma
    # All are linear in the unknowns, the magnitude along its own direction.
    return np.column_stack([slope, np.zeros((7, others)), slope @ shared])


def _check(free: _Solution) -> None:
    """Refuse a motion that contradicts the recording, leaves the scale open, or shows another planet's gravity."""
    if free.misfit > _LARGEST_MISFIT:
        raise ReconstructionError(
            f"the IMU contradicts the motion of the camera: their differences are {free.misfit**0.5:.1f} times as "
            "large as expected; its clock, its axes or the recording is wrong"
        )
    if free.log_scale_sigma > _LARGEST_SCALE_SIGMA:
        raise ReconstructionError(
            f"the motion does not determine the metric scale: its standard deviation is "
            f"{100 * free.log_scale_sigma:.0f} %, at most {100 * _LARGEST_SCALE_SIGMA:.0f} % is accepted; "
            "the camera must accelerate more"
        )
    if abs(free.gravity - GRAVITY) > _GRAVITY_TOLERANCE + 3 * free.gravity_sigma:
        raise ReconstructionError(
            f"the IMU contradicts the motion of the camera: they show a gravity of {free.gravity:.2f} m/s^2 with a "
            f"standard deviation of {free.gravity_sigma:.2f}, {GRAVITY:g} is expected; "
            "its clock, its axes or its units are wrong"
        )


def _alignment(solution: _Solution, free_gravity: float) -> InertialAlignment:
    rho, gamma = float(solution.shared[_RHO]), solution.shared[_GAMMA]
    length = float(np.linalg.norm(gamma))
    direction = gamma / length
    change = np.eye(_SHARED)  # of ln scale, gravity without its magnitude, and the biases, by the unknowns
    change[0, 0] = -1.0 / rho
    change[1:4, 1:4] = GRAVITY / length * (np.eye(3) - np.outer(direction, direction))
    covariance = change @ solution.covariance @ change.T
    return InertialAlignment(
        scale=1.0 / rho,
        log_scale_sigma=solution.log_scale_sigma,
        gravity=GRAVITY * direction,
        gravity_sigma=float(np.sqrt(np.linalg.eigvalsh(covariance[1:4, 1:4])[-1])) / GRAVITY,
        velocities=solution.velocities / rho,
        gyroscope_bias=solution.shared[_TURN_BIAS],
        accelerometer_bias=solution.shared[_FORCE_BIAS],
        covariance=covariance,
        free_gravity=free_gravity,
        misfit=solution.misfit,
    )
