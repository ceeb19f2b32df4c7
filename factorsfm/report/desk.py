"""The report with larger pictures, in which a click means a pixel or two of the footage."""

from __future__ import annotations

import base64
import logging
from pathlib import Path

from factorsfm.export.writing import complete_file
from factorsfm.frames.targets import spare_footage
from factorsfm.report.document import data_of, with_data
from factorsfm.report.thumbnails import retake
from factorsfm.result.image_sources import footage_of
from factorsfm.result.reading import read_result
from factorsfm.support.errors import InputError

logger = logging.getLogger(__name__)

DESK = "view.html"

_WIDTH = 960  # pixels of a picture: half of HD, and 240 of them are about 20 MB


def write_desk(report: Path, footage: Path | None = None) -> Path | None:
    """Write the report again, beside itself and with larger pictures.

    None where no footage is at hand for them, or the folder cannot be written, of which a warning tells.

    Args:
        footage: the shot, see `ExportOptions.footage`.

    Raises:
        InputError: the result is damaged, or the footage given is not that of its shot, or would be overwritten.
    """
    text = report.read_text(encoding="utf-8")
    try:
        data = data_of(text)
    except ValueError as error:
        raise InputError(f"{report} is damaged: {error}") from error
    if not data.get("positions"):  # nothing is solved, so there is nothing to pick
        return None
    result = read_result(report.parent)
    spare_footage([report.with_name(DESK)], footage, *footage_of(result.options))
    retake(result, footage, _WIDTH)
    pictures = [frame.thumbnail for frame in result.frames]
    if not any(pictures):
        return None
    data["thumbnail"] = [base64.b64encode(picture).decode() if picture else None for picture in pictures]
    data["footage"] = footage and str(footage.absolute())
    try:
        with complete_file(report.with_name(DESK)) as file:
            file.write_text(with_data(text, data), encoding="utf-8")
    except InputError as error:  # a result of others, or on a medium that is read only, can be looked at
        logger.warning("%s; the pictures are the small ones of %s", error, report.name)
        return None
    return report.with_name(DESK)
