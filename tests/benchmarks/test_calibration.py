"""Covariances of a rendered shot beside its errors."""

import numpy as np

from benchmarks.calibration import row_of
from factorsfm import Options, Stream
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import render_shot


def test_errors_of_a_rendered_shot_are_those_of_its_covariances():
    shot = render_shot("truck", 24, 480, 270)
    with Stream(shot.camera, options=Options.preset_named("geometry")) as stream:
        for image in shot.images:
            stream.push(image)
        result = stream.finish()
    row = row_of(result, *pose_arrays(shot.cam_from_world), shot.depths[0])
    print(row)
    assert np.isfinite(float(row["cameras, median"]))
