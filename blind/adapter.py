"""The five steps of discover on another plant, and the interface of its adapter.

A plant simulates its own load cases with any of its own effects on. Real machines differ from their
models by far more than sensor noise, and their residuals are long-lived; so here the level of the
residual is a parameter of the likelihood (N log RSS for each channel), and N counts correlation
times. For a held-out test the model is refitted without a whole load case and tested on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.optimize import least_squares

from psd_deflection.records import FloatArray
from psd_deflection.simulation.declaration import EffectParameter

BIC_ACCEPT = 10.0
MAX_EFFECTS = 4

Model = Mapping[str, Mapping[str, float]]
"""Effect name to parameter values."""


@dataclass(frozen=True, slots=True)
class PlantEffect:
    """An effect of another plant; ``start``: where each parameter's search begins."""

    name: str
    parameters: tuple[EffectParameter, ...]
    start: Mapping[str, float]


class Plant(Protocol):
    """The interface of an adapter."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the rows."""

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the load cases."""

    @property
    def library(self) -> tuple[PlantEffect, ...]:
        """The effects that may be missing."""

    def measured(self) -> list[FloatArray]:
        """Per load case, (channels, n)."""

    def simulate(self, model: Model, cases: Sequence[int]) -> list[FloatArray]:
        """The listed cases in the same form, simulated with the effects of ``model``."""


@dataclass(frozen=True, slots=True)
class Step:
    """One effect added: gap per channel (rms) before and after, BIC gained, held-out gain and its error."""

    name: str
    values: Mapping[str, float]
    delta_bic: float
    heldout_gain: float
    heldout_error: float
    gap_after: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PlantDiscovery:
    """``where``: (case, channel, rms), largest share of its channel first. ``tried``: BIC gained at the first step.

    ``heldout_before`` and ``heldout_after``: rms per channel on load cases not used in the fit.
    """

    where: tuple[tuple[str, str, float], ...]
    tried: tuple[tuple[str, float], ...]
    steps: tuple[Step, ...]
    gap_before: tuple[float, ...]
    heldout_before: tuple[float, ...]
    heldout_after: tuple[float, ...]
    simulations: int


class _Fitter:
    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.data = plant.measured()
        self.effects = {e.name: e for e in plant.library}
        self.simulations = 0
        nominal = self.residuals({}, range(len(self.data)))
        self.scale = self.rms(nominal)
        self.count = np.array([self._effective(nominal, c) for c in range(len(plant.channels))])

    def residuals(self, model: Model, cases: Sequence[int]) -> list[FloatArray]:
        self.simulations += 1
        simulated = self.plant.simulate(model, list(cases))
        return [self.data[c] - s for c, s in zip(cases, simulated, strict=True)]

    def rms(self, residuals: Sequence[FloatArray]) -> FloatArray:
        joined = np.concatenate(residuals, axis=1)
        return np.asarray(np.sqrt(np.mean(joined**2, axis=1)))

    @staticmethod
    def _effective(residuals: Sequence[FloatArray], channel: int) -> float:
        """Independent values: samples over the integrated correlation time, cut at its first zero."""
        total = 0.0
        for r in residuals:
            x = r[channel] - r[channel].mean()
            correlation = np.correlate(x, x, 'full')[len(x) - 1 :] / max(float(x @ x), 1e-300)
            negative = np.flatnonzero(correlation < 0.0)
            stop = int(negative[0]) if len(negative) else len(x)
            total += len(x) / (1.0 + 2.0 * float(correlation[1:stop].sum()))
        return max(total, 2.0)

    def fit(self, model: Model, cases: Sequence[int]) -> Model:
        """Refit every parameter of ``model`` on ``cases``, channels weighted by their nominal misfit."""
        places = [(name, p) for name in model for p in self.effects[name].parameters]
        x0 = np.array([model[name][p.name] / p.scale for name, p in places])
        low = np.array([p.minimum / p.scale for _, p in places])
        high = np.array([p.maximum / p.scale for _, p in places])

        def build(x: FloatArray) -> Model:
            out: dict[str, dict[str, float]] = {name: {} for name in model}
            for (name, p), v in zip(places, x, strict=True):
                out[name][p.name] = float(v) * p.scale
            return out

        def cost(x: FloatArray) -> FloatArray:
            residuals = self.residuals(build(x), cases)
            return np.concatenate([(r / self.scale[:, None]).ravel() for r in residuals])

        steps = np.full(len(x0), 0.02)
        found = least_squares(cost, np.clip(x0, low, high), bounds=(low, high), diff_step=steps, max_nfev=25)
        return build(np.asarray(found.x))

    def bic(self, model: Model, residuals: Sequence[FloatArray]) -> float:
        k = sum(len(self.effects[name].parameters) for name in model)
        level = np.log(self.rms(residuals) ** 2)
        return float(np.sum(self.count * level) + k * np.log(self.count.sum()))

    def heldout(self, model: Model) -> list[FloatArray]:
        """Residual of each case under a fit of all the others."""
        everything = range(len(self.data))
        out = []
        for case in everything:
            others = [c for c in everything if c != case]
            out.append(self.residuals(self.fit(model, others) if model else model, [case])[0])
        return out


def discover_in(plant: Plant) -> PlantDiscovery:
    """The effects that ``plant``'s model lacks, added while BIC and unseen load cases both improve."""
    fitter = _Fitter(plant)
    everything = range(len(fitter.data))
    current: Model = {}
    left = fitter.residuals(current, everything)
    before = fitter.rms(left)
    where = sorted(
        (
            (plant.cases[c], plant.channels[k], float(np.sqrt(np.mean(r[k] ** 2))))
            for c, r in enumerate(left)
            for k in range(len(plant.channels))
        ),
        key=lambda w: -w[2] / before[plant.channels.index(w[1])],
    )
    held = fitter.heldout(current)
    held_before = fitter.rms(held)
    steps: list[Step] = []
    tried: list[tuple[str, float]] = []
    while len(steps) < MAX_EFFECTS:
        now = fitter.bic(current, left)
        trials: list[tuple[float, str, Model, list[FloatArray]]] = []
        for effect in plant.library:
            if effect.name in current:
                continue
            model = fitter.fit({**current, effect.name: effect.start}, everything)
            residuals = fitter.residuals(model, everything)
            trials.append((fitter.bic(model, residuals), effect.name, model, residuals))
        if not trials:
            break
        trials.sort(key=lambda t: t[0])
        if not steps:
            tried = [(name, now - value) for value, name, _, _ in trials]
        value, name, model, residuals = trials[0]
        unseen = fitter.heldout(model)
        # Each case at its own level, so that one bad case does not dominate the others.
        gains = np.array(
            [
                float(np.sum(fitter.count * np.log(np.mean(a**2, axis=1) / np.mean(b**2, axis=1))) / len(everything))
                for a, b in zip(held, unseen, strict=True)
            ]
        )
        gain, error = float(gains.sum()), float(np.sqrt(len(gains)) * gains.std(ddof=1))
        if now - value <= BIC_ACCEPT or gain <= 2.0 * error:
            break
        current, left, held = model, residuals, unseen
        steps.append(Step(name, model[name], now - value, gain, error, tuple(fitter.rms(left).tolist())))
    steps = [Step(s.name, current[s.name], s.delta_bic, s.heldout_gain, s.heldout_error, s.gap_after) for s in steps]
    return PlantDiscovery(
        tuple(where),
        tuple(tried),
        tuple(steps),
        tuple(before.tolist()),
        tuple(held_before.tolist()),
        tuple(fitter.rms(held).tolist()),
        fitter.simulations,
    )
