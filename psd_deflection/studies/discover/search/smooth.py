# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What remains without a name as one smooth function: a Gaussian process over named variables (Rasmussen and Williams
2006) beside free sizes of the named effects (universal kriging), by restricted likelihood (Patterson and Thompson
1971)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky
from scipy.optimize import Bounds, minimize

from psd_deflection.records import BoolArray, FloatArray, IntArray
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, heldout_gap, unseen_gap
from psd_deflection.studies.discover.search.localise import Localisation
from psd_deflection.studies.discover.search.weighing import Unknown
from psd_deflection.studies.discover.thresholds import (
    BIC_GAIN,
    FEWEST_CASES,
    HALF,
    LEVELS,
    MOST_VALUES,
    P_STRONG,
    RANGE,
)
from psd_deflection.studies.loads.thresholds import FEWEST_VALUES

Variables = Mapping[str, Sequence[FloatArray]]
"""By name, for each case (n,) or, of several coordinates, (n, k)."""


@dataclass(frozen=True, slots=True, eq=False)
class Smooth:
    """``variables``: of which it is a function, by name. ``heldout``: the gap that it and the effects leave on unseen
    cases; ``before``: that the effects alone leave there. ``heldout_as_shaped``: as ``heldout``, with the shapes that
    all cases show; so a table of terms is judged whose terms were chosen with all cases. ``tables``: its value, in the
    form of what was measured, also where nothing was. ``sizes`` (p,): by what the fitted sizes, in the order of the
    fit, are others beside it.
    """

    variables: tuple[str, ...]
    heldout: float
    heldout_as_shaped: float
    before: float
    tables: tuple[FloatArray, ...]
    sizes: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Remainders:
    """``values`` (d,), whitened, of ``channel`` (d,); ``sizes`` (d, p): what the effects can do there; ``fold`` (d,).
    ``apart``: of each variable the squared distances (d, d).
    """

    values: FloatArray
    channel: IntArray
    sizes: FloatArray
    fold: IntArray
    apart: Mapping[str, FloatArray]

    def part(self, keep: BoolArray) -> Remainders:
        """Some of the values."""
        apart = {name: d[np.ix_(keep, keep)] for name, d in self.apart.items()}
        return Remainders(self.values[keep], self.channel[keep], self.sizes[keep], self.fold[keep], apart)


def smooth_of(ws: Comparison, fit: Fit, variables: Variables) -> Smooth | None:
    """What ``fit`` leaves as a function of some of the ``variables``; None if it predicts unseen cases no better."""
    there = np.concatenate([np.isfinite(m).ravel() for m in ws.measured])
    channel = np.concatenate([np.repeat(np.arange(len(m)), m.shape[1]) for m in ws.measured])
    counts = np.bincount(channel[there], minlength=len(ws.channels))
    folds = ws.folds()[ws.row_cases()]
    parts = len(np.unique(folds[there]))
    if parts < FEWEST_CASES or counts.min() < FEWEST_VALUES or len(there) > MOST_VALUES * len(counts):
        return None
    free = np.array([name not in fit.at_bound for name in fit.free], dtype=bool)
    apart = {name: _distances(ws, values) for name, values in variables.items()}
    remains = Remainders(fit.residual, channel, fit.jacobian[:, free], folds, apart)
    chosen, shapes = _chosen(remains.part(there))
    if not chosen:
        return None

    def gap(shaped: bool) -> float:
        change = ws.unwhitened(unseen_residual(remains, chosen, shapes, there, shaped) - fit.residual)
        return ws.gap([d + c for d, c in zip(fit.difference, change, strict=True)])

    heldout, before = gap(shaped=False), heldout_gap(ws, fit)
    if heldout**2 > (1.0 - HALF) * before**2:
        return None
    sizes = np.zeros(len(fit.free))
    _, value, sizes[free] = _known(remains, chosen, shapes, there)
    return Smooth(chosen, heldout, gap(shaped=True), before, tuple(ws.unwhitened(value)), sizes)


def _distances(ws: Comparison, values: Sequence[FloatArray]) -> FloatArray:
    """Squared (D, D), in units of the variable's own scatter, between all elements of a vector."""
    columns = [np.asarray(v, dtype=np.float64).reshape(len(v), -1) for v in values]
    x = np.concatenate([np.tile(c, (len(m), 1)) for c, m in zip(columns, ws.measured, strict=True)])
    scatter = float(np.sqrt(np.mean(np.sum((x - x.mean(axis=0)) ** 2, axis=1))))
    x = x / max(scatter, 1e-300)
    return np.asarray(((x[:, None, :] - x[None, :, :]) ** 2).sum(axis=2))


def _chosen(remains: Remainders) -> tuple[tuple[str, ...], FloatArray]:
    """Return the variables that the likelihood asks for, one after the other, and the logarithms of the shapes."""
    names: tuple[str, ...] = ()
    shapes, likelihood = _shaped(remains, names)
    while True:
        tried = [(*names, name) for name in remains.apart if name not in names]
        fitted = [(*_shaped(remains, more), more) for more in tried]
        best = max(fitted, key=lambda row: row[1], default=None)
        if best is None or 2.0 * (best[1] - likelihood) < BIC_GAIN:
            return names, shapes
        shapes, likelihood, names = best


def _shaped(remains: Remainders, names: Sequence[str], start: FloatArray | None = None) -> tuple[FloatArray, float]:
    """Logarithms (channels, 1 + 2 len(names)) of noise, then size and length of each, and the likelihood of all."""
    channels = np.unique(remains.channel)
    usual = np.full(1 + 2 * len(names), 0.5 * np.log(RANGE[0] * RANGE[1]))
    low, high = np.tile(np.log(RANGE), (len(usual), 1)).T
    begin = np.tile(usual, (len(channels), 1)) if start is None else start
    bounds = Bounds(np.tile(low, len(channels)), np.tile(high, len(channels)))
    basis = orthonormal_basis(remains.sizes)
    parts = [(remains.part(of_channel), basis[of_channel]) for of_channel in (remains.channel == c for c in channels)]
    surprise: Callable[[FloatArray], tuple[float, FloatArray]] = partial(
        negative_log_likelihood, parts=parts, names=names
    )
    solution = minimize(surprise, begin.ravel(), jac=True, method='L-BFGS-B', bounds=bounds, options={'maxiter': 60})
    return np.reshape(solution.x, begin.shape), -float(solution.fun)


def orthonormal_basis(columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis of ``columns``, which may depend on each other."""
    basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(basis[:, sizes > 1e-9 * max(float(sizes.max(initial=0.0)), 1e-300)])


def negative_log_likelihood(
    shapes: FloatArray, parts: Sequence[tuple[Remainders, FloatArray]], names: Sequence[str]
) -> tuple[float, FloatArray]:
    """Minus the restricted log-likelihood, up to a constant, and its gradient. ``parts``: each channel, with what the
    effects can do there (d, p), of an orthonormal basis over all of them.
    """
    rows = np.reshape(shapes, (len(parts), -1))
    known, inverses, logs = list[FloatArray](), list[FloatArray](), 0.0
    for shape, (of_channel, _) in zip(rows, parts, strict=True):
        known.append(_covariance(shape, of_channel, names))
        noise = np.exp(2.0 * shape[0]) * np.eye(len(of_channel.values))
        try:
            lower = cholesky(known[-1] + noise, lower=True)
        except LinAlgError:
            return 1e12, np.zeros(shapes.size)
        inverses.append(cho_solve((lower, True), np.eye(len(lower))))
        logs += float(np.log(np.diag(lower)).sum())
    weighed = [inverse @ basis for inverse, (_, basis) in zip(inverses, parts, strict=True)]
    pulls = [inverse @ of_channel.values for inverse, (of_channel, _) in zip(inverses, parts, strict=True)]
    f = np.sum([basis.T @ w for w, (_, basis) in zip(weighed, parts, strict=True)], axis=0)
    sizes = np.linalg.pinv(f, hermitian=True)
    moved = sizes @ np.sum([basis.T @ p for p, (_, basis) in zip(pulls, parts, strict=True)], axis=0)
    logs += 0.5 * float(np.linalg.slogdet(f)[1])
    loss, gradient = logs, np.zeros_like(rows)
    for i, (shape, (of_channel, _)) in enumerate(zip(rows, parts, strict=True)):
        pull = pulls[i] - weighed[i] @ moved
        loss += 0.5 * float(of_channel.values @ pull)
        # The derivative by a covariance V is half of P - (P y)(P y)', with P the inverse beside the effects.
        curvature = 0.5 * (inverses[i] - weighed[i] @ sizes @ weighed[i].T - np.outer(pull, pull))
        gradient[i, 0] = 2.0 * np.exp(2.0 * shape[0]) * np.trace(curvature)
        for k, name in enumerate(names):
            part = _covariance(np.array([shape[0], *shape[1 + 2 * k : 3 + 2 * k]]), of_channel, (name,))
            gradient[i, 1 + 2 * k] = 2.0 * float(np.sum(curvature * part))
            gradient[i, 2 + 2 * k] = float(
                np.exp(-2.0 * shape[2 + 2 * k]) * np.sum(curvature * part * of_channel.apart[name])
            )
    return loss, gradient.ravel()


def _covariance(shape: FloatArray, remains: Remainders, names: Sequence[str]) -> FloatArray:
    """Of the function of one channel (d, d)."""
    out = np.zeros((len(remains.values), len(remains.values)))
    for name, (size, length) in zip(names, shape[1:].reshape(-1, 2).tolist(), strict=True):
        out += np.exp(2.0 * size - 0.5 * np.exp(-2.0 * length) * remains.apart[name])
    return out


def _known(
    remains: Remainders, names: Sequence[str], shapes: FloatArray, training: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residual (d,) of all values, the function there (d,), the move of the sizes (p,), from ``training``."""
    function = np.zeros((len(remains.values), len(remains.values)))
    noise = np.zeros(len(remains.values))
    for shape, c in zip(shapes, np.unique(remains.channel).tolist(), strict=True):
        of_channel = remains.channel == c
        function[np.ix_(of_channel, of_channel)] = _covariance(shape, remains.part(of_channel), names)
        noise[of_channel] = np.exp(2.0 * shape[0])
    factor = cho_factor((function + np.diag(noise))[np.ix_(training, training)])
    sizes, values = remains.sizes[training], remains.values[training]
    lengths = np.maximum(np.linalg.norm(sizes, axis=0), 1e-150)
    f = (sizes / lengths).T @ cho_solve(factor, sizes / lengths)
    more = np.linalg.lstsq(f, (sizes / lengths).T @ cho_solve(factor, values), rcond=1e-9)[0] / lengths
    value = function[:, training] @ cho_solve(factor, values - sizes @ more)
    return remains.values - remains.sizes @ more - value, value, more


def unseen_residual(
    remains: Remainders, names: Sequence[str], shapes: FloatArray, there: BoolArray, shaped: bool = False
) -> FloatArray:
    """What is left (d,) of each value by sizes, shapes and a function that were found without its part. ``shaped``: the
    shapes are ``shapes``.
    """
    out = np.zeros(len(remains.values))
    for fold in np.unique(remains.fold[there]):
        training = there & (remains.fold != fold)
        shapes_used = shapes if shaped else _shaped(remains.part(training), names, shapes)[0]
        out[~training & there] = _known(remains, names, shapes_used, training)[0][~training & there]
    return out


Table = Sequence[tuple[str, Mapping[str, Sequence[FloatArray]]]]
"""Of each channel its name and its regressors (n,) of each recording, by name."""


@dataclass(frozen=True, slots=True)
class Remainder:
    """``depends_on``: names of variables. ``rms``: what a polynomial of them explains, beyond what then is left;
    ``heldout``: the gap that it leaves on unseen load cases. In the unit of the gap. ``function``: it, if that is one
    smooth function.
    """

    depends_on: tuple[str, ...]
    rms: float
    heldout: float
    function: Smooth | None = None

    @classmethod
    def of(cls, function: Smooth) -> Remainder:
        """Return a smooth function."""
        rms = float(np.sqrt(function.before**2 - function.heldout**2))
        return cls(function.variables, rms, function.heldout, function)

    def tree(self) -> dict[str, Any]:
        """As JSON has it."""
        return {'depends_on': list(self.depends_on), 'rms': self.rms, 'heldout': self.heldout}

    def unknown(self, ws: Comparison, share: float) -> Unknown:
        """In words; ``share``: of the gap's energy that it explains."""
        names = ' and '.join(self.depends_on)
        words = f'a smooth function of {names} that has no name, {ws.worded(self.rms)} rms; '
        words += f'with it {ws.worded(self.heldout)} remain on unseen cases'
        return Unknown(words, self.depends_on, share, rms=self.rms)


def remainder_of(ws: Comparison, fit: Fit, residual: Localisation, table: Table) -> Remainder | None:
    """What ``fit`` leaves as a sum of those terms of ``table`` that ``residual`` found strong.

    None if there are none, or if they predict nothing on unseen load cases.
    """
    strong = [d for d in residual.dependences if d.p < P_STRONG][:LEVELS]
    if not strong:
        return None
    columns = [fit.jacobian[:, j] for j, name in enumerate(fit.free) if name not in fit.at_bound]
    channels = [name for name, _ in table]
    for d in strong:
        c = channels.index(d.channel)
        columns.append(_as_vector(ws, c, ws.row(c, table[c][1][d.regressor])))
    heldout = unseen_gap(ws, fit, np.column_stack(columns))
    before = ws.gap(fit.difference)
    if heldout >= before:
        return None
    names = tuple(dict.fromkeys(d.regressor for d in strong))
    return Remainder(names, float(np.sqrt(before**2 - heldout**2)), heldout)


def _as_vector(ws: Comparison, channel: int, row: FloatArray) -> FloatArray:
    """Return the vector (D,) that is ``row``, whitened, on one channel and 0 on the others."""
    parts = ws.split(np.zeros(sum(m.size for m in ws.measured)))
    at = 0
    for part in parts:
        n = part.shape[1]
        part[channel] = row[at : at + n]
        at += n
    return np.concatenate([part.ravel() for part in parts])
