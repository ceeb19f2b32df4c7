"""Small problems of every frame: one pose on known points, and many points seen by known poses."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pycolmap
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray

from benchmarks.markdown import table
from benchmarks.micro.batch_solvers import Problem, batch_problem
from benchmarks.micro.timing import KERNEL, PIXEL_SIGMA, seconds
from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.problem import ErrorModel, Free
from factorsfm.graph.factors import (
    camera_from_pose,
    constant_projection_factor,
    image_reprojection_factor,
    lens_of,
    pixel_noise,
    pose_from_camera,
)
from factorsfm.mapping.registration import register_image
from factorsfm.support.options import PolishOptions
from factorsfm.support.rotations import camera_centers

Array = NDArray[np.float64]

_INLIER_PX = 3.0
_POINT_STEPS = 4


def small_solves() -> str:
    """Table of the time and the result of each solver on the same problem, from the same start."""
    rows: list[list[object]] = []
    for count in (250, 800):
        problem = batch_problem(30, 2 * count)
        for title, solvers in (("one pose", _poses(problem, count)), ("points alone", _points(problem))):
            for name, solve in solvers.items():
                result = solve()
                rows.append(
                    [
                        title,
                        count if title == "one pose" else len(problem.points),
                        name,
                        f"{1e3 * seconds(solve):.1f}",
                        result,
                    ]
                )
    return (
        "One pose: from a neighbour's, on exact points that stay; the difference is to the true centre, in thousandths "
        "of the median distance. `register_image` finds inliers, noise and covariance, too. Points alone: "
        "30 known poses, four steps or convergence; the error is the median reprojection error in pixels."
        f"\n\n{table(['problem', 'points', 'solver', 'ms', 'difference or error'], rows)}"
    )


def _poses(problem: Problem, count: int) -> dict[str, Callable[[], str]]:
    """Solvers for the pose of the last image, from that of the one before."""
    o, last = problem.observations, len(problem.rotation) - 1
    mine = np.flatnonzero(o.frame == last)[:count]
    rotation, center = problem.true_rotations[last].T, problem.true_centers[last]
    points = problem.points[o.point[mine]]
    rays = np.column_stack([o.pixels[mine] / problem.focal, np.ones(len(mine))]) @ rotation
    points = center + rays * np.linalg.norm(
        points - center, axis=1, keepdims=True
    )  # exact but for the noise of the pixels
    pixels, start = o.pixels[mine], (problem.true_rotations[last - 1].T, problem.translation[last - 1])
    typical = float(np.median(np.linalg.norm(points - center, axis=1)))

    def off(found: Array, shift: Array) -> str:
        return f"{1e3 * np.linalg.norm(camera_centers(found[None], shift[None])[0] - center) / typical:.3f}"

    def ours() -> str:
        found = register_image(
            points, pixels / problem.focal, *start, focal=problem.focal, sigma=PIXEL_SIGMA, inlier_px=_INLIER_PX
        )
        return off(found.rotation, found.translation)

    def ceres() -> str:
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=2, height=2, params=[problem.focal, 0.0, 0.0])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(start[0]), start[1])
        result = pycolmap.refine_absolute_pose(pose, pixels, points, np.ones(len(points), bool), camera)
        found = result["cam_from_world"]
        return off(found.rotation.matrix(), found.translation)

    def whole_image() -> str:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(image_reprojection_factor(X(0), points, pixels / problem.focal, problem.focal, PIXEL_SIGMA, KERNEL))
        values.insert(X(0), pose_from_camera(*start))
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        return off(*camera_from_pose(solved.atPose3(X(0))))

    return {"numpy (`register_image`)": ours, "Ceres (`refine_absolute_pose`)": ceres, "GTSAM LM": whole_image}


def _points(problem: Problem) -> dict[str, Callable[[], str]]:
    """Solvers for all points on the poses as they are at the start."""
    o = problem.observations

    def error(points: Array) -> str:
        return f"{np.median(_adjustment(problem, points).reprojection_errors()):.3f}"

    def ours() -> str:
        return error(_adjustment(problem, problem.points).solve(_POINT_STEPS).points)

    def native() -> str:
        lens, noise = lens_of(problem.focal), pixel_noise(PIXEL_SIGMA)
        poses = [pose_from_camera(*pose) for pose in zip(problem.rotation, problem.translation, strict=True)]
        cameras = [gtsam.PinholePoseCal3_S2(pose, lens) for pose in poses]
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for frame, point, pixels in zip(o.frame.tolist(), o.point.tolist(), o.pixels, strict=True):
            graph.add(constant_projection_factor(cameras[frame], pixels, noise, L(point)))
        for row, point in enumerate(problem.points):
            values.insert(L(row), point)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(_POINT_STEPS)
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        return error(np.array([solved.atPoint3(L(row)) for row in range(len(problem.points))]))

    return {"numpy": ours, "GTSAM LM": native}


def _adjustment(problem: Problem, points: Array) -> BundleAdjustment:
    """Of the points alone, which begin there."""
    return BundleAdjustment(
        problem.state(points), problem.observations, PolishOptions(kernel=KERNEL), ErrorModel(PIXEL_SIGMA),
        free=Free(cameras=False),
    )  # fmt: skip
