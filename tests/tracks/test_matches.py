"""Tracks from pairwise matches, and matching itself on rendered images with exact truth."""

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from factorsfm.synthetic import RenderedShot, render_shot
from factorsfm.tracks import matches
from factorsfm.tracks.match_tracks import tracks_from_matches
from factorsfm.tracks.matches import PairMatches, match_images, read_matches
from tests.image_files import write_images


def keypoints(*counts: int) -> list[np.ndarray]:
    return [np.random.default_rng(i).uniform(0, 500, (n, 2)) for i, n in enumerate(counts)]


def pair(first: int, second: int, *rows: tuple[int, int]) -> PairMatches:
    return PairMatches(first, second, np.array(rows, np.int64).reshape(-1, 2))


def as_sets(joined: list[tuple[np.ndarray, np.ndarray]]) -> set[frozenset[tuple[int, int]]]:
    """Tracks as sets of (image, keypoint)."""
    tracks: dict[int, set[tuple[int, int]]] = {}
    for image, (ids, rows) in enumerate(joined):
        assert (np.diff(ids) > 0).all()  # ascending, and an image at most once
        for i, r in zip(ids.tolist(), rows.tolist(), strict=True):
            tracks.setdefault(i, set()).add((image, r))
    assert sorted(tracks) == list(range(len(tracks)))
    return {frozenset(t) for t in tracks.values()}


def test_matches_join_through_other_images() -> None:
    joined = tracks_from_matches(
        keypoints(3, 3, 3, 2), [pair(0, 1, (0, 2), (1, 1)), pair(1, 2, (2, 0)), pair(2, 3, (1, 1))]
    )
    assert as_sets(joined) == {
        frozenset({(0, 0), (1, 2), (2, 0)}),
        frozenset({(0, 1), (1, 1)}),
        frozenset({(2, 1), (3, 1)}),
    }


def test_no_matches_no_tracks() -> None:
    assert as_sets(tracks_from_matches(keypoints(3, 0, 2), [])) == set()


def test_keypoints_at_one_place_are_one() -> None:
    points = keypoints(2, 2, 2)
    points[1][1] = points[1][0]  # the second orientation of the same keypoint
    joined = tracks_from_matches(points, [pair(0, 1, (0, 0)), pair(1, 2, (1, 1))])
    assert as_sets(joined) == {frozenset({(0, 0), (1, 0), (2, 1)})}


def test_a_track_that_sees_an_image_twice_is_split_where_fewest_matches_join_it() -> None:
    strong = [(i, i) for i in range(1, 6)]
    joined = tracks_from_matches(
        keypoints(8, 8, 8),
        [pair(0, 1, (0, 0), *strong), pair(1, 2, (0, 0), *strong[:4]), pair(0, 2, (7, 0), (6, 6))],
    )
    tracks = as_sets(joined)
    assert frozenset({(0, 0), (1, 0), (2, 0)}) in tracks
    assert not any((0, 7) in t for t in tracks)
    assert frozenset({(0, 6), (2, 6)}) in tracks


def test_components_agree_with_a_search_of_the_graph() -> None:
    generator = np.random.default_rng(3)
    n, images = 60, 12
    points = keypoints(*[n] * images)
    truth = [generator.permutation(n) for _ in range(images)]  # keypoint of every point
    pairs, neighbours = [], {(i, k): set() for i in range(images) for k in range(n)}
    for a in range(images):
        for b in range(a + 1, images):
            seen = generator.permutation(n)[: generator.integers(0, 12)]
            rows = np.stack([truth[a][seen], truth[b][seen]], 1)
            pairs.append(PairMatches(a, b, rows))
            for r, s in rows.tolist():
                neighbours[a, r].add((b, s))
                neighbours[b, s].add((a, r))
    expected, left = set(), {k for k, v in neighbours.items() if v}
    while left:
        todo, component = [left.pop()], set()
        while todo:
            node = todo.pop()
            component.add(node)
            todo += [m for m in neighbours[node] if m in left]
            left -= neighbours[node]
        expected.add(frozenset(component))
    assert as_sets(tracks_from_matches(points, pairs)) == expected


@pytest.fixture(scope="module")
def shot() -> RenderedShot:
    return render_shot("truck", 3, 400, 300, parallax=0.15)


def test_matches_obey_the_true_geometry(shot: RenderedShot, tmp_path: Path) -> None:
    names = write_images(shot, tmp_path / "images")
    found = match_images(tmp_path / "m.db", tmp_path / "images", names, [shot.camera] * 3)
    assert len(found.pairs) == 3
    for p in found.pairs:
        assert len(p.rows) > 400
        a, b = found.keypoints[p.first][p.rows[:, 0]], found.keypoints[p.second][p.rows[:, 1]]
        # Lift with the true depth and project: keypoints have their centres at integers.
        x, y = np.clip(np.rint(a).astype(int), 0, [[399, 299]]).T
        rays = np.column_stack([shot.camera.cam_from_img(a + 0.5), np.ones(len(a))])
        relative = shot.cam_from_world[p.second] * shot.cam_from_world[p.first].inverse()
        there = np.asarray(shot.camera.img_from_cam(relative * (rays * shot.depths[p.first][y, x][:, None]))) - 0.5
        error = np.median(np.abs(there - b), axis=0)
        assert (error > 0.025).all()
        assert (error < 0.13).all()
        assert np.abs(np.median(there - b, axis=0)).max() < 0.01


def test_work_goes_on_where_it_stopped(shot: RenderedShot, tmp_path: Path) -> None:
    names = write_images(shot, tmp_path / "images")
    database, images, cameras = tmp_path / "m.db", tmp_path / "images", [shot.camera] * 3
    first = match_images(database, images, names[:2], cameras[:2])
    second = match_images(database, images, names, cameras)
    assert np.array_equal(first.keypoints[1], second.keypoints[1])
    assert np.array_equal(first.pairs[0].rows, second.pairs[0].rows)
    for name in names:
        (images / name).unlink()  # all features are there: nothing is read again
    third = match_images(database, images, names, cameras)
    assert [len(p.rows) for p in third.pairs] == [len(p.rows) for p in second.pairs]


def test_a_database_of_other_images_is_replaced(shot: RenderedShot, tmp_path: Path) -> None:
    names = write_images(shot, tmp_path / "images")
    match_images(tmp_path / "m.db", tmp_path / "images", names[:2], [shot.camera] * 2)
    found = match_images(tmp_path / "m.db", tmp_path / "images", names[1:], [shot.camera] * 2)
    assert len(found.pairs) == 1
    with pycolmap.Database.open(tmp_path / "m.db") as db:
        assert {image.name for image in db.read_all_images()} == set(names[1:])


def test_masked_pixels_give_no_keypoints(shot: RenderedShot, tmp_path: Path) -> None:
    names = write_images(shot, tmp_path / "images")[:2]
    (tmp_path / "masks").mkdir()
    mask = np.full((300, 400), 255, np.uint8)
    cv2.imwrite(str(tmp_path / "masks" / "1.png.png"), mask)
    mask[:, :200] = 0
    cv2.imwrite(str(tmp_path / "masks" / "0.png.png"), mask)
    found = match_images(tmp_path / "m.db", tmp_path / "images", names, [shot.camera] * 2, tmp_path / "masks")
    assert found.keypoints[0][:, 0].min() > 198
    assert found.keypoints[1][:, 0].min() < 5


def test_large_sets_are_paired_by_appearance(
    shot: RenderedShot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matches, "EXHAUSTIVE_UP_TO", 2)
    monkeypatch.setattr(matches, "_VISUAL_WORDS", 64)
    names = write_images(shot, tmp_path / "images")
    found = match_images(tmp_path / "m.db", tmp_path / "images", names, [shot.camera] * 3)
    assert {(p.first, p.second) for p in found.pairs} == {(0, 1), (0, 2), (1, 2)}
    assert min(len(p.rows) for p in found.pairs) > 100


def test_images_without_features_are_empty(tmp_path: Path, shot: RenderedShot) -> None:
    names = write_images(shot, tmp_path / "images")
    cv2.imwrite(str(tmp_path / "images" / "1.png"), np.full((300, 400), 90, np.uint8))
    found = match_images(tmp_path / "m.db", tmp_path / "images", names, [shot.camera] * 3)
    assert len(found.keypoints[1]) == 0
    assert [(p.first, p.second) for p in found.pairs] == [(0, 2)]
    again = read_matches(tmp_path / "m.db", ["unknown.png"])
    assert len(again.keypoints[0]) == 0
    assert again.pairs == []


def test_images_are_numbered_by_name_whatever_is_found_first(shot: RenderedShot, tmp_path: Path) -> None:
    """Pairs are verified from the smaller number to the larger one: another order would give other matches."""
    names = write_images(shot, tmp_path / "images")
    runs = [match_images(tmp_path / f"{k}.db", tmp_path / "images", names, [shot.camera] * 3) for k in range(2)]
    with pycolmap.Database.open(tmp_path / "0.db") as db:
        assert [image.name for image in db.read_all_images()] == sorted(names)
    for first, second in zip(*(run.pairs for run in runs), strict=True):
        np.testing.assert_array_equal(first.rows, second.rows)
