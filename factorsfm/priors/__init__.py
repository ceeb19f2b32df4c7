"""What networks, or files in their place, say of a single image: depth, masks, and values at keypoints.

Takes a frame, gives depth and masks. May import `frames` and what lies below it.
"""

from factorsfm.priors.depth import DepthFolder, DepthKind, DepthMap, DepthModel, DepthPrior, open_depth
from factorsfm.priors.masks import MaskFolder, MaskModel, MaskPrior, open_masks
from factorsfm.priors.networks import NETWORK_SPECS, NetworkSpec

__all__ = [
    "NETWORK_SPECS",
    "DepthFolder",
    "DepthKind",
    "DepthMap",
    "DepthModel",
    "DepthPrior",
    "MaskFolder",
    "MaskModel",
    "MaskPrior",
    "NetworkSpec",
    "open_depth",
    "open_masks",
]
