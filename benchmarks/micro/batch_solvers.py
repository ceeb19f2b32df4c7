"""The batch solver beside those of COLMAP (Ceres) and GTSAM."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
import pycolmap
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from benchmarks.markdown import table
from benchmarks.micro.timing import KERNEL, PIXEL_SIGMA
from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.problem import ErrorModel
from factorsfm.adjustment.state import State
from factorsfm.camera.projection import normalized_from_pixels
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.graph.factors import pose_from_camera
from factorsfm.support.options import PolishOptions
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import synthetic_scene

Array = NDArray[np.float64]

_TOLERANCE = 1e-6  # relative decrease of the cost at which a solver stops
_ITERATIONS = 100  # at most
_TRACK_LENGTH = 5  # fewest observations of a point


@dataclass(frozen=True, slots=True)
class Problem:
    """Bundle adjustment with a known lens.

    Attributes:
        rotation (k, 3, 3), translation (k, 3), points (n, 3): the start, the first camera exact.
        observations: of the points; focal: pixels.
        true_rotations (k, 3, 3), true_centers (k, 3): world_from_cam.
    """

    rotation: Array
    translation: Array
    points: Array
    observations: Observations
    focal: float
    true_rotations: Array
    true_centers: Array

    def state(self, points: Array) -> State:
        """The start, with these points (n, 3)."""
        length = np.linalg.norm(points, axis=1)
        return State(self.rotation, self.translation, points / length[:, None], 1.0 / length, np.log([self.focal]))


def batch_problem(frames: int, points: int) -> Problem:
    """A handheld shot of small parallax, with a start that is as far off as an incremental map."""
    scene = synthetic_scene("handheld", frames, points, parallax=0.03)
    observed = scene.observe(PIXEL_SIGMA)
    frame = np.concatenate([np.full(len(ids), k) for k, (ids, _) in enumerate(observed)])
    point = np.concatenate([ids for ids, _ in observed])
    focal = float(scene.camera.focal_length_x)
    pixels = focal * normalized_from_pixels(scene.camera, np.concatenate([pixels for _, pixels in observed]))
    order = np.argsort(point, kind="stable")
    order = order[(np.bincount(point) >= _TRACK_LENGTH)[point[order]]]
    kept, row = np.unique(point[order], return_inverse=True)
    rng = np.random.default_rng(1)
    translation = np.array([pose.translation for pose in scene.cam_from_world])
    translation[1:] += 2e-3 * rng.standard_normal((frames - 1, 3))
    rotations, centers = pose_arrays(scene.cam_from_world)
    return Problem(
        rotations.transpose(0, 2, 1),
        translation,
        scene.points[kept] * (1.0 + 0.1 * rng.standard_normal((len(kept), 1))),
        Observations(frame[order], row, pixels[order]),
        focal,
        rotations,
        centers,
    )


def batch_solvers() -> str:
    """Table of the solvers on the same problem, with the same start, observations, kernel and tolerance."""
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
    options = PolishOptions(kernel=KERNEL, tolerance=_TOLERANCE, iterations=_ITERATIONS)
    adjustment = BundleAdjustment(problem.state(problem.points), problem.observations, options, ErrorModel(PIXEL_SIGMA))
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
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in observations.pixels[chosen]])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(problem.rotation[k]), problem.translation[k])
        model.add_image_with_trivial_frame(image, pose)
    ends = np.flatnonzero(np.diff(observations.point, append=-1)) + 1
    for xyz, (begin, end) in zip(problem.points, pairwise([0, *ends.tolist()]), strict=True):
        elements = [pycolmap.TrackElement(int(observations.frame[i]) + 1, int(position[i])) for i in range(begin, end)]
        model.add_point3D(xyz, pycolmap.Track(elements), np.zeros(3, np.uint8))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = KERNEL * PIXEL_SIGMA
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
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(KERNEL)
    noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(2, PIXEL_SIGMA))
    graph, values, ordering = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Ordering()
    for i, (frame, point) in enumerate(zip(observations.frame.tolist(), observations.point.tolist(), strict=True)):
        pixel = observations.pixels[i]
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
