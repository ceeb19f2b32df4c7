"""The report is one valid, self-contained document that carries the data; the picture shows them."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import cv2
import numpy as np
import pytest

from factorsfm.polish.observability import CameraObservability
from factorsfm.report import Thumbnails, draw_picture, failure_html, report_html
from factorsfm.report.wording import explanation, verdict_sentence
from factorsfm.result.moving import Moving, MovingStretch
from factorsfm.result.reconstruction import Reconstruction
from factorsfm.result.summary import verdict
from factorsfm.support.status import ShotKind
from tests.exact_result import build

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
    assert {"scene", "footage", "slider", "charts", "data"} <= set(checker.ids)
    assert not {"src", "href", "action"} & {key for key, _ in checker.attributes}
    assert set(re.findall(r"\w+://[^\"'\s]+", html)) == {"http://www.w3.org/2000/svg"}
    assert "@import" not in html
    assert "url(" not in html


def test_every_element_that_the_script_looks_up_exists() -> None:
    html = report_html(build())
    ids = set(Checker(html).ids)
    assert set(re.findall(r'(?:getElementById|byId)\("(\w+)"\)', html)) <= ids
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
    assert data["registered"] == [True, True, True, False, True, True]
    assert data["positions"] == [0, 1, 2, 4, 5]
    charts = {chart["title"]: chart for chart in data["charts"]}
    assert charts["Reprojection error, median (px)"]["values"] == [0.1, 0.2, 0.3, None, 0.5, 0.6]
    assert charts["Residual of the depth prior, median (%)"]["values"] == [5, None, 15, None, 25, None]
    assert charts["Inliers; pale: tracked points"]["values"] == [40, 40, 40, None, 40, 40]
    assert charts["Scale of the depth prior, ±1σ"]["values"] == [2, None, 4, None, 6, None]
    assert charts["Scale of the depth prior, ±1σ"]["std"][0] == 0.2


def test_charts_appear_with_their_numbers() -> None:
    reconstruction = build()

    def titles() -> str:
        return " ".join(chart["title"] for chart in embedded(report_html(reconstruction))["charts"])

    assert not re.search("slide|angle|deviation", titles())
    for k, frame in enumerate(reconstruction.registered):
        frame.observability = CameraObservability(0.25, 0.5, 1.5, 0.1 * k)
        frame.covariance = np.diag([1e-6, 1e-6, 2e-6, 4e-4, 4e-4, 8e-4])
    assert re.search("slide.*depth prior.*angle.*position.*rotation", titles())
    charts = {chart["title"]: chart["values"] for chart in embedded(report_html(reconstruction))["charts"]}
    assert charts["Pixel slide of a locked object, 1σ (px)"] == [0, 0.1, 0.2, None, 0.3, 0.4]
    assert charts["Standard deviation of the position (units)"][0] == 0.04
    assert charts["Standard deviation of the rotation (°)"][0] == pytest.approx(np.degrees(0.002), rel=1e-4)
    for frame in reconstruction.registered:  # of a camera at rest
        frame.observability = CameraObservability(np.nan, np.nan, 0.0, 0.0)
    assert not re.search("slide|share|angle", titles())


def test_tracks_carry_places_residuals_and_the_prior() -> None:
    reconstruction = build()
    shift = np.array([0.5, -1.25])
    reconstruction.observation_xy = reconstruction.observation_xy - shift  # so that the solve lies further right, up
    tracks = embedded(report_html(reconstruction))["tracks"]
    assert tracks["start"] == [0, 40, 80, 120, 120, 160, 200]  # nothing in the frame that is not registered
    np.testing.assert_array_equal(array(tracks["point"], "<u2"), np.tile(np.arange(40), 5))
    kept = reconstruction.observation_frame != 3
    pixels = array(tracks["place"], "<u2").reshape(-1, 2) / 65535 * [640, 480] - 0.5
    np.testing.assert_allclose(pixels, reconstruction.observation_xy[kept], atol=0.01)
    residual = array(tracks["residual"], "<i2").reshape(-1, 2) / tracks["residual_steps"]
    np.testing.assert_allclose(residual, np.tile(shift, (200, 1)), atol=0.003)
    prior = array(tracks["prior"], "<i2").reshape(5, 40)
    assert (prior[1] == -32768).all()
    np.testing.assert_allclose(prior[2] / tracks["prior_steps"], 0.15, atol=1e-4)


def test_what_moves_by_itself_has_tracks_of_its_own() -> None:
    xy = np.array([[10.0, 20.0], [11.0, 21.5], [630.0, 470.0]])
    moving = Moving((MovingStretch(12, 18, 0.2, 0.125),), np.array([12, 14, 18]), np.array([0, 0, 1]), xy)
    html = report_html(replace(build(), moving=moving))
    data = embedded(html)["moving"]
    assert data["start"] == [0, 0, 1, 2, 2, 3, 3]
    np.testing.assert_array_equal(array(data["track"], "<u4"), [0, 0, 1])
    np.testing.assert_allclose(array(data["place"], "<u2").reshape(-1, 2) / 65535 * [640, 480] - 0.5, xy, atol=0.01)
    assert data["stretches"] == [[12, 18]]
    assert "Moves by itself</dt><dd>up to 12 % of the image" in html
    assert embedded(report_html(build()))["moving"] is None


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
    assert "tracks contradict the scene" in checker.text["td"]
    assert checker.text["h1"] == "</script><img>.mp4"
    assert "mapper.window" in checker.text["th"]
    assert "3.50 s" in checker.text["td"]
    assert "The camera is solved in 5 of 6 frames" in checker.text["p"]
    assert checker.text["span"].startswith("Solved in part")
    assert "Every frame is solved" in report_html(build(unregistered=()))


def test_many_points_stay_small() -> None:
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


@pytest.mark.parametrize("frames", [100, 300])
def test_long_shots_stay_small(frames: int) -> None:
    reconstruction = build(frames=frames, points=1000, unregistered=())
    noise = np.random.default_rng(0).integers(80, 170, (108, 192, 3)).astype(np.uint8)
    thumbnails = Thumbnails()
    for _ in range(frames):
        thumbnails.add(cv2.resize(noise, (384, 216)))
    thumbnails.attach(reconstruction.frames)
    html = report_html(reconstruction)
    data = embedded(html)
    assert 75_000 <= data["tracks"]["start"][-1] <= 150_000
    assert sum(map(bool, data["thumbnail"])) == (100 if frames == 100 else 150)
    assert 1_000_000 < len(html) < 7_000_000


def test_thumbnails_are_small_pictures_in_bounded_memory() -> None:
    thumbnails = Thumbnails(most=10)
    for k in range(45):
        image = np.full((270, 480, 3), 5 * k, np.uint8)
        thumbnails.add(image if k % 2 else image[:, :, 0])
    kept = thumbnails.by_frame()
    assert [k for k, jpeg in enumerate(kept) if jpeg] == list(range(0, 45, 8))
    picture = cv2.imdecode(np.frombuffer(kept[16] or b"", np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (216, 384, 3)
    np.testing.assert_allclose(picture, 80, atol=3)
    small = Thumbnails()
    small.add(np.zeros((36, 64, 3), np.uint8))
    picture = cv2.imdecode(np.frombuffer(small.by_frame()[0] or b"", np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (36, 64, 3)


def test_a_failure_says_why() -> None:
    frames = build(unregistered=tuple(range(6))).frames
    html = failure_html("7 < 30 tracks.", frames, {"source": "shot.mp4"}, {"tracking": 2.0})
    checker = Checker(html)
    assert "The camera of this shot could not be solved." in checker.text["p"]
    assert "6 frames: tracks contradict the scene. 7 < 30 tracks." in checker.text["p"]
    assert checker.text["span"].startswith("Not solved")
    assert checker.text["td"].count("14 of 30 inliers needed") == 1
    assert "10 to 20" in checker.text["td"]  # the frames with one and the same reason share a row
    assert "2.00 s" in checker.text["td"]
    assert [chart["title"] for chart in embedded(html)["charts"]] == [
        "Inliers; pale: tracked points",
        "Scale of the depth prior, ±1σ",
        "Shift of the depth prior, ±1σ",
    ]
    assert "No frame was read" in failure_html("no frames", [], {}, {})


def test_verdict_for_compositors() -> None:
    reconstruction = build(unregistered=())
    assert verdict_sentence(reconstruction) == (
        "The camera is solved in all 6 frames, and half of the tracked points land within 0.35 pixels of where the "
        "footage shows them."
    )
    assert explanation(reconstruction) == [
        "The camera travels 1.2 % of the distance to the scene.",
        "The size of the scene is free: scale it by a length that you know.",
    ]
    for share, words in ((0.3, "Up to 30 % of what is known"), (0.01, "from parallax alone")):
        for frame in reconstruction.frames[1:]:
            frame.observability = CameraObservability(share, 0.9, 1.5, 0.12)
        text = " ".join(explanation(reconstruction))
        assert words in text
        assert "may slide by up to 0.12 pixels" in text
    for frame in reconstruction.frames:
        frame.observability = CameraObservability(0.01, 0.9, 1.5, 0.004)
    assert "may slide by less than 0.01 pixels" in " ".join(explanation(reconstruction))
    reconstruction.observation_error = reconstruction.observation_error + 2
    assert explanation(reconstruction)[0].startswith("Half of the tracks miss by more than 2.35 pixels")
    assert ">Doubtful</span>" in report_html(reconstruction)
    turning = replace(reconstruction, kind=ShotKind.ROTATION, metric=True)
    assert "only turns" in explanation(turning)[1]
    assert "parallax alone" not in " ".join(explanation(turning))
    assert explanation(turning)[-1].startswith("Lengths are in metres")


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
