"""Files that Blender saves after a script."""

import shutil
import subprocess
from pathlib import Path

import pytest

BLENDER = shutil.which("blender")

in_blender = pytest.mark.skipif(BLENDER is None, reason="Blender is not installed (Debian's package: blender)")


def saved(folder: Path, script: str) -> Path:
    """A file that Blender saves after a script."""
    path = folder / "shot.blend"
    (folder / "save.py").write_text(f"import bpy\n{script}\nbpy.ops.wm.save_as_mainfile(filepath={str(path)!r})\n")
    command = [str(BLENDER), "--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    done = subprocess.run([*command, str(folder / "save.py")], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return path
