"""One grade, with its reasons, wherever a result is told of."""

from pathlib import Path

import pytest

from factorsfm.result.reconstruction import RollingShutter
from factorsfm.result.summary import conclusion, summary, verdict
from factorsfm.result.verdict import Grade, verdict_of
from tests.exact_result import build


@pytest.mark.parametrize(
    ("unregistered", "grade"), [((), Grade.SOLVED), ((2,), Grade.IN_PART), (tuple(range(6)), Grade.NOT_SOLVED)]
)
def test_the_grade_says_how_much_is_solved(unregistered, grade):
    assert verdict_of(build(unregistered=unregistered)).grade is grade


def test_a_doubt_is_told_everywhere():
    result = build(unregistered=())
    result.doubts = ["Another reading is as good."]
    said = conclusion(result, Path("out")).splitlines()
    assert verdict(result).endswith("; doubtful")
    assert "Doubtful: Another reading is as good." in said
    assert said[-1].startswith("Doubtful. Result in out; open")
    assert (summary(result)["grade"], summary(result)["doubts"]) == ("Doubtful", result.doubts)


def test_the_skew_of_a_rolling_shutter_is_no_misfit():
    result = build(unregistered=())
    result.observation_error = result.observation_error + 2.0
    assert verdict_of(result).grade is Grade.DOUBTFUL
    result.shutter = RollingShutter(0.5, 0.01, "rows", recorded=True, reprojection_error=0.12)
    assert verdict_of(result).grade is Grade.SOLVED
    result.shutter = RollingShutter(0.5, 0.01, "rows", recorded=True, reprojection_error=1.2)
    assert verdict_of(result).grade is Grade.DOUBTFUL
