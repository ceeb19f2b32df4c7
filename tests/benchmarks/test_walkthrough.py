"""The walk-through is followed with fewer frames: the page writes its command, and the cube stays on the true floor."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from benchmarks import walkthrough
from benchmarks.walkthrough import BLENDER, FIRST, PICKS, read_walk
from factorsfm import read_camera, read_result
from tests.pages import DOCS
from tests.report.chromium import EXECUTABLE, MISSING, Chromium

FRAMES = 10
FLOOR = 1.1  # of the room, below the first camera
SIZE = 0.4  # of the cube


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working directory with the shot of the page, which is solved."""
    folder, walk = tmp_path_factory.mktemp("walk"), read_walk()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert walk.footage.count("frames=48") == 1
        exec(walk.footage.replace("frames=48", f"frames={FRAMES}"), {})
        walkthrough.run(walk.solve)
        yield folder


def floor_points() -> dict[str, np.ndarray]:
    """Where the picks of the page are in the room, in the axes of the first camera."""
    camera = read_camera(Path("room/camera.json"))
    rays = camera.cam_from_img(np.array(read_walk().pixels) + 0.5)
    points = FLOOR / rays[:, 1:] * np.column_stack([rays, np.ones(len(rays))])
    return dict(zip(PICKS, points, strict=True))


@pytest.mark.skipif(EXECUTABLE is None, reason=MISSING)
def test_the_report_writes_the_command_of_the_page(place: Path, tmp_path: Path) -> None:
    browser, walk = Chromium(tmp_path), read_walk()
    words = walkthrough.pick_in_page(browser, place / "walk" / "report.html", walk)
    walkthrough.choose_tracks(browser)
    assert "--without-tracks" in browser.run("byId('mend_command').value")
    browser.close()
    assert len(words) == len(walk.align)
    for word, said in zip(words, walk.align, strict=True):
        if said.startswith("0:"):
            assert word.startswith("0:")
            np.testing.assert_allclose(*([float(x) for x in w[2:].split(",")] for w in (word, said)), atol=0.1)
        elif said == "walk":
            assert word == str(place / "walk")
        else:
            assert word == said


@pytest.mark.skipif(BLENDER is None, reason="Blender is not installed (Debian's package: blender)")
def test_the_cube_stands_on_the_floor_in_every_frame(place: Path, tmp_path: Path) -> None:
    walk, true = read_walk(), floor_points()
    for command in ([*walk.view, "--no-browser"], walk.align, walk.export):
        walkthrough.run(command)
    known = read_result("walk").alignment
    measured = float(walk.align[-1].split(",")[0])
    assert np.linalg.norm(true["to"] - true["from"]) == pytest.approx(measured, abs=0.005)
    assert known.camera_height == pytest.approx(FLOOR, abs=0.03)
    feet = walkthrough.run_blender(place / "room.py", walk.cube, tmp_path)
    assert sorted(feet) == list(range(FIRST, FIRST + FRAMES))
    along = (true["axis"] - true["origin"]) / np.linalg.norm(true["axis"] - true["origin"])
    across = np.cross(along, [0.0, 1.0, 0.0])
    corners = true["origin"] + SIZE / 2 * np.array([a * along + b * across for a in (-1, 1) for b in (-1, 1)])
    camera = read_camera(place / "room" / "camera.json")
    misses = []
    for number, (_, *center, x, y, z, w) in enumerate(np.loadtxt(place / "room" / "groundtruth.txt"), FIRST):
        cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d([x, y, z, w]), center).inverse()
        seen = camera.img_from_cam(cam_from_world * corners) - 0.5
        misses.append(np.linalg.norm(feet[number][:, None] - seen, axis=2).min(axis=1))
    assert np.max(misses) < 1.0


def test_its_pictures_are_small() -> None:
    for name in ("walk-view.jpg", "walk-cube.jpg", "report-tracks.jpg"):
        assert (DOCS / "images" / name).stat().st_size < 150_000
