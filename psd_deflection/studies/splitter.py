# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Two lasers over one beam splitter (thesis 5.4), one half of their beam for each PSD: together at most twice the power
of one PSD; half of one is enough for both; the second may be a cold spare. What a failure does is simulated."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.health import HALF_LIGHT
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import BlockStatus, DeflectionEstimate, FloatArray, RawChunk, Record, SpotMeans
from psd_deflection.rig.config import Rig, replace_values

BEFORE_S, AFTER_S = 6.0, 2.0
"""Simulated time before the failure, in which the noise is measured, and after everything has settled."""
LOAD = (0.0, -10.0, 1.0)
"""N, N, N m: held all the time, so that the dots are off the middle."""


@dataclass(frozen=True, slots=True)
class Lasers:
    """Powers of the two lasers, W; what one PSD is ``allowed`` to get, W; until a spare has its power, s: ``warm_up``.

    ``apart``: along X, from the dot of laser 1 to that of laser 2 on each PSD, m. Raises ConfigError for a value that
    cannot be.
    """

    powers: tuple[float, float]
    allowed: float
    warm_up: float = 1.0
    apart: float = 1e-3

    def __post_init__(self) -> None:
        for name, value in (*(('splitter', power) for power in self.powers), ('allowed', self.allowed)):
            if not 0.0 < value < 1e3:
                raise ConfigError(f'{name} = {value} W: must be above 0 and below 1000')
        if not 0.0 <= self.warm_up <= 60.0:
            raise ConfigError(f'warm_up = {self.warm_up} s: must be at least 0 and at most 60')
        if not abs(self.apart) <= 5e-3:
            raise ConfigError(f'apart = {self.apart} m: must be at least -0.005 and at most 0.005')


class SplitterRule(NamedTuple):
    """One rule. ``value`` and ``limit``: what is compared; ``unit`` of both; ``satisfied``: whether it holds."""

    words: str
    value: float
    limit: float
    unit: str
    satisfied: bool

    def tree(self) -> dict[str, str | float | bool]:
        """For JSON."""
        return dict(zip(('words', 'value', 'limit', 'unit', 'satisfied'), self, strict=True))


class LightPhase(NamedTuple):
    """What a simulated rig does in one phase.

    ``estimates``: share of blocks with one; ``status`` of most blocks; ``deviations`` (3,): stated, m, m, rad;
    ``off``, ``scatter`` (3,): mean and standard deviation of the errors, m, m, rad; ``largest``: largest error about
    their mean, in stated deviations (0 without estimates); ``message``: the finding, or ''.
    """

    name: str
    estimates: float
    status: BlockStatus
    deviations: FloatArray
    off: FloatArray
    scatter: FloatArray
    largest: float
    message: str


def rules(rig: Rig, lasers: Lasers) -> list[SplitterRule]:
    """Return the three rules, the second and the third for each laser."""
    amplifier, least = rig.amplifier.sum_nominal, 0.5 * rig.estimator.sum_min
    both = sum(lasers.powers)
    out = [SplitterRule('both together', both, 2.0 * lasers.allowed, 'W', both <= 2.0 * lasers.allowed)]
    for i, power in enumerate(lasers.powers, 1):
        sum_signal = amplifier * power / both
        out.append(SplitterRule(f'laser {i} alone is enough: sum signal', sum_signal, least, 'V', sum_signal >= least))
    # The page and the covariance know of the failure by this.
    shares = [power / both for power in lasers.powers]
    low, high = HALF_LIGHT
    out.append(SplitterRule('a failure is noticed: smaller share', min(shares), low, '', low < min(shares) <= high))
    for i, power in enumerate(lasers.powers, 1):
        satisfied = power <= 2.0 * lasers.allowed
        out.append(SplitterRule(f'as spares: laser {i}', power, 2.0 * lasers.allowed, 'W', satisfied))
    spare = amplifier * lasers.powers[1] / lasers.powers[0]
    satisfied = rig.estimator.sum_min <= spare <= rig.estimator.sum_max
    out.append(SplitterRule('the spare is like the first: sum signal', spare, rig.estimator.sum_max, 'V', satisfied))
    return out


def simulated(rig: Rig, lasers: Lasers, seed: int = 1) -> list[LightPhase]:
    """Both lasers; one out; the first alone; its spare cold; the spare warm: each as the pipeline sees it.

    The zero is that of the first phase: of both dots, or of the first one.
    """
    rig = replace_values(rig, {'splitter': True})
    first, second = lasers.powers
    both = first + second
    # Two lasers are read at the centroid of their light.
    sum_signal = lasers.apart * first / both
    together = _run(
        rig, (('both lasers', BEFORE_S, 1.0, 0.0), ('laser 1 out', AFTER_S, second / both, sum_signal)), seed
    )
    cold = [('laser 1 out, its spare cold', lasers.warm_up, 0.0, 0.0)] if lasers.warm_up else []
    alone = (('laser 1 alone', BEFORE_S, 1.0, 0.0), *cold, ('its spare', AFTER_S, second / first, lasers.apart))
    return [*together, *_run(rig, alone, seed + 1)]


def _run(rig: Rig, phases: Sequence[tuple[str, float, float, float]], seed: int) -> Iterator[LightPhase]:
    """Of phases with a name, so many seconds, that share of the nominal light, and so far along X from the zero, m."""
    rate, size = rig.converter.sample_rate_hz, rig.estimator.block_size
    counts = [round(phase[1] * rate) for phase in phases]
    share, aside = (np.repeat([phase[i] for phase in phases], counts) for i in (2, 3))
    made = RigSimulator(rig, seed).step(np.tile(LOAD, (len(share), 1)))
    read = np.asarray(made.counts * rig.converter.volts_per_count, np.float64)
    read[:, 0::3] += aside[:, None] / rig.sensitivities[:, 0]
    volts = lit(rig, read, share, np.random.default_rng(seed))
    seq = np.arange(len(share))
    t_ns = np.round(seq * 1e9 / rate).astype(np.int64)
    chunk = RawChunk(seq, t_ns, volts.astype(np.float32), np.zeros(len(seq), np.uint8))
    records = list(Pipeline(rig).process(chunk))
    begin = 0
    for (name, *_), count in zip(phases, counts, strict=True):
        # Without the blocks in which the light changes, and those in which the noise is not measured yet.
        first = -(-begin // size) + 1 if begin else count // size // 2
        begin += count
        yield _phase(name, range(first, begin // size), records, made.pose, size)


def lit(rig: Rig, volts: FloatArray, share: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Volts (n, 3P) of PSDs that get the ``share`` (n,) of the light by which ``volts``, V, were read."""
    out, dark = volts.copy(), share <= 0.0
    more = np.sqrt(np.maximum(1.0 / np.where(dark, 1.0, share) ** 2 - 1.0, 0.0))
    drawn = rng.standard_normal(volts.shape)
    for psd, noise in enumerate(rig.noises):
        for axis in (0, 1):
            column = 3 * psd + axis
            out[:, column] += more * noise[axis] * drawn[:, column]
            out[dark, column] = noise[axis] * drawn[dark, column]
        out[:, 3 * psd + 2] *= share
    return out


def _phase(name: str, blocks: range, records: Sequence[Record], pose: FloatArray, size: int) -> LightPhase:
    """What the ``records`` say of ``blocks`` of ``size`` samples, whose true poses are ``pose`` (n, 3)."""
    spots = [r for r in records if isinstance(r, SpotMeans) and r.index in blocks]
    estimates = [r for r in records if isinstance(r, DeflectionEstimate) and r.primary and r.block in blocks]
    statuses = [s.status for s in spots]
    status = max(set(statuses), key=statuses.count)
    message = next((s.findings[0] for s in spots if s.findings), '')
    if not estimates:
        none = np.full(3, np.nan)
        why = next((s.reason for s in spots if s.reason), message)
        return LightPhase(name, 0.0, status, none, none, none, 0.0, why)
    sds = np.sqrt([r.variances for r in estimates])
    middle = np.array([size * r.block + (size - 1) // 2 for r in estimates])
    # Between two samples if their number is even.
    there = 0.5 * (pose[middle] + pose[middle + 1 - size % 2])
    errors = np.array([r.pose for r in estimates]) - there
    off, scatter = errors.mean(axis=0), errors.std(axis=0)
    largest = float((np.abs(errors - off) / sds).max())
    return LightPhase(
        name, len(estimates) / len(blocks), status, np.median(sds, axis=0), off, scatter, largest, message
    )
