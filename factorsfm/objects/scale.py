"""The scale of an object beside that of the scene, and the depth prior, which sees both in the same maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ScaleSource = Literal["rest", "prior"]

_LEAST_VALUES = 5  # of a map on the object
_LARGEST_STD = 0.5  # relative: beyond, the median depth of the scene says as much


@dataclass(frozen=True, slots=True)
class PriorOnScene:
    """What the scene says of the depth map of a frame: ``scale / z + shift`` predicts its inverse depth.

    Attributes:
        scale, shift, scale_std, shift_std, sigma, smooth: as in `PriorFit`.
        on_things: relative error of the depth of a thing that stands out from the scene, which the scene does not show.
    """

    scale: float
    shift: float
    scale_std: float
    shift_std: float
    sigma: float
    smooth: float
    on_things: float = 0.0


@dataclass(frozen=True, slots=True)
class Scale:
    """Units of the scene in one unit of the object.

    Attributes:
        std: relative; frames: number of frames, or of maps, that it comes from; source: what gives it.
    """

    value: float
    std: float
    frames: int
    source: ScaleSource


def scale_from_prior(
    maps: Sequence[tuple[Array, Array, PriorOnScene]],
) -> Scale | None:
    """The median over frames of the depth that the maps say of the object, in the scene's units, over its own.

    The error of a network on one thing is alike in all frames, so that further frames add nothing to the precision: it
    is that of a single map. The spread of the frames counts where it is larger.

    Args:
        maps: per frame with a map: (n,) its inverse depths on the object, (n,) the object's z-depths there, and what
            the scene says of this map.

    Returns:
        None where no map says anything of the object, or none says it to a half of it.
    """
    ratios, stds = [], []
    for inverse_depth, depth, prior in maps:
        inverse = (inverse_depth - prior.shift) / prior.scale
        good = np.isfinite(inverse) & (inverse > 0.0)
        if good.sum() < _LEAST_VALUES or not prior.scale > 0.0:
            continue
        near = float(np.median(inverse[good]))
        ratios.append(float(np.median(1.0 / (inverse[good] * depth[good]))))
        errors = np.array([prior.sigma, prior.smooth, prior.shift_std, prior.scale_std * near]) / (prior.scale * near)
        stds.append(float(np.hypot(np.linalg.norm(errors), prior.on_things)))
    if not ratios:
        return None
    value = float(np.median(ratios))
    spread = 1.4826 * float(np.median(np.abs(np.array(ratios) / value - 1.0)))
    std = max(float(np.median(stds)), spread)
    return Scale(value, std, len(ratios), "prior") if std < _LARGEST_STD else None
