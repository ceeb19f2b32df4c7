"""Picks in the report: by pointer and by keys, in the picture and in the scene; the command they give is run."""

import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factorsfm import Reconstruction, read_result
from factorsfm.cli.main import main
from factorsfm.control.fit import ControlFit
from factorsfm.report import report_html
from factorsfm.report.result_folder import write_folder
from tests.alignment.test_align import HEIGHT, in_first_camera, pixel, room
from tests.report.chromium import EXECUTABLE, MISSING, Chromium
from tests.report.test_overlay import FLOOR
from tests.report.test_report_browser import Report, with_thumbnails

pytestmark = pytest.mark.skipif(EXECUTABLE is None, reason=MISSING)

NEAR, FAR, THIRD = np.array([0.3, FLOOR, 4.5]), np.array([-0.6, FLOOR, 5.5]), np.array([0.7, FLOOR, 5.8])


class Page(Report):
    """A report with picks; `result` is what it shows."""

    def __init__(self, browser: Chromium, folder: Path, result: Reconstruction) -> None:
        super().__init__(browser, folder)
        self.result = result

    def command(self) -> list[str]:
        return shlex.split(self.text("command"))

    def choose(self, name: str, value: str) -> None:
        self.run(f"document.querySelector('input[name={name}][value={value}]').click()")

    def type(self, field: str, text: str) -> None:
        self.run(f"byId('{field}').value = ''; byId('{field}').focus()")
        for key in text:
            self.browser.press(key)

    def click(self, canvas: str, u: float, v: float) -> None:
        """At a share of the width and height of a canvas."""
        x, y = self.run(
            f"(() => {{ const node = byId('{canvas}'); node.scrollIntoView({{block: 'center'}});"
            f"const box = node.getBoundingClientRect();"
            f"return [box.x + {u} * box.width, box.y + {v} * box.height]; }})()"
        )
        self.browser.click(x, y)

    def pick(self, name: str, point: np.ndarray, frame: int = 0) -> None:
        """A point, which is given in the axes of the first camera, in the picture."""
        self.run(f"goTo({frame}); document.querySelector('[data-pick={name}] button').click()")
        self.click_at(point, frame)

    def click_at(self, point: np.ndarray, frame: int = 0) -> None:
        place, camera = pixel(self.result, point, frame), self.result.camera
        self.click("footage", (place.x + 0.5) / camera.width, (place.y + 0.5) / camera.height)


@pytest.fixture
def page(browser: Chromium, tmp_path: Path) -> Iterator[Page]:
    result = with_thumbnails(room())
    folder = tmp_path / "it's a result"
    write_folder(result, folder)
    page = Page(browser, folder, result)
    page.open(page.page.read_text())
    yield page
    page.check()


def test_picks_in_the_picture_give_origin_axis_and_unit(page: Page) -> None:
    folder = str(page.page.parent)
    assert page.command() == ["factorsfm", "align", folder]
    page.pick("origin", NEAR)
    page.pick("axis", FAR, 4)
    page.choose("scale", "distance")
    assert page.hidden("command_row") == [True]
    assert page.text("align_status") == "Pick both ends of the distance."
    page.pick("from", NEAR, 1)
    page.click_at(FAR, 1)  # the other end is asked for by itself
    assert page.text("align_status") == "Type the distance in metres."
    length = 2 * float(np.linalg.norm(FAR - NEAR))
    page.type("metres", f"{length:.4f}")
    page.type("sigma", "-1")
    assert page.text("align_status") == "The standard deviation is 0 metres or more."
    page.type("sigma", "0.01")
    words = page.command()
    assert words[:4] == ["factorsfm", "align", folder, "--origin"]
    assert words[-1] == f"{length:.4f},0.01"
    assert main(words[1:]) == 0
    aligned = read_result(folder)
    assert (aligned.alignment.origin_from, aligned.alignment.x_from) == ("pick", "pick")
    # A click is a pixel of the screen, which are about as large as those of the footage.
    np.testing.assert_allclose(in_first_camera(aligned, [0, 0, 0]), 2 * NEAR, atol=0.06)
    along = aligned.frames[0].cam_from_world.rotation.matrix()[:, 0]
    np.testing.assert_allclose(along, (FAR - NEAR) / np.linalg.norm(FAR - NEAR), atol=0.02)
    assert aligned.alignment.camera_height == pytest.approx(2 * HEIGHT, rel=0.02)


def test_three_picks_are_the_ground_and_a_height_gives_the_unit(page: Page) -> None:
    page.choose("ground", "picked")
    assert page.hidden("command_row") == [True]
    page.pick("origin", NEAR)
    page.click_at(FAR)
    page.click_at(THIRD)
    page.choose("scale", "height")
    page.type("height", "3")
    words = page.command()
    assert main(words[1:]) == 0
    known = read_result(page.page.parent).alignment
    assert (known.up_from, known.ground_from, known.scale_from) == (["picks"], "picks", "height")
    assert known.camera_height == pytest.approx(3)
    assert known.up_std < 3


def test_a_point_of_the_scene_is_picked_where_it_is_tracked(page: Page) -> None:
    page.run("document.querySelector('[data-look=through]').click(); goTo(2)")
    page.run("document.querySelector('[data-pick=origin] button').click()")
    u, v = page.run(
        """(() => {
          const {clientWidth: width, clientHeight: height} = scene.canvas, from = viewer(width, height);
          globalThis.wanted = tracks.start[2] + 7;
          const d = [0, 1, 2].map(k => points[3 * tracks.point[wanted] + k] - from.eye[k]), w = dot(from.axes[2], d);
          return [0, 1].map(k => from.focal * dot(from.axes[k], d) / w);
        })()"""
    )
    width, height = page.run("[scene.canvas.clientWidth, scene.canvas.clientHeight]")
    page.click("scene", 0.5 + u / width, 0.5 + v / height)
    chosen, wanted = page.run(
        "[aligning.picks.origin, [tracks.place[2 * wanted] / 65535, tracks.place[2 * wanted + 1] / 65535]]"
    )
    assert chosen["position"] == 2
    # The nearest of several points is as good: it is within the reach of a click, 14 pixels of the screen.
    np.testing.assert_allclose([chosen["u"], chosen["v"]], wanted, atol=0.03)
    np.testing.assert_allclose(page.run("behind(aligning.picks.origin)"), chosen["point"], rtol=0.05, atol=0.05)
    moved = page.digest("scene")
    page.run("document.querySelector('[data-pick=origin] button:last-child').click()")
    assert page.digest("scene") != moved
    assert page.command()[3:] == []


def test_keys_pick_and_leave(page: Page) -> None:
    page.press("[data-pick=origin] button", "Enter")
    assert page.run("document.activeElement.id") == "footage"
    page.press("#footage", "PageDown", "ArrowRight", "ArrowDown", "ArrowDown")
    loupe = page.digest("footage")
    page.press("#footage", "Enter")
    width, height = page.result.camera.width, page.result.camera.height
    assert page.command()[3:] == ["--origin", f"1:{0.52 * width - 0.5:g},{0.54 * height - 0.5:g}"]
    assert page.run("document.activeElement.textContent") == "Origin"
    assert page.digest("footage") != loupe
    page.press("[data-pick=axis] button", "Enter")
    assert page.text("align_status").startswith("Click “Along x”")
    page.press("#footage", "Escape")
    assert page.text("align_status") == ""
    assert page.run("aligning.waiting") is None
    page.press("#footage", "ArrowRight")
    assert page.run("seek.position") == 2
    page.run("data.footage = '/moved/the shot.mp4'; showAlignment()")
    assert page.command()[-2:] == ["--footage", "/moved/the shot.mp4"]
    page.run("byId('copy').click()")
    assert page.text("align_status") == "Copied."
    assert page.run("getSelection().toString()") == page.text("command")


def test_an_axis_needs_an_origin_and_every_pick_a_pose(page: Page) -> None:
    lost = next(k for k, frame in enumerate(page.result.frames) if not frame.registered)
    page.run(f"goTo({lost}); document.querySelector('[data-pick=axis] button').click()")
    assert page.run("seek.position") != lost
    page.run(f"goTo({lost})")
    page.click("footage", 0.5, 0.9)
    shown = page.run("seek.position")
    assert page.text("align_status").startswith(
        f"Frame {lost} has no pose or no picture of its own; this is frame {shown}."
    )
    page.click_at(NEAR, shown)
    assert page.text("align_status") == "A point along x needs an origin."
    page.run("document.querySelector('[data-pick=origin] button').click()")
    page.click("footage", 0.5, 0.01)
    assert page.text("align_status").startswith("Picked, but there are hardly any tracks around this pixel")
    assert page.hidden("command_row") == [False]


def test_a_narrow_window(page: Page) -> None:
    page.open(page.page.read_text(), size=(360, 700), dark=True)
    page.choose("ground", "picked")
    page.choose("scale", "distance")
    page.pick("origin", NEAR)
    page.click_at(FAR)
    page.click_at(THIRD)
    page.pick("from", NEAR)
    page.click_at(FAR)
    page.type("metres", "1")
    assert len(page.command()) == 13


@pytest.mark.parametrize(("placed", "hidden"), [(True, [True, False]), (False, [False, True])])
def test_what_the_control_says_is_not_asked_for(browser: Chromium, tmp_path: Path, placed: bool, hidden: list) -> None:
    control = ControlFit([], [], [], placed=placed, scale_std=0.01, position_std=0.1)
    page = Page(browser, tmp_path, replace(room(), control=control))
    page.open(report_html(page.result))
    assert page.hidden("align_section", "scale_choice") == hidden
