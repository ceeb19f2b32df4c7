"""What is polished: the images, their tracks, and the first guess of their lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from factorsfm.adjustment.gather import gather
from factorsfm.adjustment.observations import Observations
from factorsfm.camera.projection import without_distortion
from factorsfm.lens.lens import Lens
from factorsfm.lens.rolling_shutter import Recording, with_sweep
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.support.options import MapperOptions
from factorsfm.tracks.image_tracks import ImageTracks, seen_by
from factorsfm.tracks.supervised import LEAST_SUPERVISED, SupervisedTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Shot:
    """The images of a shot or a set, and what the incremental map says of them.

    Attributes:
        images: all of them, registered or not.
        map_points: track ids and positions of the incremental map.
        guess: of the lens; its shape is zero where the lens is not estimated.
        group: (images,) which of its focal lengths is that of each image.
        first_focal: see `estimate_lens`.
        recording: of which the images are all, None if their rows were all read at once.
        suspects: ids (ascending) of the tracks that take part only where they agree with the others.
        supervised: tracks that take part whatever the others say.
        solved_lens: see `MeasuredShot`.
        seconds: (images,) when they were recorded, None: in no order of time.
    """

    images: list[MappedImage]
    map_points: tuple[Index, Array]
    guess: Lens
    group: Index
    first_focal: tuple[Array, float] | None
    recording: Recording | None
    suspects: Index
    supervised: SupervisedTracks
    solved_lens: Lens | None
    seconds: Array | None

    @classmethod
    def of(
        cls,
        images: list[MappedImage],
        map_points: tuple[Index, Array],
        focal: Array,
        *,
        shape: Array | None = None,
        groups: Index | None = None,
        first_focal: tuple[Array, float] | None = None,
        recording: Recording | None = None,
        suspects: Index | None = None,
        supervised: SupervisedTracks | None = None,
        solved_lens: Lens | None = None,
        seconds: Array | None = None,
    ) -> Shot:
        """A shot whose lens is estimated where a shape is given: its tracks keep their distorted pixels then.

        Args:
            images: at least one registered; map_points: track ids and positions of the incremental map.
            focal: (g,) focal lengths, pixels; first guesses where the options refine them.
            shape: (4,) distortion of the lens as in `residuals.distort` where the options refine the lens; None: the
                cameras of the images know their distortion.
            groups: (images,) which of the focal lengths is that of each image; None: all have the first.
            first_focal: the focal lengths as they were known first, as in `estimate_lens`; None: `focal`.
            recording: of which the images are all, if their rows may have been read one after another; None: all at
                once, or in no order of time.
            suspects, supervised, solved_lens: see `MeasuredShot`; None: none.
            seconds: (images,) when they were recorded, one after another; None: in no order of time.
        """
        guess = Lens(focal)
        if shape is not None:
            guess = Lens(focal, np.r_[shape, np.zeros(2)])
            images = [replace(image, tracks=_distorted(image.tracks)) for image in images]
        group = np.zeros(len(images), np.int64) if groups is None else groups
        suspects = np.zeros(0, np.int64) if suspects is None else suspects
        supervised = supervised or SupervisedTracks.none()
        return cls(images, map_points, guess, group, first_focal, recording, suspects, supervised, solved_lens, seconds)

    @property
    def in_time(self) -> bool:
        """Whether the images were recorded one after another, so that a lens may have zoomed over them."""
        return self.seconds is not None

    @property
    def registered(self) -> list[int]:
        """Positions of the registered images."""
        return [position for position, image in enumerate(self.images) if image.registered]

    def tracks(self, frames: Sequence[int]) -> list[ImageTracks]:
        """Those of some images."""
        return [self.images[position].tracks for position in frames]

    def turns(self, frames: Sequence[int]) -> Array:
        """(k, 3, 3) rotations of some registered images in the map."""
        return np.array([self.images[position].pose[0] for position in frames])

    def long_tracks(self, frames: Sequence[int], least: int) -> Index:
        """Ids (ascending) of the tracks that at least so many of the images see; of the supervised ones, two."""
        tracks = self.tracks(frames)
        return np.union1d(seen_by(tracks, least), np.intersect1d(seen_by(tracks, 2), self.supervised.ids))

    def trusted(self, tracks: Index) -> Index:
        """Rows of the tracks on which the cameras are solved first: not suspected, nor supervised if these can wait."""
        waiting = self.suspects if self.supervised.join else np.r_[self.suspects, self.supervised.ids]
        return np.flatnonzero(~np.isin(tracks, waiting))

    def registering(self, options: MapperOptions) -> MapperOptions:
        """How images are registered on solved points: by a few where supervised tracks alone join some of them."""
        return replace(options, min_inliers=LEAST_SUPERVISED) if self.supervised.join else options

    def observations(self, frames: Sequence[int], tracks: Index) -> Observations:
        """Of some tracks (ascending ids) in some images."""
        return gather(self.tracks(frames), tracks, self._focal(frames))

    def swept(self, observations: Observations, frames: Sequence[int], tracks: Index) -> Observations:
        """The same with their motion during the readout, if the images have one."""
        if self.recording is None:
            return observations
        return with_sweep(observations, tracks, self.images, frames, self._focal(frames), self.recording)

    def marks(self, marks: Sequence[ImageTracks], frames: Sequence[int], points: int) -> Observations:
        """Points that were marked in the images, as the tracks are observed.

        Args:
            marks: by image, in pixels of its camera; frames: rows of the observations; points: how many there are.
        """
        by_position = {mark.position: replace(mark, camera=self.images[mark.position].tracks.camera) for mark in marks}
        none = self.images[0].tracks.of(np.zeros(0, np.int64))
        seen = [by_position.get(position, none) for position in frames]
        return gather(seen, np.arange(points), self._focal(frames))

    def times(self, frames: Sequence[int]) -> Array:
        """(k,) when some of the images were recorded, in usual intervals between two; their positions if unknown."""
        times = np.arange(len(self.images)) if self.recording is None else self.recording.times
        return np.asarray(times[list(frames)], np.float64)

    def _focal(self, frames: Sequence[int]) -> Array:
        return self.guess.focal[self.group[list(frames)]]


def _distorted(tracks: ImageTracks) -> ImageTracks:
    return replace(tracks, camera=without_distortion(tracks.camera))
