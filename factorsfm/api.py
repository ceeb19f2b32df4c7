"""The one call: from a source of frames to a finished reconstruction."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pycolmap

from factorsfm.camera.files import open_camera
from factorsfm.control.files import read_control
from factorsfm.control.known import Control
from factorsfm.frames.edits import AnotherView, LeftOut, left_out_of, read_edit, until_another_view
from factorsfm.frames.fields import Fields
from factorsfm.frames.folders import unread_images
from factorsfm.frames.frame import Frame
from factorsfm.frames.numbering import first_number_of, missing_numbers, sequence_of
from factorsfm.frames.ranges import checked_range
from factorsfm.frames.reading import check_footage
from factorsfm.frames.unordered import looks_unordered, other_files, read_images
from factorsfm.imagesets.image_set import ImageSet
from factorsfm.imagesets.photo_folder import work_folder
from factorsfm.inertial.mounting import open_imu
from factorsfm.inertial.recording import ImuRecording
from factorsfm.inputs import Inputs, Source
from factorsfm.mending.user_tracks import UserTracks, read_tracks
from factorsfm.objects.observed import ObservedObjects, RememberedDepth
from factorsfm.priors.depth import DepthPrior, open_depth
from factorsfm.priors.depth_map import DepthKind
from factorsfm.priors.masks import MaskPrior, open_masks
from factorsfm.priors.object_masks import FROM_MOTION, ObjectMasks, open_objects
from factorsfm.result.left_out import add_left_out
from factorsfm.result.objects import add_objects, seen_again
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.streaming.stream import Stream
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.first_few import first_few
from factorsfm.support.options import LensFreedom, Options, ShutterUse
from factorsfm.support.progress import Progress
from factorsfm.support.status import FrameStatus
from factorsfm.support.threads import OneThreadEach


def reconstruct(
    source: Source,
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
    tracks: str | Path | UserTracks | None = None,
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
        control: what is known beforehand of poses, points, distances and heights, or its file (`read_control`), also
            of a camera that another program has tracked; the result is in the world and unit of the control then.
        tracks: of the user in a video, which take part with a weight of their own and become named points; or their
            file (`read_tracks`).
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
    frames = checked_range(frames) if frames is not None else None
    if unordered is None:
        unordered = isinstance(source, str | Path) and looks_unordered(Path(source), frames)
    options = replace(Options.preset_named(preset), lens=lens, shutter=shutter)
    from_motion = isinstance(objects, str) and objects == FROM_MOTION
    number = first_number_of(source)
    given = Inputs(
        source=source,
        frames=frames,
        fields=fields,
        pixel_aspect=pixel_aspect,
        unordered=unordered,
        camera=open_camera(camera),
        depth=open_depth(depth, depth_kind) if options.uses_depth else None,
        masks=open_masks(masks),
        objects=None if from_motion else open_objects(objects),
        from_motion=from_motion,
        control=read_control(control, number) if isinstance(control, str | Path) else control,
        tracks=read_tracks(tracks, first_number=number) if isinstance(tracks, str | Path) else tracks,
        imu=open_imu(imu) if isinstance(imu, str | Path) else imu,
        features=features,
        work=work,
        options=options,
    )
    result = _from_images(given, progress) if unordered else _from_shot(given, progress)
    said = given.described()
    for part in (result, *result.others):
        part.seconds["total"] = time.perf_counter() - begin
        part.options |= said
    return result


def _check_choice(name: str, value: str, expected: tuple[str, ...]) -> None:
    if value not in expected:
        raise InputError(f"unknown {name} '{value}', expected one of {', '.join(expected)}")


def _from_shot(given: Inputs, progress: Progress | None) -> Reconstruction:
    """The one shot of a source; of a file or folder without the slates and bars beside it.

    A file or folder is read anew where it holds more than one view.

    Raises:
        ReconstructionError: there are several shots, or as in `Stream.finish`.
    """
    if not isinstance(given.source, str | Path):
        return _solve(given, given.footage(), (), progress)
    try:
        result = _solve(given, until_another_view(given.footage()), (), progress)
    except AnotherView:
        edit = read_edit(given.footage())
        if len(edit.starts) > 1:
            raise ReconstructionError(edit.cuts) from None
        result = _solve(given, given.footage(), edit.left_out, progress)
        result.notes[:0] = [f"{part.said[0].upper()}{part.said[1:]}: left out." for part in edit.left_out]
    if sequence_of(given.source) and (gaps := missing_numbers([frame.index for frame in result.frames])):
        result.notes.append(f"The numbering of the frames has gaps: {gaps} are missing.")
    if Path(given.source).is_dir() and (unread := unread_images(Path(given.source))):
        result.notes.append(f"Images in formats that are not read, and left out: {first_few(unread, 5)}.")
    return result


def _solve(
    given: Inputs, images: Iterator[Frame], left_out: Sequence[LeftOut], progress: Progress | None
) -> Reconstruction:
    """One shot from the first frame to the last, and what moves in it by itself."""
    options = given.options
    with ExitStack() as held:
        seen, observed, depth = given.masks, None, given.depth
        if given.objects is not None:
            depth = remembered = RememberedDepth(depth) if depth is not None else None
            seen = observed = held.enter_context(
                ObservedObjects(given.objects, given.masks, remembered, options.tracker)
            )
        stream = held.enter_context(
            Stream(
                given.camera,
                depth=depth,
                masks=seen,
                options=options,
                control=given.control,
                imu=given.imu,
                horizon=None,
            )
        )
        beside = _pushed(stream, observed, images, left_out, progress)
        if not stream.frames:
            raise InputError(f"no frames in {given.source}")
        given.check_matched()
        result = stream.finish(progress, tracks=given.tracks)
        if (observed is not None or given.from_motion) and progress is not None:
            progress("objects", 0, None)
        with stream.seconds.of("objects"), OneThreadEach():
            if given.from_motion:
                observed = held.enter_context(
                    seen_again(result, stream.all_tracks(), given.footage(), given.depth, options)
                )
            if observed is not None:
                add_objects(result, observed, options)
        if observed is not None:
            result.seconds["objects"] = stream.seconds["objects"]
        if beside:
            add_left_out(result, beside)
        return result


def _pushed(
    stream: Stream,
    observed: ObservedObjects | None,
    images: Iterator[Frame],
    left_out: Sequence[LeftOut],
    progress: Progress | None,
) -> list[FrameResult]:
    """Push the frames of the shot; gives those that are left out, which are beside it."""
    beside = []
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
    return beside


def _from_images(given: Inputs, progress: Progress | None) -> Reconstruction:
    """A set of photographs in any order."""
    with work_folder(given.work) as folder:
        images = ImageSet(
            folder, given.camera, depth=given.depth, masks=given.masks, features=given.features, options=given.options,
            control=given.control,
        )  # fmt: skip
        if isinstance(given.source, str | Path) and (others := other_files(Path(given.source))):
            images.note(f"Not images, and ignored: {first_few(others, 5)}.")
        for done, image in enumerate(read_images(given.source, given.frames)):
            if progress is not None:
                progress("images", done, None)
            if isinstance(image, Frame):
                images.add(image)
            else:
                images.leave_out(image.index, image.name, image.reason)
        result = images.finish(progress)
        given.check_matched()
        return result
