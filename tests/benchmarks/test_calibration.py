"""Covariances of rendered shots beside their errors."""

import pytest

from benchmarks.calibration import row_of
from factorsfm import Options, Stream
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import render_shot


@pytest.mark.parametrize(
    ("motion", "seed", "least", "most"),  # 1.0 and 2.1; exact covariances have 1.95
    [("truck", 0, 0.7, 1.4), ("arc", 1, 1.5, 2.8)],
)
def test_errors_of_a_rendered_shot_are_those_of_its_covariances(motion, seed, least, most):
    shot = render_shot(motion, 24, 480, 270, seed=seed)
    with Stream(shot.camera, options=Options.preset_named("geometry")) as stream:
        for image in shot.images:
            stream.push(image)
        result = stream.finish()
    row = row_of(result, *pose_arrays(shot.cam_from_world), shot.depths[0])
    assert least < float(row["cameras, median"]) < most
    assert row["beyond 5, %"] == "0.0"
    assert 0.4 < float(row["drift / slide, median"]) < 0.7  # 0.5
