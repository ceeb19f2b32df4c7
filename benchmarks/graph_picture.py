"""A picture of the live factor graph of a rendered shot, drawn from `Stream.graph()` at its fifth keyframe.

    python -m benchmarks.graph_picture docs/images/graph.svg

Circles are variables, squares factors. Landmarks that begin in the same keyframe are one circle, and factors of one
kind between the same circles, or of the depth map of one keyframe, are one square; the numbers say how many there are.
With the seeds of the synthetic shots the picture is always the same.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam

import factorsfm
from factorsfm import DepthKind, DepthMap
from factorsfm.synthetic import render_shot, simulate_prior

KEYFRAMES = 5
MOTION, FRAMES, WIDTH, HEIGHT = "handheld", 40, 320, 180

COLUMN, LEFT, BOTTOM = 170, 130, 530
ROWS = {"a": 90, "depth": 170, "x": 250, "l": 450}
COLORS = {"a": "#f4c77b", "x": "#9cc4ea", "l": "#a9d8a0", "t": "#d9d9d9"}
PRIOR = "prior"

Place = tuple[float, float]
Bundle = tuple[str, tuple[str, ...]]


class Maps:
    """A prior from a list of inverse-depth maps, one a frame."""

    kind = DepthKind.INVERSE
    name = "simulated"

    def __init__(self, maps: list[Any]) -> None:
        self.maps = maps

    def __call__(self, frame: factorsfm.Frame) -> DepthMap:
        return DepthMap(self.maps[frame.index], self.kind)


def live_graph() -> gtsam.NonlinearFactorGraph:
    """The graph of the stream as soon as it has its keyframes."""
    shot = render_shot(MOTION, FRAMES, WIDTH, HEIGHT)
    stream = factorsfm.Stream(shot.camera, depth=Maps(simulate_prior(shot)))
    try:
        for image in shot.images:
            stream.push(image)
            graph, values = stream.graph()
            if sum(gtsam.Symbol(key).chr() == ord("x") for key in list(values.keys())) == KEYFRAMES:
                return graph
    finally:
        stream.close()
    raise SystemExit(f"the shot has fewer than {KEYFRAMES} keyframes")


@dataclass(slots=True)
class Bundles:
    """The variables of a graph, landmarks together, and how many factors of a kind are between the same of them.

    Attributes:
        variables: number of the variables behind each circle, by its name; factors: by kind and circles.
    """

    variables: Counter[str] = field(default_factory=Counter)
    factors: Counter[Bundle] = field(default_factory=Counter)

    @classmethod
    def of(cls, graph: gtsam.NonlinearFactorGraph) -> Bundles:
        """Count the factors and the variables of a graph."""
        factors = [graph.at(k) for k in range(graph.size()) if graph.exists(k)]
        begins: dict[int, int] = {}
        for factor in factors:
            keys = [gtsam.Symbol(key) for key in list(factor.keys())]
            frames = [key.index() for key in keys if key.chr() == ord("x")]
            for key in keys:
                if key.chr() == ord("l") and frames:
                    begins[key.key()] = min(frames[0], begins.get(key.key(), frames[0]))
        bundles, seen = cls(), set()
        for factor in factors:
            keys = list(factor.keys())
            names = tuple(_circle(key, begins) for key in keys)
            bundles.factors[_kind(factor), names] += 1
            for key, name in zip(keys, names, strict=True):
                bundles.variables[name] += key not in seen
                seen.add(key)
        return bundles


def _circle(key: int, begins: dict[int, int]) -> str:
    symbol = gtsam.Symbol(key)
    kind = chr(symbol.chr())
    return f"l{begins[key]}" if kind == "l" else f"{kind}{symbol.index()}"


def _kind(factor: gtsam.NonlinearFactor) -> str:
    name = type(factor).__name__
    return PRIOR if name.startswith("Prior") else {"GenericProjectionFactorCal3_S2": "projection"}.get(name, "depth")


def picture(bundles: Bundles) -> str:
    """The SVG."""
    frames = sorted(int(name[1:]) for name in bundles.variables if name[0] == "x")
    groups = sorted((name for name in bundles.variables if name[0] == "l"), key=lambda name: int(name[1:]))
    right = LEFT + COLUMN * (len(frames) - 1)
    places = {f"{row}{i}": (LEFT + COLUMN * k, ROWS[row]) for k, i in enumerate(frames) for row in "ax"}
    step = (right - LEFT) / max(len(groups), 1)
    places |= {name: (LEFT + step * (k + 0.5), ROWS["l"]) for k, name in enumerate(groups)}
    places["t0"] = (right + 120, ROWS["depth"])
    lines, squares = [], []
    for (kind, names), count in sorted(bundles.factors.items()):
        for start, end, dashed in _edges(kind, names, places):
            lines.append(_line(start, end, dashed=dashed))
        if kind != "depth":
            squares.append(_square(*_factor_place(kind, names, places), count, places[names[0]]))
    for k, i in enumerate(frames):
        depths = sum(n for (kind, names), n in bundles.factors.items() if kind == "depth" and f"x{i}" in names)
        if depths:
            squares.append(_square(*_depth_place(LEFT + COLUMN * k), depths, (0, 0)))
    lines = list(dict.fromkeys(lines))
    circles = [_variable(name, places[name], count) for name, count in sorted(bundles.variables.items())]
    size = f'width="{right + 190}" height="{BOTTOM}" viewBox="0 0 {right + 190} {BOTTOM}"'
    style = 'font-family="sans-serif" font-size="13" text-anchor="middle"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}><rect width="100%" height="100%" fill="#fff"/>'
    return "\n".join([head, *lines, *circles, *squares, *_legend(), "</svg>", ""])


def _edges(kind: str, names: tuple[str, ...], places: dict[str, Place]) -> list[tuple[Place, Place, bool]]:
    """Lines of a bundle of factors, those to what many factors share dashed."""
    if kind == "projection":
        return [(places[names[0]], places[names[1]], False)]
    if kind == PRIOR:
        return [(places[names[0]], _factor_place(kind, names, places), False)]
    square = _depth_place(places[names[0]][0])
    return [(square, places[name], name[0] == "l") for name in names]


def _depth_place(x: float) -> Place:
    return x + 38, ROWS["depth"]


def _factor_place(kind: str, names: tuple[str, ...], places: dict[str, Place]) -> Place:
    x, y = places[names[0]]
    if kind == PRIOR:
        return {"a": (x, y - 48), "x": (x - 48, y - 22), "l": (x, y + 45), "t": (x, y - 48)}[names[0][0]]
    to_x, to_y = places[names[1]]
    share = 0.22 + 0.11 * [name for name in places if name[0] == "l"].index(names[1])
    return x + share * (to_x - x), y + share * (to_y - y)


def _line(start: Place, end: Place, *, dashed: bool) -> str:
    look = 'stroke="#b5b5b5" stroke-dasharray="4 4"' if dashed else 'stroke="#555"'
    return f'<line x1="{start[0]:.0f}" y1="{start[1]:.0f}" x2="{end[0]:.0f}" y2="{end[1]:.0f}" {look}/>'


def _square(x: float, y: float, count: int, variable: Place) -> str:
    """A factor; the number stands on the side away from its variable."""
    left = variable[0] > x
    anchor, halo = "end" if left else "start", 'stroke="#fff" stroke-width="4" paint-order="stroke"'
    number = f'<text x="{x + (-9 if left else 9):.0f}" y="{y + 5:.0f}" text-anchor="{anchor}" {halo}>'
    box = f'<rect x="{x - 5:.0f}" y="{y - 5:.0f}" width="10" height="10"/>'
    return box + (f"{number}{count}</text>" if count > 1 else "")


def _variable(name: str, place: Place, count: int) -> str:
    kind, (x, y) = name[0], place
    radius, label = (34, f"{count} L") if kind == "l" else (22, f"{kind.upper()}({name[1:]})")
    circle = f'<circle cx="{x:.0f}" cy="{y:.0f}" r="{radius}" fill="{COLORS[kind]}" stroke="#333"/>'
    below = f'<text x="{x:.0f}" y="{y + 72:.0f}">begin in X({name[1:]})</text>' if kind == "l" else ""
    return f'{circle}<text x="{x:.0f}" y="{y + 5:.0f}">{label}</text>{below}'


def _legend() -> list[str]:
    texts = {"a": "depth maps", "depth": "depth", "x": "keyframes", "l": "landmarks"}
    lines = [f'<text x="12" y="{ROWS[row] + 5}" text-anchor="start" fill="#555">{t}</text>' for row, t in texts.items()]
    middle = 0.5 * (ROWS["x"] + ROWS["l"]) - 25
    return [*lines, f'<text x="12" y="{middle:.0f}" text-anchor="start" fill="#555">projections</text>']


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("output", type=Path)
    output = parser.parse_args().output
    bundles = Bundles.of(live_graph())
    output.write_text(picture(bundles))
    kinds: Counter[str] = Counter()
    for (kind, _), count in bundles.factors.items():
        kinds[kind] += count
    print(f"{output}: {sum(bundles.variables.values())} variables, {dict(kinds)} factors")


if __name__ == "__main__":
    main()
