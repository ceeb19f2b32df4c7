"""The walk-through of docs/walkthrough.md, done as it is written, its pictures, and that of the list of tracks.

    python -m benchmarks.walkthrough [--work FOLDER]

Chromium makes the picks, Blender renders the cube.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from factorsfm.cli.main import main as factorsfm
from tests.pages import DOCS, text_of
from tests.report.chromium import Chromium

BLENDER = shutil.which("blender")
FIRST = 1  # frame of a movie in Blender
PICKS = ("origin", "axis", "from", "to")
_IN_BLENDER = Path(__file__).with_name("walkthrough_blender.py")
_QUALITY = 85  # of JPEG


@dataclass(frozen=True, slots=True)
class Walk:
    """What the page says.

    Attributes:
        footage, cube: Python; the second for Blender.
        solve, view, align, export: the arguments of factorsfm.
    """

    footage: str
    solve: list[str]
    view: list[str]
    align: list[str]
    export: list[str]
    cube: str

    @property
    def pixels(self) -> list[list[float]]:
        """Those of `PICKS`, x and y, all of them in the first frame."""
        return [[float(value) for value in word[2:].split(",")] for word in self.align if word.startswith("0:")]


def read_walk() -> Walk:
    """The blocks of the page, in their order."""
    blocks = re.findall(
        r"^```\w+\n(?:\$ factorsfm )?(.*?)^```$", text_of(DOCS / "walkthrough.md"), re.MULTILINE | re.DOTALL
    )
    footage, *commands, cube = blocks
    return Walk(footage, *map(shlex.split, commands), cube)  # type: ignore[arg-type]


def run(arguments: Sequence[str]) -> None:
    """A command of factorsfm, in the working directory."""
    if (status := factorsfm(list(arguments))) != 0:
        raise SystemExit(status)


def pick_in_page(browser: Chromium, report: Path, walk: Walk) -> list[str]:
    """Make the picks of the page in the report, and return the command that this writes, word by word."""
    browser.open(report, (1280, 1000))
    size = browser.run("data.sizes[0]")
    browser.run("byId('show_residuals').click()")  # the picture is better seen without
    browser.run("document.querySelector('input[name=scale][value=distance]').click()")
    for name, pixel in zip(PICKS, walk.pixels, strict=True):
        browser.run(f"aligning.waiting === '{name}' || document.querySelector('[data-pick={name}] button').click()")
        u, v = (np.array(pixel) + 0.5) / size
        browser.click(*browser.run(
            "(() => { const box = byId('footage').getBoundingClientRect();"
            f" return [box.x + {u} * box.width, box.y + {v} * box.height]; }})()"
        ))  # fmt: skip
    metres, sigma = walk.align[-1].split(",")
    for field, text in (("metres", metres), ("sigma", sigma)):
        browser.run(f"byId('{field}').value = '{text}'; byId('{field}').dispatchEvent(new Event('input'))")
    return shlex.split(browser.run("byId('command').textContent"))[1:]


def choose_tracks(browser: Chromium) -> None:
    """Look at the track with the largest error in the open page, and choose it and the next one."""
    browser.run("document.querySelector('#tracks_rows button').click()")
    browser.run("[...document.querySelectorAll('#tracks_rows input')].slice(0, 2).forEach(box => box.click())")


def run_blender(scene: Path, cube: str, folder: Path, rendered: Sequence[int] = ()) -> dict[int, NDArray[np.float64]]:
    """Add the cube to an exported scene in Blender.

    Args:
        folder: for what Blender writes.
        rendered: frames that are rendered into it as FRAME.png, transparent but for the cube and its shadow.

    Returns:
        By frame the pixels (4, 2) of the corners of the cube's foot, as Blender's camera sees them.
    """
    (folder / "cube.py").write_text(cube)
    command = [str(BLENDER), "--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    given = [str(scene), str(folder / "cube.py"), str(folder), *map(str, rendered)]
    done = subprocess.run([*command, str(_IN_BLENDER), "--", *given], capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(done.stdout + done.stderr)
    feet = json.loads((folder / "feet.json").read_text())
    return {int(frame): np.array(corners) for frame, corners in feet.items()}


def picture_of_cube(images: Sequence[NDArray[np.uint8]], layers: Sequence[Path]) -> NDArray[np.uint8]:
    """Frames side by side, each with what Blender has rendered over it."""
    shown = []
    for image, layer in zip(images, layers, strict=True):
        rgba = np.asarray(cv2.imread(str(layer), cv2.IMREAD_UNCHANGED), np.float64)
        share = rgba[..., 3:] / 255
        shown.append(np.round(share * rgba[..., :3] + (1 - share) * image).astype(np.uint8))
    return np.hstack(shown)


def screenshot(browser: Chromium, first: str, last: str) -> bytes:
    """JPEG of the open page from one element, a CSS selector, to another."""
    top, bottom, width = browser.run(
        f"[document.querySelector('{first}').getBoundingClientRect().top + scrollY - 8,"
        f" document.querySelector('{last}').getBoundingClientRect().bottom + scrollY + 12,"
        " document.documentElement.clientWidth]"
    )
    return browser.screenshot((0, top, width, bottom - top))


def make_pictures(images: Path) -> None:
    """Follow the page in the working directory, and write its pictures into a folder."""
    walk = read_walk()
    exec(walk.footage, {})
    run(walk.solve)
    run([*walk.view, "--no-browser"])
    browser = Chromium(Path("profile").absolute())
    words = pick_in_page(browser, Path("walk/view.html").absolute(), walk)
    (images / "walk-view.jpg").write_bytes(screenshot(browser, "#footage_section", "#align_section"))
    choose_tracks(browser)
    (images / "report-tracks.jpg").write_bytes(screenshot(browser, "#tracks_section", "#tracks_section"))
    browser.close()
    print("the page writes: factorsfm", shlex.join(words))
    run(walk.align)
    run(walk.export)
    video = cv2.VideoCapture("room/shot.mp4")
    frames = [image for _, image in iter(video.read, (False, None))]
    chosen = [0, len(frames) - 1]
    numbers = [FIRST + k for k in chosen]
    run_blender(Path("room.py"), walk.cube, Path.cwd(), numbers)
    picture = picture_of_cube([frames[k] for k in chosen], [Path(f"{number}.png") for number in numbers])
    cv2.imwrite(str(images / "walk-cube.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, metavar="FOLDER", help="kept for a look; default: a temporary one")
    work = parser.parse_args().work
    with tempfile.TemporaryDirectory() as temporary:
        folder = work or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        os.chdir(folder)
        make_pictures(DOCS / "images")


if __name__ == "__main__":
    main()
