# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How often the truth is inside the intervals that are published: ``python -m blind.coverage --help``.

One table. A row holds if 0.93 to 0.97 (to two digits) of the blocks have the truth inside, each axis and jointly; or
more have ("wide"); or 99 % of the blocks with an error beyond 3 standard deviations (sd) have a finding ("named"),
those aside that chance makes: 0.27 % of the errors of an axis.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import poisson

from blind import generator
from blind import motion as moving
from blind.campaign import options, over
from blind.generator import Array
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import DeflectionEstimate, RawChunk, SpotMeans
from psd_deflection.rig.config import Rig, load_rig

SIZE = 20
CHI_SQUARE_3 = 7.814728  # 95 % of a chi-square of 3 degrees of freedom.
BEYOND_3 = 0.0027  # Share of errors beyond 3 standard deviations.
SETTLED = 100  # Blocks before the noise is measured; they are not counted at rest.
SHIFTS = ((0.31372e-3, -0.27182e-3), (0.16180e-3, 0.46692e-3))
"""Where the PSDs are off their places, so that no reading stands in the middle of a converter's step, m."""
RISE = 10.0  # K.
DRIFT = ({'x': 0.4e-6, 'y': -0.3e-6}, {'x': -0.2e-6, 'y': 0.4e-6})
"""Of the dots of each PSD, m/K: up to 40 ppm/K of its half width of 10 mm, as makers state it."""
LOSSES = {'none': (0.0, 0), '2 %': (0.02, 0), '20 %': (0.2, 0), 'bursts of 8': (0.0, 8)}
IN_STEP = {'14 to 19': range(14, 20), '12 to 19': range(12, 20), '0 to 7': range(8), '6 to 13': range(6, 14)}
"""Places of a block whose samples a device that stalls in step loses."""


@dataclass(frozen=True, slots=True)
class Row:
    """One rig: rms noise of all channels V, AR(1) memory, hum V at ``mains`` Hz, bits, offsets of x1, y1, x2, y2 V.
    ``stated``: the rig file has that noise. ``corner``: Hz, where 1/f noise is as much as the white."""

    label: str
    sigmas: tuple[float, ...] = (2e-3,) * 6
    memory: float = 0.0
    heavy: bool = False
    hum: float = 0.0
    mains: float = 60.0
    bits: int = 16
    offsets: tuple[float, ...] = ()
    stated: bool = False
    corner: float = 0.0


ROWS = (
    Row('white'),
    *(Row(f'AR(1) {memory}', memory=memory) for memory in (0.3, 0.6, 0.9)),
    Row('twice the noise', sigmas=(4e-3,) * 6),
    *(Row(f'hum 10 mV, {hz:g} Hz', hum=10e-3, mains=hz) for hz in (49.5, 49.9, 50.0, 50.1, 50.5, 60.0)),
    *(Row(f'{bits} bit', bits=bits) for bits in (12, 24)),
    Row('heavy tails', heavy=True),
    Row('offsets, zeroed', offsets=(1e-3, -2e-3, 0.5e-3, 1.5e-3)),
    Row('1, 2, 4, 2 mV', sigmas=(1e-3, 2e-3, 2e-3, 4e-3, 2e-3, 2e-3)),
    Row('unequal channels', sigmas=(1e-3, 2e-3, 2e-3, 4e-3, 2e-3, 2e-3), stated=True),
)
UNEQUAL = ROWS[-1]
HUMS = (1.0, 0.8, 1.0, 0.9, 1.1, 1.0)  # Shares of the hum that the channels have.
SLOW = (Row('1/f, corner 1 Hz', corner=1.0), Row('1/f, corner 10 Hz', corner=10.0))  # Not covered in full.
TONES = (5.0, 14.0, 20.0, 28.0, 36.0, 44.0, 48.0, 75.0, 87.0, 130.0, 180.0, 300.0, 480.0)  # Hz of a steady vibration.
SHAKEN = (8e-6, 20e-6, 0.1e-3)  # Its amplitudes: dX, dY m, theta rad, each with a phase of its own.
SIZES = (0.015, 0.05, 0.15, 1.0)  # Times these.
RANDOM = ((0, 40, 3e-6), (108, 132, 3e-6), (108, 132, 0.5e-6))  # Bands, Hz, and rms of each axis, m.
LOUDER, EVERY = (0.5, 1.0, 2.0, 4.0), (2, 4, 20)  # Times the noise at rest; s from one change of the load to the next.


class Inside(NamedTuple):
    """Shares of the blocks whose truth is inside 95 % (dX, dY, theta, all three jointly) and inside 3 sd.

    ``rms`` error, ``sd``: median of the published ones (dX, dY, theta: m, m, rad). ``named``: share of the blocks that
    have a finding; ``reported``: of those whose error is beyond 3 sd, NaN if there are none. ``chance``: whether blocks
    without a finding have no more errors beyond 3 sd than chance makes."""

    axes: tuple[float, float, float]
    joint: float
    three: float
    rms: tuple[float, float, float]
    blocks: int
    sd: tuple[float, float, float]
    named: float
    reported: float
    chance: bool

    @property
    def held(self) -> str:
        """Return why the row holds: "yes" in the band, "wide" above it, "named"; "**no**" if it does not."""
        shares = [round(v, 2) for v in (*self.axes, self.joint)]
        if min(shares) >= 0.93 and max(shares) <= 0.97:
            return 'yes'
        if min(shares) >= 0.93 and self.chance:
            return 'wide'
        return 'named' if self.chance or not self.reported < 0.99 else '**no**'

    def line(self, *labels: str) -> str:
        """Return a row of the table."""
        shares = [f'{v:.3f}' for v in (*self.axes, self.joint)]
        sizes = f'{self.three:.4f} | {1e6 * self.rms[1]:.2f} | {1e6 * self.sd[1]:.2f} | {self.named:.3f}'
        unnamed = 'none beyond' if np.isnan(self.reported) else f'{self.reported:.3f}'
        return '| ' + ' | '.join((*labels, *shares, sizes, unnamed, self.held)) + ' |'


HEAD = '| case | | ΔX | ΔY | θ | joint | within 3 sd | ΔY: rms error, µm | sd, µm | finding | beyond 3 sd | held |'


class Run(NamedTuple):
    """The primary estimates of a recording against the truth: ``error`` (k, 3), ``covariance`` (k, 3, 3), ``block``
    (k,), and the ``findings`` of each block; ``alarms``: share of the blocks said to contradict each other."""

    error: Array
    covariance: Array
    block: npt.NDArray[np.int_]
    findings: list[str]
    alarms: float

    def inside(self, first: int = 0, last: int | None = None) -> Inside:
        """Score the blocks from ``first`` to before ``last``."""
        return pooled([self], first, last)


class Scored(NamedTuple):
    """At rest and ringing; ``alarms``: share of the blocks whose readings are said to contradict each other."""

    rest: Inside
    ringing: Inside
    alarms: float


def pooled(runs: Sequence[Run], first: int = 0, last: int | None = None) -> Inside:
    """Score all ``runs`` together, of each the blocks from ``first`` to before ``last``."""
    here = [(r.block >= first) & (r.block < (r.block[-1] + 1 if last is None else last)) for r in runs]
    error = np.concatenate([r.error[h] for r, h in zip(runs, here, strict=True)])
    covariance = np.concatenate([r.covariance[h] for r, h in zip(runs, here, strict=True)])
    named = np.concatenate([np.array(r.findings)[h] != '' for r, h in zip(runs, here, strict=True)])
    sd = np.sqrt(np.einsum('nii->ni', covariance))
    size = np.abs(error) / sd
    joint = np.einsum('ni,ni->n', error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    a, b, c = (size < 1.959964).mean(axis=0).tolist()
    x, y, t = np.sqrt((error**2).mean(axis=0)).tolist()
    u, v, w = np.median(sd, axis=0).tolist()
    outliers = (size > 3.0).any(axis=1)
    reported = float(named[outliers].mean()) if outliers.any() else float('nan')
    errors = size[~named].size
    chance = bool((size[~named] > 3.0).sum() <= poisson.ppf(1.0 - BEYOND_3 / 2.0, BEYOND_3 * errors))
    three = float((size < 3.0).mean())
    shares = float((joint < CHI_SQUARE_3).mean()), three
    return Inside((a, b, c), *shares, (x, y, t), len(error), (u, v, w), float(named.mean()), reported, chance)


def rig(row: Row, **overrides: object) -> Rig:
    """Return the nominal rig with that converter; its noise stays 2 mV, white, unless the row's is stated."""
    values: dict[str, object] = {'solver': 'exact', 'solvers': ['exact'], 'converter.bits': min(row.bits, 16)}
    for i, (shift, place) in enumerate(zip(SHIFTS, generator.PLACES, strict=True), start=1):
        values[f'psd_{i}.center'] = [p + s for p, s in zip(place, shift, strict=True)]
        values[f'psd_{i}.zero'] = [-s for s in shift]
        if row.stated:
            values[f'psd_{i}.noise'] = list(row.sigmas[3 * i - 3 : 3 * i - 1])
    return load_rig(overrides={**values, **overrides})


def stepped(rest_s: int, steps: int, every_s: int = 5) -> Array:
    """Poses on the fine grid: at rest, then 50 N on the sidebar on and off ``every_s``."""
    n, dwell = rest_s * 1000, every_s * 1000
    loads = np.zeros((n + steps * dwell, 3))
    for step in range(0, steps, 2):
        # Off the blocks' grid, each at another place in its block.
        loads[n + step * dwell + 7 * step % SIZE :][:dwell] = (0.0, -50.0, -29.25)
    return generator.motion(loads, 0.585, [])


@cache
def motion(rest_s: int, steps: int, every_s: int = 5, size: int = SIZE) -> tuple[Array, Array]:
    """Volts (n, 6) without noise and poses at the middles of blocks of ``size``."""
    fine = stepped(rest_s, steps, every_s)
    return optics_of(fine), middles(fine, size)


def optics_of(fine: Array, warm: Array | None = None, effects: Sequence[generator.Spec] = ()) -> Array:
    """Volts (n, 6) without noise; ``warm``: K above the first temperature, for ``effects`` of the sensors."""
    none = np.zeros(len(fine))
    places = ({'psd': i, 'x': x, 'y': y} for i, (x, y) in enumerate(SHIFTS, 1))
    shifted = [{'name': 'sensor_position', 'aimed': False, **place} for place in places]
    dots = generator.optics(fine, none, none, 0.585, shifted)
    m, light = generator.sensors(dots, none, none if warm is None else warm, effects)
    return generator.electronics(m, light, none, [])


def middles(fine: Array, size: int = SIZE) -> Array:
    """Poses at the blocks' middles (n, 3), by the cubic through the four fine places about each."""
    at = generator.FINER * (np.arange(len(fine) // (size * generator.FINER)) * size + 0.5 * (size - 1))
    i = np.clip(np.floor(at).astype(int), 1, len(fine) - 3)
    u = (at - i)[:, None]
    a, b, c, d = (fine[i + k] for k in (-1, 0, 1, 2))
    weights = -u * (u - 1) * (u - 2) / 6, (u + 1) * (u - 1) * (u - 2) / 2, -(u + 1) * u * (u - 2) / 2
    return np.asarray(weights[0] * a + weights[1] * b + weights[2] * c + (u + 1) * u * (u - 1) / 6 * d)


def volts_of(row: Row, clean: Array, seed: int) -> Array:
    """What the converter gives, (n, 6) V."""
    out = clean + generator.electronic_noise(len(clean), seed, sigmas=row.sigmas, memory=row.memory, heavy=row.heavy)
    if row.corner:
        flicker = generator.flicker(len(clean), row.corner, np.random.default_rng(seed))
        out = clean + np.asarray(row.sigmas) * flicker
    t = np.arange(len(clean)) / generator.RATE
    out += row.hum * np.sin(2.0 * np.pi * row.mains * t)[:, None] * HUMS
    if row.offsets:
        out[:, [0, 1, 3, 4]] += row.offsets
    return generator.output(out, [], row.bits)


def run(
    pipeline: Pipeline, volts: Array, truth: Array, here: npt.NDArray[np.bool_] | None = None, *, zero_at: int = 0
) -> Run:
    """Return the primary estimates of samples (n, 6) V of which ``here`` (n,) arrive; zeroed at block ``zero_at``."""
    seq = np.arange(len(volts)) if here is None else np.flatnonzero(here)
    first, then = np.split(seq, [int(np.searchsorted(seq, zero_at * SIZE))])
    records = _records(pipeline, first, volts)
    if records:
        pipeline.zero()
    return _compared(pipeline, records + _records(pipeline, then, volts), truth)


def _records(pipeline: Pipeline, part: npt.NDArray[np.int_], volts: Array) -> list[object]:
    chunk = RawChunk(part, part * 1_000_000, volts[part].astype(np.float32), np.zeros(len(part), np.uint8))
    return [r for r in pipeline.process(chunk) if isinstance(r, DeflectionEstimate | SpotMeans)]


def _compared(pipeline: Pipeline, records: Sequence[object], truth: Array) -> Run:
    estimates = [r for r in records if isinstance(r, DeflectionEstimate) and r.primary]
    findings = {r.index: ', '.join(r.findings) for r in records if isinstance(r, SpotMeans)}
    block = np.array([e.block for e in estimates])
    error = np.array([(e.dx, e.dy, e.theta) for e in estimates]) - truth[block]
    covariance = np.array([e.covariance for e in estimates]).reshape(-1, 3, 3)
    alarms = pipeline.estimator.contradictions / len(estimates)
    return Run(error, covariance, block, [findings[b] for b in block.tolist()], alarms)


def score(
    row: Row, loss: str, *, rest_s: int = 100, steps: int = 16, seed: int = 1, size: int = SIZE, **more: object
) -> Scored:
    """At rest from block 200 on, then a step of 50 N every 5 s."""
    clean, truth = motion(rest_s, steps, size=size)
    here = ~np.isin(np.arange(len(clean)) % SIZE, list(IN_STEP.get(loss, ())))
    if loss in LOSSES:
        here = generator.present(len(clean), seed + 1000, *LOSSES[loss])
    pipeline = Pipeline(rig(row, block_size=size, **more))
    got = run(pipeline, volts_of(row, clean, seed), truth, here, zero_at=SETTLED if row.offsets else 0)
    first = rest_s * 1000 // size
    return Scored(got.inside(2 * SETTLED, first), got.inside(first), got.alarms)


def louder(times: float, every_s: int, rest_s: int = 10, seed: int = 1) -> Inside:
    """``rest_s`` at rest; then so many ``times`` the noise, while the load changes ``every_s``. Counted from 10 s later
    on."""
    clean, truth = motion(rest_s, 40 // every_s, every_s)
    volts = volts_of(ROWS[0], clean, seed)
    first = rest_s * 1000
    row = Row('changed', sigmas=tuple(times * s for s in ROWS[0].sigmas))
    volts[first:] = volts_of(row, clean, seed + 1)[first:]
    return run(Pipeline(rig(row)), volts, truth).inside((first + 10_000) // SIZE)


def drifting(readings: Sequence[int], seconds: int = 60, seed: int = 1) -> Inside:
    """At rest, while the dots' ``readings`` (0 to 3: x1, y1, x2, y2) drift by 0.02 um/s."""
    fine = np.zeros((seconds * 1000 * generator.FINER, 3))
    clean = optics_of(fine)
    slope = np.isin(np.arange(6), [(0, 1, 3, 4)[k] for k in readings]) * 2e-8 / generator.MM_PER_V
    volts = volts_of(ROWS[0], clean + slope * (np.arange(len(clean)) / generator.RATE)[:, None], seed)
    return run(Pipeline(rig(ROWS[0])), volts, middles(fine)).inside(2 * SETTLED)


def warming(reported: bool = True, rest_s: int = 60, steps: int = 8, seed: int = 1) -> Scored:
    """Readings that drift with temperature by what makers of PSDs state, ``DRIFT``, while it rises by ``RISE``.
    ``reported``: the rig file has the drift, and the temperature is told once a second, to 0.1 K."""
    n, fine = rest_s * 1000, stepped(rest_s, steps)
    warm = np.linspace(0.0, RISE, len(fine))
    names = [{'name': 'thermal_drift', 'psd': psd, **drift} for psd, drift in enumerate(DRIFT, 1)]
    volts = volts_of(ROWS[0], optics_of(fine, warm, names), seed)
    known = {f'effects.drift_{drift["psd"]}.{key}': value for drift in names for key, value in drift.items()}
    pipeline = Pipeline(rig(ROWS[0], **(known if reported else {})))
    records: list[object] = []
    for second, part in enumerate(np.split(np.arange(len(volts)), len(volts) // 1000)):
        if reported:
            pipeline.temperature(20.0 + round(float(warm[second * 1000 * generator.FINER]), 1))
        records += _records(pipeline, part, volts)
    got = _compared(pipeline, records, middles(fine))
    return Scored(got.inside(2 * SETTLED, n // SIZE), got.inside(n // SIZE), got.alarms)


def on_a_moving_base(seconds: int = 60, seed: int = 1) -> Inside:
    """A link without load whose base turns, as :func:`blind.motion.swung` moves it; its accelerations are told."""
    made, pipeline = moving.make('joint', float(seconds), seed), Pipeline(moving.rig_of())
    reported = list(made.reported)
    records: list[object] = []
    for part in np.split(np.arange(len(made.volts)), len(made.volts) // SIZE):
        while reported and reported[0].t_ns < int(part[-1] + 1) * 1_000_000:
            pipeline.accelerate(reported.pop(0))
        records += _records(pipeline, part, made.volts)
    return _compared(pipeline, records, generator.between(made.pose)).inside(int(moving.REST * generator.RATE) // SIZE)


def shaken(hz: float, seconds: int = 60, seed: int = 1, size: float = 1.0) -> Run:
    """A link without load that vibrates with that frequency and ``size`` times ``SHAKEN``, from the first sample on."""
    t = np.arange(seconds * int(generator.RATE) * generator.FINER) / (generator.RATE * generator.FINER)
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 3)
    fine = np.sin(2.0 * np.pi * hz * t[:, None] + phases) * SHAKEN * size
    return run(Pipeline(rig(ROWS[0])), volts_of(ROWS[0], optics_of(fine), seed), middles(fine))


def tones(hz: float, size: float) -> Inside:
    """Eight runs of 16 s of :func:`shaken`, each with phases and noise of its own."""
    return pooled([shaken(hz, 16, seed, size) for seed in range(1, 9)], 2 * SETTLED)


def random_motion(low: float, high: float, rms: float, seconds: int = 60, seed: int = 1) -> Inside:
    """A link without load whose dX and dY move at random, ``rms`` m, in a band from ``low`` to ``high``, Hz."""
    rng = np.random.default_rng(seed)
    n = seconds * 1000 * generator.FINER
    f = np.fft.rfftfreq(n, 1.0 / (generator.RATE * generator.FINER))[:, None]
    fine = np.zeros((n, 3))
    fine[:, :2] = np.fft.irfft(np.fft.rfft(rng.normal(size=(n, 2)), axis=0) * ((f >= low) & (f <= high)), n, axis=0)
    fine[:, :2] *= rms / fine[:, :2].std(axis=0)
    return run(Pipeline(rig(ROWS[0])), volts_of(ROWS[0], optics_of(fine), seed), middles(fine)).inside(2 * SETTLED)


def coarse(poses: int = 150, seed: int = 1, *, reported: bool = True, **overrides: object) -> Inside:
    """Return a 10 bit converter, whose step is ten times the noise: the last 20 blocks of 120 in each of many poses.
    ``reported``: the rig file says so, not 16 bit."""
    rng, row = np.random.default_rng(seed), Row('10 bit', bits=10)
    more = {'converter.bits': 10 if reported else 16, **overrides}
    runs = []
    for _ in range(poses):
        pose = rng.uniform(-1.0, 1.0, 3) * (1e-3, 1e-3, 1e-2)
        volts = volts_of(row, optics_of(np.tile(pose, (120 * SIZE * generator.FINER, 1))), int(rng.integers(1 << 30)))
        runs.append(run(Pipeline(rig(row, **more)), volts, np.tile(pose, (120, 1))))
    return pooled(runs, 100)


def bound(row: Row) -> Array:
    """Least rms error (3,) that white noise of that size and 16 bits leave in a mean of 20 samples (Cramer-Rao)."""
    (x1, y1), (x2, y2) = generator.PLACES
    a = np.array([[-1.0, 0.0, y1], [0.0, -1.0, -x1], [-1.0, 0.0, y2], [0.0, -1.0, -x2]])
    sigmas = np.array(row.sigmas)[[0, 1, 3, 4]]
    variances = generator.MM_PER_V**2 * (sigmas**2 + generator.LSB**2 / 12.0) / SIZE
    return np.asarray(np.sqrt(np.linalg.inv((a.T / variances) @ a).diagonal()))


def over_the_bound(row: Row, solvers: Sequence[str], rest_s: int = 400, seed: int = 1) -> dict[str, Array]:
    """rms error (3,) of each solver on a link at rest over :func:`bound`."""
    fine = np.zeros((rest_s * 1000 * generator.FINER, 3))
    volts, truth = volts_of(row, optics_of(fine), seed), middles(fine)
    errors = {name: run(Pipeline(rig(row, solver=name, solvers=[name])), volts, truth).error for name in solvers}
    return {name: np.sqrt(np.square(error).mean(axis=0)) / bound(row) for name, error in errors.items()}


def fault(kind: str, channel: int, load: tuple[float, float, float], seed: int = 1) -> tuple[float, str]:
    """Largest error in own standard deviations of any estimate of a rig with one wrong reading, and what is named.
    ``kind``: dead, stuck, inverted (``channel`` 0 to 3: x1, y1, x2, y2) or swapped (0 or 1: the PSD whose x and y are
    exchanged). Four seconds at rest, then ``load`` (N, N, N m) switched on for four."""
    n = 8000
    loads = np.zeros((n, 3))
    loads[n // 2 + 7 :] = load
    fine = generator.motion(loads, 0.585, [])
    clean, truth = optics_of(fine), middles(fine)
    volts = volts_of(Row(kind), clean, seed)
    column = (0, 1, 3, 4)[channel]
    if kind == 'stuck':
        volts[n // 4 :, column] = volts[n // 4, column]
    elif kind in ('dead', 'inverted'):
        volts[:, column] = 0.0 if kind == 'dead' else -volts[:, column]
    else:
        volts[:, [3 * channel, 3 * channel + 1]] = volts[:, [3 * channel + 1, 3 * channel]]
    # Zeroed as it is: the readings at rest are what they are then.
    pipeline = Pipeline(rig(Row(kind)))
    got = run(pipeline, volts, truth, zero_at=SETTLED // 2)
    sd = np.sqrt(np.einsum('nii->ni', got.covariance))
    worst = (np.abs(got.error) / sd)[got.block >= SETTLED // 2].max()
    return float(worst), pipeline.estimator.most_likely_wrong()


WRONG = [(kind, channel) for kind in ('dead', 'stuck', 'inverted') for channel in range(4)]
WRONG += [('swapped', psd) for psd in range(2)]


def one_wrong(rows: int | None) -> int:
    """Print :func:`fault` for every wrong reading, or the first so many, at 10, 30 and 50 N."""
    print('| wrong | load | largest error, own sd | named |\n|---|---|---|---|')
    for (kind, channel), force, arm in product(WRONG[:rows], (10.0, 30.0, 50.0), (0.585, 0.0)):
        worst, named = fault(kind, channel, (0.0, -force, -arm * force))
        place = 'sidebar' if arm else 'link'
        print(
            f'| {kind} {channel} | {force:g} N, {place} | {worst:.1f} | {named or "cannot be determined"} |', flush=True
        )
    return 0


SHORT = {'rest_s': 40, 'steps': 8}  # Of a run whose blocks are many.
Case = tuple[str, str, Callable[..., Inside | Scored], tuple[object, ...], dict[str, object]]


def cases() -> list[Case]:
    """Return label, second label, function and arguments of each row or pair of rows of the table."""
    out: list[Case] = [(row.label, loss, score, (row, loss), {}) for row in ROWS for loss in LOSSES]
    out += [('lost in step', label, score, (ROWS[0], label), {}) for label in IN_STEP]
    out += [(row.label, 'none', score, (row, 'none'), {}) for row in SLOW]
    out += [
        (f'block_size {n}', '', score, (ROWS[0], 'none'), {'size': n, **(SHORT if n <= 60 else {})})
        for n in range(1, 201)
    ]
    out += [(f'{hz:g} Hz', f'{20.0 * size:g} µm', tones, (hz, size), {}) for size in SIZES for hz in TONES]
    out += [(f'{t:g} times the noise', f'a load every {s} s', louder, (t, s), {}) for t in LOUDER for s in EVERY]
    names = {'x1': [0], 'y1': [1], 'x1 and x2': [0, 2], 'y1 and y2': [1, 3], 'x1 and y2': [0, 3], 'all': [0, 1, 2, 3]}
    out += [('drift 0.02 µm/s', name, drifting, (which,), {}) for name, which in names.items()]
    out += [('temperature ramp', f'drift {k} the rig file', warming, (k == 'in',), {}) for k in ('in', 'missing from')]
    out += [(f'random, {a} to {b} Hz', f'{1e6 * rms:g} µm', random_motion, (a, b, rms), {}) for a, b, rms in RANDOM]
    out += [('moving base', '', on_a_moving_base, (), {}), ('10 bit, no dither', '', coarse, (), {})]
    return [*out, ('10 bit', 'the rig file says 16', coarse, (), {'reported': False})]


def _line(case: Case) -> str:
    label, second, function, arguments, more = case
    got = function(*arguments, **more)
    if isinstance(got, Inside):
        return got.line(label, second)
    phases = (('rest', got.rest), ('ringing', got.ringing))
    return '\n'.join(part.line(label, ', '.join(filter(None, (second, phase)))) for phase, part in phases)


def main(argv: Sequence[str] | None = None) -> int:
    parser = options(__doc__, jobs=2)
    parser.add_argument('--only', default='', metavar='TEXT', help='only rows whose labels match this pattern')
    parser.add_argument('--faults', action='store_true', help='instead: one wrong reading after the other')
    parser.add_argument('--rows', type=int, help='only the first rows')
    args = parser.parse_args(argv)
    if args.faults:
        return one_wrong(args.rows)
    print(HEAD)
    print('|---' * (HEAD.count('|') - 1) + '|')
    chosen = [case for case in cases() if re.search(args.only, f'{case[0]}, {case[1]}')]
    missed = 0
    for line in over(_line, chosen[: args.rows], args.jobs):
        print(line, flush=True)
        missed += line.count('**no**')
    print(f'\nrows that do not hold: {missed}')
    if not args.only and args.rows is None:
        print('\nrms error at rest over the Cramér–Rao bound, dX, dY, theta:')
        for row, solvers in ((ROWS[0], ('exact',)), (UNEQUAL, ('wls', 'exact', 'ols'))):
            for name, ratio in over_the_bound(row, solvers).items():
                print(f'- {row.label}, {name}: {", ".join(f"{r:.3f}" for r in ratio)}')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
