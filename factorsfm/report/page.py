"""The report: one HTML file that opens anywhere, offline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby
from platform import python_version
from string import Template
from typing import Any

from factorsfm.report.data import frames_data, reconstruction_data
from factorsfm.report.document import document, packaged, script_text
from factorsfm.report.wording import (
    explanation,
    failure_sentence,
    status_words,
    verdict_sentence,
)
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.result.summary import focal_range, with_total
from factorsfm.result.verdict import Grade, verdict_of
from factorsfm.support.program import PROGRAM, program_version

_SCRIPTS = ("base.js", "view.js", "footage.js", "align.js", "tracks.js", "charts.js", "page.js")
_LIBRARIES = ("gtsam", "pycolmap", "opencv-python-headless", "onnxruntime", "numpy")


def report_html(reconstruction: Reconstruction, *, can_be_mended: bool = False) -> str:
    """The report as one HTML document that contains all styles, scripts and data.

    Args:
        can_be_mended: whether the shot can be solved again from the folder in which the page lies.
    """
    return _document(
        grade=verdict_of(reconstruction).grade,
        verdict=verdict_sentence(reconstruction),
        explanation=" ".join(explanation(reconstruction)),
        notes=reconstruction.notes,
        facts=_facts(reconstruction),
        frames=reconstruction.frames,
        seconds=reconstruction.seconds,
        options=reconstruction.options,
        data={**reconstruction_data(reconstruction), "canBeMended": can_be_mended},
    )


def failure_html(
    reason: str, frames: Sequence[FrameResult], options: Mapping[str, Any], seconds: Mapping[str, float]
) -> str:
    """The report of a shot that could not be reconstructed: the reason, and the status of each frame."""
    return _document(
        grade=Grade.NOT_SOLVED,
        verdict="The camera of this shot could not be solved.",
        explanation=f"{failure_sentence(frames)} {reason[:1].upper()}{reason[1:].rstrip('.')}.",
        notes=[],
        facts={"Frames": len(frames)},
        frames=frames,
        seconds=seconds,
        options=options,
        data=frames_data(frames),
    )


def _document(
    *,
    grade: Grade,
    verdict: str,
    explanation: str,
    notes: Sequence[str],
    facts: Mapping[str, Any],
    frames: Sequence[FrameResult],
    seconds: Mapping[str, float],
    options: Mapping[str, Any],
    data: Mapping[str, Any],
) -> str:
    source = options.get("source")
    body = Template(packaged("factorsfm.report", "page.html")).substitute(
        source=escape(str(source)) if source else "Reconstruction",
        grade=escape(grade),
        mark=grade.lower().replace(" ", "-"),
        verdict=escape(verdict),
        explanation=escape(explanation),
        notes="".join(f"<li>{escape(note)}</li>" for note in notes),
        facts="".join(f"<div><dt>{key}</dt><dd>{escape(str(value))}</dd></div>" for key, value in facts.items()),
        align=packaged("factorsfm.report", "align.html"),
        statuses=_statuses(frames),
        timings=_table({stage: f"{value:.2f} s" for stage, value in with_total(seconds).items()}),
        versions=_table(_versions()),
        options=_table(_flat(options)),
        data=script_text(data),
        script="".join(packaged("factorsfm.report", name) for name in _SCRIPTS),
    )
    title = f"{source} – {PROGRAM} report" if source else f"{PROGRAM} report"
    return document(title, body, styles=packaged("factorsfm.report", "align.css"), scripted=True)


def _facts(reconstruction: Reconstruction) -> dict[str, Any]:
    camera, focals = reconstruction.camera, focal_range(reconstruction)
    return {
        "Frames solved": f"{len(reconstruction.registered)} / {len(reconstruction.frames)}",
        "Keyframes": sum(frame.keyframe for frame in reconstruction.frames),
        "Points": f"{len(reconstruction.points):,}",
        "Observations": f"{len(reconstruction.observation_point):,}",
        "Parallax": f"{reconstruction.parallax:.3f}",
        "Motion": _motion(reconstruction),
        "Scale": "metres" if reconstruction.metric else "free",
        "Focal length": f"{focals[0]:.1f} to {focals[1]:.1f} px" if focals else f"{camera.mean_focal_length():.1f} px",
        "Lens": f"{camera.model_name} {camera.width}×{camera.height}",
        **_moving_facts(reconstruction),
        **_object_facts(reconstruction),
    }


def _moving_facts(reconstruction: Reconstruction) -> dict[str, Any]:
    """A line on what moves by itself, where something does."""
    moving = reconstruction.moving
    return (
        {"Moves by itself": f"up to {100 * max(s.image for s in moving.stretches):.0f} % of the image"}
        if moving
        else {}
    )


def _motion(reconstruction: Reconstruction) -> str:
    """The kind of motion, and that of each stretch where they differ."""
    stretches = reconstruction.stretches
    if len(stretches) < 2:
        return reconstruction.kind
    return ", ".join(f"{s.kind} ({s.first}–{s.last})" for s in stretches)


def _object_facts(reconstruction: Reconstruction) -> dict[str, Any]:
    """A line on the things that move by themselves, where there are some."""
    names = [f"{found.name} ({len(found.frames)} frames)" for found in reconstruction.objects]
    return {"Objects": ", ".join(names)} if names else {}


def _statuses(frames: Sequence[FrameResult]) -> str:
    missing = [frame for frame in frames if not frame.registered]
    if not missing:
        return "<p>Every frame is solved.</p>" if frames else "<p>No frame was read.</p>"
    alike = [list(group) for _, group in groupby(missing, lambda frame: (frame.status, frame.message))]
    rows = "".join(
        f"<tr><td>{_span(str(group[0].index), str(group[-1].index))}</td>"
        f"<td>{escape(_span(group[0].name, group[-1].name))}</td>"
        f"<td>{status_words(group[0].status)}</td><td>{escape(group[0].message)}</td></tr>"
        for group in alike
    )
    return (
        '<div class="scroll tall" tabindex="0" role="region" aria-label="Frames that are not solved"><table><thead><tr>'
        '<th scope="col">Frame</th><th scope="col">Name</th><th scope="col">Status</th><th scope="col">Reason</th>'
        f"</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _span(first: str, last: str) -> str:
    return first if first == last else f"{first} to {last}"


def _table(values: Mapping[str, Any]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{escape(key)}</th><td>{escape(str(value))}</td></tr>' for key, value in values.items()
    )
    return f'<div class="scroll"><table><tbody>{rows}</tbody></table></div>' if rows else "<p>None.</p>"


def _versions() -> dict[str, str]:
    found = {PROGRAM: program_version(), "Python": python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # another build of the same library
            continue
    return found


def _flat(options: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options as one level: ``{"tracker": {"window": 21}}`` becomes ``{"tracker.window": 21}``."""
    flat: dict[str, Any] = {}
    for key, value in options.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
