# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton in floats for one block; several methods use it.

A model gives predicted readings and their derivatives; the driver repeats x <- x + (J^T W J)^-1 J^T W r
until a step no longer matters. The residuals are micrometres and the rig is decimetres, so each
step is some thousand times smaller than the one before, and four or five suffice. The covariance is
(J^T W J)^-1 at the last step.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.base.errors import SolverError
from psd_deflection.model.solvers.interface import Solution, SolverStatus

Model = Callable[[Sequence[float]], tuple[list[float], list[Sequence[float]]]]
"""Parameters (p) to predicted readings (m) and rows of derivatives (m of p)."""

MAX_STEPS = 50
LAST_STEP = 1e-12
"""m and rad. The step after it would be below the last digit that matters."""


class Minimum(NamedTuple):
    """``covariance`` (p x p) rows; ``residual``: measured minus predicted."""

    parameters: list[float]
    covariance: list[list[float]]
    residual: list[float]
    converged: bool
    steps: int


def answer(minimum: Minimum, pose: Sequence[float], covariance: Sequence[Sequence[float]]) -> Solution:
    """``minimum`` as a solver answers: ``pose`` (dX, dY, theta, phi, omega), ``covariance`` of the first three."""
    dx, dy, theta, phi, omega = pose
    (vxx, vxy, vxt), (_, vyy, vyt), (_, _, vtt) = (row[:3] for row in covariance[:3])
    return Solution(
        dx,
        dy,
        theta,
        phi,
        omega,
        (vxx, vxy, vxt, vxy, vyy, vyt, vxt, vyt, vtt),
        tuple(minimum.residual),
        SolverStatus.OK if minimum.converged else SolverStatus.NOT_CONVERGED,
        minimum.steps,
    )


def fit(
    model: Model,
    start: Sequence[float],
    measured: Sequence[float],
    variances: Sequence[float],
    arithmetic: Arithmetic = LIBRARY,
) -> Minimum:
    """One block. Raises SolverError if a variance is 0."""
    x = list(start)
    p = len(x)
    try:
        weights = [1.0 / v for v in variances]
    except ZeroDivisionError:
        raise SolverError('solve: variances must be above 0 m^2') from None
    steps = 0
    while True:
        predicted, rows = model(x)
        residual = [m - q for m, q in zip(measured, predicted, strict=True)]
        normal = [[0.0] * p for _ in range(p)]
        right = [0.0] * p
        for row, w, r in zip(rows, weights, residual, strict=True):
            for i in range(p):
                wi = w * row[i]
                right[i] += wi * r
                line = normal[i]
                for j in range(i + 1):
                    line[j] += wi * row[j]
        inverse = _invert(normal, arithmetic)
        if inverse is None:
            nan = float('nan')
            return Minimum(x, [[nan] * p for _ in range(p)], residual, False, steps)
        largest = 0.0
        step = []
        for i in range(p):
            change = 0.0
            for a, b in zip(inverse[i], right, strict=True):
                change += a * b
            step.append(change)
            x[i] += change
            largest = max(largest, abs(change))
        steps += 1
        if largest < LAST_STEP:
            # For so small a step the linear model of the residual is exact to the last digit.
            residual = [
                r - arithmetic.total([a * b for a, b in zip(row, step, strict=True)])
                for r, row in zip(residual, rows, strict=True)
            ]
            return Minimum(x, inverse, residual, True, steps)
        if not largest < float('inf') or steps == MAX_STEPS:
            return Minimum(x, inverse, residual, False, steps)


def _invert(lower: list[list[float]], arithmetic: Arithmetic) -> list[list[float]] | None:
    """The inverse of a symmetric positive matrix, given its lower half (Cholesky)."""
    p = len(lower)
    for i in range(p):
        line = lower[i]
        for j in range(i + 1):
            other = lower[j]
            total = line[j]
            for k in range(j):
                total -= line[k] * other[k]
            if i == j:
                if not total > 0.0:
                    return None
                line[i] = arithmetic.root(total)
            else:
                line[j] = total / other[j]
    # The inverse of the factor, below the diagonal; then its product with itself.
    factor = [[0.0] * p for _ in range(p)]
    for i in range(p):
        factor[i][i] = 1.0 / lower[i][i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= lower[i][k] * factor[k][j]
            factor[i][j] = total * factor[i][i]
    out = [[0.0] * p for _ in range(p)]
    for i in range(p):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, p):
                total += factor[k][i] * factor[k][j]
            out[i][j] = out[j][i] = total
    return out
