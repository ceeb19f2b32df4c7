"""A Python script that builds the scene in Blender: animated camera, points, footage behind the camera."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.export.footage import Sequence, background
from factorsfm.export.shot import Shot
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

# What Blender takes; it moves every other value into these ranges without a word.
_MOST_FPS, _LAST_FRAME, _LEAST_MM = 32767, 1048574, 1.0

_BUILD = """
import bpy

scene = bpy.context.scene
scene.render.resolution_x, scene.render.resolution_y = DATA["size"]
scene.render.resolution_percentage = 100
scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = DATA["pixel_aspect"]
scene.render.fps, scene.render.fps_base = DATA["fps"]
scene.frame_start, scene.frame_end = DATA["range"]

collection = bpy.data.collections.new("factorsfm")
scene.collection.children.link(collection)

lens = bpy.data.cameras.new("factorsfm camera")
lens.sensor_fit = "HORIZONTAL"
lens.sensor_width, lens.sensor_height = DATA["sensor"]
lens.lens = DATA["focal_length"]
lens.shift_x, lens.shift_y = DATA["shift"]
lens.clip_start, lens.clip_end = DATA["clip"]
camera = bpy.data.objects.new("factorsfm camera", lens)
collection.objects.link(camera)
scene.camera = camera
camera.rotation_mode = "QUATERNION"
camera["not_registered"] = DATA["lost"]

for frame, location, rotation in zip(DATA["frames"], DATA["locations"], DATA["rotations"]):
    camera.location = location
    camera.rotation_quaternion = rotation
    camera.keyframe_insert("location", frame=frame)
    camera.keyframe_insert("rotation_quaternion", frame=frame)
for frame, focal_length in zip(DATA["frames"], DATA["focal_lengths"]):  # of a zoom
    lens.lens = focal_length
    lens.keyframe_insert("lens", frame=frame)

moving = []
for thing in DATA["objects"]:
    null = bpy.data.objects.new(thing["name"], None)
    null.rotation_mode = "QUATERNION"
    collection.objects.link(null)
    for frame, location, rotation in zip(thing["frames"], thing["locations"], thing["rotations"]):
        null.location = location
        null.rotation_quaternion = rotation
        null.keyframe_insert("location", frame=frame)
        null.keyframe_insert("rotation_quaternion", frame=frame)
    moving.append(null)

for action in [data.animation_data.action for data in (camera, lens, *moving) if data.animation_data]:
    if hasattr(action, "fcurves"):
        curves = list(action.fcurves)
    else:  # since Blender 5
        bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
        curves = [curve for bag in bags for curve in bag.fcurves]
    for key in [key for curve in curves for key in curve.keyframe_points]:
        key.interpolation = "LINEAR"

def add_points(name, points, colors):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points, [], [])
    if points:
        mesh.attributes.new("color", "BYTE_COLOR", "POINT").data.foreach_set("color_srgb", colors)
    cloud = bpy.data.objects.new(name, mesh)
    collection.objects.link(cloud)
    return cloud

add_points("factorsfm points", DATA["points"], DATA["colors"])
for thing, null in zip(DATA["objects"], moving):
    if thing["points"]:
        add_points(thing["name"] + " points", thing["points"], thing["colors"]).parent = null

footage = DATA["footage"]
if footage:
    image = bpy.data.images.load(footage["file"])
    image.source = footage["source"]
    behind = lens.background_images.new()
    behind.image = image
    behind.image_user.frame_start = footage["frame_start"]
    behind.image_user.frame_duration = footage["frame_duration"]
    behind.image_user.frame_offset = footage["frame_offset"]
    behind.image_user.use_auto_refresh = True
    behind.alpha = 1.0
    behind.display_depth = "BACK"
    behind.frame_method = "STRETCH"
    lens.show_background_images = True

scene.frame_set(DATA["range"][0])
"""


def write_blender(shot: Shot, path: Path) -> None:
    """Write a script for Blender 3.4 or newer, which is run in Blender or with ``blender --python camera.py``.

    It adds a collection to the open scene and sets the scene's size, pixel aspect, frame rate and range. An object is
    an empty with keys, the parent of its points. Unregistered
    frames have no key (Blender interpolates); the camera's custom property ``not_registered`` lists them. Blender's
    camera has no distortion, so the footage behind it should be undistorted.

    Raises:
        InputError: the footage is a folder whose images are not a numbered sequence, or Blender has no such frames, or
            no lens so short.
    """
    _check_ranges(shot)
    text = json.dumps(_data(shot), allow_nan=False)
    title = '"""Builds the animated camera, the points and the footage of a factorsfm reconstruction in Blender."""'
    path.write_text(f"{title}\n\nimport json\n\nDATA = json.loads({text!r})\n{_BUILD}", encoding="utf-8")


def _check_ranges(shot: Shot) -> None:
    """Refuse what Blender would change."""
    if shot.first < 0 or shot.last > _LAST_FRAME:
        raise InputError(
            f"the frames have the numbers {shot.first} to {shot.last}, and Blender has 0 to {_LAST_FRAME}; "
            "another first frame is expected"
        )
    shortest = min(lens.focal_length for lens in shot.lenses)
    if min(shortest, shot.sensor_width) < _LEAST_MM:
        raise InputError(
            f"the lens has {shortest:.3g} mm on a sensor of {shot.sensor_width:.3g} mm, and Blender has "
            f"{_LEAST_MM:g} mm and more; a larger sensor width is expected"
        )


def _data(shot: Shot) -> dict[str, Any]:
    lens = shot.lens
    fps = min(max(round(shot.fps), 1), _MOST_FPS)  # a whole number, which another one divides
    # In Blender one of the two is 1 and the other one at least 1.
    pixel_aspect = max(lens.pixel_aspect, 1.0), max(1 / lens.pixel_aspect, 1.0)
    return {
        "size": (lens.width, lens.height),
        "pixel_aspect": pixel_aspect,
        "fps": (fps, fps / shot.fps),
        "range": (shot.first, shot.last),
        "sensor": (lens.sensor_width, lens.sensor_height),
        "focal_length": lens.focal_length,
        "focal_lengths": [own.focal_length for own in shot.lenses] if shot.zooms else [],
        "shift": (lens.right / lens.sensor_width, lens.up / lens.sensor_width),
        "clip": shot.clipping,
        "frames": shot.numbers,
        "lost": shot.lost,
        "locations": shot.world_from_film[:, :3, 3].tolist(),
        "rotations": _quaternions(shot.world_from_film),
        "points": shot.reconstruction.points.tolist(),
        "colors": _colors(shot.reconstruction.colors),
        "objects": [
            {
                "name": thing.name,
                "frames": thing.numbers,
                "locations": thing.world_from_object[:, :3, 3].tolist(),
                "rotations": _quaternions(thing.world_from_object),
                "points": thing.points.tolist(),
                "colors": _colors(thing.colors),
            }
            for thing in shot.nulls
        ],
        "footage": _footage(shot),
    }


def _colors(rgb: NDArray[np.uint8]) -> list[float]:
    """Red, green, blue and alpha of all points in a row, from 0 to 1."""
    return list(np.pad(rgb / 255, ((0, 0), (0, 1)), constant_values=1).ravel().tolist())


def _quaternions(matrices: NDArray[np.float64]) -> list[list[float]]:
    """Quaternions w, x, y, z, with signs that keep neighbours close, since Blender interpolates each number."""
    found: list[list[float]] = []
    for matrix in matrices:
        x, y, z, w = pycolmap.Rotation3d(matrix[:3, :3]).quat
        quaternion = np.array([w, x, y, z])
        if found and np.dot(found[-1], quaternion) < 0:
            quaternion = -quaternion
        found.append(quaternion.tolist())
    return found


def _footage(shot: Shot) -> dict[str, Any] | None:
    footage = background(shot)
    if footage is None:
        return None
    if shot.distorts:
        logger.warning("the lens distorts, Blender's camera does not: put undistorted plates behind it")
    if isinstance(footage, Sequence):
        file, source, offset = footage.file(footage.first), "SEQUENCE", footage.first - 1
        duration = footage.last - footage.first + 1
    else:
        file, source, offset = footage, "MOVIE", 0
        duration = shot.in_footage[-1].index + shot.numbering.shift + 1
    return {
        "file": str(file),
        "source": source,
        "frame_start": shot.footage_start,
        "frame_duration": duration,
        "frame_offset": offset,
    }
