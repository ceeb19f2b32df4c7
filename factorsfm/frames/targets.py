"""Footage is left as it is: outputs that would overwrite it are refused."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from factorsfm.frames.folders import IMAGE_SUFFIXES, list_images
from factorsfm.support.errors import InputError


def spare_footage(targets: Iterable[str | Path], *footage: object) -> None:
    """Check that nothing that is about to be written changes footage, wherever links lead.

    A target may lie in a folder of images, as long as it is none of them.

    Args:
        targets: files and folders that are written anew; what is in such a folder may be replaced.
        footage: video files and folders of images; whatever is no path, or does not exist, counts for nothing.

    Raises:
        InputError: a target is footage, holds some, or would be an image of a folder of footage.
    """
    # What is not there overwrites nothing, and is no new image either unless its name says so.
    risky = [Path(t) for t in targets if os.path.lexists(t) or Path(t).suffix.lower() in IMAGE_SUFFIXES]
    for given in footage:
        if not risky or not isinstance(given, str | Path) or not os.path.exists(given):
            continue
        known = _real(given)
        files = {_real(path) for path in list_images(Path(given))} if known.is_dir() else set[Path]()
        places = {place for path in (known, *files) for place in (path, *path.parents)}
        for target in risky:
            new = _real(target)
            if new in places or (known.is_dir() and known == new.parent and new.suffix.lower() in IMAGE_SUFFIXES):
                raise InputError(f"the output {target} would overwrite the footage {given}; choose another path")


def _real(path: str | Path) -> Path:
    return Path(os.path.realpath(path))  # `Path.resolve` fails on links that lead to themselves
