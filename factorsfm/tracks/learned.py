"""Learned features of image sets: XFeat keypoints, matched by LighterGlue, as networks in ONNX files.

They go into the same database as SIFT features and are verified in the same way.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from factorsfm.camera.projection import PIXEL_CENTER
from factorsfm.priors.models import MODELS_VARIABLE, model_folders
from factorsfm.priors.networks import open_session
from factorsfm.support.errors import ModelError

Floats = NDArray[np.float32]
Index = NDArray[np.int64]

logger = logging.getLogger(__name__)

_LONGEST_SIDE_PX = 1600  # larger images are reduced to it
_MULTIPLE_OF_PX = 32  # sides of the network's input
_MOST_KEYPOINTS = 2048  # per image: the cost of matching grows with their square
_LEAST_SCORE = 0.1  # of a match
_COMPARED_KEYPOINTS = 512  # the strongest ones, by which `common_features` compares two images
_SAME_DESCRIPTOR = 0.82  # cosine of two descriptors of the same feature there; the value of XFeat's authors
_LEAST_MATCHES = 15  # of a pair that is verified


@dataclass(frozen=True, slots=True)
class FeatureSpec:
    """Two networks: one finds keypoints, the other matches them.

    Attributes:
        extractor: file whose inputs are ``image``, (1, 3, h, w) RGB in 0..1, and ``max_keypoints``, and whose outputs
            are keypoints (1, k, 2) in pixels, descriptors (1, k, d) of unit length and scores (1, k).
        matcher: file whose inputs are ``kpts0``, ``kpts1``, ``desc0``, ``desc1`` as above, and ``image_size0``,
            ``image_size1``, (1, 2) width and height. Its outputs are, for each keypoint of the first image, the row of
            its match in the second one, or -1, and a score in 0..1.
    """

    extractor: str
    matcher: str


FEATURES: dict[str, FeatureSpec] = {"xfeat": FeatureSpec("xfeat.onnx", "lighterglue_xfeat.onnx")}


@dataclass(frozen=True, slots=True)
class Keypoints:
    """The keypoints of one image, the strongest first.

    Attributes:
        xy: (n, 2) pixels, centres at integers.
        descriptors: (n, d) of unit length.
        size: (width, height) of the image, pixels.
    """

    xy: Floats
    descriptors: Floats
    size: tuple[int, int]


class LearnedFeatures:
    """Keypoints and matches by networks.

    Args:
        name: a key of `FEATURES`, whose files are in the folder that ``FACTORSFM_MODELS`` names or in the user's cache;
            or a folder that holds the files of "xfeat".

    Attributes:
        name: the key of `FEATURES`.

    Raises:
        ModelError: a file is missing, or is another network.
    """

    def __init__(self, name: str | Path) -> None:
        self.name = str(name) if str(name) in FEATURES else "xfeat"
        spec = FEATURES[self.name]
        folders = [Path(name)] if str(name) not in FEATURES else model_folders()
        self._extractor = _open(folders, spec.extractor, spec, {"image", "max_keypoints"})
        glue = {f"{what}{i}" for what in ("kpts", "desc", "image_size") for i in (0, 1)}
        self._matcher = _open(folders, spec.matcher, spec, glue)

    def find(self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> Keypoints:
        """The keypoints of an image.

        Args:
            image: (h, w, 3) BGR.
            mask: (h, w), True = ignore.
        """
        height, width = image.shape[:2]
        factor = min(1.0, _LONGEST_SIDE_PX / max(height, width))
        if factor < 1.0:
            size = max(1, round(width * factor)), max(1, round(height * factor))
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        h, w = image.shape[:2]
        below, right = -h % _MULTIPLE_OF_PX, -w % _MULTIPLE_OF_PX
        padded = cv2.copyMakeBorder(image, 0, below, 0, right, cv2.BORDER_REPLICATE)
        values = np.ascontiguousarray(padded[None, ..., ::-1].transpose(0, 3, 1, 2), np.float32) / np.float32(255.0)
        inputs = {"image": values, "max_keypoints": np.array(_MOST_KEYPOINTS, np.int64)}
        xy, descriptors, scores = (output[0] for output in self._extractor.run(None, inputs))
        xy = (xy + PIXEL_CENTER) * (np.array([width, height]) / (w, h)) - PIXEL_CENTER
        good = (scores > 0) & (xy <= (width - 1, height - 1)).all(axis=1)
        if mask is not None:
            column, row = np.clip(np.rint(xy).astype(int), 0, (width - 1, height - 1)).T
            good &= ~mask[row, column]
        order = np.nonzero(good)[0][np.argsort(-scores[good], kind="stable")]
        return Keypoints(xy[order].astype(np.float32), descriptors[order].astype(np.float32), (width, height))

    def match(self, a: Keypoints, b: Keypoints) -> Index:
        """Matches of two images: (m, 2) rows of keypoints of the first and of the second one."""
        inputs: dict[str, Floats] = {}
        for i, k in enumerate((a, b)):
            inputs |= {f"kpts{i}": k.xy[None], f"desc{i}": k.descriptors[None]}
            inputs[f"image_size{i}"] = np.array([k.size], np.float32)
        other, score = self._matcher.run(None, inputs)
        rows = np.nonzero((other >= 0) & (score > _LEAST_SCORE))[0]
        return np.stack([rows, other[rows]], 1).astype(np.int64)


def common_features(images: Sequence[Keypoints]) -> Index:
    """(n, n) number of mutual nearest neighbours among the strongest keypoints of two images, 0 on the diagonal."""
    n = len(images)
    strongest = [k.descriptors[:_COMPARED_KEYPOINTS] for k in images]
    common = np.zeros((n, n), np.int64)
    for i in range(n):
        for j in range(i + 1, n):
            if len(strongest[i]) and len(strongest[j]):
                cosine = strongest[i] @ strongest[j].T
                there, back = cosine.argmax(1), cosine.argmax(0)
                best = cosine[np.arange(len(there)), there]
                common[i, j] = ((back[there] == np.arange(len(there))) & (best > _SAME_DESCRIPTOR)).sum()
    return common + common.T


def find_all(
    database: Path, images: Path, names: Sequence[str], features: LearnedFeatures, masks: Path | None
) -> list[Keypoints]:
    """Keypoints of all images: read from the database, or found and written to it.

    Args:
        database: holds all images.
        images: folder of the image files; names: the files, in order.
        masks: folder with a file "NAME.png" for every image, zero = ignore.
    """
    found = []
    with pycolmap.Database.open(database) as db:
        for name in names:
            image_id = db.read_image_with_name(name).image_id
            if not db.exists_keypoints(image_id):
                image = np.asarray(cv2.imread(str(images / name)), np.uint8)
                kept = cv2.imread(str(masks / f"{name}.png"), cv2.IMREAD_GRAYSCALE) if masks is not None else None
                k = features.find(image, None if kept is None else np.asarray(kept) == 0)
                kind = pycolmap.FeatureExtractorType.UNDEFINED
                stored = np.ascontiguousarray(k.descriptors).view(np.uint8)
                db.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, stored))
                db.write_keypoints(image_id, k.xy + np.float32(PIXEL_CENTER))
            camera = db.read_camera(db.read_image(image_id).camera_id)
            xy = np.asarray(db.read_keypoints(image_id), np.float32)[:, :2] - np.float32(PIXEL_CENTER)
            data = np.ascontiguousarray(db.read_descriptors(image_id).data)
            descriptors = data.view(np.float32) if len(xy) else np.zeros((0, 64), np.float32)
            found.append(Keypoints(xy, descriptors, (camera.width, camera.height)))
    return found


def match_pairs(
    database: Path,
    names: Sequence[str],
    keypoints: Sequence[Keypoints],
    pairs: Sequence[tuple[int, int]],
    features: LearnedFeatures,
    verification: pycolmap.TwoViewGeometryOptions,
) -> None:
    """Match and verify pairs of images, as far as they are not in the database yet, and write them to it.

    Args:
        names, keypoints: of all images, in order.
        pairs: positions of two images.
    """
    lines = []
    with pycolmap.Database.open(database) as db:
        ids = [db.read_image_with_name(name).image_id for name in names]
        for a, b in pairs:
            if not db.exists_matches(ids[a], ids[b]):
                rows = np.zeros((0, 2), np.int64)
                if min(len(keypoints[a].xy), len(keypoints[b].xy)) >= _LEAST_MATCHES:
                    rows = features.match(keypoints[a], keypoints[b])
                db.write_matches(ids[a], ids[b], rows.astype(np.uint32))
            if len(db.read_matches(ids[a], ids[b])) >= _LEAST_MATCHES and not db.exists_two_view_geometry(
                ids[a], ids[b]
            ):
                lines.append(f"{names[a]} {names[b]}\n")
    if lines:
        with tempfile.TemporaryDirectory() as folder:
            listed = Path(folder) / "pairs.txt"
            listed.write_text("".join(lines), encoding="utf-8")
            pycolmap.verify_matches(database, listed, verification)


def _open(folders: Sequence[Path], file: str, spec: FeatureSpec, inputs: set[str]) -> Any:
    path = next((folder / file for folder in folders if (folder / file).is_file()), None)
    if path is None:
        raise ModelError(
            f"the network {file} is in none of {', '.join(map(str, folders))}: set {MODELS_VARIABLE} to a folder that "
            f"holds {spec.extractor} and {spec.matcher}, or give that folder in place of the name"
        )
    session = open_session(path)
    found = {i.name for i in session.get_inputs()}
    if found != inputs:
        raise ModelError(
            f"{path} is another network: its inputs are {', '.join(sorted(found))}; "
            f"{', '.join(sorted(inputs))} are expected"
        )
    return session
