"""What an earlier batch has left, damaged: a shot is done again, a folder is refused, and nothing else happens."""

import json
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from factorsfm.batch.index import Entry, Index, shots_known
from factorsfm.batch.outcome import Outcome
from factorsfm.batch.plan import Job, Method, Video
from factorsfm.report.result_folder import write_folder
from factorsfm.support.errors import InputError
from tests.exact_result import build

OTHER_VALUES = [None, True, -1, 0.5, "x", [], {}, [[1]], [[5, 2, 0]], {"x": 1}, 10**400]


@pytest.fixture
def job(tmp_path: Path) -> Job:
    """A job that is done."""
    job = Job(Video(tmp_path / "a.mp4", "a", 1, 2), range(6), Method(), tmp_path / "out" / "a" / "shot_001")
    result = build()
    result.options["job"] = job.to_dict()
    write_folder(result, job.folder)
    return job


@pytest.mark.parametrize("value", OTHER_VALUES, ids=str)
def test_a_shot_with_a_damaged_summary_is_done_again_or_shown(tmp_path: Path, job: Job, value: Any) -> None:
    path = job.folder / "summary.json"
    whole = json.loads(path.read_text())
    for key in whole:
        path.write_text(json.dumps({**whole, key: value}))
        if job.is_done():
            Entry.of(job, tmp_path / "out")
        else:
            assert key in {field.name for field in fields(Outcome)}
    for text in ("", "{", "[]", "null", '"x"', "[" * 100_000):
        path.write_text(text)
        assert not job.is_done()


def test_a_damaged_report_costs_its_picture(tmp_path: Path, job: Job) -> None:
    for text in ("", '<script type="application/json" id="data">{"thumbnail": ["%"]}</script>', "\udcff"):
        (job.folder / "report.html").write_bytes(text.encode(errors="surrogateescape"))
        assert job.is_done()
        assert Entry.of(job, tmp_path / "out").thumbnail is None


def test_a_damaged_index_is_refused(tmp_path: Path, job: Job) -> None:
    output, source = tmp_path / "out", tmp_path / "a.mp4"
    index = Index(source, output, {job.video: [job.frames]}, {}, [job])
    index.add(job)
    index.write()
    assert {path.name for path in output.iterdir()} == {"a", "index.html", "index.json"}
    assert list(shots_known(output, source).values()) == [[range(6)]]
    path = output / "index.json"
    whole = json.loads(path.read_text())
    (video,) = whole["videos"]
    damaged = [{**whole, key: value} for key in ("program", "source", "version", "videos") for value in OTHER_VALUES]
    damaged += [{**whole, "videos": [{**video, key: value}]} for key in video for value in OTHER_VALUES]
    damaged += [{**whole, "videos": [value]} for value in OTHER_VALUES]
    for content in damaged:
        path.write_text(json.dumps(content))
        with suppress(InputError):
            assert len(shots_known(output, source)) < 2
    for text in ("", "{", "null", "[" * 100_000):
        path.write_text(text)
        with pytest.raises(InputError, match="is not that of an earlier batch"):
            shots_known(output, source)
