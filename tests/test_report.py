"""The report is one valid, self-contained document that carries the data; the picture shows them."""

import base64
import json
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from test_export import build

from factorsfm.reconstruction import Reconstruction, ShotKind
from factorsfm.report import draw_picture, report_html
from factorsfm.summary import verdict

VOID = {"meta", "link", "br", "input", "img", "hr"}


class Checker(HTMLParser):
    """Insists that every element is closed in order, and collects ids, texts and references."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.text: dict[str, str] = {}
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += attrs
        self.ids += [value for key, value in attrs if key == "id" and value]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open:
            self.text[self.open[-1]] = self.text.get(self.open[-1], "") + data


def embedded(html: str) -> dict[str, Any]:
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', html, re.DOTALL)
    assert match
    data: dict[str, Any] = json.loads(match[1])
    return data


def array(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


def test_document_is_valid_and_self_contained() -> None:
    html = report_html(build())
    checker = Checker(html)
    assert html.startswith("<!doctype html>")
    assert len(checker.ids) == len(set(checker.ids))
    assert {"orbit", "top", "side", "charts", "data"} <= set(checker.ids)
    assert not {"src", "href", "action"} & {key for key, _ in checker.attributes}
    assert set(re.findall(r"\w+://[^\"'\s]+", html)) == {"http://www.w3.org/2000/svg"}
    assert "@import" not in html
    assert "url(" not in html


def test_every_element_that_the_script_looks_up_exists() -> None:
    html = report_html(build())
    ids = set(Checker(html).ids)
    assert set(re.findall(r'getElementById\("(\w+)"\)', html)) <= ids
    variables = set(re.findall(r"(--\w+):", html))
    assert set(re.findall(r"var\((--\w+)\)", html)) | set(re.findall(r'css\("(--\w+)"\)', html)) == variables


def test_data_round_trip() -> None:
    reconstruction = build()
    data = embedded(report_html(reconstruction))
    # the first camera of the fixture is the world's origin
    points = array(data["points"], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points, reconstruction.points, atol=1e-6)
    np.testing.assert_array_equal(array(data["colors"], "u1").reshape(-1, 3), reconstruction.colors)
    centers = array(data["centers"], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(centers, reconstruction.camera_centers(), atol=1e-6)
    assert data["frame"] == [10, 12, 14, 16, 18, 20]
    assert data["registered"] == [1, 1, 1, 0, 1, 1]
    assert data["error"] == [0.1, 0.2, 0.3, None, 0.5, 0.6]
    assert data["residual"] == [5, None, 15, None, 25, None]
    assert data["scale"] == [2, None, 4, None, 6, None]
    assert data["scale_std"][0] == 0.2


def test_views_are_seen_from_the_first_registered_camera() -> None:
    reconstruction = build(unregistered=(0,))
    data = embedded(report_html(reconstruction))
    first = reconstruction.frames[1].cam_from_world
    points = array(data["points"], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(points, first * reconstruction.points, atol=1e-5)
    np.testing.assert_allclose(array(data["centers"], "<f4")[:3], 0, atol=1e-6)
    np.testing.assert_allclose(array(data["rotations"], "<f4")[:9].reshape(3, 3), np.eye(3), atol=1e-6)


def test_texts_are_escaped_and_shown() -> None:
    reconstruction = build()
    reconstruction.notes = ["scale <b>unknown</b> </script>"]
    reconstruction.frames[3].message = "7 < 30 & lost"
    reconstruction.options = {"source": "</script><img>.mp4", "mapper": {"window": 21}}
    html = report_html(reconstruction)
    checker = Checker(html)
    assert "scale <b>unknown</b> </script>" in checker.text["li"]
    assert "7 < 30 & lost" in checker.text["td"]
    assert "too few inliers" in checker.text["td"]
    assert checker.text["h1"] == "</script><img>.mp4"
    assert "mapper.window" in checker.text["th"]
    assert "3.50 s" in checker.text["td"]
    assert "5 of 6 frames registered" in checker.text["p"]
    assert "Every frame is registered" in report_html(build(unregistered=()))


def test_large_results_stay_small() -> None:
    rng = np.random.default_rng(0)
    reconstruction = build(frames=80)
    reconstruction.points = rng.normal(0, 1, (50_000, 3))
    reconstruction.points[7] = np.nan
    reconstruction.colors = np.zeros((50_000, 3), np.uint8)
    html = report_html(reconstruction)
    points = array(embedded(html)["points"], "<f4").reshape(-1, 3)
    assert 10_000 <= len(points) <= 20_000
    assert np.isfinite(points).all()
    assert len(html) < 1_000_000


def test_verdict_in_words() -> None:
    reconstruction = build(unregistered=())
    assert verdict(reconstruction) == (
        "all 6 frames registered, 40 points, median reprojection error 0.35 px, parallax 0.012"
    )
    reconstruction.kind = ShotKind.ROTATION
    assert verdict(reconstruction).endswith("; pure rotation, no parallax")


@pytest.mark.parametrize(
    "reconstruction", [build(), build(points=0), build(unregistered=tuple(range(6))), build(frames=1)]
)
def test_odd_results_can_be_shown(reconstruction: Reconstruction) -> None:
    Checker(report_html(reconstruction))
    assert draw_picture(reconstruction).shape == (720, 1280, 3)


def test_picture_shows_path_points_and_errors() -> None:
    picture = draw_picture(build())
    assert picture.dtype == np.uint8
    path = (picture == (15, 67, 209)).all(axis=2)
    for view in (path[64:484, 24:632], path[64:484, 648:1256]):
        assert 20 < view.sum() < 5000
    curve = (picture == (170, 105, 23)).all(axis=2)
    assert curve[500:696].sum() > 300
    assert not curve[:500].any()
    near_points = np.abs(picture.astype(int) - (60, 205, 250)).max(axis=2) < 40
    assert near_points[64:484].sum() > 5
