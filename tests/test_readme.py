"""Every example of the README runs, and what it says of commands, options, formats and statuses is so."""

import hashlib
import json
import os
import re
import shlex
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from onnx import helper

from factorsfm import PRESETS, DepthKind, FrameStatus, ShotKind, read_camera, read_control, reconstruct
from factorsfm.cli import main as cli
from factorsfm.export import FORMATS
from factorsfm.priors import models
from factorsfm.synthetic import render_shot, write_shot
from tests.priors.test_models import save_network

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = ("reconstruct", "stream", "batch", "extend", "export", "overlay", "demo")
FRAMES = 10
FILES = {"trajectory.tum", "colmap", "points.ply", "summary.json", "report.html"}


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text and the line of the README on which that starts."""

    language: str
    text: str
    line: int


def blocks(language: str | None = None) -> list[Block]:
    found = [
        Block(match[1], match[2], TEXT.count("\n", 0, match.start(2)) + 1)
        for match in re.finditer(r"^```(\w*)\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL)
    ]
    return [block for block in found if language in (None, block.language)]


def each(language: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("block", [pytest.param(b, id=f"line {b.line}") for b in blocks(language)])


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all files that the examples name; its networks take what is bright for near."""
    folder = tmp_path_factory.mktemp("readme")
    shot = render_shot(frames=FRAMES, width=256, height=144)
    write_shot(shot, folder)
    for name in ("images", "masks", "networks", "stills"):
        (folder / name).mkdir()
    mask = np.zeros((90, 160), np.uint8)
    mask[60:, :30] = 255
    for index, image in enumerate(shot.images):
        cv2.imwrite(str(folder / "images" / f"{index}.png"), image)
        cv2.imwrite(str(folder / "masks" / f"{index:06d}.png"), mask)
    for index, image in enumerate(render_shot("arc", frames=3, width=256, height=144, parallax=0.1).images[1:]):
        cv2.imwrite(str(folder / "stills" / f"still_{index}.png"), image)
    (control,) = (block.text for block in blocks("json") if "poses" in block.text)
    (folder / "control.json").write_text(control)
    brightness = helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1], keepdims=1)
    nodes = [brightness, helper.make_node("Softplus", ["mean"], ["out"])]
    network = save_network(folder / "network.onnx", [1, 3, 48, 80], nodes)
    shutil.copy(network, folder / "networks" / models.MODELS["tcmonodepth"].file)
    shutil.copy(folder / "shot.mp4", folder / "film.mp4")
    (folder / "frames.bgr").write_bytes(np.stack(shot.images).tobytes())
    camera, depth = read_camera(folder / "camera.json"), folder / "depth"
    reconstruct(folder / "shot.mp4", camera=camera, depth=depth, depth_kind="inverse").write(folder / "result")
    return folder


@pytest.fixture
def place(material: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the material as working directory, in which `tcmonodepth` is the small network."""
    folder = shutil.copytree(material, tmp_path / "place")
    digest = hashlib.sha256((folder / "network.onnx").read_bytes()).hexdigest()
    monkeypatch.setitem(models.MODELS, "tcmonodepth", replace(models.MODELS["tcmonodepth"], sha256=digest))
    monkeypatch.setenv("FACTORSFM_MODELS", str(folder / "networks"))
    monkeypatch.chdir(folder)
    return folder


@each("console")
def test_command(block: Block, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands = [shlex.split(line.removeprefix("$ ")) for line in block.text.splitlines() if line.startswith("$ ")]
    assert commands
    for words in commands:
        while "=" in words[0]:
            monkeypatch.setenv(*words.pop(0).split("=", 1))
        if "<" in words:
            monkeypatch.setattr(sys, "stdin", (place / words.pop()).open())
            words.pop()
        assert words[0] == "factorsfm"
        assert cli.main(words[1:]) == 0
        output = place / words[words.index("--output") + 1]
        if words[1] in ("reconstruct", "stream"):
            assert {path.name for path in output.iterdir()} == FILES
            summary = json.loads((output / "summary.json").read_text())
            assert summary["registered"] == summary["frames"] == FRAMES
            assert ("--control" in words) == (summary["control"] is not None)
            assert not any(item["contradicts"] for item in (summary["control"] or {"residuals": []})["residuals"])
        elif words[1] == "extend":
            assert {path.name for path in output.iterdir()} == FILES
            summary = json.loads((output / "summary.json").read_text())
            assert summary["registered"] == summary["frames"] == FRAMES + 2
        elif words[1] == "batch":
            assert {path.name for path in (output / "film" / "shot_001").iterdir()} == FILES
            index = json.loads((output / "index.json").read_text())
            assert (index["reconstructed"], index["registered"], index["frames"]) == (1, FRAMES, FRAMES)
        elif output.is_dir():
            assert any(output.iterdir())
        else:
            assert output.stat().st_size > 0


@each("python")
def test_python(block: Block, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = compile("\n" * (block.line - 1) + block.text, str(ROOT / "README.md"), "exec")
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(code, names)
    if "reconstruction" in names:
        assert len(names["reconstruction"].registered) == FRAMES
    if "print(" in block.text:
        assert capsys.readouterr().out.strip()


@each("json")
def test_file(block: Block, tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(block.text)
    if "poses" in block.text:
        assert read_control(tmp_path / "camera.json").frames == ["0", "9", 0, 9]
        return
    camera = read_camera(tmp_path / "camera.json")
    assert (camera.width, camera.height) == (320, 180)
    np.testing.assert_allclose(
        [camera.mean_focal_length(), camera.principal_point_x, camera.principal_point_y], [314, 160, 90]
    )


def test_no_block_escapes() -> None:
    assert {block.language for block in blocks()} == {"sh", "console", "python", "json"}
    assert TEXT.count("```") == 2 * len(blocks())


def test_set_up_commands_are_those_of_ci() -> None:
    script = (ROOT / ".ci" / "run").read_text()
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    demo, tests = (block.text.strip().split(" && ") for block in blocks("sh"))
    assert demo[2:] == ["pip install .", "factorsfm demo"]
    assert demo[:2] == tests[:2] == ["python3 -m venv .venv", ". .venv/bin/activate"]
    assert tests[-1] in script.splitlines()
    assert tests[2].removeprefix("pip install ") == "'.[test]'"
    assert re.search(r"^pip install .*'\.\[test\]'$", script, re.MULTILINE)
    assert re.search(r"^factorsfm demo ", script, re.MULTILINE)


def options_of(command: str, capsys: pytest.CaptureFixture[str]) -> set[str]:
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    return set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", capsys.readouterr().out)) - {"--help", "--verbose"}


def test_every_option_and_value_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    options = set().union(*(options_of(command, capsys) for command in COMMANDS))
    assert len(options) > 20
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", TEXT)) == options
    for value in (*PRESETS, *DepthKind, *ShotKind, *FrameStatus, *models.MODELS, *COMMANDS):
        assert f"`{value}`" in TEXT
    for status in (0, cli.BAD_INPUT, cli.NOT_RECONSTRUCTED, cli.INTERRUPTED):
        assert f"\n| {status} | " in TEXT


@pytest.mark.parametrize(
    ("heading", "commands"),
    [("Streaming", ["reconstruct", "stream"]), ("Films", ["reconstruct", "batch"]), ("Export", ["export"])],
)
def test_a_section_names_the_options_of_its_command(
    heading: str, commands: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    section = TEXT.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    known = set().union(*(options_of(command, capsys) for command in commands))
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", section))
    assert named <= known
    assert options_of(commands[-1], capsys) - options_of(commands[0], capsys) <= named


def test_the_formats_are_those_of_the_export() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \| a (file|folder): (.+) \| (\S+) \| (\S+) \| (\S+) \|$", TEXT, re.MULTILINE)
    assert [name for name, *_ in rows] == list(FORMATS)
    for name, kind, said, up, scale, first in rows:
        chosen, defaults = FORMATS[name], FORMATS[name].defaults
        assert (kind == "folder") == chosen.is_folder
        assert up in (defaults.up_axis.value, "–")
        assert scale in (f"{defaults.scale:g}", "–")
        assert first in (str(defaults.first_frame), "–")
        assert ("`vfx`" in said) == (name in ("usd", "stmap"))
        assert ("`alembic`" in said) == (name == "alembic")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)]+)\)", text)
    assert targets or page.name != "README.md"
    for target in targets:
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        other = (page.parent / name).resolve() if name else page
        assert other.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", other.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"\W+", "-", heading.lower()).strip("-") for heading in headings}
