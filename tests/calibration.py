"""Whether covariances are those of the errors: normalised errors of many draws beside the chi-square distribution."""

import numpy as np

from factorsfm.graph.factors import pose_from_camera


def pose_errors(state, truth):
    """(6 (k - 1),) errors of all cameras but the first, which is the world, in the convention of the covariance."""
    errors = []
    for k in range(1, len(truth.rotation)):
        estimate = pose_from_camera(state.rotation[k], state.translation[k])
        errors.append(estimate.localCoordinates(pose_from_camera(truth.rotation[k], truth.translation[k])))
    return np.concatenate(errors)


def normalised(error, covariance):
    """Squared error in standard deviations, and its degrees of freedom."""
    return error @ np.linalg.solve(covariance, error), len(error)


def unit_direction(state):
    """(6 (k - 1),) how the poses of all cameras but the first change where the unit of length grows."""
    moved = -state.translation[1:]
    return np.concatenate([np.zeros_like(moved), moved], axis=1).ravel()


def without_unit(error, covariance, direction):
    """Error and covariance on the complement of the direction in which the unit of length is free."""
    basis = np.linalg.svd(direction[None])[2][1:]
    return basis @ error, basis @ covariance @ basis.T


def assert_calibrated(trials, low=1.0, high=1.0):
    """The normalised errors of all trials together are a chi-square draw, up to a factor from `low` to `high`."""
    total, freedom = np.sum(trials, axis=0)
    margin = 3.3 * np.sqrt(2 / freedom)  # 99.9 % of a chi-square of many degrees of freedom, relative
    assert low * (1 - margin) < total / freedom < high * (1 + margin)
