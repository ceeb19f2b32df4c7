"""Baselines: COLMAP on the same frames, with the true lens held fixed and the same masks."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.evaluation.truth import Shot
from factorsfm.frames.frame import Frame
from factorsfm.priors.masks import MaskFolder
from factorsfm.support.errors import InputError
from factorsfm.support.similarity import pose_arrays

Array = NDArray[np.float64]

EXHAUSTIVE_UP_TO = 40  # images; in a longer shot each is matched with its neighbours only
OVERLAP = 15  # neighbours on either side

# Smallest triangulation angles, degrees, of the first pair and of a point that is kept, tuned for small parallax. The
# next pair is tried if the one before registers fewer than 95 % of the images.
TUNED_ANGLES = ((0.5, 0.05), (2.0, 0.1), (0.2, 0.02), (4.0, 0.2))
ENOUGH_REGISTERED = 0.95
SMALL_ANGLE = 0.05  # degrees, smallest triangulation angle of a new point

_SEED = 0


@dataclass(frozen=True, slots=True)
class BaselineResult:
    """COLMAP's model of the frames; without points and poses if it found none.

    Attributes:
        indices: (n,) frame indices, in the order given.
        rotations: (n, 3, 3) world_from_cam, NaN for unregistered frames.
        centers: (n, 3) camera centres, NaN for unregistered frames.
        points: (k, 3) world coordinates.
        observation_frame: (m,) row in `indices` of each observation of a point.
        observation_point: (m,) row in `points`.
        observation_xy: (m, 2) pixels, centres at integers.
        observation_depth: (m,) z-depth of the point in that camera.
        seconds: wall time of `extraction`, `matching` and `mapping`.
        settings: the settings of the mapper in words.
    """

    indices: NDArray[np.int64]
    rotations: Array
    centers: Array
    points: Array
    observation_frame: NDArray[np.int64]
    observation_point: NDArray[np.int64]
    observation_xy: Array
    observation_depth: Array
    seconds: Mapping[str, float]
    settings: str


@dataclass(frozen=True, slots=True)
class Matches:
    """Images with verified matches in a COLMAP database, which several mappers can use.

    Attributes:
        folder: holds `database.db` and `images/`; the mappers write beside them.
        indices: (n,) frame indices.
        seconds: wall time of `extraction` and `matching`.
    """

    folder: Path
    indices: NDArray[np.int64]
    seconds: Mapping[str, float]


def run_baselines(
    shot: Shot,
    frames: Iterable[Frame],
    methods: Sequence[Callable[[Matches], BaselineResult]] | None = None,
    max_features: int = 8192,
) -> dict[str, BaselineResult]:
    """Extract and match features once in a temporary folder, then run each method.

    Args:
        shot: its lens and masks are used.
        frames: the images to reconstruct.
        methods: some of `colmap_default`, `colmap_tuned`, `colmap_global`; None runs all.
        max_features: SIFT keypoints per image; the default is COLMAP's.

    Returns:
        The results by the name of the method.

    Raises:
        InputError: fewer than two frames, or frames of another size than the lens.
    """
    with tempfile.TemporaryDirectory(prefix="colmap-") as folder:
        matches = match_frames(shot, frames, Path(folder), max_features)
        return {method.__name__: method(matches) for method in methods or BASELINES}


def match_frames(shot: Shot, frames: Iterable[Frame], folder: Path, max_features: int = 8192) -> Matches:
    """Write images and masks to an empty folder, extract SIFT features and match them.

    Up to 40 images, all pairs are matched; beyond, each image with 15 neighbours and with those at distances of powers
    of two (quadratic overlap).

    Raises:
        InputError: fewer than two frames, or frames of another size than the lens.
    """
    images, masks, database = folder / "images", folder / "masks", folder / "database.db"
    images.mkdir()
    masks.mkdir()
    mask_prior = MaskFolder(shot.masks) if shot.masks is not None else None
    indices = []
    for frame in frames:
        if frame.image.shape[:2] != (shot.camera.height, shot.camera.width):
            raise InputError(
                f"frame {frame.index} is {frame.image.shape[1]}x{frame.image.shape[0]} pixels, "
                f"its lens {shot.camera.width}x{shot.camera.height}"
            )
        name = _image_name(frame.index)
        cv2.imwrite(str(images / name), frame.image)
        ignore = mask_prior(frame) if mask_prior is not None else None
        if ignore is not None:
            cv2.imwrite(str(masks / f"{name}.png"), np.where(ignore, 0, 255).astype(np.uint8))
        indices.append(frame.index)
    if len(indices) < 2:
        raise InputError(f"COLMAP needs two frames at least, {len(indices)} given")

    pycolmap.set_random_seed(_SEED)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = shot.camera.model.name
    reader.camera_params = ",".join(repr(float(p)) for p in shot.camera.params)
    if any(masks.iterdir()):
        reader.mask_path = masks
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = max_features
    start = time.perf_counter()
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    extracted = time.perf_counter()
    if len(indices) <= EXHAUSTIVE_UP_TO:
        pycolmap.match_exhaustive(database)
    else:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap = OVERLAP
        pairing.quadratic_overlap = True
        pycolmap.match_sequential(database, pairing_options=pairing)
    matched = time.perf_counter()
    seconds = {"extraction": extracted - start, "matching": matched - extracted}
    return Matches(folder, np.array(indices), seconds)


def colmap_default(matches: Matches) -> BaselineResult:
    """Incremental mapping with COLMAP's default thresholds."""
    start = time.perf_counter()
    best = _incremental(matches, default_options())
    return _result(matches, best, time.perf_counter() - start, "default")


def colmap_tuned(matches: Matches) -> BaselineResult:
    """Incremental mapping tuned for small parallax; further settings are tried while too few images register.

    The model with the most registered images is kept; among equal ones, that with the most points.
    """
    start = time.perf_counter()
    best, settings = None, "none"
    for init_angle, filter_angle in TUNED_ANGLES:
        model = _incremental(matches, tuned_options(init_angle, filter_angle))
        if _quality(model) > _quality(best):
            best = model
            settings = f"first pair from {init_angle} degrees, points from {filter_angle} degrees"
        if _quality(best)[0] >= ENOUGH_REGISTERED * len(matches.indices):
            break
    return _result(matches, best, time.perf_counter() - start, settings)


def colmap_global(matches: Matches) -> BaselineResult:
    """Global mapping (GLOMAP), with triangulation angles tuned for small parallax."""
    start = time.perf_counter()
    best = _largest(
        pycolmap.global_mapping(
            matches.folder / "database.db",
            matches.folder / "images",
            _new_folder(matches.folder),
            global_options(),
        )
    )
    return _result(matches, best, time.perf_counter() - start, f"points from {SMALL_ANGLE} degrees")


BASELINES = (colmap_default, colmap_tuned, colmap_global)


def default_options() -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's default thresholds, with the lens held fixed."""
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = False
    options.ba_refine_principal_point = False
    options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    return options


def tuned_options(init_angle: float, filter_angle: float) -> pycolmap.IncrementalPipelineOptions:
    """Thresholds relaxed for small parallax, with the lens held fixed.

    Args:
        init_angle: smallest triangulation angle of the first pair, degrees.
        filter_angle: smallest triangulation angle of a point that is kept, degrees.
    """
    options = default_options()
    options.min_model_size = 3
    options.mapper.init_min_tri_angle = init_angle
    options.mapper.filter_min_tri_angle = filter_angle
    options.mapper.ba_local_min_tri_angle = 0.1
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_num_inliers = 50
    options.mapper.abs_pose_min_num_inliers = 15
    options.triangulation.min_angle = SMALL_ANGLE
    return options


def global_options() -> pycolmap.GlobalPipelineOptions:
    """Global mapping with angles relaxed for small parallax, with the lens held fixed."""
    options = pycolmap.GlobalPipelineOptions()
    options.mapper.bundle_adjustment.refine_focal_length = False
    options.mapper.bundle_adjustment.refine_principal_point = False
    options.mapper.bundle_adjustment.refine_extra_params = False
    options.mapper.min_tri_angle_deg = SMALL_ANGLE
    options.mapper.retriangulation.min_angle = SMALL_ANGLE
    return options


def _incremental(matches: Matches, options: pycolmap.IncrementalPipelineOptions) -> pycolmap.Reconstruction | None:
    return _largest(
        pycolmap.incremental_mapping(
            matches.folder / "database.db", matches.folder / "images", _new_folder(matches.folder), options
        )
    )


def _largest(models: Mapping[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    return max(models.values(), key=_quality, default=None)


def _quality(model: pycolmap.Reconstruction | None) -> tuple[int, int]:
    return (model.num_reg_images(), model.num_points3D()) if model is not None else (0, 0)


def _new_folder(parent: Path) -> Path:
    return Path(tempfile.mkdtemp(prefix="model-", dir=parent))


def _image_name(index: int) -> str:
    return f"{index:06d}.png"


def _result(matches: Matches, model: pycolmap.Reconstruction | None, mapping: float, settings: str) -> BaselineResult:
    posed, points = [], {}
    if model is not None:
        posed = [image for image in model.images.values() if image.has_pose]
        points = {key: point.xyz for key, point in model.points3D.items()}
    by_name = {image.name: image for image in posed}
    images = [by_name.get(_image_name(int(index))) for index in matches.indices]
    rotations, centers = pose_arrays([image and image.cam_from_world() for image in images])
    xyz = np.array(list(points.values())).reshape(-1, 3)
    row_of = {key: row for row, key in enumerate(points)}
    observed = [
        (frame, row_of[p.point3D_id], *p.xy)
        for frame, image in enumerate(images)
        if image is not None
        for p in image.points2D
        if p.has_point3D()
    ]
    table = np.array(observed).reshape(-1, 4)
    frame, point = table[:, :2].T.astype(np.int64)
    return BaselineResult(
        indices=matches.indices,
        rotations=rotations,
        centers=centers,
        points=xyz,
        observation_frame=frame,
        observation_point=point,
        observation_xy=table[:, 2:] - 0.5,
        observation_depth=np.einsum("ni,ni->n", xyz[point] - centers[frame], rotations[frame, :, 2]),
        seconds={**matches.seconds, "mapping": mapping},
        settings=settings,
    )
