"""What the parts cost, on rendered and synthetic input: ``python -m benchmarks.micro [--models FOLDER]``."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pycolmap
from gtsam.symbol_shorthand import A, L, T, X
from numpy.typing import NDArray

from benchmarks.inputs import NETWORK_FILES
from benchmarks.markdown import table
from benchmarks.run import HERE, machine
from factorsfm import DepthModel, Frame, TrackerOptions
from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.state import State
from factorsfm.camera.projection import normalized_from_pixels
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.graph.factors import (
    depth_consistency_factor,
    image_depth_factor,
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
from factorsfm.mapping.registration import register_image
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.options import MapperOptions, PolishOptions
from factorsfm.support.similarity import pose_arrays
from factorsfm.support.status import FrameStatus
from factorsfm.synthetic import render_shot, synthetic_scene
from factorsfm.tracks.flow import FlowTracker
from factorsfm.tracks.image_tracks import ImageTracks

Array = NDArray[np.float64]

_PIXEL_SIGMA = 0.25
_KERNEL = 2.0
_DEPTH_NOISE = 0.05
_REPEATS = 5
_TOLERANCE = 1e-6  # relative decrease of the cost at which the batch solvers stop
_ITERATIONS = 100
_OBSERVATIONS = 100  # depth residuals of one image


def seconds(call: Callable[[], object]) -> float:
    """Time of a call, the best of several, since what else the machine does only adds."""
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


# --- depth factors ----------------------------------------------------------------------------------------------


def depth_factors() -> str:
    """Cost of a depth residual in a Gauss-Newton step by the number of variables in the graph."""
    rows: list[list[object]] = []
    for variables in (200, 1000, 5000, 20000):
        without = seconds(_depth_step(variables))
        row: list[object] = [variables]
        # As many factors as make a difference that can be measured beside the step itself.
        for add, factors, residuals in (
            (_add_native, 20_000, 20_000),
            (_add_custom, 20, 20),
            (_add_whole_image, 20, 20 * _OBSERVATIONS),
        ):
            row.append(f"{1e6 * (seconds(_depth_step(variables, add, factors)) - without) / residuals:.1f}")
        rows.append(row)
    header = ["variables", "native factor", "one `CustomFactor` each", "whole-image `CustomFactor`, points fixed"]
    return (
        "Microseconds per residual in one Gauss-Newton step, beyond the cost of the step without them "
        f"({_OBSERVATIONS} residuals in a whole-image factor).\n\n{table(header, rows)}"
    )


def _depth_step(
    variables: int, add: Callable[[gtsam.NonlinearFactorGraph, Array, int], None] | None = None, factors: int = 0
) -> Callable[[], object]:
    """A Gauss-Newton step over landmarks with priors, and depth factors of one image on some of them."""
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 8), (variables, 3))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, point in enumerate(points):
        values.insert(L(i), point)
        graph.add(gtsam.PriorFactorPoint3(L(i), point, gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    for key, pose in ((X(0), gtsam.Pose3()), (T(0), virtual_offset())):
        values.insert(key, pose)
        graph.add(gtsam.PriorFactorPose3(key, pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-8)))
    native, affine = native_affine(1.0, 0.0), np.array([1.0, 0.0])
    values.insert(A(0), native)
    graph.add(gtsam.PriorFactorCal3_S2(A(0), native, native_affine_noise(0.5, 0.1)))
    values.insert(A(1), affine)
    graph.add(gtsam.PriorFactorVector(A(1), affine, gtsam.noiseModel.Isotropic.Sigma(2, 0.5)))
    if add is not None:
        add(graph, points, factors)
    return lambda: gtsam.GaussNewtonOptimizer(graph, values).iterate()


def _add_native(graph: gtsam.NonlinearFactorGraph, points: Array, factors: int) -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([_DEPTH_NOISE, 1e6]))
    for i in range(factors):
        row = i % _OBSERVATIONS
        graph.add(native_depth_factor(X(0), T(0), L(row), A(0), 1.0 / points[row, 2], noise))


def _add_custom(graph: gtsam.NonlinearFactorGraph, points: Array, factors: int) -> None:
    noise = gtsam.noiseModel.Isotropic.Sigma(1, _DEPTH_NOISE)
    for i in range(factors):
        graph.add(depth_consistency_factor(X(0), L(i), A(1), 1.0 / points[i, 2], noise))


def _add_whole_image(graph: gtsam.NonlinearFactorGraph, points: Array, factors: int) -> None:
    seen, sigma = points[:_OBSERVATIONS], np.full(_OBSERVATIONS, _DEPTH_NOISE)
    for _ in range(factors):
        graph.add(image_depth_factor(X(0), A(1), seen, 1.0 / seen[:, 2], sigma, _KERNEL, domain="inverse"))


# --- incremental graph ------------------------------------------------------------------------------------------


def incremental_updates() -> str:
    """Time of the map's update at a keyframe beside native factors in iSAM2, by keyframes and landmarks."""
    marks, steps = (5, 10, 20, 30), MapperOptions().graph_iterations
    rows = []
    for landmarks in (100, 300, 600):
        shot = _keyframes(landmarks, max(marks))
        for name, measure in {"`update_map`": _map_seconds, "native factors in iSAM2": _native_seconds}.items():
            times = measure(*shot)
            rows.append([len(shot[2]), name, *(f"{1e3 * times[mark - 1]:.0f}" for mark in marks)])
    header = ["landmarks", "update", *(f"keyframe {mark}" for mark in marks)]
    return (
        "Milliseconds per update, every landmark seen by every keyframe, depth prior on each, a copy to roll back to "
        "included. `update_map` condenses the landmarks in numpy, takes more steps while there are few keyframes, at "
        f"least {steps}, and holds all but the newest 20 keyframes; the other has the landmarks as variables and takes "
        f"{steps} steps over all keyframes.\n\n"
        f"{table(header, rows)}"
    )


def _keyframes(landmarks: int, count: int) -> tuple[float, list[MappedImage], Array]:
    """Focal length, keyframes at their true poses with noisy tracks and priors, and about `landmarks` true points."""
    scene = synthetic_scene("dolly", count, 2 * landmarks, parallax=0.1)
    observed = scene.observe(_PIXEL_SIGMA)
    seen = np.bincount(np.concatenate([ids for ids, _ in observed]), minlength=len(scene.points))
    everywhere = np.flatnonzero(seen == count)[:landmarks]
    unit = float(np.median(1.0 / np.linalg.norm(scene.points[everywhere], axis=1)))
    images = []
    for k, (ids, xy) in enumerate(observed):
        pose = scene.cam_from_world[k]
        inverse = scene.inverse_depth(k, everywhere, noise=_DEPTH_NOISE) / unit
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
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.01)
    parameters.relinearizeSkip = 1
    isam, times = gtsam.ISAM2(parameters), []
    kernel, lens = gtsam.noiseModel.mEstimator.Cauchy.Create(_KERNEL), gtsam.Cal3_S2(focal, focal, 0.0, 0.0, 0.0)
    pixel, depth = (
        gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas)))
        for sigmas in ([_PIXEL_SIGMA, _PIXEL_SIGMA], [_DEPTH_NOISE, 1e6])
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


# --- batch solvers ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Problem:
    """Bundle adjustment with a known lens.

    Attributes:
        rotation (k, 3, 3), translation (k, 3), points (n, 3): the start, the first camera exact.
        observations: of the points, normalised; focal: pixels.
        true_rotations (k, 3, 3), true_centers (k, 3): world_from_cam.
    """

    rotation: Array
    translation: Array
    points: Array
    observations: Observations
    focal: float
    true_rotations: Array
    true_centers: Array


def batch_problem(frames: int, points: int) -> Problem:
    """A handheld shot of small parallax, started as far off as an incremental map is."""
    scene = synthetic_scene("handheld", frames, points, parallax=0.03)
    observed = scene.observe(_PIXEL_SIGMA)
    frame = np.concatenate([np.full(len(ids), k) for k, (ids, _) in enumerate(observed)])
    point = np.concatenate([ids for ids, _ in observed])
    xy = normalized_from_pixels(scene.camera, np.concatenate([pixels for _, pixels in observed]))
    order = np.argsort(point, kind="stable")
    order = order[(np.bincount(point) >= 5)[point[order]]]
    kept, row = np.unique(point[order], return_inverse=True)
    rng = np.random.default_rng(1)
    translation = np.array([pose.translation for pose in scene.cam_from_world])
    translation[1:] += 2e-3 * rng.standard_normal((frames - 1, 3))
    rotations, centers = pose_arrays(scene.cam_from_world)
    return Problem(
        rotations.transpose(0, 2, 1),
        translation,
        scene.points[kept] * (1.0 + 0.1 * rng.standard_normal((len(kept), 1))),
        Observations(frame[order], row, xy[order]),
        float(scene.camera.focal_length_x),
        rotations,
        centers,
    )


def batch_solvers() -> str:
    """The polish beside pycolmap and GTSAM on the same problem: the same start, observations, kernel and tolerance."""
    solvers = {"numpy polish": _solve_numpy, "pycolmap (Ceres)": _solve_pycolmap, "GTSAM LM": _solve_gtsam}
    rows: list[list[object]] = []
    for frames, points in ((30, 500), (72, 1000)):
        problem = batch_problem(frames, points)
        polish_seconds = 0.0
        for name, solve in solvers.items():
            begin = time.perf_counter()
            rotations, centers, iterations = solve(problem)
            spent = time.perf_counter() - begin
            polish_seconds = polish_seconds or spent
            errors = trajectory_errors(rotations, centers, problem.true_rotations, problem.true_centers)
            path = np.linalg.norm(problem.true_centers - problem.true_centers[0], axis=1).max()
            rows.append(
                [
                    *(frames, len(problem.points), len(problem.observations.frame), name, f"{spent:.2f}", iterations),
                    *(f"{1e3 * spent / iterations:.0f}", f"{spent / polish_seconds:.2f}"),
                    f"{100 * np.median(errors.ate) / path:.3f}",
                ]
            )
    header = ["frames", "points", "observations", "solver", "s", "iterations", "ms an iteration", "s over polish"]
    return (
        "Poses and points without a prior, Cauchy kernel, lens known, until the cost falls by less than a millionth; "
        f"setting up included.\n\n{table([*header, 'median ATE, % of the path'], rows)}"
    )


def _solve_numpy(problem: Problem) -> tuple[Array, Array, int]:
    length = np.linalg.norm(problem.points, axis=1)
    bearing = problem.points / length[:, None]
    state = State(problem.rotation, problem.translation, bearing, 1.0 / length, np.log([problem.focal]))
    options = PolishOptions(kernel=_KERNEL, tolerance=_TOLERANCE, iterations=_ITERATIONS)
    adjustment = BundleAdjustment(state, problem.observations, options, ErrorModel(_PIXEL_SIGMA))
    done = adjustment.solve()
    rotations = done.rotation.transpose(0, 2, 1)
    return rotations, -np.einsum("nij,nj->ni", rotations, done.translation), adjustment.iterations


def _solve_pycolmap(problem: Problem) -> tuple[Array, Array, int]:
    observations, focal = problem.observations, problem.focal
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=2, height=2, params=[focal, focal, 0.0, 0.0])
    model.add_camera_with_trivial_rig(camera)
    frames = len(problem.rotation)
    rows = [np.flatnonzero(observations.frame == k) for k in range(frames)]
    position = np.zeros(len(observations.frame), np.int64)
    for k, chosen in enumerate(rows):
        position[chosen] = np.arange(len(chosen))
        image = pycolmap.Image(name=str(k), camera_id=1, image_id=k + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in focal * observations.xy[chosen]])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(problem.rotation[k]), problem.translation[k])
        model.add_image_with_trivial_frame(image, pose)
    ends = np.flatnonzero(np.diff(observations.point, append=-1)) + 1
    for xyz, (begin, end) in zip(problem.points, pairwise([0, *ends.tolist()]), strict=True):
        elements = [pycolmap.TrackElement(int(observations.frame[i]) + 1, int(position[i])) for i in range(begin, end)]
        model.add_point3D(xyz, pycolmap.Track(elements), np.zeros(3, np.uint8))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _KERNEL * _PIXEL_SIGMA
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    options.ceres.solver_options.gradient_tolerance = 0.0
    options.ceres.solver_options.max_num_iterations = _ITERATIONS
    config = pycolmap.BundleAdjustmentConfig()
    for k in range(frames):
        config.add_image(k + 1)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve()
    rotations, centers = pose_arrays([model.images[k + 1].cam_from_world() for k in range(frames)])
    return rotations, centers, summary.ceres_summary.num_successful_steps


def _solve_gtsam(problem: Problem) -> tuple[Array, Array, int]:
    observations, focal = problem.observations, problem.focal
    lens = gtsam.Cal3_S2(focal, focal, 0.0, 0.0, 0.0)
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(_KERNEL)
    noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, _PIXEL_SIGMA))
    graph, values, ordering = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Ordering()
    for i, (frame, point) in enumerate(zip(observations.frame.tolist(), observations.point.tolist(), strict=True)):
        pixel = focal * observations.xy[i]
        graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel, noise, X(frame), L(point), lens))
    for i, xyz in enumerate(problem.points):
        values.insert(L(i), xyz)
        distance = float(np.linalg.norm(xyz))
        graph.add(gtsam.PriorFactorPoint3(L(i), xyz, gtsam.noiseModel.Isotropic.Sigma(3, distance)))
        ordering.push_back(L(i))
    for k, pose in enumerate(zip(problem.rotation, problem.translation, strict=True)):
        values.insert(X(k), pose_from_camera(*pose))
        ordering.push_back(X(k))
    graph.add(gtsam.PriorFactorPose3(X(0), values.atPose3(X(0)), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setOrdering(ordering)
    parameters.setRelativeErrorTol(_TOLERANCE)
    parameters.setMaxIterations(_ITERATIONS)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    result = optimizer.optimize()
    poses = [result.atPose3(X(k)) for k in range(len(problem.rotation))]
    return (
        np.array([p.rotation().matrix() for p in poses]),
        np.array([p.translation() for p in poses]),
        optimizer.iterations(),
    )


# --- front end --------------------------------------------------------------------------------------------------


def front_end(models: Path) -> str:
    """Milliseconds per frame of the tracker, the registration and the networks."""
    shot = render_shot("handheld", 8, 960, 540)
    rows: list[list[object]] = []
    for count in (300, 1000):
        tracker = FlowTracker(TrackerOptions(max_tracks=count))
        tracker.track(shot.images[0])
        times = []
        for image in shot.images[1:]:
            start = time.perf_counter()
            alive = len(tracker.track(image).ids)
            times.append(time.perf_counter() - start)
        rows.append([f"tracking, 960x540, {alive} tracks", f"{1e3 * np.median(times):.1f}"])
    scene = synthetic_scene("dolly", 2, 1200, parallax=0.05)
    ids, xy = scene.observe(_PIXEL_SIGMA)[1]
    start_pose = scene.cam_from_world[0]
    for count in (250, 1000):
        few = ids[:count]
        observed = normalized_from_pixels(scene.camera, xy[:count])
        inverse = scene.inverse_depth(1, few, noise=_DEPTH_NOISE)
        for what, depth in (("", None), (" with depth", ImageDepth(inverse, np.ones(len(few)), 1.0))):
            spent = seconds(
                partial(
                    register_image,
                    scene.points[few],
                    observed,
                    start_pose.rotation.matrix(),
                    start_pose.translation,
                    focal=float(scene.camera.focal_length_x),
                    sigma=_PIXEL_SIGMA,
                    inlier_px=3.0,
                    depth=depth,
                )
            )
            rows.append([f"registration{what}, {len(few)} points", f"{1e3 * spent:.1f}"])
    frame = Frame(0, shot.images[0], "0", None)
    for name, file in NETWORK_FILES.items():
        if (models / file).is_file():
            rows.append([f"network {name}", f"{1e3 * seconds(partial(DepthModel(models / file), frame)):.1f}"])
        else:
            rows.append([f"network {name}: {file} is not in the folder of networks", "–"])
    return table(["part", "ms per frame"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.micro", description=__doc__)
    parser.add_argument("--models", type=Path, default=Path("models"), help="folder of networks")
    parser.add_argument("--output", type=Path, default=HERE / "results", help="folder of MICRO.md")
    arguments = parser.parse_args()
    sections: dict[str, Callable[[], str]] = {
        "Depth factors": depth_factors,
        "Incremental graph": incremental_updates,
        "Batch solvers": batch_solvers,
        "Front end": partial(front_end, arguments.models),
    }
    load = os.getloadavg()[0]
    parts = [
        "# Cost of the parts",
        f"Generated by `python -m benchmarks.micro`. Machine: {machine()}; load at the start {load:.1f}.",
    ]
    for title, section in sections.items():
        parts += [f"## {title}", section()]
        print("\n\n".join(parts[-2:]) + "\n", flush=True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "MICRO.md").write_text("\n\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
