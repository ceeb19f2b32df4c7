"""The camera of a stream: given, or guessed with the first frame, and as the map knows it since."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pycolmap

from factorsfm.frames.frame import Frame
from factorsfm.lens.camera_model import distortion_of
from factorsfm.mapping.mapper import Mapper
from factorsfm.streaming.footage import Footage
from factorsfm.support.errors import InputError
from factorsfm.support.options import Options

_LEAST_SIDE = 32  # pixels: room for the patches of the tracker


class StreamCamera:
    """The camera of all frames.

    Args:
        camera: the lens, None where it is not known.

    Attributes:
        newest: as it is known now; None before the first frame where it was not given.
        given: whether it is known, and no guess.
    """

    def __init__(self, camera: pycolmap.Camera | None) -> None:
        self.newest, self.given = camera, camera is not None
        self._size = (0, 0)  # width and height of the frames, pixels

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs."""
        return {"camera": self.newest, "_size": self._size, "_lens_given": self.given}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on where `state` was taken."""
        self.newest, self._size, self.given = state["camera"], state["_size"], state["_lens_given"]

    @property
    def known(self) -> pycolmap.Camera:
        """That of the newest frame; there must be one."""
        assert self.newest is not None
        return self.newest

    def open(self, frame: Frame, footage: Footage, options: Options) -> None:
        """Take, or guess, the camera of the first frame.

        Raises:
            InputError: the frame is too small, or not of the size of the camera; the options estimate of the lens what
                its model does not have.
        """
        height, width = frame.image.shape[:2]
        if min(height, width) < _LEAST_SIDE:
            raise InputError(f"the images have {width}x{height} pixels; at least {_LEAST_SIDE} on each side are needed")
        self.newest = footage.opened(frame, self.newest)
        if options.estimates_lens:
            distortion_of(self.newest)  # refuses what cannot be estimated
        self._size = (self.newest.width, self.newest.height)

    def check_size(self, frame: Frame) -> None:
        """Refuse a frame of another size than those before.

        Raises:
            InputError: it is one.
        """
        height, width = frame.image.shape[:2]
        if (width, height) != self._size:
            expected = f"{self._size[0]}x{self._size[1]} as the frames before"
            raise InputError(f"frame {frame.index} is {width}x{height}, expected {expected}")

    def follow(self, mapper: Mapper) -> bool:
        """Take over the camera of the mapper's images; whether it has another focal length."""
        if math.isclose(mapper.focal, self.known.mean_focal_length(), rel_tol=1e-12):
            return False
        self.newest = mapper.images[-1].tracks.camera
        return True
