"""A focal length that was held joins the variables of the live graph, once the map determines it."""

from __future__ import annotations

import numpy as np

from factorsfm.graph.live_isam import LiveIsam
from factorsfm.graph.window import Window

_STD = 0.0022  # relative, of independent observations, with which a focal length counts as determined
_NEARLY = 1.2  # times that, beyond which further steps do not lead there
_STEPS, _TOLERANCE = 6, 1e-4
_STEP = 0.03  # of the logarithm of the focal length, that can be made in one go


def with_free_lens(live: LiveIsam, window: Window) -> tuple[LiveIsam, Window] | None:
    """A copy in which the focal length is estimated, and the window with its values; None where it stays open.

    Where a first step goes far, the focal length is led there a little at a time: in one go the reprojections would be
    so far off that the robust kernel drops them.
    """
    opened = live.copy()
    opened.step_with_free_lens()
    if opened.focal_std() > 2.0 * _STD:
        return None
    before, after = window.focal, opened.estimated_focal()
    if (steps := int(abs(np.log(after / before)) / _STEP)) > 0:
        opened = live.copy()
        for focal in np.geomspace(before, after, steps + 2)[1:].tolist():
            opened.step_with_held_lens(focal)
        opened.step_with_free_lens()
        if opened.focal_std() > _NEARLY * _STD:
            return None
    for _ in range(_STEPS):
        before = opened.estimated_focal()
        opened.step_with_free_lens()
        if abs(opened.estimated_focal() / before - 1.0) < _TOLERANCE:
            break
    solved = opened.solved(window)
    return (opened, solved) if opened.focal_std() < _STD else None
