"""The first guess of an unknown lens: the focal length from EXIF data, or a usual field of view."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import pycolmap

from factorsfm.support.options import GIVEN_FOCAL_STD, GUESSED_FOCAL_STD
from factorsfm.support.picture_area import PictureArea

logger = logging.getLogger(__name__)

# That of a 27 mm lens on Super 35 film, or 39 mm on full frame. The usual film lenses (18 to 50 mm on Super 35) span 69
# to 28 degrees, so that the guess is wrong by a factor of two at most.
_FIELD_OF_VIEW_DEG = 50.0

_EXIF_RATIOS = (0.2, 30.0)  # focal length over the longer image side; a value outside is an error in the file


def guess_camera(
    width: int,
    height: int,
    image_path: Path | None = None,
    pixel_aspect: float = 1.0,
    picture: PictureArea | None = None,
) -> pycolmap.Camera:
    """First guess of an unknown lens: SIMPLE_PINHOLE, principal point in the middle of the picture.

    PINHOLE where pixels are not square, with focal lengths whose ratio is their aspect.

    Args:
        width, height: size of the images, pixels.
        image_path: an image whose EXIF data may hold the focal length: as 35 mm equivalent, or with the resolution of
            the focal plane, or with a camera whose sensor COLMAP knows.
        pixel_aspect: width of a pixel over its height.
        picture: what of the images is picture, where they have black bars; None if all is.

    Returns:
        A camera whose `has_prior_focal_length` is True if the focal length is from EXIF data. Otherwise the longer side
        of the picture spans 50 degrees.
    """
    shown = picture or PictureArea(0, 0, width, height)
    longer = max((shown.right - shown.left) * pixel_aspect, shown.bottom - shown.top)  # in heights of a pixel
    focal_length = _exif_focal_ratio(image_path) * longer if image_path is not None else 0.0
    known = focal_length > 0
    if not known:
        focal_length = longer / 2 / math.tan(math.radians(_FIELD_OF_VIEW_DEG) / 2)
    focal_lengths = [focal_length] if pixel_aspect == 1.0 else [focal_length / pixel_aspect, focal_length]
    return pycolmap.Camera(
        camera_id=1,
        model="SIMPLE_PINHOLE" if pixel_aspect == 1.0 else "PINHOLE",
        width=width,
        height=height,
        params=[*focal_lengths, (shown.left + shown.right) / 2, (shown.top + shown.bottom) / 2],
        has_prior_focal_length=known,
    )


def first_focal_std(camera: pycolmap.Camera, *, given: bool) -> float:
    """Relative standard deviation of a focal length before any image is used.

    Args:
        given: whether the user gave the camera.
    """
    return GIVEN_FOCAL_STD if given or camera.has_prior_focal_length else GUESSED_FOCAL_STD


def _exif_focal_ratio(image_path: Path) -> float:
    """Focal length from EXIF data over the longer image side; 0 if there is none that can be trusted."""
    try:
        camera = pycolmap.infer_camera_from_image(image_path)
    except ValueError:  # whoever reads the frames reports an unreadable image
        return 0.0
    ratio = float(camera.mean_focal_length() / max(camera.width, camera.height))
    if not camera.has_prior_focal_length:
        return 0.0
    if not _EXIF_RATIOS[0] < ratio < _EXIF_RATIOS[1]:
        logger.warning("ignoring the EXIF focal length of %s: it is %.3g times the longer side", image_path, ratio)
        return 0.0
    return ratio
