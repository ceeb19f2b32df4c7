"""Covariances of a rendered shot beside its errors."""

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
    assert 1.4 < float(row["cameras, median"]) < 3.2  # 2.4; exact covariances have 1.95
    assert row["beyond 5, %"] == "0.0"
    assert 0.4 < float(row["drift / slide, median"]) < 1.4  # 0.8
