"""Optical flow between two frames: where tracks should be, and a pyramidal search for those that are not there."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.support.options import TrackerOptions
from factorsfm.support.semidefinite import solution
from factorsfm.tracks.grey import GreyFrame
from factorsfm.tracks.parts import in_parts

Array = NDArray[np.float32]
Flags = NDArray[np.bool_]

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 12, 0.02)  # coarse: the re-alignment refines the result
_SAMPLED_TRACKS = 64  # that are followed to predict the others
_FIT_ITERATIONS, _FIT_RIDGE = 5, 1e-4
_LEAST_FIT_SCALE_PX = 0.5  # scale of the kernel of the fit, at least


class FrameFlow:
    """Pyramidal Lucas-Kanade flow from one frame to the next.

    Args:
        options: window, pyramid levels and the limit of the forward-backward check.
        pool: two threads.
    """

    def __init__(self, options: TrackerOptions, pool: ThreadPoolExecutor) -> None:
        self._window = (options.window_px, options.window_px)
        self._levels = options.levels
        self._check_px = options.flow_check_px
        self._pool = pool

    def predict(self, previous: GreyFrame, frame: GreyFrame, xy: Array, velocity: Array) -> Array:
        """Where tracks should be: at constant velocity, corrected by the flow of a few of them.

        The correction is affine in the place, as the flow of a small rotation nearly is, and in the velocity, which
        holds the parallax.

        Args:
            xy: (n, 2) pixels in the previous frame; velocity: (n, 2) pixels per frame.
        """
        predicted = xy + velocity
        sampled = np.linspace(0, len(predicted) - 1, min(len(predicted), _SAMPLED_TRACKS)).astype(int)
        found, seen = self._coarse_flow(previous, frame, xy[sampled])
        sampled = sampled[seen]
        scale = np.array([1.0, *([1.0 / max(frame.full.shape)] * 4)])
        design = np.column_stack([np.ones(len(predicted)), xy, velocity]) * scale
        correction = robust_fit(design[sampled], found[seen] - predicted[sampled])
        return np.asarray(predicted + design @ correction, np.float32)

    def search(self, previous: GreyFrame, frame: GreyFrame, xy: Array, start: Array | None) -> tuple[Array, Flags]:
        """Flow of n points, coarse to fine.

        Args:
            xy: (n, 2) pixels in the previous frame.
            start: (n, 2) near where they are in the frame; None searches from the top of the pyramid.

        Returns:
            (n, 2) pixels in the frame, and whether each passes the forward-backward check.
        """

        def part(rows: NDArray[np.intp]) -> tuple[Array, Flags]:
            old = xy[rows]
            coarse, _ = self._coarse_flow(previous, frame, old, None if start is None else start[rows])
            forward, status, _ = cv2.calcOpticalFlowPyrLK(
                previous.full, frame.full, old, coarse, winSize=self._window, maxLevel=0, criteria=_CRITERIA,
                flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            )  # fmt: skip
            # The way back starts where it should end: the check only asks whether it stays there.
            back, status_back, _ = cv2.calcOpticalFlowPyrLK(
                frame.full, previous.full, forward, old.copy(), winSize=self._window, maxLevel=1, criteria=_CRITERIA,
                flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            )  # fmt: skip
            passed = (status[:, 0] == 1) & (status_back[:, 0] == 1)
            passed &= np.linalg.norm(back - old, axis=1) < self._check_px
            return forward, passed

        return in_parts(part, len(xy), len(xy), self._pool) if len(xy) else (xy, np.zeros(0, bool))

    def _coarse_flow(
        self, previous: GreyFrame, frame: GreyFrame, xy: Array, start: Array | None = None
    ) -> tuple[Array, Flags]:
        """Flow of points in the images of half the size, in pixels of the full ones, and whether it was found."""
        first = None if start is None else (start - 0.5) / 2
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            previous.half, frame.half, (xy - 0.5) / 2, first, winSize=self._window,
            maxLevel=self._levels - 1 if start is None else 1, criteria=_CRITERIA,
            flags=0 if start is None else cv2.OPTFLOW_USE_INITIAL_FLOW,
        )  # fmt: skip
        return 2 * found + 0.5, status[:, 0] == 1


def robust_fit(design: NDArray[np.float64], target: Array) -> NDArray[np.float64]:
    """(c, 2) coefficients with ``design @ coefficients ~ target``, by iteratively re-weighted least squares (Cauchy).

    Zero where there are fewer than 2 c rows.

    Args:
        design: (n, c) of the size of one.
        target: (n, 2) pixels.
    """
    rows, columns = design.shape
    found: NDArray[np.float64] = np.zeros((columns, 2))
    weight = np.ones(rows)
    for _ in range(_FIT_ITERATIONS if rows >= 2 * columns else 0):
        weighted = design * weight[:, None]
        normal = weighted.T @ design + _FIT_RIDGE * np.eye(columns)
        found = solution(normal, weighted.T @ target)
        error = np.linalg.norm(design @ found - target, axis=1)
        weight = 1.0 / (1.0 + (error / max(float(np.sort(error)[rows // 2]), _LEAST_FIT_SCALE_PX)) ** 2)
    return found
