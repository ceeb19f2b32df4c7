"""Tracks of an image set, joined from its pairwise matches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from factorsfm.support.components import connected_components
from factorsfm.tracks.matches import PairMatches

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def tracks_from_matches(keypoints: Sequence[Array], pairs: Sequence[PairMatches]) -> list[tuple[Index, Index]]:
    """Join keypoints to tracks: those that matches connect, directly or through other images.

    Every image observes a track at most once. Where matches would join two different keypoints of an image, they are
    added one by one, from the pair with the most matches to that with the fewest, and a match that would join two
    keypoints of an image is dropped.

    Args:
        keypoints: per image (n, 2) pixels.
        pairs: verified matches.

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
    # Number the tracks of two images or more.
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


def _same_position(keypoints: Sequence[Array]) -> Index:
    """For every keypoint of the set the first one of its image at the same place: SIFT has one for each orientation."""
    nodes, offset = [], 0
    for xy in keypoints:
        _, representative, inverse = np.unique(xy, axis=0, return_index=True, return_inverse=True)
        nodes.append(offset + representative[inverse.reshape(-1)])
        offset += len(xy)
    return np.concatenate([np.zeros(0, np.int64), *nodes]).astype(np.int64)


def _split_inconsistent(label: Index, edges: Index, image_of: Index) -> Index:
    """Join the components that hold two keypoints of one image anew, edge by edge, without the edges that do so.

    Args:
        label: (n,) component of each keypoint.
        edges: (m, 2) keypoints, the most trusted edges first.
        image_of: (n,) image of each keypoint.

    Returns:
        (n,) the new components.
    """
    nodes = np.unique(edges)
    seen, count = np.unique(np.stack([label[nodes], image_of[nodes]]), axis=1, return_counts=True)
    inconsistent = np.zeros(len(label), bool)
    inconsistent[seen[0, count > 1]] = True
    label = label.copy()
    inside = nodes[inconsistent[label[nodes]]]
    members = {int(n): [int(n)] for n in inside}
    root = {int(n): int(n) for n in inside}
    images = {int(n): {int(image_of[n])} for n in inside}
    for a, b in edges[inconsistent[label[edges[:, 0]]]].tolist():
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
