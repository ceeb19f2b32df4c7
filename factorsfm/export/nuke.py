"""Nuke: the camera as a ``.chan`` file, and a script with footage, camera, points and lens."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from factorsfm.export.footage import Sequence, background
from factorsfm.export.nulls import Null
from factorsfm.export.rotation import angles_zxy
from factorsfm.export.shot import Lens, Shot
from factorsfm.export.stmap import DISTORT, UNDISTORT, write_stmaps

Array = NDArray[np.float64]

SCRIPT, POINTS = "camera.nk", "points.obj"

# Corners of a tetrahedron around its middle, and its faces.
_CORNERS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], np.float64)
_FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
_BESIDE_SCRIPT = r"\[file dirname \[value root.name]]/"  # an expression that Nuke must not evaluate while loading


def write_chan(shot: Shot, path: Path) -> None:
    """Write one line per registered frame: ``frame tx ty tz rx ry rz vfov``.

    Angles are in degrees, in the rotation order ZXY (Nuke's default: first z, then x, then y); ``vfov`` is the vertical
    field of view. Unregistered frames have no line. The format cannot hold distortion, a principal point off the
    centre, or the film back, which the user must set in the tool: sensor width, and sensor width times height over
    width.
    """
    angles = angles_zxy(shot.world_from_film[:, :3, :3])
    fields = [math.degrees(2 * math.atan(lens.height / (2 * lens.fy))) for lens in shot.lenses]
    lines = [
        " ".join([str(number), *(f"{value:.12g}" for value in (*matrix[:3, 3], *angle, field))])
        for number, matrix, angle, field in zip(shot.numbers, shot.world_from_film, angles, fields, strict=True)
    ]
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def write_nuke(shot: Shot, folder: Path) -> None:
    """Write a script with camera, points, lens and footage, and the files that it reads.

    The script undistorts the footage with one STMap and renders the points over the undistorted plate. Beside that, it
    distorts the render with the other STMap and lays it over the original footage. A lens without distortion has no
    STMaps. The principal point is in the camera's window translation, the aspect of its
    pixels in the format. An object is an axis that moves its points,
    a named point an axis alone. Unregistered frames have no
    key; a note lists them.
    """
    (folder / POINTS).write_text(_tetrahedra(shot.reconstruction.points, shot.point_size), encoding="ascii")
    for thing in _with_points(shot):
        (folder / f"{thing.name}.obj").write_text(_tetrahedra(thing.points, shot.point_size), encoding="ascii")
    if shot.distorts:
        write_stmaps(shot, folder)
    (folder / SCRIPT).write_text(_script(shot), encoding="utf-8")


def _script(shot: Shot) -> str:
    footage = background(shot)
    parts = ["#! nuke", "version 11.0 v1", _root(shot)]
    if shot.lost:
        lost = ", ".join(map(str, shot.lost))
        parts.append(_node("StickyNote", inputs=0, name="NotRegistered", label=f'"No camera at frames {lost}"'))
    parts += [_plate(shot, footage), "set plate [stack 0]"]
    if shot.distorts:
        parts += [_map_reader(shot, UNDISTORT), "push $plate", _stmap("Undistort"), "set plain_plate [stack 0]"]
    else:
        parts += ["push $plate", "set plain_plate [stack 0]"]
    parts += [
        _camera(shot),
        "set camera [stack 0]",
        _node("ReadGeo2", inputs=0, file=f'"{_BESIDE_SCRIPT}{POINTS}"', name="Points"),
        "set points [stack 0]",
        *_objects(shot),
        *("push $camera", "push $points", "push $plain_plate"),
        _node("ScanlineRender", inputs=3, name="PointsOnUndistortedPlate"),
    ]
    if shot.distorts:
        parts += [
            *("push $camera", "push $points", "push 0"),
            _node("ScanlineRender", inputs=3, name="RenderPoints"),
            "set render [stack 0]",
            *(_map_reader(shot, DISTORT), "push $render"),
            _stmap("Distort"),
            "push $plate",
            _node("Merge2", inputs=2, name="PointsOnPlate"),
        ]
    return "\n".join(parts) + "\n"


def _root(shot: Shot) -> str:
    return _node(
        "Root",
        inputs=0,
        frame=shot.first,
        first_frame=shot.first,
        last_frame=shot.last,
        lock_range="true",
        fps=_number(shot.fps),
        format=_format(shot.lens),
    )


def _format(lens: Lens) -> str:
    """The knob of a format with the size and the pixel aspect of the footage."""
    width, height = lens.width, lens.height
    return f'"{width} {height} 0 0 {width} {height} {_number(lens.nominal_aspect)} factorsfm"'


def _plate(shot: Shot, footage: Path | Sequence | None) -> str:
    if footage is None:
        return _node("Constant", inputs=0, format=_format(shot.lens), name="Plate")
    if isinstance(footage, Sequence):
        file, first, last = footage.pattern, footage.first, footage.last
    else:
        file, first, last = footage.as_posix(), 1, shot.in_footage[-1].index + shot.numbering.shift + 1
    return _node(
        "Read",
        inputs=0,
        file=_quoted(file),
        first=first,
        last=last,
        origfirst=first,
        origlast=last,
        origset="true",
        frame_mode='"start at"',
        frame=shot.footage_start,
        format=_format(shot.lens),
        **({"on_error": "black"} if isinstance(footage, Sequence) and footage.missing else {}),
        name="Plate",
    )


def _camera(shot: Shot) -> str:
    lens, focal = shot.lens, np.array([lens.focal_length for lens in shot.lenses])
    return _node(
        "Camera2",
        inputs=0,
        rot_order="ZXY",
        translate=_curves(shot.numbers, shot.world_from_film[:, :3, 3]),
        rotate=_curves(shot.numbers, angles_zxy(shot.world_from_film[:, :3, :3])),
        focal=_curves(shot.numbers, focal[:, None]) if shot.zooms else _number(lens.focal_length),
        haperture=_number(lens.sensor_width),
        vaperture=_number(lens.sensor_height),
        near=_number(shot.clipping[0]),
        far=_number(shot.clipping[1]),
        win_translate=_pair(*_window_translation(lens)),
        # What the format leaves of the ratio of the focal lengths.
        win_scale=_pair(1, lens.nominal_aspect / lens.pixel_aspect),
        name="Camera",
    )


def _with_points(shot: Shot) -> list[Null]:
    return [null for null in shot.nulls if len(null.points)]


def _objects(shot: Shot) -> list[str]:
    """An axis for each object and named point, the points of objects moved by it, and a scene of all points in the
    place of those of the scene."""
    parts, moved = [], _with_points(shot)
    for thing in shot.nulls:
        parts.append(
            _node(
                "Axis2",
                inputs=0,
                rot_order="ZXY",
                translate=_curves(thing.numbers, thing.world_from_object[:, :3, 3]),
                rotate=_curves(thing.numbers, angles_zxy(thing.world_from_object[:, :3, :3])),
                name=thing.name,
            )
        )
        if not len(thing.points):
            continue
        parts += [
            _node("ReadGeo2", inputs=0, file=f'"{_BESIDE_SCRIPT}{thing.name}.obj"', name=f"{thing.name}_points"),
            _node("TransformGeo", inputs=2, name=f"{thing.name}_moved"),
            f"set {thing.name} [stack 0]",
        ]
    if moved:
        parts += [
            *(f"push ${thing.name}" for thing in moved),
            "push $points",
            _node("Scene", inputs=len(moved) + 1, name="AllPoints"),
            "set points [stack 0]",
        ]
    return parts


def _window_translation(lens: Lens) -> tuple[float, float]:
    """The window translation, in halves of the film back's width; Nuke subtracts it before it divides by the scale."""
    return 2 * lens.right / lens.sensor_width, 2 * lens.up / lens.sensor_width


def _map_reader(shot: Shot, name: str) -> str:
    number, frames = (".%04d", {"first": shot.numbers[0], "last": shot.numbers[-1]}) if shot.zooms else ("", {})
    file = f'"{_BESIDE_SCRIPT}{name}{number}.exr"'
    return _node("Read", inputs=0, file_type="exr", file=file, **frames, raw="true", name=f"Map_{name}")


def _stmap(name: str) -> str:
    return _node("STMap", inputs=2, channels="rgba", uv="rgb", name=name)


def _node(kind: str, **knobs: object) -> str:
    return "\n".join([f"{kind} {{", *(f" {name} {value}" for name, value in knobs.items()), "}"])


def _curves(numbers: list[int], values: Array) -> str:
    curves = (
        " ".join(["curve", *(f"x{number} {_number(value)}" for number, value in zip(numbers, column, strict=True))])
        for column in values.T
    )
    return "{" + " ".join(f"{{{curve}}}" for curve in curves) + "}"


def _pair(x: float, y: float) -> str:
    return f"{{{_number(x)} {_number(y)}}}"


def _quoted(text: str) -> str:
    """A Tcl string literal of this text."""
    return '"' + re.sub(r'([\\"\[$])', r"\\\1", text) + '"'


def _number(value: float) -> str:
    return f"{value:.12g}"


def _tetrahedra(points: Array, size: float) -> str:
    """The points as OBJ: a small tetrahedron around each, since not all tools show bare points."""
    vertices = (points[:, None] + size / 2 * _CORNERS).reshape(-1, 3)
    faces = (4 * np.arange(len(points))[:, None, None] + _FACES + 1).reshape(-1, 3)
    return "".join(_obj_lines("v", vertices.tolist())) + "".join(_obj_lines("f", faces.tolist()))


def _obj_lines(kind: str, rows: Iterable[list[float]]) -> Iterable[str]:
    return (f"{kind} {' '.join(f'{value:.9g}' for value in row)}\n" for row in rows)
