# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings and simulations as whitened means of a few milliseconds, so that half the squared length of a residual is
its negative log-likelihood. All simulations are run and counted here."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple, Self

import numpy as np

from psd_deflection.base.charts import ONE_AFTER_ANOTHER, TimeAxis
from psd_deflection.model.simulation.catalogue import sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import Observation, load_cases
from psd_deflection.records import FloatArray, IntArray, Moment, dot_names
from psd_deflection.studies.discover.hidden import (
    FIRST,
    SETUP,
    Direction,
    Free,
    LoadDirection,
    added,
    moved,
    only_in,
    sparse_rows,
)
from psd_deflection.studies.discover.noise import NoiseModel, corners_of, estimate_noise
from psd_deflection.studies.discover.search.comparison import Comparison, SimulationCount
from psd_deflection.studies.discover.thresholds import FOLDS, MAX_FINE
from psd_deflection.studies.loads.plate_motion import dot_rows, fine_means
from psd_deflection.studies.loads.thresholds import FINE_SECONDS, MINOR, REST_S, SLIGHT


class _Asked(NamedTuple):
    """``observation`` is compared by identity."""

    observation: Observation
    effects: list[ActiveEffect]


MOST_KEPT = 1_000_000
"""Samples of all recordings whose motion is kept: 0.12 GB."""
LOADS_SHOWN = ('load_fx / N', 'load_fy / N', 'load_tz / N m')


class KeptMotion:
    """Where the dots of a recording fall on the plate, kept once it is asked for twice in a row: the effects of a PSD
    leave it as it is, and most of a simulation's time is spent on it."""

    def __init__(self, keeps: bool) -> None:
        self._keeps = keeps
        self._asked: _Asked | None = None
        self._kept: _Asked | None = None
        self._pieces: list[SimulatedSamples] = []

    def simulated(
        self, observation: Observation, model: ForwardModel, unit: int
    ) -> Iterator[tuple[slice, SimulatedSamples]]:
        """The pieces of ``observation`` by a new ``model``, as of :meth:`ForwardModel.expect_in_pieces`."""
        asked = _Asked(observation, model.moving)
        inputs = observation.acting, observation.temperature, unit
        if asked == self._kept and model.in_pieces:
            yield from model.expect_in_pieces(*inputs, self._pieces)
            return
        keeps = self._keeps and asked == self._asked and model.in_pieces
        self._asked = asked
        if keeps:
            self._kept, self._pieces = None, []
        pieces = list[SimulatedSamples]()
        for at, samples in model.expect_in_pieces(*inputs):
            if keeps:
                pieces.append(samples.up_to_plate(samples.physics))
            yield at, samples
        if keeps:
            self._kept, self._pieces = asked, pieces


class Workspace(Comparison):
    """All recordings of the rig of one call of discover, as means of fine blocks (3P, nf), V."""

    physics: Physics
    first = FIRST
    setup = SETUP
    digits = '.3f'
    free: Free | None = None

    def __init__(self, observations: Sequence[Observation], base: Sequence[ActiveEffect] = ()) -> None:
        self.observations = tuple(observations)
        self.physics = Physics.of(observations[0].rig)
        self.tally = SimulationCount()
        self.base = tuple(base)
        keeps = sum(len(o.loads) for o in observations) <= MOST_KEPT
        self._motions = [KeptMotion(keeps) for _ in observations]
        self.fine: list[int] = []
        self.measured: list[FloatArray] = []
        self.count: list[FloatArray] = []
        self._present: list[FloatArray | None] = []
        self.case: list[IntArray] = []
        next_case = 0
        longest = sum(o.duration for o in self.observations) / MAX_FINE
        for o in self.observations:
            block = o.rig.estimator.block_size
            wanted = max(1, round(max(FINE_SECONDS, longest) / o.period))
            # An estimate block is a whole number of fine blocks.
            size = max(d for d in range(1, min(wanted, block) + 1) if block % d == 0)
            there = np.isfinite(o.volts.T)
            present = None if there.all() else there.astype(np.float64)
            means = fine_means(np.where(there, o.volts.T, 0.0), size, present)
            self.fine.append(size)
            self.measured.append(means)
            self._present.append(present)
            self.count.append(np.ones_like(means) if present is None else fine_means(present, size))
            case = load_cases(o.loads, o.period)[: means.shape[1] * size : size] + next_case
            next_case = int(case.max()) + 1
            self.case.append(case)
        self.noise = self._noise_beside(self.base)

    def _noise_beside(self, effects: Sequence[ActiveEffect]) -> tuple[NoiseModel, ...]:
        """Return the noise, with the link's motion simulated with ``effects``."""
        out, residuals = list[NoiseModel](), list[FloatArray]()
        self.tally.count += 1
        for i, (o, size) in enumerate(zip(self.observations, self.fine, strict=True)):
            chunk = ForwardModel(o.rig, only_in(sort_effects(effects), i)).expect(o.acting, o.temperature)
            difference = o.volts - chunk.volts.T
            # Coarse steps hide the noise of a reading that rests.
            share = 0.25 if any(a.effect.value_grid for a in effects) else SLIGHT
            floors = np.maximum(share * o.rig.noises.ravel(), o.rig.converter.volts_per_count / np.sqrt(12.0))
            noise = estimate_noise(o, difference, size, floors)
            present = self._present[i]
            rows = difference.T if present is None else np.where(present > 0.0, difference.T, 0.0)
            residuals.append(noise.whiten(fine_means(rows, size, present), self.count[i]))
            out.append(noise)
        corners = corners_of(residuals, self.periods)
        blocks = [o.rig.estimator.block_size * o.period for o in self.observations]
        both = zip(out, residuals, self.periods, blocks, strict=True)
        return tuple(w.with_slow_noise(corners, part.shape[1], period, block) for w, part, period, block in both)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the recordings."""
        return tuple(o.name for o in self.observations)

    @property
    def channels(self) -> tuple[str, ...]:
        """The dots."""
        return dot_names(self.psds)

    @property
    def psds(self) -> int:
        """How many PSDs the rig has."""
        return self.physics.psds

    @property
    def rows(self) -> list[int]:
        """The rows of the dots in a table, as an index."""
        return dot_rows(self.psds)

    @property
    def periods(self) -> list[float]:
        """s between the fine blocks of each recording."""
        return [o.period * size for o, size in zip(self.observations, self.fine, strict=True)]

    def renoised(self, effects: Sequence[ActiveEffect]) -> Self:
        """With the noise as it is with ``effects`` in the model; this one if that is the same."""
        noise = self._noise_beside(effects)
        if all(a.like(b) for a, b in zip(self.noise, noise, strict=True)):
            return self
        out = self.replaced(noise=noise)
        return out.replaced(free=out.whitened(self.free))

    def raw_residual(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        """Measured minus simulated (n, 3P) V of each recording, samples, 0 if lost."""
        self.tally.count += 1
        out = []
        for i, o in enumerate(self.observations):
            chunk = ForwardModel(o.rig, only_in(sort_effects(effects), i)).expect(o.acting, o.temperature)
            difference = o.volts - chunk.volts.T
            out.append(np.where(np.isfinite(difference), difference, 0.0))
        return out

    def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        """Fine-block means (3P, nf) V of each recording, simulated without noise."""
        self.tally.count += 1
        out = []
        for i, (o, size, present) in enumerate(zip(self.observations, self.fine, self._present, strict=True)):
            model = ForwardModel(o.rig, only_in(sort_effects(effects), i))
            means = np.empty((3 * o.psds, len(o.loads) // size))
            for at, samples in self._motions[i].simulated(o, model, size):
                there = None if present is None else present[:, at]
                means[:, at.start // size : at.stop // size] = fine_means(samples.volts, size, there)
            out.append(means)
        return out

    def whiten(self, fine: Sequence[FloatArray]) -> FloatArray:
        """Return one vector of all recordings, white and of unit variance if the noise model holds.

        What is not known of the loads adds to the noise (errors in variables); a free load adds without bound.
        """
        white = self._white(fine)
        if self.free is None:
            return white
        less = 1.0 - 1.0 / np.sqrt(1.0 + self.free.energy)
        return white - self.free.sum(less * self.free.shares(white))

    def _white(self, fine: Sequence[FloatArray]) -> FloatArray:
        parts = [w.whiten(f, c).ravel() for f, w, c in zip(fine, self.noise, self.count, strict=True)]
        return np.concatenate(parts)

    def with_free(self, directions: Sequence[Direction], effects: Sequence[ActiveEffect] = ()) -> Self:
        """With what ``directions`` say free; loads are simulated beside ``effects``."""
        if not directions:
            return self
        beside = [*self.base, *effects]
        loads = [d for d in directions if isinstance(d, LoadDirection)]
        nominal = self.simulate(beside) if loads else self.measured

        def table(d: Direction) -> FloatArray:
            if isinstance(d, LoadDirection):
                # A free load is large: the change by one of its unit, in proportion.
                more = self.with_loads([(d, 1.0)]).simulate(beside)
                return np.concatenate([(d.sd * (a - b)).ravel() for a, b in zip(more, nominal, strict=True)])
            return np.concatenate(
                [t.ravel() for t in d.table(nominal, self.observations[d.recording].rig.sensitivities)]
            )

        tables, nothing = sparse_rows(map(table, directions)), np.zeros((0, 0))
        return self.replaced(free=self.whitened(Free(tuple(directions), tables, tables, nothing, nothing, nothing)))

    def whitened(self, free: Free | None) -> Free | None:
        """``free`` by the noise of this comparison."""
        if free is None:
            return None
        tables = (free.tables[[i]].toarray().ravel() for i in range(len(free.directions)))
        white = sparse_rows(self._white(self.split(t)) for t in tables)
        energy, vectors = np.linalg.eigh((white @ white.T).toarray())
        observable = energy > max(1e-6, 1e-14 * float(energy.max()))
        energy, vectors = energy[observable], vectors[:, observable]
        back = np.array([d.sd for d in free.directions])[:, None] * vectors
        return Free(free.directions, free.tables, white, vectors / np.sqrt(energy), energy, back)

    def with_loads(self, more: Sequence[tuple[Direction, float]]) -> Self:
        """With the loads changed."""
        out = self
        for recording, change, swings in added(more):
            if swings:
                out = out._swung(recording, change)
            else:
                out = out.loaded(recording, out.observations[recording].loads + change)
        return out

    def loaded(self, recording: int, loads: FloatArray) -> Self:
        """With other ``loads`` (n, 3) N, N, N m of one recording."""
        o = self.observations[recording]
        return self._with(recording, dataclasses.replace(o, loads=loads, digest=o.digest or o.hashed()))

    def _swung(self, recording: int, more: FloatArray) -> Self:
        """With ``more`` (n, 3) N, N, N m of what swung in one recording."""
        o = self.observations[recording]
        swing = more if o.swing is None else o.swing + more
        return self._with(recording, dataclasses.replace(o, swing=swing, digest=o.digest or o.hashed()))

    def _with(self, recording: int, observation: Observation) -> Self:
        observations = list(self.observations)
        observations[recording] = observation
        return self.replaced(observations=tuple(observations))

    @property
    def directions(self) -> tuple[Direction, ...]:
        """What is free."""
        return () if self.free is None else self.free.directions

    @property
    def free_loads(self) -> bool:
        """Whether a load or its time is free."""
        return any(isinstance(d, LoadDirection) for d in self.directions)

    def refitted(self, difference: Sequence[FloatArray]) -> Self:
        """With the free loads as the ``difference`` of a fit, measured minus simulated, asks for."""
        if self.free is None or not self.free_loads:
            return self
        more = self._implied_loads(self.free, difference)
        return self.with_loads(more).replaced(free=dataclasses.replace(self.free, directions=moved(more)))

    def refitted_beside(self, difference: Sequence[FloatArray], effects: Sequence[ActiveEffect]) -> Self:
        """The same, with what one more of each does beside the ``effects``, if more than noise is left to settle."""
        if self.free is None or not self.free_loads or self.gap(difference) <= (1.0 + MINOR) * self.floor():
            return self
        more = self._implied_loads(self.free, difference)
        return self.with_loads(more).with_free(moved(more), effects)

    def _implied_loads(self, free: Free, difference: Sequence[FloatArray]) -> list[tuple[Direction, float]]:
        sizes = free.back @ (np.sqrt(free.energy) / (1.0 + free.energy) * free.shares(self._white(difference)))
        return list(zip(free.directions, sizes.tolist(), strict=True))

    def direction_sd(self) -> dict[tuple[int, int], float]:
        """Standard deviations of the free loads by the noise, by the id of what each belongs to, and its axis."""
        if self.free is None:
            return {}
        sd = np.sqrt((self.free.back**2 / (1.0 + self.free.energy)).sum(axis=1)).tolist()
        both = zip(self.free.directions, sd, strict=True)
        return {(id(d.of), d.axis): v for d, v in both if isinstance(d, LoadDirection)}

    @property
    def size(self) -> int:
        """Elements of a vector that carry data."""
        return sum(int(np.count_nonzero(c)) for c in self.count)

    def effective_size(self) -> float:
        """Sample size for BIC: blocks of the estimate and channels (N over correlation time)."""
        return sum(
            float(c.sum()) * s / o.rig.estimator.block_size
            for c, s, o in zip(self.count, self.fine, self.observations, strict=True)
        )

    def block_dots(self, fine: Sequence[FloatArray]) -> list[FloatArray]:
        """Block means of the dots (2P, blocks), m, of fine-block volts; NaN if less than half of the block is there."""
        out = []
        for f, c, s, o in zip(fine, self.count, self.fine, self.observations, strict=True):
            per_block = o.rig.estimator.block_size // s
            share = fine_means(c[self.rows], per_block)
            total = fine_means(f[self.rows] * c[self.rows], per_block)
            means = np.where(share >= 0.5, total / np.maximum(share, 0.5), np.nan)
            out.append(means * o.rig.sensitivities.reshape(-1, 1))
        return out

    def gap(self, residual: Sequence[FloatArray]) -> float:
        """rms of the block-mean residual over x1 y1 x2 y2 ..., m; ``residual`` in fine-block volts."""
        blocks = np.concatenate([b.ravel() for b in self.block_dots(residual)])
        blocks = blocks[np.isfinite(blocks)]
        return float(np.sqrt(np.mean(blocks**2))) if len(blocks) else 0.0

    def gap_per_channel(self, residual: Sequence[FloatArray]) -> FloatArray:
        """Return the same for each of x1 y1 x2 y2 ..., (2P,) m."""
        blocks = np.concatenate(self.block_dots(residual), axis=1)
        there = np.isfinite(blocks)
        return np.asarray(np.sqrt(np.where(there, blocks**2, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)))

    def floor(self) -> float:
        """Return the gap from noise alone, m."""
        total, count = 0.0, 0
        for w, o, c, s in zip(self.noise, self.observations, self.count, self.fine, strict=True):
            share = fine_means(c[self.rows], o.rig.estimator.block_size // s)
            variance = (w.block_sigma[self.rows] * o.rig.sensitivities.ravel())[:, None] ** 2
            valid = share >= 0.5
            # A block with some samples missing is noisier.
            total += float((variance / np.maximum(share, 0.5))[valid].sum())
            count += int(valid.sum())
        return float(np.sqrt(total / max(count, 1)))

    def pieces(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Log-likelihood that residual ``b`` gains over ``a`` (D,), in pieces of ``REST_S``."""
        out: list[FloatArray] = []
        for part, o, size in zip(self.split(0.5 * (a * a - b * b)), self.observations, self.fine, strict=True):
            length = max(1, round(REST_S / (o.period * size)))
            total = part.sum(axis=0)
            out.append(np.add.reduceat(total, np.arange(0, len(total), length)))
        return np.concatenate(out)

    def unwhitened(self, white: FloatArray) -> list[FloatArray]:
        """Fine-block volts of a change that is slow compared with a fine block: a scaling per channel."""
        return [noise.of_slow_change(part) for part, noise in zip(self.split(white), self.noise, strict=True)]

    def folds(self) -> IntArray:
        """Whole recordings if there are enough, else load cases in turn, so that each fold has several kinds."""
        count = max(int(c.max()) for c in self.case) + 1
        if len(self.case) < FOLDS:
            return np.arange(count) % min(FOLDS, count)
        out = np.zeros(count, dtype=np.int64)
        for i, cases in enumerate(self.case):
            out[cases] = i
        return out

    @property
    def unit(self) -> str:
        """Metres."""
        return 'm'

    @property
    def display_scale(self) -> tuple[float, str]:
        """Micrometres."""
        return 1e6, 'µm'

    @property
    def display_units(self) -> tuple[str, ...]:
        """Micrometres."""
        return ('µm',) * len(self.channels)

    def displayed(self, tables: Sequence[FloatArray]) -> list[FloatArray]:
        """Block means of the dots (2P, blocks), µm."""
        return [1e6 * d for d in self.block_dots(tables)]

    def along(self) -> tuple[TimeAxis, list[FloatArray]]:
        """Time, recordings one after another, block by block."""
        times: list[FloatArray] = []
        marks: list[Moment] = []
        start = 0.0
        for o, dots in zip(self.observations, self.block_dots(self.measured), strict=True):
            middles = (np.arange(dots.shape[1]) + 0.5) * o.rig.estimator.block_size * o.period
            times.append(np.asarray(start + middles, dtype=np.float64))
            marks += [mark._replace(t=start + mark.t) for mark in o.marks]
            start += o.duration
        return TimeAxis(ONE_AFTER_ANOTHER, marks), times

    def against(self) -> dict[str, list[FloatArray]]:
        """Loads and the dots as measured, block by block."""
        out: dict[str, list[FloatArray]] = {}
        for o, dots in zip(self.observations, self.block_dots(self.measured), strict=True):
            size, n = o.rig.estimator.block_size, dots.shape[1]
            for name, row in zip(LOADS_SHOWN, fine_means(o.loads.T, size), strict=True):
                out.setdefault(name, []).append(row[:n])
            for name, row in zip(self.channels, dots, strict=True):
                out.setdefault(f'{name} / mm', []).append(1e3 * row)
        return out

    def provenance(self) -> list[dict[str, object]]:
        """Of each recording: hash, length, noise."""
        return [
            {
                'name': o.name,
                'sha256': o.digest or o.hashed(),
                'seconds': o.duration,
                'rest_seconds': w.rest_seconds,
                'noise_v': [float(s) for s in w.sigma],
                'coloured': list(w.coloured),
                'corners_hz': w.corners.tolist(),
            }
            for o, w in zip(self.observations, self.noise, strict=True)
        ]
