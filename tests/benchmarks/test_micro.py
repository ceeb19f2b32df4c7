"""The batch solvers that are timed side by side solve the same problem."""

import numpy as np
import pytest

from benchmarks.micro import batch_solvers
from factorsfm.evaluation.metrics import trajectory_errors


@pytest.mark.parametrize("solve", ["_solve_pycolmap", "_solve_gtsam"])
def test_the_solvers_reach_the_same_minimum(solve):
    problem = batch_solvers.batch_problem(12, 150)
    path = np.linalg.norm(problem.true_centers - problem.true_centers[0], axis=1).max()
    aligned = []
    for run in (batch_solvers._solve_numpy, getattr(batch_solvers, solve)):
        rotations, centers, iterations = run(problem)
        errors = trajectory_errors(rotations, centers, problem.true_rotations, problem.true_centers)
        assert 0.003 < np.median(errors.ate) / path < 0.012
        assert 5 < iterations < 20
        aligned.append(errors.alignment.points(centers))
    assert np.abs(aligned[0] - aligned[1]).max() < 2e-4 * path
