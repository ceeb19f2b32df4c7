"""What is known of a single image beforehand, from networks or files: its depth, and masks of what moves.

Takes a frame, gives depth and masks. May import `frames` and what lies below it.
"""

from factorsfm.priors.depth import DepthFolder, DepthModel, DepthPrior, open_depth
from factorsfm.priors.depth_map import DepthKind, DepthMap
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
