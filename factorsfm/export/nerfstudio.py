"""nerfstudio's data folder: ``transforms.json``, the images and the points, ready for training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from factorsfm.export.ply import write_ply
from factorsfm.export.shot import Shot
from factorsfm.export.training import IMAGES, MASKS, seen_in_training, write_training_images
from factorsfm.support.errors import InputError
from factorsfm.support.json_text import json_text

# COLMAP's model: nerfstudio's model, and its names of the parameters after the principal point.
_MODELS: dict[str, tuple[str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("OPENCV", ()),
    "PINHOLE": ("OPENCV", ()),
    "SIMPLE_RADIAL": ("OPENCV", ("k1",)),
    "RADIAL": ("OPENCV", ("k1", "k2")),
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "SIMPLE_FISHEYE": ("OPENCV_FISHEYE", ()),
    "FISHEYE": ("OPENCV_FISHEYE", ()),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}

_CURE = "--undistorted writes images without distortion"  # of any lenses


def write_nerfstudio(shot: Shot, folder: Path) -> None:
    """Write ``transforms.json``, ``points.ply`` and, if the footage is available, images and masks.

    Camera axes are x right, y up, looking along -z. The principal point counts from the image's corner. Distortion is
    included where images are not undistorted. If frames do not share one lens, each has its own parameters.
    Unregistered frames are left out. Images and masks are as `write_training_images` writes them.

    Raises:
        InputError: nerfstudio does not know the lens model, or as in `write_training_images`.
    """
    r = seen_in_training(shot)
    lenses = [_lens(r.camera_of(frame)) for frame in r.registered]
    models = {lens.pop("camera_model") for lens in lenses}
    if len(models) > 1:
        raise InputError(f"nerfstudio takes lenses of one model, not {' and '.join(sorted(models))} together; {_CURE}")
    masks = write_training_images(shot, r, folder)
    shared = {} if r.has_own_lenses else lenses[0]  # shared values hide those of a frame
    content = {
        "camera_model": models.pop(),
        **shared,
        "frames": [
            {
                "file_path": f"{IMAGES}/{frame.name}",
                **({"mask_path": f"{MASKS}/{masks[frame.name]}"} if masks else {}),
                "transform_matrix": matrix,
                **({} if shared else lens),
            }
            for frame, matrix, lens in zip(r.registered, shot.world_from_film, lenses, strict=True)
        ],
        "ply_file_path": "points.ply",
        "applied_transform": np.column_stack([shot.world, np.zeros(3)]),
        "applied_scale": shot.scale,
    }
    (folder / "transforms.json").write_text(json_text(content), encoding="utf-8")
    write_ply(r, folder / "points.ply")


def _lens(camera: pycolmap.Camera) -> dict[str, Any]:
    if camera.model_name not in _MODELS:
        raise InputError(
            f"nerfstudio does not know the lens model {camera.model_name}; it knows {', '.join(_MODELS)}; {_CURE}"
        )
    model, names = _MODELS[camera.model_name]
    values = [float(camera.params[i]) for i in camera.extra_params_idxs()]
    return {
        "camera_model": model,
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.focal_length_x,
        "fl_y": camera.focal_length_y,
        "cx": camera.principal_point_x,
        "cy": camera.principal_point_y,
        **dict.fromkeys(("k1", "k2", "k3", "k4") if model == "OPENCV_FISHEYE" else ("k1", "k2", "p1", "p2"), 0.0),
        **dict(zip(names, values, strict=True)),
    }
