"""Snapshots: a resumed stream goes on as if nothing had happened, and a file that is none does no harm."""

import hashlib
import json
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorsfm import FrameStatus, FrameUpdate, InputError, Options, Reconstruction, Stream
from factorsfm.streaming.snapshot import read_snapshot, write_snapshot
from factorsfm.synthetic import RenderedShot, render_shot, simulate_prior
from tests.rendered import Maps, with_fewer_tracks

FRAMES = 14
FOREIGN = range(9, 12)  # frames of another room: the view is lost and found again
MAGIC = b"factorsfm-3\n"


@cache
def shot() -> RenderedShot:
    found, other = render_shot("handheld", FRAMES, 320, 180), render_shot("truck", len(FOREIGN), 320, 180, seed=5)
    for k, image in zip(FOREIGN, other.images, strict=True):
        found.images[k] = image
    return found


def prior() -> Maps:
    return Maps([None if k == 6 else values for k, values in enumerate(simulate_prior(shot()))])


def pushed(stream: Stream, frames: range) -> list[FrameUpdate]:
    return [stream.push(shot().images[k]) for k in frames]


def new_stream() -> Stream:
    return Stream(shot().camera, depth=prior(), options=with_fewer_tracks(Options()))


@pytest.fixture(scope="module")
def whole() -> tuple[list[FrameUpdate], Reconstruction]:
    stream = new_stream()
    return pushed(stream, range(FRAMES)), stream.finish()


def pose(update: Any) -> np.ndarray:
    return np.full((3, 4), np.nan) if update.cam_from_world is None else update.cam_from_world.matrix()


def covariance(update: Any) -> np.ndarray:
    return np.full((6, 6), np.nan) if update.covariance is None else update.covariance


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5, 8, 10, 13, FRAMES])
def test_resumed_it_is_as_if_it_had_never_ended(tmp_path, whole, count):
    updates, result = whole
    stream = new_stream()
    pushed(stream, range(count))
    stream.save(tmp_path / "state")
    stream.close()
    again = Stream.load(tmp_path / "state", depth=prior())
    assert len(again.frames) == count
    for update, expected in zip(pushed(again, range(count, FRAMES)), updates[count:], strict=True):
        assert (update.index, update.status, update.message) == (expected.index, expected.status, expected.message)
        assert (update.keyframe, update.tracks, update.new_points) == (
            expected.keyframe, expected.tracks, expected.new_points,
        )  # fmt: skip
        np.testing.assert_allclose(pose(update), pose(expected), atol=1e-8)  # the graph is another one
        np.testing.assert_allclose(update.parallax, expected.parallax, atol=1e-8)
        np.testing.assert_allclose(covariance(update), covariance(expected), rtol=1e-6, atol=1e-12)
    resumed = again.finish()
    assert resumed.notes == result.notes
    np.testing.assert_array_equal(resumed.track_ids, result.track_ids)
    np.testing.assert_array_equal(resumed.colors, result.colors)
    np.testing.assert_allclose(resumed.points, result.points, rtol=0.0, atol=1e-7)  # as exact as the solver
    for frame, expected_frame in zip(resumed.frames, result.frames, strict=True):
        np.testing.assert_allclose(pose(frame), pose(expected_frame), atol=1e-8)
        assert (frame.status, frame.name) == (expected_frame.status, expected_frame.name)


def test_the_cases_above_hold_what_is_difficult(whole):
    updates, _ = whole
    assert {updates[k].status for k in FOREIGN} == {FrameStatus.LOST}
    assert updates[-1].status is FrameStatus.REGISTERED
    stream, pending = new_stream(), []
    for k in range(FRAMES):
        pushed(stream, range(k, k + 1))
        pending.append(stream._mapper._updates.pending)
    assert {True, False} == {pending[k - 1] for k in (1, 2, 3, 5, 8, 10, 13)}  # the graph is at work, and is not


def test_saving_changes_nothing(tmp_path, whole):
    updates, _ = whole
    stream = new_stream()
    for k, expected in enumerate(updates):
        (update,) = pushed(stream, range(k, k + 1))
        stream.save(tmp_path / "state")
        np.testing.assert_allclose(pose(update), pose(expected), atol=1e-8)
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


def test_an_unknown_lens_is_still_unknown(tmp_path):
    results = []
    for count in (None, 6):
        stream = Stream(None, depth=prior(), options=replace(with_fewer_tracks(Options()), shutter="global"))
        for k in range(FOREIGN.start):
            if k == count:
                stream.save(tmp_path / "state")
                stream = Stream.load(tmp_path / "state", depth=prior())
            stream.push(shot().images[k])
        results.append(stream.finish())
    focal = [result.camera.mean_focal_length() for result in results]
    np.testing.assert_allclose(focal[1], focal[0], rtol=1e-10)
    assert results[0].notes == results[1].notes


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("snapshot") / "state"
    stream = new_stream()
    pushed(stream, range(4))
    stream.save(path)
    return path.read_bytes()


def sealed(content: Any, data: bytes = b"") -> bytes:
    """A file whose checksum is right, whatever it holds."""
    header = content if isinstance(content, bytes) else json.dumps(content).encode()
    body = MAGIC + len(header).to_bytes(8, "little") + header + data
    return body + hashlib.sha256(body).digest()


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.9, 0.99999])
def test_a_truncated_file_is_recognised(tmp_path, good, share):
    path = tmp_path / "state"
    path.write_bytes(good[: int(share * len(good))])
    with pytest.raises(InputError, match=r"is torn|not a snapshot"):
        Stream.load(path)


def test_a_torn_file_is_recognised(tmp_path, good):
    path = tmp_path / "state"
    for position in np.linspace(len(MAGIC), len(good) - 1, 40).astype(int):
        path.write_bytes(good[:position] + bytes([good[position] ^ 1]) + good[position + 1 :])
        with pytest.raises(InputError, match="is torn: its checksum is wrong"):
            Stream.load(path)


class Malicious:
    def __reduce__(self):
        return os.mkdir, ("executed",)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "not a snapshot"),
        (b"PK\x03\x04 a zip", "not a snapshot"),
        (pickle.dumps(Malicious()), "not a snapshot"),
        (MAGIC + pickle.dumps(Malicious()), "is torn"),
        (sealed(pickle.dumps(Malicious())), "does not hold"),
        (sealed({"array": "object", "shape": [1]}, pickle.dumps(Malicious())), "arrays of object are not expected"),
        (sealed({"array": "V8", "shape": [1]}, bytes(8)), "arrays of V8"),
        (sealed({"array": "float64", "shape": [10**15]}), "does not hold"),
        (sealed({"array": "float64", "shape": [2**40, 2**40]}), "does not hold"),
        (sealed({"array": "float64", "shape": [10**30]}), "does not hold"),
        (sealed({"array": "float64", "shape": [-1]}, bytes(8)), "does not hold"),
        (sealed({"array": "float64", "shape": "10"}), "does not hold"),
        (sealed({"array": "float64", "shape": [1.5]}, bytes(16)), "does not hold"),
        (sealed({"type": "Malicious", "fields": {}}), "does not hold"),
        (sealed({"type": "os.system", "value": "mkdir executed"}), "does not hold"),
        (sealed({"type": "FrameStatus", "value": "glad"}), "does not hold"),
        (sealed({"type": "KeyframeView", "fields": {"ids": 1, "command": 2}}), "does not hold"),
        (sealed({"type": "KeyframeView", "fields": []}), "does not hold"),
        (sealed({"type": ["KeyframeView"], "fields": {}}), "does not hold"),
        (sealed({"dict": [[{"list": []}, 1]]}), "does not hold"),
        (sealed({"dict": [1, 2]}), "does not hold"),
        (sealed({}), "does not hold"),
        (sealed([1, 2]), "does not hold"),
        (sealed({"dict": []}), "does not hold"),
        (sealed(b"[" * 100_000 + b"]" * 100_000), "does not hold"),
        (sealed(b'{"list": ' * 3000 + b"1" + b"}" * 3000), "does not hold"),
        (MAGIC + (2**63).to_bytes(8, "little") + bytes(64), "is torn"),
    ],
)
def test_whatever_is_no_snapshot_is_refused_and_runs_nothing(tmp_path, monkeypatch, content, reason):
    monkeypatch.chdir(tmp_path)
    Path("state").write_bytes(content)
    with pytest.raises(InputError, match=reason):
        Stream.load("state")
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


def test_a_snapshot_of_another_version_is_refused_as_such(tmp_path, good):
    path = tmp_path / "state"
    path.write_bytes(good.replace(MAGIC, b"factorsfm-2\n", 1))
    with pytest.raises(InputError, match="of another version of factorsfm"):
        Stream.load(path)
    path.write_bytes(good)
    Stream.load(path, depth=prior()).close()


def test_parts_that_are_missing_or_foreign_are_refused(tmp_path, good):
    path = tmp_path / "state"
    path.write_bytes(good)
    state = read_snapshot(path)
    for name in state:
        write_snapshot(path, {key: value for key, value in state.items() if key != name})
        with pytest.raises(InputError, match="does not hold the state of a stream"):
            Stream.load(path)
    for name in ("camera", "options", "frames", "tracker", "mapper"):
        write_snapshot(path, {**state, name: {"command": "mkdir executed"}})
        with pytest.raises(InputError):
            Stream.load(path)


def test_files_that_cannot_be_read_or_written(tmp_path):
    with pytest.raises(InputError, match="cannot be read: No such file"):
        Stream.load(tmp_path / "absent")
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        Stream.load(tmp_path)
    with pytest.raises(InputError, match="cannot be written: No such file"):
        new_stream().save(tmp_path / "absent" / "state")
    with pytest.raises(TypeError, match="a set cannot be part of a snapshot"):
        write_snapshot(tmp_path / "state", {"a": {1, 2}})
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_no_snapshot_is_not_replaced(tmp_path):
    (tmp_path / "shot.mp4").write_bytes(b"footage")
    with pytest.raises(InputError, match="would overwrite a file that is no snapshot"):
        write_snapshot(tmp_path / "shot.mp4", {})
    assert (tmp_path / "shot.mp4").read_bytes() == b"footage"
    (tmp_path / "older").write_bytes(b"factorsfm-1\n...")
    (tmp_path / "empty").touch()
    for name in ("older", "empty", "new"):
        write_snapshot(tmp_path / name, {"a": 1})
        assert read_snapshot(tmp_path / name) == {"a": 1}


def test_a_snapshot_replaces_files_alone(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="pipe cannot be written: it is a pipe, and a file is expected"):
        write_snapshot(tmp_path / "pipe", {})
    assert (tmp_path / "pipe").is_fifo()
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "state").touch()
    (tmp_path / "link").symlink_to("folder/state")
    write_snapshot(tmp_path / "link", {"a": 1})
    assert read_snapshot(tmp_path / "folder" / "state") == {"a": 1}
    assert (tmp_path / "link").is_symlink()
    assert len([*tmp_path.rglob("*")]) == 4


def test_values_survive(tmp_path):
    state = {
        "none": None, "number": 1, "real": 0.1, "nan": float("nan"), "text": "Größe", "truth": True,
        "pair": (1, (2.0, "x")), "list": [[], ()], "by number": {3: (1.0, 2.0)}, "status": FrameStatus.LOST,
        "empty": np.zeros((0, 3)), "scalar": np.float64(2.5), "grid": np.arange(6, dtype=np.uint8).reshape(2, 3).T,
    }  # fmt: skip
    write_snapshot(tmp_path / "state", state)
    again = read_snapshot(tmp_path / "state")
    assert again.keys() == state.keys()
    for name, value in state.items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(again[name], value)
            assert again[name].dtype == value.dtype
            assert again[name].flags.writeable
        elif name == "nan":
            assert np.isnan(again[name])
        else:
            assert again[name] == value
            assert type(again[name]) is (float if name == "scalar" else type(value))


_WRITER = """
import sys
import numpy as np
from factorsfm.streaming.snapshot import write_snapshot
from pathlib import Path

for count in range(10**9):
    write_snapshot(Path(sys.argv[1]), {"count": count, "data": np.full(300_000, count)})
    print(count, flush=True)
"""


@pytest.mark.parametrize("kill", range(4))
def test_killed_while_it_writes_the_last_whole_file_stays(tmp_path, kill):
    path = tmp_path / "state"
    with subprocess.Popen([sys.executable, "-c", _WRITER, str(path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        written = [int(process.stdout.readline()) for _ in range(3 + kill)]
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.003 * kill)
        process.send_signal(signal.SIGKILL)
        written += [int(line) for line in process.stdout]
    state = read_snapshot(path)
    assert state["count"] >= written[-1]
    np.testing.assert_array_equal(state["data"], state["count"])
