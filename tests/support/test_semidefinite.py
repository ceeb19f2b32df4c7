"""What is not determined counts as unobservable: no division by zero, no negative variance."""

import re
from pathlib import Path

import numpy as np
import pytest

import factorsfm
from factorsfm.support.semidefinite import (
    conditioned,
    covariance_and_root,
    covariance_of,
    deviations,
    root_of,
    solution,
    squared_deviations,
    triangular_solution,
)


def information_without(direction, scales):
    """(n, n) of random measurements that say nothing along a direction, of variables in very different units."""
    rng = np.random.default_rng(0)
    seen = rng.standard_normal((40, len(direction)))
    seen -= np.outer(seen @ direction, direction) / (direction @ direction)
    return seen.T @ seen * np.outer(scales, scales)


@pytest.mark.parametrize("rounding", [-1e-9, 0.0, 1e-15])
def test_an_undetermined_direction_is_very_uncertain_and_the_others_are_as_they_are(rounding):
    direction, scales = np.array([1.0, -2.0, 0.5, 0.0, 1.0]), np.array([1e6, 1.0, 1e-3, 10.0, 1e2])
    information = information_without(direction, scales)
    information[0, 0] *= 1.0 + rounding  # the elimination leaves such errors
    covariance = covariance_of(conditioned(information))
    assert (np.linalg.eigvalsh(covariance * np.outer(scales, scales)) > 0.0).all()
    unseen = direction / scales
    assert unseen @ covariance @ unseen > 1e3
    seen = np.array([0.0, 0.0, 0.0, 1.0, 0.0])  # the only one that has no part in the direction
    assert seen @ covariance @ seen == pytest.approx(
        np.linalg.pinv(information_without(direction, scales))[3, 3], rel=0.1
    )


def test_a_variable_that_nothing_sees_stays_where_it_is():
    information = np.diag([4.0, 0.0, 2.0])
    np.testing.assert_allclose(solution(information, np.array([8.0, 3.0, 1.0])), [2.0, 0.0, 0.5], rtol=1e-12)
    np.testing.assert_allclose(covariance_of(information).diagonal(), [0.25, 1e12, 0.5])


def test_a_determined_system_is_solved_as_it_is():
    information = information_without(np.array([1.0, 1.0, 0.0]), np.ones(3)) + 0.1 * np.eye(3)
    gradient = np.array([1.0, -2.0, 3.0])
    np.testing.assert_array_equal(solution(information, gradient), np.linalg.solve(information, gradient))
    np.testing.assert_allclose(covariance_of(information), np.linalg.inv(information), rtol=1e-9)


@pytest.mark.parametrize("values", [(), (3,)])
def test_a_large_triangle_is_solved_block_by_block(values):
    rng = np.random.default_rng(2)
    root = np.tril(rng.standard_normal((250, 250))) + 20.0 * np.eye(250)
    wanted = rng.standard_normal((250, *values))
    np.testing.assert_allclose(triangular_solution(root, root @ wanted), wanted, rtol=0.0, atol=1e-12)


def test_evidence_from_few_samples_is_not_negative():
    samples = np.random.default_rng(1).standard_normal((2, 4))
    covariance = samples.T @ samples
    along, across = samples[0], np.linalg.svd(samples)[2][3]
    assert squared_deviations(along, covariance) == pytest.approx(along @ np.linalg.pinv(covariance) @ along, rel=1e-5)
    assert squared_deviations(across, covariance) > 1e6


def test_roots_are_those_of_the_matrix_whatever_is_open():
    full = information_without(np.array([1.0, 1.0, 0.0]), np.ones(3)) + 0.1 * np.eye(3)
    np.testing.assert_array_equal(root_of(full), np.linalg.cholesky(full))
    singular = np.array([[2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, -1e-18]])
    root = root_of(singular)
    np.testing.assert_array_equal(np.triu(root, 1), 0.0)
    np.testing.assert_allclose(root @ root.T, singular, atol=1e-11)
    covariance, root = covariance_and_root(np.stack([full, np.diag([4.0, 0.0, 1.0])]))
    np.testing.assert_allclose(covariance[0], np.linalg.inv(full))
    np.testing.assert_allclose(covariance[1].diagonal(), [0.25, 1e12, 1.0])
    np.testing.assert_allclose(root @ root.swapaxes(1, 2), covariance, rtol=1e-9, atol=1e-9)


def test_what_is_no_number_is_not_known():
    information = np.array([[4.0, np.nan], [np.nan, np.inf]])
    np.testing.assert_allclose(covariance_of(information), np.diag([0.25, 1e12]))
    np.testing.assert_array_equal(deviations(np.diag([4.0, -1e-9])), [2.0, 0.0])


def test_normal_equations_are_solved_in_one_place():
    """Elsewhere only matrices are inverted that no measurement can make singular."""
    elsewhere = {
        "alignment/planes.py", "support/semidefinite.py", "synthetic/imu.py", "synthetic/room.py", "tracks/tiles.py"
    }  # fmt: skip
    package = Path(factorsfm.__file__).parent
    found = {
        file.relative_to(package).as_posix()
        for file in package.rglob("*.py")
        if re.search(r"linalg\.(solve|inv|cholesky)\(", file.read_text(encoding="utf-8"))
    }
    assert found == elsewhere
