"""The shared driver: it converges, and says so if it does not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from psd_deflection.solvers.gauss_newton import MAX_STEPS, fit


def curve(x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
    """(a, b) to a e^b, a e^2b, a: three readings of two unknowns."""
    a, b = x
    e = float(np.exp(b))
    return [a * e, a * e * e, a], [(e, a * e), (e * e, 2.0 * a * e * e), (1.0, 0.0)]


def line(x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
    """Sees the sum of its unknowns only, except where the first is 1."""
    tells = 1.0 if x[0] == 1.0 else 0.0
    return [x[0] + x[1], 0.0], [(1.0, 1.0), (tells, 0.0)]


def test_a_curve_is_fitted_with_its_covariance() -> None:
    measured, _ = curve((2.0, 0.3))
    one = fit(curve, (1.5, 0.2), measured, (0.01, 0.04, 0.02))
    assert one.converged
    np.testing.assert_allclose(one.parameters, (2.0, 0.3), atol=1e-12)
    _, rows = curve((2.0, 0.3))
    j = np.array(rows)
    want = np.linalg.inv(j.T @ np.diag([100.0, 25.0, 50.0]) @ j)
    np.testing.assert_allclose(one.covariance, want, rtol=1e-9)


def test_what_cannot_be_seen_is_not_converged() -> None:
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
