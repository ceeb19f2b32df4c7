"""What CONTRIBUTING and the pages in docs/ say of rooms, files and functions is so."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

from tests.pages import ALL_PAGES, CONTRIBUTING, ROOT, table, text_of

FILE = r"`((?:factorsfm|benchmarks)/[\w/]+\.py)`"


def names_of(file: Path) -> set[str]:
    """Functions, classes and constants that a module defines."""
    names = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.add(node.target.id)
    return names


def test_the_rooms_are_those_of_the_import_linter() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers, *_ = settings["tool"]["importlinter"]["contracts"]
    assert [row["room"].strip("`") for row in table(text_of(CONTRIBUTING), "room")] == layers["layers"]


def test_every_answer_names_functions_that_are_there() -> None:
    answers = table(text_of(CONTRIBUTING), "to change")
    assert {row["to change"] for row in answers} >= {
        "when a keyframe is made",
        "the weight of the depth prior",
        "the Nuke export",
        "how a live camera is read",
        "the depth-consistency factor",
    }
    for row in answers:
        first, *parts = re.split(FILE, row["go to"])
        assert (first, len(parts) >= 2) == ("", True), row["to change"]
        for file, said in zip(parts[::2], parts[1::2], strict=True):
            named = set(re.findall(r"`(\w+)`", said))
            assert named, file
            assert named <= names_of(ROOT / file), file


@pytest.mark.parametrize("page", ALL_PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_that_a_page_names_are_there(page: Path) -> None:
    for path in re.findall(r"\b(?:factorsfm|benchmarks)/[\w/.-]*[\w/]", text_of(page)):
        assert (ROOT / path).exists(), path
