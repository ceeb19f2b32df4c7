"""The index of a batch: index.json for programs, and index.html with links to all reports."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from factorsfm.batch.outcome import read_outcome, thumbnail
from factorsfm.batch.plan import Job, Video
from factorsfm.export.writing import complete_file
from factorsfm.report.document import document, packaged
from factorsfm.report.result_folder import check_directory
from factorsfm.result.verdict import Grade
from factorsfm.support.errors import InputError
from factorsfm.support.json_reading import read_json, typed
from factorsfm.support.json_text import json_text
from factorsfm.support.program import PROGRAM, program_version


@dataclass(frozen=True, slots=True)
class Entry:
    """A shot that is done.

    Attributes:
        video, shot: file name, and number of the shot in the video, from 1.
        folder: of the result, relative to the output.
        frames: first frame, and last frame + 1.
        verdict: the result in one sentence, or the reason of the failure.
        parallax: NaN if unknown.
        seconds: computing time.
        thumbnail: a small JPEG, or None.
    """

    video: str
    shot: int
    folder: str
    frames: tuple[int, int]
    reconstructed: bool
    grade: Grade
    verdict: str
    registered: int
    parallax: float
    seconds: float
    thumbnail: bytes | None

    @staticmethod
    def of(job: Job, output: Path) -> Entry:
        """Read the result of a job that is done."""
        outcome = read_outcome(job.folder)
        done = outcome.reconstructed
        return Entry(
            video=job.video.path.name,
            shot=int(job.folder.name.rpartition("_")[2]),
            folder=job.folder.relative_to(output.absolute()).as_posix(),
            frames=(job.frames.start, job.frames.stop),
            reconstructed=done,
            grade=outcome.grade,
            verdict=outcome.verdict if done else outcome.reason.rstrip("."),
            registered=outcome.registered if done else 0,
            parallax=outcome.parallax,
            seconds=outcome.seconds.get("total", math.nan),
            thumbnail=thumbnail(job.folder / "report.html"),
        )


class Index:
    """The two files, written again after every shot.

    Args:
        source, output: of the batch.
        shots: of the videos that could be read; unread: the reasons of the others.
        jobs: in the order of the page.
    """

    def __init__(
        self,
        source: Path,
        output: Path,
        shots: Mapping[Video, Sequence[range]],
        unread: Mapping[Video, str],
        jobs: Sequence[Job],
    ) -> None:
        self._source, self._output = source, output
        self._shots, self._unread, self._jobs = shots, unread, jobs
        self._entries: dict[Path, Entry] = {}

    @property
    def entries(self) -> list[Entry]:
        """The shots that are done."""
        return [self._entries[job.folder] for job in self._jobs if job.folder in self._entries]

    def add(self, job: Job) -> None:
        """Add a job that is done."""
        self._entries[job.folder] = Entry.of(job, self._output)

    def write(self) -> None:
        """Write both files.

        Raises:
            InputError: they cannot be written.
        """
        for name, text in (("index.json", json_text(self._to_dict())), ("index.html", self._html())):
            with complete_file(self._output / name) as file:
                file.write_text(text, encoding="utf-8")

    def _to_dict(self) -> dict[str, Any]:
        return {
            "program": PROGRAM,
            "version": program_version(),
            "source": self._source.absolute(),
            **self._totals(),
            "videos": [
                {**video.to_dict(), "shots": [[frames.start, frames.stop] for frames in found]}
                for video, found in self._shots.items()
            ],
            "unread": [{**video.to_dict(), "reason": reason} for video, reason in self._unread.items()],
            "results": [
                {name: value for name, value in asdict(entry).items() if name != "thumbnail"} for entry in self.entries
            ],
        }

    def _totals(self) -> dict[str, Any]:
        entries = self.entries
        return {
            "shots": len(self._jobs),
            "done": len(entries),
            "reconstructed": sum(entry.reconstructed for entry in entries),
            "frames": sum(entry.frames[1] - entry.frames[0] for entry in entries),
            "registered": sum(entry.registered for entry in entries),
            "seconds": sum(entry.seconds for entry in entries),
        }

    def _html(self) -> str:
        totals = self._totals()
        facts = {
            "Videos": len(self._shots) + len(self._unread),
            "Shots": totals["shots"],
            "Frames": f"{totals['frames']:,}",
            "Frames solved": f"{totals['registered']:,}",
            "Computing": _duration(totals["seconds"]),
        }
        body = Template(packaged("factorsfm.batch", "index.html")).substitute(
            source=escape(str(self._source)),
            verdict=_verdict(totals),
            facts="".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in facts.items()),
            videos="".join(self._video_html(video) for video in (*self._shots, *self._unread)),
        )
        return document(f"{self._source} – {PROGRAM} shots", body, styles=packaged("factorsfm.batch", "index.css"))

    def _video_html(self, video: Video) -> str:
        entries = [entry for entry in self.entries if entry.folder.rpartition("/")[0] == video.name]
        rows = "".join(map(_entry_html, entries))
        reason = f'<p class="unread">{escape(self._unread[video])}.</p>' if video in self._unread else ""
        return f'<section><h2>{escape(video.path.name)}</h2>{reason}<ol class="shots">{rows}</ol></section>'


@dataclass(frozen=True, slots=True)
class _EarlierVideo:
    """A video in index.json, see `Video.to_dict`; each shot is its first frame and its last frame + 1."""

    video: str
    size: int
    modified_ns: int
    fields: str
    shots: list[list[int]]

    def key(self) -> str:
        return json_text(
            {"video": self.video, "size": self.size, "modified_ns": self.modified_ns, "fields": self.fields}
        )


@dataclass(frozen=True, slots=True)
class _Earlier:
    """The part of index.json that a later run reads."""

    program: str
    version: str
    source: str
    videos: list[_EarlierVideo]


def shots_known(output: Path, source: Path) -> dict[str, list[range]]:
    """The shots from an earlier run, by the JSON text of `Video.to_dict`; empty if another version found them.

    Raises:
        InputError: the folder cannot be written, or it holds something else than an earlier run on this source.
    """
    path = output / "index.json"
    if not path.exists():
        check_directory(output)
        return {}
    try:
        earlier = typed(_Earlier, read_json(path, "the index"), "index.json")
        if earlier.program != PROGRAM:
            raise InputError(f"{path} is of {earlier.program}")
        known = {video.key(): [range(first, stop) for first, stop in video.shots] for video in earlier.videos}
    except (InputError, ValueError) as error:
        raise InputError(f"{path} is not that of an earlier batch; choose a new or empty folder") from error
    if earlier.source != str(source.absolute()):
        raise InputError(f"{output} holds the shots of {earlier.source}, not of {source}; choose a new or empty folder")
    return known if earlier.version == program_version() else {}


def _verdict(totals: Mapping[str, Any]) -> str:
    shots, solved, waiting = totals["shots"], totals["reconstructed"], totals["shots"] - totals["done"]
    said = f"All {shots} shots are solved" if solved == shots else f"{solved} of {shots} shots are solved"
    return f"{said}, {waiting} are still to do." if waiting else f"{said}."


def _entry_html(entry: Entry) -> str:
    first, last = entry.frames[0], entry.frames[1] - 1
    picture = '<span class="blank"></span>'
    if entry.thumbnail is not None:
        data = base64.b64encode(entry.thumbnail).decode("ascii")
        picture = f'<img src="data:image/jpeg;base64,{data}" alt="A frame of shot {entry.shot}">'
    facts = {
        "Frames": entry.frames[1] - first,
        "Solved": entry.registered,
        "Parallax": f"{entry.parallax:.3f}" if math.isfinite(entry.parallax) else "–",
        "Computing": _duration(entry.seconds),
    }
    values = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in facts.items())
    return (
        f'<li class="card"><a href="{quote(entry.folder)}/report.html">{picture}<div class="said">'
        f'<h3>Shot {entry.shot} <span>frames {first} to {last}</span></h3><p><span class="grade '
        f'{entry.grade.lower().replace(" ", "-")}">{entry.grade}</span> {escape(_sentence(entry.verdict))}</p></div>'
        f'<dl class="facts">{values}</dl></a></li>'
    )


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, hours = seconds / 60, seconds / 3600
    return f"{minutes:.0f} min" if minutes < 100 else f"{hours:.1f} h"
