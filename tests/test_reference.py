"""The reference is built from the docstrings, with the command that the page for contributors gives."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import factorsfm

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    command = re.search(r"^python -m (pdoc [^#]*)", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE)
    assert command
    folder = tmp_path_factory.mktemp("reference")
    words = command[1].split()
    words[words.index("-o") + 1] = str(folder)
    built = subprocess.run([sys.executable, "-W", "error", "-m", *words], capture_output=True, text=True, cwd=ROOT)
    assert (built.returncode, built.stderr) == (0, "")
    return (folder / "factorsfm.html").read_text()


def test_every_public_name_is_described(page: str) -> None:
    for name in factorsfm.__all__:
        assert f'id="{name}"' in page
        if name != "PRESETS":  # a plain dictionary
            assert (getattr(factorsfm, name).__doc__ or "").strip(), name


def test_every_public_method_is_described() -> None:
    for owner in (value for name in factorsfm.__all__ if isinstance(value := getattr(factorsfm, name), type)):
        for name, member in inspect.getmembers(owner, lambda m: inspect.isroutine(m) or isinstance(m, property)):
            if not name.startswith("_") and "factorsfm" in (getattr(member, "__module__", None) or "factorsfm"):
                assert inspect.getdoc(member), f"{owner.__name__}.{name}"


def test_arguments_and_errors_are_set_as_lists(page: str) -> None:
    reconstruct = page.split('id="reconstruct"')[1].split("<section")[0]
    for heading in ("Arguments", "Raises"):
        assert re.search(rf"<h6[^>]*>{heading}:</h6>\s*<ul>", reconstruct), heading
