"""A shot whose frames have all come: polished as a whole, or the reason why it cannot be reconstructed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorsfm.camera.guess import first_focal_std
from factorsfm.control.known import Control
from factorsfm.control.with_factors import ShotFactors
from factorsfm.frames.recorded import RecordedFootage, RecordedFrame
from factorsfm.graph.added_factors import AddedFactors
from factorsfm.graph.factors_on_poses import FactorsOnPoses
from factorsfm.mapping.mapped_images import MappedImage
from factorsfm.mapping.mapper import Mapper
from factorsfm.mending.joined import joined
from factorsfm.mending.taken_up import taken_up
from factorsfm.mending.user_tracks import UserTracks
from factorsfm.polish.measured import MeasuredShot
from factorsfm.polish.polished import Polished
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.result.solved_shot import solved_shot
from factorsfm.streaming.depth_reader import DepthReader
from factorsfm.streaming.frame_update import SeenFrame
from factorsfm.streaming.imu_result import add_imu
from factorsfm.streaming.imu_source import FramePoses, ImuSource
from factorsfm.streaming.stream_camera import StreamCamera
from factorsfm.support.options import Options
from factorsfm.support.progress import Progress
from factorsfm.support.stages import StageSeconds
from factorsfm.tracks.supervised import SupervisedTracks

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class EndedShot:
    """What a stream knows when the last frame has come.

    Attributes:
        frames: as they came; images: of these, registered on the map as it is at last; mapper: has made it.
        colors: (n, 3) RGB by track id.
        camera: of the mapper's images; depth: the prior, and where it failed.
        control: what is known beforehand; imu: beside the stream; footage: how the frames were recorded.
        seconds: of the stages so far; that of the polish is added.
        suspects: ids of the tracks that count only where they agree with the others.
        tracks: of the user.
    """

    frames: Sequence[SeenFrame]
    images: list[MappedImage]
    mapper: Mapper
    colors: NDArray[np.uint8]
    camera: StreamCamera
    depth: DepthReader
    control: Control | None
    imu: ImuSource | None
    footage: RecordedFootage
    options: Options
    seconds: StageSeconds
    suspects: NDArray[np.int64]
    tracks: UserTracks | None

    def reconstruction(self, progress: Progress | None) -> Reconstruction:
        """Polish over all frames and tracks; errors as in `Stream.finish`."""
        measured, factors = self._measured(), self._factors()
        with self.seconds.of("polish"):
            polished = measured.solved(
                lambda stage: progress(stage, 0, None) if progress else None,
                factors,
                self._imu_joining if factors is None and self.imu is not None else None,
            )
        result = solved_shot(measured, polished, self.seconds)
        if self.imu is not None:
            took_part = polished.factors
            on_poses = None if took_part is None else took_part.on_poses(polished.frames, [], [])
            focal_std = 0.0 if polished.lens is None else float(polished.lens.focal_std.max())
            add_imu(result, self.imu, on_poses, focal_std)
        return result

    def _measured(self) -> MeasuredShot:
        """What the polish takes from the stream."""
        notes = []
        if failed := self.depth.failed:
            count, first = len(failed), next(iter(failed.values()))
            notes.append(f"Frames that went without depth because the prior failed: {count}; {first}.")
        if self.mapper.without_prior:
            notes.append(f"The map went on without the depth prior: {self.mapper.without_prior}.")
        camera, given = self.camera.known, self.camera.given
        measured = MeasuredShot(
            frames=[RecordedFrame(frame.index, frame.name, frame.timestamp) for frame in self.frames],
            footage=self.footage,
            images=self.images,
            map_points=self.mapper.points.all(),
            colors=self.colors,
            camera=camera,
            lens_given=given,
            first_focal=(self.mapper.first_focal, first_focal_std(camera, given=given)),
            depth_kind=None if self.depth.prior is None else self.depth.prior.kind,
            suspects=self.suspects,
            supervised=SupervisedTracks.none(),
            options=self.options,
            control=self.control,
            notes=tuple(notes),
        )
        return measured if self.tracks is None else taken_up(joined(measured, self.tracks))

    def _factors(self) -> ShotFactors | None:
        """Those that were added to the live graph, with the poses that these are beside."""
        added = self.mapper.additions.everything()
        if not added.numbers:
            return None
        return self._beside(added, {image.tracks.position: image.pose for image in self.images if image.registered})

    def _beside(self, added: AddedFactors, poses: dict[int, tuple[Array, Array]]) -> ShotFactors:
        """Factors in the world of some poses, which are there by position."""
        numbers, contents = [image.tracks.frame for image in self.images], self.mapper.contents()
        return ShotFactors(
            frames=[position for position in poses if numbers[position] in added.frames],
            tracks=np.array(sorted(added.tracks), np.int64),
            poses=poses,
            on_poses=lambda positions, tracks, guided: FactorsOnPoses(
                added, contents, [numbers[k] for k in positions], tracks, [numbers[k] for k in guided]
            ),
        )

    def _imu_joining(self, polished: Polished) -> ShotFactors | None:
        """Those of an IMU that could not join the live graph, in metres and in the world of the polished poses."""
        assert self.imu is not None
        if self.mapper.refines_focal and (polished.lens is None or not polished.lens.determined):
            self.imu.reason = "the lens is not known, and the shot does not determine it"
            return None
        images, rows = self.images, polished.frames
        poses = FramePoses.none(len(images))
        poses.rotation[rows], poses.translation[rows] = polished.state.rotation, polished.state.translation
        poses.covariance[rows] = polished.covariance
        if (found := self.imu.join(poses, [image.tracks.frame for image in images])) is None:
            return None
        (graph, values), scale = found
        added = AddedFactors.of(range(graph.size()), graph, values)
        return self._beside(added, {k: (poses.rotation[k], scale * poses.translation[k]) for k in rows})
