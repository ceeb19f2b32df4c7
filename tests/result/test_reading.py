"""A result folder read back, and the command that exports it."""

import json
import math
import shutil
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from factorsfm.cli.main import main
from factorsfm.control.fit import ControlFit, ControlResidual
from factorsfm.export import FORMATS, export
from factorsfm.motion.stretches import Stretch
from factorsfm.polish.observability import CameraObservability
from factorsfm.report.result_folder import write_failure
from factorsfm.result.reading import read_result
from factorsfm.result.reconstruction import LensFit, RollingShutter
from factorsfm.support.errors import InputError
from factorsfm.support.status import ShotKind
from tests.exact_result import build
from tests.export_problems import hard_reconstruction


def test_read_result_gives_back_what_was_written(tmp_path: Path) -> None:
    written = build()
    written.write(tmp_path / "out")
    found = read_result(tmp_path / "out")
    assert found.camera.model_name == "OPENCV"
    np.testing.assert_array_equal(found.camera.params, written.camera.params)
    np.testing.assert_array_equal(found.points, written.points)
    np.testing.assert_array_equal(found.colors, written.colors)
    for a, b in zip(found.frames, written.frames, strict=True):
        assert (a.index, a.name, a.timestamp, a.status, a.message) == (
            b.index,
            b.name,
            b.timestamp,
            b.status,
            b.message,
        )
        assert (a.keyframe, a.observations, a.inliers, a.prior) == (b.keyframe, b.observations, b.inliers, b.prior)
        np.testing.assert_array_equal(a.reprojection_error, b.reprojection_error)
        assert a.registered == b.registered
        if a.registered:
            np.testing.assert_allclose(a.cam_from_world.matrix(), b.cam_from_world.matrix(), atol=1e-15)
    # observations in the frame that is not registered are not kept
    kept = written.observation_frame != 3
    order, expected_order = (
        np.lexsort((r.observation_point[rows], r.observation_frame[rows]))
        for r, rows in ((found, slice(None)), (written, kept))
    )
    for name, tolerance in (("observation_frame", 0), ("observation_point", 0), ("observation_xy", 1e-6)):
        np.testing.assert_allclose(
            getattr(found, name)[order], getattr(written, name)[kept][expected_order], atol=tolerance
        )
    assert found.observation_error.max() < 2e-6  # exact projections
    assert (found.kind, found.parallax, found.metric) == (written.kind, written.parallax, written.metric)
    assert (found.notes, found.seconds["tracking"]) == (written.notes, 1.5)
    assert found.options["source"] == "shot.mp4"


def test_what_is_known_of_lens_shutter_and_poses_comes_back(tmp_path: Path) -> None:
    written = build()
    written.lens = LensFit(True, 0.0123, k1_std=0.001, k2_std=None, cx_std=0.002, zoom_std=0.03)
    written.shutter = RollingShutter(-0.61, 0.02, "columns", recorded=True)
    written.frames[1].observability = CameraObservability(float("nan"), float("nan"), 1.5, 0.25)
    written.frames[2].observability = CameraObservability(0.25, 0.5, 1.75, 0.125)
    written.frames[2].focal_std = 0.004
    written.stretches = (Stretch(0, 1, ShotKind.STATIC), Stretch(2, 3, ShotKind.GENERAL))
    written.control = ControlFit(
        [ControlResidual("ground", "m", 0.01, 0.02, 0.5, contradicts=False)], ["000010"], ["sky"], True, 0.001, math.nan
    )
    written.write(tmp_path / "out")
    found = read_result(tmp_path / "out")
    assert found.stretches == written.stretches
    assert found.lens == written.lens
    assert found.shutter == written.shutter
    assert repr(found.control) == repr(written.control)  # NaN differs from NaN
    assert [repr(frame.observability) for frame in found.frames] == [repr(f.observability) for f in written.frames]
    assert [frame.focal_std for frame in found.frames] == [None, None, 0.004, None, None, None]
    found.write(tmp_path / "again")
    first, second = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("out", "again"))
    differ = {key for key in first if second[key] != first[key]}
    assert differ == {"verdict", "observations", "reprojection_error"}  # of the observations that are not kept


def test_result_read_and_written_again_is_the_same_model(tmp_path: Path) -> None:
    build().write(tmp_path / "a")
    read_result(tmp_path / "a").write(tmp_path / "b")
    for name in ("trajectory.tum", "points.ply", "colmap/cameras.txt", "colmap/images.txt"):
        assert (tmp_path / "a" / name).read_text(errors="replace") == (tmp_path / "b" / name).read_text(
            errors="replace"
        )


def test_read_result_of_a_shot_without_points(tmp_path: Path) -> None:
    build(points=0).write(tmp_path / "out")
    found = read_result(tmp_path / "out")
    assert found.points.shape == found.colors.shape == (0, 3)
    assert found.observation_xy.shape == (0, 2)
    assert len(found.registered) == 5
    needs = {"usd": "pxr", "alembic": "alembic3d"}
    for format in set(FORMATS) - {"undistorted"}:
        if format not in needs or find_spec(needs[format]):
            export(found, tmp_path / f"{format}.usda", format=format)


def test_read_result_refuses_other_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no result of factorsfm reconstruct: there is no summary"):
        read_result(tmp_path)
    with pytest.raises(InputError, match="holds no result"):
        read_result(tmp_path / "missing")
    (tmp_path / "summary.json").write_text("{}")
    with pytest.raises(InputError, match="is not factorsfm's"):
        read_result(tmp_path)
    (tmp_path / "summary.json").write_text("no json")
    with pytest.raises(InputError, match="is not JSON"):
        read_result(tmp_path)
    write_failure(tmp_path / "failed", "too dark")
    with pytest.raises(InputError, match="could not be reconstructed: too dark"):
        read_result(tmp_path / "failed")


# --- damaged results ----------------------------------------------------------------------------------------------

OTHER_VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=3),
    st.just([]), st.just({}), st.just([None]), st.just({"index": "x"}), st.just(10**400),
)  # fmt: skip


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a JSON value, as the keys that lead there."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(place for key, item in items for place in places(item, (*path, key)))]


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result in which everything is there that a summary can hold."""
    result = build()
    result.lens, result.shutter = LensFit(True, 0.01, k1_std=0.001), RollingShutter(0.5, 0.01, "rows", recorded=False)
    result.control = ControlFit([ControlResidual("a", "m", 0.1, 0.1, 1.0, contradicts=False)], [], [], True, 0.1, 0.1)
    result.frames[0].observability = CameraObservability(0.25, 0.5, 1.75, 0.125)
    result.options["added"] = [{"source": None, "first": 18}]
    result.write(tmp_path_factory.mktemp("intact") / "out")
    return tmp_path_factory.getbasetemp() / "intact0" / "out"


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_summary_with_anything_in_any_place_is_read_or_refused(
    intact: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """What is read can be written, exported and shown; all else is one sentence."""
    folder = tmp_path_factory.mktemp("damaged")
    shutil.copytree(intact / "colmap", folder / "result" / "colmap")
    content = json.loads((intact / "summary.json").read_text())
    *path, last = data.draw(st.sampled_from(places(content)[1:]))
    holder = content
    for key in path:
        holder = holder[key]
    if isinstance(holder, dict) and data.draw(st.booleans()):
        del holder[last]
    else:
        holder[last] = data.draw(OTHER_VALUES)
    (folder / "result" / "summary.json").write_text(json.dumps(content))
    with suppress(InputError):
        result = read_result(folder / "result")
        result.write(folder / "again")
        for format in ("nerfstudio", "blender", "kitti", "tum"):
            with suppress(InputError):
                export(result, folder / format, format=format)


@pytest.mark.parametrize("name", ["../../precious.png", "/etc/passwd", "C:/x.png"])
def test_a_name_that_leaves_the_folder_is_not_read(intact: Path, tmp_path: Path, name: str) -> None:
    out = tmp_path / "out"
    shutil.copytree(intact, out)
    summary = json.loads((out / "summary.json").read_text())
    summary["statuses"][3]["name"] = name  # of a frame that is not registered
    (out / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match=f"is damaged: the image name '{name}' leaves the folder of the images"):
        read_result(out)


@pytest.mark.parametrize("damage", ["no model", "missing image", "missing key", "other status"])
def test_damaged_result_is_an_input_error(tmp_path: Path, damage: str) -> None:
    out = tmp_path / "out"
    build().write(out)
    summary = json.loads((out / "summary.json").read_text())
    if damage == "no model":
        shutil.rmtree(out / "colmap")
    elif damage == "missing image":
        summary["statuses"][0]["index"] = 99
    elif damage == "missing key":
        del summary["statuses"]
    else:
        summary["statuses"][0]["status"] = "elsewhere"
    (out / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match="is damaged"):
        read_result(out)


def test_command_exports_with_its_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hard_reconstruction("PINHOLE").write(tmp_path / "result")
    arguments = ["export", str(tmp_path / "result"), "--output", str(tmp_path / "new" / "camera.chan")]
    options = ["--format", "chan", "--first-frame", "1", "--scale", "10", "--up-axis", "z", "--sensor-width", "24"]
    assert main([*arguments, *options]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert captured.out.startswith("Wrote chan (")
    assert "1 of 6 frames are not registered" in captured.out
    rows = np.loadtxt(tmp_path / "new" / "camera.chan")
    assert rows[:, 0].tolist() == [11, 13, 15, 19, 21]
    centers = hard_reconstruction("PINHOLE").camera_centers()
    np.testing.assert_allclose(rows[:, 1:4], 10 * centers[:, [0, 2, 1]] * [1, 1, -1], atol=1e-9)


@pytest.mark.parametrize(
    ("result", "options", "message"),
    [
        ("missing", ["--format", "ply"], "holds no result"),
        ("result", ["--format", "fbx"], "invalid choice: 'fbx'"),
        ("result", ["--format", "ply", "--fps", "-1"], "fps is -1"),
        ("result", ["--format", "nuke", "--footage", "no.mp4"], "the footage no.mp4 does not exist"),
    ],
)
def test_command_complains_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], result: str, options: list[str], message: str
) -> None:
    build().write(tmp_path / "result")
    arguments = ["export", str(tmp_path / result), "--output", str(tmp_path / "out"), *options]
    try:
        status: object = main(arguments)
    except SystemExit as stopped:
        status = stopped.code
    assert status == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert message in captured.err
    assert [path.name for path in tmp_path.iterdir()] == ["result"]
