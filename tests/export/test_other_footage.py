"""Exports on other footage than what was solved: another size, other numbers, movies for sequences."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm.export import ExportOptions, export
from factorsfm.export.footage import image_sequence
from factorsfm.frames.folders import read_pixels
from factorsfm.frames.plates import read_exr
from factorsfm.frames.reading import read_frames
from factorsfm.frames.writing import write_exr
from factorsfm.report.overlay import write_overlay
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.support.errors import InputError
from tests.export_problems import hard_reconstruction, noise_images
from tests.exported_files import after_effects_tracks, exported, nuke_nodes
from tests.video_files import interlaced, moving_texture, write_video


def numbered(first: int = 1001) -> Reconstruction:
    """Solved on a sequence that begins at `first`: frames first + 10 to first + 20."""
    reconstruction = hard_reconstruction(options={"first_number": first})
    frames = [
        replace(frame, index=first + frame.index, name=f"shot.{first + frame.index:04d}.png", timestamp=None)
        for frame in reconstruction.frames
    ]
    return replace(reconstruction, frames=frames)


def movie(path: Path, count: int = 21) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 24, (640, 480))
    for value in range(count):
        writer.write(np.full((480, 640, 3), 10 * value, np.uint8))
    writer.release()
    return path


def chan_numbers(reconstruction: Reconstruction, folder: Path, **options: object) -> list[int]:
    export(reconstruction, folder / "a.chan", format="chan", options=ExportOptions(**options))
    return np.loadtxt(folder / "a.chan")[:, 0].astype(int).tolist()


def test_frames_of_a_sequence_have_the_numbers_of_their_files(tmp_path: Path) -> None:
    assert chan_numbers(numbered(1033), tmp_path) == [1043, 1045, 1047, 1051, 1053]
    assert chan_numbers(numbered(1033), tmp_path, first_frame=1) == [11, 13, 15, 19, 21]
    assert chan_numbers(numbered(0), tmp_path) == [10, 12, 14, 18, 20]
    assert chan_numbers(hard_reconstruction(), tmp_path) == [1011, 1013, 1015, 1019, 1021]  # a movie
    export(numbered(1033), tmp_path / "ae", format="after-effects")
    _, tracks = after_effects_tracks((tmp_path / "ae" / "camera.txt").read_text())
    assert list(tracks["Transform\tPosition"]) == [10, 12, 14, 18, 20]  # counted in its composition


@pytest.mark.parametrize(
    ("solved", "first", "start", "number"),
    [
        (numbered(1001), 1001, "1001", 1011),  # the source itself
        (numbered(1001), 1009, "1009", 1011),  # fewer handles: the numbers decide
        (numbered(1001), 2001, "2001", 2011),  # other numbers: first goes on first
        (hard_reconstruction(), 1043, "1043", 1053),  # a movie was solved
    ],
)
def test_nuke_shows_the_sequence_at_its_own_numbers(
    tmp_path: Path, solved: Reconstruction, first: int, start: str, number: int
) -> None:
    footage = noise_images(tmp_path / "shot", 21)
    for path in sorted(footage.iterdir(), reverse=first > 1001):
        path.rename(footage / f"shot.{int(path.stem[5:]) - 1001 + first:04d}.png")
    export(solved, tmp_path / "out", format="nuke", options=ExportOptions(footage=footage))
    nodes = nuke_nodes((tmp_path / "out" / "camera.nk").read_text())
    assert nodes["Plate"]["first"] == nodes["Plate"]["frame"] == start
    assert nodes["Root"]["first_frame"] == str(number)
    export(solved, tmp_path / "out", format="nuke", options=ExportOptions(footage=footage, first_frame=1))
    moved = nuke_nodes((tmp_path / "out" / "camera.nk").read_text())
    assert int(start) - int(moved["Plate"]["frame"]) == number - int(moved["Root"]["first_frame"])


def test_a_movie_behind_a_solved_sequence(tmp_path: Path) -> None:
    footage = movie(tmp_path / "shot.avi")
    export(numbered(1033), tmp_path / "out", format="nuke", options=ExportOptions(footage=footage))
    plate = nuke_nodes((tmp_path / "out" / "camera.nk").read_text())["Plate"]
    assert (plate["first"], plate["last"], plate["frame"]) == ("1", "21", "1033")


def test_the_number_need_not_be_last_in_the_name(tmp_path: Path) -> None:
    for number in range(1001, 1004):
        (tmp_path / f"shot_{number}_v02.png").touch()
    sequence = image_sequence(tmp_path)
    assert Path(sequence.pattern) == tmp_path / "shot_%04d_v02.png"
    assert (sequence.first, sequence.last) == (1001, 1003)


def test_gaps_of_the_footage_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    footage = noise_images(tmp_path / "shot", 21)
    (footage / "shot.1005.png").unlink()
    export(numbered(), tmp_path / "out", format="nuke", options=ExportOptions(footage=footage))
    plate = nuke_nodes((tmp_path / "out" / "camera.nk").read_text())["Plate"]
    assert (plate["first"], plate["last"], plate["on_error"]) == ("1001", "1021", "black")
    assert "have gaps: 1005 are missing" in caplog.text


@pytest.mark.parametrize("size", [(2560, 1920), (320, 240), (801, 600)])
def test_lens_and_observations_are_scaled_about_the_corner(tmp_path: Path, size: tuple[int, int]) -> None:
    footage = noise_images(tmp_path / "big", 21, *size)
    solved = numbered()
    export(solved, tmp_path / "out", format="colmap", options=ExportOptions(footage=footage))
    model = pycolmap.Reconstruction(tmp_path / "out")
    (camera,) = model.cameras.values()
    assert (camera.width, camera.height) == size
    x, y = size[0] / 640, size[1] / 480
    expected = [600 * x, 1200 * y, 290 * x, 262 * y, *solved.camera.params[4:]]
    np.testing.assert_allclose(camera.params, expected, rtol=1e-12)
    original = solved.observation_xy[np.isin(solved.observation_frame, [0])] + 0.5
    found = np.array([p.xy for p in model.image(1012).points2D])
    scaled = original * [x, y]
    assert np.abs(found[:, None] - scaled[None]).max(axis=2).min(axis=1).max() < 1e-5


def assert_drawn_over(shown: np.ndarray, original: np.ndarray) -> None:
    """The lens has pixels of 2 (anamorphic): the picture is stretched to square ones."""
    height, width = original.shape[:2]
    stretched = cv2.resize(original, (round(width * 1200 / 600), height), interpolation=cv2.INTER_CUBIC)
    assert shown.shape == (height, stretched.shape[1], 3)
    assert np.median(cv2.absdiff(shown[:, : stretched.shape[1]], stretched)) < 12  # JPEG, and what is drawn


def test_interlaced_footage_is_read_as_the_result_was(tmp_path: Path) -> None:
    footage = interlaced(tmp_path / "shot.mp4", moving_texture(14, size=(640, 480)) * 3)
    blended = hard_reconstruction(options={"fields": "blend"})
    write_overlay(blended, tmp_path / "out.avi", footage)
    frames = list(read_frames(footage, fields="blend"))
    for picture, frame in zip(read_frames(tmp_path / "out.avi"), blended.frames, strict=True):
        assert_drawn_over(picture.image, frames[frame.index].image)
    with pytest.raises(InputError, match="640x240 pixels"):  # its fields taken apart
        write_overlay(hard_reconstruction(options={"fields": "auto"}), tmp_path / "auto.avi", footage)


@pytest.mark.parametrize("format", ["nuke", "blender", "tracks-blender"])
@pytest.mark.parametrize(
    ("fields", "marked", "is_plate"),
    [
        ("auto", True, False),
        ("apart", True, False),
        ("apart", False, False),
        ("blend", True, True),
        ("auto", False, True),
    ],
)
def test_a_movie_whose_fields_were_solved_is_no_plate(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, format: str, fields: str, marked: bool, is_plate: bool
) -> None:
    moments = moving_texture(48, size=(640, 480))
    path = tmp_path / "shot.mp4"
    footage = interlaced(path, moments) if marked else write_video(path, moments[::2])
    solved = hard_reconstruction("PINHOLE", options={"source": str(footage), "fields": fields})
    export(solved, tmp_path / "out", format=format)
    script = (tmp_path / "out" / "camera.nk" if format == "nuke" else tmp_path / "out").read_text()
    assert (str(footage) in script) == is_plate
    if is_plate:
        assert caplog.messages == []
        return
    (message,) = caplog.messages
    assert message == (
        f"there is no plate: {footage} is interlaced, and the result is of its fields, twice the frames of half the "
        "lines; the format undistorted writes plates of the fields"
    )
    half = pycolmap.Camera(model="PINHOLE", width=640, height=240, params=[600, 600, 290, 131])
    solved, options = replace(solved, camera=half), ExportOptions(footage=footage)
    with pytest.raises(InputError, match="is of its fields, twice the frames"):
        export(solved, tmp_path / "new", format=format, options=options)
    export(solved, tmp_path / "plates", format="undistorted", options=options)
    assert exported(tmp_path / "plates") == {f"plate.{1001 + k}.png" for k in range(48)}


LACKS = "the footage {} has {} of the 6 frames of the result; it lacks {}"


@pytest.mark.parametrize("format", ["nuke", "blender", "tracks-blender", "undistorted"])
@pytest.mark.parametrize(
    ("solved", "kind", "count", "said"),
    [
        (numbered(), "sequence", 21, None),
        (numbered(), "sequence", 20, (5, "1021")),
        (numbered(), "sequence", 14, (2, "1015 to 1021")),
        (hard_reconstruction(), "sequence", 14, (2, "1015 to 1021")),
        (hard_reconstruction(), "movie", 21, None),
        (hard_reconstruction(), "movie", 14, (2, "{} to {}")),
        (numbered(), "movie", 20, (5, "1021")),
    ],
)
def test_footage_that_lacks_frames_is_told(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    format: str,
    solved: Reconstruction,
    kind: str,
    count: int,
    said: tuple[int, str] | None,
) -> None:
    footage = noise_images(tmp_path / "shot", count) if kind == "sequence" else movie(tmp_path / "shot.avi", count)
    straight = replace(solved, camera=hard_reconstruction("PINHOLE").camera)
    export(straight, tmp_path / "out", format=format, options=ExportOptions(footage=footage))
    first = 1 if "blender" in format else 1001
    wanted = [] if said is None else [LACKS.format(footage, said[0], said[1].format(first + 14, first + 20))]
    assert caplog.messages == wanted


def test_plates_that_are_not_written_for_gaps_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    footage = noise_images(tmp_path / "shot", 21)
    for number in (1011, 1014, 1015):
        (footage / f"shot.{number}.png").unlink()
    options = ExportOptions(footage=footage, first_frame=1)
    export(numbered(), tmp_path / "out", format="undistorted", options=options)
    assert caplog.messages == [LACKS.format(footage, 4, "11, 15")]  # 14 is no frame of the result


@pytest.mark.parametrize("format", ["nuke", "blender", "nerfstudio", "chan", "undistorted"])
def test_another_aspect_ratio_is_refused_with_the_numbers(tmp_path: Path, format: str) -> None:
    footage = noise_images(tmp_path / "wide", 1, 640, 360)
    with pytest.raises(InputError, match=r"640x360 pixels \(aspect ratio 1.778\) and the result 640x480 \(1.333\)"):
        export(numbered(), tmp_path / "out", format=format, options=ExportOptions(footage=footage))
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match=r"640x360 pixels \(aspect ratio 1.778\)"):
        write_overlay(numbered(), tmp_path / "out.avi", footage)


def test_nerfstudio_takes_images_and_lens_of_the_originals(tmp_path: Path) -> None:
    footage = noise_images(tmp_path / "big", 21, 1280, 960)
    export(numbered(), tmp_path / "out", format="nerfstudio", options=ExportOptions(footage=footage))
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert (content["w"], content["h"], content["fl_x"], content["cy"]) == (1280, 960, 1200, 524)
    for entry in content["frames"]:
        assert cv2.imread(str(tmp_path / "out" / entry["file_path"])).shape == (960, 1280, 3)


def test_neither_footage_nor_source_is_overwritten(tmp_path: Path) -> None:
    source, other = movie(tmp_path / "shot.avi"), movie(tmp_path / "other.avi")
    (tmp_path / "link.avi").symlink_to(source)
    solved = replace(hard_reconstruction(), options={"source": str(source)})
    before = source.read_bytes(), other.read_bytes()
    for path in (source, tmp_path / "link.avi", other):
        with pytest.raises(InputError, match="would overwrite the footage"):
            write_overlay(solved, path, other)
        with pytest.raises(InputError, match="would overwrite the footage"):
            export(solved, path, format="ply", options=ExportOptions(footage=other))
    assert (source.read_bytes(), other.read_bytes()) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.avi", "other.avi", "shot.avi"]


def test_plates_are_not_replaced_by_undistorted_ones(tmp_path: Path) -> None:
    for number in range(1001, 1023):
        cv2.imwrite(str(tmp_path / f"plate.{number}.png"), np.full((480, 640, 3), number - 1000, np.uint8))
    solved = replace(numbered(), options={"first_number": 1001, "source": str(tmp_path)})
    with pytest.raises(InputError, match="would overwrite the footage"):
        export(solved, tmp_path, format="undistorted")
    assert int(cv2.imread(str(tmp_path / "plate.1011.png"))[0, 0, 0]) == 11


def test_overlay_on_the_originals(tmp_path: Path) -> None:
    footage = noise_images(tmp_path / "big", 21, 1280, 960)
    write_overlay(numbered(), tmp_path / "out.avi", footage)
    shown = next(read_frames(tmp_path / "out.avi")).image
    assert_drawn_over(shown, cv2.imread(str(footage / "shot.1011.png")))


@pytest.mark.parametrize("kind", ["half", "16 bits"])
def test_undistorted_plates_keep_the_bits_of_the_originals(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "plates"
    folder.mkdir()
    light = cv2.resize(np.random.default_rng(0).random((6, 8, 3)).astype(np.float32), (640, 480)) * 9
    if kind == "half":
        write_exr(folder / "plate.1001.exr", light.astype(np.float16))
        original = read_exr(folder / "plate.1001.exr").astype(np.float32)
    else:
        original = (light * 7000).astype(np.uint16)
        cv2.imwrite(str(folder / "plate.1001.png"), original)
    solved = numbered()
    export(solved, tmp_path / "out", format="undistorted", options=ExportOptions(footage=folder))
    (name,) = exported(tmp_path / "out")
    assert name == ("plate.1001.exr" if kind == "half" else "plate.1001.png")
    matrix = np.array([[600, 0, 289.5], [0, 1200, 261.5], [0, 0, 1]], float)
    maps = cv2.initUndistortRectifyMap(matrix, solved.camera.params[4:], np.eye(3), matrix, (640, 480), cv2.CV_32FC1)
    expected = cv2.remap(original, *maps, cv2.INTER_CUBIC).astype(np.float64)
    found = read_pixels(tmp_path / "out" / name)
    assert found.dtype == (np.float16 if kind == "half" else np.uint16)
    np.testing.assert_allclose(found[50:-50, 50:-50], expected[50:-50, 50:-50], rtol=4e-3, atol=0.01)
