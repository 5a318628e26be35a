# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tests a model on held-out load cases: whole load cases or recordings, never interleaved blocks.

For each group of load cases the model is refitted without it, by one Gauss-Newton step from the
optimum, and tested on that group. One step is enough because the effects are nearly linear.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit

BOOTSTRAPS = 400


RIDGE = 1e-6
"""Of the squared length of a signature: so little of it on the cases of a fit does not tell its size."""


def fold_steps(
    workspace: Comparison, fit: Fit, home: bool = False
) -> Iterator[tuple[npt.NDArray[np.bool_], FloatArray]]:
    """For each fold its elements (D,), and by how much the parameters (p,) move if it is left out of the fit.

    What only this fold shows, the zero of a run, stays where it is, or with ``home`` goes back to where it is off.
    """
    folds = workspace.folds()[workspace.row_cases()]
    lengths = np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-150)
    j = fit.jacobian / lengths
    full_f, full_g = j.T @ j, j.T @ fit.residual
    # A parameter at its bound stays there: a step knows no bounds.
    free = np.array([name not in fit.at_bound for name in fit.free])
    away = _from_off(workspace, fit) if home else np.zeros(len(lengths))
    for fold in np.unique(folds):
        test = folds == fold
        jt, rt = j[test], fit.residual[test]
        f = full_f - jt.T @ jt
        f[np.diag_indices_from(f)] += RIDGE
        step = np.zeros(len(lengths))
        asked = full_g - jt.T @ rt + RIDGE * away * lengths
        step[free] = np.linalg.lstsq(f[np.ix_(free, free)], asked[free], rcond=1e-9)[0]
        yield test, step / lengths


def _from_off(workspace: Comparison, fit: Fit) -> FloatArray:
    """By how much the parameters (p,) would move to where they are off; 0 for those that are off at no number."""
    effects, start = (*fit.effects, *fit.nuisance), workspace.nuisance
    out = np.zeros(len(fit.free))
    for j, (i, name) in enumerate(fit.free):
        p = effects[i].effect.parameter(name)
        # The nuisance of the rig is what was known before the search.
        off = start[i].values[name] if i < 0 and start else p.off(workspace.physics)
        if p.kind == 'amplitude' and np.isfinite(off):
            out[j] = off - effects[i].values[name]
    return out


def heldout_residual(workspace: Comparison, fit: Fit, home: bool = True) -> FloatArray:
    """Whitened residual (D,), each element predicted by a fit that has not seen its load case; ``home``: what only that
    case shows is off.
    """
    if not fit.free:
        return fit.residual
    out = fit.residual.copy()
    for test, step in fold_steps(workspace, fit, home):
        out[test] -= fit.jacobian[test] @ step
    return out


def scatter(workspace: Comparison, fit: Fit) -> FloatArray:
    """Standard deviation (p,) of the parameters, from their scatter when one fold after the other is left out.

    The jackknife (Tukey 1958). It sees what the noise does not: that the model fits each case a little differently.
    """
    steps = np.array([step for _, step in fold_steps(workspace, fit)])
    n = len(steps)
    return np.asarray(np.sqrt((n - 1) / n * np.sum((steps - steps.mean(axis=0)) ** 2, axis=0)))


def heldout_tables(workspace: Comparison, fit: Fit, home: bool = True) -> list[FloatArray]:
    """Return measured minus simulated, m, on load cases that the fit has not seen; ``home``: as of the residual."""
    if not fit.free:
        return fit.difference
    change = workspace.unwhitened(heldout_residual(workspace, fit, home) - fit.residual)
    return [d + c for d, c in zip(fit.difference, change, strict=True)]


def heldout_gap(workspace: Comparison, fit: Fit, home: bool = True) -> float:
    """Return the gap on load cases that the fit has not seen, m; ``home``: what only one case shows is off there."""
    return workspace.gap(heldout_tables(workspace, fit, home))


def unseen_gap(workspace: Comparison, fit: Fit, columns: FloatArray) -> float:
    """The gap on unseen load cases if ``columns`` (D, p), whitened, describe what ``fit`` leaves, in proportion."""
    lengths = np.maximum(np.linalg.norm(columns, axis=0), 1e-150)
    moved = columns @ (np.linalg.lstsq(columns / lengths, fit.residual, rcond=1e-9)[0] / lengths)
    free = tuple((0, str(j)) for j in range(columns.shape[1]))
    linear = replace(fit, residual=fit.residual - moved, jacobian=columns, free=free, at_bound=())
    change = workspace.unwhitened(heldout_residual(workspace, linear, False) - fit.residual)
    return workspace.gap([d + c for d, c in zip(fit.difference, change, strict=True)])


@dataclass(frozen=True, slots=True)
class HeldOut:
    """``gain``: log-likelihood gained on unseen load cases; ``error``: its block-bootstrap standard error."""

    gain: float
    error: float

    @property
    def significant(self) -> bool:
        """Whether the gain exceeds two standard errors."""
        return self.gain > 2.0 * self.error


def heldout_gain(workspace: Comparison, without: Fit, fit: Fit, rng: np.random.Generator) -> HeldOut:
    """Gain of ``fit`` over ``without`` on unseen load cases.

    The standard error is the smaller of the block bootstrap's and that of the likelihood ratio
    itself, because the former is meaningless for an effect that shows only in a few short intervals. No other case can
    speak for or against what one case alone shows: that keeps its size here, and BIC decides.
    """
    piece = workspace.pieces(heldout_residual(workspace, without, False), heldout_residual(workspace, fit, False))
    draws = rng.integers(0, len(piece), size=(BOOTSTRAPS, len(piece)))
    deviation = float(np.std(piece[draws].sum(axis=1)))
    gain = float(piece.sum())
    return HeldOut(gain, min(deviation, float(np.sqrt(2.0 * max(abs(gain), 1.0)))))
