"""Streams that are longer than their horizon."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import factorsfm
from factorsfm import InputError, Reconstruction, Stream
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.streaming.frame_update import FrameUpdate
from factorsfm.streaming.snapshot import read_snapshot, write_snapshot
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import RenderedShot, render_shot

HORIZON, LENGTH = 100, 180


@dataclass(frozen=True)
class Streamed:
    """A camera that moves back and forth."""

    shot: RenderedShot
    order: list[int]  # the frame of the shot that each frame of the stream shows
    observations: list[int]  # that each frame has at the end
    again: FrameUpdate  # after a gap, on the first view once more
    live: list[pycolmap.Rigid3d | None]
    result: Reconstruction


@pytest.fixture(scope="module")
def streamed(tmp_path_factory: pytest.TempPathFactory) -> Streamed:
    shot, folder = render_shot("truck", 40, 320, 180, parallax=0.12), tmp_path_factory.mktemp("horizon")
    there_and_back = [*range(40), *range(38, 0, -1)]
    order = [there_and_back[k % len(there_and_back)] for k in range(LENGTH)]
    tracker = replace(factorsfm.Options().tracker, max_tracks=200)
    with Stream(shot.camera, options=factorsfm.Options(tracker=tracker), horizon=HORIZON) as stream:
        for k in order:
            stream.push(shot.images[k])
        stream.save(folder / "state")
        observations = [len(tracks.ids) for tracks in stream.all_tracks()]
    resumed = Stream.load(folder / "state")
    for _ in range(2):
        resumed.push(np.zeros_like(shot.images[0]))
    again = resumed.push(shot.images[0])
    live = resumed.trajectory()
    return Streamed(shot, order, observations, again, live, resumed.finish())


def test_all_frames_have_a_pose_in_one_world(streamed: Streamed) -> None:
    poses = [frame.cam_from_world for frame in streamed.result.frames[:LENGTH]]
    true = [streamed.shot.cam_from_world[k] for k in streamed.order]
    errors = trajectory_errors(*pose_arrays(poses), *pose_arrays(true))
    assert 0.0 < np.median(errors.ate) < 2e-3  # of a path of 0.5 units
    assert errors.ate.max() < 1e-2
    assert poses[0] is not None
    assert np.allclose(poses[0].matrix(), np.eye(3, 4), atol=1e-12)


def test_the_poses_beyond_it_are_the_live_ones(streamed: Streamed) -> None:
    result = streamed.result
    begin = int(result.observation_frame.min())
    assert LENGTH - HORIZON - 10 < begin < LENGTH - HORIZON + 10
    ratios = []
    for frame, live in zip(result.frames[1:begin], streamed.live[1:begin], strict=True):
        assert frame.cam_from_world is not None
        assert live is not None
        assert frame.covariance is not None
        assert frame.message.startswith("beyond the horizon")
        assert np.allclose(frame.cam_from_world.rotation.matrix(), live.rotation.matrix(), atol=1e-9)
        ratios.append(np.linalg.norm(frame.cam_from_world.translation) / np.linalg.norm(live.translation))
    assert np.ptp(ratios) < 1e-9  # one unit of length
    assert sum("longer than its horizon of 100 frames" in note for note in result.notes) == 1


def test_the_covariance_goes_on_from_that_of_the_live_pose(streamed: Streamed) -> None:
    frames = streamed.result.frames
    begin = int(streamed.result.observation_frame.min())
    before, after = (frames[k].covariance for k in (begin - 1, begin))
    assert before is not None
    assert after is not None
    assert 0.3 < np.trace(after[3:, 3:]) / np.trace(before[3:, 3:]) < 3.0


def test_beyond_it_only_views_that_show_something_new_keep_their_observations(streamed: Streamed) -> None:
    begin = int(streamed.result.observation_frame.min())
    kept = [k for k, count in enumerate(streamed.observations[: begin - 1]) if count]
    assert kept[0] == 0
    assert 1 <= len(kept) <= 32  # the keyframes on which the graph works stay, too
    assert min(streamed.observations[begin:]) > 100


def test_a_view_from_beyond_it_is_found_again(streamed: Streamed) -> None:
    pose = streamed.again.cam_from_world
    assert pose is not None
    assert np.linalg.norm(pose.translation) < 5e-3  # the first view, where the world begins


def test_what_is_about_all_frames_keeps_all_of_them() -> None:
    places = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
    poses = [factorsfm.KnownPose(k, position=place, sigma=0.1) for k, place in enumerate(places)]
    with Stream(control=factorsfm.Control(poses=poses)) as stream:
        assert stream._horizon.frames is None
    with pytest.raises(InputError, match="a horizon of 20 frames is too near; at least 100 are needed"):
        Stream(horizon=20)


def test_a_snapshot_keeps_arrays_exactly(tmp_path: Path) -> None:
    arrays = [np.array([0.1, np.nan, 1e300]), np.array([0.5, np.nan]), np.array([2**40, 1]), np.array([2**31, -1])]
    write_snapshot(tmp_path / "state", {"arrays": arrays})
    for array, read in zip(arrays, read_snapshot(tmp_path / "state")["arrays"], strict=True):
        assert read.dtype == array.dtype
        np.testing.assert_array_equal(read, array)


def test_a_stream_goes_on_after_a_frame_that_repeats_another(tmp_path: Path) -> None:
    shot = render_shot("truck", 10, 160, 96)
    with Stream(shot.camera) as stream:
        for index, k in enumerate([*range(9), 8]):
            stream.push(factorsfm.Frame(index, shot.images[k], f"{index}"))
        stream.save(tmp_path / "state")
    with Stream.load(tmp_path / "state") as stream:
        assert len(stream.frames) == 9
        assert stream.newest.index == 9
        stream.push(factorsfm.Frame(10, shot.images[9], "10"))
        assert stream.newest.index == 10
