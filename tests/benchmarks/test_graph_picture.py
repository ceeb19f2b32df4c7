"""The picture of a graph holds all that the graph holds, and says how many."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, T, X

from benchmarks.graph_picture import PRIOR, Bundles, picture
from factorsfm.graph.factors import (
    affine_prior,
    depth_noise,
    landmark_prior,
    native_depth_factor,
    pixel_noise,
    pose_prior,
    projection_factor,
)

SEEN = {4: [1, 2, 3], 11: [1, 2, 3, 7]}  # landmarks by keyframe
DRAWN = Path(__file__).parents[2] / "docs" / "images" / "graph.svg"


def small_graph() -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for key in (X(4), X(11), T(0)):
        graph.add(pose_prior(key, gtsam.Pose3(), 1.0))
    graph.add(affine_prior(A(11), 1.0, 0.0, 1.0, 1.0))
    for j in (1, 2, 3, 7):
        graph.add(landmark_prior(L(j), np.ones(3), 1.0))
        graph.add(native_depth_factor(X(11), T(0), L(j), A(11), 1.0, depth_noise(0.1)))
    for i, landmarks in SEEN.items():
        for j in landmarks:
            graph.add(projection_factor(np.zeros(2), pixel_noise(1.0), X(i), L(j), gtsam.Cal3_S2()))
    return graph


def test_variables_and_factors_are_counted() -> None:
    bundles = Bundles.of(small_graph())
    assert bundles.variables == {"x4": 1, "x11": 1, "a11": 1, "t0": 1, "l4": 3, "l11": 1}
    assert bundles.factors == {
        ("projection", ("x4", "l4")): 3,
        ("projection", ("x11", "l4")): 3,
        ("projection", ("x11", "l11")): 1,
        ("depth", ("x11", "t0", "l4", "a11")): 3,
        ("depth", ("x11", "t0", "l11", "a11")): 1,
        (PRIOR, ("x4",)): 1,
        (PRIOR, ("x11",)): 1,
        (PRIOR, ("t0",)): 1,
        (PRIOR, ("a11",)): 1,
        (PRIOR, ("l4",)): 3,
        (PRIOR, ("l11",)): 1,
    }


def test_the_picture_has_a_circle_for_every_bundle_and_the_numbers_of_the_factors() -> None:
    drawing = ET.fromstring(picture(Bundles.of(small_graph())))
    texts = [element.text for element in drawing.iter("{http://www.w3.org/2000/svg}text")]
    assert len(list(drawing.iter("{http://www.w3.org/2000/svg}circle"))) == 6
    assert len(list(drawing.iter("{http://www.w3.org/2000/svg}rect"))) == 1 + 3 + 1 + 6
    assert sorted(text for text in texts if text.isdigit()) == ["3", "3", "3", "4"]
    assert {"X(4)", "X(11)", "A(11)", "T(0)", "3 L", "1 L"} <= set(texts)


def test_the_drawn_picture_is_that_of_five_keyframes_and_the_page_names_its_numbers() -> None:
    texts = re.findall(r">([^<]+)</text>", DRAWN.read_text())
    assert sum(text.startswith("X(") for text in texts) == sum(text.startswith("A(") for text in texts) == 5
    landmarks = sum(int(text.split()[0]) for text in texts if text.endswith(" L"))
    numbers = sum(int(text) for text in texts if text.isdigit())
    single = 5 + 5 + 1  # priors on poses, affines and the constant
    page = (DRAWN.parents[1] / "how-it-works.md").read_text()
    assert f"{landmarks + 11:,} variables and {numbers + single:,} factors" in re.sub(r"\s+", " ", page)
