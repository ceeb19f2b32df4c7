"""The live factor graph: keyframe poses, landmarks and prior affines as variables of one persistent iSAM2.

Variables are ``X(i)``, the pose (`world_from_cam`) of the keyframe with the index i in the source; ``L(j)``, the
landmark of track j; ``A(i)``, scale and shift of that keyframe's depth prior; ``K(0)``, the lens, where it is not
known; and what the caller adds. A keyframe that leaves the window becomes a constant: its projections are replaced by
factors on the landmarks alone, so that an update costs the same however long the shot.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from factorsfm.graph.added_factors import NOTHING_ADDED, AddedFactors, misfit_of
from factorsfm.graph.live_isam import LiveIsam
from factorsfm.graph.open_lens import with_free_lens
from factorsfm.graph.window import Window

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_LARGEST_ERROR_PX = 10.0  # median, of the newest keyframe
_LEAST_IN_FRONT = 0.7  # of the landmarks of the newest keyframe
_FIRM_LANDMARK_SIGMA = 0.3  # see `LANDMARK_SIGMA`, where an update fails
_MORE_KEYFRAMES = 1.15  # times as many as left the focal length open, before it is tried again: a try takes many steps
_LARGEST_LENS_STEP = 0.5  # of the logarithm of the focal length
_MIRRORED = "the depth is mirrored: the scale of a prior is negative"


@dataclass(frozen=True, slots=True)
class UpdateResult:
    """Outcome of an update: committed or rolled back, and why.

    Attributes:
        window: with the values after the update, or as it was.
        covariance: (6, 6) of each pose that is solved for, by keyframe (`FrameResult.covariance`).
        mirrored: whether it was rolled back because the solution and the prior are each other's mirror image.
        added: the caller's factors, with the values of their variables after the update.
        misfit: which of them is grossly off all the same, and by how much; empty if none is.
    """

    committed: bool
    reason: str
    window: Window
    covariance: dict[int, Array] = field(default_factory=dict)
    mirrored: bool = False
    added: AddedFactors = NOTHING_ADDED
    misfit: str = ""


class KeyframeGraph:
    """The graph of the keyframes of one map.

    Every update runs on a copy and is committed only if the result is finite, in front of the cameras and not
    mirrored; a failed iSAM2 object is never used again.
    """

    def __init__(self) -> None:
        self._live = LiveIsam()
        self._copy: LiveIsam | None = None  # on which the next update runs
        self._replaced: tuple[LiveIsam | None, ...] = ()  # by the last update: GTSAM frees as slowly as it copies
        self._opens_lens_from = 0  # keyframes

    def update(
        self,
        window: Window,
        iterations: int,
        added: AddedFactors = NOTHING_ADDED,
        constants: gtsam.Values | None = None,
    ) -> UpdateResult:
        """Add what the graph does not know of the window, remove what has left it, and solve.

        Args:
            window: its first keyframe is the world, or constant; the newest is the last one.
            iterations: steps of iSAM2.
            added: the caller's factors; constants: values of the variables that these name besides those of the window.
        """
        if not (window.frame == len(window.keyframes) - 1).any():
            return _rolled_back(window, "the keyframe observes no landmark")
        held = constants or gtsam.Values()
        reason, trials = "", [self._trial()] if self._live.fits(window) else []
        # What is indeterminate from where the graph stands may not be so from the map, or with firmer landmarks.
        for live in (*trials, LiveIsam(), LiveIsam(landmark_sigma=_FIRM_LANDMARK_SIGMA)):
            try:
                solved = live.update(window, iterations, added, held)
                reason = _fault(solved, window.focal)
                if not reason:
                    self._replaced, self._copy = (self._live, self._copy), None
                    self._live, solved = self._with_open_lens(live, solved)
                    covariance = self._live.covariances(solved)
                    if not added.numbers:
                        return UpdateResult(True, "committed", solved, covariance)
                    estimate = self._live.estimate()
                    misfit, added = misfit_of(added, estimate), added.with_values(estimate)
                    return UpdateResult(True, "committed", solved, covariance, added=added, misfit=misfit)
                break
            except Exception as error:  # gtsam raises several types; any of them leaves the trial unusable
                reason = f"the linear system of the update is indeterminate ({_first_line(error)})"
        return _rolled_back(window, reason)

    def start_anew(self) -> None:
        """Begin another graph with the next update, from the values of its window."""
        self._live, self._copy = LiveIsam(), None

    def prepare(self) -> None:
        """Do for the next update what takes time and can be done before, while nobody waits for one."""
        self._replaced, self._copy = (), self._copy or self._live.copy()

    def _trial(self) -> LiveIsam:
        trial, self._copy = self._copy or self._live.copy(), None
        return trial

    def _with_open_lens(self, live: LiveIsam, window: Window) -> tuple[LiveIsam, Window]:
        """The graph with the focal length among its variables, from when on the map determines it."""
        if not window.open_lens or live.free_lens or len(window.keyframes) < self._opens_lens_from:
            return live, window
        try:
            found = with_free_lens(live, window)
            if found is not None and not _fault(found[1], window.focal):
                return found
        except Exception as error:
            logger.debug("the focal length stays as it is: %s", _first_line(error))
        self._opens_lens_from = int(np.ceil(_MORE_KEYFRAMES * len(window.keyframes)))
        return live, window

    def contents(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """A copy of the factors, and the estimate."""
        return self._live.contents()


def _first_line(error: Exception) -> str:
    return (str(error).strip() or repr(error)).splitlines()[0]


def _rolled_back(window: Window, reason: str) -> UpdateResult:
    logger.warning("update at frame %d rolled back: %s", window.keyframes[-1], reason)
    return UpdateResult(False, reason, window, mirrored=reason == _MIRRORED)


def _fault(window: Window, focal: float) -> str:
    """What speaks against a result, judged at its newest keyframe; empty if nothing does. `focal`: as it was before."""
    if not abs(np.log(window.focal / focal)) < _LARGEST_LENS_STEP:
        return f"the focal length goes from {focal:.0f} to {window.focal:.0f} pixels"
    if not (np.isfinite(window.rotation).all() and np.isfinite(window.translation).all()):
        return "the pose is not finite"
    newest = window.frame == len(window.keyframes) - 1
    errors, depth = (values[newest] for values in window.reprojection())
    front = depth > 1e-6
    if front.mean() < _LEAST_IN_FRONT:
        return f"{int((~front).sum())} of {len(front)} landmarks lie behind the camera"
    error = float(np.median(errors))
    if not error < _LARGEST_ERROR_PX:
        return f"the median reprojection error is {error:.1f} pixels, at most {_LARGEST_ERROR_PX:.0f} expected"
    if window.depths is not None and (window.depths.scale <= 0.0).any():
        return _MIRRORED
    return ""
