"""How much of a shot moves by itself, on tracks of which that is known, and its file."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm.export.other_footage import at_size_of
from factorsfm.result.moving import Moving, MovingStretch, moving_in, moving_json, read_moving
from factorsfm.result.notes import moving_note
from factorsfm.result.reading import read_result
from factorsfm.support.errors import InputError
from factorsfm.tracks.image_tracks import ImageTracks
from tests.estimation_problems import tracks_at
from tests.exact_result import build

WIDTH, HEIGHT = 640, 360
FRAMES = 30
CAMERA = pycolmap.Camera(model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[500, WIDTH / 2, HEIGHT / 2])


def grid_of_tracks(frame: int) -> ImageTracks:
    """20 by 10 tracks all over the image, with ids row by row."""
    v, u = np.divmod(np.arange(200), 20)
    pixels = np.column_stack([(u + 0.5) * WIDTH / 20 - 0.5, (v + 0.5) * HEIGHT / 10 - 0.5])
    tracks = tracks_at(frame, np.arange(200), np.zeros((200, 2)))
    return replace(tracks, pixels=pixels, camera=CAMERA)


def a_quarter_moves(begin: int, end: int) -> Moving | None:
    """The left quarter of the image moves in some of the frames, whose indices are odd."""
    images = [grid_of_tracks(k) for k in range(FRAMES)]
    left = np.flatnonzero(np.arange(200) % 20 < 5)
    seen = [image if begin <= k < end else image.of(~np.isin(image.ids, left)) for k, image in enumerate(images)]
    return moving_in(seen, [2 * k + 1 for k in range(FRAMES)], np.arange(200), left)


def test_shares_of_tracks_and_image_are_told_of_a_stretch():
    found = a_quarter_moves(10, 18)
    assert found is not None
    (stretch,) = found.stretches
    assert (stretch.first, stretch.last) == (21, 35)
    assert stretch.tracks == pytest.approx(0.25, abs=1e-12)
    assert stretch.image == pytest.approx(0.25, abs=1e-12)
    np.testing.assert_array_equal(found.frame, np.repeat(np.arange(21, 36, 2), 50))
    assert found.xy[:, 0].max() < WIDTH / 4
    assert found.share_of_image(range(1, 2 * FRAMES, 2)) == pytest.approx(0.25 * 8 / FRAMES, abs=1e-12)
    assert moving_note(found).startswith(
        "Something moves by itself and is left out: frames 21 to 35: 25 % of the tracks, 25 % of the image. "
    )


def test_dense_texture_does_not_make_a_thing_larger():
    image = grid_of_tracks(0)
    dense = np.random.default_rng(0).uniform([0.0, 0.0], [WIDTH / 4, HEIGHT], (400, 2))
    fine = image.of(np.arange(200) % 20 >= 5).joined(np.arange(1000, 1400), dense)
    found = moving_in([fine] * 3, [0, 1, 2], fine.ids, np.arange(1000, 1400))
    assert found is not None
    assert found.stretches[0].tracks == pytest.approx(400 / 550)
    assert 0.24 < found.stretches[0].image < 0.29


def test_what_is_not_there_or_hardly_there_is_not_told():
    assert a_quarter_moves(10, 12) is None  # shorter than a stretch
    images = [grid_of_tracks(k) for k in range(FRAMES)]
    assert moving_in(images, range(FRAMES), np.arange(200), np.zeros(0, np.int64)) is None
    assert moving_in(images, range(FRAMES), np.arange(200), np.arange(3)) is None  # 1.5 % of the image


def test_only_the_largest_stretches_are_in_the_note():
    stretches = tuple(MovingStretch(20 * k, 20 * k + 9, 0.1, 0.1 + 0.01 * k) for k in range(4))
    note = moving_note(Moving(stretches, np.zeros(1, int), np.zeros(1, int), np.zeros((1, 2))))
    assert "frames 40 to 49: 10 % of the tracks, 12 % of the image; frames 60 to 69" in note
    assert "; 2 other stretches in summary.json." in note


def test_the_file_comes_back_to_a_hundredth_of_a_pixel(tmp_path):
    found = a_quarter_moves(10, 18)
    assert found is not None
    (tmp_path / "moving.json").write_text(json.dumps(moving_json(found)))
    again = read_moving(tmp_path / "moving.json")
    assert again is not None
    assert again.stretches == found.stretches
    np.testing.assert_array_equal(again.frame, found.frame)
    np.testing.assert_array_equal(again.track, found.track)
    assert 0.0 <= np.abs(again.xy - found.xy).max() <= 0.005 + 1e-12
    assert read_moving(tmp_path / "none.json") is None


@pytest.mark.parametrize(
    ("tracks", "said"),
    [
        ([], "it has 0 tracks; at least 1 is expected"),
        ([{"frames": [1, 2], "xy": [[1.0, 2.0]]}], "track 0 has 2 frames and no place in each"),
        ([{"frames": [1], "xy": [[1.0]]}], "track 0 has 1 frames and no place in each"),
        ([{"frames": [1], "xy": [[None, 1.0]]}], "a place is not finite"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path, tracks, said):
    (tmp_path / "moving.json").write_text(json.dumps({"stretches": [], "tracks": tracks}))
    with pytest.raises(InputError, match=said):
        read_moving(tmp_path / "moving.json")


def test_a_result_keeps_it_and_gives_it_at_the_size_of_the_footage(tmp_path):
    found = Moving((MovingStretch(10, 14, 0.2, 0.1),), np.array([10, 12]), np.array([0, 0]), np.array([[1.0, 2.0]] * 2))
    result = replace(build(), moving=found)
    result.write(tmp_path / "result")
    again = read_result(tmp_path / "result")
    assert again.moving is not None
    assert again.moving.stretches == found.stretches
    cv2.imwrite(str(tmp_path / "10.png"), np.zeros((960, 1280, 3), np.uint8))
    larger = at_size_of(again, tmp_path).moving
    assert larger is not None
    np.testing.assert_allclose(larger.xy, [[2.5, 4.5]] * 2)
    build().write(tmp_path / "result")
    assert read_result(tmp_path / "result").moving is None
