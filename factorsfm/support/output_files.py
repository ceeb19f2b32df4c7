"""What is at a place that is to be written: files and folders are replaced, and nothing else is."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def kind_of(path: Path) -> str | None:
    """What is at a path, in words: of a link, what it leads to; None if nothing is there."""
    if not os.path.lexists(path):
        return None
    try:
        mode = path.stat().st_mode
    except OSError:
        return "a link that leads nowhere"
    known = {stat.S_IFREG: "a file", stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return known.get(stat.S_IFMT(mode), "a device")


def replaced_file(path: Path) -> Path:
    """The file that is replaced where a path is written: the one that a link leads to, so that the link stays.

    Raises:
        OSError: what is there is no file; a rename onto it would remove a pipe or a device.
    """
    kind = kind_of(path)
    if kind not in (None, "a file"):
        raise OSError(errno.EEXIST, f"it is {kind}, and a file is expected")
    return Path(os.path.realpath(path)) if path.is_symlink() else path
