"""Unordered images: the mapper on exact projections with wrong matches, and whole folders of rendered images."""

import json
import logging
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

import factorsfm
from factorsfm import (
    ExportOptions,
    Frame,
    FrameStatus,
    InputError,
    Options,
    ReconstructionError,
    read_result,
    reconstruct,
)
from factorsfm.camera.files import camera_to_json
from factorsfm.camera.guess import guess_camera
from factorsfm.camera.projection import with_focal
from factorsfm.cli import main as cli
from factorsfm.evaluation.baselines import colmap_default, match_frames
from factorsfm.evaluation.metrics import TrajectoryErrors, auc, relative_pose_errors, trajectory_errors
from factorsfm.export import export
from factorsfm.frames.unordered import Unusable, looks_unordered, other_files, read_images
from factorsfm.imagesets.cameras import find_cameras
from factorsfm.imagesets.covisibility import common_tracks, longest_tracks, pyramid_score
from factorsfm.imagesets.image_set import ImageSet
from factorsfm.imagesets.mapper import SetMapper
from factorsfm.imagesets.parts import map_parts
from factorsfm.imagesets.photo_folder import Photo, PhotoFolder
from factorsfm.imagesets.photo_results import by_reason
from factorsfm.polish.polish import Polished, polish
from factorsfm.polish.shot import Shot
from factorsfm.priors.image_depth import ImageDepth
from factorsfm.support.similarity import pose_arrays
from factorsfm.synthetic import RenderedShot, render_shot, render_views, room_camera
from factorsfm.tracks.image_tracks import ImageTracks
from tests.estimation_problems import tracks_at
from tests.photographs import photographs

FOCAL = 800.0
NOISE_PX = 0.3


class Ring:
    """Cameras on a circle around a cloud of points, 26 degrees from neighbour to neighbour, in shuffled order."""

    def __init__(self, cameras: int = 11, points: int = 1500, seed: int = 0, first_id: int = 0) -> None:
        self.generator = np.random.default_rng(seed)
        self.points = self.generator.normal(0.0, 1.0, (points, 3))
        self.ids = first_id + np.arange(points)
        angle = self.generator.permutation(0.45 * np.arange(cameras))
        self.rotation, self.translation = [], []
        for a in angle:
            center = np.array([6.0 * np.sin(a), 0.5 * np.cos(3.0 * a), -6.0 * np.cos(a)])
            forward = -center / np.linalg.norm(center)
            right = np.cross([0.0, 1.0, 0.0], forward)
            right /= np.linalg.norm(right)
            turn = np.stack([right, np.cross(forward, right), forward])
            self.rotation.append(turn)
            self.translation.append(-turn @ center)
        self.angle = angle

    def tracks(self, wrong: float = 0.0, noise_px: float = NOISE_PX, first: int = 0) -> list[ImageTracks]:
        """What the cameras see: each point from a third of the circle; some observations anywhere."""
        tracks = []
        side = np.arctan2(self.points[:, 0], -self.points[:, 2])
        for k, (rotation, translation) in enumerate(zip(self.rotation, self.translation, strict=True)):
            turned = np.angle(np.exp(1j * (side - self.angle[k])))
            rows = np.nonzero((np.abs(turned) < 1.2) & (self.generator.random(len(self.points)) < 0.85))[0]
            q = self.points[rows] @ rotation.T + translation
            xy = q[:, :2] / q[:, 2:] + self.generator.normal(0.0, noise_px / FOCAL, (len(rows), 2))
            bad = self.generator.random(len(rows)) < wrong
            xy[bad] = self.generator.uniform(-0.4, 0.4, (int(bad.sum()), 2))
            tracks.append(tracks_at(first + k, self.ids[rows], xy, focal=FOCAL))
        return tracks

    def errors(self, rotation: np.ndarray, translation: np.ndarray) -> TrajectoryErrors:
        """Against the truth; the radius of the circle is 6."""
        estimate = rotation.transpose(0, 2, 1), -np.einsum("kji,kj->ki", rotation, translation)
        r, t = np.array(self.rotation), np.array(self.translation)
        return trajectory_errors(*estimate, r.transpose(0, 2, 1), -np.einsum("kji,kj->ki", r, t))


def solve(tracks: list[ImageTracks], options: Options | None = None, focal: float = FOCAL) -> Polished:
    options = (options or Options()).for_image_sets()
    mapper = SetMapper(tracks, focal, options)
    mapper.run()
    assert all(image.registered for image in mapper.images)
    return polish(Shot.of(mapper.images, mapper.points.all(), np.array([mapper.focal])), options)


def test_wide_baselines_with_wrong_matches_in_any_order() -> None:
    ring = Ring()
    result = solve(ring.tracks(wrong=0.1))
    errors = ring.errors(result.state.rotation, result.state.translation)
    # 0.3 px at a distance of 6 are 2.3 mm, averaged over some hundred points a camera.
    assert 1e-4 < np.median(errors.ate) < 2e-3
    assert np.median(errors.r_rpe) < 0.05  # degrees
    assert 0.65 * NOISE_PX < result.sigma < NOISE_PX  # the points of short tracks explain some of the noise
    assert result.errors.max() < 13.0 * result.sigma  # wrong matches are gone, their tracks are not:
    assert len(result.tracks) > 1200  # of 1500


def test_without_noise_the_solution_is_exact() -> None:
    ring = Ring(cameras=8, points=600)
    result = solve(ring.tracks(noise_px=0.0))
    assert ring.errors(result.state.rotation, result.state.translation).ate.max() < 1e-13


def with_depth(ring: Ring, tracks: list[ImageTracks], scale: float, shift: float) -> list[ImageTracks]:
    """The tracks with a depth prior: the true depth is ``scale * D + shift`` of the prior's."""
    guided = []
    for image in tracks:
        points = ring.points[np.isin(ring.ids, image.ids)]
        k = image.position
        depth = ((points @ ring.rotation[k].T + ring.translation[k])[:, 2] - shift) / scale
        guided.append(replace(image, depth=ImageDepth(1.0 / depth, np.ones(len(depth)), 1.0)))
    return guided


@pytest.mark.parametrize("preset", ["paper", "paper-init-only"])
def test_the_papers_steps_use_depth_on_a_set(preset: str) -> None:
    """Registration finds gamma and beta, triangulation holds points to them (paper, equations 2 to 4)."""
    ring = Ring(cameras=5, points=600)
    tracks = with_depth(ring, ring.tracks(noise_px=0.3), scale=2.0, shift=0.5)
    mapper = SetMapper(tracks, FOCAL, factorsfm.PRESETS[preset].for_image_sets())
    mapper.run()
    assert registered(mapper) == list(range(5))
    affines = [image.affine for image in mapper.images if image.affine is not None]
    if preset == "paper-init-only":
        assert not affines
        return
    assert len(affines) == 5
    # In a map u times as large as the truth gamma is 2 u and beta 0.5 u, whatever u is.
    gamma, beta = np.array(affines).T
    np.testing.assert_allclose(gamma, gamma.mean(), rtol=2e-3)
    np.testing.assert_allclose(beta / gamma, 0.25, atol=0.01)


def test_an_image_that_the_map_contradicts_is_registered_again() -> None:
    ring = Ring()
    mapper = SetMapper(ring.tracks(), FOCAL, Options().for_image_sets())
    mapper.run()
    spoiled, sound = mapper.images[3], mapper.images[3].pose
    turn = cv2.Rodrigues(np.array([0.0, 0.6, 0.1]))[0]
    spoiled.rotation, spoiled.translation = turn @ sound[0], turn @ sound[1] + [0.5, 0.0, 1.0]
    mapper._adjustment = replace(mapper._adjustment, iterations=1)  # the others hold it where it is
    mapper._adjust()
    assert not spoiled.registered
    assert "contradicts" in spoiled.message
    mapper._grow(None)
    assert registered(mapper) == list(range(len(mapper.images)))
    assert np.linalg.norm(spoiled.pose[0] @ sound[0].T - np.eye(3)) < 3e-4


def test_the_part_with_most_images_is_kept_and_the_others_are_told_why() -> None:
    large, small, lonely = Ring(7), Ring(4, seed=1, first_id=5000), Ring(1, seed=2, first_id=9000)
    tracks = large.tracks() + small.tracks(first=7) + lonely.tracks(first=11)
    mapper = SetMapper(tracks, FOCAL, Options())
    mapper.run()
    assert [image.registered for image in mapper.images] == [True] * 7 + [False] * 5
    for image in mapper.images[7:11]:
        assert image.status is FrameStatus.TOO_FEW_TRACKS
        assert "a part of 4 images" in image.message
        assert "0 of 15 needed tracks" in image.message
    assert mapper.images[11].message.startswith("0 of 15 needed tracks in common with any other image")


def registered(mapper: SetMapper) -> list[int]:
    return [k for k, image in enumerate(mapper.images) if image.registered]


def test_parts_without_common_tracks_are_maps_of_their_own() -> None:
    rings = (
        Ring(4, 900, seed=1, first_id=5000),
        Ring(7, 900),
        Ring(2, 900, seed=2, first_id=9000),
        Ring(3, 900, seed=3, first_id=12000),
    )
    tracks: list[ImageTracks] = []
    for ring in rings:
        tracks += ring.tracks(first=len(tracks))
    parts = map_parts(tracks, FOCAL, Options())
    assert [registered(part) for part in parts] == [list(range(4, 11)), [0, 1, 2, 3], [13, 14, 15]]
    for part, ring, first in zip(parts, (rings[1], rings[0], rings[3]), (4, 0, 13), strict=True):
        poses = [image.pose for image in part.images[first : first + len(ring.rotation)]]
        errors = ring.errors(np.array([r for r, _ in poses]), np.array([t for _, t in poses]))
        assert 3e-4 < errors.ate.max() < 0.008
        assert "a part of 2 images" in part.images[11].message  # too small for one of its own


def test_what_no_pose_joins_to_the_map_is_started_anew() -> None:
    """Four images have enough tracks in common with the others, but the matches that join them are wrong."""
    large, small = Ring(7), Ring(4, points=800, seed=1, first_id=5000)
    generator = np.random.default_rng(4)
    tracks = large.tracks()
    for t in small.tracks(first=7):
        ids = np.sort(generator.choice(large.ids, 60, replace=False))
        xy = generator.uniform(-0.4, 0.4, (60, 2))
        tracks.append(tracks_at(t.position, np.concatenate([ids, t.ids]), np.concatenate([xy, t.xy])))
    first, second = map_parts(tracks, FOCAL, Options())
    assert registered(first) == list(range(7))
    assert registered(second) == [7, 8, 9, 10]
    assert "of 15 needed inliers" in first.images[7].message
    poses = [image.pose for image in second.images[7:]]
    assert small.errors(np.array([r for r, _ in poses]), np.array([t for _, t in poses])).ate.max() < 0.004


def test_an_image_of_wrong_matches_is_not_registered() -> None:
    ring = Ring(6)
    tracks = ring.tracks()
    tracks[2] = tracks_at(2, tracks[2].ids, np.random.default_rng(5).uniform(-0.4, 0.4, tracks[2].xy.shape))
    mapper = SetMapper(tracks, FOCAL, Options())
    mapper.run()
    assert [image.registered for image in mapper.images] == [True, True, False, True, True, True]
    assert mapper.images[2].status is FrameStatus.TOO_FEW_INLIERS
    assert "of 15 needed inliers" in mapper.images[2].message


def test_a_guessed_focal_length_is_corrected_with_the_map() -> None:
    ring = Ring(8)
    guess = 1.2 * FOCAL
    tracks = [replace(t, camera=with_focal(t.camera, guess)) for t in ring.tracks()]
    result = solve(tracks, Options(lens="focal"), guess)
    assert result.state.focal[0] == pytest.approx(FOCAL, rel=2e-4)
    assert np.median(ring.errors(result.state.rotation, result.state.translation).ate) < 3e-3


def nearby_tracks(with_depth: bool) -> tuple[list[ImageTracks], np.ndarray]:
    """Five cameras that are 2 % of the median depth apart; the true centres."""
    generator = np.random.default_rng(0)
    points = generator.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 8.0], (800, 3))
    centers = generator.uniform(-0.05, 0.05, (5, 3))
    tracks = []
    for k, center in enumerate(centers):
        q = points - center
        xy = q[:, :2] / q[:, 2:] + generator.normal(0.0, 0.1 / FOCAL, (800, 2))
        inverse = 1.0 / q[:, 2] * generator.normal(1.0, 0.05, 800)
        depth = ImageDepth(inverse / np.median(inverse), np.ones(800), float(np.median(inverse)))
        tracks.append(tracks_at(k, np.arange(800), xy, depth if with_depth else None))
    return tracks, centers


@pytest.mark.parametrize("with_depth", [False, True])
def test_small_parallax_is_solved_with_and_without_a_prior(with_depth: bool, caplog: pytest.LogCaptureFixture) -> None:
    tracks, centers = nearby_tracks(with_depth)
    with caplog.at_level(logging.DEBUG, "factorsfm.imagesets.mapper"):
        result = solve(tracks)
    r, t = result.state.rotation, result.state.translation
    estimate = r.transpose(0, 2, 1), -np.einsum("kji,kj->ki", r, t)
    errors = trajectory_errors(*estimate, np.tile(np.eye(3), (5, 1, 1)), centers)
    assert 3e-5 < np.median(errors.ate) < 4e-4  # of a path of about 0.1
    assert (result.prior is not None) == with_depth


def test_an_image_that_sees_too_little_of_the_map_is_told_so() -> None:
    """The last one has tracks in common with its neighbour only, which see each other and nothing else."""
    ring = Ring(6)
    tracks = ring.tracks()
    own = np.arange(50_000, 50_040)  # seen by two images that cannot be registered together: they are as one
    xy = np.random.default_rng(3).uniform(-0.4, 0.4, (40, 2))
    neighbour = tracks[5]
    tracks[5] = tracks_at(5, np.concatenate([neighbour.ids, own]), np.concatenate([neighbour.xy, xy]))
    tracks.append(tracks_at(6, own, np.random.default_rng(4).uniform(-0.4, 0.4, (40, 2))))
    mapper = SetMapper(tracks, FOCAL, Options())
    mapper.run()
    assert registered(mapper) == list(range(6))
    assert mapper.images[6].status is FrameStatus.LOST
    assert mapper.images[6].message == "0 of 15 needed tracks have a point in the map"


def test_tracks_in_common_are_counted_for_every_pair() -> None:
    generator = np.random.default_rng(6)
    ids = [np.sort(generator.choice(300, size, replace=False)) for size in (120, 80, 0, 200)]
    tracks = [tracks_at(k, i, np.zeros((len(i), 2))) for k, i in enumerate(ids)]
    expected = [[len(set(a) & set(b)) if a is not b else 0 for b in ids] for a in ids]
    np.testing.assert_array_equal(common_tracks(tracks), expected)


def test_the_longest_tracks_of_every_image() -> None:
    ids = [np.array([0, 1, 2, 7]), np.array([1, 2, 3]), np.array([2, 3, 5])]
    tracks = [tracks_at(k, i, np.zeros((len(i), 2))) for k, i in enumerate(ids)]
    assert longest_tracks(tracks, 2).tolist() == [1, 2, 3]  # 2 is seen thrice, 1 and 3 twice


def test_keypoints_that_are_spread_score_more() -> None:
    generator = np.random.default_rng(7)
    xy = np.concatenate([[[-0.5, -0.5], [0.5, 0.5]], generator.uniform(-0.5, 0.5, (500, 2))])
    everywhere = generator.random(502) < 0.2
    corner = (xy < 0.0).all(axis=1)
    assert everywhere.sum() < corner.sum()
    assert pyramid_score(xy, everywhere) > 1.1 * pyramid_score(xy, corner)
    assert pyramid_score(xy, np.arange(502) == 5) == 2 + 4 + 8 + 16 + 32  # one cell of each resolution
    assert pyramid_score(xy, np.zeros(502, bool)) == 0


def test_too_little_in_common_is_no_start() -> None:
    tracks = [tracks_at(k, 100 * k + np.arange(100), np.zeros((100, 2))) for k in range(3)]
    mapper = SetMapper(tracks, FOCAL, Options())
    mapper.run()
    assert not any(image.registered for image in mapper.images)
    assert all("0 of 15 needed tracks in common" in image.message for image in mapper.images)


# --- folders ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shot() -> RenderedShot:
    return render_shot("arc", 5, 400, 300, parallax=0.25)


def jpeg_with_orientation(image: np.ndarray, orientation: int) -> bytes:
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + struct.pack("<HHI", orientation, 0, 0)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]


def test_odd_files_are_told_and_do_not_stop_the_rest(
    shot: RenderedShot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("factorsfm.imagesets.photo_folder.MAX_SIDE", 600)
    names = ["beach", "cat", "door", "house", "tree"]
    for name, image in zip(names, shot.images, strict=True):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    jpeg = cv2.imencode(".jpg", shot.images[0])[1].tobytes()
    (tmp_path / "cut.jpg").write_bytes(jpeg[: len(jpeg) // 2])
    (tmp_path / "text.jpg").write_text("no image")
    (tmp_path / "notes.txt").write_text("no image")
    cv2.imwrite(str(tmp_path / "grey.png"), cv2.cvtColor(shot.images[1], cv2.COLOR_BGR2GRAY))
    cv2.imwrite(str(tmp_path / "flat.png"), np.full((300, 400), 128, np.uint8))
    cv2.imwrite(str(tmp_path / "ztree.png"), shot.images[4])
    cv2.imwrite(str(tmp_path / "large.png"), cv2.resize(shot.images[2], (1200, 900), interpolation=cv2.INTER_CUBIC))
    cv2.imwrite(str(tmp_path / "square.png"), shot.images[2][:, 50:350])
    cv2.imwrite(str(tmp_path / "upright.png"), cv2.rotate(shot.images[3], cv2.ROTATE_90_CLOCKWISE))
    sideways = cv2.rotate(shot.images[3], cv2.ROTATE_90_CLOCKWISE)
    (tmp_path / "exif.jpg").write_bytes(jpeg_with_orientation(sideways, 8))

    result = reconstruct(tmp_path, camera=shot.camera, depth=None)

    frames = {frame.name: frame for frame in result.frames}
    truth = dict(zip(names, shot.cam_from_world, strict=True))
    twins = {"grey": "cat", "ztree": "tree", "large": "door", "upright": "house", "exif": "house"}
    truth |= {name: truth[other] for name, other in twins.items()}
    posed = [frame for frame in result.frames if frame.registered]
    assert {Path(frame.name).stem for frame in posed} == {*truth, "square"}
    posed.remove(frames["square.png"])  # from a lens that is guessed
    estimate = pose_arrays([frame.cam_from_world for frame in posed])
    expected = pose_arrays([truth[Path(frame.name).stem] for frame in posed])
    length = np.linalg.norm(expected[1][:, None] - expected[1], axis=2).max()
    errors = trajectory_errors(*estimate, *expected)
    assert 5e-5 * length < errors.ate.max() < 6e-4 * length
    assert 1e-3 < errors.r_rpe.max() < 0.015

    assert frames["cut.jpg"].status is frames["text.jpg"].status is FrameStatus.UNUSABLE
    assert frames["cut.jpg"].message == "it is truncated"
    assert "cannot be decoded" in frames["text.jpg"].message
    assert result.has_own_lenses
    assert result.camera_of(frames["square.png"]).width == 300
    assert result.camera_of(frames["large.png"]) is result.camera
    assert frames["flat.png"].status is FrameStatus.BLANK
    assert "0 of 30 needed keypoints" in frames["flat.png"].message
    assert frames["ztree.png"].message == "the same image as tree.png, whose pose it has"
    assert "reduced from 1200x900 to 600x450" in frames["large.png"].message
    assert "turned left" in frames["upright.png"].message
    text = "\n".join(result.notes)
    assert "2 cameras: 10 of 400x300 pixels" in text
    assert "1 of 300x300 pixels with a focal length of 322 (a guess)" in text
    for word in ("notes.txt", "cut.jpg", "text.jpg", "large.png", "ztree.png (as tree.png)", "flat.png"):
        assert word in text
    assert result.camera.width == 400
    assert (result.observation_xy < [400, 300]).all()
    assert len(result.colors) == len(result.points) > 200
    result.write(tmp_path / "out")
    assert (tmp_path / "out" / "trajectory.tum").read_text().count("\n") >= len(posed)


def jpeg_with_focal_length(image: np.ndarray, equivalent_mm: int) -> bytes:
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 97])[1].tobytes()
    entry = b"\x01\0" + struct.pack("<HHII", 0xA405, 3, 1, equivalent_mm)
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHII", 0x8769, 4, 1, 26) + bytes(4) + entry + bytes(4)
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:]


def test_images_of_two_cameras(tmp_path: Path) -> None:
    """Every other image is square; what EXIF says of both focal lengths is right to a tenth of a percent."""
    centers = np.stack([np.linspace(-0.5, 0.5, 6), np.zeros(6), np.zeros(6)], 1)
    poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(), c).inverse() for c in centers]
    for k, pose in enumerate(poses):
        width, equivalent_mm = ((400, 34), (300, 30))[k % 2]
        (image,) = render_views([pose], width, 300)
        (tmp_path / f"{k}.jpg").write_bytes(jpeg_with_focal_length(image, equivalent_mm))

    result = reconstruct(tmp_path, depth=None, unordered=True, lens="fixed")
    assert len(result.registered) == 6
    for k, frame in enumerate(result.frames):
        camera, width = result.camera_of(frame), (400, 300)[k % 2]
        assert (camera.width, camera.height) == (width, 300)
        assert camera.focal_length_x == pytest.approx(room_camera(width, 300).focal_length_x, rel=0.002)
    turns = np.tile(np.eye(3), (6, 1, 1))
    errors = trajectory_errors(*pose_arrays([frame.cam_from_world for frame in result.frames]), turns, centers)
    assert errors.ate.max() < 0.008  # of a path of length 1; the guess for the square images is off by 9 %
    assert errors.r_rpe.max() < 0.1
    mine = [frame.reprojection_error for frame in result.frames]
    assert 0.03 < min(mine) <= max(mine) < 0.5
    assert any("3 of 300x300 pixels with a focal length of 294 (from EXIF)" in note for note in result.notes)

    result.write(tmp_path / "out")
    again = read_result(tmp_path / "out")
    for frame, other in zip(result.frames, again.frames, strict=True):
        assert again.camera_of(other).params.tolist() == result.camera_of(frame).params.tolist()
    # The errors in the file are those of the lenses in the file.
    assert np.median(again.observation_error) == pytest.approx(np.median(result.observation_error), rel=1e-4)
    export(again, tmp_path / "splats", format="nerfstudio", options=ExportOptions(footage=tmp_path))
    written = json.loads((tmp_path / "splats" / "transforms.json").read_text())
    assert "w" not in written
    assert [frame["w"] for frame in written["frames"]] == [400, 300] * 3
    with pytest.raises(InputError, match="chan is for images of one size, and these have 300x300, 400x300 pixels"):
        export(again, tmp_path / "out.chan", format="chan")


def test_cameras_far_apart_determine_the_principal_point(tmp_path: Path) -> None:
    images = []
    for x in np.linspace(-1.2, 1.2, 6):
        turn = pycolmap.Rotation3d(np.array([0.0, -np.arctan(x / 5.0), 0.0]))
        (image,) = render_views([pycolmap.Rigid3d(turn, np.array([x, 0.1 * x**2, 0.0])).inverse()], 440, 330)
        images.append(image[20:320, 30:430])  # the middle of the lens is at (190, 145)
    result = reconstruct(images, depth=None, unordered=True)
    assert result.parallax > 0.3
    assert result.camera.mean_focal_length() == pytest.approx(room_camera(440, 330).focal_length_x, rel=5e-4)
    assert abs(result.camera.principal_point_x - 190) < 1.2  # the guess is off by 10
    assert abs(result.camera.principal_point_y - 145) < 3
    assert result.lens is not None
    assert result.lens.cx_std is not None


class Turned(PhotoFolder):
    """Takes note of what is turned, without files."""

    def __init__(self) -> None:
        self.turned: list[str] = []

    def turn(self, photo: Photo) -> None:
        self.turned.append(photo.name)


def photo(name: str, size: tuple[int, int], focal_ratio: float = 0.0) -> Photo:
    return Photo(0, name, None, size=size, full_size=size, focal_ratio=focal_ratio)


def test_format_and_focal_length_tell_cameras_apart() -> None:
    photos = [
        *(photo(f"wide{k}", (400, 300), 0.8) for k in range(3)),
        *(photo(f"tele{k}", (400, 300), 2.0 + 0.002 * k) for k in range(2)),
        photo("untold", (400, 300)),
        photo("scaled", (800, 600), 0.8),
        photo("upright", (300, 400), 2.0),
        photo("square", (300, 300)),
    ]
    files = Turned()
    wide, tele, square = find_cameras(photos, files, None)
    assert [p.camera for p in photos] == [0, 0, 0, 1, 1, 0, 0, 1, 2]
    assert files.turned == ["upright"]
    assert (wide.width, wide.focal_length) == (400, pytest.approx(320.0))
    assert (tele.width, tele.focal_length) == (400, pytest.approx(800.0, rel=0.002))
    assert square == guess_camera(300, 300)

    given = room_camera(400, 300)
    cameras = find_cameras(photos, Turned(), given)
    assert [p.camera for p in photos] == [0] * 8 + [1]
    assert cameras == [given, guess_camera(300, 300)]


def test_what_is_said_of_many_photographs_is_said_once() -> None:
    said = [("a", "blank"), *((f"p{k}", "reduced") for k in range(7)), ("b", ""), ("c", "blank")]
    assert by_reason(said) == ["a, c: blank.", "p0, p1, p2, p3, p4, … (7 in all): reduced."]


def test_a_duplicate_that_lies_on_its_side(shot: RenderedShot, tmp_path: Path) -> None:
    images = ImageSet(tmp_path, shot.camera)
    upright = cv2.rotate(shot.images[1], cv2.ROTATE_90_CLOCKWISE)
    for k, image in enumerate((shot.images[0], upright, upright)):
        images.add(Frame(k, image, f"{k}.png"))
    images._find_cameras()
    assert [photo.size for photo in images.photos[:2]] == [(400, 300)] * 2
    assert images.photos[2].twin == 1
    assert len(list((tmp_path / "images").iterdir())) == 3  # both, and one of them turned


@pytest.mark.slow
def test_an_image_of_100_megapixels_is_reduced(shot: RenderedShot, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    huge = cv2.resize(shot.images[0], (12000, 9000), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(tmp_path / "images" / "huge.jpg"), huge)
    images = ImageSet(tmp_path / "work", shot.camera)
    for image in read_images(tmp_path / "images"):
        assert isinstance(image, Frame)
        images.add(image)
    (huge_photo,) = images.photos
    assert huge_photo.size == (3200, 2400)
    assert huge_photo.remark == "reduced from 12000x9000 to 3200x2400 pixels"
    assert cv2.imread(str(tmp_path / "work" / "images" / huge_photo.file)).shape == (2400, 3200, 3)


def test_two_scenes_make_two_results(shot: RenderedShot, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The mirrored images are another scene: their keypoints match none of the first."""
    (tmp_path / "images").mkdir()
    for k, image in enumerate(shot.images):
        cv2.imwrite(str(tmp_path / "images" / f"a{k}.png"), image)
    for k in range(3):
        cv2.imwrite(str(tmp_path / "images" / f"b{k}.png"), cv2.flip(shot.images[k], 1))
    cv2.imwrite(str(tmp_path / "images" / "twin.png"), cv2.flip(shot.images[1], 1))
    (tmp_path / "camera.json").write_text(json.dumps(camera_to_json(shot.camera)))
    command = ["reconstruct", str(tmp_path / "images"), "--output", str(tmp_path / "out"), "--depth", "none"]
    assert cli.main([*command, "--camera", str(tmp_path / "camera.json"), "--unordered"]) == 0

    said = capsys.readouterr().out
    assert "fall into 2 parts that could not be joined, of 5, 3 images; this is part 1" in said
    assert "part-002: 4 of 9 frames registered" in said
    first = read_result(tmp_path / "out")
    (second,) = first.others
    assert [frame.name for frame in first.registered] == [f"a{k}.png" for k in range(5)]
    assert [frame.name for frame in second.registered] == ["b0.png", "b1.png", "b2.png", "twin.png"]
    assert len(first.points) > len(second.points) > 100
    frames = {frame.name: frame for frame in first.frames}
    assert frames["b0.png"].status is FrameStatus.LOST
    assert frames["b0.png"].message.endswith("it is in part 2, of 3 images")
    assert frames["twin.png"].message.startswith("the same image as b1.png, ")
    assert second.frames[0].message == "it is in part 1, of 5 images"
    assert not any("could not be registered" in note for note in first.notes + second.notes)
    expected = pose_arrays(shot.cam_from_world[:3])
    centers = pose_arrays([frame.cam_from_world for frame in second.registered[:3]])[1]
    sides, true = (np.linalg.norm(c - np.roll(c, 1, 0), axis=1) for c in (centers, expected[1]))
    np.testing.assert_allclose(sides / sides.sum(), true / true.sum(), atol=1e-4)  # a triangle has no handedness

    second.write(tmp_path / "out")  # a result of one part leaves nothing of the other
    assert not (tmp_path / "out" / "part-002").exists()
    assert read_result(tmp_path / "out").others == []


def test_a_given_camera_of_another_format_is_refused(shot: RenderedShot, tmp_path: Path) -> None:
    images = ImageSet(tmp_path, shot.camera)
    for k in range(2):
        images.add(Frame(k, shot.images[k][:, :200], str(k)))
    with pytest.raises(InputError, match="400x300 pixels, but none of the 2 images"):
        images.finish()


def test_one_image_is_too_few(shot: RenderedShot, tmp_path: Path) -> None:
    images = ImageSet(tmp_path, shot.camera)
    images.add(Frame(0, shot.images[0], "a.png"))
    images.leave_out(1, "b.png", "it is truncated")
    with pytest.raises(ReconstructionError, match="1 of 2 images can be used") as caught:
        images.finish()
    assert [frame.status for frame in caught.value.frames] == [FrameStatus.WAITING, FrameStatus.UNUSABLE]


def test_what_is_no_image_is_passed_on_as_unusable(shot: RenderedShot) -> None:
    good, bad, last = read_images([shot.images[0], np.zeros(5), Frame(7, shot.images[1], "x")])
    assert isinstance(good, Frame)
    assert isinstance(bad, Unusable)
    assert "shape" in bad.reason or "float64" in bad.reason
    assert isinstance(last, Frame)
    assert last.index == 7


def test_sets_and_shots_are_told_apart(shot: RenderedShot, tmp_path: Path) -> None:
    def folder(name: str, files: dict[str, np.ndarray]) -> Path:
        (tmp_path / name).mkdir()
        for file, image in files.items():
            cv2.imwrite(str(tmp_path / name / file), image)
        return tmp_path / name

    image = shot.images[0]
    moved = [np.roll(image, (2 * k, 3 * k), (0, 1)) for k in range(4)]
    apart = [cv2.rotate(i, cv2.ROTATE_180) if k % 2 else i for k, i in enumerate(moved)]
    assert not looks_unordered(folder("shot", {f"f{k:03d}.png": i for k, i in enumerate(moved)}))
    assert looks_unordered(folder("set", {f"f{k:03d}.png": i for k, i in enumerate(apart)}))
    assert looks_unordered(folder("names", {f"{n}.png": i for n, i in zip("abcd", moved, strict=True)}))
    assert looks_unordered(folder("sizes", {"f0.png": image, "f1.png": image[:200]}))
    assert not looks_unordered(folder("single", {"a.png": image}))
    assert not looks_unordered(tmp_path / "film.mp4")
    (tmp_path / "single" / "b.txt").write_text("x")
    assert other_files(tmp_path / "single") == ["b.txt"]


def test_the_grain_of_a_shot_does_not_make_photographs_of_it(shot: RenderedShot, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def grainy(name: str, images: Sequence[np.ndarray]) -> Path:
        (tmp_path / name).mkdir()
        for k, image in enumerate(images):
            noisy = image + rng.normal(0.0, 25.0, image.shape)
            cv2.imwrite(str(tmp_path / name / f"{k:04d}.png"), np.clip(noisy, 0, 255).astype(np.uint8))
        return tmp_path / name

    moved = [np.roll(shot.images[0], (2 * k, 3 * k), (0, 1)) for k in range(4)]
    assert not looks_unordered(grainy("shot", moved))
    assert looks_unordered(grainy("turned", [cv2.rotate(i, k % 3) for k, i in enumerate(moved)]))
    steps = render_shot("arc", 4, 480, 270, parallax=0.3)
    assert looks_unordered(grainy("steps", steps.images))


@pytest.mark.parametrize(
    ("names", "others", "words"),
    [
        ("plate.%04d.png", ["plate.0003.jpg"], r"plate\.0003\.jpg beside the sequence plate\.####\.png"),
        ("plate.%04d.png", [f"plate.{k:04d}.jpg" for k in range(7)], "2 sequences"),
        ("L.%04d.png", [f"R.{k:04d}.png" for k in range(8)], r"2 sequences \(L\.####\.png, R\.####\.png\)"),
        ("IMG_%04d.JPG", [f"DSC_{k:04d}.JPG" for k in range(8)], ""),
        ("IMG_%04d.JPG", ["cover.jpg"], ""),
    ],
)
def test_what_is_mixed_into_a_shot_is_refused(
    shot: RenderedShot, tmp_path: Path, names: str, others: list[str], words: str
) -> None:
    """Photographs that share as much, with the names of cameras, are still a set; and so is what shares too little."""
    moved = [np.roll(shot.images[0], (2 * k, 3 * k), (0, 1)) for k in range(8)]
    for folder, images in (("shot", moved), ("set", [cv2.rotate(i, k % 3) for k, i in enumerate(moved)])):
        (tmp_path / folder).mkdir()
        for k, image in enumerate(images):
            cv2.imwrite(str(tmp_path / folder / (names % k)), image)
        for k, name in enumerate(others):
            cv2.imwrite(str(tmp_path / folder / name), images[k])
    assert looks_unordered(tmp_path / "set")
    if not words:
        assert looks_unordered(tmp_path / "shot")
        return
    with pytest.raises(InputError, match=f"holds {words}.*; a folder with one of them is expected, unless"):
        reconstruct(tmp_path / "shot", depth=None)


def test_a_number_in_the_middle_of_the_names_is_that_of_the_frame(shot: RenderedShot, tmp_path: Path) -> None:
    for k in range(4):
        cv2.imwrite(str(tmp_path / f"plate_{1001 + k}_v02.png"), np.roll(shot.images[0], (2 * k, 3 * k), (0, 1)))
    assert not looks_unordered(tmp_path)
    assert [frame.index for frame in read_images(tmp_path, numbered=True)] == [1001, 1002, 1003, 1004]


@pytest.mark.slow
def test_two_real_scenes_in_one_folder(shared_data: Path, tmp_path: Path) -> None:
    """The photographs of both were taken with one lens."""
    scenes = [photographs(shared_data / "real" / name) for name in ("fountain-P11", "herzjesu-P8")]
    for name, scene in zip("ab", scenes, strict=True):
        scene.write(tmp_path, list(scene.images)[:6], prefix=name)
    result = reconstruct(tmp_path, camera=scenes[0].camera, depth=None)
    for part, scene in zip((result, *result.others), scenes, strict=True):
        assert len(part.registered) == 6
        estimate = pose_arrays([frame.cam_from_world for frame in part.registered])
        truth = scene.shot.rotations[:6], scene.shot.centers[:6]
        assert auc(relative_pose_errors(*estimate, *truth), 1.0) > 75.0


@pytest.mark.slow
def test_strecha_photographs_as_well_as_colmap(shared_data: Path, tmp_path: Path) -> None:
    scene = photographs(shared_data / "real" / "herzjesu-P8")
    folder = scene.write(tmp_path / "images")
    truth = scene.shot.rotations, scene.shot.centers
    result = reconstruct(folder, camera=scene.camera, depth=None, unordered=True)
    ours = pose_arrays([frame.cam_from_world for frame in result.frames])
    frames = [Frame(k, image, name) for k, (name, image) in enumerate(scene.images.items())]
    shot = replace(scene.shot, camera=scene.camera, masks=None)
    (tmp_path / "colmap").mkdir()
    colmap = colmap_default(match_frames(shot, frames, tmp_path / "colmap"))
    assert np.isfinite(ours[1]).all()
    assert np.isfinite(colmap.centers).all()
    theirs = colmap.rotations, colmap.centers
    scores = [auc(relative_pose_errors(*poses, *truth), 1.0) for poses in (ours, theirs)]
    errors = [float(np.sqrt((trajectory_errors(*poses, *truth).ate ** 2).mean())) for poses in (ours, theirs)]
    assert scores[1] - 2.0 < scores[0] < 97.0
    assert 0.001 < errors[0] < 1.1 * errors[1]
