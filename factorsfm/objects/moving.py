"""What moves by itself without masks: tracks that the scene does not explain, divided into things.

A track that no point at rest explains, before the cameras of the scene, moves by itself, or slides. Neighbours that
keep beside each other while the scene passes are on the same thing; what slides keeps beside nothing. Whether a thing
is rigid, and large enough, its solution shows.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.noise import FIRST_SIGMA_PX
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.adjustment.state import State
from factorsfm.frames.frame import Frame
from factorsfm.mapping.all_points import triangulated
from factorsfm.motion.moving import log_errors
from factorsfm.objects.start import LEAST_FRAMES, LEAST_TRACKS
from factorsfm.support.components import connected_components
from factorsfm.support.options import Options, PolishOptions
from factorsfm.tracks.image_tracks import ImageTracks, seen_by

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]

logger = logging.getLogger(__name__)

_MOVED_PX = 0.25  # typical error of a point at rest, from which it moves: what rests before a fixed camera stays within
_LITTLE_PARALLAX = 0.1  # camera path over depth, from which the depth of a point starts
_ITERATIONS = 4  # of points alone, until they show what fits the cameras
_MOMENTS = 24  # of the shot, in which neighbours are looked for
_NEIGHBOURS, _REACH = 6, 0.08  # of a track in such a moment, within a share of the image's width
# Of what moves two neighbours against the scene, while both are seen: what they may move against each other. On
# rendered boxes 99 to 100 % of the tracks of a thing are then on it, from 0.25 to 0.7. With 0.25, what goes along with
# the camera and turns falls apart: as points at rest, most of its motion passes for depth.
_TOGETHER = 0.5
_LEAST_SHARED = 3  # frames in which two points are seen, that are compared
_HALF = 1.349  # standard deviations: the width of the middle half of a normal distribution
_MASK_WIDTH = 320  # pixels: an outline between tracks is no finer


@dataclass(frozen=True, slots=True)
class MovingThings:
    """Things that move by themselves, large enough that they may be solved; as `ObjectMasks`.

    Attributes:
        places: by name, and by index of the frame, (n, 2) pixels of the tracks on each; largest first.
        loose: number of tracks that move by themselves besides.
        window_px: side of the windows of the tracks, which lie on the things.
        name: of this source of masks.
    """

    places: dict[str, dict[int, Array]]
    loose: int
    window_px: int
    name: str = "auto"

    def __call__(self, frame: Frame) -> dict[str, Flags]:
        """The windows of the tracks of each thing, and what lies between, at most `_REACH` from one to the next."""
        return {
            name: _between(seen[frame.index], frame.image.shape, self.window_px)
            for name, seen in self.places.items()
            if frame.index in seen
        }

    def described(self) -> list[str]:
        """Of each thing: its name, when it is seen, and where in the middle of that time."""
        return [f"{name} ({_where(seen)})" for name, seen in self.places.items()]


def moving_things(
    images: Sequence[ImageTracks],
    cam_from_world: Mapping[int, pycolmap.Rigid3d],
    scene: Index,
    options: Options,
) -> MovingThings:
    """What moves by itself in a shot whose scene is solved.

    Args:
        images: of the whole shot, with the scene's lens; their `index` is that of the frame in its source.
        cam_from_world: of the scene, by position of the image; scene: ids of the tracks of its points.
    """
    images = [image for image in images if image.position in cam_from_world]
    ids = seen_by(images, options.polish.min_track_length) if images else np.zeros(0, np.int64)
    none = MovingThings({}, 0, options.tracker.window_px)
    if not len(ids):
        return none
    observations = gather(images, ids, np.array([image.camera.mean_focal_length() for image in images]))
    errors = _errors_at_rest(images, observations, cam_from_world, options.polish)
    moving = np.flatnonzero(_moves(observations, errors, np.isin(ids, scene), options.polish))
    if not len(moving):
        return none
    o = observations.of(moving)
    against_scene = errors[np.isin(observations.point, moving)]
    label = connected_components(len(moving), _links(o, against_scene, images[0].camera.width))
    groups = [np.flatnonzero(label == k) for k in np.unique(label)]
    large = [group for group in groups if _lasts(o.of(group))]
    large.sort(key=lambda group: -len(o.of(group).frame))
    logger.info("moving: %d of %d tracks, things of %s", len(moving), len(ids), [len(group) for group in large])
    places = {f"object-{k}": _places(images, ids[moving[group]]) for k, group in enumerate(large, 1)}
    return replace(none, places=places, loose=len(moving) - sum(map(len, large)))


def _errors_at_rest(
    images: Sequence[ImageTracks],
    observations: Observations,
    cam_from_world: Mapping[int, pycolmap.Rigid3d],
    options: PolishOptions,
) -> Array:
    """(m, 2) reprojection errors of the best points at rest, pixels."""
    poses = [cam_from_world[image.position] for image in images]
    first = poses[0].inverse()  # the first camera is the world: from there all points are in front
    poses = [pose * first for pose in poses]
    count = int(observations.point[-1]) + 1
    translation = np.array([pose.translation for pose in poses])
    farthest = float(np.linalg.norm(translation, axis=1).max())
    cameras = State(
        np.array([pose.rotation.matrix() for pose in poses]),
        translation / farthest if farthest > 0.0 else translation,
        np.zeros((count, 3)), np.ones(count),
        np.log([image.camera.mean_focal_length() for image in images]), group=np.arange(len(images)),
    )  # fmt: skip
    found = triangulated(cameras, observations, np.arange(count), np.full(count, _LITTLE_PARALLAX))
    state = replace(cameras, bearing=found.bearing, inverse_distance=np.maximum(found.inverse_distance, 0.0))
    adjustment = BundleAdjustment(
        state, observations, replace(options, iterations=_ITERATIONS), ErrorModel(FIRST_SIGMA_PX),
        free=Free(cameras=False),
    )  # fmt: skip
    adjustment.solve()
    return adjustment.reprojection_vectors()


def _moves(observations: Observations, errors: Array, scene: Flags, options: PolishOptions) -> Flags:
    """(n,) which points are at rest nowhere, beside the errors of the scene's own (n,).

    Those of a scene that much moves before include some of the latter: usual is what the shortest half has.
    """
    if not scene.any():
        return np.zeros(len(scene), bool)
    size = log_errors(observations, np.linalg.norm(errors, axis=1))
    usual = np.sort(size[scene])
    half = (len(usual) + 1) // 2
    widths = usual[half - 1 :] - usual[: len(usual) - half + 1]
    low = int(np.argmin(widths))
    center, spread = float(usual[low] + 0.5 * widths[low]), float(widths[low]) / _HALF
    limit = center + options.outlier_sigmas * max(spread, 0.1)
    return np.asarray(size > max(limit, np.log(_MOVED_PX)))


def _links(observations: Observations, errors: Array, width: int) -> Index:
    """(e, 2) points that are neighbours at some moment, and keep beside each other while both are seen.

    Args:
        errors: (m, 2) of each as a point at rest: how it moves against the scene; width: of the image; pixels.
    """
    o, count = observations, int(observations.point[-1]) + 1
    last = int(o.frame.max())
    place, against = np.full((2, count, last + 1, 2), np.nan)
    place[o.point, o.frame], against[o.point, o.frame] = o.pixels, errors
    linked = np.zeros((count, count), bool)
    for frame in np.unique(np.linspace(o.frame.min(), last, _MOMENTS).round().astype(int)):
        seen = np.flatnonzero(np.isfinite(place[:, frame, 0]))
        distance = np.linalg.norm(place[seen, None, frame] - place[None, seen, frame], axis=2)
        nearest = np.argsort(distance, axis=1)[:, 1 : _NEIGHBOURS + 1]
        near = np.take_along_axis(distance, nearest, axis=1) < _REACH * width
        linked[np.repeat(seen, near.sum(1)), seen[nearest[near]]] = True
    edges = np.argwhere(linked)
    return np.asarray(edges[_apart(place, against, *edges.T) < _TOGETHER])


def _apart(place: Array, against: Array, a: Index, b: Index) -> Array:
    """(e,) by how much points move against each other while both are seen, over what they move against the scene; NaN
    where they are not seen together for long enough to tell."""
    both = np.isfinite(place[a, :, 0] + place[b, :, 0])
    both[both.sum(1) < _LEAST_SHARED] = False
    own = np.minimum(_motion(against[a], both), _motion(against[b], both))
    return np.asarray(_motion(place[a] - place[b], both) / np.where(own > 0.0, own, np.nan))


def _motion(places: Array, seen: Flags) -> Array:
    """(e,) root mean square distance of places (e, k, 2) from their mean, over the frames (e, k) that count."""
    weight = seen / np.maximum(seen.sum(1, keepdims=True), 1)
    known = np.where(seen[:, :, None], places, 0.0)
    off = known - np.einsum("ek,eki->ei", weight, known)[:, None]
    return np.asarray(np.sqrt(np.einsum("ek,eki->e", weight, off**2)))


def _lasts(observations: Observations) -> bool:
    """Whether enough of the tracks of a thing are seen for long enough to solve it."""
    return int((np.bincount(observations.frame) >= LEAST_TRACKS).sum()) >= LEAST_FRAMES


# --- where things are ---------------------------------------------------------------------------------------------


def _places(images: Sequence[ImageTracks], ids: Index) -> dict[int, Array]:
    """By index of the frame, (n, 2) pixels of some tracks."""
    seen = {image.frame: image.pixels[np.isin(image.ids, ids)] for image in images}
    return {index: pixels for index, pixels in seen.items() if len(pixels)}


def _between(pixels: Array, shape: tuple[int, ...], window_px: int) -> Flags:
    """(h, w) mask of windows around places and of what lies between, on a smaller image."""
    size = min(_MASK_WIDTH, shape[1])
    mask = np.zeros((round(shape[0] * size / shape[1]), size), np.uint8)
    x, y = np.floor((pixels + 0.5) * size / shape[1]).astype(int).T
    mask[np.clip(y, 0, mask.shape[0] - 1), np.clip(x, 0, size - 1)] = 1
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _disc(round(0.5 * _REACH * size)))
    return np.asarray(cv2.dilate(closed, _disc(round(0.5 * window_px * size / shape[1]))), bool)


def _disc(radius: int) -> NDArray[np.uint8]:
    size = (2 * radius + 1, 2 * radius + 1)
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size), np.uint8)


def _where(places: dict[int, Array]) -> str:
    """When and where a thing is seen."""
    frames = sorted(places)
    middle = frames[len(frames) // 2]
    low, high = np.quantile(places[middle], [0.02, 0.98], axis=0).round().astype(int)
    spans = [f"{axis} from {a} to {b}" for axis, a, b in zip("xy", low, high, strict=True)]
    return f"frames {frames[0]} to {frames[-1]}; in frame {middle} {' and '.join(spans)} pixels"
