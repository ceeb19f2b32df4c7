"""What is said of a result."""

from factorsfm.control.fit import ControlFit, ControlResidual
from factorsfm.result.notes import control_notes


def test_contradictions_are_given_in_their_unit_and_in_sigmas():
    residuals = [
        ControlResidual("height of a", "m", 0.25, 0.01, 25.0, contradicts=True),
        ControlResidual("GPSFactor on x3", "sigma", 31.0, 1.0, 31.0, contradicts=True),
    ]
    _, note = control_notes(ControlFit(residuals, [], [], True, 0.01, 0.01))
    assert note.endswith(": GPSFactor on x3 by 31 sigma; height of a by 0.25 m or 25 sigma.")


def test_factors_that_know_no_lengths_say_nothing_of_the_scale():
    (note,) = control_notes(ControlFit([], [], [], False, float("inf"), 0.0025, "factors"))
    assert note == "Factors added: 0 items used; they leave the unit of length open."
