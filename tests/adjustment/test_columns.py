"""The columns of the linear system, and what relies on knowing which variable each of them belongs to."""

from dataclasses import replace

import numpy as np
import pytest

from factorsfm.adjustment.bundle_adjustment import BundleAdjustment
from factorsfm.adjustment.columns import Columns
from factorsfm.adjustment.marginals import in_scene_unit
from factorsfm.adjustment.problem import ErrorModel, Free, Known, LensPrior
from factorsfm.support.options import PolishOptions
from tests.estimation_problems import make_problem, with_prior


def test_every_variable_has_one_column():
    problem = make_problem("truck", frames=4, points=20)
    _, state = with_prior(problem, [0, 2])
    columns = Columns.of(replace(state, log_focal=np.zeros(3), control=np.zeros(7)))
    parts = [columns.poses, columns.log_focal, columns.lens, columns.affines, columns.field, columns.control]
    sizes = [len(range(columns.size)[part]) for part in parts]
    assert sizes == [6 * 4, 3, 6, 2 * 2, len(state.field), 7]
    np.testing.assert_array_equal(np.concatenate([np.arange(columns.size)[part] for part in parts]), range(sum(sizes)))
    np.testing.assert_array_equal(columns.pose(np.array([0, 3])), [np.arange(6), 18 + np.arange(6)])
    optics = np.arange(columns.size)[columns.optics]
    np.testing.assert_array_equal(optics, np.r_[np.arange(24, 27), np.arange(27, 33)])
    scales, shifts = (np.arange(columns.size)[part].tolist() for part in (columns.scales, columns.shifts))
    assert (scales, shifts) == ([33, 35], [34, 36])


@pytest.mark.parametrize("unknown_lens", [False, True])
def test_in_the_unit_of_the_scene_it_is_no_matter_how_well_the_unit_is_known(unknown_lens):
    """The scale of the prior's affines is the unit: known to 10 % or not at all, with lens columns before it or not."""
    problem = make_problem("arc", frames=6, points=80, parallax=0.3, noise_px=0.2)
    prior, truth = with_prior(problem, [0, 2, 5], smooth=0.05)
    sigmas = np.array([0.1, 0.1, 0.01, 0.01, 0.0, 0.0])
    found = []
    for scale_sigma in (0.1, 100.0):
        adjustment = BundleAdjustment(
            truth,
            problem.observations,
            PolishOptions(point_sigma=1e4),
            ErrorModel(0.2),
            prior=replace(prior, scale_sigma=scale_sigma),
            free=Free(focal=unknown_lens),
            known=Known(lens=LensPrior(truth.lens, sigmas) if unknown_lens else None),
        )
        marginals, columns = adjustment.marginals(), adjustment.columns
        relative = in_scene_unit(marginals, truth)
        found.append([np.sqrt(c.diagonal()[columns.scales]) for c in (marginals.camera, relative)])
        assert marginals.camera[columns.lens, columns.lens].any() == unknown_lens
    (known, known_relative), (unknown, unknown_relative) = found
    assert (unknown > 5 * known).all()
    np.testing.assert_allclose(unknown_relative, known_relative, rtol=0.02)
