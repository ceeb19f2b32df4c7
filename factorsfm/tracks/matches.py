"""Matches of image sets, through pycolmap: features, pairs to match, geometric verification.

The database lies in a work folder. Images with features and verified pairs are not computed again, so that an
interrupted run goes on where it stopped.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.support.errors import InputError
from factorsfm.tracks.learned import LearnedFeatures, common_features, find_all, match_pairs

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

MAX_FEATURES = 8192  # per image
EXHAUSTIVE_UP_TO = 60  # images; in a larger set each is matched with its neighbours by appearance and by name
_NEIGHBOURS_BY_APPEARANCE, _NEIGHBOURS_BY_NAME = 25, 4
_VISUAL_WORDS, _SAMPLED_DESCRIPTORS = 256, 100_000  # of the vocabulary, which is made from the set itself
# Pixels of an image that SIFT looks at in double size, for which it needs 240 bytes for each; else 30. The largest
# features of an image come first: a large one has enough of them without its finest.
_DOUBLED_UP_TO = 6e6
_SEED = 0


@dataclass(frozen=True, slots=True)
class PairMatches:
    """Verified matches of two images.

    Attributes:
        first, second: positions of the images, the smaller one first.
        rows: (m, 2) keypoints of the first and of the second.
    """

    first: int
    second: int
    rows: Index


@dataclass(frozen=True, slots=True)
class SetMatches:
    """The keypoints of a set and their matches.

    Attributes:
        keypoints: per image (n, 2) pixels, centres at integers.
        pairs: verified matches, sorted by their images.
    """

    keypoints: list[Array]
    pairs: list[PairMatches]


def match_images(
    database: Path,
    images: Path,
    names: Sequence[str],
    cameras: Sequence[pycolmap.Camera],
    masks: Path | None = None,
    features: LearnedFeatures | None = None,
) -> SetMatches:
    """Find features, match all promising pairs and verify them by epipolar geometry.

    Args:
        database: the file; made if it does not exist, replaced if it is of other images.
        images: folder of the image files.
        names: the files, in order.
        cameras: one per image; `has_prior_focal_length` decides whether the verification uses the lens.
        masks: folder with a file "NAME.png" for every image, zero = ignore.
        features: None for SIFT. A database holds features of one kind.

    Raises:
        InputError: the file is not a database.
    """
    pycolmap.set_random_seed(_SEED)
    if database.exists() and not _stored_names(database) <= set(names):
        logger.info("the matches in %s are of other images and are computed again", database)
        database.unlink()
    with _quiet_colmap():
        _import(database, images, names, cameras)
        if features is not None:
            _match_learned(database, images, names, masks, features)
            return read_matches(database, names)
        _extract(database, images, names, masks, max(c.width * c.height for c in cameras))
        if len(names) <= EXHAUSTIVE_UP_TO:
            pycolmap.match_exhaustive(database, verification_options=_verification())
        else:
            _match_neighbours(database, len(names))
    return read_matches(database, names)


def read_matches(database: Path, names: Sequence[str]) -> SetMatches:
    """The content of a database; an image that is not in it has no keypoints."""
    keypoints = []
    with pycolmap.Database.open(database) as db:
        position = {}
        for i, name in enumerate(names):
            image = db.read_image_with_name(name)
            found = np.zeros((0, 2)) if image is None else np.asarray(db.read_keypoints(image.image_id), np.float64)
            keypoints.append(found[:, :2] - PIXEL_CENTER)
            if image is not None:
                position[image.image_id] = i
        pairs = []
        for pair_id, geometry in zip(*db.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            rows = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
            if len(rows) and a in position and b in position:
                first, second = position[a], position[b]
                if first > second:  # in a work folder, images that came later have the larger numbers
                    first, second, rows = second, first, rows[:, ::-1]
                pairs.append(PairMatches(first, second, rows))
    return SetMatches(keypoints, sorted(pairs, key=lambda pair: (pair.first, pair.second)))


def _stored_names(database: Path) -> set[str]:
    try:
        with pycolmap.Database.open(database) as db:
            return {image.name for image in db.read_all_images()}
    except RuntimeError as error:
        raise InputError(f"{database} is not a database of COLMAP; remove it, or name another work folder") from error


def _extract(database: Path, images: Path, names: Sequence[str], masks: Path | None, pixels: int) -> None:
    """Find SIFT features of images of so many pixels at most."""
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = MAX_FEATURES
    options.sift.first_octave = -1 if pixels <= _DOUBLED_UP_TO else 0
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    pycolmap.extract_features(
        database,
        images,
        image_names=list(names),
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        extraction_options=options,
    )


def _import(database: Path, images: Path, names: Sequence[str], cameras: Sequence[pycolmap.Camera]) -> None:
    """Number the images by name: in the order in which their features are found, pairs would be verified either way
    round, and each run would have other matches."""
    with pycolmap.Database.open(database) as db:  # makes the file
        new = [name for name in names if db.read_image_with_name(name) is None]
    if new:
        pycolmap.import_images(database, images, camera_mode=pycolmap.CameraMode.PER_IMAGE, image_names=new)
    with pycolmap.Database.open(database) as db:
        for name, camera in zip(names, cameras, strict=True):
            if (image := db.read_image_with_name(name)) is not None:
                known = pycolmap.Camera(camera.todict())
                known.camera_id = image.camera_id
                db.update_camera(known)


def _verification() -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = _SEED
    return options


@contextmanager
def _quiet_colmap() -> Iterator[None]:
    """Keep COLMAP from writing progress to stderr, past all Python logging."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(level, int(pycolmap.logging.Level.ERROR))
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def _match_neighbours(database: Path, count: int) -> None:
    """Match each image with its neighbours by appearance, from a vocabulary tree, and with its neighbours by name."""
    vocabulary = database.with_suffix(".vocabulary")
    if not vocabulary.exists():
        _build_vocabulary(database, vocabulary)
    by_appearance = pycolmap.VocabTreePairingOptions()
    by_appearance.vocab_tree_path = vocabulary
    by_appearance.num_images = min(_NEIGHBOURS_BY_APPEARANCE, count - 1)
    pycolmap.match_vocabtree(database, pairing_options=by_appearance, verification_options=_verification())
    by_name = pycolmap.SequentialPairingOptions()
    by_name.overlap = _NEIGHBOURS_BY_NAME
    by_name.quadratic_overlap = False
    pycolmap.match_sequential(database, pairing_options=by_name, verification_options=_verification())


def _match_learned(
    database: Path,
    images: Path,
    names: Sequence[str],
    masks: Path | None,
    features: LearnedFeatures,
) -> None:
    """Find and match learned features; neighbours by appearance share most of their strongest keypoints."""
    keypoints = find_all(database, images, names, features, masks)
    distance = np.abs(np.subtract.outer(np.arange(len(names)), np.arange(len(names))))
    chosen = distance > 0
    if len(names) > EXHAUSTIVE_UP_TO:
        rank = np.argsort(np.argsort(-common_features(keypoints), axis=1, kind="stable"), axis=1)
        chosen &= (distance <= _NEIGHBOURS_BY_NAME) | (rank < _NEIGHBOURS_BY_APPEARANCE)
    first, second = np.nonzero(np.triu(chosen | chosen.T))
    pairs = list(zip(first.tolist(), second.tolist(), strict=True))
    match_pairs(database, names, keypoints, pairs, features, _verification())


def _build_vocabulary(database: Path, path: Path) -> None:
    """Write a vocabulary of visual words, from a random sample of the descriptors in the database."""
    with pycolmap.Database.open(database) as db:
        ids = [image.image_id for image in db.read_all_images()]
        per_image = _SAMPLED_DESCRIPTORS // len(ids)
        rng = np.random.default_rng(_SEED)
        sample = []
        for image_id in ids:
            data = np.asarray(db.read_descriptors(image_id).data)
            sample.append(data[rng.permutation(len(data))[:per_image]])
    descriptors = pycolmap.FeatureDescriptorsFloat()
    descriptors.type = pycolmap.FeatureExtractorType.SIFT
    descriptors.data = np.concatenate(sample).astype(np.float32)
    index = pycolmap.VisualIndex.create(128, 64)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = _VISUAL_WORDS
    index.build(options, descriptors)
    index.write(path)
