"""Cost of an update of the keyframe graph."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.markdown import table
from benchmarks.micro.timing import DEPTH_SIGMA, PIXEL_SIGMA
from factorsfm.graph.keyframe_graph import KeyframeGraph
from factorsfm.mapping.map_copy import MapCopy
from factorsfm.mapping.map_update import update_map
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.point_map import PointMap
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.options import MapperOptions
from factorsfm.support.status import FrameStatus
from factorsfm.synthetic import synthetic_scene
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]


def incremental_updates() -> str:
    """Table of the time of an update at a keyframe, by the number of keyframes and landmarks."""
    marks = (5, 10, 20, 30, 40)
    rows = []
    for landmarks in (100, 300, 600):
        shot = _keyframes(landmarks, max(marks))
        times = _seconds(*shot)
        rows.append([len(shot[2]), *(f"{1e3 * times[mark - 1]:.0f}" for mark in marks)])
    header = ["landmarks", *(f"keyframe {mark}" for mark in marks)]
    return (
        "Milliseconds of `update_map`, with the copy to roll back to; every keyframe observes every landmark and has a "
        "depth prior at it. The newest 16 keyframes are variables of iSAM2, up to eight older ones constants.\n\n"
        f"{table(header, rows)}"
    )


def _keyframes(landmarks: int, count: int) -> tuple[float, list[MappedImage], Array]:
    """A scene of about `landmarks` points: focal length (pixels), keyframes at their true poses with noisy tracks and
    priors, and the true points."""
    scene = synthetic_scene("dolly", count, 2 * landmarks, parallax=0.1)
    observed = scene.observe(PIXEL_SIGMA)
    observers = np.bincount(np.concatenate([ids for ids, _ in observed]), minlength=len(scene.points))
    everywhere = np.flatnonzero(observers == count)[:landmarks]
    unit = float(np.median(1.0 / np.linalg.norm(scene.points[everywhere], axis=1)))
    images = []
    for k, (ids, xy) in enumerate(observed):
        pose = scene.cam_from_world[k]
        inverse = scene.inverse_depth(k, everywhere, noise=DEPTH_SIGMA) / unit
        tracks = ImageTracks(
            k,
            np.arange(len(everywhere)),
            xy[np.searchsorted(ids, everywhere)],
            scene.camera,
            ImageDepth(inverse, np.ones(len(everywhere)), 1.0),
        )
        rotation, translation = pose.rotation.matrix(), unit * pose.translation
        images.append(MappedImage(tracks, FrameStatus.REGISTERED, "", rotation, translation))
    return float(scene.camera.focal_length_x), images, unit * scene.points[everywhere]


def _seconds(focal: float, images: list[MappedImage], points: Array) -> list[float]:
    """Seconds of `update_map` at each keyframe."""
    graph, mapped, times = KeyframeGraph(), PointMap(), []
    images = [replace(image) for image in images]
    mapped.set(images[0].tracks.ids, points)
    for k in range(len(images)):
        start = time.perf_counter()
        copy = MapCopy([replace(image) for image in images[: k + 1]], mapped.copy(), MapperOptions(), focal)
        update = update_map(copy, graph)
        times.append(time.perf_counter() - start)
        if not update.committed:
            raise RuntimeError(f"update {k} with {len(points)} landmarks: {update.reason}")
        mapped.set(update.ids, update.points)
        for position, (rotation, translation) in update.poses.items():
            images[position].rotation, images[position].translation = rotation, translation
        for position, affine in update.affines.items():
            images[position].affine = affine
    return times
