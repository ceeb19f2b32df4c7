"""Frames in, poses out: the tracker, the priors and the mapper joined; `finish` polishes over all frames."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict, astuple
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.control.known import Control
from factorsfm.frames.frame import Frame, as_frame
from factorsfm.frames.texture import BLANK_TEXTURE
from factorsfm.graph.contents import Factors, LiveGraph, Values, empty_graph
from factorsfm.graph.process import GraphProcess
from factorsfm.inertial.recording import ImuRecording
from factorsfm.mapping.graph_updates import UPDATES
from factorsfm.mapping.mapper import Mapper
from factorsfm.mending.user_tracks import UserTracks
from factorsfm.priors.depth import DepthPrior
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.priors.masks import MaskPrior
from factorsfm.priors.read_priors import read_mask
from factorsfm.report.thumbnails import Thumbnails
from factorsfm.result.frame_results import SourceFrame, mapped_results, pose_of
from factorsfm.result.lost_frames import with_large_steps
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.result.repeats import add_recorded, add_results
from factorsfm.streaming.depth_reader import DepthReader
from factorsfm.streaming.finishing import EndedShot
from factorsfm.streaming.footage import Footage
from factorsfm.streaming.frame_update import (
    FrameIndices,
    FrameUpdate,
    SeenFrame,
    frame_update,
    keyframe_times,
    mark_blank,
)
from factorsfm.streaming.horizon import FRAMES, Horizon, recent
from factorsfm.streaming.imu_source import ImuSource, restore_imu
from factorsfm.streaming.snapshot import read_snapshot, write_snapshot
from factorsfm.streaming.stream_camera import StreamCamera
from factorsfm.streaming.suspicion import Suspicion
from factorsfm.streaming.view_finder import ViewFinder
from factorsfm.support.context import Closing
from factorsfm.support.errors import InputError, ReconstructionError
from factorsfm.support.options import Options
from factorsfm.support.progress import Progress
from factorsfm.support.stages import StageSeconds
from factorsfm.support.status import FrameStatus
from factorsfm.support.threads import OneThreadEach
from factorsfm.tracks.colors import TrackColors
from factorsfm.tracks.flow import FlowTracker
from factorsfm.tracks.image_tracks import ImageTracks


class Stream(Closing):
    """Incremental reconstruction of one shot.

    Args:
        camera: the lens; None takes EXIF of the first frame's file or guesses a field of view, and refines it in
            `finish`.
        depth: prior, or None.
        masks: what to ignore, or to suspect where they are soft (`MaskPrior`), or None.
        options: see `Options`; None is the default preset.
        control: what is known beforehand of poses and points; it takes part in `finish`. Not part of snapshots.
        imu: recording of an IMU on the camera, which gives metric scale and gravity; the frames need times. With it the
            letters v, b and g of variables are taken.
        horizon: number of frames that `finish` polishes; those before keep their live poses, and of what they saw what
            finds their view again. None is all; control, an IMU and factors of the caller also keep all.
    """

    def __init__(
        self,
        camera: pycolmap.Camera | None = None,
        *,
        depth: DepthPrior | None = None,
        masks: MaskPrior | None = None,
        options: Options | None = None,
        control: Control | None = None,
        imu: ImuRecording | None = None,
        horizon: int | None = FRAMES,
    ) -> None:
        if control is not None and imu is not None:
            raise InputError("control and an IMU cannot both set the scale; give one of them")
        self._camera = StreamCamera(camera)
        self._imu = ImuSource(imu) if imu is not None else None
        self.control = control
        self.options = options or Options()
        self.seconds = StageSeconds()
        self.frames: list[SeenFrame] = []
        self._depth = DepthReader(depth if self.options.uses_depth else None)
        self._held, self._closed = ExitStack(), False
        self._tracker = self._held.enter_context(FlowTracker(self.options.tracker))
        self._suspicion = self._held.enter_context(Suspicion(masks, self.options.mapper.min_tracks))
        self._finder = ViewFinder(self._tracker)
        self._horizon = Horizon(horizon if control is None and imu is None else None)
        self._thumbnails = self._held.enter_context(Thumbnails())
        self._graph = self._held.enter_context(GraphProcess(UPDATES))  # it starts while the source opens
        self._mapper: Mapper | None = None
        self._colors = TrackColors()
        self._indices = FrameIndices()
        self._footage = Footage()

    def push(self, frame: Frame | NDArray[np.uint8], *, keyframe: bool = False) -> FrameUpdate:
        """Take the next frame.

        Args:
            frame: a `Frame`, or an image (h, w, 3) BGR or (h, w) grey.
            keyframe: make it a keyframe, where it is registered: the caller has a measurement of its pose.

        Raises:
            InputError: it is no image, its size differs from that of the frames before or contradicts the camera, or
                a prior fails on it (the depth prior: before there is a map, later the frame goes without); the stream
                can go on with another frame, unless it is closed.
        """
        self._check_open("takes no further frame")
        frame = as_frame(frame, len(self.frames))
        time = self._imu.check_time(frame.index, frame.timestamp) if self._imu is not None else 0.0
        mapper = self._mapper = self._mapper or self._open(frame)
        focal_changed = self._camera.follow(mapper)
        self._camera.check_size(frame)
        frame, grey = self._footage.seen(frame)
        mapper.frame_rate = self._tracker.frame_rate = self._footage.pace.rate
        with self.seconds.of("masks"):
            mask = self._footage.ignored(read_mask(self._suspicion.sure, frame), self.options.tracker.border_px)
        if (repeated := self._footage.repeated(frame, grey, len(self.frames))) is not None:
            return repeated
        with self.seconds.of("tracking"):
            tracked = self._tracker.track(grey, mask, self._finder.expected(mapper))
        self._colors.remember(frame.image, tracked.ids, tracked.xy)
        with self.seconds.of("mapping"):
            mapper.advance()
        focal_changed |= self._camera.follow(mapper)
        index = self._indices.take(frame.index)
        tracks = ImageTracks(len(self.frames), tracked.ids, tracked.xy, self._camera.known, index=index)
        tracks = tracks.of(tracks.invertible & (tracked.texture >= BLANK_TEXTURE))  # a blank image's tracks are noise
        with self.seconds.of("masks"):
            tracks = self._suspicion.of_scene(frame, tracks, mapper)
        with self.seconds.of("mapping"):
            if self._imu is not None:
                keyframe |= self._imu.wants_keyframe(mapper, time)
            image = mapper.add(tracks, lambda: self._read_depth(frame, tracks.pixels), keyframe=keyframe)
            if self._imu is not None:
                self._imu.follow(mapper, time)
        focal_changed |= self._camera.follow(mapper)
        self.frames.append(SeenFrame(frame.index, frame.name, frame.timestamp, tracked.texture))
        self._thumbnails.add(frame.image)
        if len(burn_ins := mapper.news.burn_ins):
            self._tracker.avoid(burn_ins)
            mapper.forget_tracks(burn_ins)
        with self.seconds.of("relocalization"):
            self._finder.keep_in_sight(mapper, image, grey)
        self._horizon.follow(mapper, self._finder.relocalizer)
        if image.status is not FrameStatus.WAITING:  # it may still take part in the start
            mark_blank(mapper, len(self.frames) - 1, tracked.texture)
        return self._footage.told(frame_update(frame, image, mapper, self.frames, focal_changed=focal_changed))

    @property
    def camera(self) -> pycolmap.Camera | None:
        """The lens as it is known now; None before the first frame where it was not given."""
        return self._camera.newest

    def trajectory(self) -> list[pycolmap.Rigid3d | None]:
        """`cam_from_world` of every frame so far as the graph knows it now, None where it has none.

        The map takes over what the graph is working on, and the frames between keyframes are registered on it again.
        """
        if self._mapper is None:
            return []
        self._mapper.refresh()
        return self._footage.recorded.with_repeats([pose_of(image) for image in self._mapper.images])

    def graph(self) -> LiveGraph:
        """A copy of the live factor graph, and its values; both empty before the second keyframe.

        Waits for the update that the graph is working on. Keys are GTSAM's symbols: ``X(i)`` the pose
        (`world_from_cam`) of the frame with index i, where that is a keyframe (`keyframes`); ``L(j)`` the landmark of
        track j; ``A(i)`` scale and shift of the depth map of frame i (`graph.factors.affine_of_native`); ``K(0)`` the
        lens where it is not known. An index that came twice counts on from the largest one.

        Raises:
            InputError: the stream is closed, as by `finish`.
        """
        self._check_open("has no graph any more")
        return self._mapper.graph() if self._mapper is not None else empty_graph()

    def add_factors(self, graph: Factors, values: Values) -> None:
        """Add factors of your own to the live graph; the update of the next keyframe takes all of them, or none.

        They name poses ``X(i)`` and affines ``A(i)`` of `keyframes`, landmarks ``L(j)``, and variables of your own with
        any other letter, in the world of the first keyframe, whose pose stays. Where they determine the unit of length,
        all lengths follow (`FrameUpdate.note` says so). They take part in `finish`, and go with `save`.

        Args:
            graph: GTSAM's factors in C++, which can be serialised; values: of variables that no earlier factor named.

        Raises:
            InputError: a factor cannot be taken (Python callback, unknown key, key that is in use, variables that are
                left open), or the stream is closed, has control or no map yet. That the images contradict the factors
                only the update finds out: `FrameUpdate.note` then says that they are refused.
        """
        self._check_open("takes no factors")
        if self.control is not None:
            raise InputError("a stream with control takes no factors; say of the control what the factors would")
        if self._mapper is None or not self._mapper.started:
            raise InputError("there is no map yet to which factors could be added")
        self._mapper.add_factors(graph, values)

    @property
    def keyframes(self) -> dict[int, float | None]:
        """Timestamps (seconds, None if unknown) of the keyframes of the map, by the index i of ``X(i)``."""
        return keyframe_times(self._mapper.images, self.frames) if self._mapper is not None else {}

    @property
    def points(self) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """(n, 3) points of the map as it is now, and (n, 3) their colours, RGB."""
        if self._mapper is None:
            return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        ids, points = self._mapper.points.all()
        return points, self._colors.table[ids]

    @property
    def tracks(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(n, 2) tracked points of the newest frame (pixels), and (n,) whether the map holds them."""
        if self._mapper is None or not self._mapper.images:
            return np.zeros((0, 2)), np.zeros(0, bool)
        return self._mapper.images[-1].tracks.pixels, self._mapper.points.contains(self.track_ids)

    def all_tracks(self) -> list[ImageTracks]:
        """The tracks of every frame so far, whether the map holds them or not; a repeated frame has its twin's."""
        images = self._mapper.images if self._mapper is not None else []
        return self._footage.recorded.with_repeats([image.tracks for image in images])

    @property
    def newest(self) -> SourceFrame:
        """The frame that came last, also where it repeats the one before; there must be one."""
        last: list[SourceFrame] = [*self.frames[-1:], *self._footage.repeats[-1:]]
        return max(last, key=lambda frame: frame.index)

    @property
    def track_ids(self) -> NDArray[np.int64]:
        """(n,) of the `tracks` of the newest frame: the j of ``L(j)`` where the map holds them."""
        images = self._mapper.images if self._mapper is not None else []
        return images[-1].tracks.ids if images else np.zeros(0, np.int64)

    def save(self, path: str | Path) -> None:
        """Write everything that is known so far as one file, whole or not at all; the stream can go on.

        Raises:
            InputError: the file cannot be written.
        """
        write_snapshot(
            Path(path),
            {
                **self._camera.state(),
                "options": self.options.to_dict(),
                "without_depth": self._depth.failed,
                "seconds": dict(self.seconds),
                "frames": [astuple(frame) for frame in self.frames],
                "tracker": self._tracker.state(),
                "colors": self._colors.table,
                "views": self._finder.relocalizer.views,
                "thumbnails": self._thumbnails.state(),
                "next_view": self._finder.relocalizer.next_view,
                "mapper": self._mapper.state() if self._mapper is not None else None,
                "footage": self._footage.state(),
                "imu": self._imu.state() if self._imu is not None else None,
                "suspicion": self._suspicion.state(),
                "horizon": asdict(self._horizon),
            },
        )

    @classmethod
    def load(
        cls, path: str | Path, *,
        depth: DepthPrior | None = None, masks: MaskPrior | None = None, imu: ImuRecording | None = None,
    ) -> Stream:  # fmt: skip
        """Go on where a stream was saved, with the frame after `newest`.

        Args:
            path: of the snapshot; depth, masks, imu: the priors and the recording that the stream had.

        Raises:
            InputError: the file cannot be read, is torn, or is no snapshot; an IMU is missing, or the stream had none.
        """
        state = read_snapshot(Path(path))
        try:
            with ExitStack() as unless_restored:
                stream = cls(depth=depth, masks=masks, imu=imu, options=Options.from_dict(state["options"]))
                unless_restored.enter_context(stream)
                stream._restore(state)
                unless_restored.pop_all()
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"snapshot {path} does not hold the state of a stream: {error!r}") from error
        return stream

    def _restore(self, state: dict[str, Any]) -> None:
        self._camera.restore(state)
        self._depth.failed = state["without_depth"]
        self.seconds.update(state["seconds"])
        self.frames = [SeenFrame(*frame) for frame in state["frames"]]
        self._tracker.restore(state["tracker"])
        self._finder = ViewFinder(self._tracker, state["views"], state["next_view"])
        self._colors = TrackColors(state["colors"])
        self._thumbnails.restore(state["thumbnails"])
        self._footage.restore(state["footage"])
        if state["mapper"] is not None:
            self._mapper = self._new_mapper()
            self._mapper.restore(state["mapper"])
            self._indices = FrameIndices(image.tracks.frame for image in self._mapper.images)
        self._suspicion.restore(state["suspicion"])
        self._horizon = Horizon(**state["horizon"])
        restore_imu(self._imu, state["imu"])

    def finish(self, progress: Progress | None = None, *, tracks: UserTracks | None = None) -> Reconstruction:
        """Polish over all frames and tracks, those of the user too.

        Raises:
            InputError: control or tracks of the user cannot be used with these frames.
            ReconstructionError: no frame could be registered, or too few points remain.
        """
        with self:
            try:
                ended = self._ended(tracks)
                result = self._horizon.with_all(ended.reconstruction(progress), self.frames, ended.mapper.images)
            except ReconstructionError as error:
                images = self._mapper.images if self._mapper is not None else []
                frames = mapped_results(self.frames, images)
                self._thumbnails.attach(frames)
                reason = with_large_steps(str(error), frames, images)
                raise ReconstructionError(reason, add_results(frames, self._footage.recorded)) from error
            self._thumbnails.attach(result.frames)
            add_recorded(result, self._footage.recorded)
            return result

    def _ended(self, tracks: UserTracks | None) -> EndedShot:
        """The shot, now that no more frames come."""
        if self._mapper is None or len(self.frames) < 2:
            raise ReconstructionError(f"frames in the shot: {len(self.frames)}, at least 2 needed")
        with self.seconds.of("mapping"):
            self._mapper.finish(self._imu.finish if self._imu is not None else lambda mapper: None)
            suspects = self._suspicion.end(self._mapper)
        self._camera.follow(self._mapper)
        for position, seen in enumerate(self.frames):
            mark_blank(self._mapper, position, seen.texture)
        begin = self._horizon.begin
        return EndedShot(
            frames=self.frames[begin:], images=recent(self._mapper.images, begin), mapper=self._mapper,
            colors=self._colors.table, camera=self._camera, depth=self._depth, control=self.control, imu=self._imu,
            footage=self._footage.recorded.of(range(begin, len(self.frames))), options=self.options,
            seconds=self.seconds, suspects=suspects, tracks=tracks,
        )  # fmt: skip

    def close(self) -> None:
        """End all threads and processes of the stream, with a result or without; `finish` closes, too."""
        self._closed = True
        self._held.close()

    def _check_open(self, what: str) -> None:
        if self._closed:
            raise InputError(f"the stream is closed and {what}")

    def _open(self, frame: Frame) -> Mapper:
        """Everything that waits for the size of the first frame."""
        if self.camera is None:
            self.options = self.options.for_unknown_lens()
        self._camera.open(frame, self._footage, self.options)
        return self._new_mapper()

    def _new_mapper(self) -> Mapper:
        self._held.enter_context(OneThreadEach())
        camera, has_prior = self._camera.known, self._depth.prior is not None
        return Mapper(self._graph, camera.mean_focal_length(), camera.width, self.options, has_prior=has_prior)

    def _read_depth(self, frame: Frame, xy: NDArray[np.float64]) -> ImageDepth | None:
        with self.seconds.of("depth"):
            return self._depth.read(frame, xy, needed=self._mapper is None or not self._mapper.started)
