"""Footage and files as they come: every bad input through the one call and through the command line."""

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from onnx import TensorProto, helper, save

import factorsfm
from factorsfm import FrameStatus, InputError, ReconstructionError, ShotKind, read_frames
from factorsfm.camera.files import camera_to_json
from factorsfm.cli.main import main
from factorsfm.evaluation.metrics import rotation_angle
from factorsfm.evaluation.readers import read_shot
from tests.rendered import FRAMES, Maps, errors_of, quick_presets, rendered, simulated_maps

Images = list[np.ndarray]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr("factorsfm.support.options.PRESETS", quick_presets())
    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = before


def reconstruct(images: Images, depth: Any = None, **arguments: Any) -> factorsfm.Reconstruction:
    arguments.setdefault("camera", rendered("dolly").camera)
    return factorsfm.reconstruct(images, depth=depth, **arguments)


def write_images(folder: Path, images: Images) -> Path:
    folder.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k:04d}.png"), image)
    return folder


def write_camera(path: Path, **changes: Any) -> Path:
    path.write_text(json.dumps(camera_to_json(rendered("dolly").camera) | changes))
    return path


def write_maps(folder: Path, maps: dict[str, np.ndarray]) -> Path:
    folder.mkdir()
    for name, values in maps.items():
        np.save(folder / f"{name}.npy", values)
    return folder


class Cli:
    """Runs the command line beside the files of a test, and checks what every failure has in common."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self.capsys = folder, capsys
        self.output = folder / "out"

    def run(self, source: Path | str, *arguments: Path | str, output: Path | None = None) -> int:
        given = list(map(str, arguments))
        depth = [] if "--depth" in given else ["--depth", "none"]
        return main(["reconstruct", str(source), "--output", str(output or self.output), *depth, *given])

    def refuses(self, words: str, source: Path | str, *arguments: Path | str, output: Path | None = None) -> None:
        before = snapshot(self.folder)
        assert self.run(source, *arguments, output=output) == 2
        self.one_line(words)
        assert snapshot(self.folder) == before

    def fails(self, words: str, source: Path | str, *arguments: Path | str) -> dict[str, Any]:
        """Exit status 3; only the summary, which is returned, and the report are written."""
        assert self.run(source, *arguments) == 3
        self.one_line(words)
        assert {path.name for path in self.output.iterdir()} == {"summary.json", "report.html"}
        summary = json.loads((self.output / "summary.json").read_text())
        assert summary["reconstructed"] is False
        assert words in summary["reason"]
        return summary

    def one_line(self, words: str) -> None:
        captured = self.capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("factorsfm: error: ")
        assert captured.err.count("\n") == 1
        assert "Traceback" not in captured.err
        assert words in captured.err


@pytest.fixture
def cli(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Cli:
    return Cli(tmp_path, capsys)


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """Every file and folder below, with its content."""
    return {str(p): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


# --- sources that are none ----------------------------------------------------------------------------------------


def missing(folder: Path) -> Path:
    return folder / "shot.mp4"


def no_video(folder: Path) -> Path:
    path = folder / "shot.mp4"
    path.write_bytes(b"This is no video. " * 500)
    return path


def empty_file(folder: Path) -> Path:
    path = folder / "shot.mov"
    path.touch()
    return path


def empty_folder(folder: Path) -> Path:
    (folder / "images").mkdir()
    return folder / "images"


def folder_without_images(folder: Path) -> Path:
    empty_folder(folder)
    (folder / "images" / "notes.txt").write_text("x")
    return folder / "images"


def one_image_file(folder: Path) -> Path:
    return write_images(folder / "images", rendered("dolly").images[:1]) / "0000.png"


def damaged_image(folder: Path) -> Path:
    images = write_images(folder / "images", rendered("dolly").images[:4])
    (images / "0002.png").write_bytes(b"\x89PNG\r\n")
    return images


def other_size(folder: Path) -> Path:
    images = rendered("dolly").images
    return write_images(folder / "images", [*images[:2], images[2][:100], *images[3:]])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (missing, "does not exist"),
        (no_video, "cannot be decoded as a video"),
        (empty_file, "cannot be decoded as a video"),
        (empty_folder, "holds no images"),
        (folder_without_images, "holds no images"),
        (one_image_file, "is a single image"),
        (damaged_image, "0002.png cannot be decoded"),
        (other_size, "has 320x100 pixels"),
    ],
)
def test_a_source_that_cannot_be_read(make: Callable[[Path], Path], words: str, cli: Cli) -> None:
    source = make(cli.folder)
    cli.refuses(words, source)
    with pytest.raises(InputError, match=words):
        factorsfm.reconstruct(source, depth=None)


def test_frames_that_the_source_does_not_have(cli: Cli) -> None:
    source = write_images(cli.folder / "images", rendered("dolly").images[:3])
    cli.refuses("holds no frames from number 50 on", source, "--frames", "50:60")
    cli.refuses("is empty; STOP must be larger", source, "--frames", "2:1")


@pytest.mark.parametrize(("height", "width"), [(1, 480), (16, 16), (400, 20)])
def test_images_without_room_for_a_patch(height: int, width: int, cli: Cli) -> None:
    images = [np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)] * 3
    words = f"the images have {width}x{height} pixels; at least 32 on each side are needed"
    cli.refuses(words, write_images(cli.folder / "images", images))
    with pytest.raises(InputError, match=words):
        reconstruct(images, camera=None)


def test_no_frames_in_a_sequence() -> None:
    with pytest.raises(InputError, match="holds no frames"):
        reconstruct([])


def test_arguments_that_name_nothing() -> None:
    with pytest.raises(InputError, match="no depth kind 'far'"):
        reconstruct(rendered("dolly").images, "tcmonodepth", depth_kind="far")
    with pytest.raises(InputError, match="unknown preset 'best'"):
        reconstruct(rendered("dolly").images, preset="best")
    with pytest.raises(InputError, match=r"the camera is of type int; a pycolmap\.Camera or a file is expected"):
        reconstruct(rendered("dolly").images, camera=35)
    with pytest.raises(InputError, match=r"frames is \(0, 5\); a slice is expected"):
        reconstruct(rendered("dolly").images, frames=(0, 5))


# --- footage that cannot be reconstructed -------------------------------------------------------------------------


def one_frame() -> Images:
    return rendered("dolly").images[:1]


def black() -> Images:
    return [np.zeros((180, 320, 3), np.uint8)] * 6


def black_with_noise() -> Images:
    generator = np.random.default_rng(0)
    return [generator.integers(0, 4, (180, 320, 3)).astype(np.uint8) for _ in range(6)]


def blurred() -> Images:
    return [cv2.GaussianBlur(image, (0, 0), 25) for image in rendered("dolly").images[:6]]


def twenty_dots() -> Images:
    places = np.random.default_rng(3).uniform((40, 30), (260, 150), (20, 2))
    images = [np.full((180, 320, 3), 90, np.uint8) for _ in range(6)]
    for k, image in enumerate(images):
        for x, y in places:
            cv2.circle(image, (int(x) + k, int(y)), 3, (220, 220, 220), -1, cv2.LINE_AA)
    return images


@pytest.mark.parametrize(
    ("make", "words", "status"),
    [
        (one_frame, "frames in the shot: 1, at least 2 needed", FrameStatus.WAITING),
        (black, "contrast 0.00 of 0.20 needed grey levels", FrameStatus.BLANK),
        (black_with_noise, "of 0.20 needed grey levels", FrameStatus.BLANK),
        (blurred, "of 0.20 needed grey levels", FrameStatus.BLANK),
        (twenty_dots, "of 30 needed tracks", FrameStatus.TOO_FEW_TRACKS),
    ],
)
def test_footage_without_anything_to_track(
    make: Callable[[], Images], words: str, status: FrameStatus, cli: Cli
) -> None:
    images = make()
    with pytest.raises(ReconstructionError, match=words) as caught:
        reconstruct(images)
    assert [frame.index for frame in caught.value.frames] == list(range(len(images)))
    summary = cli.fails(words, write_images(cli.folder / "images", images))
    assert summary["frames"] == len(images)
    assert summary["statuses"][-1]["status"] == status


@pytest.mark.parametrize("preset", ["default", "paper", "geometry"])
def test_blurred_footage_fails_alike_with_a_prior(preset: str) -> None:
    with pytest.raises(ReconstructionError, match="registered, at least 2 needed"):
        reconstruct(blurred(), Maps(simulated_maps("dolly")), preset=preset)


@pytest.mark.parametrize(("first", "last"), [(0, 2), (4, 6), (7, 10)])
def test_a_black_stretch_costs_its_own_frames_only(first: int, last: int) -> None:
    shot = rendered("dolly")
    dark = [np.zeros_like(shot.images[0])] * (last - first)
    result = reconstruct([*shot.images[:first], *dark, *shot.images[first:]])
    statuses = [frame.status for frame in result.frames]
    assert statuses[first:last] == [FrameStatus.BLANK] * (last - first)
    assert "contrast 0.00 of 0.20" in result.frames[first].message
    del result.frames[first:last]
    assert len(result.registered) == FRAMES
    assert 0.0008 < np.median(errors_of(result, shot).ate) < 0.005


def test_after_a_cut_nothing_is_invented() -> None:
    other = [cv2.flip(image, -1) for image in rendered("truck").images[:5]]
    result = reconstruct(rendered("dolly").images + other)
    assert [frame.registered for frame in result.frames] == [True] * FRAMES + [False] * 5
    assert "needed" in result.frames[-1].message


# --- cameras that do not move, or only turn -----------------------------------------------------------------------


def still() -> Images:
    return [rendered("dolly").images[0]] * 8


def still_with_noise() -> Images:
    generator = np.random.default_rng(1)
    image = rendered("dolly").images[0]
    return [np.clip(image + generator.normal(0, 3, image.shape), 0, 255).astype(np.uint8) for _ in range(8)]


@pytest.mark.parametrize("with_prior", [False, True])
@pytest.mark.parametrize("make", [still, still_with_noise])
def test_a_static_camera_gets_no_motion(make: Callable[[], Images], with_prior: bool) -> None:
    prior = Maps([simulated_maps("dolly")[0]] * 8) if with_prior else None
    result = reconstruct(make(), prior)
    assert result.kind is ShotKind.STATIC
    assert {frame.status for frame in result.frames} == {FrameStatus.STATIC}
    assert result.parallax == 0.0
    np.testing.assert_array_equal(result.camera_centers(), np.zeros((8, 3)))
    turns = [np.degrees(frame.cam_from_world.rotation.angle()) for frame in result.frames]
    assert max(turns) < 0.002
    (note,) = result.notes
    assert note.startswith("The camera is static")
    assert ("from the prior alone" in note) == with_prior


def turn_errors(result: factorsfm.Reconstruction, truth: np.ndarray) -> np.ndarray:
    """Degrees, against true world_from_cam rotations, both relative to the first frame."""
    estimate = np.array([frame.cam_from_world.inverse().rotation.matrix() for frame in result.frames])
    return rotation_angle(estimate[0].T @ estimate, truth[0].T @ truth)


def assert_rotation(result: factorsfm.Reconstruction) -> None:
    assert result.kind is ShotKind.ROTATION
    np.testing.assert_array_equal(result.camera_centers(), np.zeros((len(result.frames), 3)))
    assert result.parallax == 0.0
    assert any("translation is not observable" in note for note in result.notes)


@pytest.mark.parametrize("preset", ["default", "paper", "geometry"])
def test_a_rotating_camera_gets_its_rotation_and_no_translation(preset: str) -> None:
    shot = rendered("rotation")
    result = reconstruct(shot.images, Maps(simulated_maps("rotation")), preset=preset)
    assert_rotation(result)
    truth = np.array([pose.inverse().rotation.matrix() for pose in shot.cam_from_world])
    errors = turn_errors(result, truth)
    assert len(errors) == FRAMES
    assert 0.003 < errors.max() < 0.02  # of 12 degrees


def test_a_camera_that_only_turns_takes_no_control() -> None:
    control = factorsfm.Control(distances=[factorsfm.KnownDistance(0.5, 0.01, frames=(0, FRAMES - 1))])
    result = reconstruct(rendered("rotation").images, Maps(simulated_maps("rotation")), control=control)
    assert_rotation(result)
    assert result.control is None
    assert any(note.startswith("Control: not used") for note in result.notes)


def test_a_tripod_pan_of_the_development_data(shared_data: Path) -> None:
    shot = read_shot(shared_data / "studiosim" / "d10_keep_tripod_pan")
    result = factorsfm.reconstruct(shot.source, camera=shot.camera, depth=None, frames=slice(0, 36, 3))
    assert_rotation(result)
    errors = turn_errors(result, shot.rotations[:36:3])
    assert len(errors) == 12
    assert 6e-4 < errors.max() < 0.005


# --- priors -------------------------------------------------------------------------------------------------------


def all_maps() -> dict[str, np.ndarray]:
    return {f"{k:04d}": values for k, values in enumerate(simulated_maps("dolly"))}


@pytest.mark.parametrize(
    ("maps", "words"),
    [
        (lambda: {k: v[:, :200] for k, v in all_maps().items()}, "the aspect ratios must agree"),
        (lambda: {k: v.T for k, v in all_maps().items()}, "the aspect ratios must agree"),
        (lambda: {k: v.astype(complex) for k, v in all_maps().items()}, "must hold one 2-D array of numbers"),
        (lambda: {k: np.stack([v] * 3, -1) for k, v in all_maps().items()}, "must hold one 2-D array of numbers"),
        (lambda: {str(1000 + k): v for k, v in enumerate(all_maps().values())}, "no depth map in the given folder"),
        (dict, "holds no depth maps"),
    ],
)
def test_depth_folders_that_cannot_be_used(maps: Callable[[], dict[str, np.ndarray]], words: str, cli: Cli) -> None:
    source = write_images(cli.folder / "images", rendered("dolly").images[:6])
    depth = write_maps(cli.folder / "depth", maps())
    cli.refuses(words, source, "--depth", depth, "--depth-kind", "inverse")
    with pytest.raises(InputError, match=words):
        factorsfm.reconstruct(source, depth=depth, depth_kind="inverse")


def test_masks_that_match_no_frame(cli: Cli) -> None:
    source = write_images(cli.folder / "images", rendered("dolly").images[:6])
    masks = cli.folder / "masks"
    masks.mkdir()
    cv2.imwrite(str(masks / "5000.png"), np.zeros((180, 320), np.uint8))
    cli.refuses("no mask in the given folder", source, "--masks", masks)
    cli.refuses("the aspect ratios must agree", source, "--masks", write_images(cli.folder / "m", [np.eye(50)]))


def test_a_few_maps_are_enough(tmp_path: Path) -> None:
    source = write_images(tmp_path / "images", rendered("dolly").images)
    some = {name: values[::2, ::2] for name, values in all_maps().items() if int(name) in (0, 7)}
    result = factorsfm.reconstruct(
        source, camera=rendered("dolly").camera, depth=write_maps(tmp_path / "depth", some), depth_kind="inverse"
    )
    assert len(result.registered) == FRAMES
    assert not any("took no part" in note for note in result.notes)
    assert result.frames[0].prior is not None
    assert 0.0008 < np.median(errors_of(result, rendered("dolly")).ate) < 0.005


@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0, np.inf])
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_maps_without_a_valid_value_are_as_good_as_none(preset: str, value: float) -> None:
    depth = Maps([np.full((90, 160), value, np.float32)] * FRAMES)
    result = reconstruct(rendered("dolly").images, depth, preset=preset)
    assert len(result.registered) == FRAMES
    assert "The depth prior took no part: no frame that needed it has a usable depth map." in result.notes
    assert 0.0008 < np.median(errors_of(result, rendered("dolly")).ate) < 0.005


def test_a_flat_prior_does_no_harm() -> None:
    result = reconstruct(rendered("dolly").images, Maps([np.ones((90, 160), np.float32)] * FRAMES))
    assert len(result.registered) == FRAMES
    assert 0.0008 < np.median(errors_of(result, rendered("dolly")).ate) < 0.005


def failing_network(path: Path) -> Path:
    """Loads like any depth network and fails at its first image: it reshapes to a size that does not fit."""
    nodes = [helper.make_node("Reshape", ["image", "shape"], ["depth"])]
    shape = helper.make_tensor("shape", TensorProto.INT64, [4], [1, 1, 7, 11])
    graph = helper.make_graph(
        nodes,
        "failing",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 32, 64])],
        [helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 1, "h", "w"])],
        [shape],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    save(model, str(path))
    return path


def test_a_depth_network_that_fails(cli: Cli) -> None:
    source = write_images(cli.folder / "images", rendered("dolly").images[:3])
    network = failing_network(cli.folder / "network.onnx")
    cli.refuses("network.onnx", source, "--depth", network)
    (cli.folder / "broken.onnx").write_bytes(b"no network")
    cli.refuses("broken.onnx", source, "--depth", cli.folder / "broken.onnx")
    cli.refuses("no depth prior", source, "--depth", cli.folder / "absent")


def test_a_prior_of_the_user_that_raises(cli: Cli) -> None:
    class Raising(Maps):
        def __call__(self, frame: factorsfm.Frame) -> None:
            raise RuntimeError("out of memory")

    for preset in ("default", "paper"):
        with pytest.raises(InputError, match=r"failed on frame 0: RuntimeError\('out of memory'\)"):
            reconstruct(rendered("dolly").images, Raising([]), preset=preset)


# --- camera files and output --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"width": 640, "height": 360}, "made for 640x360 pixels, but the images have 320x180"),
        ({"width": 180, "height": 320}, "made for 180x320 pixels"),
        ({"width": "wide"}, "width"),
        ({"model": "SCIENTIFIC"}, "SCIENTIFIC"),
    ],
)
def test_camera_files_that_contradict(changes: dict[str, Any], words: str, cli: Cli) -> None:
    source = write_images(cli.folder / "images", rendered("dolly").images[:3])
    cli.refuses(words, source, "--camera", write_camera(cli.folder / "camera.json", **changes))


def test_output_that_cannot_be_written(cli: Cli) -> None:
    source = write_images(cli.folder / "images", rendered("dolly").images[:3])
    cli.refuses("cannot write to the output folder", source, output=source / "0000.png")
    cli.refuses("cannot write to the output folder", source, output=source / "0000.png" / "out")
    cli.refuses("cannot write to the output folder", source, output=Path("/proc/factorsfm-out"))
    cli.refuses("is not empty and holds no earlier factorsfm result", source, output=source)


def test_a_disk_that_fills_up_leaves_nothing(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_images(cli.folder / "images", rendered("dolly").images[:4])

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("factorsfm.report.result_folder.write_ply", full)
    cli.refuses("No space left on device", source)


def test_good_footage_through_the_command_line_after_bad(cli: Cli) -> None:
    """The reason of a failure gives way to a result, and a result to a result."""
    cli.fails("needed grey levels", write_images(cli.folder / "dark", black()))
    source = write_images(cli.folder / "images", rendered("dolly").images[:5])
    camera = write_camera(cli.folder / "camera.json")
    for _ in range(2):
        assert cli.run(source, "--camera", camera) == 0
        captured = cli.capsys.readouterr()
        assert captured.err == ""
        assert "all 5 frames registered" in captured.out
        names = {path.name for path in cli.output.iterdir()}
        assert names == {"colmap", "points.ply", "report.html", "summary.json", "tracks.npz", "trajectory.tum"}
    assert len((cli.output / "trajectory.tum").read_text().splitlines()) == 5


def test_frames_are_read_no_further_than_asked(cli: Cli) -> None:
    """What lies beyond the range may be damaged."""
    images = write_images(cli.folder / "images", rendered("dolly").images[:6])
    (images / "0005.png").write_bytes(b"x")
    assert cli.run(images, "--frames", "0:5") == 0
    with pytest.raises(InputError, match=r"0005\.png"):
        list(read_frames(images))


def test_images_that_are_not_read_beside_others_are_noted(tmp_path):
    folder = write_images(tmp_path / "shot", rendered("dolly").images)
    (folder / "0020.heic").write_bytes(b"not read")
    (folder / "0001.dng").write_bytes(b"of the same picture")
    result = reconstruct(folder)
    assert "Images in formats that are not read, and left out: 0020.heic." in result.notes
