"""The same move at several image sizes and frame rates: ``python -m benchmarks.sizes``.

The room of `factorsfm.synthetic`, whose finest texture is as fine as the pixels at every size, with the noise of a
sensor, which is in pixels, and coded as H.264. The videos stay in ``cache/sizes``; the largest takes minutes to render.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from benchmarks.markdown import table
from benchmarks.run import HERE, machine
from benchmarks.usage import cpu_seconds
from factorsfm import FrameUpdate, Stream, open_source, read_frames
from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.support.options import TrackerOptions
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import render_views, room_camera
from factorsfm.synthetic.room import Room
from factorsfm.synthetic.scene import camera_path
from factorsfm.tracks.flow import FlowTracker

Array = NDArray[np.float64]

SIZES = ((480, 270), (960, 540), (1920, 1080), (3840, 2160))
RATES = (12, 24, 60)
_USUAL_SIZE, _USUAL_RATE = (960, 540), 24  # the size of all rates, and the rate of all sizes
_SECONDS = 2.5
_FINE_RATE = 120  # frames a second of the path that the shots of all rates are taken from
_PARALLAX, _DEPTH = 0.1, 4.0  # of the path; the depth is about the median of the room
_NOISE = 3.0  # grey levels, in each channel: film at a middle exposure, a phone in a room
_QUALITY = "18"  # CRF of a delivered film
_DEPTH_WIDTH = 960  # of the true depth maps: between their pixels the inverse depth of a plane is exactly linear
_EDGE_RATIO = 1.02  # of the inverse depths around a point, above which it lies on an edge and has no truth


@dataclass(frozen=True, slots=True)
class SizedShot:
    """A rendered video, its lens and its true poses."""

    video: Path
    camera: pycolmap.Camera
    cam_from_world: list[pycolmap.Rigid3d]


def sized_shot(folder: Path, size: tuple[int, int], rate: int) -> SizedShot:
    """The move at a size (width, height) and a number of frames a second, rendered unless it is there."""
    path = camera_path("handheld", round(_SECONDS * _FINE_RATE) + 1, _PARALLAX, _DEPTH, seed=0)[:: _FINE_RATE // rate]
    video = folder / f"{size[0]}x{size[1]}_{rate}.mp4"
    if not video.exists():
        folder.mkdir(parents=True, exist_ok=True)
        unfinished = video.with_suffix(".part.mp4")
        _encode(render_views(path, *size), unfinished, size, rate)
        unfinished.rename(video)
    return SizedShot(video, room_camera(*size), path)


def _encode(images: Iterator[NDArray[np.uint8]], video: Path, size: tuple[int, int], rate: int) -> None:
    """Write images with noise as H.264."""
    generator = np.random.default_rng(0)
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate), options={"crf": _QUALITY, "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for image in images:
            noisy = image + generator.standard_normal(image.shape, np.float32) * np.float32(_NOISE)
            pixels = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="bgr24")))
        container.mux(stream.encode())


def track_errors(tracks: list[tuple[NDArray[np.int64], Array]], shot: SizedShot) -> Array:
    """Distances in pixels between tracks and their truth: the point of the scene that they showed when they were born.

    Args:
        tracks: ids (n,) and pixels (n, 2) in every frame.
    """
    camera = shot.camera
    small = room_camera(_DEPTH_WIDTH, round(_DEPTH_WIDTH * camera.height / camera.width))
    room = Room(0, 1.0)  # its shape alone counts
    calibration = camera.calibration_matrix()
    points = np.full((max(int(ids.max(initial=-1)) for ids, _ in tracks) + 1, 3), np.nan)
    seen, errors = 0, []
    for (ids, xy), pose in zip(tracks, shot.cam_from_world, strict=True):
        old = ids < seen
        projected = _transformed(points[ids[old]], pose) @ calibration.T
        errors.append(np.linalg.norm(projected[:, :2] / projected[:, 2:] - PIXEL_CENTER - xy[old], axis=1))
        if not old.all():
            inverse = _inverse_depth(1.0 / room.depth(small, pose), xy[~old] + PIXEL_CENTER, camera.width)
            rays = np.column_stack([xy[~old] + PIXEL_CENTER, np.ones(int((~old).sum()))])
            points[ids[~old]] = _transformed(rays @ np.linalg.inv(calibration).T / inverse[:, None], pose.inverse())
            seen = int(ids.max()) + 1
    pooled = np.concatenate(errors)
    return np.asarray(pooled[np.isfinite(pooled)])


def _transformed(points: Array, pose: pycolmap.Rigid3d) -> Array:
    return np.asarray(points @ pose.rotation.matrix().T + pose.translation)


def _inverse_depth(inverse: Array, xy: Array, width: int) -> Array:
    """(n,) inverse depth at places (n, 2), corners of pixels at integers, of an image so wide; NaN at edges."""
    x, y = np.ascontiguousarray((xy * (inverse.shape[1] / width) - PIXEL_CENTER).T, np.float32)
    around = np.ones((3, 3), np.uint8)
    high, low = cv2.dilate(inverse, around), cv2.erode(inverse, around)
    columns, rows = np.rint([x, y]).astype(int)
    columns, rows = np.clip(columns, 0, inverse.shape[1] - 1), np.clip(rows, 0, inverse.shape[0] - 1)
    found = cv2.remap(inverse, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
    return np.where(high[rows, columns] < _EDGE_RATIO * low[rows, columns], found, np.nan)


def measured(shot: SizedShot, rate: int) -> list[object]:
    """The row of a shot: CPU time by stage, speed, and errors."""
    start = time.process_time()
    frames = sum(1 for _ in read_frames(shot.video))
    decoding = 1e3 * (time.process_time() - start) / frames
    tracks, tracking = [], 0.0
    with FlowTracker(TrackerOptions()) as tracker:
        for frame in read_frames(shot.video):
            start = time.process_time()
            tracked = tracker.track(frame.image)
            tracking += 1e3 * (time.process_time() - start) / frames
            tracks.append((tracked.ids, tracked.xy))
    updates: list[FrameUpdate] = []
    pushes: list[float] = []
    start, cpu = time.perf_counter(), cpu_seconds()
    with Stream(shot.camera) as stream:
        with open_source(shot.video) as source:
            for frame in source:
                begin = time.perf_counter()
                updates.append(stream.push(frame))
                pushes.append(time.perf_counter() - begin)
        seconds = time.perf_counter() - start
        cpu = 1e3 * (cpu_seconds() - cpu) / frames
        mapping = 1e3 * stream.seconds["mapping"] / frames
        truth = pose_arrays(shot.cam_from_world)
        live = trajectory_errors(*pose_arrays([update.cam_from_world for update in updates]), *truth)
        graph = trajectory_errors(*pose_arrays(stream.trajectory()), *truth)
    errors = track_errors(tracks, shot)
    diagonal = 1e6 / np.hypot(shot.camera.width, shot.camera.height)
    return [
        f"{shot.camera.width}x{shot.camera.height}", rate, frames, f"{decoding:.1f}", f"{tracking:.1f}",
        f"{mapping:.1f}", f"{cpu:.1f}", f"{frames / seconds:.1f}", f"{1e3 * np.median(pushes):.0f}",
        f"{np.median(errors):.3f}", f"{np.quantile(errors, 0.9):.3f}", f"{diagonal * np.median(errors):.1f}",
        f"{np.mean([len(ids) for ids, _ in tracks]):.0f}", f"{max(int(ids.max()) for ids, _ in tracks) + 1}",
        f"{1e3 * np.median(live.ate):.2f}", f"{1e3 * np.median(graph.ate):.2f}", f"{np.median(graph.r_rpe) * rate:.3f}",
    ]  # fmt: skip


_HEADER = [
    *("size", "frames a second", "frames", "CPU ms: decoding", "tracking", "mapping, wall ms", "CPU ms: stream"),
    *("frames a second live", "push ms", "track error px, median", "90 %", "median, ppm of the diagonal"),
    *("tracks a frame", "tracks in all", "ATE as given, 1/1000 units", "ATE graph", "R-RPE, degrees a second"),
]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.sizes", description=__doc__)
    parser.add_argument("--widths", nargs="+", type=int, default=[width for width, _ in SIZES], help="only these")
    parser.add_argument("--cache", type=Path, default=HERE / "cache" / "sizes", help="folder of the videos")
    parser.add_argument("--output", type=Path, default=HERE / "results", help="folder of SIZES.md")
    arguments = parser.parse_args()
    cases = [(size, _USUAL_RATE) for size in SIZES] + [(_USUAL_SIZE, rate) for rate in RATES if rate != _USUAL_RATE]
    rows = []
    for size, rate in cases:
        if size[0] in arguments.widths:
            rows.append(measured(sized_shot(arguments.cache, size, rate), rate))
            print(*rows[-1], sep="  ", flush=True)
    text = f"# Sizes and rates\n\nGenerated by `python -m benchmarks.sizes`. Machine: {machine()}.\n\n"
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "SIZES.md").write_text(text + table(_HEADER, rows) + "\n")
    print(table(_HEADER, rows))


if __name__ == "__main__":
    main()
