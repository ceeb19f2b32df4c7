"""Images added to a finished reconstruction: what is known stays, what is new is where it was taken."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm import (
    Frame,
    FrameStatus,
    InputError,
    Reconstruction,
    ReconstructionError,
    add_images,
    read_result,
    reconstruct,
)
from factorsfm.camera.projection import pixels_from_normalized
from factorsfm.cli import main as cli
from factorsfm.evaluation.metrics import trajectory_errors
from factorsfm.export import export
from factorsfm.support.similarity import align, pose_arrays
from factorsfm.synthetic import RenderedShot, render_shot
from tests.command_line import assert_error
from tests.photographs import photographs

OLD, NEW = (0, 2, 3, 5, 6, 8), (1, 4, 7)


@dataclass(frozen=True)
class Set:
    """Nine photographs of a room on an arc: six are reconstructed and three are left."""

    shot: RenderedShot
    folder: Path
    result: Reconstruction

    def errors(self, result: Reconstruction) -> np.ndarray:
        """Distance of each camera from the truth over the length of the path, after the alignment of the old ones."""
        order = [int(Path(frame.name).stem.rpartition("_")[2]) for frame in result.frames]
        truth = pose_arrays([self.shot.cam_from_world[k] for k in order])
        estimate = pose_arrays([frame.cam_from_world for frame in result.frames])
        old = [row for row, k in enumerate(order) if k in OLD]
        similarity = align(*(part[old] for part in estimate), *(part[old] for part in truth))
        length = np.linalg.norm(truth[1] - truth[1][0], axis=1).max()
        return np.linalg.norm(similarity.points(estimate[1]) - truth[1], axis=1) / length


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Set:
    folder = tmp_path_factory.mktemp("set")
    shot = render_shot("arc", frames=9, width=320, height=240, parallax=0.3)
    for name, rows in (("old", OLD), ("new", NEW), ("all", range(9))):
        (folder / name).mkdir()
        for k in rows:
            cv2.imwrite(str(folder / name / f"{name[0]}_{k}.png"), shot.images[k])
    result = reconstruct(folder / "old", camera=shot.camera, depth=None, unordered=True)
    result.write(folder / "result")
    return Set(shot, folder, result)


@pytest.fixture(scope="module")
def added(material: Set) -> Reconstruction:
    return add_images(material.folder / "result", material.folder / "new")


def assert_consistent(result: Reconstruction) -> None:
    """Every observation is of a point and a frame that are there, and its error is that of the poses and points."""
    assert len(result.colors) == len(result.track_ids) == len(result.points)
    assert len(np.unique(result.track_ids)) == len(result.points)
    pairs = np.stack([result.observation_frame, result.observation_point])
    assert (
        len(np.unique(pairs, axis=1).T) == len(pairs.T) == len(result.observation_error) == len(result.prior_residual)
    )
    for row in np.unique(result.observation_frame):
        mine = result.observation_frame == row
        q = result.frames[row].cam_from_world * result.points[result.observation_point[mine]]
        off = pixels_from_normalized(result.camera, q[:, :2] / q[:, 2:]) - result.observation_xy[mine]
        np.testing.assert_allclose(np.linalg.norm(off, axis=1), result.observation_error[mine], atol=1e-9)
    assert 0.02 < np.median(result.observation_error) < 0.12


def test_known_cameras_stay_as_they_are_and_new_ones_are_where_they_were(material: Set, added: Reconstruction) -> None:
    known = read_result(material.folder / "result")
    assert [frame.name for frame in added.frames] == [f"o_{k}.png" for k in OLD] + [f"n_{k}.png" for k in NEW]
    assert [frame.index for frame in added.frames] == list(range(9))
    for before, after in zip(known.frames, added.frames, strict=False):
        assert before.cam_from_world is not None
        assert after.cam_from_world is not None
        np.testing.assert_array_equal(after.cam_from_world.matrix(), before.cam_from_world.matrix())
    assert all(frame.status is FrameStatus.REGISTERED for frame in added.frames)
    off = material.errors(added)
    assert 5e-5 < off[6:].max() < 2.0 * off[:6].max()
    assert off.max() < 5e-4
    assert_consistent(added)
    assert len(added.points) > 1.2 * len(known.points)
    seen_anew = np.unique(added.observation_point[added.observation_frame >= 6])
    unseen = np.setdiff1d(np.arange(len(known.points)), seen_anew)
    assert min(len(unseen), np.count_nonzero(seen_anew < len(known.points))) > 20  # some of both
    np.testing.assert_array_equal(added.points[unseen], known.points[unseen])
    for frame in added.frames[6:]:
        assert frame.covariance is not None
        assert 1.5e-5 < np.sqrt(np.trace(frame.covariance[3:, 3:])) < 7e-5
        assert frame.observability is not None
        assert frame.inliers > 400
    assert "3 of 3 further images were registered on the result." in added.notes


@pytest.mark.slow
def test_it_is_as_good_as_the_reconstruction_of_all_images(material: Set, added: Reconstruction) -> None:
    whole = reconstruct(material.folder / "all", camera=material.shot.camera, depth=None, unordered=True)
    assert np.median(material.errors(added)) < 1.5 * np.median(material.errors(whole)) + 1e-4


def test_refined_cameras_stay_in_their_coordinates_as_a_whole(material: Set) -> None:
    known = read_result(material.folder / "result")
    refined = add_images(material.folder / "result", material.folder / "new", refine=True)
    before = pose_arrays([frame.cam_from_world for frame in known.frames])
    after = pose_arrays([frame.cam_from_world for frame in refined.frames[:6]])
    similarity = align(*after, *before)
    assert similarity.scale == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(similarity.rotation, np.eye(3), atol=1e-12)
    assert 1e-5 < np.abs(after[1] - before[1]).max() < 1e-4
    assert 2e-5 < np.median(material.errors(refined)) < 5e-4
    assert_consistent(refined)


def test_a_result_grows_more_than_once_through_its_files(material: Set, tmp_path: Path) -> None:
    for k in NEW:
        (tmp_path / f"n{k}").mkdir()
        shutil.copy(material.folder / "new" / f"n_{k}.png", tmp_path / f"n{k}")
    assert cli.main(
        ["extend", str(material.folder / "result"), str(tmp_path / "n1"), "--output", str(tmp_path / "first")]
    ) == 0  # fmt: skip
    assert cli.main(
        ["extend", str(tmp_path / "first"), str(tmp_path / "n4"), "--output", str(tmp_path / "first"), "--refine"]
    ) == 0  # fmt: skip
    result = read_result(tmp_path / "first")
    assert [frame.index for frame in result.registered] == list(range(8))
    summary = json.loads((tmp_path / "first" / "summary.json").read_text())
    assert summary["options"]["added"] == [
        {"source": str(tmp_path / "n1"), "first": 6}, {"source": str(tmp_path / "n4"), "first": 7}
    ]  # fmt: skip
    assert 5e-5 < material.errors(result).max() < 7e-4
    export(result, tmp_path / "splats", format="nerfstudio")
    assert len(list((tmp_path / "splats" / "images").iterdir())) == 8


def test_the_folder_of_a_shot_keeps_its_tracks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("result", "images"):
        (tmp_path / name).mkdir()
    (tmp_path / "result" / "summary.json").write_text('{"program": "factorsfm"}')
    (tmp_path / "result" / "tracks.npz").write_bytes(b"tracks")
    folder = str(tmp_path / "result")
    assert cli.main(["extend", folder, str(tmp_path / "images"), "--output", f"{folder}/../result"]) == 2
    assert_error(capsys.readouterr(), "the output folder is that of the result, whose tracks")
    assert (tmp_path / "result" / "tracks.npz").read_bytes() == b"tracks"


def test_frames_of_a_video_are_added_and_exported_in_a_folder_of_its_name(material: Set, tmp_path: Path) -> None:
    height, width = material.shot.images[0].shape[:2]
    video = cv2.VideoWriter(str(tmp_path / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 24, (width, height))
    for k in NEW:
        video.write(material.shot.images[k])
    video.release()
    arguments = [str(material.folder / "result"), str(tmp_path / "clip.avi"), "--output", str(tmp_path / "more")]
    assert cli.main(["extend", *arguments]) == 0
    result = read_result(tmp_path / "more")
    assert [frame.name for frame in result.registered[6:]] == [f"clip/00000{k}" for k in range(3)]
    for _ in range(2):  # the second one replaces the first one
        export(result, tmp_path / "splats", format="nerfstudio")
    frames = json.loads((tmp_path / "splats" / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames[6:]] == [f"images/clip/00000{k}.png" for k in range(3)]
    reader = cv2.VideoCapture(str(tmp_path / "clip.avi"))
    for frame in frames[6:]:
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "splats" / frame["file_path"])), reader.read()[1])
    export(result, tmp_path / "model", format="colmap")
    names = {image.name for image in pycolmap.Reconstruction(tmp_path / "model").images.values()}
    assert names == {*(f"o_{k}.png" for k in OLD), *(f"clip/00000{k}.png" for k in range(3))}
    again = add_images(result, [material.shot.images[4]])  # matched with the frames of the video, too
    assert again.frames[-1].registered


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 3])
def test_images_of_the_own_source_keep_their_index_and_come_in_its_order(material: Set, first: int) -> None:
    folder = material.folder / "all"
    known = slice(first, first + 6)
    part = reconstruct(folder, camera=material.shot.camera, depth=None, unordered=True, frames=known)
    result = add_images(part, folder)
    assert [frame.index for frame in result.registered] == list(range(9))
    assert_consistent(result)
    assert "added" not in result.options or result.options["added"] == []
    assert 5e-5 < material.errors(result).max() < 7e-4


def test_photographs_are_added_to_a_shot(tmp_path: Path) -> None:
    """Twelve frames of a slow truck, and stills of the same room from further away."""
    shot = render_shot("truck", frames=12, width=320, height=180, parallax=0.1)
    stills = render_shot("arc", frames=5, width=320, height=180, parallax=0.2)
    for k, image in enumerate(shot.images):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    base = reconstruct(tmp_path, camera=shot.camera, depth=None)
    images = [Frame(k, stills.images[k], f"still {k}") for k in (2, 4)]
    result = add_images(base, images)
    assert [frame.registered for frame in result.frames] == [True] * 14
    assert [frame.index for frame in result.frames[12:]] == [14, 16]
    poses = [*shot.cam_from_world, stills.cam_from_world[2], stills.cam_from_world[4]]
    errors = trajectory_errors(*pose_arrays([f.cam_from_world for f in result.frames]), *pose_arrays(poses))
    assert 3e-4 < errors.ate.max() < 0.0025  # of distances of up to 0.9
    assert result.parallax == pytest.approx(0.2, rel=0.15)
    assert base.measured is not None
    assert result.measured is None
    lost = "The tracks of the shot are not kept: only the result without these images can be solved again."
    assert result.notes.count(lost) == 1
    further = add_images(result, [Frame(0, stills.images[3], "still 3")], source=tmp_path)
    assert further.notes.count(lost) == 1


# --- what cannot be added ---------------------------------------------------------------------------------------


def test_images_that_show_something_else_are_not_registered(material: Set, tmp_path: Path) -> None:
    other = render_shot("truck", frames=2, width=320, height=240, seed=5).images
    with pytest.raises(ReconstructionError, match=r"none of 2 new images .*000000: \d+ of 15 needed") as caught:
        add_images(material.result, other)
    assert len(caught.value.frames) == 8
    other_folder = tmp_path / "other"
    other_folder.mkdir()
    cv2.imwrite(str(other_folder / "0.png"), other[0])
    shutil.copytree(material.folder / "result", tmp_path / "result")
    before = (tmp_path / "result" / "summary.json").read_bytes()
    arguments = [str(tmp_path / "result"), str(other_folder), "--output", str(tmp_path / "result")]
    assert cli.main(["extend", *arguments]) == cli.NOT_RECONSTRUCTED
    assert (tmp_path / "result" / "summary.json").read_bytes() == before
    mixed = add_images(material.result, [other[0], material.shot.images[4]])
    assert [frame.registered for frame in mixed.frames[6:]] == [False, True]
    assert any(note.startswith("000000 could not be registered: ") for note in mixed.notes)


def test_what_is_no_image_of_the_camera_is_left_out(material: Set, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "square.png"), material.shot.images[1][:, :240])
    cv2.imwrite(
        str(tmp_path / "small.png"), cv2.resize(material.shot.images[4], (240, 180), interpolation=cv2.INTER_AREA)
    )
    (tmp_path / "torn.jpg").write_bytes(b"nothing")
    result = add_images(material.result, tmp_path)
    assert [(frame.name, frame.status) for frame in result.frames[6:]] == [
        ("small.png", FrameStatus.REGISTERED), ("square.png", FrameStatus.UNUSABLE), ("torn.jpg", FrameStatus.UNUSABLE)
    ]  # fmt: skip
    assert result.frames[7].message == "240x240 pixels, another format than 320x240 of the camera"


def test_the_images_of_the_result_must_be_found(
    material: Set, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = read_result(material.folder / "result")
    moved.options["source"] = str(tmp_path / "gone")
    with pytest.raises(InputError, match=r"are not at .*gone any more"):
        add_images(moved, material.folder / "new")
    again = add_images(moved, material.folder / "new", source=material.folder / "old")
    assert len(again.registered) == 9
    (tmp_path / "few").mkdir()
    shutil.copy(material.folder / "old" / "o_0.png", tmp_path / "few")
    output = tmp_path / "out"
    arguments = [str(material.folder / "result"), str(material.folder / "new"), "--source", str(tmp_path / "few")]
    assert cli.main(["extend", *arguments, "--output", str(output)]) == cli.BAD_INPUT
    assert_error(capsys.readouterr(), "o_2.png of the result is not in its source")
    assert not output.exists()


def test_there_must_be_something_to_add(material: Set) -> None:
    with pytest.raises(InputError, match="has an image o_0"):
        add_images(material.result, [Frame(0, material.shot.images[0], "o_0.png")])
    with pytest.raises(InputError, match="there is no image to add"):
        add_images(material.result, material.folder / "old")
    with pytest.raises(InputError, match=r"there is no image to add in .*: 000000 is unusable, 99x240 pixels"):
        add_images(material.result, [material.shot.images[0][:, :99]], source=material.folder / "old")


def test_a_camera_that_does_not_move_has_no_points_to_register_on(tmp_path: Path) -> None:
    shot = render_shot("static", frames=4, width=320, height=180)
    result = reconstruct(shot.images, camera=shot.camera, depth=None)
    with pytest.raises(InputError, match="only be added to a result whose camera moves"):
        add_images(result, shot.images)


@pytest.mark.slow
def test_photographs_are_added_to_a_real_set(shared_data: Path, tmp_path: Path) -> None:
    """Fountain-P11: 8 images and 3 further ones."""
    scene = photographs(shared_data / "real" / "fountain-P11")
    names = list(scene.images)
    late = [names[k] for k in (2, 5, 9)]
    old = scene.write(tmp_path / "old", [name for name in names if name not in late])
    base = reconstruct(old, camera=scene.camera, depth=None, unordered=True)
    result = add_images(base, scene.write(tmp_path / "new", late))
    order = np.array([names.index(frame.name) for frame in result.frames])
    errors = trajectory_errors(*pose_arrays([f.cam_from_world for f in result.frames]), *scene.shot.truth(order))
    assert len(result.registered) == 11
    assert 0.0005 < np.median(errors.ate) < 0.0035  # metres
    assert errors.ate[8:].max() < 0.005
    assert np.median(result.observation_error) < 0.2
