# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Readings of several blocks have the answers of each alone, of all solvers and of subsets."""

import numpy as np
import pytest

from psd_deflection.measure.solving import ReadingsRun, SolverSet
from psd_deflection.measure.uncertainty.psd_set import PsdSet
from psd_deflection.rig.config import rig_from_values

RIG = rig_from_values({'solver': 'exact', 'solvers': ['wls', 'iterative', 'exact', 'beam']})
CENTERS = RIG.centers.ravel()


def run_of(dots: list[tuple[float, ...]], covariance: np.ndarray, solvers: SolverSet) -> ReadingsRun:
    return ReadingsRun(solvers, PsdSet(RIG, (0, 1), 'none'), dots, (4e-12, 1e-12, 9e-12, 2e-12), covariance)


@pytest.mark.parametrize('odd', [False, True])
def test_blocks_together_have_the_answers_of_each_alone(odd: bool) -> None:
    """``odd``: the dots of one block coincide on the plate, so that the iteration does not end."""
    rng = np.random.default_rng(4)
    dots = [tuple(row) for row in (RIG.zeros.ravel() + 1e-4 * rng.normal(size=(5, 4))).tolist()]
    if odd:
        dots[2] = tuple((-CENTERS).tolist())
    half = 1e-6 * rng.normal(size=(5, 4, 4))
    covariance = half @ half.swapaxes(1, 2)
    solvers = SolverSet(RIG)
    assert solvers.names == ['exact', 'wls', 'iterative', 'beam']
    together = run_of(dots, covariance, solvers)
    for at in range(5):
        alone = run_of(dots[at : at + 1], covariance[at : at + 1], solvers)
        for number in range(4):
            got, want = together.answer(number, at), alone.answer(number, 0)
            assert got.failure == want.failure
            if got.solution is None or want.solution is None:
                assert got == want == (None, got.failure, None, None)
                continue
            assert got.solution._replace(iterations=0) == want.solution._replace(iterations=0)
            np.testing.assert_array_equal(got.gain, want.gain)
            np.testing.assert_array_equal(got.noise, want.noise)
            assert got.gain is not None
            assert got.noise is not None
            np.testing.assert_allclose(got.noise, got.gain @ covariance[at] @ got.gain.T, rtol=1e-9)
    assert bool(together.answer(2, 2).failure) is odd


def test_a_solver_that_needs_all_psds_says_so_of_each_block() -> None:
    """Where the beams of a subset meet in one point, it has no twist."""
    one_place, apart = (rig_from_values({'psd_3.center': [x, y]}) for x, y in (RIG.centers[0].tolist(), (0.0, 0.06)))
    solvers = SolverSet(one_place)
    subset = ReadingsRun(solvers, PsdSet(apart, (0, 2), 'none'), [(0.0,) * 4] * 2, (1e-12,) * 4, np.zeros((2, 4, 4)))
    assert solvers.of(0, (0, 2)) is None
    assert {subset.answer(0, at).failure for at in (0, 1)} == {'exact: takes all PSDs'}
    assert subset.answer(1, 0).solution is None
