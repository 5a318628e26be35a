"""Gauss-Newton, once in floats for a block and once vectorised for n: the driver of several methods.

A model gives predicted readings and their derivatives; the driver repeats x <- x + (J^T W J)^-1 J^T W r
until a step no longer matters. Residuals of some micrometres on a rig of decimetres make each step
some thousand times smaller than the one before, so that four or five suffice. The covariance is
(J^T W J)^-1 at the last step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.records import FloatArray

Model = Callable[[Sequence[float]], tuple[list[float], list[Sequence[float]]]]
"""Parameters (p) to predicted readings (m) and rows of derivatives (m of p)."""

ModelMany = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Parameters (n, p) to predicted readings (n, m) and derivatives (n, m, p)."""

MAX_STEPS = 50
LAST_STEP = 1e-12
"""m and rad. The next step would be below the last digit of a double."""

CHUNK = 4096
"""Blocks worked on at once: their arrays stay in the processor's cache."""


class Fit(NamedTuple):
    """``covariance`` (p x p) rows; ``residual``: measured minus predicted."""

    parameters: list[float]
    covariance: list[list[float]]
    residual: list[float]
    converged: bool
    steps: int


class Fits(NamedTuple):
    """(n, p), (n, p, p), (n, m), (n,) bool."""

    parameters: FloatArray
    covariance: FloatArray
    residual: FloatArray
    converged: npt.NDArray[np.bool_]


def fit(model: Model, start: Sequence[float], measured: Sequence[float], variances: Sequence[float]) -> Fit:
    """One block; every variance above 0."""
    x = list(start)
    p = len(x)
    weights = [1.0 / v for v in variances]
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
        inverse = _invert(normal)
        if inverse is None:
            nan = float('nan')
            return Fit(x, [[nan] * p for _ in range(p)], residual, False, steps)
        largest = 0.0
        for i in range(p):
            step = 0.0
            for a, b in zip(inverse[i], right, strict=True):
                step += a * b
            x[i] += step
            largest = max(largest, abs(step))
        steps += 1
        if largest < LAST_STEP:
            # The step is below what the residual can show.
            return Fit(x, inverse, residual, largest == largest, steps)
        if not largest < float('inf') or steps == MAX_STEPS:
            return Fit(x, inverse, residual, False, steps)


def _invert(lower: list[list[float]]) -> list[list[float]] | None:
    """The inverse of a symmetric positive matrix of which the lower half is given (Cholesky)."""
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
                line[i] = total**0.5
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


def fit_many(model: ModelMany, start: FloatArray, measured: FloatArray, variances: FloatArray) -> Fits:
    """N blocks: ``start`` (n, p), ``measured`` (n, m), ``variances`` (m,) or (n, m)."""
    n, p = start.shape
    weights = np.broadcast_to(1.0 / np.atleast_2d(variances), measured.shape)
    out = Fits(start.copy(), np.empty((n, p, p)), np.empty(measured.shape), np.zeros(n, dtype=bool))
    for first in range(0, n, CHUNK):
        part = slice(first, first + CHUNK)
        x = out.parameters[part]
        w = weights[part]
        for _ in range(MAX_STEPS):
            predicted, rows = model(x)
            residual = measured[part] - predicted
            weighted = rows * w[:, :, None]
            normal = np.einsum('nmi,nmj->nij', weighted, rows)
            right = np.einsum('nmi,nm->ni', weighted, residual)
            try:
                inverse = np.linalg.inv(normal)
            except np.linalg.LinAlgError:
                # One singular block must not spoil its neighbours.
                singular = ~(np.linalg.matrix_rank(normal, hermitian=True) == p)
                normal[singular] = np.nan
                inverse = np.linalg.inv(normal)
            step = np.einsum('nij,nj->ni', inverse, right)
            x += step
            largest = np.abs(step).max(axis=1)
            if not (largest >= LAST_STEP).any():
                break
        out.covariance[part] = inverse
        out.residual[part] = residual
        out.converged[part] = largest < LAST_STEP
    return out
