"""Cost of an update of the incremental graph, beside native factors in iSAM2."""

from __future__ import annotations

import time
from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, T, X
from numpy.typing import NDArray

from benchmarks.markdown import table
from benchmarks.micro.timing import DEPTH_SIGMA, KERNEL, PIXEL_SIGMA
from factorsfm.graph.factors import (
    native_affine,
    native_affine_noise,
    native_depth_factor,
    pose_from_camera,
    virtual_offset,
)
from factorsfm.graph.keyframe_graph import FactorGraph
from factorsfm.mapping.map_update import MapCopy, update_map
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
    marks, steps = (5, 10, 20, 30), MapperOptions().graph_iterations
    rows = []
    for landmarks in (100, 300, 600):
        shot = _keyframes(landmarks, max(marks))
        for name, measure in {"`update_map`": _map_seconds, "native factors in iSAM2": _native_seconds}.items():
            times = measure(*shot)
            rows.append([len(shot[2]), name, *(f"{1e3 * times[mark - 1]:.0f}" for mark in marks)])
    header = ["landmarks", "update", *(f"keyframe {mark}" for mark in marks)]
    return (
        "Milliseconds per update, with the copy to roll back to; every keyframe observes every landmark and has a "
        "depth prior at it. `update_map` condenses the landmarks in numpy, takes at least "
        f"{steps} steps, more while there are few keyframes, and holds all but the newest 20 keyframes fixed; the "
        f"other has the landmarks as variables and takes {steps} steps over all keyframes.\n\n"
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


def _map_seconds(focal: float, images: list[MappedImage], points: Array) -> list[float]:
    """Seconds of `update_map` at each keyframe."""
    graph, mapped, times = FactorGraph(), PointMap(), []
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


def _native_seconds(focal: float, images: list[MappedImage], points: Array) -> list[float]:
    """Seconds of an update of iSAM2 with landmarks as variables at each keyframe."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.01)
    parameters.relinearizeSkip = 1
    isam, times = gtsam.ISAM2(parameters), []
    kernel, lens = gtsam.noiseModel.mEstimator.Cauchy.Create(KERNEL), gtsam.Cal3_S2(focal, focal, 0.0, 0.0, 0.0)
    pixel, depth = (
        gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas)))
        for sigmas in ([PIXEL_SIGMA, PIXEL_SIGMA], [DEPTH_SIGMA, 1e6])
    )
    affine = native_affine(1.0, 0.0)
    for k, image in enumerate(images):
        graph, values, tracks = gtsam.NonlinearFactorGraph(), gtsam.Values(), image.tracks
        assert tracks.depth is not None
        start = time.perf_counter()
        values.insert(X(k), pose_from_camera(*image.pose))
        values.insert(A(k), affine)
        graph.add(gtsam.PriorFactorCal3_S2(A(k), affine, native_affine_noise(0.5, 0.3)))
        if k == 0:
            for key, pose in ((X(0), values.atPose3(X(0))), (T(0), virtual_offset())):
                graph.add(gtsam.PriorFactorPose3(key, pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
            values.insert(T(0), virtual_offset())
            for j, point in enumerate(points):
                values.insert(L(j), point)
                graph.add(gtsam.PriorFactorPoint3(L(j), point, gtsam.noiseModel.Isotropic.Sigma(3, 1.0)))
        for j, (xy, inverse) in enumerate(zip(focal * tracks.xy, tracks.depth.inverse_depth, strict=True)):
            graph.add(gtsam.GenericProjectionFactorCal3_S2(xy, pixel, X(k), L(j), lens))
            graph.add(native_depth_factor(X(k), T(0), L(j), A(k), inverse, depth))
        isam = gtsam.ISAM2(isam)
        isam.update(graph, values)
        for _ in range(MapperOptions().graph_iterations - 1):
            isam.update()
        isam.calculateEstimate()
        times.append(time.perf_counter() - start)
    return times
