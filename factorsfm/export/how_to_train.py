"""What to type to train on an export, and what the trainer does not learn from it."""

from __future__ import annotations

import shlex
from pathlib import Path

from factorsfm.export.options import ExportOptions
from factorsfm.export.training import IMAGES, MASKS
from factorsfm.result.reconstruction import Reconstruction


def how_to_train(result: Reconstruction, path: Path, format: str, options: ExportOptions) -> list[str]:
    """Lines for the user of an export for training that was written to a path."""
    if format != "nerfstudio" and not options.undistorted:
        return ["To train splats, add --undistorted: it writes images and masks beside the model."]
    place, masked = shlex.quote(str(path)), (path / MASKS).is_dir()
    lines = ["To train:"]
    if format == "nerfstudio":
        lines.append(f"  nerfstudio  ns-train splatfacto --data {place}")
    else:
        masks = f" --masks-path {MASKS}" if masked else ""
        model = shlex.quote(str(path / "sparse" / "0"))
        lines += [
            f"  gsplat      python examples/simple_trainer.py default --data_dir {place} --data_factor 1"
            + (" (it reads no masks)" if masked else ""),
            f"  nerfstudio  ns-train splatfacto --data {place} colmap --colmap-path sparse/0{masks}",
            f"  Postshot    drop {shlex.quote(str(path / IMAGES))} and the files of {model} into its window"
            + (f", and {shlex.quote(str(path / MASKS))}" if masked else ""),
        ]
    lines.append(f"  Brush       brush {place}")
    return lines + _not_learned(result, options)


def _not_learned(result: Reconstruction, options: ExportOptions) -> list[str]:
    """What of a result no trainer knows."""
    lines = []
    if result.shutter is not None:
        poses = "that show the points best without one" if result.shutter.recorded else "of the middle of each image"
        lines.append(f"No trainer knows the rolling shutter that was found: the poses are those {poses}.")
    masks = result.options.get("masks")
    if masks and options.masks is None:
        lines.append(f"The result was made with masks ({masks}), which --masks hands on to the trainer.")
    return lines
