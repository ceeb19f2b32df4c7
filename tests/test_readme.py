"""Every example of the README and of the pages in docs/ runs, and what they say of options, formats and files is so."""

import hashlib
import json
import os
import re
import shlex
import shutil
import sys
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from onnx import helper

from factorsfm import PRESETS, DepthKind, FrameStatus, ShotKind, open_imu, read_camera, read_control, reconstruct
from factorsfm.cli import main as cli
from factorsfm.export import FORMATS
from factorsfm.frames.writing import write_exr
from factorsfm.priors import models
from factorsfm.synthetic import RenderedShot, render_moving, render_shot, write_moving, write_shot
from tests.instruments import CHECKS, WALK_FRAMES, write_measurements, write_walk
from tests.networks import save_network
from tests.pages import ALL_PAGES, CONTRIBUTING, DOCS, PAGES, README, ROOT, rows, table, text_of

# The pages whose tables describe the options of each command.
DESCRIBED = {
    "reconstruct": ["command-line.md"],
    "demo": ["command-line.md"],
    "stream": ["command-line.md", "streaming.md"],
    "batch": ["command-line.md", "films.md"],
    "extend": ["image-sets.md"],
    "view": ["align.md"],
    "solve": ["mending.md"],
    "align": ["align.md"],
    "export": ["export.md"],
    "overlay": ["export.md"],
}
WALK = DOCS / "walkthrough.md"  # its blocks belong together and have a test of their own
LARGEST_README = 12 * 1024
FRAMES = 10
FILES = {"trajectory.tum", "colmap", "points.ply", "summary.json", "tracks.npz", "report.html"}
OPTION = r"(?<![\w-])--[a-z][a-z-]+"


@dataclass(frozen=True)
class Block:
    """A fenced block of a page: its language, its text and the line on which that starts."""

    page: Path
    language: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    text = text_of(page)
    return [
        Block(page, match[1], match[2], text.count("\n", 0, match.start(2)) + 1)
        for match in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    ]


def each(language: str) -> pytest.MarkDecorator:
    found = [block for page in PAGES if page != WALK for block in blocks(page) if block.language == language]
    assert found
    return pytest.mark.parametrize("block", [pytest.param(b, id=f"{b.page.name} line {b.line}") for b in found])


# --- examples ---------------------------------------------------------------------------------------------------


@cache
def shot_of_the_examples() -> RenderedShot:
    return render_shot(frames=FRAMES, width=256, height=144)


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all files that the examples name; its networks take what is bright for near."""
    folder = tmp_path_factory.mktemp("readme")
    shot = shot_of_the_examples()
    write_shot(shot, folder)
    write_moving(render_moving("truck", FRAMES, 256, 144, size=0.8), folder / "crossing")
    for name in ("images", "masks", "networks", "stills", "plates", "originals"):
        (folder / name).mkdir()
    mask = np.zeros((90, 160), np.uint8)
    mask[60:, :30] = 255
    for index, image in enumerate(shot.images):
        cv2.imwrite(str(folder / "images" / f"{index}.png"), image)
        cv2.imwrite(str(folder / "masks" / f"{index:06d}.png"), mask)
        write_exr(folder / "plates" / f"plate.{1001 + index}.exr", np.float16((image[..., ::-1] / 255) ** 2.2))
        cv2.imwrite(str(folder / "originals" / f"plate.{1001 + index}.png"), cv2.resize(image, (512, 288)))
    for index, image in enumerate(render_shot("arc", frames=3, width=256, height=144, parallax=0.1).images[1:]):
        cv2.imwrite(str(folder / "stills" / f"still_{index}.png"), image)
    (control,) = (block.text for block in blocks(DOCS / "control.md") if block.language == "json")
    (folder / "control.json").write_text(control)
    brightness = helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1], keepdims=1)
    nodes = [brightness, helper.make_node("Softplus", ["mean"], ["out"])]
    network = save_network(folder / "network.onnx", [1, 3, 48, 80], nodes)
    shutil.copy(network, folder / "networks" / models.MODELS["tcmonodepth"].file)
    shutil.copy(folder / "shot.mp4", folder / "film.mp4")
    (folder / "frames.bgr").write_bytes(np.stack(shot.images).tobytes())
    camera, depth = read_camera(folder / "camera.json"), folder / "depth"
    reconstruct(folder / "shot.mp4", camera=camera, depth=depth, depth_kind="inverse").write(folder / "result")
    write_measurements(shot, folder)
    write_walk(folder)
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
        output = place / words[words.index("--output" if "--output" in words else words[1]) + 1]
        if words[1] in ("reconstruct", "stream"):
            summary = json.loads((output / "summary.json").read_text())
            own = {"objects.json"} if "--objects" in words else set()
            missing = {"tracks.npz"} if summary["options"].get("unordered") else set()
            assert {path.name for path in output.iterdir()} == FILES - missing | own
            assert summary["registered"] == summary["frames"] == (WALK_FRAMES if "--imu" in words else FRAMES)
            assert ("--imu" in words) == (summary["imu"] is not None)
            assert bool({"--control", "--imu"} & set(words)) == (summary["control"] is not None)
            assert not any(item["contradicts"] for item in (summary["control"] or {"residuals": []})["residuals"])
        elif words[1] == "extend":
            assert {path.name for path in output.iterdir()} == FILES - {"tracks.npz"}
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
    code = compile("\n" * (block.line - 1) + block.text, str(block.page), "exec")
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(code, names)
    if "reconstruction" in names:
        assert len(names["reconstruction"].registered) == (WALK_FRAMES if "walk.mp4" in block.text else FRAMES)
    for file, check in CHECKS.items():
        if file in block.text:
            check(names, shot_of_the_examples())
    if "print(" in block.text:
        assert capsys.readouterr().out.strip()


@each("json")
def test_file(block: Block, tmp_path: Path, place: Path) -> None:
    (tmp_path / "file.json").write_text(block.text)
    if '"imu.csv"' in block.text:
        (tmp_path / "imu.csv").write_text((place / "imu.csv").read_text())
        assert open_imu(tmp_path / "file.json").noise.accelerometer == 0.002
        return
    if "poses" in block.text:
        assert read_control(tmp_path / "file.json").frames == ["0", "9", 0, 9]
        return
    camera = read_camera(tmp_path / "file.json")
    assert (camera.width, camera.height) == (320, 180)
    np.testing.assert_allclose(
        [camera.mean_focal_length(), camera.principal_point_x, camera.principal_point_y], [314, 160, 90]
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_block_escapes(page: Path) -> None:
    run_by_ci = {"sh"} if page == README else set()
    assert {block.language for block in blocks(page)} <= {"console", "python", "json"} | run_by_ci
    assert text_of(page).count("```") == 2 * len(blocks(page))


# --- commands and options ---------------------------------------------------------------------------------------


def test_set_up_commands_are_those_of_ci() -> None:
    script = (ROOT / ".ci" / "run").read_text()
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    set_up, run = (block.text.splitlines() for block in blocks(README) if block.language == "sh")
    assert set_up == ["python3 -m venv .venv && . .venv/bin/activate", "pip install '.[test]'"]
    assert run[0] == "factorsfm demo"
    assert re.search(r"^pip install .*'\.\[test\]'$", script, re.MULTILINE)
    assert re.search(r"^factorsfm demo ", script, re.MULTILINE)
    assert run[1] in script.splitlines()
    assert f"\n{run[1]} " in text_of(CONTRIBUTING)


def help_of(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    return capsys.readouterr().out


def options_of(command: str, capsys: pytest.CaptureFixture[str]) -> set[str]:
    return set(re.findall(OPTION, help_of(command, capsys))) - {"--help", "--verbose"}


def described(pages: list[str]) -> dict[str, str]:
    """The options in the first cells of the tables of some pages, with these cells."""
    cells = [row[0] for page in pages for row in rows(text_of(DOCS / page))]
    return {option: cell for cell in cells for option in re.findall(OPTION, cell)}


@pytest.mark.parametrize("command", DESCRIBED)
def test_every_option_has_a_row_with_its_values(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    rows_of = described(DESCRIBED[command])
    assert options_of(command, capsys) <= rows_of.keys()
    for option, values in re.findall(rf"({OPTION}) \{{([^}}]+)\}}", help_of(command, capsys)):
        if option != "--preset":  # has a table of its own
            assert set(values.split(",")) <= set(re.split(r"[`| ]", rows_of[option])), option


@pytest.mark.parametrize("page", sorted({page for pages in DESCRIBED.values() for page in pages}))
def test_a_page_describes_no_option_that_its_commands_do_not_have(
    page: str, capsys: pytest.CaptureFixture[str]
) -> None:
    own = set().union(*(options_of(command, capsys) for command, pages in DESCRIBED.items() if page == pages[-1]))
    assert described([page]).keys() <= own


def test_no_page_names_an_option_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    known = {"--help", "--version"}.union(*(options_of(command, capsys) for command in DESCRIBED))
    assert len(known) > 30
    for page in PAGES:
        assert set(re.findall(OPTION, text_of(page))) <= known, page.name


def test_every_command_value_and_status_is_described() -> None:
    page = text_of(DOCS / "command-line.md")
    assert [row["command"].strip("`") for row in table(page, "command")] == [
        "reconstruct", "stream", "batch", "extend", "solve", "view", "align", "export", "overlay", "demo",
    ]  # fmt: skip
    assert set(DESCRIBED) == {row["command"].strip("`") for row in table(page, "command")}
    for column, values in (("kind", ShotKind), ("status", FrameStatus), ("preset", PRESETS)):
        assert {row[column].strip("`") for row in table(page, column)} == set(values)
    assert {int(row["exit status"]) for row in table(page, "exit status")} == {
        0, cli.BAD_INPUT, cli.NOT_RECONSTRUCTED, cli.INTERRUPTED,
    }  # fmt: skip
    priors = text_of(DOCS / "priors.md")
    assert {row["kind"].strip("`") for row in table(priors, "kind")} == set(DepthKind)
    assert all(f"`{name}`" in priors for name in models.MODELS)


def test_the_formats_are_those_of_the_export() -> None:
    listed = table(text_of(DOCS / "export.md"), "format")
    assert [row["format"].strip("`") for row in listed] == list(FORMATS)
    for row, (name, chosen) in zip(listed, FORMATS.items(), strict=True):
        kind = "a folder:" if chosen.is_folder else "a file:"
        assert row["writes"].startswith(kind)
        assert row["up axis"] in (chosen.defaults.up_axis.value, "–")
        assert row["scale"] in (f"{chosen.defaults.scale:g}", "–")
        assert row["first frame"] in (str(chosen.defaults.first_frame), "–")
        assert ("`vfx`" in row["writes"]) == (name == "usd")
        assert ("`alembic`" in row["writes"]) == (name == "alembic")


# --- the README -------------------------------------------------------------------------------------------------


def test_the_readme_is_read_in_one_sitting() -> None:
    assert README.stat().st_size <= LARGEST_README


@pytest.mark.parametrize("page", [README, DOCS / "command-line.md"], ids=lambda page: page.name)
def test_the_files_of_a_result_are_listed(page: Path) -> None:
    listed = {row["file"].split(",")[0].strip("`/") for row in table(text_of(page), "file")}
    assert listed - {"part-002", "objects.json", "moving.json"} == FILES


def test_the_figures_are_those_of_the_benchmarks() -> None:
    results = text_of(ROOT / "benchmarks" / "results" / "RESULTS.md").split("\n### All shots\n")[1]
    measured = {(row["method"], row["prior"]): row for row in table(results, "method")}
    said = table(text_of(README), "method")
    assert len(said) > 3
    for row in said:
        source = measured[row["method"], row["prior"]]
        assert row == {name: source[name].strip("*") for name in row}


# --- links and names --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)]+)\)", text_of(page))
    for target in targets:
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        other = (page.parent / name).resolve() if name else page
        assert other.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", text_of(other), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}, target


def test_every_page_is_linked_from_the_readme() -> None:
    linked = set(re.findall(r"\]\(docs/([\w-]+\.md)", text_of(README)))
    assert linked == {page.name for page in DOCS.glob("*.md")}
