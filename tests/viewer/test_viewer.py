"""What a stream shows: recorded for the viewer, and read back."""

import os
import sys

import numpy as np
import pytest

from factorsfm import Frame, InputError, Options, Stream
from factorsfm.viewer.viewer import RerunViewer, Viewer, open_viewer
from tests.rendered import FRAMES, Maps, rendered, simulated_maps, with_fewer_tracks

rerun = pytest.importorskip("rerun")
EVERY_FRAME = {
    "/status", "/world/camera", "/world/camera/image/tracks", "/world/path", "/plots/tracks", "/plots/inliers",
    "/plots/parallax", "/plots/share/prior", "/plots/share/parallax",
}  # fmt: skip


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Columns by entity and component, all rows in the order of the frames."""
    from rerun.chunk import RrdReader

    path = tmp_path_factory.mktemp("recording") / "shot.rrd"
    shot = rendered("dolly")
    updates = []
    with open_viewer(record=path) as viewer:
        depth = viewer.watch(Maps(simulated_maps("dolly")))
        stream = Stream(shot.camera, depth=depth, options=with_fewer_tracks(Options()))
        for k, image in enumerate(shot.images):
            frame = Frame(k, image, f"{k:06d}", k / 24)
            updates.append(stream.push(frame))
            viewer.log(frame, updates[-1], stream)
        result = stream.finish()
        viewer.log_result(result)
    rows: dict[str, list[dict]] = {}
    for chunk in RrdReader(path).stream():
        rows.setdefault(chunk.entity_path, []).extend(chunk.to_record_batch().to_pylist())
    return rows, updates, result


def series(rows: dict[str, list[dict]], entity: str, component: str) -> dict[int, list]:
    found = [(row["frame"], row[component]) for row in rows[entity] if row.get(component) is not None]
    return {int(frame): value for frame, value in sorted(found, key=lambda pair: pair[0])}


def test_every_frame_is_there(recorded):
    rows, _, _ = recorded
    for entity in EVERY_FRAME:
        assert sorted({int(row["frame"]) for row in rows[entity]}) == list(range(FRAMES)), entity
    assert {"/world/points", "/world/polished/path", "/world/polished/points"} <= rows.keys()
    assert 1 <= len(rows["/prior"]) <= FRAMES


def test_the_numbers_are_those_of_the_updates(recorded):
    rows, updates, result = recorded
    inliers = series(rows, "/plots/inliers", "Scalars:scalars")
    assert [value[0] for value in inliers.values()] == [update.inliers for update in updates]
    scale = series(rows, "/plots/prior/scale", "Scalars:scalars")
    assert [v[0] for v in scale.values()] == [update.prior.scale for update in updates if update.prior]
    share = series(rows, "/plots/share/prior", "Scalars:scalars")
    np.testing.assert_allclose([v[0] for v in share.values()], [f.observability.prior_share for f in result.frames])
    place = series(rows, "/world/camera", "Transform3D:translation")
    centers = [update.cam_from_world.inverse().translation for update in updates]
    np.testing.assert_allclose([value[0] for value in place.values()], centers, rtol=0.0, atol=1e-8)
    points = series(rows, "/world/polished/points", "Points3D:positions")
    np.testing.assert_allclose(points[FRAMES - 1], result.points, rtol=0.0, atol=1e-6)


def test_nothing_is_shown_unless_asked_for():
    viewer = open_viewer()
    assert type(viewer) is Viewer
    depth = Maps([None])
    assert viewer.watch(depth) is depth
    with viewer:
        viewer.log(None, None, None)
        viewer.log_result(None)


def test_without_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"pip install 'factorsfm\[viewer\]'"):
        open_viewer(record=tmp_path / "shot.rrd")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(InputError, match=r"recording .* cannot be written: No such file or directory"):
        open_viewer(record=tmp_path / "absent" / "shot.rrd")
    os.mkfifo(tmp_path / "pipe")  # to open it would wait for somebody who reads
    with pytest.raises(InputError, match=r"recording .* cannot be written: it is a pipe, and a file is expected"):
        open_viewer(record=tmp_path / "pipe")


def test_a_prior_without_any_value_is_shown_dark(tmp_path):
    frame = Frame(0, np.zeros((18, 32, 3), np.uint8), "0")
    viewer = open_viewer(record=tmp_path / "shot.rrd")
    assert isinstance(viewer, RerunViewer)
    with viewer:
        assert viewer.watch(None) is None
        assert viewer.watch(Maps([None]))(frame) is None
        assert np.isnan(viewer.watch(Maps([np.zeros((9, 16), np.float32)]))(frame).values).all()
    assert (tmp_path / "shot.rrd").stat().st_size > 0
