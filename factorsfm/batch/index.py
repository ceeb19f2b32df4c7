"""What has become of all shots: index.json, and index.html as the page to begin with."""

from __future__ import annotations

import base64
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np

from factorsfm.batch.plan import Job, Video
from factorsfm.report.document import document, packaged
from factorsfm.report.result_folder import check_directory
from factorsfm.report.wording import grade_of
from factorsfm.support.errors import InputError
from factorsfm.support.json_text import json_text
from factorsfm.support.program import PROGRAM, program_version

_THUMBNAIL_WIDTH = 240
_QUALITY = 70  # of JPEG
_DATA = re.compile(r'<script type="application/json" id="data">(.*?)</script>', re.DOTALL)


@dataclass(frozen=True, slots=True)
class Entry:
    """A shot that is done.

    Attributes:
        video, shot: file name, and number in the video from 1.
        folder: of the result, below the output.
        frames: first frame, and the one after the last.
        verdict: what has been recovered, or why nothing.
        parallax: NaN where there is none.
        seconds: of computing.
        thumbnail: a small JPEG, if there is a picture.
    """

    video: str
    shot: int
    folder: str
    frames: tuple[int, int]
    reconstructed: bool
    grade: str
    verdict: str
    registered: int
    parallax: float
    seconds: float
    thumbnail: bytes | None

    @staticmethod
    def of(job: Job, output: Path) -> Entry:
        """Read the result of a job that is done."""
        summary = json.loads((job.folder / "summary.json").read_text(encoding="utf-8"))
        done = summary["reconstructed"]
        error = _number(summary.get("reprojection_error"))
        return Entry(
            video=job.video.path.name,
            shot=int(job.folder.name.rpartition("_")[2]),
            folder=job.folder.relative_to(output.absolute()).as_posix(),
            frames=(job.frames.start, job.frames.stop),
            reconstructed=done,
            grade=grade_of(summary["registered"], summary["frames"], error) if done else "Not solved",
            verdict=summary["verdict"] if done else summary["reason"].rstrip("."),
            registered=summary["registered"] if done else 0,
            parallax=_number(summary.get("parallax")),
            seconds=summary["seconds"]["total"],
            thumbnail=_thumbnail(job.folder / "report.html"),
        )


class Index:
    """The two files, written anew whenever a shot is done.

    Args:
        source, output: of the whole.
        shots: of all videos that could be read; unread: of the others, why not.
        jobs: all of them, in the order of the page.
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
        """Take a job that is done."""
        self._entries[job.folder] = Entry.of(job, self._output)

    def write(self) -> None:
        """Write both files.

        Raises:
            InputError: they cannot be written.
        """
        for name, text in (("index.json", json_text(self._to_dict())), ("index.html", self._html())):
            try:
                self._output.mkdir(parents=True, exist_ok=True)
                (self._output / f".{name}").write_text(text, encoding="utf-8")
                (self._output / f".{name}").replace(self._output / name)
            except OSError as error:
                raise InputError(f"cannot write {self._output / name}: {error.strerror or error}") from error

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


def shots_known(output: Path, source: Path) -> dict[str, list[range]]:
    """Shots that an earlier run has found, by the JSON text of `Video.to_dict`; empty if another version did.

    Raises:
        InputError: the folder cannot be written, or holds something else than an earlier run on this source.
    """
    path = output / "index.json"
    if not path.exists():
        check_directory(output)
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["program"] != PROGRAM:
            raise ValueError(content["program"])
        if (earlier := content["source"]) != str(source.absolute()):
            raise InputError(f"{output} holds the shots of {earlier}, not of {source}; choose a new or empty folder")
        if content["version"] != program_version():
            return {}
        found = [([range(*pair) for pair in video.pop("shots")], video) for video in content["videos"]]
        return {json_text(video): shots for shots, video in found}
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path} is not that of an earlier batch; choose a new or empty folder") from error


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


def _number(value: float | None) -> float:
    """JSON has no NaN."""
    return math.nan if value is None else value


def _thumbnail(report: Path) -> bytes | None:
    """The picture in the middle of a report, smaller."""
    match = _DATA.search(report.read_text(encoding="utf-8"))
    pictures = [text for text in json.loads(match[1])["thumbnail"] if text] if match else []
    if not pictures:
        return None
    image = cv2.imdecode(np.frombuffer(base64.b64decode(pictures[len(pictures) // 2]), np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return None
    height, width = image.shape[:2]
    size = (_THUMBNAIL_WIDTH, max(1, round(height * _THUMBNAIL_WIDTH / width)))
    _, jpeg = cv2.imencode(
        ".jpg", cv2.resize(image, size, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    )
    return jpeg.tobytes()
