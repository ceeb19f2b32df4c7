"""Unordered photographs in, a reconstruction out: the counterpart of `stream` for image sets."""

from __future__ import annotations

import logging
import time
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera import PIXEL_CENTER, guess_camera, lens_shape, normalized_from_pixels
from factorsfm.control import Control, LocatedControl, locate
from factorsfm.errors import InputError, ReconstructionError
from factorsfm.frames import Frame, bgr_image
from factorsfm.images import ImageTracks, MappedImage
from factorsfm.options import Options
from factorsfm.polish import polish
from factorsfm.priors.depth import DepthKind, DepthPrior
from factorsfm.priors.masks import MaskPrior
from factorsfm.reading import read_depth, read_mask
from factorsfm.reconstruction import FrameResult, FrameStatus, Reconstruction
from factorsfm.result import assemble
from factorsfm.set_mapper import SetMapper
from factorsfm.threads import OneThreadEach
from factorsfm.tracks.matches import join_tracks, match_images

Array = NDArray[np.float64]
Progress = Callable[[str, int, int | None], None]

logger = logging.getLogger(__name__)

MAX_SIDE = 3200  # pixels; larger images are matched and reconstructed at this size
_SAME_ASPECT = 0.01
_LEAST_KEYPOINTS = 30


@dataclass(slots=True)
class Photo:
    """What is kept of an image: never its pixels.

    Attributes:
        index, name, timestamp: see `Frame`.
        file: its copy in the work folder, empty where the image is left out; size: (width, height) of the copy.
        full_size: (width, height) of the image itself.
        left_out: why it takes no part, empty where it does; twin: position of an earlier image with the same pixels.
        remark: what a user should know of it.
    """

    index: int
    name: str
    timestamp: float | None
    file: str = ""
    size: tuple[int, int] = (0, 0)
    full_size: tuple[int, int] = (0, 0)
    left_out: str = ""
    twin: int | None = None
    remark: str = ""


class ImageSet:
    """Reconstruction of an unordered set of photographs from one camera.

    Images of another size but the same aspect ratio count as scaled, upright ones in a set of landscape format (or the
    reverse) are turned; images with another aspect ratio are left out, since the set has one lens.

    Args:
        folder: working copies, features and matches lie here; a second run with the same images goes on from them.
        camera: the lens; None takes the focal length from the EXIF data or a guess, and refines it.
        depth: prior, or None.
        masks: what to ignore, or None.
        options: see `Options`; None is the default preset.
        control: what is known beforehand of poses and points; pixels are those of the images themselves.
    """

    def __init__(
        self,
        folder: Path,
        camera: pycolmap.Camera | None = None,
        *,
        depth: DepthPrior | None = None,
        masks: MaskPrior | None = None,
        options: Options | None = None,
        control: Control | None = None,
    ) -> None:
        self.camera = camera
        self._lens_given = camera is not None
        self.control = control
        options = options or Options()
        if camera is None:
            options = options.for_unknown_lens()
        self.options = _for_image_sets(options)
        self.photos: list[Photo] = []
        self.seconds: dict[str, float] = defaultdict(float)
        self.notes: list[str] = []
        self._depth = depth if options.uses_depth else None
        self._masks = masks
        self._folder = folder
        self._focal_ratios: list[float] = []
        self._known: dict[str, int] = {}
        (folder / "images").mkdir(parents=True, exist_ok=True)

    def add(self, frame: Frame) -> None:
        """Take an image.

        Raises:
            InputError: it is no image, or a mask fails on it; the set can go on with other images.
        """
        image = bgr_image(frame.image, frame.index)
        with self._timed("masks"):
            mask = read_mask(self._masks, frame)
        with self._timed("reading"):
            height, width = image.shape[:2]
            photo = Photo(frame.index, frame.name, frame.timestamp, full_size=(width, height))
            image, mask = _bounded(image, mask)
            if max(width, height) > MAX_SIDE:
                photo.remark = f"reduced from {width}x{height} to {image.shape[1]}x{image.shape[0]} pixels"
                logger.warning("%s is %s", frame.name, photo.remark)
            checksum = zlib.crc32(image.tobytes() + (b"" if mask is None else mask.tobytes()))
            key = f"{checksum:08x}-{image.shape[1]}x{image.shape[0]}"
            photo.file, photo.size = f"{frame.index:06d}-{key}.png", (image.shape[1], image.shape[0])
            photo.twin = self._known.setdefault(key, len(self.photos))
            if photo.twin == len(self.photos):
                photo.twin = None
                _write_once(self._folder / "images" / photo.file, image)
                if self._masks is not None:
                    ignored = np.zeros(image.shape[:2], bool) if mask is None else mask
                    _write_once(
                        self._folder / "masks" / f"{photo.file}.png", np.where(ignored, 0, 255).astype(np.uint8)
                    )
            self.photos.append(photo)
            if self.camera is None and frame.path is not None:
                guess = guess_camera(width, height, frame.path)
                if guess.has_prior_focal_length:
                    self._focal_ratios.append(guess.focal_length / max(width, height))

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
            InputError: the camera is made for images of another format, or the control names an image that is not
                there.
            ReconstructionError: fewer than two images can be used or registered.
        """
        report: Progress = progress or (lambda stage, done, total: None)
        camera = self._fit_together()
        control = self._located_control()
        used = [k for k, photo in enumerate(self.photos) if not photo.left_out and photo.twin is None]
        if len(used) < 2:
            raise self._failure(f"{len(used)} of {len(self.photos)} images can be used, at least 2 needed", [])
        report("matching", 0, None)
        tracks, pixels = self._match(used, camera)
        colors = self._look_up(used, tracks, pixels, report)
        report("mapping", 0, None)
        focal = 0.5 * (camera.focal_length_x + camera.focal_length_y)
        mapper = SetMapper(tracks, focal, self.options)
        with self._timed("mapping"), OneThreadEach():
            mapper.run()
        self._explain(mapper.images)
        registered = sum(image.registered for image in mapper.images)
        if registered < 2:
            worst = next(k for k in used if not mapper.images[k].registered)
            raise self._failure(
                f"{registered} of {len(self.photos)} images registered, at least 2 needed; "
                f"{self.photos[worst].name}: {mapper.images[worst].message}",
                mapper.images,
            )
        with self._timed("polish"), OneThreadEach():
            try:
                polished = polish(
                    mapper.images,
                    mapper.points.all(),
                    np.array([mapper.focal]),
                    self.options,
                    lambda stage: report(stage, 0, None),
                    lens_shape(camera) if self.options.refine_focal_length else None,
                    control=control and _scaled(control, focal / mapper.focal),
                )
            except ReconstructionError as error:
                raise self._failure(str(error), mapper.images) from error
        result = assemble(
            polished,
            mapper.images,
            self.photos,
            pixels,
            colors,
            camera,
            lens_given=self._lens_given,
            prior_given=self._depth is not None,
            metric=self._depth is not None and self._depth.kind is DepthKind.METRIC,
            seconds=dict(self.seconds),
            options=self.options.to_dict(),
        )
        self._at_full_size(result)
        self._add_twins(result)
        result.notes.extend(self._summary(result))
        return result

    # --- one camera ---------------------------------------------------------------------------------------------

    def _fit_together(self) -> pycolmap.Camera:
        """The camera of the working copies; images of another format are turned or left out."""
        photos = [photo for photo in self.photos if not photo.left_out]
        if not photos:
            raise self._failure("there is no image that can be read", [])
        if self.camera is None:
            width, height = Counter(photo.full_size for photo in photos).most_common(1)[0][0]
            self.camera = guess_camera(width, height)
            if self._focal_ratios:
                self.camera.focal_length = float(np.median(self._focal_ratios)) * max(width, height)
                self.camera.has_prior_focal_length = True
        full = (int(self.camera.width), int(self.camera.height))
        for photo in photos:
            if not _same_format(photo.full_size, full) and not _same_format(photo.full_size[::-1], full):
                photo.left_out = f"{_text(photo.full_size)} pixels, another format than {_text(full)} of the camera"
                logger.warning("%s is left out: %s", photo.name, photo.left_out)
            elif not _same_format(photo.full_size, full):
                self._turn(photo)
        fitting = [photo for photo in photos if not photo.left_out]
        if not fitting:
            raise InputError(
                f"the camera is made for {_text(full)} pixels, but none of the {len(photos)} images has this format"
            )
        camera = pycolmap.Camera(self.camera.todict())
        width, height = Counter(photo.size for photo in fitting).most_common(1)[0][0]
        camera.rescale(width, height)
        return camera

    def _turn(self, photo: Photo) -> None:
        """Turn the working copy by 90 degrees."""
        folder, turned = self._folder, photo.file.replace(".png", "-turned.png")
        image = cv2.imread(str(folder / "images" / photo.file))
        _write_once(folder / "images" / turned, cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE))
        mask = folder / "masks" / f"{photo.file}.png"
        if mask.exists():
            sideways = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
            _write_once(folder / "masks" / f"{turned}.png", cv2.rotate(sideways, cv2.ROTATE_90_COUNTERCLOCKWISE))
        photo.remark = "turned left by 90 degrees to the format of the others; its pose is that of the turned image"
        logger.warning("%s is %s", photo.name, photo.remark)
        photo.file, photo.size, photo.full_size = turned, photo.size[::-1], photo.full_size[::-1]

    def _located_control(self) -> LocatedControl | None:
        """The control, its marks normalised by the camera of the set."""

        def normalized(position: int, xy: Array) -> Array:
            photo = self.photos[position]
            if photo.left_out or photo.file.endswith("-turned.png"):
                raise InputError(f"control: points are marked in {photo.name}, {photo.left_out or photo.remark}")
            assert self.camera is not None
            factor = np.array([self.camera.width, self.camera.height]) / photo.full_size
            return normalized_from_pixels(self.camera, (xy + PIXEL_CENTER) * factor - PIXEL_CENTER)

        return None if self.control is None else locate(self.control, self.photos, normalized)

    # --- steps --------------------------------------------------------------------------------------------------

    def _match(self, used: list[int], camera: pycolmap.Camera) -> tuple[list[ImageTracks], list[Array]]:
        """Tracks of all images, normalised, and their pixels as `camera` sees them."""
        cameras = []
        for k in used:
            own = pycolmap.Camera(camera.todict())
            own.rescale(*self.photos[k].size)
            cameras.append(own)
        names = [self.photos[k].file for k in used]
        masks = self._folder / "masks" if self._masks is not None else None
        with self._timed("matching"):
            matches = match_images(self._folder / "matches.db", self._folder / "images", names, cameras, masks)
            joined = join_tracks(matches.keypoints, matches.pairs)
        none = np.zeros(0, np.int64), np.zeros((0, 2))
        tracks = [ImageTracks(k, *none) for k in range(len(self.photos))]
        pixels = [np.zeros((0, 2))] * len(self.photos)
        for k, own, keypoints, (ids, rows) in zip(used, cameras, matches.keypoints, joined, strict=True):
            if len(keypoints) < _LEAST_KEYPOINTS:
                self.photos[k].remark = f"{len(keypoints)} of {_LEAST_KEYPOINTS} needed keypoints: hardly any texture"
            xy = np.asarray(own.cam_from_img(keypoints[rows] + PIXEL_CENTER), np.float64).reshape(-1, 2)
            good = np.isfinite(xy).all(axis=1)
            scale = np.array([camera.width, camera.height]) / self.photos[k].size
            tracks[k] = ImageTracks(k, ids[good], xy[good])
            pixels[k] = (keypoints[rows][good] + PIXEL_CENTER) * scale - PIXEL_CENTER
        return tracks, pixels

    def _look_up(
        self, used: list[int], tracks: list[ImageTracks], pixels: list[Array], progress: Progress
    ) -> NDArray[np.uint8]:
        """Depth of the tracks, in place, and their colours (RGB by track id)."""
        count = max((int(t.ids[-1]) + 1 for t in tracks if len(t.ids)), default=0)
        colors = np.zeros((count, 3), np.uint8)
        size = Counter(self.photos[k].size for k in used).most_common(1)[0][0]
        for done, k in enumerate(used):
            progress("depth", done, len(used))
            photo = self.photos[k]
            image = np.asarray(cv2.imread(str(self._folder / "images" / photo.file)), np.uint8)
            scale = np.array(photo.size) / size
            xy = (pixels[k] + PIXEL_CENTER) * scale - PIXEL_CENTER
            x, y = np.clip(np.rint(xy).astype(int), 0, np.array(photo.size) - 1).T
            colors[tracks[k].ids] = image[y, x][:, ::-1]
            if self._depth is not None and len(xy):
                with self._timed("depth"):
                    frame = Frame(photo.index, image, photo.name, photo.timestamp)
                    tracks[k] = replace(tracks[k], depth=read_depth(self._depth, frame, xy))
        return colors

    # --- the report ---------------------------------------------------------------------------------------------

    def _explain(self, images: list[MappedImage]) -> None:
        for photo, image in zip(self.photos, images, strict=True):
            if photo.left_out:
                image.status, image.message = FrameStatus.UNUSABLE, photo.left_out
            elif photo.remark and not image.registered:
                blank = "keypoints" in photo.remark
                image.status = FrameStatus.BLANK if blank else image.status
                image.message = photo.remark if blank else f"{image.message}; {photo.remark}"

    def _add_twins(self, result: Reconstruction) -> None:
        """An image with the pixels of another one has its pose."""
        for photo, frame in zip(self.photos, result.frames, strict=True):
            if photo.twin is not None and not photo.left_out:
                twin = result.frames[photo.twin]
                frame.status, frame.cam_from_world = twin.status, twin.cam_from_world
                frame.covariance, frame.observability = twin.covariance, twin.observability
                frame.message = f"the same image as {twin.name}, whose pose it has"
            elif photo.remark and frame.registered:
                frame.message += f"; {photo.remark}"

    def _at_full_size(self, result: Reconstruction) -> None:
        """The result speaks of the images' own pixels, not of those of the working copies."""
        assert self.camera is not None
        factor = self.camera.width / result.camera.width
        if factor != 1.0:
            result.camera.rescale(int(self.camera.width), int(self.camera.height))
            result.observation_xy = (result.observation_xy + PIXEL_CENTER) * factor - PIXEL_CENTER
            result.observation_error = result.observation_error * factor
            for frame in result.frames:
                frame.reprojection_error *= factor
                if frame.observability is not None:
                    slide = frame.observability.pixel_slide * factor
                    frame.observability = replace(frame.observability, pixel_slide=slide)

    def _summary(self, result: Reconstruction) -> list[str]:
        notes = [f"{photo.name}: {photo.left_out}." for photo in self.photos if photo.left_out]
        notes += [f"{photo.name}: {photo.remark}." for photo in self.photos if photo.remark]
        missing = [f for f, p in zip(result.frames, self.photos, strict=True) if not f.registered and not p.left_out]
        if missing:
            some = "; ".join(f"{frame.name}: {frame.message}" for frame in missing[:3])
            notes.append(f"{len(missing)} of {len(result.frames)} images could not be registered ({some}).")
        twins = [photo for photo in self.photos if photo.twin is not None and not photo.left_out]
        if twins:
            notes.append(f"{len(twins)} images repeat others, the first one is {twins[0].name}.")
        return self.notes + notes

    def _failure(self, message: str, images: list[MappedImage]) -> ReconstructionError:
        frames = []
        for k, photo in enumerate(self.photos):
            status, reason = (FrameStatus.UNUSABLE, photo.left_out) if photo.left_out else (FrameStatus.WAITING, "")
            if images and not photo.left_out:
                status, reason = images[k].status, images[k].message
            frames.append(FrameResult(photo.index, photo.name, photo.timestamp, status, reason))
        return ReconstructionError(message, frames)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] += time.perf_counter() - start


def _for_image_sets(options: Options) -> Options:
    """Two views make a track, wrong matches are single observations, and keypoints are less exact than tracks."""
    return replace(
        options,
        polish=replace(
            options.polish, min_track_length=2, final_iterations=20, observation_sigmas=12.0, doubtful_px=0.6
        ),
    )


def _scaled(control: LocatedControl, ratio: float) -> LocatedControl:
    """What was marked with another focal length; `ratio`: the former one over the new one."""
    return replace(control, marks=replace(control.marks, xy=control.marks.xy * ratio))


def _bounded(
    image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    height, width = image.shape[:2]
    factor = MAX_SIDE / max(width, height)
    if factor >= 1.0:
        return image, mask
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    reduced = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    if mask is None:
        return reduced, None
    return reduced, cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _write_once(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a file that is complete or absent."""
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished.png")
    if not cv2.imwrite(str(unfinished), image, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
        raise InputError(f"cannot write to the work folder {path.parent}")
    unfinished.replace(path)


def _same_format(size: tuple[int, int], other: tuple[int, int]) -> bool:
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1.0) < _SAME_ASPECT


def _text(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
