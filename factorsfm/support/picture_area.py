"""What of an image is picture, where it has bars beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class PictureArea:
    """What of an image shows the picture: columns `left` to `right` and lines `top` to `bottom`, without these ends."""

    left: int
    top: int
    right: int
    bottom: int

    def of(self, image: NDArray[Any]) -> NDArray[Any]:
        """The picture of a (h, w, ...) image."""
        return image[self.top : self.bottom, self.left : self.right]

    def outside(self, shape: tuple[int, ...], margin: int) -> NDArray[np.bool_]:
        """(h, w) of an image of this shape: True in the bars and up to `margin` pixels beside them."""
        mask = np.zeros(shape[:2], bool)
        mask[: self.top + margin if self.top else 0] = True
        mask[self.bottom - margin if self.bottom < shape[0] else shape[0] :] = True
        mask[:, : self.left + margin if self.left else 0] = True
        mask[:, self.right - margin if self.right < shape[1] else shape[1] :] = True
        return mask

    def said(self, width: int, height: int) -> str:
        """The widths of the bars of an image of this size in words."""
        widths = {"on the left": self.left, "on the right": width - self.right}
        widths |= {"above": self.top, "below": height - self.bottom}
        parts = [f"{pixels} pixels {where}" for where, pixels in widths.items() if pixels]
        return ", ".join(parts[:-1]) + " and " * (len(parts) > 1) + parts[-1]
