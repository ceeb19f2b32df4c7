"""The pixel aspect, width of a pixel over its height: what the user or a file may say."""

from __future__ import annotations

import logging
import math
from pathlib import Path

from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

_LEAST, _MOST = 0.25, 4.0  # anamorphic lenses squeeze by 2 at most, and fields halve the lines


def check_pixel_aspect(aspect: float) -> None:
    """Refuse a pixel aspect that no footage has.

    Raises:
        InputError: it is out of range.
    """
    if not _LEAST <= aspect <= _MOST:
        raise InputError(f"the pixel aspect is {aspect:g}; {_LEAST:g} to {_MOST:g} is expected")


def stated_or_square(aspect: float, path: Path) -> float:
    """What a file says, 1 if that is no number; 1 with a warning if no footage has such pixels."""
    if not (math.isfinite(aspect) and aspect > 0):
        return 1.0
    if not _LEAST <= aspect <= _MOST:
        logger.warning(
            "%s states a pixel aspect of %g, which is ignored; %g to %g is expected", path, aspect, _LEAST, _MOST
        )
        return 1.0
    return aspect
