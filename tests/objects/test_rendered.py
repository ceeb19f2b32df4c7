"""A rendered box that crosses the image: from pixels and masks to a result, its folder and back."""

import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

import factorsfm
from factorsfm import Frame, InputError, Reconstruction
from factorsfm.report.page import report_html
from factorsfm.support.json_text import json_text
from factorsfm.support.similarity import align, pose_arrays
from factorsfm.synthetic import Motion, MovingShot, render_moving, simulate_prior
from tests.rendered import Maps

FRAMES = 16


@cache
def crossing() -> MovingShot:
    return render_moving("truck", FRAMES, 320, 180, parallax=0.05, size=0.75)


def masks(frame: Frame) -> dict[str, NDArray[np.bool_]]:
    return {"box": crossing().masks[frame.index]}


@cache
def solved(*, prior: bool = True) -> Reconstruction:
    shot = crossing().shot
    depth = Maps(simulate_prior(shot)) if prior else None
    return factorsfm.reconstruct(shot.images, camera=shot.camera, depth=depth, objects=masks, shutter="global")


def errors(result: Reconstruction, moving: MovingShot | None = None) -> tuple[float, float, float]:
    """Largest error of the path up to its scale over its length, and of the rotation in degrees; true over found scale.

    The path is that of the point of the true box which is nearest to where the object has its origin.
    """
    (found,) = result.objects
    moving = moving or crossing()
    true_world_from_cam = moving.shot.cam_from_world
    estimate = pose_arrays([frame.cam_from_world for frame in result.frames])
    to_truth = align(*estimate, *pose_arrays(true_world_from_cam))
    by_index = {frame.index: frame.cam_from_world for frame in result.registered}
    seen = [frame.index for frame in found.frames]
    rows, wanted, turns = [], [], []
    first = found.frames[0].world_from_object.rotation
    true_boxes = [moving.world_from_box[index] for index in seen]
    alignment = pycolmap.Rotation3d(to_truth.rotation)
    for frame, true_box in zip(found.frames, true_boxes, strict=True):
        in_camera = to_truth.scale * (by_index[frame.index] * frame.world_from_object.translation)
        true = true_world_from_cam[frame.index] * true_box
        rows.append(np.column_stack([in_camera, -true.rotation.matrix()]))
        wanted.append(true.translation)
        turn = alignment * frame.world_from_object.rotation * first.inverse() * alignment.inverse()
        true_turn = true_box.rotation * true_boxes[0].rotation.inverse()
        turns.append(np.degrees((turn * true_turn.inverse()).angle()))
    system, right = np.concatenate(rows), np.concatenate(wanted)
    (scale, *_), *_ = solution = np.linalg.lstsq(system, right, rcond=None)
    off = np.linalg.norm((system @ solution[0] - right).reshape(-1, 3), axis=1)
    length = np.linalg.norm(np.diff([box.translation for box in true_boxes], axis=0), axis=1).sum()
    return float(off.max() / length), float(max(turns)), float(scale)


@pytest.mark.parametrize("prior", [True, False])
def test_path_and_rotation_of_a_rendered_box(prior: bool) -> None:
    result = solved(prior=prior)
    assert len(result.registered) == FRAMES
    path, turn, scale = errors(result)
    assert 0.0005 < path < 0.01
    assert 0.05 < turn < 1.0
    (found,) = result.objects
    assert (found.name, len(found.frames)) == ("box", FRAMES)
    (note,) = (note for note in result.notes if "box" in note)
    assert f"is solved in {FRAMES} frames" in note
    if prior:
        assert found.scale_std is not None
        assert 0.01 < found.scale_std < 0.15
        assert abs(scale - 1.0) < 2.5 * found.scale_std
    else:
        assert found.scale_std is None
        assert "Nothing gives its scale" in note


def found_without_masks(moving: MovingShot) -> Reconstruction:
    shot = moving.shot
    depth = Maps(simulate_prior(shot))
    return factorsfm.reconstruct(shot.images, camera=shot.camera, depth=depth, objects="auto", shutter="global")


def test_a_box_is_found_and_solved_without_masks() -> None:
    """Nearly as exactly as with masks; what is said of it names it and its place."""
    moving = render_moving("truck", FRAMES, 400, 225, parallax=0.05, size=0.6)
    result = found_without_masks(moving)
    path, turn, scale = errors(result, moving)
    assert 0.0002 < path < 0.01
    assert 0.05 < turn < 1.5
    (found,) = result.objects
    assert (found.name, len(found.frames), found.scale_from) == ("object-1", FRAMES, "prior")
    assert len(found.points) > 100
    assert found.scale_std is not None
    assert abs(scale - 1.0) < 2.5 * found.scale_std
    said = next(note for note in result.notes if note.startswith("Things that move by themselves: object-1 (frames"))
    assert f"frames 0 to {FRAMES - 1}; in frame {FRAMES // 2} x from " in said
    assert result.options["objects"] == "auto"
    assert result.seconds["objects"] > 0.0


def in_sigmas(result: Reconstruction, moving: MovingShot) -> NDArray[np.float64]:
    """(frames - 1,) errors of the poses since the first frame in standard deviations: the larger of rotation and
    translation, with the scale at which they are smallest."""
    (found,) = result.objects
    by_index = {frame.index: frame.cam_from_world for frame in result.registered}
    estimates = [by_index[frame.index] * frame.world_from_object for frame in found.frames]
    truth = [moving.shot.cam_from_world[frame.index] * moving.world_from_box[frame.index] for frame in found.frames]
    pairs = list(zip(estimates, truth, strict=True))
    system = np.concatenate([np.column_stack([e.translation, -t.rotation.matrix()]) for e, t in pairs])
    first_scale = 1.0 / np.linalg.lstsq(system, np.concatenate([t.translation for _, t in pairs]), rcond=None)[0][0]

    def at(scale: float) -> NDArray[np.float64]:
        scaled = [pycolmap.Rigid3d(t.rotation, scale * t.translation) for t in truth]
        box_from_object = scaled[0].inverse() * estimates[0]
        sizes = []
        for true, estimate, frame in list(zip(scaled, estimates, found.frames, strict=True))[1:]:
            off = (true * box_from_object).inverse() * estimate
            error = np.r_[2.0 * off.rotation.quat[:3] * np.sign(off.rotation.quat[3]), off.translation]
            parts = (slice(3), slice(3, 6))
            sizes.append([np.sqrt(error[p] @ np.linalg.solve(frame.covariance[p, p], error[p])) for p in parts])
        return np.array(sizes)

    scales = first_scale * np.exp(np.linspace(-0.005, 0.005, 81))
    best = min(scales, key=lambda scale: float((at(scale) ** 2).sum()))
    return np.asarray(at(best).max(axis=1))


@pytest.mark.slow
def test_errors_are_as_large_as_the_covariance_says() -> None:
    """The median of the larger of two errors with three components each is 1.95."""
    found = []
    shots: list[tuple[Motion, int]] = [("truck", 0), ("handheld", 1), ("truck", 4)]
    for motion, seed in shots:
        moving = render_moving(motion, 24, 480, 270, size=0.5, seed=seed)
        found.append(in_sigmas(found_without_masks(moving), moving))
    pooled = np.concatenate(found)
    assert 1.4 < np.median(pooled) < 2.6
    assert np.mean(pooled > 5.0) <= 0.02


def test_what_moves_by_itself_needs_frames_that_come_twice() -> None:
    with pytest.raises(InputError, match=r"can be read twice; these are an iterator$"):
        factorsfm.reconstruct(iter(crossing().shot.images), depth=None, objects="auto")


def test_the_scene_is_as_good_as_without_the_box() -> None:
    """What is an object is none of the scene's points, and the cameras are those of the scene."""
    estimate = pose_arrays([frame.cam_from_world for frame in solved().frames])
    truth = pose_arrays(crossing().shot.cam_from_world)
    alignment = align(*estimate, *truth)
    off = np.linalg.norm(alignment.points(estimate[1]) - truth[1], axis=1)
    assert off.max() < 0.02 * np.linalg.norm(truth[1][-1] - truth[1][0])
    result = solved()
    for k in (0, FRAMES - 1):
        x, y = np.rint(result.observation_xy[result.observation_frame == k]).astype(int).T
        assert not crossing().masks[k][y, x].any()


def test_the_folder_has_it_all_and_comes_back(tmp_path: Path) -> None:
    result = solved()
    result.write(tmp_path / "out")
    again = factorsfm.read_result(tmp_path / "out")
    (found,), (read,) = result.objects, again.objects
    assert (read.name, read.note, read.scale_from) == (found.name, found.note, found.scale_from)
    assert read.scale_std == found.scale_std
    np.testing.assert_array_equal(read.points, found.points)
    np.testing.assert_array_equal(read.colors, found.colors)
    for a, b in zip(read.frames, found.frames, strict=True):
        assert a.index == b.index
        np.testing.assert_array_equal(a.covariance, b.covariance)
        np.testing.assert_allclose(a.world_from_object.matrix(), b.world_from_object.matrix(), rtol=1e-14)
    (brief,) = json.loads((tmp_path / "out" / "summary.json").read_text())["objects"]
    assert brief == {
        "name": "box",
        "frames": FRAMES,
        "points": len(found.points),
        "scale_std": found.scale_std,
        "scale_from": "prior",
        "rotation_std": found.rotation_std,
        "reprojection_error": found.reprojection_error,
    }
    assert f"<dt>Objects</dt><dd>box ({FRAMES} frames)</dd>" in report_html(again)
    again.objects = ()
    again.write(tmp_path / "out")  # the earlier objects go
    assert not (tmp_path / "out" / "objects.json").exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda thing: thing.pop("points"), r"points is missing"),
        (lambda thing: thing["frames"][0].update(rotation=[1.0, 0.0]), r"none of \(4,\)"),
        (lambda thing: thing["points"].append([1.0]), r"none of \(\d+, 3\)"),
        (lambda thing: thing["frames"][0].update(translation=[None, 0, 0]), r"none of \(3,\)"),
    ],
)
def test_damaged_objects(tmp_path: Path, damage: object, message: str) -> None:
    solved().write(tmp_path / "out")
    path = tmp_path / "out" / "objects.json"
    content = json.loads(path.read_text())
    damage(content["objects"][0])  # type: ignore[operator]
    path.write_text(json_text(content))
    with pytest.raises(InputError, match=f"is damaged: .*{message}"):
        factorsfm.read_result(tmp_path / "out")


def test_an_object_that_cannot_be_solved_is_named_in_a_note() -> None:
    shot = crossing().shot
    dot = np.zeros((180, 320), bool)
    dot[80:90, 100:110] = True
    result = factorsfm.reconstruct(
        shot.images[:8], camera=shot.camera, depth=None, objects=lambda frame: {"dot": dot}, shutter="global"
    )
    assert result.objects == ()
    assert any(note.startswith("The object dot is not solved: 0 frames have 20 tracks on it") for note in result.notes)


def test_objects_are_of_videos_and_match_frames(tmp_path: Path) -> None:
    shot = crossing().shot
    for index, image in enumerate(shot.images[:6]):
        (tmp_path / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "images" / f"{index}.png"), image)
    (tmp_path / "objects" / "box").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "objects" / "box" / "5000.png"), np.zeros((180, 320), np.uint8))
    with pytest.raises(InputError, match="images in any order show no motion"):
        factorsfm.reconstruct(tmp_path / "images", objects=tmp_path / "objects", unordered=True, depth=None)
    with pytest.raises(InputError, match="images in any order show no motion"):
        factorsfm.reconstruct(tmp_path / "images", objects="auto", unordered=True, depth=None)
    with pytest.raises(InputError, match="no mask of an object in the given folder matches a frame"):
        factorsfm.reconstruct(tmp_path / "images", objects=tmp_path / "objects", camera=shot.camera, depth=None)
