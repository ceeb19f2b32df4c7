"""Results of rendered shots, and covariances of the poses of their graphs."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from factorsfm import Options, Reconstruction, Stream
from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.marginals import Marginals
from factorsfm.adjustment.shared_errors import SharedErrors
from factorsfm.polish import polish
from factorsfm.synthetic import Motion, render_shot
from tests.rendered import Maps, rendered, simulated_maps, with_fewer_tracks


@contextmanager
def tracks_one_by_one() -> Iterator[None]:
    """Covariances of the polish without what neighbouring tracks share, which no factor on one track can hold."""
    with patch.object(polish, "shared_errors", nothing_shared):
        yield


def nothing_shared(adjustment: BundleAdjustment, marginals: Marginals) -> SharedErrors:
    state = adjustment.state
    camera, points = np.zeros((adjustment.columns.size, 1)), np.zeros((len(state.bearing), 1))
    return SharedErrors(camera, points, np.zeros((len(state.rotation), 6, 6)))


@cache
def result(motion: Motion, guided: bool = True) -> Reconstruction:
    shot = rendered(motion)
    prior = Maps(simulated_maps(motion)) if guided else None
    stream = Stream(shot.camera, depth=prior, options=replace(with_fewer_tracks(Options()), shutter="global"))
    for image in shot.images:
        stream.push(image)
    with tracks_one_by_one():
        return stream.finish()


@cache
def longer_result() -> Reconstruction:
    """Longer than the time for which the errors of tracks persist."""
    shot = render_shot("dolly", 40, 320, 180)
    stream = Stream(shot.camera, options=replace(with_fewer_tracks(Options(), 120), shutter="global"))
    for image in shot.images:
        stream.push(image)
    with tracks_one_by_one():
        return stream.finish()


@cache
def rolling_result() -> Reconstruction:
    """Of images whose rows were read one after another; its poses are fitted to them."""
    shot = render_shot("handheld", 16, 320, 180, parallax=0.05, readout=0.8)
    stream = Stream(shot.camera, options=with_fewer_tracks(Options(), 120))
    for image in shot.images:
        stream.push(image)
    with tracks_one_by_one():
        return stream.finish()


def pose_covariance(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, r: Reconstruction) -> np.ndarray:
    """(6 k, 6 k) of the registered poses, the unit of length fixed as in `FrameResult.covariance`."""
    poses, points = [X(frame.index) for frame in r.registered], [L(j) for j in r.track_ids]
    ordering = gtsam.Ordering()
    for key in [*poses, *points, *sorted(set(values.keys()) - {*poses, *points})]:
        ordering.push_back(key)
    information = graph.linearize(values).hessian(ordering)[0]
    size = np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
    # Errors of the poses, when the solution is scaled to the mean inverse distance of the result.
    distance = np.linalg.norm(r.points, axis=1)
    by_point = -r.points / distance[:, None] ** 3 / np.sum(1.0 / distance)
    wrong = np.zeros(len(covariance))
    wrong[6 * len(poses) : 6 * len(poses) + by_point.size] = by_point.ravel()
    relative = np.eye(len(covariance))[: 6 * len(poses)] + np.outer(size_motion(values, poses), wrong)
    return relative @ covariance @ relative.T


def size_motion(values: gtsam.Values, poses: list[int]) -> np.ndarray:
    """(6 k,) by how much the poses move with the logarithm of the scene's size."""
    places = [values.atPose3(key).rotation().unrotate(values.atPose3(key).translation()) for key in poses]
    return np.concatenate([np.append(np.zeros(3), place) for place in places])
