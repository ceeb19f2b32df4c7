"""Cameras beside things that move by themselves: ``python -m benchmarks.moving --data FOLDER``.

Without masks, and with the true ones: live poses, those of the graph, polished ones, and what the result says of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.composites import KINDS, composite
from benchmarks.inputs import open_prior, open_shot
from benchmarks.markdown import table
from benchmarks.plan import FULL
from benchmarks.run import HERE, machine
from factorsfm import Frame, MaskFolder, Reconstruction, Stream
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.evaluation.truth import Shot
from factorsfm.result.verdict import Grade, verdict_of
from factorsfm.support.similarity import pose_arrays

SCENES = ("d01_livingroom_dolly_in", "d03_livingroom_handheld", "d06_keep_static_breath", "d08_arena_pedestal")
_TEXTURES = ("d05_warehouse_walk_arc", "d07_keep_pan_trans_actor")  # scenes of which figures have their texture
_COVERED = 0.02  # of a pixel, from which a mask says so
_SAID = 0.05  # of the image at odds with the live map

Covers = Sequence[NDArray[np.bool_] | None]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Median ATE in millimetres of the three kinds of poses, and what the result says."""

    given: float
    graph: float
    polished: float
    said: str


class _Masks:
    """Masks of composited figures as a source of masks."""

    name = "figures"

    def __init__(self, covers: Covers) -> None:
        self._covers = covers

    def __call__(self, frame: Frame) -> NDArray[np.bool_] | None:
        return self._covers[frame.index]


def outcome(
    shot: Shot, frames: Sequence[Frame], masks: MaskFolder | _Masks | None, arguments: argparse.Namespace
) -> Outcome:
    """Stream and polish frames with the truth of a shot."""
    depth = open_prior("tcmonodepth", shot, arguments.data, arguments.models, HERE / "cache")
    with Stream(shot.camera, depth=depth, masks=masks) as stream:
        updates = [stream.push(frame) for frame in frames]
        graph = stream.trajectory()
        result = stream.finish()
    poses = [u.cam_from_world for u in updates], graph, [frame.cam_from_world for frame in result.frames]
    ate = [trajectory_errors(*pose_arrays(p), shot.rotations, shot.centers).ate for p in poses]
    said = _said(result, max(update.at_odds for update in updates))
    return Outcome(*(1e3 * float(np.median(errors)) for errors in ate), said)


def _said(result: Reconstruction, at_odds: float) -> str:
    moves = any("moves by itself" in note for note in result.notes)
    doubtful = verdict_of(result).grade is Grade.DOUBTFUL
    words = (("moves", moves), ("doubtful", doubtful), (f"live: {at_odds:.0%} at odds", at_odds > _SAID))
    return ", ".join(word for word, said in words if said)


def measured(arguments: argparse.Namespace) -> Iterator[list[object]]:
    """A row for every shot."""
    for folder in sorted((arguments.data / "moving").glob("m*")):
        shot = open_shot(arguments.data, folder.name, FULL)
        frames = list(shot.frames())
        cover = float(np.mean([_cover(MaskFolder(folder / "truth_masks"), frame) for frame in frames[::6]]))
        masks = MaskFolder(folder / "truth_masks")
        yield _row(folder.name, cover, *(outcome(shot, frames, m, arguments) for m in (None, masks)))
    textures = [next(iter(open_shot(arguments.data, name, FULL).frames())).image for name in _TEXTURES]
    for scene in arguments.scenes:
        shot = open_shot(arguments.data, scene, FULL)
        footage = list(shot.frames())
        for kind in arguments.kinds:
            frames, covers = zip(*composite(footage, KINDS[kind], textures), strict=True)
            masks = _Masks([cover > _COVERED for cover in covers])
            found = [outcome(shot, frames, m, arguments) for m in (None, masks)]
            yield _row(f"{scene[:3]} {kind}", float(np.mean(covers)), *found)


def _cover(masks: MaskFolder, frame: Frame) -> float:
    mask = masks(frame)
    return 0.0 if mask is None else float(np.mean(mask))


def _row(name: str, cover: float, without: Outcome, masked: Outcome) -> list[object]:
    pairs = [(without.given, masked.given), (without.graph, masked.graph), (without.polished, masked.polished)]
    return [
        name,
        f"{100 * cover:.0f}",
        *(f"{a:.2f} / {b:.2f}" for a, b in pairs),
        f"{pairs[-1][0] / pairs[-1][1]:.1f}",
        without.said,
    ]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.moving", description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the sets")
    parser.add_argument("--models", type=Path, help="folder of the networks (default: models beside the data)")
    parser.add_argument("--scenes", nargs="*", default=SCENES, metavar="NAME", help="into which figures are laid")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS), help="of figures")
    parser.add_argument("--output", type=Path, default=HERE / "results", help="folder of MOVING.md")
    arguments = parser.parse_args()
    arguments.models = arguments.models or arguments.data.parent / "models"
    header = ["shot", "cover, %", "as given, mm", "graph, mm", "polished, mm", "ratio", "note"]
    rows = []
    for row in measured(arguments):
        rows.append(row)
        print(*row, sep="  ", flush=True)
    parts = [
        "# Things that move by themselves",
        f"Generated by `python -m benchmarks.moving`. Machine: {machine()}.",
        "Median ATE without masks / with the true ones; TCMonoDepth at the keyframes, known lens. Figures are laid "
        "into shots of which the truth is known; cover: their share of the image. Ratio: of the polished ones. Note: "
        "whether the result says that something moves, and whether it calls itself doubtful; live: the largest "
        "share of the image that a frame's update called at odds with the map (it says so in a note from 25 % on).",
        table(header, rows),
    ]
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "MOVING.md").write_text("\n\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
