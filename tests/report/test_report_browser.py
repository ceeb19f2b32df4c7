"""The report in a real browser: it draws, follows slider, keys and pointer, fits its window, and asks nobody."""

import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from factorsfm.report import Thumbnails, failure_html, report_html
from factorsfm.result.moving import Moving, MovingStretch
from factorsfm.result.reconstruction import Reconstruction
from tests.exact_result import build
from tests.report.chromium import EXECUTABLE, MISSING, Chromium

pytestmark = pytest.mark.skipif(EXECUTABLE is None, reason=MISSING)

# What a canvas shows: its pixels, read from a copy, since reading the canvas itself makes Chromium complain.
HELPERS = """
globalThis.settled = async () => {
  const frame = () => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)));
  do await frame(); while (pictures.some(kept => kept && kept.picture.src && !kept.picture.complete));
  await frame();
};
globalThis.pixels = id => {
  const {width, height} = byId(id), copy = new OffscreenCanvas(width, height).getContext("2d");
  copy.drawImage(byId(id), 0, 0);
  return copy.getImageData(0, 0, width, height).data;
};
globalThis.filled = id => {
  const data = pixels(id);
  let n = 0;
  for (let i = 3; i < data.length; i += 4) n += data[i] > 0;
  return 4 * n / data.length;
};
globalThis.digest = id => pixels(id).reduce((sum, value, i) => (sum + value * (i % 9973 + 1)) % 4294967296, 0);
settled()
"""


class Report:
    """A report that is open in the browser."""

    def __init__(self, browser: Chromium, folder: Path) -> None:
        self.browser, self.page = browser, folder / "report.html"

    def open(self, html: str, size: tuple[int, int] = (1280, 900), dark: bool = False) -> None:
        self.page.write_text(html, encoding="utf-8")
        self.browser.open(self.page, size, dark)
        self.browser.run(HELPERS)

    def run(self, script: str) -> Any:
        value = self.browser.run(script)
        self.browser.run("settled()")
        return value

    def filled(self, canvas: str) -> float:
        """Share of a canvas that is drawn on."""
        return float(self.run(f"filled('{canvas}')"))

    def digest(self, canvas: str) -> int:
        return int(self.run(f"digest('{canvas}')"))

    def text(self, name: str) -> str:
        return str(self.run(f"byId('{name}').textContent"))

    def hidden(self, *names: str) -> list[bool]:
        return [self.run(f"byId('{name}').hidden") for name in names]

    def press(self, element: str, *keys: str) -> None:
        self.run(f"document.querySelector('{element}').focus()")
        for key in keys:
            self.browser.press(key)
        self.run("0")

    def check(self) -> None:
        """Nothing on the console, nothing asked of the network, nothing wider than the window."""
        assert self.browser.complaints == []
        assert [url for url in self.browser.requests if not url.startswith("data:")] == [self.page.as_uri()]
        assert self.run("document.documentElement.scrollWidth - innerWidth") <= 0


@pytest.fixture
def report(browser: Chromium, tmp_path: Path) -> Iterator[Report]:
    report = Report(browser, tmp_path)
    yield report
    report.check()


def with_thumbnails(reconstruction: Reconstruction) -> Reconstruction:
    thumbnails = Thumbnails()
    for k in range(len(reconstruction.frames)):
        image = np.full((480, 640, 3), 60, np.uint8)
        cv2.circle(image, (100 + 60 * k, 240), 80, (40, 160, 230), -1)
        thumbnails.add(image)
    thumbnails.attach(reconstruction.frames)
    return reconstruction


def test_what_moves_by_itself_is_drawn_and_hidden(report: Report) -> None:
    reconstruction = with_thumbnails(build())
    report.open(report_html(reconstruction))
    assert report.hidden("moving_control") == [True]
    plain, strip = report.digest("footage"), report.digest("strip")
    xy = np.random.default_rng(0).uniform([0.0, 0.0], [640.0, 480.0], (60, 2))
    places = np.concatenate([xy, xy + 5.0])
    moving = Moving((MovingStretch(10, 12, 0.5, 0.5),), np.repeat([10, 12], 60), np.tile(np.arange(60), 2), places)
    report.open(report_html(replace(reconstruction, moving=moving)))
    assert report.hidden("moving_control") == [False]
    assert report.digest("strip") != strip
    shown = report.digest("footage")
    report.run("byId('show_moving').click()")
    assert report.digest("footage") == plain != shown


def test_everything_is_drawn(report: Report) -> None:
    reconstruction = with_thumbnails(build(points=400))
    reconstruction.observation_xy = reconstruction.observation_xy + 0.5  # else there are no residuals
    report.open(report_html(reconstruction))
    assert 0.002 < report.filled("scene") < 0.2
    for canvas in ("footage", "solved_depth", "prior_depth"):
        assert report.filled(canvas) == 1
    assert 0.002 < report.filled("depth_scatter") < 0.5
    assert report.filled("strip") > 0.95
    assert report.run("document.querySelectorAll('#charts figure').length") == 5
    corner = report.run("Array.from(pixels('footage').slice(0, 3))")  # of the thumbnail
    np.testing.assert_allclose(corner, 60, atol=8)
    drawn = report.digest("footage")
    report.run("byId('show_tracks').click()")
    without_tracks = report.digest("footage")
    report.run("byId('show_residuals').click()")
    assert len({drawn, without_tracks, report.digest("footage")}) == 3


def test_the_slider_moves_everything(report: Report) -> None:
    report.open(report_html(with_thumbnails(build(points=400))))
    assert report.text("status").startswith("Frame 10 · 0.00 s · solved, keyframe · 400 inliers")
    before = {canvas: report.digest(canvas) for canvas in ("scene", "footage", "strip", "prior_depth")}
    marker = "charts[0].marker.getAttribute('x1')"
    mark = report.run(marker)
    report.press("#slider", "ArrowRight", "ArrowRight", "ArrowRight", "ArrowRight")
    assert report.text("status").startswith("Frame 18 · 0.17 s · solved, keyframe")
    assert [canvas for canvas in before if report.digest(canvas) == before[canvas]] == []
    assert float(report.run(marker)) > float(mark) + 10
    report.press("#slider", "ArrowLeft")
    assert "Frame 16 · 0.13 s · tracks contradict the scene · 14 of 30 inliers needed" in report.text("status")
    hint = report.text("depth_hint")
    assert hint.startswith(
        "Frame 14, the nearest one with a depth prior: the prior is off by 17.6 % at half of the 400"
    )
    report.press("#charts svg", "ArrowLeft")
    assert report.run("[seek.position, byId('slider').value]") == [2, "2"]
    report.browser.drag("#strip", 580, 0)
    assert report.run("seek.position") == 5
    moved = "new Promise(done => setInterval(() => seek.position !== 5 && done(true), 10))"
    assert report.run(f"byId('play').click(); Promise.race([{moved}, new Promise(done => setTimeout(done, 10000))])")
    assert report.run("byId('play').click(), byId('play').textContent") == "Play"


def test_tracks_are_sorted_shown_and_left_out_by_the_copied_command(report: Report) -> None:
    reconstruction = with_thumbnails(build())
    wrong = np.isin(reconstruction.observation_point, [7, 31])
    reconstruction.observation_error = np.where(wrong, 5.0 + reconstruction.observation_error, 0.2)
    report.open(report_html(reconstruction, can_be_mended=True))
    first = "[...byId('tracks_rows').rows].slice(0, 2).map(row => row.cells[1].textContent)"
    assert report.run(first) == ["track_00108", "track_00132"]
    plain = {canvas: report.digest(canvas) for canvas in ("footage", "pointed")}
    report.run("byId('tracks_rows').rows[0].querySelector('button').click()")
    assert report.text("status").startswith("Frame 20 ")  # where its error is largest
    report.run("goTo(0)")
    assert [canvas for canvas in plain if report.digest(canvas) == plain[canvas]] == []
    report.run("document.querySelector('[data-sort=name]').click()")
    assert report.run(first) == ["track_00101", "track_00102"]
    for name in ("track_00132", "track_00108"):
        row = f"[...byId('tracks_rows').rows].find(row => row.cells[1].textContent === '{name}')"
        report.run(f"{row}.querySelector('input').click()")
    command = report.run("byId('mend_command').value")
    assert shlex.split(command)[:2] == ["factorsfm", "solve"]
    assert shlex.split(command)[2:] == [
        str(report.page.parent), "--without-tracks", "108", "132", "--output", f"{report.page.parent}-mended",
    ]  # fmt: skip
    report.run("byId('mend_copy').click()")
    assert report.text("mend_copy") == "Copied"
    report.run("byId('mend_none').click()")
    assert report.run("byId('mend_command').value") == ""
    report.open(report_html(reconstruction))  # of images in any order: nothing to solve again
    assert report.hidden("tracks_section", "mend_controls", "mend_column") == [False, True, True]


def test_the_scene_turns(report: Report) -> None:
    report.open(report_html(build(points=400)))
    seen = [report.digest("scene")]
    report.press("#scene", "ArrowLeft")
    seen.append(report.digest("scene"))
    report.press("#scene", "ArrowUp")
    seen.append(report.digest("scene"))
    report.press("#scene", "+")
    seen.append(report.digest("scene"))
    report.browser.drag("#scene", 50, 20)
    seen.append(report.digest("scene"))
    for look in ("path", "above", "side", "through"):
        report.run(f"document.querySelector('[data-look={look}]').click()")
        seen.append(report.digest("scene"))
    report.run("document.getElementsByName('paint')[1].click()")
    seen.append(report.digest("scene"))
    assert len(set(seen)) == len(seen)
    report.run("document.getElementsByName('paint')[0].click()")
    report.press("#scene", "0")
    assert report.digest("scene") == seen[0]


def test_the_points_stand_where_the_camera_sees_them(report: Report) -> None:
    """Through the camera, the points fall on the places of the tracks."""
    report.open(report_html(build(points=30)))
    report.run("document.querySelector('[data-look=through]').click(); goTo(0)")
    misses = report.run(
        """(() => {
          const from = viewer(data.width, data.height), misses = [];
          for (let o = tracks.start[0]; o < tracks.start[1]; o++) {
            const d = [0, 1, 2].map(k => points[3 * tracks.point[o] + k] - from.eye[k]), w = dot(from.axes[2], d);
            const x = data.width / 2 + from.focal * dot(from.axes[0], d) / w;
            misses.push(x - tracks.place[2 * o] / 65535 * data.width);
          }
          return misses;
        })()"""
    )
    # the viewer is a pinhole, the camera of the fixture distorts a little and is 1 pixel off the middle
    assert len(misses) == 30
    assert np.abs(misses).max() < 4


def test_narrow_dark_and_without_thumbnails_or_prior(report: Report) -> None:
    reconstruction = build()
    reconstruction = replace(reconstruction, prior_residual=np.full_like(reconstruction.prior_residual, np.nan))
    report.open(report_html(reconstruction), size=(360, 700), dark=True)
    assert report.run("innerWidth") == 360
    assert report.run("getComputedStyle(document.body).backgroundColor") == "rgb(20, 21, 23)"
    assert report.hidden("depth_section", "scene_card", "footage_card") == [True, False, False]
    assert 0.0005 < report.filled("scene") < 0.2
    assert 0.0005 < report.filled("footage") < 0.2


def test_a_failed_shot(report: Report) -> None:
    frames = with_thumbnails(build(unregistered=tuple(range(6)))).frames
    report.open(failure_html("14 of 30 inliers needed", frames, {}, {}))
    assert report.run("getComputedStyle(document.body).backgroundColor") == "rgb(246, 246, 244)"
    assert report.hidden("scene_card", "depth_section", "footage_card", "charts_section") == [True, True, False, False]
    assert report.run("document.querySelector('.explanation').textContent") == (
        "6 frames: tracks contradict the scene. 14 of 30 inliers needed."
    )
    assert report.filled("footage") == 1
    before = report.digest("footage")
    report.press("#slider", "End")
    assert "Frame 20" in report.text("status")
    assert report.digest("footage") != before


@pytest.mark.parametrize(
    "html",
    [
        report_html(build(frames=1)),
        report_html(build(points=0)),
        report_html(build(unregistered=tuple(range(6)))),
        failure_html("no frames", [], {}, {}),
    ],
    ids=["one frame", "no points", "no cameras", "nothing"],
)
def test_odd_results_raise_nothing(report: Report, html: str) -> None:
    report.open(html, size=(800, 600))
    report.run("frameCount && goTo(1)")
    assert report.run("document.querySelector('.verdict').textContent.length") > 20
