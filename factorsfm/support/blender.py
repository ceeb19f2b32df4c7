"""What a script finds in a file of Blender, which Blender itself opens."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from factorsfm.support.errors import InputError

_SECONDS = 300  # that Blender may take for a file

# Around a script that puts what it finds into `found`.
_FRAME = """
import json, sys, bpy

if not bpy.data.filepath:
    sys.exit("Blender has opened no file")
{script}
with open(sys.argv[-1], "w", encoding="utf-8") as stream:
    json.dump(found, stream)
"""


def found_in_blender(path: Path, script: str) -> Any:
    """What a script puts into `found`, as JSON holds it; scripts in the file do not run.

    Raises:
        InputError: there is no file, Blender is not there, or cannot open it.
    """
    if not path.is_file():
        raise InputError("there is no such file")
    blender = shutil.which("blender")
    if blender is None:
        raise InputError(f"{path.name} is opened by Blender; the program blender is expected in the PATH")
    with tempfile.TemporaryDirectory() as folder:
        runs, output = Path(folder) / "script.py", Path(folder) / "found.json"
        runs.write_text(_FRAME.replace("{script}", script), encoding="utf-8")
        command = [blender, "--background", "--factory-startup", "--disable-autoexec", "--python-exit-code", "1"]
        command += [str(path.resolve()), "--python", str(runs), "--", str(output)]
        try:
            subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_SECONDS, check=True)
            return json.loads(output.read_text(encoding="utf-8"))
        except subprocess.TimeoutExpired:
            raise InputError(f"Blender has not opened {path.name} in {_SECONDS} seconds") from None
        except (OSError, ValueError, subprocess.CalledProcessError) as error:
            raise InputError(f"Blender cannot open {path.name}; a file that it has saved is expected") from error
