"""Tests a model on held-out load cases: whole load cases, never interleaved blocks.

For each group of load cases the model is refitted without it, by one Gauss-Newton step from the
optimum, and tested on that group. One step is enough because the effects are nearly linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psd_deflection.discovery.fit import Fit
from psd_deflection.discovery.workspace import Workspace
from psd_deflection.records import FloatArray, IntArray

FOLDS = 4
PIECE_SECONDS = 0.5
BOOTSTRAPS = 400


def fold_of_case(workspace: Workspace) -> IntArray:
    """The fold of each load case: assigned in turn, so each fold contains several kinds of cases."""
    count = max(int(c.max()) for c in workspace.case) + 1
    return np.arange(count) % min(FOLDS, count)


def heldout_residual(workspace: Workspace, fit: Fit) -> FloatArray:
    """Whitened residual (D,), each element predicted by a fit that has not seen its load case."""
    if not fit.free:
        return fit.residual
    folds = fold_of_case(workspace)[workspace.row_cases()]
    lengths = np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-150)
    j = fit.jacobian / lengths
    whole_f, whole_g = j.T @ j, j.T @ fit.residual
    out = fit.residual.copy()
    for fold in np.unique(folds):
        test = folds == fold
        jt, rt = j[test], fit.residual[test]
        f = whole_f - jt.T @ jt
        # A ridge of one prior standard deviation: parameters that only this fold shows do not move.
        f[np.diag_indices_from(f)] += 1e-6
        step = np.linalg.lstsq(f, whole_g - jt.T @ rt, rcond=1e-9)[0]
        out[test] = rt - jt @ step
    return out


def heldout_gap(workspace: Workspace, fit: Fit) -> float:
    """Gap, m, on load cases that the fit has not seen."""
    if not fit.free:
        return workspace.gap(fit.difference)
    white = heldout_residual(workspace, fit) - fit.residual
    # The change is slow compared with a fine block, so the inverse of whitening is a scaling per channel.
    parts = []
    for part, d, noise in zip(workspace.split(white), fit.difference, workspace.noise, strict=True):
        gain = noise.innovation / np.maximum(1.0 - noise.ar.sum(axis=1), 0.05)
        parts.append(d + part * gain[:, None])
    return workspace.gap(parts)


@dataclass(frozen=True, slots=True)
class HeldOut:
    """``gain``: log-likelihood gained on unseen load cases; ``error``: its block-bootstrap standard error."""

    gain: float
    error: float

    @property
    def holds(self) -> bool:
        """Whether the gain exceeds two standard errors."""
        return self.gain > 2.0 * self.error


def heldout_gain(workspace: Workspace, without: Fit, fit: Fit, rng: np.random.Generator) -> HeldOut:
    """Gain of ``fit`` over ``without`` on unseen load cases.

    The standard error is the smaller of the block bootstrap's and that of the likelihood ratio
    itself, because the former is meaningless for an effect that shows only in a few short intervals.
    """
    a, b = heldout_residual(workspace, without), heldout_residual(workspace, fit)
    gains = 0.5 * (a * a - b * b)
    pieces: list[FloatArray] = []
    for part, o, size in zip(workspace.split(gains), workspace.observations, workspace.fine, strict=True):
        length = max(1, round(PIECE_SECONDS / (o.period * size)))
        total = part.sum(axis=0)
        pieces.append(np.add.reduceat(total, np.arange(0, len(total), length)))
    piece = np.concatenate(pieces)
    draws = rng.integers(0, len(piece), size=(BOOTSTRAPS, len(piece)))
    spread = float(np.std(piece[draws].sum(axis=1)))
    gain = float(piece.sum())
    return HeldOut(gain, min(spread, float(np.sqrt(2.0 * max(abs(gain), 1.0)))))
