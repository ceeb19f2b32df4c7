"""Estimation problems with exact truth, made from synthetic scenes, and how far a solution is from it."""

from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from factorsfm.adjustment.observations import Observations, PriorObservations
from factorsfm.adjustment.state import State
from factorsfm.camera.projection import normalized_from_pixels, pixels_from_normalized
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.status import FrameStatus
from factorsfm.synthetic import synthetic_scene
from factorsfm.tracks.image_tracks import ImageTracks

FIELD = (4, 3)  # columns and rows of the nodes of the smooth field of a prior


@dataclass(frozen=True)
class Problem:
    """The truth, with the first camera as the world and a median inverse distance of 1, and what was observed.

    `points` (n, 3) are the Euclidean points of `truth` in its unit; `focal` and `noise_px` in pixels.
    """

    truth: State
    points: np.ndarray
    observations: Observations
    focal: float
    noise_px: float

    @property
    def frames(self):
        return len(self.truth.rotation)

    def of_frame(self, frame):
        """Points (ids) that a frame observes and their normalised coordinates."""
        mine = self.observations.frame == frame
        return self.observations.point[mine], self.xy[mine]

    @property
    def xy(self):
        """(m, 2) undistorted normalised coordinates of the observations, of the true lens without distortion."""
        return self.observations.pixels / self.focal

    def depth(self, frame, ids):
        return (self.points[ids] @ self.truth.rotation[frame].T + self.truth.translation[frame])[:, 2]


def make_problem(motion, *, frames=10, points=100, parallax=0.05, noise_px=0.0, seed=0):
    """Points seen by all frames of a `synthetic_scene`, in observations sorted by point."""
    scene = synthetic_scene(motion, frames=frames, points=points, parallax=parallax, seed=seed)
    seen = scene.observe(noise_px, seed)
    everywhere = np.flatnonzero(np.bincount(np.concatenate([ids for ids, _ in seen])) == frames)
    n = len(everywhere)
    xy = np.stack([normalized_from_pixels(scene.camera, uv[np.isin(ids, everywhere)]) for ids, uv in seen], 1)
    points = scene.points[everywhere]
    unit = np.median(1 / np.linalg.norm(points, axis=1))
    points = points * unit
    distance = np.linalg.norm(points, axis=1)
    focal = scene.camera.focal_length_x
    truth = State(
        rotation=np.array([pose.rotation.matrix() for pose in scene.cam_from_world]),
        translation=np.array([pose.translation for pose in scene.cam_from_world]) * unit,
        bearing=points / distance[:, None],
        inverse_distance=1 / distance,
        log_focal=np.log([focal]),
    )
    frame, point = np.tile(np.arange(frames), n), np.repeat(np.arange(n), frames)
    observations = Observations(frame, point, focal * xy.reshape(-1, 2))
    return Problem(truth, points, observations, focal, noise_px)


def with_points(problem, points, pixels):
    """The problem with further points, which all frames see.

    Args:
        points: (n, 3), where the solution has them; pixels: (n, frames, 2) where they are seen, whatever moves them.
    """
    truth, o, first, frames = problem.truth, problem.observations, len(problem.points), problem.frames
    observations = Observations(
        np.r_[o.frame, np.tile(np.arange(frames), len(points))],
        np.r_[o.point, np.repeat(first + np.arange(len(points)), frames)],
        np.r_[o.pixels, pixels.reshape(-1, 2)],
    )
    distance = np.linalg.norm(points, axis=1)
    truth = replace(
        truth,
        bearing=np.r_[truth.bearing, points / distance[:, None]],
        inverse_distance=np.r_[truth.inverse_distance, 1.0 / distance],
    )
    return replace(problem, truth=truth, points=np.r_[problem.points, points], observations=observations)


def pinhole(focal):
    return pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=360, params=[focal, 320.0, 180.0])


def tracks_at(position, ids, xy, depth=None, *, focal=1.0):
    """Tracks of an image at normalised coordinates (n, 2), seen by a pinhole."""
    camera = pinhole(focal)
    return ImageTracks(position, ids, pixels_from_normalized(camera, xy), camera, depth)


def image_depth(problem, frame, ids, *, scale=1.0, shift=0.0, noise=0.0, seed=0):
    """A prior at some points of a frame: ``scale / z + shift`` and noise, everywhere reliable."""
    value = scale / problem.depth(frame, ids) + shift
    value = value + noise * np.random.default_rng([seed, frame]).standard_normal(len(ids))
    return ImageDepth(value, np.ones(len(ids)), unit=1.0)


def mapped_images(problem, state, *, guess=1.0, guided=(), **prior):
    """The frames as the mapper sees them, at the poses of `state`; `guided` ones carry a prior (see `image_depth`).

    `guess`: focal length of the mapper's cameras over the true one, one or one for each frame.
    """
    images, guess = [], np.broadcast_to(guess, problem.frames)
    for k in range(problem.frames):
        ids, xy = problem.of_frame(k)
        depth = image_depth(problem, k, ids, **prior) if k in guided else None
        tracks = tracks_at(k, ids, xy / guess[k], depth, focal=guess[k] * problem.focal)
        images.append(MappedImage(tracks, FrameStatus.REGISTERED, "", state.rotation[k], state.translation[k]))
    return images


def rotation_matrices(vectors):
    return np.array([pycolmap.Rotation3d(vector).matrix() for vector in np.reshape(vectors, (-1, 3))])


def perturbed(state, seed=0, *, angle_rad=0.003, shift=0.01, structure=0.1):
    """A start away from the truth; the first camera stays where it is."""
    rng = np.random.default_rng([seed, 7])
    turn = rotation_matrices(angle_rad * rng.standard_normal((len(state.rotation), 3)))
    move = shift * rng.standard_normal(state.translation.shape)
    turn[0], move[0] = np.eye(3), 0.0
    bearing = state.bearing + 0.003 * rng.standard_normal(state.bearing.shape)
    return replace(
        state,
        rotation=turn @ state.rotation,
        translation=state.translation + move,
        bearing=bearing / np.linalg.norm(bearing, axis=1, keepdims=True),
        inverse_distance=state.inverse_distance * np.exp(structure * rng.standard_normal(len(state.bearing))),
    )


def in_unit_of(state, truth):
    """The same solution with the median inverse distance relative to the truth brought to 1."""
    unit = np.median(state.inverse_distance / truth.inverse_distance)
    return replace(state, translation=state.translation * unit, inverse_distance=state.inverse_distance / unit)


def angles_between(a, b):
    """(k,) angles between rotations (radians), exact for small ones too."""
    return np.linalg.norm(np.swapaxes(a, -1, -2) @ b - np.eye(3), axis=(-2, -1)) / np.sqrt(2)


def centers(rotation, translation):
    return -np.einsum("kji,kj->ki", rotation, translation)


def with_prior(problem, images, *, noise=0.05, smooth=0.0, scale_std=0.15, shift_std=0.08, seed=0):
    """A prior on some frames, drawn from its own model: the values, and the truth that carries its variables."""
    rng = np.random.default_rng([seed, 3])
    truth, n, k = problem.truth, len(problem.points), len(images)
    columns, rows = FIELD
    low, high = truth.bearing[:, :2].min(0), truth.bearing[:, :2].max(0)
    position = (truth.bearing[:, :2] - low) / (high - low) * [columns - 1.001, rows - 1.001]
    cell, (x, y) = position.astype(int), (position % 1).T
    nodes = (cell[:, 1] * columns + cell[:, 0])[:, None] + [0, 1, columns, columns + 1]
    weights = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], -1)
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
    near = np.exp(-np.linalg.norm(grid[:, None] - grid[None], axis=2) / 2) + 1e-6 * np.eye(columns * rows)
    covariance = max(smooth, 1e-3) ** 2 * near
    field = np.linalg.cholesky(covariance) @ rng.standard_normal(len(covariance)) * (smooth > 0)
    scale, shift = 1 + scale_std * rng.standard_normal(k), shift_std * rng.standard_normal(k)
    image, point = np.tile(np.arange(k), n), np.repeat(np.arange(n), k)
    frame = np.asarray(images)[image]
    inverse = truth.inverse_distance[point] / truth.camera_points(frame, point)[:, 2]
    error = (field[nodes] * weights).sum(1)[point]
    value = scale[image] * (inverse + error) + shift[image] + noise * rng.standard_normal(n * k)
    prior = PriorObservations(
        image, frame, point, value, np.full(n * k, max(noise, 1e-3)), nodes[point], weights[point],
        np.linalg.inv(covariance), scale_std, shift_std,
    )  # fmt: skip
    return prior, replace(truth, scale=scale, shift=shift, field=field)
