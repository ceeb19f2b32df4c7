"""A result solved again from its tracks: the same without changes, and without what is left out."""

import json
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import factorsfm
from factorsfm import (
    Control,
    Frame,
    InputError,
    KnownDistance,
    MaskRegion,
    Options,
    Reconstruction,
    ReconstructionError,
    Stream,
    solve_again,
)
from factorsfm.camera.projection import with_focal
from factorsfm.cli.main import main
from factorsfm.polish import start
from factorsfm.report.thumbnails import thumbnail
from factorsfm.result.alignment import FREE_SCALE, Alignment
from factorsfm.result.other_world import in_other_world
from factorsfm.result.tracks_file import read_tracks, write_tracks
from factorsfm.support.similarity import Similarity
from factorsfm.synthetic import render_shot
from tests.command_line import assert_error
from tests.rendered import FRAMES, Maps, rendered, simulated_maps, with_fewer_tracks

SHOWN = [0, 1, 2, 3, 3, 4, 5, 6, 7]  # the frame with index 4 repeats the one before
MAPS = [simulated_maps("dolly")[k] for k in SHOWN]


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    rng, shot = np.random.default_rng(3), rendered("dolly")
    images = [np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8) for image in shot.images]
    with Stream(shot.camera, depth=Maps(MAPS), options=with_fewer_tracks(Options())) as stream:
        for index, k in enumerate(SHOWN):
            stream.push(Frame(index, images[k], f"{index:06d}", index / 24))
        return stream.finish()


@pytest.fixture(scope="module")
def folder(result: Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("solved") / "result"
    result.write(folder)
    return folder


def centers_of(result: Reconstruction) -> dict[int, np.ndarray]:
    return {frame.index: frame.cam_from_world.inverse().translation for frame in result.registered}


def assert_same_cameras(result: Reconstruction, known: Reconstruction, share: float, size: float = 1.0) -> None:
    """Within a share of the standard deviations of the known result, whose world may be `size` times as large."""
    assert [frame.index for frame in result.frames] == [frame.index for frame in known.frames]
    for frame, other in list(zip(result.frames, known.frames, strict=True))[1:]:
        off = frame.cam_from_world * other.cam_from_world.inverse()
        std = np.sqrt(np.diag(other.covariance)) * np.repeat([1.0, size], 3)
        turn = 2.0 * np.asarray(off.rotation.quat)[:3]
        assert (np.abs(np.r_[turn, off.translation]) < share * std).all()


def test_the_file_holds_what_was_measured(result: Reconstruction, folder: Path, tmp_path: Path) -> None:
    known, read = result.measured, read_tracks(folder / "tracks.npz")
    assert known is not None
    assert read is not None
    assert (read.frames, read.footage, read.options) == (known.frames, known.footage, known.options)
    assert read.footage.repeats[0].index == 4
    assert read.depth_kind is known.depth_kind
    assert read.camera == known.camera
    for image, other in zip(read.images, known.images, strict=True):
        np.testing.assert_array_equal(image.tracks.ids, other.tracks.ids)
        np.testing.assert_allclose(image.tracks.pixels, other.tracks.pixels, atol=1e-4)
        np.testing.assert_array_equal(image.rotation, other.rotation)
        assert (image.tracks.depth is None) == (other.tracks.depth is None)
        if other.tracks.depth is not None:
            valid = other.tracks.depth.valid
            np.testing.assert_array_equal(image.tracks.depth.valid, valid)
            np.testing.assert_allclose(
                image.tracks.depth.inverse_depth[valid], other.tracks.depth.inverse_depth[valid], rtol=1e-6
            )
    np.testing.assert_array_equal(read.colors[result.track_ids], result.colors)
    observations = sum(len(image.tracks.ids) for image in known.images)
    assert (folder / "tracks.npz").stat().st_size < 12 * observations + 8000
    write_tracks(read, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (folder / "tracks.npz").read_bytes()


def test_without_a_change_the_cameras_are_the_same(result: Reconstruction, folder: Path) -> None:
    again = solve_again(folder)
    assert_same_cameras(again, result, 0.01)
    assert again.frames[4].repeats == 3
    np.testing.assert_array_equal(again.track_ids, result.track_ids)
    assert again.notes == result.notes
    assert again.frames[1].covariance == pytest.approx(result.frames[1].covariance, rel=1e-3)
    assert (again.frames[0].prior is None) == (result.frames[0].prior is None)


@pytest.fixture(scope="module")
def unknown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result whose lens was estimated."""
    folder = tmp_path_factory.mktemp("unknown")
    shot = render_shot("arc", 12, 320, 180, parallax=0.3)
    images = [Frame(k, image, f"{k:06d}", k / 24) for k, image in enumerate(shot.images)]
    factorsfm.reconstruct(images, depth=None).write(folder)
    return folder


def test_a_lens_is_searched_where_what_was_found_leads_to_none(unknown: Path) -> None:
    known, wrong = factorsfm.read_result(unknown), factorsfm.read_result(unknown)
    wrong.camera = with_focal(wrong.camera, 30.0 * wrong.camera.mean_focal_length())
    solved = solve_again(wrong)
    assert solved.camera.mean_focal_length() == pytest.approx(known.camera.mean_focal_length(), rel=1e-6)


def test_an_unknown_lens_starts_where_it_was_found(unknown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = factorsfm.read_result(unknown)
    assert known.lens is not None
    assert known.lens.focal_std is not None
    monkeypatch.setattr(start, "_searched", lambda *arguments: pytest.fail("the lens was searched"))
    solved = solve_again(known, mask_regions=["0,0,40,40"])
    assert solved.lens is not None
    off = np.log(solved.camera.mean_focal_length() / known.camera.mean_focal_length())
    assert abs(off) < 0.5 * known.lens.focal_std
    assert solved.lens.focal_std == pytest.approx(known.lens.focal_std, rel=0.3)


def test_tracks_regions_and_frames_are_left_out(result: Reconstruction, folder: Path, tmp_path: Path) -> None:
    gone = result.track_ids[[3, 17]] + 1
    again = solve_again(folder, without_tracks=[int(gone[0]), f"track_{gone[1]:05d}"])
    assert_same_cameras(again, result, 1.0)
    assert not np.isin(again.track_ids + 1, gone).any()
    assert again.notes[-1] == f"Solved again without 2 tracks: track_{gone[0]:05d}, track_{gone[1]:05d}."
    assert again.options["solved_again"][0]["without_tracks"] == [str(gone[0]), f"track_{gone[1]:05d}"]
    again.write(tmp_path / "again")
    further = solve_again(
        tmp_path / "again", mask_regions=["2:3:0,0,80,200", MaskRegion(300, 0, 100, 200)], frames=slice(1, 9)
    )
    assert [frame.index for frame in further.frames] == list(range(1, 9))
    assert not np.isin(further.track_ids + 1, gone).any()
    index = np.array([frame.index for frame in further.frames])[further.observation_frame]
    x = further.observation_xy[:, 0]
    assert x[index == 2].min() > 79.9
    assert x[index > 2].min() < 60
    assert x.max() < 300
    assert further.frames[3].repeats == 3
    assert [change["frames"] for change in further.options["solved_again"]] == [None, "1:9:1"]
    known = centers_of(result)
    for number, center in centers_of(further).items():  # the first frame is gone, and the world stays
        np.testing.assert_allclose(center, known[number], atol=2e-3)


TURNED = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # the camera goes up
ALIGNMENT = Alignment(
    ["ground"], 0.1, "points", 1.0, 0.1, 40, 1.0, "foot", None, "camera", None, None, [FREE_SCALE, "other"]
)


@pytest.fixture(scope="module")
def aligned(result: Reconstruction) -> Reconstruction:
    """The first camera is 2 above the origin, and 1 above the ground."""
    moved = in_other_world(result, Similarity(2.5, TURNED, np.array([1.0, -2.0, 3.0])))
    return replace(moved, alignment=ALIGNMENT, metric=True)


def test_the_world_stays(aligned: Reconstruction) -> None:
    again = solve_again(aligned)
    assert_same_cameras(again, aligned, 0.01)
    assert again.alignment is not None
    assert replace(again.alignment, camera_height=1.0) == ALIGNMENT
    assert again.alignment.camera_height == pytest.approx(1.0, abs=1e-3)
    assert again.metric
    np.testing.assert_allclose(again.points, aligned.points, rtol=1e-3)


def test_the_height_is_that_of_the_camera_that_is_the_first_now(aligned: Reconstruction) -> None:
    again = solve_again(aligned, frames=slice(5, 9))
    assert again.alignment is not None
    height = -aligned.camera_centers()[5][1] - 1.0
    assert abs(height - 1.0) > 0.01
    assert again.alignment.camera_height == pytest.approx(height, abs=2e-3)


def test_control_with_lengths_changes_the_unit_of_an_aligned_world_and_not_its_ground(aligned: Reconstruction) -> None:
    long = float(np.linalg.norm(aligned.camera_centers()[8] - aligned.camera_centers()[0]))
    again = solve_again(aligned, control=Control(distances=[KnownDistance(0.5 * long, 1e-4 * long, frames=[0, 8])]))
    np.testing.assert_allclose(again.camera_centers(), 0.5 * aligned.camera_centers(), atol=2e-3)
    np.testing.assert_allclose(again.points, 0.5 * aligned.points, rtol=1e-2)
    found = again.alignment
    assert found is not None
    assert (found.scale_from, found.notes) == ("control", ["other"])
    assert 2e-4 < found.scale_std < 6e-3  # of the distance, and of the path in the scene
    assert (found.ground_height, found.ground_std) == pytest.approx((0.5, 0.05), rel=1e-3)
    assert found.camera_height == pytest.approx(0.5, abs=1e-3)
    further = solve_again(again, without_tracks=[int(again.track_ids[3]) + 1])
    np.testing.assert_allclose(further.camera_centers(), again.camera_centers(), atol=2e-3)
    assert further.alignment is not None
    assert further.alignment.camera_height == pytest.approx(0.5, abs=1e-3)


def test_the_first_camera_stays_at_the_origin_where_control_gives_lengths(result: Reconstruction) -> None:
    again = solve_again(result, control=Control(distances=[KnownDistance(3.0, 0.01, frames=[0, 8])]))
    np.testing.assert_allclose(again.camera_centers()[0], 0.0, atol=2e-3)


def test_control_is_kept_until_there_is_another(result: Reconstruction, tmp_path: Path) -> None:
    def between(metres: float) -> Control:
        return Control(distances=[KnownDistance(metres, 0.01, frames=[0, 8])])

    surveyed = solve_again(result, control=between(3.0))
    surveyed.write(tmp_path / "surveyed")
    for solved, metres in (
        (solve_again(tmp_path / "surveyed"), 3.0),
        (solve_again(surveyed, control=between(5.0)), 5.0),
    ):
        centers = centers_of(solved)
        assert np.linalg.norm(centers[8] - centers[0]) == pytest.approx(metres, rel=1e-3)
        assert solved.metric


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"without_tracks": [999999]}, "no track 999999 among the"),
        ({"without_tracks": ["door"]}, "no track door"),
        ({"without_tracks": "12"}, "without_tracks is '12'; a list of numbers and names of tracks is expected"),
        ({"without_tracks": 12}, "without_tracks is 12; a list of"),
        ({"without_tracks": [1.5]}, r"without_tracks is \[1.5\]; a list of"),
        ({"mask_regions": "0,0,9,9"}, "mask_regions is '0,0,9,9'; a list of regions is expected"),
        ({"mask_regions": MaskRegion(0, 0, 9, 9)}, "a list of regions is expected"),
        ({"mask_regions": ["0,0,10"]}, '"0,0,10" is no region'),
        ({"mask_regions": ["0,0,10,0"]}, "is empty"),
        ({"mask_regions": ["5:3:0,0,9,9"]}, "empty"),
        ({"mask_regions": ["9000,0,9,9"]}, "no track is in the region 9000,0,9,9"),
        ({"frames": slice(40, 50)}, "no frame of the result is in 40:50:1; it has 0 to 8"),
    ],
)
def test_changes_that_cannot_be_made(result: Reconstruction, change: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        solve_again(result, **change)


def test_too_little_is_left(result: Reconstruction) -> None:
    with pytest.raises(factorsfm.ReconstructionError):
        solve_again(result, mask_regions=[MaskRegion(-1, -1, 400, 175)])


def test_a_damaged_file_is_refused(folder: Path, tmp_path: Path) -> None:
    good = folder / "tracks.npz"
    arrays = dict(np.load(good))

    def damaged() -> Iterator[dict]:
        yield {**arrays, "track": arrays["track"][::-1]}
        yield {**arrays, "xy": arrays["xy"][:-1]}
        yield {**arrays, "xy": np.full_like(arrays["xy"], np.nan)}
        yield {**arrays, "frame_start": arrays["frame_start"] + 1}
        yield {**arrays, "color_track": arrays["color_track"] + 1}
        yield {**arrays, "point": arrays["point"].astype("<f4")}
        yield {**arrays, "facts": np.array("{}")}
        yield {**arrays, "facts": np.array(str(arrays["facts"]).replace('"format":1', '"format":2'))}
        yield {name: array for name, array in arrays.items() if name != "suspect"}

    for number, content in enumerate(damaged()):
        np.savez_compressed(tmp_path / f"{number}.npz", **content)
        with pytest.raises(InputError, match="is damaged"):
            read_tracks(tmp_path / f"{number}.npz")
    data = good.read_bytes()
    for cut in (0, 10, len(data) // 2):
        (tmp_path / "cut.npz").write_bytes(data[:cut])
        with pytest.raises(InputError, match="is damaged"):
            read_tracks(tmp_path / "cut.npz")
    with zipfile.ZipFile(tmp_path / "other.npz", "w") as archive:
        archive.writestr("a.txt", "no arrays")
    with pytest.raises(InputError, match="is damaged"):
        read_tracks(tmp_path / "other.npz")


def test_the_command(result: Reconstruction, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result.frames[2].thumbnail = thumbnail(np.full((90, 160, 3), 77, np.uint8))
    result.write(folder)
    track = str(result.track_ids[5] + 1)
    command = ["solve", str(folder), "--without-tracks", track, "--mask-region", "0:2:0,0,40,40", "--frames", "0:8"]
    assert main([*command, "--output", str(tmp_path / "mended")]) == 0
    assert f"Solved again without 1 track: track_{int(track):05d}." in capsys.readouterr().out
    mended = factorsfm.read_result(tmp_path / "mended")
    assert len(mended.frames) == FRAMES
    assert mended.measured is not None
    report = (tmp_path / "mended" / "report.html").read_text()
    assert report.count('"/9j/') == 8  # the pictures are those of the first report
    assert '"canBeMended":true' in report
    assert main([*command, "--output", str(folder)]) == 2
    assert_error(capsys.readouterr(), "choose another one")
    (tmp_path / "mended" / "tracks.npz").unlink()
    assert main(["solve", str(tmp_path / "mended"), "--output", str(tmp_path / "further")]) == 2
    assert_error(capsys.readouterr(), "keeps no tracks to solve again", "has images that were added, or")
    assert not (tmp_path / "further").exists()


def test_a_failure_says_why(result: Reconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result.frames[0].thumbnail = thumbnail(np.full((90, 160, 3), 77, np.uint8))
    result.write(tmp_path / "result")
    command = ["solve", str(tmp_path / "result"), "--frames", "0:1", "--output", str(tmp_path / "failed")]
    assert main(command) == 3
    assert_error(capsys.readouterr(), "1 of 1 frames registered, at least 2 needed")
    assert {path.name for path in (tmp_path / "failed").iterdir()} == {"summary.json", "report.html"}
    summary = json.loads((tmp_path / "failed" / "summary.json").read_text())
    assert "1 of 1 frames registered, at least 2 needed" in summary["reason"]
    assert [status["index"] for status in summary["statuses"]] == [0]
    assert summary["options"]["frames"] == "0:1"
    assert (tmp_path / "failed" / "report.html").read_text().count("/9j/") == 1
    with pytest.raises(ReconstructionError) as caught:
        solve_again(result, frames=slice(3, 5))  # of which one repeats the other
    assert [(frame.index, frame.repeats) for frame in caught.value.frames] == [(3, None), (4, 3)]
