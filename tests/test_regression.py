"""Accuracy on two short development shots, with bounds on both sides, so that nothing decays in silence."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.cell import Folders, measure
from benchmarks.plan import FIRST_20, Cell
from benchmarks.scores import pooled_depth, pose_aucs

# AUC in percent: ATE 0.2 and 2 cm, T-RPE 0.1 and 0.5 cm, R-RPE 0.02 and 0.1 degrees.
LOWEST = (84.0, 98.0, 66.0, 92.5, 82.0, 96.0)
HIGHEST = (96.0, 99.8, 82.0, 96.8, 95.0, 99.3)


@pytest.mark.slow
def test_accuracy_of_the_first_frames_is_kept(shared_data: Path, shared_models: Path, tmp_path: Path) -> None:
    folders = Folders(shared_data, shared_models, tmp_path)
    records = [
        measure(Cell(shot, FIRST_20, "default", "tcmonodepth"), folders)
        for shot in ("d03_livingroom_handheld", "d06_keep_static_breath")
    ]
    assert [record.facts["failed"] for record in records] == [None, None]
    assert [record.registered for record in records] == [20, 20]
    aucs = np.array(pose_aucs(records))
    assert (aucs > LOWEST).all(), aucs
    assert (aucs < HIGHEST).all(), aucs
    assert 96.5 < pooled_depth(records)["within 5%"] < 99.9
    assert 12_000 < pooled_depth(records)["points"] < 22_000
