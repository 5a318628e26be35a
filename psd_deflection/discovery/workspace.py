"""Recordings and simulations as whitened vectors of one common likelihood.

Samples are first averaged over *fine blocks* of a few milliseconds (short enough for the link's
motion, and a recording becomes four times smaller). Then they are whitened by the noise model, so
half the squared length of a residual vector is its negative log-likelihood. All simulations are run
and counted here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from psd_deflection.discovery.noise import NoiseModel, estimate_noise
from psd_deflection.discovery.observation import Observation, load_cases
from psd_deflection.records import DOT_CHANNELS, FloatArray, IntArray
from psd_deflection.simulation.catalogue import sort_effects
from psd_deflection.simulation.declaration import ActiveEffect
from psd_deflection.simulation.physics import Physics
from psd_deflection.simulation.simulator import ForwardModel

FINE_SECONDS = 0.004
MAX_FINE = 60_000
"""Approximate total number of fine blocks; long recordings get longer blocks, which limits memory."""


def fine_means(rows: FloatArray, size: int) -> FloatArray:
    """Means (k, n // size) over ``size`` samples of rows (k, n)."""
    n = rows.shape[1] // size
    return np.asarray(rows[:, : n * size].reshape(rows.shape[0], n, size).mean(axis=2))


class Workspace:
    """All recordings of one call of discover; ``simulations`` counts forward runs of all of them."""

    def __init__(self, observations: Sequence[Observation], base: Sequence[ActiveEffect] = ()) -> None:
        self.observations = tuple(observations)
        self.physics = Physics.of(observations[0].rig)
        self.simulations = 0
        self.base = tuple(base)
        self.fine: list[int] = []
        self.measured: list[FloatArray] = []
        self.valid: list[np.ndarray[tuple[int], np.dtype[np.bool_]]] = []
        self.case: list[IntArray] = []
        self.noise: list[NoiseModel] = []
        next_case = 0
        longest = sum(o.duration for o in self.observations) / MAX_FINE
        for o in self.observations:
            block = o.rig.estimator.block_size
            wanted = max(1, round(max(FINE_SECONDS, longest) / o.period))
            # An estimate block is a whole number of fine blocks.
            size = max(d for d in range(1, min(wanted, block) + 1) if block % d == 0)
            means = fine_means(o.volts.T, size)
            good = np.all(np.isfinite(means), axis=0)
            means[:, ~good] = 0.0
            self.fine.append(size)
            self.measured.append(means)
            self.valid.append(good)
            case = load_cases(o.loads, o.period)[: means.shape[1] * size : size] + next_case
            next_case = int(case.max()) + 1
            self.case.append(case)
        self.estimate_noise(self.base)
        self.data = self.whiten(self.measured)

    def estimate_noise(self, effects: Sequence[ActiveEffect]) -> None:
        """Estimate the noise (again), with the link's motion simulated with ``effects``."""
        self.noise = []
        self.simulations += 1
        for o, size in zip(self.observations, self.fine, strict=True):
            chunk = ForwardModel(o.rig, sort_effects(effects)).expect(o.loads, o.temperature)
            floors = 0.25 * o.rig.noises.ravel()
            self.noise.append(estimate_noise(o, o.volts - chunk.volts.T, size, floors))

    def raw_residual(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        """Measured minus simulated (n, 6) V of each recording, samples, 0 if lost."""
        self.simulations += 1
        out = []
        for o in self.observations:
            chunk = ForwardModel(o.rig, sort_effects(effects)).expect(o.loads, o.temperature)
            difference = o.volts - chunk.volts.T
            out.append(np.where(np.isfinite(difference), difference, 0.0))
        return out

    def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        """Fine-block means (6, nf) V of each recording, simulated without noise."""
        self.simulations += 1
        out = []
        for o, size in zip(self.observations, self.fine, strict=True):
            chunk = ForwardModel(o.rig, sort_effects(effects)).expect(o.loads, o.temperature)
            out.append(fine_means(chunk.volts, size))
        return out

    def whiten(self, fine: Sequence[FloatArray]) -> FloatArray:
        """One vector of all recordings, white and of unit variance if the noise model holds."""
        parts = [w.whiten(f, v).ravel() for f, w, v in zip(fine, self.noise, self.valid, strict=True)]
        return np.concatenate(parts)

    def split(self, vector: FloatArray) -> list[FloatArray]:
        """The (6, nf) parts of such a vector."""
        out, at = [], 0
        for m in self.measured:
            out.append(vector[at : at + m.size].reshape(m.shape))
            at += m.size
        return out

    def row_cases(self) -> IntArray:
        """The load case of every element of a vector."""
        return np.concatenate([np.tile(c, 6) for c in self.case])

    @property
    def size(self) -> int:
        """Elements of a vector that carry data."""
        return sum(6 * int(v.sum()) for v in self.valid)

    def effective_size(self) -> float:
        """Sample size for BIC: blocks of the estimate and channels (N over correlation time)."""
        return sum(
            6.0 * float(v.sum()) * s / o.rig.estimator.block_size
            for v, s, o in zip(self.valid, self.fine, self.observations, strict=True)
        )

    def block_dots(self, fine: Sequence[FloatArray]) -> list[FloatArray]:
        """Block means of the dots (4, blocks), m, of fine-block volts; NaN if a sample is lost."""
        out = []
        for f, v, s, o in zip(fine, self.valid, self.fine, self.observations, strict=True):
            rows = np.where(v, f[list(DOT_CHANNELS)], np.nan)
            out.append(fine_means(rows, o.rig.estimator.block_size // s) * o.rig.sensitivities.reshape(4, 1))
        return out

    def gap(self, residual: Sequence[FloatArray]) -> float:
        """rms of the block-mean residual over x1 y1 x2 y2, m; ``residual`` in fine-block volts."""
        blocks = np.concatenate([b.ravel() for b in self.block_dots(residual)])
        return float(np.sqrt(np.nanmean(blocks**2)))

    def gap_per_channel(self, residual: Sequence[FloatArray]) -> FloatArray:
        """The same for each of x1 y1 x2 y2, (4,) m."""
        blocks = np.concatenate(self.block_dots(residual), axis=1)
        return np.asarray(np.sqrt(np.nanmean(blocks**2, axis=1)))

    def floor(self) -> float:
        """The gap from noise alone, m."""
        total, count = 0.0, 0.0
        for w, o, v in zip(self.noise, self.observations, self.valid, strict=True):
            n = float(v.sum())
            total += n * float(np.mean((w.block_sigma[list(DOT_CHANNELS)] * o.rig.sensitivities.ravel()) ** 2))
            count += n
        return float(np.sqrt(total / max(count, 1.0)))

    def residual(self, effects: Sequence[ActiveEffect]) -> tuple[FloatArray, list[FloatArray]]:
        """Whitened residual vector and fine-block residual in V, measured minus simulated."""
        difference = [m - s for m, s in zip(self.measured, self.simulate(effects), strict=True)]
        return self.whiten(difference), difference
