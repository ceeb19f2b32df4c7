"""Tracks of a person join frames in which hardly anything can be followed."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from factorsfm import (
    Reconstruction,
    ReconstructionError,
    UserTrack,
    UserTracks,
    read_result,
    reconstruct,
    solve_again,
)
from factorsfm.result.verdict import Grade, verdict_of
from factorsfm.synthetic import RenderedShot, render_shot
from tests.rendered import errors_of

FRAMES, GAP = 30, range(10, 20)
SIGMA = 0.4
JOINED = "Supervised tracks have joined {} frames that could not be registered without them."


@cache
def shot() -> RenderedShot:
    return render_shot("handheld", FRAMES, 320, 180, parallax=0.15)


def placed_by_hand(count: int, sigma: float = SIGMA) -> UserTracks:
    """Points of the room that are seen in most frames, with white noise."""
    true, rng = shot(), np.random.default_rng(0)
    middle, height, width = FRAMES // 2, *true.depths[0].shape
    found: list[UserTrack] = []
    while len(found) < count:
        x, y = rng.integers(20, width - 20), rng.integers(20, height - 20)
        ray = np.append(np.asarray(true.camera.cam_from_img(np.array([[x + 0.5, y + 0.5]]))).ravel(), 1.0)
        place = true.cam_from_world[middle].inverse() * (true.depths[middle][y, x] * ray)
        frames, xy = [], []
        for k, pose in enumerate(true.cam_from_world):
            seen = pose * place
            pixel = np.asarray(true.camera.img_from_cam(seen[None])).ravel() - 0.5
            column, row = np.rint(pixel).astype(int)
            inside = 2 < column < width - 3 and 2 < row < height - 3
            if inside and abs(true.depths[k][row, column] / seen[2] - 1.0) < 0.03:  # nothing hides it
                frames.append(k)
                xy.append(pixel + rng.normal(0, sigma, 2))
        if len(frames) > 0.8 * FRAMES:
            found.append(UserTrack(f"hand {len(found)}", np.array(frames), np.array(xy)))
    return UserTracks(found, sigma=sigma)


def without_texture(image: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1.5, image.shape)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 20) + noise, 0, 255).astype(np.uint8)


@cache
def with_a_gap() -> list[np.ndarray]:
    return [without_texture(image, k) if k in GAP else image for k, image in enumerate(shot().images)]


@cache
def solved(tracks: int) -> Reconstruction:
    given = placed_by_hand(tracks) if tracks else None
    return reconstruct(with_a_gap(), camera=shot().camera, depth=None, tracks=given)


def lost(result: Reconstruction) -> list[int]:
    return [frame.index for frame in result.frames if not frame.registered]


def test_frames_without_texture_get_their_poses_from_them() -> None:
    assert lost(solved(0)) == list(GAP)
    found = solved(12)
    assert lost(found) == []
    assert JOINED.format(len(GAP)) in found.notes
    assert verdict_of(found).grade is Grade.SOLVED
    error = errors_of(found, shot()).ate
    assert 0.001 < error[GAP].max() < 0.02  # of the path; the noise of 0.4 pixels shows
    assert np.delete(error, GAP).max() < 0.003
    std = [np.trace(frame.covariance[:3, :3]) ** 0.5 for frame in found.frames if frame.covariance is not None]
    assert 2.0 < np.median(np.array(std)[GAP]) / np.median(np.delete(std, GAP)[1:]) < 50.0


def test_frames_between_those_that_are_solved_get_theirs_too() -> None:
    measured = solved(12).measured
    assert measured is not None
    options = measured.options
    few = replace(measured, options=replace(options, polish=replace(options.polish, max_frames=14)))
    assert few.solved(lambda stage: None).frames == list(range(FRAMES))


def test_four_are_too_few() -> None:
    found = solved(4)
    assert lost(found) == list(GAP)
    assert re.search(r"; [34] of 5 needed supervised tracks$", found.frames[GAP[0]].message)
    assert not [note for note in found.notes if "have joined" in note]


def test_a_result_is_solved_again_with_them(tmp_path: Path) -> None:
    solved(0).write(tmp_path / "result")
    found = solve_again(tmp_path / "result", tracks=placed_by_hand(12))
    assert lost(found) == []
    assert errors_of(found, shot()).ate.max() < 0.02
    found.write(tmp_path / "joined")
    written = read_result(tmp_path / "joined")
    assert written.measured is not None
    assert written.measured.supervised.join
    again = solve_again(tmp_path / "joined")
    np.testing.assert_allclose(again.camera_centers(), found.camera_centers(), atol=1e-4)
    mended = solve_again(tmp_path / "joined", without_tracks=["hand 3", "hand 5"])
    assert lost(mended) == []
    assert "hand 3" not in mended.track_names()
    few = solve_again(tmp_path / "joined", without_tracks=[f"hand {k}" for k in range(8)])
    assert lost(few) == list(GAP)
    message = r"\d+ of 15 needed tracks agree .* in the polish; a supervised one counts for 3"
    assert re.fullmatch(message, few.frames[GAP[0]].message)


def test_they_are_enough_where_nothing_else_is_there() -> None:
    images = [without_texture(image, k) for k, image in enumerate(shot().images)]
    found = reconstruct(images, camera=shot().camera, depth=None, tracks=placed_by_hand(12))
    assert lost(found) == []
    assert JOINED.format(FRAMES) in found.notes
    assert 0.001 < errors_of(found, shot()).ate.max() < 0.03
    with pytest.raises(ReconstructionError, match=r"0 of 30 frames registered.*; [456] of 8 needed supervised tracks$"):
        reconstruct(images, camera=shot().camera, depth=None, tracks=placed_by_hand(6))


def test_they_join_two_halves_that_look_unlike() -> None:
    """Some tracks are carried over the change of the light, to wrong places: these do not count against the joint."""
    images = [255 - image if k >= GAP[0] else image for k, image in enumerate(shot().images)]
    alone = reconstruct(images, camera=shot().camera, depth=None)
    assert len(lost(alone)) >= GAP[0]
    found = reconstruct(images, camera=shot().camera, depth=None, tracks=placed_by_hand(8))
    assert lost(found) == []
    assert errors_of(found, shot()).ate.max() < 0.01
    assert verdict_of(found).grade is Grade.SOLVED


def test_a_joint_on_tracks_that_contradict_each_other_is_doubtful() -> None:
    given = placed_by_hand(12)
    wave = np.outer(np.sin(np.arange(FRAMES) / 5.0), [1.0, 1.0])
    rng = np.random.default_rng(1)
    slides = [
        replace(track, xy=track.xy + wave[track.frames] * rng.choice([-15.0, 15.0], 2)) if k < 6 else track
        for k, track in enumerate(given.tracks)
    ]
    found = reconstruct(with_a_gap(), camera=shot().camera, depth=None, tracks=UserTracks(slides, sigma=SIGMA))
    assert lost(found) == []
    verdict = verdict_of(found)
    assert verdict.grade is Grade.DOUBTFUL
    assert any("supervised tracks that join frames" in doubt for doubt in verdict.doubts)


def test_a_shot_that_is_solved_without_them_rests_on_the_others() -> None:
    found = reconstruct(shot().images, camera=shot().camera, depth=None, tracks=placed_by_hand(12))
    assert found.measured is not None
    assert not found.measured.supervised.join
    assert not [note for note in found.notes if "have joined" in note]
