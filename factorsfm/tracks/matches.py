"""Correspondences of image sets, through pycolmap: features, pairs, verified matches, and the tracks they form.

The database lies in a work folder. Images that have features and pairs that are verified are not touched again, so an
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
from factorsfm.support.components import connected_components
from factorsfm.tracks.learned import LearnedFeatures, find_all, likeness, match_pairs

Array = NDArray[np.float64]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

MAX_FEATURES = 8192
EXHAUSTIVE_UP_TO = 60  # images; above, each is matched with those that look most alike and its neighbours by name
_NEIGHBOURS_ALIKE, _NEIGHBOURS_BY_NAME = 25, 4
_WORDS, _WORD_SAMPLE = 256, 100_000  # of the vocabulary, which is made from the set itself
_ONE_THREAD_ABOVE = 6e6  # pixels: SIFT needs about 150 bytes for each of them
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
    """What joins the images of a set.

    Attributes:
        keypoints: per image (n, 2) pixels, centres at integers.
        pairs: verified matches.
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
    """Features of all images, matches of all pairs worth a try, verified by epipolar geometry.

    Args:
        database: made if absent; one of other images is replaced.
        images: folder of the image files; names: the files, in order.
        cameras: of each image; `has_prior_focal_length` decides whether the lens takes part in the verification.
        masks: folder with a file "NAME.png" for every image, zero = ignore.
        features: None is SIFT. A database holds one kind of them.
    """
    pycolmap.set_random_seed(_SEED)
    if database.exists() and not _stored_names(database) <= set(names):
        logger.info("the matches in %s are of other images and are made anew", database)
        database.unlink()
    with _quiet_colmap():
        if features is not None:
            _match_learned(database, images, names, cameras, masks, features)
            return read_matches(database, names)
        _extract(database, images, names, cameras, masks)
        if len(names) <= EXHAUSTIVE_UP_TO:
            pycolmap.match_exhaustive(database, verification_options=_verification())
        else:
            _match_alike(database, len(names))
    return read_matches(database, names)


def read_matches(database: Path, names: Sequence[str]) -> SetMatches:
    """The content of a database; images that are not in it have no keypoints."""
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
                if first > second:  # the database numbers images as their features got ready
                    first, second, rows = second, first, rows[:, ::-1]
                pairs.append(PairMatches(first, second, rows))
    return SetMatches(keypoints, sorted(pairs, key=lambda pair: (pair.first, pair.second)))


def join_tracks(keypoints: Sequence[Array], pairs: Sequence[PairMatches]) -> list[tuple[Index, Index]]:
    """Tracks: what is connected by matches, directly or through other images.

    A track sees an image once. Where matches join two different keypoints of an image, the matches of the pairs with
    most matches come first, and those that would join such tracks are dropped.

    Returns:
        Per image the ids of its tracks (ascending) and the rows of their keypoints.
    """
    first = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    node = _same_position(keypoints)
    image_of = np.repeat(np.arange(len(keypoints)), np.diff(first))
    ordered = sorted(pairs, key=lambda p: -len(p.rows))
    ends = [node[p.rows + [first[p.first], first[p.second]]] for p in ordered]
    edges = np.concatenate([np.zeros((0, 2), np.int64), *ends])
    label = connected_components(int(first[-1]), edges)
    label = _split_inconsistent(label, edges, image_of)
    # Number the tracks with two images or more.
    used = np.unique(edges)
    count = np.bincount(label[used], minlength=int(first[-1]))
    used = used[count[label[used]] >= 2]
    _, ids = np.unique(label[used], return_inverse=True)
    result = []
    for i in range(len(keypoints)):
        mine = (used >= first[i]) & (used < first[i + 1])
        order = np.argsort(ids[mine])
        result.append((ids[mine][order].astype(np.int64), used[mine][order] - first[i]))
    return result


# --- features and pairs -----------------------------------------------------------------------------------------


def _stored_names(database: Path) -> set[str]:
    with pycolmap.Database.open(database) as db:
        return {image.name for image in db.read_all_images()}


def _extract(
    database: Path, images: Path, names: Sequence[str], cameras: Sequence[pycolmap.Camera], masks: Path | None
) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = MAX_FEATURES
    if max(c.width * c.height for c in cameras) > _ONE_THREAD_ABOVE:
        options.num_threads = 1
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
    _set_cameras(database, names, cameras)


def _set_cameras(database: Path, names: Sequence[str], cameras: Sequence[pycolmap.Camera]) -> None:
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
    """Keep COLMAP from writing its progress to stderr, past all Python logging."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(level, int(pycolmap.logging.Level.ERROR))
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


def _match_alike(database: Path, count: int) -> None:
    """Each image with those that look most alike, by a vocabulary tree, and with its neighbours by name."""
    vocabulary = database.with_suffix(".vocabulary")
    if not vocabulary.exists():
        _build_vocabulary(database, vocabulary)
    alike = pycolmap.VocabTreePairingOptions()
    alike.vocab_tree_path = vocabulary
    alike.num_images = min(_NEIGHBOURS_ALIKE, count - 1)
    pycolmap.match_vocabtree(database, pairing_options=alike, verification_options=_verification())
    neighbours = pycolmap.SequentialPairingOptions()
    neighbours.overlap = _NEIGHBOURS_BY_NAME
    neighbours.quadratic_overlap = False
    pycolmap.match_sequential(database, pairing_options=neighbours, verification_options=_verification())


def _match_learned(
    database: Path,
    images: Path,
    names: Sequence[str],
    cameras: Sequence[pycolmap.Camera],
    masks: Path | None,
    features: LearnedFeatures,
) -> None:
    """The same with keypoints and matches by networks; what looks alike, the keypoints themselves say."""
    with pycolmap.Database.open(database) as db:  # makes it
        new = [name for name in names if db.read_image_with_name(name) is None]
    if new:
        pycolmap.import_images(database, images, camera_mode=pycolmap.CameraMode.PER_IMAGE, image_names=new)
    _set_cameras(database, names, cameras)
    keypoints = find_all(database, images, names, features, masks)
    near = np.abs(np.subtract.outer(np.arange(len(names)), np.arange(len(names))))
    chosen = near > 0
    if len(names) > EXHAUSTIVE_UP_TO:
        rank = np.argsort(np.argsort(-likeness(keypoints), axis=1, kind="stable"), axis=1)
        chosen &= (near <= _NEIGHBOURS_BY_NAME) | (rank < _NEIGHBOURS_ALIKE)
    first, second = np.nonzero(np.triu(chosen | chosen.T))
    pairs = list(zip(first.tolist(), second.tolist(), strict=True))
    match_pairs(database, names, keypoints, pairs, features, _verification())


def _build_vocabulary(database: Path, path: Path) -> None:
    with pycolmap.Database.open(database) as db:
        ids = [image.image_id for image in db.read_all_images()]
        share = _WORD_SAMPLE // len(ids)
        rng = np.random.default_rng(_SEED)
        sample = []
        for image_id in ids:
            data = np.asarray(db.read_descriptors(image_id).data)
            sample.append(data[rng.permutation(len(data))[:share]])
    descriptors = pycolmap.FeatureDescriptorsFloat()
    descriptors.type = pycolmap.FeatureExtractorType.SIFT
    descriptors.data = np.concatenate(sample).astype(np.float32)
    index = pycolmap.VisualIndex.create(128, 64)
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words = _WORDS
    index.build(options, descriptors)
    index.write(path)


# --- tracks -----------------------------------------------------------------------------------------------------


def _same_position(keypoints: Sequence[Array]) -> Index:
    """For every keypoint of the set the first one at its place: SIFT repeats a keypoint for each orientation."""
    nodes, offset = [], 0
    for xy in keypoints:
        _, representative, inverse = np.unique(xy, axis=0, return_index=True, return_inverse=True)
        nodes.append(offset + representative[inverse.reshape(-1)])
        offset += len(xy)
    return np.concatenate([np.zeros(0, np.int64), *nodes]).astype(np.int64)


def _split_inconsistent(label: Index, edges: Index, image_of: Index) -> Index:
    """Components that see an image twice are joined again, edge by edge, without doing so."""
    nodes = np.unique(edges)
    seen, count = np.unique(np.stack([label[nodes], image_of[nodes]]), axis=1, return_counts=True)
    doubtful = np.zeros(len(label), bool)
    doubtful[seen[0, count > 1]] = True
    label = label.copy()
    inside = nodes[doubtful[label[nodes]]]
    members = {int(n): [int(n)] for n in inside}
    root = {int(n): int(n) for n in inside}
    images = {int(n): {int(image_of[n])} for n in inside}
    for a, b in edges[doubtful[label[edges[:, 0]]]].tolist():
        a, b = root[a], root[b]
        if a == b or not images[a].isdisjoint(images[b]):
            continue
        if len(members[a]) < len(members[b]):
            a, b = b, a
        for n in members[b]:
            root[n] = a
        members[a] += members.pop(b)
        images[a] |= images.pop(b)
    for group in members.values():
        label[group] = min(group)
    return label
