# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Full nonlinear refit of a set of effects: Levenberg-Marquardt on the whitened residual, bounded.

It does not use scipy.optimize.least_squares for three reasons. Every simulation must be counted and
shared. The Jacobian at the optimum is reused for the covariance, the hold-out and the next
screening. Steps are taken in each parameter's own scale.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psd_deflection.model.simulation.declaration import ActiveEffect, EffectParameter
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison

STEP = 0.05
"""Step of the finite difference, in units of the parameter's scale."""

STOP = 0.05
"""A refit ends when an iteration gains less than this in chi-square."""

BoolArray = npt.NDArray[np.bool_]


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
