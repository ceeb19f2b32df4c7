"""A shot as it was measured: all that its final solve takes from the images, so that it can be solved again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.control.known import Control
from factorsfm.control.located import LocatedControl, locate
from factorsfm.control.tracked_points import marked_by_tracks
from factorsfm.control.with_factors import ShotFactors
from factorsfm.frames.recorded import RecordedFootage, RecordedFrame
from factorsfm.lens.camera_model import distortion_of
from factorsfm.lens.lens import Lens
from factorsfm.lens.rolling_shutter import Recording
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.polish.polish import polish
from factorsfm.polish.polished import Polished
from factorsfm.polish.shot import Shot
from factorsfm.priors.depth_map import DepthKind
from factorsfm.support.errors import ReconstructionError
from factorsfm.support.options import Options
from factorsfm.tracks.supervised import SupervisedTracks

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class MeasuredShot:
    """Tracks, depth at them, and the incremental map where the final solve starts.

    Attributes:
        frames: those that repeat none; footage: how they were recorded, and those that repeat others.
        images: of the frames: tracks, and poses in the map.
        map_points: (n,) track ids, ascending, and (n, 3) positions in the map.
        colors: (t, 3) RGB by track id.
        camera: of the images; lens_given: whether it is known, and no guess.
        first_focal: focal length before any image was used, pixels, and its relative standard deviation.
        depth_kind: what the depth prior holds, None without one.
        suspects: ids (ascending) of the tracks that count only where they agree with the others.
        supervised: tracks that the user vouches for.
        control: what is known beforehand.
        notes: sentences on what happened while the frames came.
        solved_lens: what an earlier solve has found of an unknown lens, where the estimate of it starts; None: nothing.
    """

    frames: Sequence[RecordedFrame]
    footage: RecordedFootage
    images: list[MappedImage]
    map_points: tuple[Index, Array]
    colors: NDArray[np.uint8]
    camera: pycolmap.Camera
    lens_given: bool
    first_focal: tuple[float, float]
    depth_kind: DepthKind | None
    suspects: Index
    supervised: SupervisedTracks
    options: Options
    control: Control | None
    notes: tuple[str, ...] = ()
    solved_lens: Lens | None = None

    def solved(
        self,
        stage: Callable[[str], None],
        factors: ShotFactors | None = None,
        joining: Callable[[Polished], ShotFactors | None] | None = None,
    ) -> Polished:
        """The final solve; `factors`, `joining`: see `polish`.

        Raises:
            InputError: the control names a frame that is not there.
            ReconstructionError: too few frames are registered, or as in `polish`.
        """
        control = self._located_control()
        registered = sum(image.registered for image in self.images)
        if registered < 2:
            worst = next((i for i in self.images if not i.registered), self.images[0])
            raise ReconstructionError(
                f"{registered} of {len(self.frames)} frames registered, at least 2 needed; "
                f"frame {self.frames[worst.tracks.position].index}: {worst.message}"
            )
        focal, std = self.first_focal
        shot = Shot.of(
            self.images,
            self.map_points,
            np.array([self.camera.mean_focal_length()]),
            shape=distortion_of(self.camera) if self.options.estimates_lens else None,
            first_focal=(np.array([focal]), std),
            recording=self._recording(),
            suspects=self.suspects,
            supervised=self.supervised,
            solved_lens=self.solved_lens,
            seconds=self.footage.seconds(self.frames),
        )
        return polish(shot, self.options, stage, control=control, factors=factors, joining=joining)

    def _located_control(self) -> LocatedControl | None:
        if self.control is None:
            return None
        control = marked_by_tracks(self.control, [image.tracks for image in self.images], self.supervised)
        return locate(control, self.frames, lambda position, xy: (self.camera, xy))

    def _recording(self) -> Recording | None:
        """What a rolling shutter is looked for in."""
        shutter = self.options.shutter
        if shutter == "global" or (shutter == "auto" and self.control is not None):
            return None
        focal = np.array([self.camera.focal_length_x, self.camera.focal_length_y])
        size = (self.camera.width, self.camera.height)
        return Recording(*size, self.footage.times(self.frames), focal / focal.mean())
