"""Every example of the README runs, and what it says of commands, options and statuses is so."""

import hashlib
import json
import os
import re
import shlex
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from onnx import helper
from test_export import build
from test_models import save_network

from factorsfm import PRESETS, DepthKind, FrameStatus, ShotKind, cli, read_camera
from factorsfm.priors import models
from factorsfm.synthetic import render_shot, write_shot

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
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
    for name in ("images", "masks", "networks"):
        (folder / name).mkdir()
    mask = np.zeros((90, 160), np.uint8)
    mask[60:, :30] = 255
    for index, image in enumerate(shot.images):
        cv2.imwrite(str(folder / "images" / f"{index}.png"), image)
        cv2.imwrite(str(folder / "masks" / f"{index:06d}.png"), mask)
    brightness = helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1], keepdims=1)
    nodes = [brightness, helper.make_node("Softplus", ["mean"], ["out"])]
    network = save_network(folder / "network.onnx", [1, 3, 48, 80], nodes)
    shutil.copy(network, folder / "networks" / models.MODELS["tcmonodepth"].file)
    build().write(folder / "result")
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
        assert words[0] == "factorsfm"
        assert cli.main(words[1:]) == 0
        assert {path.name for path in (place / "result").iterdir()} == FILES
        summary = json.loads((place / "result" / "summary.json").read_text())
        assert summary["registered"] == summary["frames"] == FRAMES


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
def test_camera_file(block: Block, tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(block.text)
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


def test_every_option_and_value_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["reconstruct", "--help"])
    options = set(re.findall(r"--[a-z-]+", capsys.readouterr().out)) - {"--help", "--verbose"}
    assert len(options) == 7
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", TEXT)) == options
    for value in (*PRESETS, *DepthKind, *ShotKind, *FrameStatus, *models.MODELS):
        assert f"`{value}`" in TEXT
    for status in (0, cli.BAD_INPUT, cli.NOT_RECONSTRUCTED, cli.INTERRUPTED):
        assert f"\n| {status} | " in TEXT


def test_links_lead_somewhere() -> None:
    targets = re.findall(r"\]\(([^)]+)\)", TEXT)
    assert targets
    headings = {re.sub(r"\W+", "-", h.lower()).strip("-") for h in re.findall(r"^#+ (.+)$", TEXT, re.MULTILINE)}
    for target in targets:
        assert target.removeprefix("#") in headings if target.startswith("#") else (ROOT / target).exists()
