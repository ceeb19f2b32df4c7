"""Unordered photographs in, a reconstruction out: the counterpart of `Stream` for image sets."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.guess import first_focal_std, guess_camera
from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.control.known import Control
from factorsfm.control.located import LocatedControl, locate
from factorsfm.frames.frame import Frame, bgr_image
from factorsfm.imagesets.cameras import add_lenses, describe_cameras, find_cameras, resized
from factorsfm.imagesets.mapper import SetMapper
from factorsfm.imagesets.parts import map_parts
from factorsfm.imagesets.photo_folder import Photo, PhotoFolder
from factorsfm.imagesets.photo_results import add_twins, explain_missing, photo_notes
from factorsfm.lens.camera_model import distortion_of
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.polish.polish import polish
from factorsfm.polish.shot import Shot
from factorsfm.priors.depth import DepthPrior
from factorsfm.priors.masks import MaskPrior
from factorsfm.priors.read_priors import read_depth, read_mask
from factorsfm.result.assembly import assemble
from factorsfm.result.reconstruction import FrameResult, Reconstruction
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.options import Options
from factorsfm.support.progress import Progress
from factorsfm.support.stages import StageSeconds
from factorsfm.support.status import FrameStatus
from factorsfm.support.threads import OneThreadEach
from factorsfm.tracks.image_tracks import ImageTracks
from factorsfm.tracks.learned import LearnedFeatures
from factorsfm.tracks.match_tracks import tracks_from_matches
from factorsfm.tracks.matches import match_images

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

_LEAST_KEYPOINTS = 30
_WIDE_PARALLAX = 0.3  # of a map that determines the principal point of an unknown lens


class ImageSet:
    """Reconstruction of an unordered set of photographs.

    Images of another size but the same aspect ratio count as scaled, upright ones in a set of landscape format (or the
    reverse) are turned; images with another aspect ratio, or with another focal length in their EXIF data, come from a
    camera of their own (`imagesets.cameras`).

    Args:
        folder: working copies, features and matches lie here; a second run with the same images goes on from them.
        camera: the lens of its format; None takes the focal length from the EXIF data or a guess, and refines it.
            Focal lengths are refined by a common factor; where the parallax is large, also the principal point.
        depth: prior, or None.
        masks: what to ignore, or None.
        features: "sift"; the name of learned ones, see `tracks.learned.FEATURES`; or a folder with their networks.
        options: see `Options`; None is the default preset.
        control: what is known beforehand of poses and points, for the largest part of a set that falls apart; pixels
            are those of the images themselves.

    Raises:
        ModelError: the networks of the features are not there.
    """

    def __init__(
        self,
        folder: Path,
        camera: pycolmap.Camera | None = None,
        *,
        depth: DepthPrior | None = None,
        masks: MaskPrior | None = None,
        features: str | Path = "sift",
        options: Options | None = None,
        control: Control | None = None,
    ) -> None:
        self.camera = camera
        self._lens_given = camera is not None
        self.control = control
        options = options or Options()
        self._lens_is_open = camera is None and options.lens == "auto"
        if camera is None:
            options = options.for_unknown_lens()
        self.options = options.for_image_sets()
        self.photos: list[Photo] = []
        self.seconds = StageSeconds()
        self.notes: list[str] = []
        self._depth = depth if options.uses_depth else None
        self._masks = masks
        self._features = None if str(features) == "sift" else LearnedFeatures(features)
        self._database = folder / ("matches.db" if self._features is None else f"matches-{self._features.name}.db")
        self._files = PhotoFolder(folder, masked=masks is not None)
        self._cameras: list[pycolmap.Camera] = []  # of the images at full size, that of the map's pixels first

    def add(self, frame: Frame) -> None:
        """Take an image.

        Raises:
            InputError: it is no image, or a mask fails on it; the set can go on with other images.
        """
        image = bgr_image(frame.image, frame.index)
        with self.seconds.of("masks"):
            mask = read_mask(self._masks, frame)
        with self.seconds.of("reading"):
            photo = self._files.keep(frame, image, mask, len(self.photos))
            self.photos.append(photo)
            if frame.path is not None:
                guess = guess_camera(*photo.full_size, frame.path)
                if guess.has_prior_focal_length:
                    photo.focal_ratio = guess.focal_length / max(photo.full_size)

    def note(self, sentence: str) -> None:
        """Take note of something that a user should read in the result."""
        logger.warning("%s", sentence)
        self.notes.append(sentence)

    def leave_out(self, index: int, name: str, reason: str) -> None:
        """Take note of an image that cannot be used."""
        logger.warning("%s is left out: %s", name, reason)
        self.photos.append(Photo(index, name, None, left_out=reason))

    def finish(self, progress: Progress | None = None) -> Reconstruction:
        """Match, map and polish.

        Raises:
            InputError: the camera is made for images of another format than any of these, or the control names an
                image that is not there.
            ReconstructionError: fewer than two images can be used or registered.
        """
        report: Progress = progress or (lambda stage, done, total: None)
        camera = self._find_cameras()
        control = self._located_control()
        used = [k for k, photo in enumerate(self.photos) if not photo.left_out and photo.twin is None]
        if len(used) < 2:
            raise self._failure(f"{len(used)} of {len(self.photos)} images can be used, at least 2 needed", [])
        report("matching", 0, None)
        tracks = self._match(used)
        colors = self._look_up(used, tracks, report)
        report("mapping", 0, None)
        focal = 0.5 * (camera.focal_length_x + camera.focal_length_y)
        with self.seconds.of("mapping"), OneThreadEach():
            parts = map_parts(tracks, focal, self.options)
        explain_missing(parts, self.photos)
        if parts[0].registered < 2:
            images = parts[0].images
            worst = next(k for k in used if not images[k].registered)
            raise self._failure(
                f"{parts[0].registered} of {len(self.photos)} images registered, at least 2 needed; "
                f"{self.photos[worst].name}: {images[worst].message}",
                images,
            )
        result = self._solve(parts[0], camera, colors, report, control)
        result.others = [self._solve(part, camera, colors, report, None) for part in parts[1:]]
        for number, part in enumerate((result, *result.others), 1):
            part.notes += self.notes + photo_notes(part, self.photos, number, parts)
            part.seconds = dict(self.seconds)
        return result

    # --- cameras ------------------------------------------------------------------------------------------------

    def _find_cameras(self) -> pycolmap.Camera:
        """The first camera at the size of its working copies; its pixels are those of the map's errors."""
        photos = [photo for photo in self.photos if not photo.left_out and photo.twin is None]
        if not photos:
            raise self._failure("there is no image that can be read", [])
        self._cameras = find_cameras(photos, self._files, self.camera)
        if sentence := describe_cameras(self._cameras, photos, self.camera is not None):
            self.note(sentence)
        for photo in self.photos:
            if photo.twin is not None:
                photo.camera = self.photos[photo.twin].camera
        sizes = Counter(photo.size for photo in photos if photo.camera == 0)
        return resized(self._cameras[0], sizes.most_common(1)[0][0])

    def _located_control(self) -> LocatedControl | None:
        """The control, its marks in pixels of the cameras at full size."""

        def in_camera(position: int, xy: Array) -> tuple[pycolmap.Camera, Array]:
            photo = self.photos[position]
            if photo.left_out or photo.file.endswith("-turned.png"):
                raise InputError(f"control: points are marked in {photo.name}, {photo.left_out or photo.remark}")
            own = self._cameras[photo.camera]
            factor = np.array([own.width, own.height]) / photo.full_size
            return own, (xy + PIXEL_CENTER) * factor - PIXEL_CENTER

        return None if self.control is None else locate(self.control, self.photos, in_camera)

    # --- steps --------------------------------------------------------------------------------------------------

    def _match(self, used: list[int]) -> list[ImageTracks]:
        """Tracks of all images, in pixels of their cameras at full size."""
        cameras = [resized(self._cameras[self.photos[k].camera], self.photos[k].size) for k in used]
        names = [self.photos[k].file for k in used]
        with self.seconds.of("matching"):
            matches = match_images(
                self._database, self._files.images, names, cameras, self._files.masks, self._features
            )
            joined = tracks_from_matches(matches.keypoints, matches.pairs)
        none = np.zeros(0, np.int64), np.zeros((0, 2))
        tracks = [ImageTracks(k, *none, self._cameras[photo.camera]) for k, photo in enumerate(self.photos)]
        for k, keypoints, (ids, rows) in zip(used, matches.keypoints, joined, strict=True):
            if len(keypoints) < _LEAST_KEYPOINTS:
                self.photos[k].remark = f"{len(keypoints)} of {_LEAST_KEYPOINTS} needed keypoints: hardly any texture"
            camera = self._cameras[self.photos[k].camera]
            scale = np.array([camera.width, camera.height]) / self.photos[k].size
            seen = ImageTracks(k, ids, (keypoints[rows] + PIXEL_CENTER) * scale - PIXEL_CENTER, camera)
            tracks[k] = seen.of(seen.invertible)
        return tracks

    def _look_up(self, used: list[int], tracks: list[ImageTracks], progress: Progress) -> NDArray[np.uint8]:
        """Depth of the tracks, in place, and their colours (RGB by track id)."""
        count = max((int(t.ids[-1]) + 1 for t in tracks if len(t.ids)), default=0)
        colors = np.zeros((count, 3), np.uint8)
        for done, k in enumerate(used):
            progress("depth", done, len(used))
            photo = self.photos[k]
            image = self._files.read(photo)
            full = self._cameras[photo.camera]
            scale = np.array(photo.size) / [full.width, full.height]
            xy = (tracks[k].pixels + PIXEL_CENTER) * scale - PIXEL_CENTER
            x, y = np.clip(np.rint(xy).astype(int), 0, np.array(photo.size) - 1).T
            colors[tracks[k].ids] = image[y, x][:, ::-1]
            if self._depth is not None and len(xy):
                with self.seconds.of("depth"):
                    frame = Frame(photo.index, image, photo.name, photo.timestamp)
                    tracks[k] = replace(tracks[k], depth=read_depth(self._depth, frame, xy))
        return colors

    def _solve(
        self,
        part: SetMapper,
        camera: pycolmap.Camera,
        colors: NDArray[np.uint8],
        progress: Progress,
        control: LocatedControl | None,
    ) -> Reconstruction:
        """The polished result of a map; cameras that are far apart determine the principal point of a lens, too."""
        options = self.options
        if self._lens_is_open and part.parallax > _WIDE_PARALLAX:
            options = replace(options, lens="all")
        shot = Shot.of(
            part.images,
            part.points.all(),
            np.array([part.focal]),
            shape=distortion_of(camera) if options.estimates_lens else None,
            first_focal=(np.array([part.first_focal]), first_focal_std(camera, given=self._lens_given)),
        )
        with self.seconds.of("polish"), OneThreadEach():
            try:
                polished = polish(shot, options, lambda stage: progress(stage, 0, None), control=control)
            except ReconstructionError as error:
                raise self._failure(str(error), part.images) from error
        result = assemble(
            polished,
            part.images,
            self.photos,
            colors,
            camera,
            lens_given=self._lens_given,
            depth_kind=None if self._depth is None else self._depth.kind,
            seconds={},
            options=options.to_dict(),
        )
        found = polished.lens.lens if polished.lens is not None and self.camera is None else None
        add_lenses(result, self.photos, self._cameras, camera, found)
        add_twins(result, self.photos)
        return result

    def _failure(self, message: str, images: list[MappedImage]) -> ReconstructionError:
        frames = []
        for k, photo in enumerate(self.photos):
            status, reason = (FrameStatus.UNUSABLE, photo.left_out) if photo.left_out else (FrameStatus.WAITING, "")
            if images and not photo.left_out:
                status, reason = images[k].status, images[k].message
            frames.append(FrameResult(photo.index, photo.name, photo.timestamp, status, reason))
        return ReconstructionError(message, frames)
