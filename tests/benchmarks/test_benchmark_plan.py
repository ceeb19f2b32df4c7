"""Which cells are measured on which data."""

import pytest

from benchmarks import run
from benchmarks.plan import COLMAP, EXPERIMENTS, OTHERS, planned


def test_sets_that_are_not_there_are_left_out() -> None:
    plan = planned({"d03_livingroom_handheld"}, quick=False)
    assert {cell.shot for cells in plan.values() for cell in cells} == {"d03_livingroom_handheld"}
    assert len(plan["pose"]) == len(EXPERIMENTS["pose"]) / 8
    assert plan[OTHERS] == plan["real"] == []


def test_sets_of_ones_own_are_measured_beside_colmap() -> None:
    plan = planned({"clip_a", "clip_b", "kitchen-000"}, quick=False)
    assert {cell.shot for cell in plan[OTHERS]} == {"clip_a", "clip_b"}
    assert {cell.method for cell in plan[OTHERS]} == {"default", "paper", "geometry", *COLMAP}


def test_the_quick_slice_is_small() -> None:
    everything = {cell.shot for cells in EXPERIMENTS.values() for cell in cells}
    cells = [cell for cells in planned(everything, quick=True).values() for cell in cells]
    assert 20 < len(set(cells)) < 35
    assert {cell.shot for cell in planned({*everything, "mine"}, quick=True)["pose"]} < everything


def test_what_is_wanted(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    words = ["run", "--data", str(tmp_path), "--shots", "d03", "--priors", "simulated", "--experiments", "pose"]
    monkeypatch.setattr("sys.argv", words)
    arguments = run._arguments()
    chosen = [cell for cell in EXPERIMENTS["pose"] if run._wanted(cell, arguments)]
    assert {cell.shot for cell in chosen} == {"d03_livingroom_handheld"}
    assert {cell.prior for cell in chosen} == {"simulated", "none"}


def test_data_without_any_set(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setattr("sys.argv", ["run", "--data", str(tmp_path), "--output", str(tmp_path / "out")])
    with pytest.raises(SystemExit, match="nothing to measure: of the 0 sets"):
        run.main()
    assert not (tmp_path / "out").exists()
