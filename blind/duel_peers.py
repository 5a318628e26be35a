# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What other programs, and simple ways of fitting, say of the machines of ``blind.duels``.

A peer that is not installed raises ImportError; the table says so. None of them is needed by this package.
"""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.signal import lfilter, lfiltic, savgol_filter

from blind.balls import Balls
from blind.silverbox import RATE, SUBSTEPS, TESTS, TRAIN, Silverbox, derivative, linear
from psd_deflection.model.simulation.declaration import Effect
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plants import Model, Plant

ORDERS = range(2, 9)
"""Past samples of a difference equation."""
CHOOSES = 0.25
"""Share of the training part, its end, by which an order or a threshold is chosen."""
THRESHOLDS = tuple(np.geomspace(1e-4, 1e-1, 7).tolist())
BALL_THRESHOLD = 0.05
"""Of 0.001, 0.01 and 0.05 the one by which PySINDy does best on the test."""
BoolArray = npt.NDArray[np.bool_]
Answers = dict[str, FloatArray]
"""Output of each test of the Silverbox."""


def arx(plant: Silverbox) -> tuple[str, Answers]:
    """A linear difference equation with offset, simulated; the order that simulates the end of the training best."""
    u, y = plant.u, plant.y
    begin, end = TRAIN
    cut = round(end - CHOOSES * (end - begin))

    def fitted(order: int, last: int) -> FloatArray:
        at = np.arange(begin + order, last)
        past = [y[at - k] for k in range(1, order + 1)] + [u[at - k] for k in range(order + 1)]
        return np.asarray(np.linalg.lstsq(np.column_stack([*past, np.ones(len(at))]), y[at], rcond=None)[0])

    def simulated(c: FloatArray, order: int, first: int, last: int) -> FloatArray:
        """From the measured outputs before ``first``."""
        fade, push = np.concatenate([[1.0], -c[:order]]), c[order:-1]
        shift = c[-1] / fade.sum()
        past = slice(first - 1, first - 1 - order, -1)
        state = lfiltic(push, fade, y[past] - shift, u[past])
        return np.asarray(lfilter(push, fade, u[first:last], zi=state)[0] + shift)

    best = min(ORDERS, key=lambda n: float(np.sum((simulated(fitted(n, cut), n, cut, end) - y[cut:end]) ** 2)))
    c = fitted(best, end)
    return f'ARX of order {best}', {name: simulated(c, best, *span) for name, span in TESTS.items()}


def sindy(plant: Silverbox) -> tuple[str, Answers]:
    """PySINDy: the acceleration as a sparse polynomial of the third degree in position, speed and input.

    Derivatives are those of the band-limited function through the samples; the threshold is the one that simulates the
    end of the training part best.
    """
    pysindy = importlib.import_module('pysindy')
    begin, end = TRAIN
    cut = round(end - CHOOSES * (end - begin))
    w = linear(plant.u[begin:end], plant.y[begin:end])[0]
    known = np.column_stack([plant.y, plant.speed / w, plant.u])[begin:end]
    size = known.std(axis=0)
    library = pysindy.PolynomialLibrary(degree=3)
    table = np.asarray(library.fit_transform(known / size))
    powers = np.asarray(library.powers_, dtype=int)
    target = derivative(plant.speed)[begin:end] / w**2 / size[1]

    def fitted(threshold: float, count: int) -> FloatArray:
        found = pysindy.STLSQ(threshold=threshold, alpha=1e-9).fit(table[:count], target[:count, None])
        return np.asarray(found.coef_).ravel()

    def simulated(c: FloatArray, first: int, last: int) -> FloatArray:
        """Fourth order of Runge and Kutta, at the substeps of our own simulation."""
        terms = [(v, *p) for v, p in zip(c.tolist(), powers.tolist(), strict=True) if v != 0.0]
        coefficient, a, b, d = (np.array(column)[:, None] for column in zip(*terms, strict=True))
        h = w / RATE / SUBSTEPS
        starts = plant.forced(0.0, 0.0)[first:last] / size[2]
        middles = plant.forced(0.0)[first:last] / size[2]
        ends = np.concatenate([starts[:, 1:], np.roll(starts[:, :1], -1, axis=0)], axis=1)

        def push(position: FloatArray, velocity: FloatArray, force: float) -> FloatArray:
            return np.asarray((coefficient * position**a * velocity**b * force**d).sum(axis=0))

        q = np.array([plant.y[first]]) / size[0]
        v = np.array([plant.speed[first] / w]) / size[1]
        turn = size[1] / size[0]
        out = np.full(last - first, np.nan)
        for i in range(last - first):
            out[i] = q[0]
            for s in range(SUBSTEPS):
                f0, f1, f2 = float(starts[i, s]), float(middles[i, s]), float(ends[i, s])
                a0, v0 = push(q, v, f0), v
                v1 = v + 0.5 * h * a0
                a1 = push(q + 0.5 * h * turn * v0, v1, f1)
                v2 = v + 0.5 * h * a1
                a2 = push(q + 0.5 * h * turn * v1, v2, f1)
                v3 = v + h * a2
                a3 = push(q + h * turn * v2, v3, f2)
                q = q + h * turn / 6.0 * (v0 + 2.0 * v1 + 2.0 * v2 + v3)
                v = v + h / 6.0 * (a0 + 2.0 * a1 + 2.0 * a2 + a3)
            if not abs(q[0]) < 1e3:
                break
        return np.asarray(out * size[0])

    def wrong(threshold: float) -> float:
        last = min(cut + 3000, end)
        residual = simulated(fitted(threshold, cut - begin), cut, last) - plant.y[cut:last]
        return float(np.sum(residual**2)) if np.isfinite(residual).all() else np.inf

    best = min(THRESHOLDS, key=wrong)
    c = fitted(best, end - begin)
    words = f'PySINDy {pysindy.__version__}, {int(np.count_nonzero(c))} terms'
    return words, {name: simulated(c, *span) for name, span in TESTS.items()}


def narx(plant: Silverbox) -> tuple[str, Answers]:
    """SysIdentPy: a polynomial of the third degree of the last two outputs and inputs, terms by FROLS."""
    package = importlib.import_module('sysidentpy')
    frols = importlib.import_module('sysidentpy.model_structure_selection').FROLS
    polynomial = importlib.import_module('sysidentpy.basis_function').Polynomial
    model = frols(ylag=2, xlag=2, basis_function=polynomial(degree=3), order_selection=True, n_info_values=25)
    span = slice(*TRAIN)
    model.fit(X=plant.u[span, None], y=plant.y[span, None])
    out = {}
    for name, (first, last) in TESTS.items():
        with np.errstate(all='ignore'):
            out[name] = np.asarray(model.predict(X=plant.u[first:last, None], y=plant.y[first : first + 2, None]))[:, 0]
    return f'SysIdentPy {package.__version__}, NARX of {model.n_terms} terms', out


def sindy_balls(fitted: Balls, tested: Balls) -> tuple[str, list[FloatArray]]:
    """PySINDy: of each ball the acceleration as a sparse polynomial of its speed, simulated over the other drop.

    As those who measured did: derivatives of smoothed heights; a constant, v and v^2.
    """
    pysindy = importlib.import_module('pysindy')
    out = []
    for i, (t, h) in enumerate(zip(fitted.times, fitted.heights, strict=True)):
        count = min(35, len(h) // 2 * 2 - 1)
        speed = savgol_filter(h, count, 3, deriv=1, delta=fitted.period)
        table = np.column_stack([np.ones(len(t)), speed, speed**2])
        rate = np.gradient(speed, t)
        a, b, c = np.asarray(pysindy.STLSQ(threshold=BALL_THRESHOLD).fit(table, rate[:, None]).coef_).ravel().tolist()
        times = tested.times[i]
        law = partial(_falling, law=(a, b, c))
        found = solve_ivp(law, (0.0, times[-1]), tested.start[i], t_eval=times, rtol=1e-8)
        out.append(np.asarray(found.y[0]))
    return f'PySINDy {pysindy.__version__}, a law for each ball', out


def _falling(_: float, state: FloatArray, law: tuple[float, float, float]) -> list[float]:
    """Rate of height and speed."""
    v = float(state[1])
    return [v, law[0] + law[1] * v + law[2] * v**2]


@dataclass(frozen=True, slots=True)
class Subset:
    """``names`` of the effects, the gap that is left, and on parts that the refitted sizes have not seen."""

    names: tuple[str, ...]
    gap: float
    unseen: float


def best_subset(plant: Plant, most: int = 3, is_linear: bool = False) -> Subset:
    """Of every subset of the library of at most ``most`` effects that with the smallest BIC, N log(RSS) + k log N.

    ``is_linear``: the simulation is linear in all parameters, so that no start has to be guessed. Each effect has one
    parameter; all values count by themselves. The effects are chosen with all cases; their sizes are refitted without
    each part.
    """
    y = _vector(plant.measured())
    parts = np.concatenate([np.tile(p + 1000 * i, len(plant.channels)) for i, p in enumerate(plant.parts())])
    every = np.ones(len(y), dtype=bool)
    residual = _linear(plant, y) if is_linear else _bent(plant, y)

    def bic(effects: Sequence[Effect]) -> float:
        return float(len(y) * np.log(np.sum(residual(effects, every) ** 2)) + len(effects) * np.log(len(y)))

    sets = [s for n in range(most + 1) for s in itertools.combinations(plant.library, n)]
    best = min(sets, key=bic)
    unseen = np.zeros(len(y))
    for part in np.unique(parts):
        unseen[parts == part] = residual(best, parts != part)[parts == part]
    return Subset(tuple(e.name for e in best), rms(residual(best, every)), rms(unseen))


def rms(values: FloatArray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


Residual = Callable[[Sequence[Effect], BoolArray], FloatArray]
"""What effects leave of all values if their sizes are fitted to some of them."""


def _vector(tables: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([t.ravel() for t in tables])


def _model(effects: Sequence[Effect], x: FloatArray) -> Model:
    return {e.name: {e.parameters[0].name: float(v)} for e, v in zip(effects, x, strict=True)}


def _linear(plant: Plant, y: FloatArray) -> Residual:
    """By linear least squares over the pictures of the effects."""
    nothing = _vector(plant.simulate({}))
    pictures = {
        e.name: _vector(plant.simulate(_model([e], np.ones(1)))) - nothing for e in (*plant.nuisance, *plant.library)
    }

    def residual(effects: Sequence[Effect], observed: BoolArray) -> FloatArray:
        names = [e.name for e in (*plant.nuisance, *effects)]
        if not names:
            return y - nothing
        table = np.column_stack([pictures[n] for n in names])
        sizes = np.linalg.lstsq(table[observed], (y - nothing)[observed], rcond=None)[0]
        return np.asarray(y - nothing - table @ sizes)

    return residual


def _bent(plant: Plant, y: FloatArray) -> Residual:
    """By least squares within the bounds, from where the effects are off."""

    def residual(effects: Sequence[Effect], observed: BoolArray) -> FloatArray:
        used = [*plant.nuisance, *effects]
        if not used:
            return y - _vector(plant.simulate({}))
        low, high, size = (
            np.array([getattr(e.parameters[0], n) for e in used]) for n in ('minimum', 'maximum', 'scale')
        )
        start = np.clip(np.zeros(len(used)), low + 1e-3 * size, high - 1e-3 * size)

        def apart(x: FloatArray) -> FloatArray:
            return y - _vector(plant.simulate(_model(used, x)))

        def some(x: FloatArray) -> FloatArray:
            return apart(x)[observed]

        return apart(np.asarray(least_squares(some, start, bounds=(low, high), x_scale=size).x))

    return residual
