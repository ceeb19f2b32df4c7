"""Points are eliminated together with those that the same frames see."""

import numpy as np
import pytest

from factorsfm.adjustment.elimination import _LARGEST, Elimination, Term, reduced

COLUMNS = 6


def term_of(first, length, seed=0):
    """Random derivatives of points that are seen in so many frames each, from their first one on."""
    rng = np.random.default_rng(seed)
    point = np.repeat(np.arange(len(first)), length)
    frame = first[point] + np.tile(np.arange(length), len(first))
    m = len(point)
    return Term(
        rng.standard_normal((2, m)),
        rng.standard_normal((COLUMNS, 2, m)),
        COLUMNS * frame[:, None] + np.arange(COLUMNS),
        rng.standard_normal((3, 2, m)),
        frame,
        point,
    )


def eliminated(term, frames, points):
    elimination = Elimination(COLUMNS * frames, points)
    normal = elimination.normal_equations([term])
    blocks = elimination.cross_blocks(normal)
    return blocks, *reduced(normal, blocks, 0.0)


def test_points_that_other_frames_see_are_apart():
    first = np.where(np.arange(400) % 2, 0, 30)
    blocks, *_ = eliminated(term_of(first, 5), 40, 400)
    np.testing.assert_array_equal(np.sort(np.concatenate([points for *_, points in blocks])), np.arange(400))
    for _, columns, points in blocks:
        assert len(columns) == COLUMNS * 5 * len(np.unique(first[points]))
        assert len(points) <= _LARGEST
        assert (np.diff(points) > 0).all()
    assert sum(len(columns) > 5 * COLUMNS for _, columns, _ in blocks) <= 1  # a piece with the last of these


@pytest.mark.parametrize("length", [4, 12])
def test_what_is_left_is_that_of_the_dense_system(length):
    frames, points = 12, 120
    term = term_of(np.arange(points) * 7 % (frames - length + 1), length)
    _, information, gradient, _ = eliminated(term, frames, points)
    size = COLUMNS * frames
    jacobian = np.zeros((2, len(term.point), size + 3 * points))
    rows = np.arange(len(term.point))
    for d in range(2):
        jacobian[d][rows[:, None], term.columns] = term.by_camera[:, d].T
        jacobian[d][rows[:, None], size + 3 * term.point[:, None] + np.arange(3)] = term.by_point[:, d].T
    whole, pull = sum(j.T @ j for j in jacobian), sum(j.T @ r for j, r in zip(jacobian, term.residual, strict=True))
    gain = whole[:size, size:] @ np.linalg.inv(whole[size:, size:])
    np.testing.assert_allclose(information, whole[:size, :size] - gain @ whole[size:, :size], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(gradient, pull[:size] - gain @ pull[size:], rtol=0.0, atol=1e-9)
