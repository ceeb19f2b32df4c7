"""The formats by name, and the function that writes any of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from factorsfm.export.after_effects import write_after_effects
from factorsfm.export.alembic import write_alembic
from factorsfm.export.blender import write_blender
from factorsfm.export.colmap import write_colmap, write_colmap_binary, write_colmap_training
from factorsfm.export.lens import write_lens
from factorsfm.export.nerfstudio import write_nerfstudio
from factorsfm.export.nuke import write_chan, write_nuke
from factorsfm.export.opentrackio import write_opentrackio
from factorsfm.export.options import ExportOptions
from factorsfm.export.ply import write_ply
from factorsfm.export.shot import Defaults, Shot, make_shot
from factorsfm.export.stmap import write_stmaps, write_undistorted
from factorsfm.export.tracks import (
    write_3de_tracks,
    write_after_effects_tracks,
    write_blender_tracks,
    write_camera_tracker_tracks,
    write_csv_tracks,
    write_nuke_tracks,
)
from factorsfm.export.trajectory import write_kitti, write_tum
from factorsfm.export.usd import write_usd
from factorsfm.export.writing import complete_file, complete_folder
from factorsfm.frames.targets import spare_footage
from factorsfm.result.image_sources import footage_of
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError
from factorsfm.support.file_names import check_name
from factorsfm.support.first_few import first_few
from factorsfm.support.up_axis import UpAxis

_AS_RECONSTRUCTED = Defaults()


@dataclass(frozen=True, slots=True)
class Format:
    """An export format.

    Attributes:
        description: in a few words.
        write: called with the shot and a path: a new file, or an empty folder.
        is_folder: whether the format is a folder of files.
        defaults: values of options that the user does not set.
        trains: whether trainers of splats and radiance fields read it: images can be undistorted and masked.
    """

    description: str
    write: Callable[[Shot, Path], None]
    is_folder: bool = False
    defaults: Defaults = _AS_RECONSTRUCTED
    trains: bool = False


def _reconstruction_only(write: Callable[[Reconstruction, Path], None]) -> Callable[[Shot, Path], None]:
    return lambda shot, path: write(shot.reconstruction, path)


def _colmap(write: Callable[[Reconstruction, Path], None]) -> Callable[[Shot, Path], None]:
    """The model alone, or with images and masks."""

    def write_either(shot: Shot, path: Path) -> None:
        if shot.options.undistorted:
            write_colmap_training(shot, path, write)
        else:
            write(shot.reconstruction, path)

    return write_either


FORMATS = {
    "colmap": Format("COLMAP model, text", _colmap(write_colmap), is_folder=True, trains=True),
    "colmap-binary": Format("COLMAP model, binary", _colmap(write_colmap_binary), is_folder=True, trains=True),
    "nerfstudio": Format(
        "transforms.json with images and points",
        write_nerfstudio,
        is_folder=True,
        defaults=Defaults(UpAxis.Z),
        trains=True,
    ),
    "ply": Format("points", _reconstruction_only(write_ply)),
    "tum": Format("camera path, TUM", write_tum),
    "kitti": Format("camera path, KITTI", write_kitti),
    "chan": Format("camera path and field of view for Nuke", write_chan, defaults=Defaults(UpAxis.Y, first_frame=1001)),
    "nuke": Format(
        "Nuke script with footage, camera, points and lens",
        write_nuke,
        is_folder=True,
        defaults=Defaults(UpAxis.Y, first_frame=1001),
    ),
    "blender": Format(
        "Python script that builds the scene in Blender", write_blender, defaults=Defaults(UpAxis.Z, first_frame=1)
    ),
    "after-effects": Format(
        "keyframes to paste onto camera and footage",
        write_after_effects,
        is_folder=True,
        defaults=Defaults(UpAxis.MINUS_Y, scale=100.0, first_frame=0, numbered=False),
    ),
    "usd": Format("USD stage", write_usd, defaults=Defaults(UpAxis.Y, scale=100.0, first_frame=1001)),
    "alembic": Format("Alembic archive", write_alembic, defaults=Defaults(UpAxis.Y, first_frame=1001)),
    "stmap": Format(
        "maps that undistort and distort, 32-bit EXR",
        write_stmaps,
        is_folder=True,
        defaults=Defaults(first_frame=1001),
    ),
    "lens": Format(
        "the lens for Nuke, Blender and 3DEqualizer, with its deviation in each", write_lens, is_folder=True
    ),
    "opentrackio": Format(
        "samples of camera and lens in OpenTrackIO",
        write_opentrackio,
        defaults=Defaults(UpAxis.Z, first_frame=1001),
    ),
    "undistorted": Format(
        "the footage without distortion", write_undistorted, is_folder=True, defaults=Defaults(first_frame=1001)
    ),
    "tracks-csv": Format("2-D tracks as a table", write_csv_tracks),
    "tracks-nuke": Format("2-D tracks as a Nuke Tracker", write_nuke_tracks, defaults=Defaults(first_frame=1001)),
    "tracks-camera-tracker": Format(
        "2-D tracks as text for Nuke's CameraTracker",
        write_camera_tracker_tracks,
        defaults=Defaults(first_frame=1001),
    ),
    "tracks-3de": Format(
        "2-D tracks as text for 3DEqualizer", write_3de_tracks, defaults=Defaults(first_frame=1, numbered=False)
    ),
    "tracks-blender": Format(
        "script that gives a movie clip the 2-D tracks", write_blender_tracks, defaults=Defaults(first_frame=1)
    ),
    "tracks-after-effects": Format(
        "script that makes nulls of the 2-D tracks", write_after_effects_tracks, defaults=Defaults(numbered=False)
    ),
}


_ANY_SIZES = ("colmap", "colmap-binary", "nerfstudio", "ply", "tum", "kitti")  # all other formats have one film back

_NAMED = 4  # sizes in a message


def export(
    reconstruction: Reconstruction, path: str | Path, *, format: str, options: ExportOptions | None = None
) -> None:
    """Write a reconstruction for another tool; all of it or nothing.

    Args:
        path: the file; for formats with several files the folder: new, empty, or with an earlier export of this format.
            An earlier export is replaced.
        format: a name from `FORMATS`.

    Raises:
        InputError: the format is unknown, a package that it needs is missing, no frame is registered, an image name
            leaves its folder, or the path cannot be written or is that of the footage.
    """
    if format not in FORMATS:
        raise InputError(f'"{format}" is no export format; the formats are {", ".join(FORMATS)}')
    if not reconstruction.registered:
        raise InputError("no frame is registered; there is nothing to export")
    for frame in reconstruction.frames:
        check_name(frame.name)
    chosen = FORMATS[format]
    sizes = sorted({(c.width, c.height) for c in map(reconstruction.camera_of, reconstruction.registered)})
    if len(sizes) > 1 and format not in _ANY_SIZES:
        raise InputError(
            f"{format} is for images of one size, and these have {first_few([f'{w}x{h}' for w, h in sizes], _NAMED)} "
            f"pixels; {', '.join(_ANY_SIZES)} take them"
        )
    options = options or ExportOptions()
    _check_training(format, options)
    spare_footage([path], options.footage, *footage_of(reconstruction.options))
    shot = make_shot(reconstruction, options, chosen.defaults)
    with complete_folder(Path(path), format) if chosen.is_folder else complete_file(Path(path)) as place:
        chosen.write(shot, place)


def _check_training(format: str, options: ExportOptions) -> None:
    """Refuse options of formats for training where they say nothing."""
    trains = [name for name, known in FORMATS.items() if known.trains]
    if (options.undistorted or options.masks is not None) and format not in trains:
        raise InputError(f"undistorted images and masks are for {', '.join(trains)}, not for {format}")
    if options.masks is not None and format != "nerfstudio" and not options.undistorted:
        raise InputError(f"masks go with images, which {format} has only undistorted")
