"""The first guess of an unknown lens: EXIF data, or the usual field of view."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import pycolmap

from factorsfm.support.options import GUESSED_FOCAL_STD, TOLD_FOCAL_STD

logger = logging.getLogger(__name__)

# Between a 27 mm lens on Super 35 film and a 39 mm lens on full frame: the middle of the usual film
# lenses (18 to 50 mm on Super 35, 69 to 28 degrees), so that the guess is wrong by a factor of two at most.
GUESSED_FIELD_OF_VIEW = math.radians(50)


def guess_camera(width: int, height: int, image_path: Path | None = None) -> pycolmap.Camera:
    """First guess of an unknown lens: SIMPLE_PINHOLE, principal point in the middle.

    Args:
        width, height: size of the images in pixels.
        image_path: an image whose EXIF data may tell the focal length (35 mm equivalent; or focal length with
            the focal plane's resolution or with a sensor that COLMAP knows).

    Returns:
        A camera whose `has_prior_focal_length` says whether the focal length is from EXIF; otherwise the
        longer side spans 50 degrees.
    """
    longer = max(width, height)
    focal_length = _exif_focal_ratio(image_path) * longer if image_path is not None else 0.0
    known = focal_length > 0
    if not known:
        focal_length = longer / 2 / math.tan(GUESSED_FIELD_OF_VIEW / 2)
    return pycolmap.Camera(
        camera_id=1,
        model="SIMPLE_PINHOLE",
        width=width,
        height=height,
        params=[focal_length, width / 2, height / 2],
        has_prior_focal_length=known,
    )


def first_focal_std(camera: pycolmap.Camera, *, given: bool) -> float:
    """How well a focal length is known before its images are seen, relative; `given`: by a camera file."""
    return TOLD_FOCAL_STD if given or camera.has_prior_focal_length else GUESSED_FOCAL_STD


def _exif_focal_ratio(image_path: Path) -> float:
    """Focal length from EXIF over the longer side of the image, 0 if there is none to trust."""
    try:
        camera = pycolmap.infer_camera_from_image(image_path)
    except ValueError:  # an unreadable image is reported by whoever reads the frames
        return 0.0
    ratio = float(camera.mean_focal_length() / max(camera.width, camera.height))
    if not camera.has_prior_focal_length:
        return 0.0
    if not 0.2 < ratio < 30:
        logger.warning("ignoring the EXIF focal length of %s: %.3g times the image's size", image_path, ratio)
        return 0.0
    return ratio
