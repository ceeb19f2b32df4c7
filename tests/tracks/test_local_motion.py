"""The local motion of an image: exact where it is affine, the whole image's where no track tells."""

from __future__ import annotations

import numpy as np
import pytest

from factorsfm.tracks.frame_flow import robust_fit
from factorsfm.tracks.local_motion import LocalMotion

SHAPE = (540, 960)
AFFINE = np.array([[1.02, -0.03], [0.025, 0.99]])
SHIFT = np.array([4.0, -2.5])


def _tracks(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform([0, 0], [959, 539], (count, 2)).astype(np.float32)


def test_an_affine_motion_is_found() -> None:
    old = _tracks(2000)
    motion = LocalMotion(old, (old @ AFFINE.T + SHIFT).astype(np.float32), SHAPE)
    inside = old[(old > 100).all(axis=1) & (old < [860, 440]).all(axis=1)]
    linear = motion.linear(inside)
    assert np.abs(linear - AFFINE).max() < 2e-3
    assert np.abs(np.median(linear, axis=0) - AFFINE).max() < 1e-3
    error = motion.at(inside) - (inside @ AFFINE.T + SHIFT - inside)
    assert np.linalg.norm(error, axis=1).max() < 0.12
    assert np.median(np.linalg.norm(error, axis=1)) < 0.03


def test_far_from_all_tracks_the_image_moves_as_a_whole() -> None:
    old = _tracks(400)
    old = old[old[:, 0] < 300]
    motion = LocalMotion(old, old + SHIFT.astype(np.float32), SHAPE)
    there = np.array([[900.0, 500.0], [700.0, 20.0], [100.0, 100.0]], np.float32)
    assert motion.at(there) == pytest.approx(np.tile(SHIFT, (3, 1)), abs=1e-4)
    assert motion.linear(there) == pytest.approx(np.tile(np.eye(2), (3, 1, 1)), abs=1e-4)


def test_no_tracks_no_motion() -> None:
    none = np.zeros((0, 2), np.float32)
    motion = LocalMotion(none, none, SHAPE)
    assert not motion.at(_tracks(5)).any()
    assert np.array_equal(motion.linear(_tracks(5)), np.tile(np.eye(2, dtype=np.float32), (5, 1, 1)))


def test_a_fit_that_a_third_of_the_rows_contradict() -> None:
    rng = np.random.default_rng(1)
    cause = rng.uniform(-1, 1, (60, 5))
    true = rng.normal(0, 3, (5, 2))
    effect = cause @ true + rng.normal(0, 0.05, (60, 2))
    effect[::3] += rng.uniform(8, 20, (20, 2))
    assert np.abs(robust_fit(cause, effect.astype(np.float32)) - true).max() < 0.06
    assert not robust_fit(cause[:9], effect[:9].astype(np.float32)).any()  # too few to tell
