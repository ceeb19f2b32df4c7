"""The depth prior of a stream, read at keypoints; once there is a map, a frame on which it fails goes without."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from factorsfm.frames.frame import Frame
from factorsfm.priors.depth import DepthPrior
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.priors.read_priors import read_depth
from factorsfm.support.errors import ModelError

logger = logging.getLogger(__name__)


class DepthReader:
    """A prior, or none.

    Attributes:
        failed: why it failed, by the frame's index.
    """

    def __init__(self, prior: DepthPrior | None) -> None:
        self.prior = prior
        self.failed: dict[int, str] = {}

    def read(self, frame: Frame, xy: NDArray[np.float64], *, needed: bool) -> ImageDepth | None:
        """The prior at keypoints (n, 2) in pixels; None where it fails or has failed before.

        Raises:
            ModelError: it fails, and is needed.
        """
        assert self.prior is not None
        if frame.index in self.failed:
            return None
        try:
            return read_depth(self.prior, frame, xy)
        except ModelError as error:
            if needed:
                raise
            logger.warning("%s; the frame goes without", error)
            self.failed[frame.index] = str(error)
            return None
