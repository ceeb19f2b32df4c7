"""The one call: from a source of frames to a finished reconstruction."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.files import open_camera
from factorsfm.control.known import Control, find_frames, read_control
from factorsfm.frames.edits import AnotherView, LeftOut, left_out_of, read_edit, until_another_view
from factorsfm.frames.fields import Fields
from factorsfm.frames.folders import list_images
from factorsfm.frames.frame import Frame
from factorsfm.frames.numbering import chosen, missing_numbers, numbered_images, sequence_of
from factorsfm.frames.ranges import checked_range, range_text
from factorsfm.frames.reading import check_footage, read_frames
from factorsfm.frames.unordered import looks_unordered, other_files, read_images
from factorsfm.imagesets.image_set import ImageSet
from factorsfm.imagesets.photo_folder import work_folder
from factorsfm.inertial.mounting import open_imu
from factorsfm.inertial.recording import ImuRecording
from factorsfm.objects.observed import ObservedObjects, RememberedDepth
from factorsfm.priors.depth import DepthFolder, DepthPrior, open_depth
from factorsfm.priors.depth_map import DepthKind
from factorsfm.priors.masks import MaskFolder, MaskPrior, open_masks
from factorsfm.priors.object_masks import FROM_MOTION, ObjectFolder, ObjectMasks, open_objects
from factorsfm.result.left_out import add_left_out
from factorsfm.result.objects import add_objects, seen_again
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.streaming.stream import Stream
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.options import LensFreedom, Options, ShutterUse
from factorsfm.support.progress import Progress
from factorsfm.support.status import FrameStatus
from factorsfm.support.threads import OneThreadEach


def reconstruct(
    source: str | Path | Iterable[Frame | NDArray[np.uint8]],
    *,
    camera: str | Path | pycolmap.Camera | None = None,
    depth: str | Path | DepthPrior | None = "tcmonodepth",
    depth_kind: DepthKind | str | None = None,
    masks: str | Path | MaskPrior | None = None,
    objects: str | Path | ObjectMasks | None = None,
    frames: slice | None = None,
    fields: Fields = "auto",
    pixel_aspect: float | None = None,
    preset: str = "default",
    lens: LensFreedom = "auto",
    shutter: ShutterUse = "auto",
    unordered: bool | None = None,
    features: str | Path = "sift",
    work: str | Path | None = None,
    control: str | Path | Control | None = None,
    imu: str | Path | ImuRecording | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Camera path, lens and sparse points of one shot, or of a set of photographs.

    Photographs of several scenes, or of parts of one that cannot be joined, make a reconstruction of each: the largest
    is returned, the others are its `others`.

    Args:
        source: a video file, a folder of images, or any iterable of 8-bit images (BGR or grey) or `Frame`s.
        camera: the lens, or its JSON file; None takes EXIF or a guess.
        depth: a network (ONNX file), a named model, a folder of maps, any `DepthPrior`, or None.
        depth_kind: what the prior holds, where it cannot be known.
        masks: a folder, "people" or "movable", another segmentation network, any `MaskPrior`, or None.
        objects: rigid things in a video that move by themselves and are solved, too: their masks, as a folder
            (`ObjectFolder`) or any `ObjectMasks`, which the scene ignores; or "auto", what moves beside the scene,
            from frames that can be read twice. They are `Reconstruction.objects` of the result.
        frames: range of the source's frames.
        fields, pixel_aspect: of a shot, see `read_frames`.
        preset: see `options.PRESETS`.
        lens: what of the lens is estimated where the shot determines it, see `Options`.
        shutter: what is done with a rolling shutter, see `Options`.
        unordered: whether the images are a set in any order, which are matched with each other, or a shot, which is
            tracked from frame to frame; None decides for folders by `unordered.looks_unordered`.
        features: of a set: "sift"; "xfeat", whose networks lie in the folder that ``FACTORSFM_MODELS`` names; or a
            folder that holds them.
        work: folder for the features and matches of a set, from which an interrupted run goes on; None keeps nothing.
        control: what is known beforehand of poses, points, distances and heights, or its JSON file; the result is in
            the world and unit of the control then.
        imu: recording of an IMU on the camera of a video, or its file (`open_imu`); the result is metric then.
        progress: called with the stage, the frames done, and their number where it is known.

    Raises:
        InputError: the source, the camera or a prior cannot be used.
        ReconstructionError: the shot cannot be reconstructed, or the file or folder holds several shots.
    """
    begin = time.perf_counter()
    _check_choice("lens", lens, get_args(LensFreedom))
    _check_choice("shutter", shutter, get_args(ShutterUse))
    check_footage(fields, pixel_aspect)
    options = replace(Options.preset_named(preset), lens=lens, shutter=shutter)
    camera = open_camera(camera)
    frames = checked_range(frames) if frames is not None else None
    prior = open_depth(depth, depth_kind) if options.uses_depth else None
    from_motion = isinstance(objects, str) and objects == FROM_MOTION
    mask_prior, object_masks = open_masks(masks), None if from_motion else open_objects(objects)
    known = read_control(control) if isinstance(control, str | Path) else control
    recording = open_imu(imu) if isinstance(imu, str | Path) else imu
    if unordered is None:
        unordered = isinstance(source, str | Path) and looks_unordered(Path(source), frames)
    _check_control(known, source, frames, unordered=unordered)
    if unordered and recording is not None:
        raise InputError("an IMU goes with a video; images in any order have no times")
    if unordered and (object_masks is not None or from_motion):
        raise InputError("objects are tracked in a video; images in any order show no motion")
    if unordered and (fields != "auto" or pixel_aspect is not None):
        raise InputError("fields and pixel aspect are of a shot; images in any order take their pixels as square")
    if from_motion and isinstance(source, Iterator):
        raise InputError("objects that move by themselves need frames that can be read twice; these are an iterator")
    footage = partial(read_frames, source, frames, fields=fields, pixel_aspect=pixel_aspect)
    if unordered:
        result = _from_images(source, frames, camera, prior, mask_prior, options, known, features, work, progress)
    else:
        solve = partial(
            _solve, source=source, camera=camera, depth=prior, masks=mask_prior, objects=object_masks,
            again=footage if from_motion else None, options=options, control=known, imu=recording, progress=progress,
        )  # fmt: skip
        result = _from_shot(source, footage, solve)
    said = {
        "source": str(source) if isinstance(source, str | Path) else "frames",
        "unordered": unordered,
        "features": str(features),
        "objects": FROM_MOTION if from_motion else _name_of(object_masks),
        **input_options(source, prior, mask_prior, frames, fields, pixel_aspect),
    }
    for part in (result, *result.others):
        part.seconds["total"] = time.perf_counter() - begin
        part.options |= said
    return result


def _check_choice(name: str, value: str, expected: tuple[str, ...]) -> None:
    if value not in expected:
        raise InputError(f"unknown {name} '{value}', expected one of {', '.join(expected)}")


def _check_control(control: Control | None, source: object, frames: slice | None, *, unordered: bool) -> None:
    """Before the long work: a folder has all frames that the control names."""
    if control is not None and isinstance(source, str | Path) and Path(source).is_dir():
        if unordered:
            names = [(index, path.name) for index, path in enumerate(list_images(Path(source)))][frames or slice(None)]
        else:
            images = chosen(numbered_images(Path(source)), frames or checked_range(slice(None)))
            names = [(number, path.name) for number, path in images]
        find_frames(control, names)


def input_options(
    source: object,
    depth: DepthPrior | None,
    masks: MaskPrior | None,
    frames: slice | None,
    fields: Fields = "auto",
    pixel_aspect: float | None = None,
) -> dict[str, Any]:
    """What is written beside the options of a result.

    The number that a sequence begins with, the names of the priors, the range, and how footage was read.
    """
    return {
        "first_number": numbers[0] if (numbers := sequence_of(source)) else None,
        "depth": depth.name if depth is not None else None,
        "depth_kind": str(depth.kind) if depth is not None else None,
        "masks": _name_of(masks),
        "frames": range_text(frames) if frames is not None else None,
        "fields": fields,
        "pixel_aspect": pixel_aspect,
    }


def _name_of(masks: MaskPrior | ObjectMasks | None) -> str | None:
    return getattr(masks, "name", type(masks).__name__) if masks is not None else None


def _from_shot(
    source: str | Path | Iterable[Frame | NDArray[np.uint8]],
    footage: Callable[[], Iterator[Frame]],
    solve: Callable[[Iterator[Frame], Sequence[LeftOut]], Reconstruction],
) -> Reconstruction:
    """The one shot of a source; of a file or folder without the slates and bars beside it.

    Args:
        footage: opens the source; a file or folder is read anew where it holds more than one view.

    Raises:
        ReconstructionError: there are several shots, or as in `Stream.finish`.
    """
    if not isinstance(source, str | Path):
        return solve(footage(), ())
    try:
        result = solve(until_another_view(footage()), ())
    except AnotherView:
        edit = read_edit(footage())
        if len(edit.starts) > 1:
            raise ReconstructionError(edit.cuts) from None
        result = solve(footage(), edit.left_out)
        result.notes[:0] = [f"{part.said[0].upper()}{part.said[1:]}: left out." for part in edit.left_out]
    if sequence_of(source) and (gaps := missing_numbers([frame.index for frame in result.frames])):
        result.notes.append(f"The numbering of the frames has gaps: {gaps} are missing.")
    return result


def _solve(
    images: Iterator[Frame],
    left_out: Sequence[LeftOut],
    *,
    source: object,
    camera: pycolmap.Camera | None,
    depth: DepthPrior | None,
    masks: MaskPrior | None,
    objects: ObjectMasks | None,
    again: Callable[[], Iterator[Frame]] | None,
    options: Options,
    control: Control | None,
    imu: ImuRecording | None,
    progress: Progress | None,
) -> Reconstruction:
    with ExitStack() as held:
        seen, observed, shared = masks, None, depth
        if objects is not None:
            shared = remembered = RememberedDepth(depth) if depth is not None else None
            seen = observed = held.enter_context(ObservedObjects(objects, masks, remembered, options.tracker))
        stream = held.enter_context(Stream(camera, depth=shared, masks=seen, options=options, control=control, imu=imu))
        beside: list[FrameResult] = []
        for done, frame in enumerate(images):
            if progress is not None:
                progress("frames", done, None)
            if reason := left_out_of(left_out, frame.index):
                beside.append(FrameResult(frame.index, frame.name, frame.timestamp, FrameStatus.LEFT_OUT, reason))
                continue
            stream.push(frame)
            if observed is not None:
                with stream.seconds.of("objects"):
                    observed.push(frame)
        if not stream.frames:
            raise InputError(f"no frames in {source}")
        check_matched(source, depth, masks, objects)
        result = stream.finish(progress)
        if (observed is not None or again is not None) and progress is not None:
            progress("objects", 0, None)
        with stream.seconds.of("objects"), OneThreadEach():
            if again is not None:
                prior = depth if options.uses_depth else None
                observed = held.enter_context(seen_again(result, stream.all_tracks(), again(), prior, options))
            if observed is not None:
                add_objects(result, observed, options)
        if observed is not None:
            result.seconds["objects"] = stream.seconds["objects"]
        if beside:
            add_left_out(result, beside)
        return result


def _from_images(
    source: str | Path | Iterable[Frame | NDArray[np.uint8]],
    frames: slice | None,
    camera: pycolmap.Camera | None,
    depth: DepthPrior | None,
    masks: MaskPrior | None,
    options: Options,
    control: Control | None,
    features: str | Path,
    work: str | Path | None,
    progress: Progress | None,
) -> Reconstruction:
    with work_folder(work) as folder:
        images = ImageSet(folder, camera, depth=depth, masks=masks, features=features, options=options, control=control)
        if isinstance(source, str | Path) and (others := other_files(Path(source))):
            some = ", ".join(others[:5]) + (", …" if len(others) > 5 else "")
            images.note(f"Not images, and ignored: {some}.")
        for done, image in enumerate(read_images(source, frames)):
            if progress is not None:
                progress("images", done, None)
            if isinstance(image, Frame):
                images.add(image)
            else:
                images.leave_out(image.index, image.name, image.reason)
        result = images.finish(progress)
        check_matched(source, depth, masks)
        return result


def check_matched(
    source: object, depth: DepthPrior | None, masks: MaskPrior | None, objects: ObjectMasks | None = None
) -> None:
    """After all frames: a folder of maps or masks of which none belongs to a frame is an InputError."""
    for name, folder in (("depth map", depth), ("mask", masks), ("mask of an object", objects)):
        if isinstance(folder, DepthFolder | MaskFolder | ObjectFolder) and folder.asked and not folder.matched:
            raise InputError(f"no {name} in the given folder matches a frame of {source}")
