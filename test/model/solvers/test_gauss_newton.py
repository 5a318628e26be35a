# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The shared driver: it converges, and says so if it does not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from psd_deflection.model.solvers.gauss_newton import MAX_STEPS, Minimum, answer, fit
from psd_deflection.model.solvers.interface import SolverStatus


def curve(x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
    """(a, b) to a e^b, a e^2b, a: three readings of two unknowns."""
    a, b = x
    e = float(np.exp(b))
    return [a * e, a * e * e, a], [(e, a * e), (e * e, 2.0 * a * e * e), (1.0, 0.0)]


def line(x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
    """Sees the sum of its unknowns only, except where the first is 1."""
    reports = 1.0 if x[0] == 1.0 else 0.0
    return [x[0] + x[1], 0.0], [(1.0, 1.0), (reports, 0.0)]


def test_a_curve_is_fitted_with_its_covariance() -> None:
    measured, _ = curve((2.0, 0.3))
    one = fit(curve, (1.5, 0.2), measured, (0.01, 0.04, 0.02))
    assert one.converged
    np.testing.assert_allclose(one.parameters, (2.0, 0.3), atol=1e-12)
    _, rows = curve((2.0, 0.3))
    j = np.array(rows)
    want = np.linalg.inv(j.T @ np.diag([100.0, 25.0, 50.0]) @ j)
    np.testing.assert_allclose(one.covariance, want, rtol=1e-9)


def test_what_cannot_be_observed_is_not_converged() -> None:
    one = fit(line, (0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    assert not one.converged
    assert np.isnan(one.covariance).all()


def test_endless_steps_end() -> None:
    def away(x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
        # The step is always one, whatever x.
        return [0.0], [(1.0,)]

    one = fit(away, (0.0,), (1.0,), (1.0,))
    assert not one.converged
    assert one.steps == MAX_STEPS == 50


def test_a_step_without_end_is_the_last() -> None:
    """A slope of 1e-150 and a reading of 1e160: 1e310 to go."""

    def flat(x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
        return [0.0], [(1e-150,)]

    one = fit(flat, (0.0,), (1e160,), (1.0,))
    assert not one.converged
    assert one.steps == 1


def test_the_residual_is_that_at_the_answer_to_the_last_digit() -> None:
    """Readings that no curve explains: each step is a share of the one before, and the last one still counts."""
    on, _ = curve((2.0, 0.3))
    measured = [a + b for a, b in zip(on, (0.9, -0.7, 0.8), strict=True)]
    one = fit(curve, (1.5, 0.2), measured, (0.01, 0.04, 0.02))
    assert one.converged
    assert one.steps > 5
    want = np.array(measured) - curve(one.parameters)[0]
    np.testing.assert_allclose(one.residual, want, rtol=0.0, atol=2e-15)


def test_an_answer_takes_the_first_three_of_five() -> None:
    covariance = [[float(10 * min(i, j) + max(i, j)) for j in range(5)] for i in range(5)]
    for converged in (True, False):
        got = answer(Minimum([0.0] * 5, covariance, [7.0, 8.0], converged, 4), (1.0, 2.0, 3.0, 4.0, 5.0), covariance)
        assert got[:5] == (1.0, 2.0, 3.0, 4.0, 5.0)
        assert got.covariance == (0.0, 1.0, 2.0, 1.0, 11.0, 12.0, 2.0, 12.0, 22.0)
        assert (got.residual, got.iterations) == ((7.0, 8.0), 4)
        assert got.status is (SolverStatus.OK if converged else SolverStatus.NOT_CONVERGED)
