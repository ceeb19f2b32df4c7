"""The result of the polish."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import Observations
from factorsfm.adjustment.prior_term import PriorPart
from factorsfm.adjustment.state import State
from factorsfm.control.fit import ControlFit
from factorsfm.control.with_factors import ShotFactors
from factorsfm.lens.lens import LensEstimate
from factorsfm.lens.rolling_shutter import Shutter
from factorsfm.motion.at_rest import Rest
from factorsfm.motion.shot_kind import Motion
from factorsfm.motion.stretches import Stretch
from factorsfm.polish.observability import CameraObservability
from factorsfm.support.semidefinite import deviations
from factorsfm.support.similarity import Similarity

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(slots=True)
class Polished:
    """Result of the polish; the first of its cameras is the world, the median inverse distance is about 1.

    Attributes:
        frames: (k,) positions of the images in `state`; tracks: (n,) track of each point.
        errors: (m,) reprojection errors of `observations` (pixels); sigma: their standard deviation.
        observation_sigma, track_sigma: see `BundleAdjustment.observation_sigmas`.
        covariance: (k, 6, 6) of the poses, GTSAM's convention, `in_scene_unit`; relative_covariance: of each
            relative to the one before.
        observability: of the pose of each camera.
        point_std: (n,) standard deviations of the inverse distances, in the same unit.
        left_out: why, of the registered images that have no pose here.
        lens: the estimate of an unknown lens, None where it is known.
        shutter: a rolling shutter, None where the shot shows none; recorded: whether poses are those of cameras without
            one, fitted to the recorded images, see `Options.shutter`; rolled: (m, 2) where each observation is beside
            where such a camera would have it (pixels), None where they are not.
        shutter_error: median reprojection error with the rolling shutter in the model (pixels); NaN where poses are not
            `recorded`.
        moving: ids (ascending) of the tracks that move by themselves and are left out.
        turns: whether a camera that only turns explains the tracks through a lens of its own, see `turning_reading`.
        rest: what rests in the image while other things move, None where nothing does.
        rival: cost of this reading of the shot over that of the next best one in which something else is the scene; 0
            where nothing else may be.
        stretches: by positions of the images, in order of time; empty where they are in no order.
        zoom: longest over shortest focal length of a zoom that the tracks ask for and that is not estimated; 0: none.
        inflation: of the variance of the core tracks, since errors of neighbours are alike, see `error_inflation`;
            shared_error: pixels that they have in common.
        contradiction: see `NearAndFar.correlation`.
        world_alignment: from this world to that of the control; control: its residuals. None without control.
        factors: of the caller, that took part.
        unused: "Control" or "Factors added", where there are some that could not take part.
    """

    frames: list[int]
    state: State
    tracks: Index
    observations: Observations
    errors: Array
    sigma: float
    observation_sigma: Array
    track_sigma: Array
    motion: Motion
    covariance: Array
    relative_covariance: Array
    observability: list[CameraObservability]
    point_std: Array
    left_out: dict[int, str]
    prior: PriorPart | None = None
    lens: LensEstimate | None = None
    shutter: Shutter | None = None
    recorded: bool = False
    rolled: Array | None = None
    shutter_error: float = np.nan
    moving: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    turns: bool = False
    rest: Rest | None = None
    rival: float = 0.0
    zoom: float = 0.0
    stretches: tuple[Stretch, ...] = ()
    inflation: float = 1.0
    shared_error: float = 0.0
    contradiction: float | None = None
    world_alignment: Similarity | None = None
    control: ControlFit | None = None
    factors: ShotFactors | None = None
    unused: str = ""

    def describe_prior(self, adjustment: BundleAdjustment, camera_covariance: Array) -> None:
        """Take over what a solution says of the prior: its residuals, and how certain its scales and shifts are.

        Args:
            camera_covariance: (c, c) of the camera side of the solution, `in_scene_unit`.
        """
        if self.prior is None:
            return
        std = deviations(camera_covariance)
        self.prior.residual, self.prior.residual_sigma = adjustment.prior_residuals()
        self.prior.scale_std, self.prior.shift_std = std[adjustment.columns.scales], std[adjustment.columns.shifts]
