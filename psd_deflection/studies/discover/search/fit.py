# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bounded Levenberg-Marquardt refit of effects on the whitened residual. scipy's least_squares neither counts and
shares simulations nor keeps the Jacobian for covariance and hold-out."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psd_deflection.model.simulation.declaration import ActiveEffect, EffectParameter
from psd_deflection.records import BoolArray, FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.thresholds import ROUNDING, STEP, STOP


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """``chi2``: loss of ``residual`` (D,), whitened. ``jacobian`` (D, p), whitened, per unit
    of each parameter, in the order of ``free``: (index of the effect, parameter).
    ``difference``: measured minus simulated. ``at_bound``: parameters stopped there. ``nuisance``: what every model
    has, as fitted here; in ``free`` it counts from the end: -1 is the last.
    """

    effects: tuple[ActiveEffect, ...]
    chi2: float
    residual: FloatArray
    difference: list[FloatArray]
    jacobian: FloatArray
    free: tuple[tuple[int, str], ...]
    at_bound: tuple[tuple[int, str], ...]
    nuisance: tuple[ActiveEffect, ...] = ()

    @property
    def coefficients_with_nuisance(self) -> tuple[ActiveEffect, ...]:
        """Nuisance and effects."""
        return (*self.nuisance, *self.effects)

    @property
    def parameters(self) -> int:
        """Number of fitted parameters."""
        return len(self.free)

    def covariance(self) -> FloatArray:
        """(p, p), of the parameters, from the curvature; unobservable directions get large values."""
        if not self.free:
            return np.empty((0, 0))
        lengths = np.maximum(np.linalg.norm(self.jacobian, axis=0), 1e-150)
        f = (self.jacobian / lengths).T @ (self.jacobian / lengths)
        return np.asarray(np.linalg.pinv(f, rcond=1e-10, hermitian=True) / np.outer(lengths, lengths))

    def columns_of(self, index: int) -> list[int]:
        """Columns of the Jacobian that belong to effect ``index``."""
        return [j for j, (i, _) in enumerate(self.free) if i == index]


def _free(effects: Sequence[ActiveEffect]) -> list[tuple[int, EffectParameter]]:
    return [(i, p) for i, a in enumerate(effects) for p in a.effect.parameters if p.kind != 'choice']


def _moved(
    effects: Sequence[ActiveEffect], free: list[tuple[int, EffectParameter]], x: FloatArray
) -> list[ActiveEffect]:
    values = [dict(a.values) for a in effects]
    for (i, p), v in zip(free, x, strict=True):
        values[i][p.name] = float(v)
    return [ActiveEffect(a.effect, v) for a, v in zip(effects, values, strict=True)]


def _unseen(parameters: Sequence[EffectParameter], lengths: FloatArray, ranges: FloatArray) -> BoolArray:
    """Sizes (p,) whose whole range moves the residual by less than one standard deviation: nothing determines them."""
    sizes = np.array([p.kind in ('amplitude', 'coupled') for p in parameters], dtype=bool)
    return np.asarray(sizes & (lengths * ranges < 1.0))


def _differentiate(
    workspace: Comparison,
    model: Callable[[FloatArray], list[FloatArray]],
    x: FloatArray,
    steps: FloatArray,
    simulated: list[FloatArray],
    into: FloatArray,
) -> None:
    """Whitened derivatives (D, p) of ``model``, which is ``simulated`` at ``x``, by one of the ``steps`` (p,) each."""
    for j, h in enumerate(steps.tolist()):
        moved = x.copy()
        moved[j] += h
        into[:, j] = workspace.whiten([(a - b) / h for a, b in zip(model(moved), simulated, strict=True)])


def refit(
    workspace: Comparison,
    effects: Sequence[ActiveEffect],
    iterations: int = 8,
    nuisance: Sequence[ActiveEffect] | None = None,
) -> Fit:
    """Fit all parameters of ``effects``, and of the nuisance, starting from their current values.

    ``nuisance``: where it starts; by default at the values of ``workspace``.
    """
    beside = tuple(workspace.nuisance if nuisance is None else nuisance)
    count, effects = len(beside), (*beside, *effects)
    free = _free(effects)
    x = np.array([effects[i].values[p.name] for i, p in free])
    bounds = [p.bounds(workspace.physics, effects[i].values) for i, p in free]
    low, high = np.array([b[0] for b in bounds]), np.array([b[1] for b in bounds])
    scale = np.array([p.scale for _, p in free])
    x = np.clip(x, low, high)
    base = list(workspace.base)

    def model(v: FloatArray) -> list[FloatArray]:
        return workspace.simulate([*base, *_moved(effects, free, v)])

    def evaluate(v: FloatArray) -> tuple[FloatArray, list[FloatArray], list[FloatArray]]:
        simulated = model(v)
        difference = [m - s for m, s in zip(workspace.measured, simulated, strict=True)]
        return workspace.whiten(difference), difference, simulated

    residual, difference, simulated = evaluate(x)
    chi2 = workspace.loss(residual)
    jacobian = np.empty((len(residual), len(free)))
    damping = 1e-4
    off = np.clip([p.off(workspace.physics) for _, p in free], low, high)
    unseen = np.zeros(len(free), dtype=bool)
    for _ in range(iterations if free else 0):
        steps = np.where(x + STEP * scale > high, -STEP * scale, STEP * scale)
        _differentiate(workspace, model, x, steps, simulated, jacobian)
        lengths = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-150)
        # A size that is off at a bound stays there by itself, and a column of zeros may be a threshold's before it.
        loose = (off > low) & (off < high) & ((lengths > 1e-150) | (x <= low) | (x >= high))
        unseen = unseen | (loose & _unseen([p for _, p in free], lengths, high - low))
        if np.any(x[unseen] != off[unseen]):
            x = np.where(unseen, off, x)
            residual, difference, simulated = evaluate(x)
            chi2 = workspace.loss(residual)
        f = (jacobian / lengths).T @ (jacobian / lengths)
        g = (jacobian.T @ residual) / lengths
        gained = 0.0
        for _ in range(5):
            # A parameter at its bound does not move if the step would leave the bounds.
            stuck = ((x <= low) & (g < 0.0)) | ((x >= high) & (g > 0.0))
            go = np.flatnonzero(~stuck & ~unseen)
            if len(go) == 0:
                break
            a = f[np.ix_(go, go)] + damping * np.eye(len(go))
            step = np.zeros(len(x))
            step[go] = np.linalg.lstsq(a, g[go], rcond=1e-12)[0] / lengths[go]
            trial = np.clip(x + step, low, high)
            if np.array_equal(trial, x):
                break
            r, d, s = evaluate(trial)
            c = workspace.loss(r)
            if c < chi2:
                gained = chi2 - c
                x, residual, difference, simulated, chi2 = trial, r, d, s, c
                damping = max(damping * 0.1, 1e-9)
                break
            damping = max(damping * 20.0, 1e-4)
        if gained < STOP + 1e-7 * chi2:
            break
    named = [(i - count, p.name) for i, p in free]
    stopped = ((x <= low) | (x >= high)) & ~unseen
    bound = tuple(name for name, at in zip(named, stopped.tolist(), strict=True) if at)
    final = tuple(_moved(effects, free, x))
    return Fit(final[count:], chi2, residual, difference, jacobian, tuple(named), bound, final[:count])


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
        f[np.diag_indices_from(f)] += ROUNDING
        step = np.zeros(len(lengths))
        asked = full_g - jt.T @ rt + ROUNDING * away * lengths
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
    removed = _removed(workspace, fit) if home else {}
    for test, step in fold_steps(workspace, fit, home):
        moved = fit.jacobian[test] * step
        for columns, without in removed.items():
            # A limit that goes back to where it clips nothing moves the residual by no more than that.
            most = fit.residual[test] - without[test]
            if np.linalg.norm(moved[:, columns].sum(axis=1)) > np.linalg.norm(most):
                moved[:, columns] = most[:, None] / len(columns)
        out[test] -= moved.sum(axis=1)
    return out


def _removed(workspace: Comparison, fit: Fit) -> dict[tuple[int, ...], FloatArray]:
    """Return the whitened residual (D,) without each effect that is not in proportion to its size, by its columns."""
    out = {}
    for i, active in enumerate(fit.effects):
        if active.effect.finite and (columns := tuple(fit.columns_of(i))):
            rest = [a for k, a in enumerate(fit.effects) if k != i]
            out[columns] = workspace.residual([*workspace.base, *fit.nuisance, *rest])[0]
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
    """``gain``: log-likelihood gained on unseen load cases; ``error``: its standard error, by pieces."""

    gain: float
    error: float

    @property
    def significant(self) -> bool:
        """Whether the gain exceeds two standard errors."""
        return self.gain > 2.0 * self.error


def heldout_gain(workspace: Comparison, without: Fit, fit: Fit) -> HeldOut:
    """Gain of ``fit`` over ``without`` on unseen load cases.

    The standard error is the smaller of that of the sum of its pieces (a block bootstrap's, in closed form) and that of
    the likelihood ratio itself, because the former is meaningless for an effect that shows only in a few short
    intervals. No other case can speak for or against what one case alone shows: that keeps its size here, and BIC
    decides.
    """
    piece = workspace.pieces(heldout_residual(workspace, without, False), heldout_residual(workspace, fit, False))
    deviation = float(np.sqrt(len(piece)) * np.std(piece))
    gain = float(piece.sum())
    return HeldOut(gain, min(deviation, float(np.sqrt(2.0 * max(abs(gain), 1.0)))))
