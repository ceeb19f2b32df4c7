"""The plan of a run: a shot with truth, and the faults that disturb it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from benchmarks.inputs import open_prior, open_shot
from benchmarks.plan import FULL, STUDIO
from benchmarks.run import HERE
from factorsfm import DepthKind, DepthMap, Frame
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import RenderedShot, simulate_prior
from factorsfm.synthetic.room import Room
from factorsfm.synthetic.scene import camera_path, room_camera

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Generator = np.random.Generator

_FRAMES = 40
_WIDTH, _HEIGHT = 320, 180
_OTHER_SHOT_FRAMES = 20
_FIRST_FOREIGN = 10  # frame before which no other shot appears


class Fault(StrEnum):
    """The kinds of faults."""

    DROPPED = "dropped frames"
    DUPLICATED = "duplicated frames"
    BLACK = "black frames"
    NOISE = "noise instead of frames"
    DAMAGED = "damaged frames"
    WRONG_SIZE = "frame of another size"
    FOREIGN = "stretch of another shot"
    CUT = "cut to another shot"
    NAN_DEPTH = "depth of NaN"
    RAISES = "network that raises"
    KILLED = "SIGKILL and resume"


@dataclass(frozen=True, slots=True)
class KnownShot:
    """A shot with its truth and a depth prior.

    Attributes:
        images: (h, w, 3) uint8 BGR.
        depth: inverse depth of each frame, None where there is none.
        rotations: (n, 3, 3) world_from_cam; centers: (n, 3).
    """

    images: list[Image]
    depth: Sequence[NDArray[np.float32] | None]
    camera: pycolmap.Camera
    rotations: Array
    centers: Array


@dataclass(frozen=True, slots=True)
class PlannedFrame:
    """A frame that is pushed.

    Attributes:
        origin: position of the shot in the plan, and the frame in it; None if the image shows no view of a shot.
        depth_fault: what happens to the depth prior of the frame.
    """

    image: Image
    origin: tuple[int, int] | None
    depth_fault: Literal["", "nan", "raise"] = ""


@dataclass(slots=True)
class Plan:
    """A run.

    Attributes:
        faults: the kinds of faults in it.
        shots: the shot, and another one if the faults need it.
        frames: what is pushed.
        killed_at: frame at which the process is killed, None for never.
        kill_delay: seconds from the push of that frame.
        snapshot_every: frames between two snapshots.
        is_film: whether an `Episode` follows the frames, which tells shots apart.
    """

    faults: list[Fault]
    shots: list[KnownShot]
    frames: list[PlannedFrame]
    killed_at: int | None = None
    kill_delay: float = 0.0
    snapshot_every: int = 5
    is_film: bool = False


class FaultyPrior:
    """The depth maps of a plan, with their faults."""

    kind = DepthKind.INVERSE
    name = "maps with faults"

    def __init__(self, plan: Plan) -> None:
        self._plan = plan

    def __call__(self, frame: Frame) -> DepthMap | None:
        planned = self._plan.frames[frame.index]
        if planned.depth_fault == "raise":
            raise RuntimeError("out of memory")
        shot, k = planned.origin or (0, 0)
        values = self._plan.shots[shot].depth[k]
        if values is None:
            return None
        return DepthMap(np.full_like(values, np.nan) if planned.depth_fault == "nan" else values, self.kind)


def random_plan(seed: int, data: Path | None) -> Plan:
    """A plan with one to three kinds of faults; the seed determines it.

    Args:
        data: folder of the sets, of which one is the shot; None renders one.
    """
    generator = np.random.default_rng(seed)
    faults = [Fault(name) for name in generator.choice([*Fault], generator.integers(1, 4), replace=False)]
    shots = [_shot_from_data(data, generator) if data else _rendered_shot(generator)]
    if {Fault.FOREIGN, Fault.CUT} & set(faults):
        shots.append(_rendered_shot(generator, shots[0].camera, frames=_OTHER_SHOT_FRAMES))
    plan = Plan(faults, shots, [PlannedFrame(image, (0, k)) for k, image in enumerate(shots[0].images)])
    for fault in faults:
        plan.frames = disturbed(fault, plan.frames, shots, generator)
    if Fault.KILLED in faults:
        plan.killed_at = int(generator.integers(1, len(plan.frames)))
        plan.kill_delay = float(generator.uniform(0.0, 0.05))
        plan.snapshot_every = int(generator.integers(1, 8))
    plan.is_film = Fault.KILLED not in faults and bool(generator.random() < 0.5)
    return plan


def disturbed(
    fault: Fault, frames: list[PlannedFrame], shots: list[KnownShot], generator: Generator
) -> list[PlannedFrame]:
    """The frames with a fault at a random place."""
    begin, count = int(generator.integers(0, len(frames) - 4)), int(generator.integers(1, 7))
    end = min(begin + count, len(frames))
    before, there, after = frames[:begin], frames[begin:end], frames[end:]
    match fault:
        case Fault.DROPPED:
            return before + after
        case Fault.DUPLICATED:
            return before + [frame for frame in there for _ in range(int(generator.integers(2, 5)))] + after
        case Fault.BLACK:
            return before + [PlannedFrame(np.zeros_like(frame.image), None) for frame in there] + after
        case Fault.NOISE:
            noise = [generator.integers(0, 256, frame.image.shape, np.uint8) for frame in there]
            return before + [PlannedFrame(image, None) for image in noise] + after
        case Fault.DAMAGED:
            return before + [replace(frame, image=_damaged(frame.image, generator)) for frame in there] + after
        case Fault.WRONG_SIZE:
            other = cv2.resize(there[0].image, None, fx=0.5, fy=0.5)
            return [*before, PlannedFrame(other, None), *there, *after]
        case Fault.FOREIGN | Fault.CUT:
            foreign = [PlannedFrame(image, (1, k)) for k, image in enumerate(shots[1].images)]
            at = max(begin, _FIRST_FOREIGN)
            back = frames[at:] if fault is Fault.FOREIGN else []
            return frames[:at] + (foreign[: 2 * count] if back else foreign) + back
        case Fault.NAN_DEPTH:
            return _with_depth_fault(frames, "nan", generator)
        case Fault.RAISES:
            return _with_depth_fault(frames, "raise", generator)
        case Fault.KILLED:
            return frames


def _with_depth_fault(
    frames: list[PlannedFrame], fault: Literal["nan", "raise"], generator: Generator
) -> list[PlannedFrame]:
    share = generator.uniform(0.1, 1.0)
    return [replace(frame, depth_fault=fault) if generator.random() < share else frame for frame in frames]


def _damaged(image: Image, generator: Generator) -> Image:
    """As a broken stream is decoded: from some row on, rows of another place or grey."""
    damaged, row = image.copy(), int(generator.integers(image.shape[0] // 3, image.shape[0] - 8))
    damaged[row:] = np.roll(image, int(generator.integers(20, 100)), axis=1)[row:] if generator.random() < 0.5 else 128
    return damaged


def _rendered_shot(generator: Generator, camera: pycolmap.Camera | None = None, frames: int = _FRAMES) -> KnownShot:
    """A shot with a given lens, which is that of the whole film: rendered small, and enlarged."""
    motion = generator.choice(["dolly", "truck", "handheld", "arc"])
    parallax, seed = generator.uniform(0.04, 0.15), int(generator.integers(1000))
    lens = pycolmap.Camera((camera or room_camera(_WIDTH, _HEIGHT)).todict())
    size = lens.width, lens.height
    lens.rescale(_WIDTH, _HEIGHT)
    room = Room(seed, lens.focal_length_x)
    path = camera_path(motion, frames, parallax, float(np.median(room.depth(lens, pycolmap.Rigid3d()))), seed)
    depths = [room.depth(lens, pose).astype(np.float32) for pose in path]
    images = [room.image(lens, pose) for pose in path]
    prior = simulate_prior(RenderedShot(images, depths, lens, path, np.ones(frames)), seed=seed)
    lens.rescale(*size)
    return KnownShot([cv2.resize(image, size) for image in images], prior, lens, *pose_arrays(path))


def _shot_from_data(data: Path, generator: Generator) -> KnownShot:
    shot = open_shot(data, str(generator.choice(STUDIO)), FULL)
    prior = open_prior("tcmonodepth", shot, data, data.parent / "models", HERE / "cache")
    assert prior is not None
    frames = [frame for frame, _ in zip(shot.frames(), range(_FRAMES), strict=False)]
    maps = [prior(frame) for frame in frames]
    depth = [None if found is None else found.values for found in maps]
    return KnownShot([f.image for f in frames], depth, shot.camera, shot.rotations[:_FRAMES], shot.centers[:_FRAMES])
