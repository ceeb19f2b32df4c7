"""Rolling shutter: images whose rows are read out one after another while the camera moves.

Each row is seen from where the camera is when that row is read. Poses are those of the middle row; points above and
below it are displaced along their tracks, whose motion the frames before and after show. The only unknown is the
readout: the share of the time between two frames that passes from the first to the last row. Rows become columns where
a recorded image was turned upright, so both directions are tried.

Most renderers and compositors that show the result over the recorded images know no rolling shutter. For them each
camera is fitted to its recorded image at the end, on points that are free of it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.observations import DISTORTION, READOUT, Observations, Sweep
from factorsfm.adjustment.problem import ErrorModel, Free, Known, LensPrior
from factorsfm.adjustment.residuals import by_pose, cauchy, reprojection
from factorsfm.adjustment.some_frames import on_some_frames, some_frames
from factorsfm.adjustment.state import State
from factorsfm.lens.certainty import lens_deviations
from factorsfm.lens.lens import READOUT_SIGMA, Lens, LensEstimate, observed_width, shape_sigmas
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.motion.shot_kind import CLEAR_GAIN, LEAST_GAIN, Motion, translation_gain
from factorsfm.support.options import Options
from factorsfm.support.rotations import exponential
from factorsfm.support.semidefinite import solution
from factorsfm.support.status import ShotKind

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_LONGEST = 1.0  # frames: the sensor has to be done before the next one ...
_CLEARLY = 3.0  # ... and an estimate has an error, in standard deviations
_LEAST_STEP = 0.03  # frames, of the first Newton step: a shorter readout does not matter
_TURNING_GAIN = 10.0  # of translation, as in `Motion`, below which the camera may only turn
_ROUGH = 1e-3  # relative decrease of the cost, with which few frames tell a clear translation from none
# What it explains beyond what poses and points do. A camera that trucks at a constant speed hides a shutter along the
# rows altogether; what errors of tracks have in common then passes for one of 0.003 pixels. Real ones explain 0.025 up.
_LEAST_PX = 0.01
_LEAST_EVIDENCE = 16.0  # squared standard deviations; an actor without a mask reaches 10
_FEWEST, _ROUNDS = 12, 4  # least number of tracks for a field of accelerations; re-weightings
_FITS = 5  # Gauss-Newton steps to the cameras of the recorded images, which are near


@dataclass(frozen=True, slots=True)
class Recording:
    """Images whose rows may have been read one after another.

    Attributes:
        width, height: pixels.
        times: (n,) of the images, ascending, in usual intervals between two frames of the source.
        stretch: (2,) focal lengths across and down over their mean, which differ where pixels are not square.
    """

    width: int
    height: int
    times: Array
    stretch: Array = field(default_factory=lambda: np.ones(2))


@dataclass(frozen=True, slots=True)
class Shutter:
    """A rolling shutter that the shot shows.

    Attributes:
        lens: the guess or a better one, with the readout.
        std: standard deviation of the readout.
    """

    lens: Lens
    std: float

    @property
    def readout(self) -> Array:
        """(2,) share of the time between frames that the readout takes along columns and rows, one of them zero."""
        return np.asarray(self.lens.shape[READOUT])

    @property
    def is_too_long(self) -> bool:
        """Whether the sensor would not be done before the next frame."""
        return bool(np.abs(self.readout).max() - _CLEARLY * self.std > _LONGEST)

    def known_with(self, estimate: LensEstimate) -> Shutter | None:
        """The same beside a lens that was estimated with it, None where that makes it too long."""
        std = estimate.shape_std[READOUT][self.readout != 0.0]
        shutter = Shutter(estimate.lens, float(np.fmax(std, self.std)[0]))
        return None if shutter.is_too_long else shutter


def with_sweep(
    observations: Observations,
    tracks: Index,
    images: Sequence[MappedImage],
    frames: Sequence[int],
    focal: Array,
    recording: Recording,
) -> Observations:
    """The observations with `Observations.sweep`, from their tracks in the images before and after.

    Args:
        tracks: (n,) id of each point; images: all those of the recording; frames: which of them are those of the
            observations; focal: (k,) of these, with which the observations were gathered.
    """
    gaps = np.pad(np.diff(recording.times), 2, constant_values=1.0)
    motion, acceleration, place = (np.zeros_like(observations.pixels) for _ in range(3))
    by_frame = observations.rows_by_frame(len(frames))
    for k, (position, rows) in enumerate(zip(frames, by_frame, strict=True)):
        ids = tracks[observations.point[rows]]
        seen = np.stack([float(focal[k]) * _seen(images, position + step, ids) for step in range(-2, 3)])
        around = gaps[position : position + 4]
        place[rows] = seen[2] * recording.stretch / (recording.width, recording.height)
        motion[rows], acceleration[rows] = _motion(np.diff(seen, axis=0) / around[:, None, None], around, place[rows])
    return replace(observations, sweep=Sweep(motion, acceleration, place))


def _motion(velocity: Array, time: Array, place: Array) -> tuple[Array, Array]:
    """(n, 2) motion and acceleration in an image, without the error of the very observation that they are to explain.

    The motion is that between the images before and after; at the end of a track it follows from the two images beyond,
    and only where these do not see it from this image, too. The acceleration is smooth over the image. A track of a
    single image does not move.

    Args:
        velocity: (4, n, 2) between five images, of which this one is in the middle, NaN where one of two is missing;
        time: (4,) between these images.
    """
    before, to, on, beyond = velocity
    acceleration = _smooth(2.0 * (on - to) / (time[1] + time[2]), place)
    motion = (to * time[2] + on * time[1]) / (time[1] + time[2])
    for end, away in (
        (beyond, -time[2] - 0.5 * time[3]),
        (before, time[1] + 0.5 * time[0]),
        (on, -0.5 * time[2]),
        (to, 0.5 * time[1]),
    ):
        motion = np.where(np.isnan(motion), end + away * acceleration, motion)
    still = np.isnan(motion)
    return np.where(still, 0.0, motion), np.where(still, 0.0, acceleration)


def _smooth(values: Array, place: Array) -> Array:
    """Robust linear fit of values (n, 2) over the image, some of them NaN; 0 where they are too few."""
    known = np.isfinite(values[:, 0])
    if known.sum() < _FEWEST:
        return np.zeros_like(values)
    design = np.column_stack([np.ones(len(place)), place])
    weight = np.ones(int(known.sum()))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, None]
        field, *_ = np.linalg.lstsq(root * design[known], root * values[known], rcond=None)
        off = values[known] - design[known] @ field
        weight = cauchy(off, max(float(np.median(np.linalg.norm(off, axis=1))), 1e-9))[1]
    return np.asarray(design @ field)


def _seen(images: Sequence[MappedImage], position: int, ids: Index) -> Array:
    """(n, 2) normalised coordinates of tracks; NaN where an image does not see them."""
    known = images[position].tracks.ids if 0 <= position < len(images) else ids[:0]
    if not len(known):
        return np.full((len(ids), 2), np.nan)
    at = np.minimum(np.searchsorted(known, ids), len(known) - 1)
    return np.where((known[at] == ids)[:, None], images[position].tracks.xy[at], np.nan)


def find_shutter(adjustment: BundleAdjustment, motion: Motion, options: Options) -> Shutter | None:
    """The rolling shutter, None where errors of the tracks may explain it.

    Args:
        adjustment: converged without a shutter, over observations with their sweep; motion: of its camera.
    """
    if motion.kind is ShotKind.STATIC:
        return None
    if (turning := turns_before_shutter(adjustment, motion, options)) is not None:
        return _believed(turning, adjustment.state)
    if motion.kind is ShotKind.ROTATION:
        return None
    moving = _solved_with_readout(adjustment, adjustment.state, options, moves=True)
    if moving is None or _explained_px(moving, adjustment) < _LEAST_PX:
        return None
    return _believed(moving, adjustment.state)


def _explained_px(solved: BundleAdjustment, without: BundleAdjustment) -> float:
    """Root mean square of what a shutter explains of the errors of a solution without one."""
    beside = BundleAdjustment(solved.state, without.observations, without.options, without.errors)
    gain = float((without.observation_costs() - beside.observation_costs()).sum())
    return without.sigma * float(np.sqrt(max(gain, 0.0) / len(without.observations.frame)))


def turns_before_shutter(adjustment: BundleAdjustment, motion: Motion, options: Options) -> BundleAdjustment | None:
    """The camera that turns before a rolling shutter, where that explains what seems to be a translation; else None.

    The images of a camera that turns are skewed, and so it may seem to move, too.
    """
    if motion.gain >= _TURNING_GAIN:
        return None
    _, few, _ = some_frames(motion.rotation_only, adjustment.observations)
    rough = replace(options, polish=replace(options.polish, tolerance=_ROUGH))
    if _turning(on_some_frames(adjustment), few, rough, CLEAR_GAIN) is None:
        return None
    return _turning(adjustment, motion.rotation_only, options, LEAST_GAIN)


def _turning(adjustment: BundleAdjustment, start: State, options: Options, least: float) -> BundleAdjustment | None:
    """The camera that turns before a rolling shutter, None where it has none or where translation gains this much."""
    turning = _solved_with_readout(adjustment, start, options, moves=False)
    return turning if turning is not None and translation_gain(turning, adjustment) < least else None


def _solved_with_readout(
    adjustment: BundleAdjustment, state: State, options: Options, *, moves: bool
) -> BundleAdjustment | None:
    """Converged with a readout along rows or columns, None where it is short, or where the lens has no ray any more."""
    o = adjustment.observations
    shape = shape_sigmas(options.lens, observed_width(state, o))

    def problem(free: NDArray[np.bool_]) -> BundleAdjustment:
        return BundleAdjustment(
            state,
            o,
            options.polish,
            ErrorModel(adjustment.sigma),
            free=Free(translation=moves, focal=options.refine_focal_length),
            known=Known(lens=LensPrior(state.lens, np.r_[shape, READOUT_SIGMA * free])),
        )

    step = np.abs(problem(np.array([True, True])).lens_step()[-2:])
    if step.max() < _LEAST_STEP:
        return None
    solved = problem(np.arange(2) == np.argmax(step))
    return solved if np.isfinite(solved.solve().normalized(o)).all() else None


def _believed(solved: BundleAdjustment, guess: State) -> Shutter | None:
    """The shutter of a solution beside the lens of the guess, None where it may be chance."""
    std, left_out, evidence = lens_deviations(solved, guess.lens, READOUT)
    readout = solved.state.lens[READOUT]
    deviation = float(np.nanmax(np.fmax(std, left_out)[-2:]))
    logger.info("readout %s within %.3f frames, %.0f squared deviations", readout, deviation, evidence)
    shutter = Shutter(Lens(np.exp(guess.log_focal), np.r_[guess.lens[DISTORTION], readout]), deviation)
    return None if evidence < _LEAST_EVIDENCE or shutter.is_too_long else shutter


def seen_at_once(state: State, observations: Observations, weight: Array, *, moves: bool) -> State:
    """The cameras that show the points most nearly where the recorded images do, as if all were read at once.

    Args:
        state: with the points, which stay, and the rolling shutter; weight: (m,) of each observation.
        moves: whether the camera does more than turn.
    """
    free = 6 if moves else 3
    state = replace(state, lens=np.r_[state.lens[DISTORTION], np.zeros(2)])
    order = np.argsort(observations.frame, kind="stable")
    o, weight = observations.at(order), weight[order]
    xy = state.normalized(o)
    first = np.searchsorted(o.frame, np.arange(len(state.rotation)))
    for _ in range(_FITS):
        q = state.camera_points(o.frame, o.point)
        residual, by_q = reprojection(q, xy, 1.0)
        by_camera = by_pose(by_q.transpose(1, 0, 2), q, state.inverse_distance[o.point])[:, :, :free]
        jacobian = by_camera.transpose(1, 0, 2)
        gain = np.einsum("m,mdi->mid", weight, jacobian)
        information = np.add.reduceat(gain @ jacobian, first)
        gradient = np.add.reduceat(gain @ residual[:, :, None], first)
        step = np.zeros((len(first), 6))
        step[:, :free] = -solution(information, gradient)[:, :, 0]
        turn = exponential(-step[:, :3])
        translation = np.einsum("kij,kj->ki", turn, state.translation - step[:, 3:])
        state = replace(state, rotation=turn @ state.rotation, translation=translation)
    return state
