"""Small rendered shots with exact truth, rendered once per session, and priors for them."""

from dataclasses import replace
from functools import cache

import numpy as np

from factorsfm import PRESETS, DepthKind, DepthMap, Frame, Options, Reconstruction
from factorsfm.evaluation.metrics import TrajectoryErrors, trajectory_errors
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import Motion, RenderedShot, render_shot, simulate_prior

FRAMES = 8


@cache
def rendered(motion: Motion) -> RenderedShot:
    return render_shot(motion, FRAMES, 320, 180)


@cache
def simulated_maps(motion: Motion) -> list[np.ndarray]:
    return simulate_prior(rendered(motion))


class Maps:
    """A prior from a list of inverse-depth maps, one a frame; None where a frame has no map."""

    kind = DepthKind.INVERSE
    name = "maps"

    def __init__(self, maps: list[np.ndarray | None]) -> None:
        self.maps = maps

    def __call__(self, frame: Frame) -> DepthMap | None:
        values = self.maps[frame.index]
        return None if values is None else DepthMap(values, self.kind)


def with_fewer_tracks(options: Options, tracks: int = 250) -> Options:
    """The same method, several times faster on small shots."""
    return replace(options, tracker=replace(options.tracker, max_tracks=tracks))


def quick_presets() -> dict[str, Options]:
    return {name: with_fewer_tracks(options) for name, options in PRESETS.items()}


def errors_of(reconstruction: Reconstruction, shot: RenderedShot) -> TrajectoryErrors:
    """Against the truth, after similarity alignment; lengths as a share of the true path's."""
    rotations, centers = pose_arrays(shot.cam_from_world)
    length = np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()
    estimate = pose_arrays([frame.cam_from_world for frame in reconstruction.frames])
    return trajectory_errors(*estimate, rotations, centers / length)
