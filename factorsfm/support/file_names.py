"""Names of images, which exports and other programs use as paths inside a folder."""

from __future__ import annotations

import re
from pathlib import PurePosixPath, PureWindowsPath

from factorsfm.support.errors import InputError
from factorsfm.support.json_text import is_text

_DRIVE = re.compile(r"[A-Za-z]:")


def check_name(name: str) -> None:
    """Check that the name of an image is a path inside its folder, on every system.

    Raises:
        InputError: it is an absolute path, has a drive letter or "..", or is not UTF-8.
    """
    if not is_text(name):
        raise InputError(f"the image name {name!r} is not UTF-8; rename the file")
    parts = {*PurePosixPath(name).parts, *PureWindowsPath(name).parts}
    if ".." in parts or name.startswith(("/", "\\")) or _DRIVE.match(name) or "\0" in name:
        raise InputError(f"the image name {name!r} leaves the folder of the images; a relative path is expected")
