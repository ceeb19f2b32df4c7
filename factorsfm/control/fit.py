"""The fit of a result to its control."""

from __future__ import annotations

from dataclasses import dataclass

CONTRADICTION = 4.0  # standard deviations


@dataclass(frozen=True, slots=True)
class ControlResidual:
    """How far one item of the control is from the result.

    Attributes:
        name: of the item; unit: of `error` and `sigma`: "m", "degrees" or "px".
        error: length of the difference; sigma: as given; sigmas: the one over the other.
        contradicts: whether the difference is so large that the item has hardly any weight.
    """

    name: str
    unit: str
    error: float
    sigma: float
    sigmas: float
    contradicts: bool

    @classmethod
    def of(cls, name: str, unit: str, sigma: float, sigmas: float) -> ControlResidual:
        """An item that is off by so many standard deviations."""
        return cls(name, unit, sigmas * sigma, sigma, sigmas, sigmas > CONTRADICTION)


@dataclass(frozen=True, slots=True)
class ControlFit:
    """How well a result agrees with its control.

    Attributes:
        residuals: of every item that was used.
        held: names of the frames whose poses were held exactly.
        unused: what could not be used, and why.
        placed: whether the result is in the world of the control; where only distances or heights are known, it is in
            that of its first camera.
        scale_std: relative standard deviation of the scene's size in the control's unit, infinite where factors leave
            the unit open.
        position_std: standard deviation of a camera's position in this world and unit, median over the cameras.
        source: "control", or "factors" where the caller added them to the live graph; the world is then that of the
            live map.
    """

    residuals: list[ControlResidual]
    held: list[str]
    unused: list[str]
    placed: bool
    scale_std: float
    position_std: float
    source: str = "control"
