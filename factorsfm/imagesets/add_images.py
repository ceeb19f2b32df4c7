"""Further images for a finished reconstruction, registered in its coordinates."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.frames.frame import Frame
from factorsfm.frames.reading import read_frames
from factorsfm.frames.unordered import read_images
from factorsfm.imagesets.joint_adjustment import extended, local_pose
from factorsfm.imagesets.joint_problem import MatchedImage
from factorsfm.imagesets.mapper import SetMapper
from factorsfm.imagesets.photo_folder import pixel_digest, work_folder, write_once
from factorsfm.result.image_sources import AddedImages, ImageSource, added_images, fields_of, image_sources
from factorsfm.result.reading import read_result
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.file_names import check_name
from factorsfm.support.options import Options
from factorsfm.support.progress import Progress
from factorsfm.support.similarity import Similarity
from factorsfm.support.status import FrameStatus, ShotKind
from factorsfm.support.threads import OneThreadEach
from factorsfm.tracks.image_tracks import ImageTracks
from factorsfm.tracks.match_tracks import tracks_from_matches
from factorsfm.tracks.matches import match_images

_MOST_OF_A_SHOT = 40  # frames of a shot that new images are matched with
_SAME_ASPECT = 0.01
_NO_TRACKS = "The tracks of the shot are not kept: only the result without these images can be solved again."


def add_images(
    result: Reconstruction | str | Path,
    images: str | Path | Iterable[Frame | NDArray[np.uint8]],
    *,
    source: str | Path | None = None,
    frames: slice | None = None,
    refine: bool = False,
    work: str | Path | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Register further images of the same lens on a finished reconstruction of a shot or of a set.

    The new images are matched with those of the result, and common features are triangulated from the known poses. The
    known cameras stay exactly where they are, unless `refine` is set. Points that new images see are refined.

    Args:
        result: a reconstruction, or the folder of a result.
        images: a folder, a video file, or any iterable of images. Images of the result's source that have no pose
            or were outside of its range keep their index; others get the next indices.
        source: the images of the result, if they have moved.
        frames: range of the new images.
        refine: adjust all cameras and points together, and align the result with its old coordinates.
        work: folder for copies, features and matches, which an interrupted run uses again; None keeps nothing.
        progress: told the stage, the images done, and their number.

    Raises:
        InputError: the result, its images or the new ones cannot be used.
        ReconstructionError: no new image can be registered.
    """
    begin = time.perf_counter()
    base = result if isinstance(result, Reconstruction) else read_result(result)
    report: Progress = progress or (lambda stage, done, total: None)
    if base.kind is not ShotKind.GENERAL or len(base.registered) < 2:
        raise InputError("images can only be added to a result whose camera moves: only then are its points in place")
    if base.has_own_lenses:
        raise InputError("images can only be added to a result whose frames share one lens, and this one zooms")
    with work_folder(work) as folder, OneThreadEach():
        extension = _Extension(base, folder, refine)
        extension.take_known(source, report)
        extension.take_new(images, frames, report)
        extended = extension.run(report)
    extended.seconds = {**base.seconds, "extension": time.perf_counter() - begin}
    extended.seconds.pop("total", None)
    return extended


class _Extension:
    """The steps from a result and new images to one reconstruction."""

    def __init__(self, base: Reconstruction, folder: Path, refine: bool) -> None:
        self._base, self._folder, self._refine = base, folder, refine
        self._frames = [replace(frame) for frame in base.frames]
        self._known: list[MatchedImage] = []
        self._absent: set[int] = set()  # rows of known images that cannot be matched: they were turned, or were arrays
        self._new: list[MatchedImage] = []
        self._added = added_images(base.options)
        # All is solved in the coordinates of the first camera, with a median inverse distance of 1.
        first = base.registered[0].cam_from_world
        assert first is not None
        distance = np.linalg.norm(first * base.points, axis=1) if len(base.points) else np.ones(1)
        unit = float(np.median(1.0 / np.maximum(distance, 1e-9)))
        self._local = Similarity(unit, np.asarray(first.rotation.matrix()), unit * np.asarray(first.translation))

    # --- images -------------------------------------------------------------------------------------------------

    def take_known(self, source: str | Path | None, report: Progress) -> None:
        """Read the images of the result that are matched with the new ones."""
        rows = [row for row, frame in enumerate(self._frames) if frame.registered]
        if not self._base.options.get("unordered") and len(rows) > _MOST_OF_A_SHOT:
            rows = [rows[k] for k in np.linspace(0, len(rows) - 1, _MOST_OF_A_SHOT).astype(int)]
        wanted = {row: self._frames[row] for row in rows}
        report("images of the result", 0, len(rows))
        main = source or self._base.options.get("source")
        if main is None or not Path(str(main)).exists():
            raise InputError(f"the images of the result are not at {main} any more; say where they are (source)")
        for part in image_sources(Path(str(main)), self._base.options):
            self._read_known(part, {row: frame for row, frame in wanted.items() if part.holds(frame.index)})
        if missing := set(rows) - {view.position for view in self._known} - self._absent:
            name = self._frames[min(missing)].name
            raise InputError(f"the image {name} of the result is not in its source; say where it is now (source)")

    def _read_known(self, source: ImageSource, wanted: dict[int, FrameResult]) -> None:
        path = source.path
        if path is None:
            self._absent.update(wanted)
        if path is None or not wanted:
            return
        by_name = {frame.name: row for row, frame in wanted.items()}
        by_index = {frame.index - source.first: row for row, frame in wanted.items()}
        folder, fields = path.is_dir(), fields_of(self._base.options)
        for image in read_images(path) if folder else read_frames(path, slice(0, max(by_index) + 1), fields=fields):
            row = by_name.get(image.name) if folder else by_index.get(image.index)
            if row is not None and isinstance(image, Frame):
                if self._misfit(image):
                    self._absent.add(row)
                else:
                    self._known.append(self._view(image, self._frames[row], row))

    def take_new(
        self, images: str | Path | Iterable[Frame | NDArray[np.uint8]], frames: slice | None, report: Progress
    ) -> None:
        """Read the images to add."""
        used = {frame.index for frame in self._frames}
        row_of = {(frame.index, frame.name): row for row, frame in enumerate(self._frames)}
        names = {frame.name for frame in self._frames if frame.registered}
        main = self._base.options.get("source")
        path = Path(images) if isinstance(images, str | Path) else None
        own = path is not None and main is not None and path.resolve() == Path(str(main)).resolve()
        first = 0 if own else max(used) + 1
        numbered = own and not self._base.options.get("unordered")
        for image in read_images(images, frames, numbered=numbered, fields=fields_of(self._base.options)):
            report("new images", len(self._new), None)
            index = first + image.index
            row = row_of.get((index, image.name))
            if own and row is not None and self._frames[row].registered:
                continue
            name = image.name if path is None or path.is_dir() or own else f"{path.stem}/{image.name}"
            check_name(name)
            if name in names or (row is None and index in used):
                raise InputError(f"the result has an image {name} with the index {index} already; give it another name")
            frame = FrameResult(index, name, getattr(image, "timestamp", None), FrameStatus.WAITING, "")
            if row is None:
                self._frames.append(frame)
                row = len(self._frames) - 1
            else:
                self._frames[row] = frame
            if not isinstance(image, Frame):
                frame.status, frame.message = FrameStatus.UNUSABLE, image.reason
                continue
            if reason := self._misfit(image):
                frame.status, frame.message = FrameStatus.UNUSABLE, reason
                continue
            self._new.append(self._view(image, frame, row))
        if not self._new:
            unusable = [f for f in self._frames[len(self._base.frames) :] if f.status is FrameStatus.UNUSABLE]
            why = f": {unusable[-1].name} is unusable, {unusable[-1].message}" if unusable else ""
            where = images if path is not None else "the sequence of images"
            raise InputError(f"there is no image to add in {where}{why}")
        if not own:
            self._added.append(AddedImages(None if path is None else str(path.absolute()), first))

    def _misfit(self, image: Frame) -> str:
        """Why an image cannot be from the result's camera; empty if it can."""
        (height, width), camera = image.image.shape[:2], self._base.camera
        if abs(width * camera.height / (height * camera.width) - 1.0) < _SAME_ASPECT:
            return ""
        return f"{width}x{height} pixels, another format than {camera.width}x{camera.height} of the camera"

    def _view(self, image: Frame, frame: FrameResult, position: int) -> MatchedImage:
        file = f"{position:06d}-{pixel_digest(image.image)}.png"
        write_once(self._folder / "images" / file, image.image)
        none = np.zeros((0, 2))
        size = image.image.shape[1], image.image.shape[0]
        return MatchedImage(frame, position, file, size, np.zeros(0, np.int64), none, np.zeros((0, 3), np.uint8))

    # --- steps --------------------------------------------------------------------------------------------------

    def run(self, report: Progress) -> Reconstruction:
        """Match, register and adjust."""
        report("matching", 0, None)
        views = [*self._known, *self._new]
        tracks = self._match(views)
        report("mapping", 0, None)
        first = len(self._known)
        mapper = SetMapper(tracks, self._base.camera.mean_focal_length(), Options().for_image_sets())
        known = [view.frame.cam_from_world for view in self._known]
        mapper.extend({k: local_pose(pose, self._local) for k, pose in enumerate(known) if pose is not None})
        for view, image in zip(self._new, mapper.images[first:], strict=True):
            view.frame.status, view.frame.message = image.status, image.message
            view.frame.observations = len(image.tracks.ids)
        registered = [view for view in self._new if view.frame.status is FrameStatus.REGISTERED]
        if not registered:
            worst = self._new[0].frame
            reason = f"none of {len(self._new)} new images registered; {worst.name}: {worst.message}"
            raise ReconstructionError(reason, self._frames)
        report("adjustment", 0, None)
        result = extended(self._base, self._frames, views, mapper, self._local, refine=self._refine)
        result.options = {**self._base.options, "added": [asdict(part) for part in self._added]}
        result.notes.append(f"{len(registered)} of {len(self._new)} further images were registered on the result.")
        if self._base.measured is not None:  # that is of the frames of a shot, and the points are others now
            result.notes.append(_NO_TRACKS)
        for view in self._new:
            if view not in registered:
                result.notes.append(f"{view.frame.name} could not be registered: {view.frame.message}.")
        return _in_order(result)

    def _match(self, views: list[MatchedImage]) -> list[ImageTracks]:
        """Tracks of all images; their pixels and colours are left in the views."""
        camera = self._base.camera
        cameras = []
        for view in views:
            own = pycolmap.Camera(camera.todict())
            own.rescale(*view.size)
            cameras.append(own)
        names = [view.file for view in views]
        matches = match_images(self._folder / "matches.db", self._folder / "images", names, cameras)
        joined = tracks_from_matches(matches.keypoints, matches.pairs)
        tracks = []
        for k, (view, keypoints, (ids, rows)) in enumerate(zip(views, matches.keypoints, joined, strict=True)):
            scale = np.array([camera.width, camera.height]) / view.size
            seen = ImageTracks(k, ids, (keypoints[rows] + PIXEL_CENTER) * scale - PIXEL_CENTER, camera)
            good = seen.invertible
            tracks.append(seen.of(good))
            view.ids, view.xy = tracks[-1].ids, tracks[-1].pixels
            image = np.asarray(cv2.imread(str(self._folder / "images" / view.file)), np.uint8)
            x, y = np.clip(np.rint(keypoints[rows][good]).astype(int), 0, np.array(view.size) - 1).T
            view.rgb = image[y, x][:, ::-1]
        return tracks


def _in_order(result: Reconstruction) -> Reconstruction:
    """The frames in the order of their indices, as tools expect them: those of the own source may come in between."""
    order = np.argsort([frame.index for frame in result.frames], kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return replace(result, frames=[result.frames[k] for k in order], observation_frame=rank[result.observation_frame])
