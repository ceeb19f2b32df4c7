"""Sentences about a result in the language of compositors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.result.summary import registered_share
from factorsfm.result.verdict import median_reprojection_error, verdict_of
from factorsfm.support.status import FrameStatus, ShotKind

_NO_SHARE = 0.05  # of the depth prior, below which it is not mentioned
_STATUS = {
    "registered": "solved",
    "lost": "the view is not in the map",
    "static": "solved, camera at rest",
    "inertial": "posed by the IMU",
    "too_few_tracks": "too little to track",
    "too_few_inliers": "tracks contradict the scene",
    "blank": "blank or out of focus",
    "waiting": "before the solve could start",
    "left_out": "not of the shot",
    "unusable": "image cannot be used",
}


def status_words(status: FrameStatus) -> str:
    return _STATUS.get(status.value, status.value.replace("_", " "))


def verdict_sentence(reconstruction: Reconstruction) -> str:
    """How many frames are solved, and how well the points fit the footage."""
    sentence = f"The camera is solved in {registered_share(reconstruction)}"
    error = median_reprojection_error(reconstruction)
    if np.isfinite(error):
        sentence += f", and half of the tracked points land within {error:.2f} pixels of where the footage shows them"
    return sentence + "."


def explanation(reconstruction: Reconstruction) -> list[str]:
    """What the solve can be used for, in sentences."""
    sentences = [*verdict_of(reconstruction).doubts, _motion(reconstruction)]
    known = [frame.observability for frame in reconstruction.registered if frame.observability is not None]
    slide = _largest([item.pixel_slide for item in known])
    if slide is not None:
        most = f"up to {slide:.2f} pixels" if slide >= 0.01 else "less than 0.01 pixels"
        sentences.append(f"An object placed in the scene may slide by {most} against the footage (1σ).")
    share = _largest([item.prior_share for item in known])
    if share is not None and reconstruction.kind is ShotKind.GENERAL:
        if share < _NO_SHARE:
            sentences.append("Where the camera stands follows from parallax alone.")
        else:
            sentences.append(
                f"Up to {100 * share:.0f} % of what is known of the camera's position comes from the depth prior, "
                "the rest from parallax."
            )
    alignment = reconstruction.alignment
    if alignment is not None:
        sentences += alignment.sentences("m" if reconstruction.metric else "units")
    elif reconstruction.metric:
        sentences.append("Lengths are in metres, as far as the depth prior is right.")
    else:
        sentences.append("The size of the scene is free: scale it by a length that you know.")
    return sentences


def failure_sentence(frames: Sequence[FrameResult]) -> str:
    """The statuses of the frames of a shot that could not be solved."""
    counts = Counter(frame.status for frame in frames).most_common()
    found = "; ".join(f"{n} {'frame' if n == 1 else 'frames'}: {status_words(status)}" for status, n in counts)
    return f"{found}." if found else "No frame was read."


def _motion(reconstruction: Reconstruction) -> str:
    if not reconstruction.registered:
        return "No frame could be solved."
    if reconstruction.kind is ShotKind.STATIC:
        return "The camera is locked off: one pose holds for every frame."
    if reconstruction.kind is ShotKind.ROTATION:
        return "The camera only turns: use it as a nodal pan, without parallax."
    return f"The camera travels {100 * reconstruction.parallax:.2g} % of the distance to the scene."


def _largest(values: Sequence[float]) -> float | None:
    finite = [value for value in values if np.isfinite(value)]
    return max(finite) if finite else None
