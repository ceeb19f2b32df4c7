"""A small result whose points project exactly onto what was observed, and the files of a result."""

from pathlib import Path

import numpy as np
import pycolmap

from factorsfm.result.reconstruction import FrameResult, PriorFit, Reconstruction
from factorsfm.support.status import FrameStatus, ShotKind

FILES = {"trajectory.tum", "colmap", "points.ply", "summary.json", "report.html"}


def build(frames: int = 6, points: int = 40, unregistered: tuple[int, ...] = (3,)) -> Reconstruction:
    """Exact projections of random points; every frame sees every point, also the unregistered ones."""
    rng = np.random.default_rng(1)
    camera = pycolmap.Camera(
        model="OPENCV", width=640, height=480, params=[500, 510, 321, 239, 0.05, -0.02, 0.001, 0.002]
    )
    xyz = np.column_stack([rng.uniform(-1, 1, (points, 2)), rng.uniform(4, 8, points)])
    results, xy = [], []
    for k in range(frames):
        rotation = pycolmap.Rotation3d(np.array([0.01 * k, -0.02 * k, 0.03 * k]))
        pose = pycolmap.Rigid3d(rotation, np.array([0.02 * k, -0.01 * k, 0.005 * k]))
        xy.append(camera.img_from_cam(pose * xyz) - 0.5)
        lost = k in unregistered
        results.append(
            FrameResult(
                index=10 + 2 * k,
                name=f"{10 + 2 * k:06d}",
                timestamp=k / 24,
                status=FrameStatus.TOO_FEW_INLIERS if lost else FrameStatus.REGISTERED,
                message="14 of 30 inliers needed" if lost else f"{points} inliers",
                cam_from_world=None if lost else pose,
                keyframe=k % 2 == 0,
                observations=points,
                inliers=14 if lost else points,
                reprojection_error=float("nan") if lost else 0.1 * (k + 1),
                prior=PriorFit(2.0 + k, 0.1, 0.2, 0.02, 0.3) if k % 2 == 0 else None,
            )
        )
    frame_of = np.repeat(np.arange(frames), points)
    return Reconstruction(
        camera=camera,
        frames=results,
        points=xyz,
        colors=rng.integers(0, 256, (points, 3)).astype(np.uint8),
        track_ids=np.arange(points) + 100,
        observation_frame=frame_of,
        observation_point=np.tile(np.arange(points), frames),
        observation_xy=np.concatenate(xy),
        observation_error=0.1 * (frame_of + 1.0),
        prior_residual=np.where(frame_of % 2 == 0, 0.05 * (frame_of + 1), np.nan),
        kind=ShotKind.GENERAL,
        parallax=0.0123,
        notes=["The focal length was guessed."],
        seconds={"tracking": 1.5, "mapping": np.float64(2.0)},
        options={"source": "shot.mp4", "tracker": {"window": 21}, "sigma": float("inf"), "path": Path("a")},
    )
