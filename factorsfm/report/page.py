"""The report: one HTML file that opens anywhere, offline."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from factorsfm.reconstruction import FrameStatus, Reconstruction
from factorsfm.report.geometry import median_prior_residuals, scene
from factorsfm.summary import json_text, program_version, verdict, with_total

_MAX_POINTS = 20_000


def report_html(reconstruction: Reconstruction) -> str:
    """The report as one self-contained HTML document: styles, scripts and data are inside, no network."""
    template = Template(files("factorsfm.report").joinpath("template.html").read_text(encoding="utf-8"))
    source = reconstruction.options.get("source")
    sentence = verdict(reconstruction)
    return template.substitute(
        title=escape(f"{source} – factorsfm report" if source else "factorsfm report"),
        source=escape(str(source)) if source else "Reconstruction",
        verdict=escape(sentence[0].upper() + sentence[1:] + "."),
        notes="".join(f"<li>{escape(note)}</li>" for note in reconstruction.notes),
        facts=_facts(reconstruction),
        unregistered=_unregistered(reconstruction),
        timings=_table({stage: f"{value:.2f} s" for stage, value in with_total(reconstruction.seconds).items()}),
        options=_table(_flat(reconstruction.options)),
        version=escape(program_version()),
        # "</" would end the script element
        data=json_text(_data(reconstruction), indent=None).replace("</", "<\\/"),
    )


def _data(reconstruction: Reconstruction) -> dict[str, Any]:
    """What the script draws; arrays as base64 of little-endian values."""
    view = scene(reconstruction, _MAX_POINTS)
    frames = reconstruction.frames
    priors = [frame.prior for frame in frames]
    return {
        "metric": reconstruction.metric,
        "aspect": reconstruction.camera.height / reconstruction.camera.width,
        "half_width": reconstruction.camera.width / 2 / reconstruction.camera.focal_length_x,
        "points": _base64(view.points, "<f4"),
        "colors": _base64(view.colors, "u1"),
        "centers": _base64(view.centers, "<f4"),
        "rotations": _base64(view.rotations, "<f4"),
        "camera_frames": view.frames,
        "frame": [frame.index for frame in frames],
        "registered": [int(frame.registered) for frame in frames],
        "keyframe": [int(frame.keyframe) for frame in frames],
        "observations": [frame.observations for frame in frames],
        "inliers": [frame.inliers for frame in frames],
        "error": _short([frame.reprojection_error for frame in frames]),
        "residual": _short(100 * median_prior_residuals(reconstruction)),
        "scale": _short([prior.scale if prior else np.nan for prior in priors]),
        "scale_std": _short([prior.scale_std if prior else np.nan for prior in priors]),
        "shift": _short([prior.shift if prior else np.nan for prior in priors]),
        "shift_std": _short([prior.shift_std if prior else np.nan for prior in priors]),
    }


def _facts(reconstruction: Reconstruction) -> str:
    camera = reconstruction.camera
    facts = {
        "Frames registered": f"{len(reconstruction.registered)} / {len(reconstruction.frames)}",
        "Keyframes": sum(frame.keyframe for frame in reconstruction.frames),
        "Points": f"{len(reconstruction.points):,}",
        "Observations": f"{len(reconstruction.observation_point):,}",
        "Parallax": f"{reconstruction.parallax:.3f}",
        "Motion": reconstruction.kind,
        "Scale": "metres" if reconstruction.metric else "arbitrary",
        "Focal length": f"{camera.mean_focal_length():.1f} px",
        "Lens": f"{camera.model_name} {camera.width}×{camera.height}",
    }
    return "".join(f"<div><dt>{key}</dt><dd>{escape(str(value))}</dd></div>" for key, value in facts.items())


def _unregistered(reconstruction: Reconstruction) -> str:
    missing = [frame for frame in reconstruction.frames if not frame.registered]
    if not missing:
        return "<p>Every frame is registered.</p>"
    rows = "".join(
        f"<tr><td>{frame.index}</td><td>{escape(frame.name)}</td>"
        f"<td>{_words(frame.status)}</td><td>{escape(frame.message)}</td></tr>"
        for frame in missing
    )
    return (
        '<div class="scroll"><table><thead><tr><th scope="col">Frame</th><th scope="col">Name</th>'
        '<th scope="col">Status</th><th scope="col">Reason</th></tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _words(status: FrameStatus) -> str:
    return status.value.replace("_", " ")


def _table(values: Mapping[str, Any]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{escape(key)}</th><td>{escape(str(value))}</td></tr>' for key, value in values.items()
    )
    return f'<div class="scroll"><table><tbody>{rows}</tbody></table></div>' if rows else "<p>None.</p>"


def _flat(options: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options as one level: ``{"tracker": {"window": 21}}`` becomes ``{"tracker.window": 21}``."""
    flat: dict[str, Any] = {}
    for key, value in options.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def _base64(values: Any, dtype: str) -> str:
    return base64.b64encode(np.asarray(values).astype(dtype).tobytes()).decode("ascii")


def _short(values: Any) -> list[float]:
    """Five significant digits are enough to draw."""
    return [float(f"{value:.5g}") for value in np.asarray(values, float)]
