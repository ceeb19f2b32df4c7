"""A result in numbers, for summary.json and the report."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from factorsfm.camera.files import camera_to_json
from factorsfm.objects.object_result import ObjectResult
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.result.supervised import named_points
from factorsfm.result.verdict import Grade, median_reprojection_error, verdict_of
from factorsfm.support.program import PROGRAM, program_version
from factorsfm.support.status import ShotKind


def summary(reconstruction: Reconstruction) -> dict[str, Any]:
    """The content of summary.json; a missing number is NaN here and null in the file."""
    judged = verdict_of(reconstruction)
    return {
        "program": PROGRAM,
        "version": program_version(),
        "reconstructed": True,
        "grade": judged.grade,
        "doubts": judged.doubts,
        "verdict": verdict(reconstruction),
        "source": reconstruction.options.get("source"),
        "frames": len(reconstruction.frames),
        "registered": len(reconstruction.registered),
        "keyframes": sum(frame.keyframe for frame in reconstruction.frames),
        "points": len(reconstruction.points),
        "observations": len(reconstruction.observation_point),
        "parallax": reconstruction.parallax,
        "kind": reconstruction.kind,
        "stretches": [{"frames": [s.first, s.last], "kind": s.kind} for s in reconstruction.stretches],
        "metric": reconstruction.metric,
        "control": reconstruction.control and asdict(reconstruction.control),
        "imu": reconstruction.imu and asdict(reconstruction.imu),
        "alignment": reconstruction.alignment and asdict(reconstruction.alignment),
        "moving": [asdict(stretch) for stretch in reconstruction.moving.stretches] if reconstruction.moving else [],
        "objects": [_object_json(found) for found in reconstruction.objects],
        "named_points": [asdict(point) for point in named_points(reconstruction)],
        "reprojection_error": median_reprojection_error(reconstruction),
        "observability": pooled_observability(reconstruction),
        "focal_length": reconstruction.camera.mean_focal_length(),
        "focal_range": focal_range(reconstruction),
        "camera": camera_to_json(reconstruction.camera),
        "lens": reconstruction.lens and asdict(reconstruction.lens),
        "shutter": reconstruction.shutter and asdict(reconstruction.shutter),
        "seconds": with_total(reconstruction.seconds),
        "notes": reconstruction.notes,
        "parts": 1 + len(reconstruction.others),
        "statuses": [_frame_json(frame) for frame in reconstruction.frames],
        "options": reconstruction.options,
    }


def failure_summary(
    reason: str, frames: Sequence[FrameResult], options: Mapping[str, Any], seconds: Mapping[str, float]
) -> dict[str, Any]:
    """The summary of a shot that cannot be reconstructed: with the keys of any other, so that one reader fits both."""
    numbers = ("parallax", "kind", "control", "imu", "alignment", "reprojection_error", "observability", "focal_length")
    return {
        "program": PROGRAM,
        "version": program_version(),
        "reconstructed": False,
        "grade": Grade.NOT_SOLVED,
        "reason": reason,
        "verdict": reason,
        "source": options.get("source"),
        "frames": len(frames),
        "registered": sum(frame.registered for frame in frames),
        **dict.fromkeys(("keyframes", "points", "observations", "parts"), 0),
        **dict.fromkeys((*numbers, "metric", "focal_range", "camera", "lens", "shutter")),
        **{name: [] for name in ("doubts", "stretches", "moving", "objects", "named_points", "notes")},
        "seconds": with_total(seconds),
        "statuses": [_frame_json(frame) for frame in frames],
        "options": options,
    }


def incomplete_summary() -> dict[str, Any]:
    """The summary of a folder whose result is being replaced."""
    reason = "the program was stopped while it replaced an earlier result"
    return {**failure_summary(reason, (), {}, {}), "incomplete": True}


def verdict(reconstruction: Reconstruction) -> str:
    """The result in one sentence for the user."""
    sentence = f"{registered_share(reconstruction)} registered, {len(reconstruction.points):,} points"
    error = median_reprojection_error(reconstruction)
    if math.isfinite(error):
        sentence += f", median reprojection error {error:.2f} px"
    doubtful = "; doubtful" if verdict_of(reconstruction).grade is Grade.DOUBTFUL else ""
    if reconstruction.kind is ShotKind.GENERAL:
        return f"{sentence}, parallax {reconstruction.parallax:.3f}{doubtful}"
    motion = "pure rotation" if reconstruction.kind is ShotKind.ROTATION else "static camera"
    return f"{sentence}; {motion}, no parallax{doubtful}"


def part_name(number: int) -> str:
    """Name of the folder of another part of an image set, inside the folder of part 1."""
    return f"part-{number:03d}"


def registered_share(reconstruction: Reconstruction) -> str:
    """The number of registered frames in words."""
    frames, registered = len(reconstruction.frames), len(reconstruction.registered)
    return f"all {frames} frames" if registered == frames else f"{registered} of {frames} frames"


def conclusion(reconstruction: Reconstruction, output: Path) -> str:
    """The sentences that a command prints after it has written a result."""
    judged = verdict_of(reconstruction)
    doubts = [f"{Grade.DOUBTFUL}: {doubt}" for doubt in judged.doubts]
    notes = [f"Note: {note}" for note in reconstruction.notes]
    if reconstruction.alignment is not None:
        notes += reconstruction.alignment.sentences("m" if reconstruction.metric else "units")
    parts = [f"{part_name(n)}: {verdict(other)}." for n, other in enumerate(reconstruction.others, 2)]
    last = f"{judged.grade}. Result in {output}; open {output / 'report.html'}"
    return "\n".join([f"{verdict(reconstruction)}.", *doubts, *notes, *parts, last])


def focal_range(reconstruction: Reconstruction) -> tuple[float, float] | None:
    """Shortest and longest focal length of the frames, pixels; None if they share one lens."""
    focals = [frame.camera.mean_focal_length() for frame in reconstruction.frames if frame.camera is not None]
    return (min(focals), max(focals)) if focals else None


def pooled_observability(reconstruction: Reconstruction) -> dict[str, float] | None:
    """Medians over the registered cameras, and the largest pixel slide; None if unknown."""
    cameras = [asdict(f.observability) for f in reconstruction.frames if f.observability is not None]
    if not cameras:
        return None
    columns = {name: np.array([camera[name] for camera in cameras]) for name in cameras[0]}
    known = {name: values[np.isfinite(values)] for name, values in columns.items()}  # NaN for a camera without points
    pooled = {name: float(np.median(values)) if len(values) else math.nan for name, values in known.items()}
    return {**pooled, "largest_pixel_slide": max(known["pixel_slide"], default=math.nan)}


def with_total(seconds: Mapping[str, float]) -> dict[str, float]:
    """The seconds by stage, with their sum as "total" if there is no total yet."""
    return {**seconds, "total": seconds.get("total", sum(seconds.values()))}


def _object_json(found: ObjectResult) -> dict[str, Any]:
    """In brief; objects.json has all of it."""
    return {
        "name": found.name,
        "frames": len(found.frames),
        "points": len(found.points),
        "scale_std": found.scale_std,
        "scale_from": found.scale_from,
        "rotation_std": found.rotation_std,
        "reprojection_error": found.reprojection_error,
    }


def _frame_json(frame: FrameResult) -> dict[str, Any]:
    prior = frame.prior
    return {
        "index": frame.index,
        "name": frame.name,
        "timestamp": frame.timestamp,
        "status": frame.status,
        "message": frame.message,
        "registered": frame.registered,
        "keyframe": frame.keyframe,
        "observations": frame.observations,
        "inliers": frame.inliers,
        "reprojection_error": frame.reprojection_error,
        "prior": prior
        and {
            "scale": prior.scale,
            "scale_std": prior.scale_std,
            "shift": prior.shift,
            "shift_std": prior.shift_std,
            "sigma": prior.sigma,
            "smooth": prior.smooth,
        },
        "observability": frame.observability and asdict(frame.observability),
        "focal_length": frame.camera and frame.camera.mean_focal_length(),
        "focal_std": frame.focal_std,
        "repeats": frame.repeats,
    }
