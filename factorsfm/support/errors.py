"""The errors that the library raises: one root, one subclass per reason."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


class FactorsfmError(Exception):
    """Root of all errors of this package; the message is one clear sentence for the user."""


class InputError(FactorsfmError):
    """The input cannot be used: missing, unreadable, or contradictory (command line: exit status 2)."""


class ModelError(InputError):
    """A network cannot be found, fetched, loaded or understood."""


class ReconstructionError(FactorsfmError):
    """The input is fine but this shot cannot be reconstructed (command line: exit status 3).

    Attributes:
        frames: a `FrameResult` for every frame whose fate is known.
    """

    def __init__(self, message: str, frames: Sequence[Any] = ()) -> None:
        super().__init__(message)
        self.frames = tuple(frames)
