"""nerfstudio's data folder: ``transforms.json``, the images and the points, ready for training."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pycolmap

from factorsfm.export.image_names import image_name
from factorsfm.export.ply import write_ply
from factorsfm.export.shot import Shot
from factorsfm.frames.fields import Fields
from factorsfm.frames.plates import PLATE_SUFFIXES
from factorsfm.frames.reading import read_frames
from factorsfm.frames.writing import write_image
from factorsfm.result.image_sources import image_sources
from factorsfm.support.errors import InputError
from factorsfm.support.json_text import json_text

logger = logging.getLogger(__name__)

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


def write_nerfstudio(shot: Shot, folder: Path) -> None:
    """Write ``transforms.json``, ``points.ply`` and, if the footage is available, ``images/``.

    Camera axes are x right, y up, looking along -z. The principal point counts from the image's corner. Distortion is
    included. If frames do not share one lens, each has its own parameters. Unregistered frames are left out.

    Raises:
        InputError: nerfstudio does not know the lens model, or the footage lacks frames.
    """
    r = shot.reconstruction
    names = {frame.index: _trained_name(frame.name) for frame in r.registered}
    lenses = [_lens(r.camera_of(frame)) for frame in r.registered]
    models = {lens.pop("camera_model") for lens in lenses}
    if len(models) > 1:
        raise InputError(f"nerfstudio takes lenses of one model, not {' and '.join(sorted(models))} together")
    shared = {} if r.has_own_lenses else lenses[0]  # shared values hide those of a frame
    content = {
        "camera_model": models.pop(),
        **shared,
        "frames": [
            {"file_path": f"images/{name}", "transform_matrix": matrix, **({} if shared else lens)}
            for name, matrix, lens in zip(names.values(), shot.world_from_film, lenses, strict=True)
        ],
        "ply_file_path": "points.ply",
        "applied_transform": np.column_stack([shot.world, np.zeros(3)]),
        "applied_scale": shot.scale,
    }
    (folder / "transforms.json").write_text(json_text(content), encoding="utf-8")
    write_ply(shot.reconstruction, folder / "points.ply")
    if shot.footage is None:
        logger.warning("there is no footage: put the frames into images/ under the names of transforms.json")
        return
    for source in image_sources(shot.footage, r.options):
        shift = shot.numbering.shift if source.path == shot.footage else -source.first
        here = {index + shift: name for index, name in names.items() if source.holds(index)}
        if source.path is None and here:
            logger.warning("there are no files of %s: put these images into images/", ", ".join(here.values()))
        elif source.path is not None and here:
            _write_images(source.path, here, folder / "images", shot.fields)


def _trained_name(name: str) -> str:
    """The name of the image for training, which is 8-bit PNG where nerfstudio cannot read the file itself."""
    return (
        str(PurePath(name).with_suffix(".png")) if PurePath(name).suffix.lower() in PLATE_SUFFIXES else image_name(name)
    )


def _lens(camera: pycolmap.Camera) -> dict[str, Any]:
    if camera.model_name not in _MODELS:
        raise InputError(f"nerfstudio does not know the lens model {camera.model_name}; it knows {', '.join(_MODELS)}")
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


def _write_images(footage: Path, names: dict[int, str], folder: Path, fields: Fields) -> None:
    """Copy image files, and write the frames of a video as images without loss.

    Args:
        names: of the images, by index in the footage; fields: as in `read_frames`.
    """
    for name in names.values():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    missing = {index for index, name in names.items() if not (footage / name).is_file()}
    for index in names.keys() - missing:
        shutil.copyfile(footage / names[index], folder / names[index])
    if not missing:
        return
    indices = sorted(missing)
    for frame in read_frames(footage, slice(indices[0], indices[-1] + 1), fields=fields):
        if frame.index not in missing:
            continue
        missing.remove(frame.index)
        write_image(folder / names[frame.index], frame.image)
    if missing:
        raise InputError(f"the footage {footage} lacks frame {min(missing)}")
