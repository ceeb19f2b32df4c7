"""What a user should read of a result, in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.control.fit import ControlFit
from factorsfm.lens.lens import LensEstimate
from factorsfm.motion.shot_kind import LEAST_GAIN
from factorsfm.motion.stretches import Stretch
from factorsfm.polish.polished import Polished
from factorsfm.result.moving import Moving
from factorsfm.result.reconstruction import FrameResult, Reconstruction, RollingShutter
from factorsfm.result.runs import runs
from factorsfm.support.status import ShotKind

# Worth a sentence: the prior gives at least half of the information, or a virtual object may visibly drift.
_NOTED_SHARE = 0.5
_NOTED_SLIDE_PX = 0.5
_MOST_STRETCHES = 2  # sentences of each sort
# Cost over that of another reading, from which that is nearly as good; right solutions have 0.5 to 0.8.
_AS_GOOD = 0.85
# Of the variance, since errors of neighbouring tracks are alike: right solutions have 1 to 7, wrong ones 13 to 80. In
# long tracks with hardly any noise right ones reach 15: what the errors have in common is 0.01 pixels and less then.
_ALIKE, _ALIKE_PX = 10.0, 0.03
_MOST_OF_THE_IMAGE = 0.5  # at rest, nobody doubts that the camera is fixed; moving, it leaves little to rest on


def result_doubts(polished: Polished, moving_share: float) -> list[str]:
    """Why the images leave open what the camera does, in sentences: another reading of the shot is nearly as good.

    Args:
        moving_share: of the image, over all frames, what moves by itself.
    """
    motion, rest, doubts = polished.motion, polished.rest, []
    if rest is not None and rest.fixed and rest.share < _MOST_OF_THE_IMAGE:
        doubts.append(
            f"{100 * rest.share:.0f} % of the image rests, and one motion explains only {100 * rest.explained:.0f} % "
            "of what does not: taken for a fixed camera before things that move by themselves."
        )
    if rest is not None and not rest.fixed and motion.kind is ShotKind.GENERAL:
        doubts.append(
            f"{100 * rest.share:.0f} % of the image rests: the camera moves before something far away, or it is fixed "
            "and all else that is seen moves by itself."
        )
    elif motion.kind is ShotKind.GENERAL and polished.turns:
        doubts.append(
            "A camera that only turns explains the tracks nearly as well, through a lens of its own: translation and "
            "lens cannot be told apart here."
        )
    elif motion.close:
        doubts.append(
            f"A camera that moves explains the tracks hardly better than one that only turns (by {motion.gain:.2f} of "
            f"the noise, {LEAST_GAIN:.1f} is asked for): translation is at the limit of what can be seen."
        )
    if polished.inflation > _ALIKE and polished.shared_error > _ALIKE_PX:
        doubts.append(
            "Neighbouring tracks miss alike, far beyond chance: something large moves by itself, or the lens is "
            "another."
        )
    if polished.rival > _AS_GOOD:
        doubts.append(
            "Two things fill the image and move against each other: which of them is the scene cannot be told, and the "
            "camera may be relative to the other one."
        )
    if moving_share > _MOST_OF_THE_IMAGE:
        doubts.append(
            f"{100 * moving_share:.0f} % of the image moves by itself: the cameras rest on the smaller part, whose "
            "tracks the larger one drags along where it passes."
        )
    if polished.zoom and polished.contradiction is not None:
        doubts.append(
            f"A zoom of {polished.zoom:.2f} explains the tracks as well as this path, whose points the depth prior "
            "contradicts."
        )
    if polished.lens is not None and polished.lens.misfit_px:
        doubts.append(f"The tracks fit no lens: their typical error is {polished.lens.misfit_px:.2f} pixels.")
    return doubts


def result_notes(
    polished: Polished,
    result: Reconstruction,
    guessed: pycolmap.Camera | None,
    *,
    depth_given: bool,
    has_depth: bool,
    interval: float = 0.0,
) -> list[str]:
    """All notes on a result, the most important ones first.

    Args:
        guessed: the camera, where it was neither given nor estimated.
        depth_given: whether there is a depth prior; has_depth: whether a frame has a depth map.
        interval: seconds between two frames, 0 if unknown.
    """
    notes = _motion_notes(polished, has_depth) + stretch_notes(result.stretches)
    if result.moving is not None:
        notes.append(moving_note(result.moving))
    if polished.lens is not None:
        notes.append(lens_note(polished.lens))
    if polished.zoom:
        notes.append(
            f"The tracks ask for a zoom: one that changes the focal length by {polished.zoom:.2f} explains them better "
            "than one focal length, or as well as a way towards a flat wall; try --lens zoom."
        )
    if polished.control is not None:
        notes += control_notes(polished.control)
    if polished.unused:
        notes.append(
            f"{polished.unused}: not used, since a camera that stays in its place ties no lengths to the images."
        )
    if polished.contradiction is not None:
        notes.append(
            "The depth prior contradicts the geometry and is not used: its inverse depths correlate with those of the "
            f"points by {polished.contradiction:.2f}."
        )
    if depth_given and not has_depth:
        notes.append("The depth prior took no part: no frame that needed it has a usable depth map.")
    if guessed is not None:
        notes.append(_focal_origin_note(guessed))
    if result.shutter is not None:
        notes.append(shutter_note(result.shutter, interval))
    return notes + observability_notes(result.frames)


def _motion_notes(polished: Polished, has_depth: bool) -> list[str]:
    """What a camera that does not translate leaves open."""
    motion, zooms = polished.motion, polished.lens is not None and polished.lens.zooms
    depths = "depths and their scale come from the prior alone" if has_depth else "depths are unknown without a prior"
    if motion.kind is ShotKind.STATIC and zooms:
        return [f"The camera stays where it is and only zooms; {depths}."]
    if motion.kind is ShotKind.STATIC:
        return [f"The camera is static: no frame moves by more than {motion.displacement_px:.2f} pixels; {depths}."]
    if motion.kind is ShotKind.ROTATION:
        return [
            f"The camera only {'rotates and zooms' if zooms else 'rotates'}: its translation is not observable from "
            "geometry and is reported as zero; "
            f"{depths}."
        ]
    return []


def stretch_notes(stretches: Sequence[Stretch]) -> list[str]:
    """What the camera does when, of a shot that is not of one kind throughout."""
    if len(stretches) < 2:
        return []
    does = {ShotKind.STATIC: "stands", ShotKind.ROTATION: "only turns", ShotKind.GENERAL: "moves"}
    said = ", ".join(f"{does[s.kind]} in {s.first} to {s.last}" for s in stretches)
    return [f"By frames, the camera {said}."]


def moving_note(moving: Moving) -> str:
    """How much of the shot moves by itself, and when."""
    told = sorted(sorted(moving.stretches, key=lambda s: -s.image)[:_MOST_STRETCHES], key=lambda s: s.first)
    said = [
        f"frames {s.first} to {s.last}: {100 * s.tracks:.0f} % of the tracks, {100 * s.image:.0f} % of the image"
        for s in told
    ]
    others = len(moving.stretches) - len(told)
    more = f"; {others} other {'stretch' if others == 1 else 'stretches'} in summary.json" if others else ""
    return (
        f"Something moves by itself and is left out: {'; '.join(said)}{more}. "
        "Masks of all that moves make the cameras better still."
    )


def _percent(share: float) -> str:
    """A relative standard deviation in words; beyond 100 % a linear estimate has no digits that mean anything."""
    return f"{100 * share:.1f} %" if share <= 1.0 else "of more than 100 %"


def lens_note(estimate: LensEstimate) -> str:
    """What the shot says of an unknown lens."""
    focals, std = estimate.lens.focal, f"standard deviation {_percent(estimate.focal_std.max())}"
    focal, zoom, held = float(np.median(focals)), "", not estimate.focal_std.any()
    if estimate.zoom_std is not None and not estimate.zooms:
        zoom = f" No zoom was found: what it might be is less than {200 * estimate.zoom_std:.1f} %."
    elif estimate.zooms:
        zoom = (
            f" It changes from {focals[0]:.0f} to {focals[-1]:.0f} pixels; the ratio of the longest to the shortest is "
            f"{focals.max() / focals.min():.3f} ± {estimate.zoom_std * focals.max() / focals.min():.3f}."
        )
        if not estimate.announced:
            zoom += " Nobody announced this zoom; --lens focal keeps one focal length."
    if estimate.contradicted_px:
        zoom += (
            f" What was known of it before says {estimate.contradicted_px:.0f} pixels, which the images contradict: "
            "cropped or stretched pictures, or a rolling shutter, may explain it."
        )
    if not (estimate.determined or estimate.rough):
        reason = f"this shot does not determine it ({std})"
        if estimate.misfit_px:
            reason = f"the tracks fit no lens (typical error {estimate.misfit_px:.2f} pixels)"
        kept = "as it was given" if held else f"a guess ({focal:.0f} pixels)"
        return f"The focal length is {kept}: {reason}.{zoom}"
    note = "The focal length was estimated"
    if estimate.rough:
        note = "The focal length is known roughly, and counts as not determined"
    note = "The focal length is as it was given" if held else f"{note}: {focal:.0f} pixels, {std}"
    if np.isfinite(estimate.shape_std[0]):
        k, k_std = estimate.lens.shape, estimate.shape_std
        note += f"; radial distortion k1 {k[0]:.3f} ± {k_std[0]:.3f}, k2 {k[1]:.3f} ± {k_std[1]:.3f}"
    elif held:
        note += "; no distortion was found"
    return f"{note}.{zoom}"


def _focal_origin_note(camera: pycolmap.Camera) -> str:
    """Where a focal length comes from that was neither given nor estimated."""
    origin = "that of the EXIF data" if camera.has_prior_focal_length else "a guess"
    return (
        f"The focal length is {origin} ({camera.mean_focal_length():.0f} pixels): no camera was given, and the lens "
        "was to stay fixed."
    )


def shutter_note(shutter: RollingShutter, interval: float) -> str:
    """How a rolling shutter reads the images, and which moment the poses belong to.

    Args:
        interval: seconds between two frames, 0 if unknown.
    """
    way = ("top", "bottom") if shutter.along == "rows" else ("left", "right")
    first, last = way if shutter.readout > 0 else way[::-1]
    milliseconds = f" ({1e3 * abs(shutter.readout) * interval:.1f} ms)" if interval > 0 else ""
    poses = "are those of the image's middle"
    if shutter.recorded:
        poses = "fit the recorded images, with --shutter rolling they are those of the image's middle"
    return (
        f"Rolling shutter: images are read from {first} to {last} in {abs(shutter.readout):.2f} ± "
        f"{shutter.std:.2f} of the time between two frames{milliseconds}. Lens and points are free of it; "
        f"poses {poses}."
    )


def control_notes(fit: ControlFit) -> list[str]:
    """What a user should know of it."""
    wrong = [r for r in fit.residuals if r.contradicts]
    good = [r.sigmas for r in fit.residuals if not r.contradicts]
    size = f", off by {np.sqrt(np.mean(np.square(good))):.2g} sigma (root mean square)" if good else ""
    held = f"{len(fit.held)} poses held exactly, " if fit.held else ""
    what, whole, item, world = (
        "Control", "the control", "items of the control", "The world is that of the first camera.",
    )  # fmt: skip
    if fit.source == "factors":
        what, whole, item = "Factors added", "the factors added", "factors"
        world = "The result is in the world of the live graph."
    elif fit.placed:
        world = "The result is in the control's world."
    scale, position = f"{100 * fit.scale_std:.2g} %", f"{fit.position_std:.2g} m"
    known = f"the scale is known to {scale}, the position of a camera to {position}. {world}"
    if not np.isfinite(fit.scale_std):
        known = "they leave the unit of length open."
    notes = [f"{what}: {held}{len(good)} items used{size}; {known}"]
    if wrong:
        worst = sorted(wrong, key=lambda r: -r.sigmas)[:3]
        sizes = ["" if r.unit == "sigma" else f"{r.error:.3g} {r.unit} or " for r in worst]
        said = "; ".join(f"{r.name} by {size}{r.sigmas:.0f} sigma" for r, size in zip(worst, sizes, strict=True))
        notes.append(f"{len(wrong)} {item} contradict the images and the others: {said}.")
    if fit.unused:
        notes.append(f"Not used of {whole}: {'; '.join(fit.unused[:3])}.")
    return notes


def observability_notes(frames: Sequence[FrameResult]) -> list[str]:
    """What a user should know of the prior's share and of the drift: one sentence on the shot, few on stretches.

    Args:
        frames: of the source, in order; only those that are registered count.
    """
    seen = [(f.index, f.observability) for f in frames if f.observability is not None]
    if not seen:
        return []
    index = np.array([i for i, _ in seen])
    share, view_axis, angle, slide = np.array([astuple(o) for _, o in seen]).T
    notes = []
    weak = np.nan_to_num(view_axis) >= _NOTED_SHARE
    if (typical := float(np.median(np.nan_to_num(share)))) >= _NOTED_SHARE:
        notes.append(
            f"{100 * typical:.0f} % of the information on the camera's positions comes from the depth prior: the "
            f"median triangulation angle is {np.median(angle):.2g} degrees, and the tracks alone would leave "
            f"{(1.0 - min(typical, 0.9999)) ** -0.5:.2g} times the error."
        )
        weak &= not weak.all()
    for stretch in _weakest(weak, view_axis):
        notes.append(
            f"{_frames(index[stretch])}: translation along the view axis comes "
            f"{100 * np.median(view_axis[stretch]):.0f} % from the depth prior."
        )
    for stretch in _weakest(slide >= _NOTED_SLIDE_PX, slide):
        notes.append(
            f"{_frames(index[stretch])}: a virtual object at the scene's median depth may drift by "
            f"{slide[stretch].max():.1f} pixels (one standard deviation)."
        )
    return notes


def _weakest(weak: NDArray[np.bool_], values: NDArray[np.float64]) -> list[slice]:
    """The few stretches of weak frames with the largest values, in order."""
    found = sorted(runs(weak), key=lambda stretch: -np.median(values[stretch]))
    return sorted(found[:_MOST_STRETCHES], key=lambda stretch: stretch.start)


def _frames(index: NDArray[np.int64]) -> str:
    return f"Frames {index[0]} to {index[-1]}"
