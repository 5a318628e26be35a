# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How often the truth is inside the intervals that are published: ``python -m blind.coverage --help``."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from blind import generator
from blind import motion as moving
from blind.campaign import chunk, options, over
from blind.generator import Array
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import DeflectionEstimate, RawChunk, SpotMeans
from psd_deflection.rig.config import Rig, load_rig

SIZE = 20
CHI_SQUARE_3 = 7.814728  # 95 % of a chi-square of 3 degrees of freedom.
SETTLED = 100  # Blocks before the noise is measured; they are not counted at rest.
SHIFTS = ((0.31372e-3, -0.27182e-3), (0.16180e-3, 0.46692e-3))
"""Where the PSDs are off their places, so that no reading stands in the middle of a converter's step, m."""
RISE = 10.0  # K.
DRIFT = ({'x': 0.4e-6, 'y': -0.3e-6}, {'x': -0.2e-6, 'y': 0.4e-6})
"""Of the dots of each PSD, m/K: up to 40 ppm/K of its half width of 10 mm, as makers state it."""
LOSSES = {'none': (0.0, 0), '2 %': (0.02, 0), '20 %': (0.2, 0), 'bursts of 8': (0.0, 8)}


@dataclass(frozen=True, slots=True)
class Row:
    """One rig: rms noise of each channel V, AR(1) memory, tails, hum V at ``mains`` Hz, converter, offsets of x1, y1,
    x2, y2 V.
    ``stated``: the rig file names the noise of each channel. ``corner``: Hz, at which 1/f noise is as much as the
    white."""

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
    Row('AR(1) 0.3', memory=0.3),
    Row('AR(1) 0.6', memory=0.6),
    Row('AR(1) 0.9', memory=0.9),
    Row('twice the noise', sigmas=(4e-3,) * 6),
    *(Row(f'hum 10 mV, {hz:g} Hz', hum=10e-3, mains=hz) for hz in (49.5, 49.9, 50.0, 50.1, 50.5, 60.0)),
    Row('12 bit', bits=12),
    Row('24 bit', bits=24),
    Row('heavy tails', heavy=True),
    Row('offsets, zeroed', offsets=(1e-3, -2e-3, 0.5e-3, 1.5e-3)),
    Row('1, 2, 4, 2 mV', sigmas=(1e-3, 2e-3, 2e-3, 4e-3, 2e-3, 2e-3)),
    Row('unequal channels', sigmas=(1e-3, 2e-3, 2e-3, 4e-3, 2e-3, 2e-3), stated=True),
)
UNEQUAL = ROWS[-1]
HUMS = (1.0, 0.8, 1.0, 0.9, 1.1, 1.0)  # Shares of the hum that the channels have.
SLOW = (Row('1/f, corner 1 Hz', corner=1.0), Row('1/f, corner 10 Hz', corner=10.0))
"""What the estimates do not cover in full."""
TONES = (5.0, 14.0, 20.0, 28.0, 36.0, 44.0, 48.0, 75.0, 87.0, 130.0, 180.0, 300.0, 480.0)  # Hz of a steady vibration.
SHAKEN = (8e-6, 20e-6, 0.1e-3)  # Its amplitudes: dX, dY m, theta rad, each with a phase of its own.
SIZES = (0.015, 0.05, 0.15, 1.0)  # Times these.
LOUDER, EVERY = (0.5, 1.0, 2.0, 4.0), (2, 4, 20)  # Times the noise at rest; s from one change of the load to the next.


class Inside(NamedTuple):
    """Shares of the blocks whose truth is inside 95 % (dX, dY, theta, all three jointly) and inside 3 sd; rms error."""

    axes: tuple[float, float, float]
    joint: float
    three: float
    rms: tuple[float, float, float]
    blocks: int


class Scored(NamedTuple):
    """At rest and ringing; ``alarms``: share of the blocks whose readings are said to contradict each other."""

    rest: Inside
    ringing: Inside
    alarms: float


def inside(error: Array, covariance: Array) -> Inside:
    """``error`` (n, 3), ``covariance`` (n, 3, 3)."""
    sd = np.sqrt(np.einsum('nii->ni', covariance))
    size = np.abs(error) / sd
    joint = np.einsum('ni,ni->n', error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    a, b, c = (size < 1.959964).mean(axis=0).tolist()
    x, y, t = np.sqrt((error**2).mean(axis=0)).tolist()
    return Inside((a, b, c), float((joint < CHI_SQUARE_3).mean()), float((size < 3.0).mean()), (x, y, t), len(error))


def rig(row: Row, **overrides: object) -> Rig:
    """Return the nominal rig with that converter; its noise stays 2 mV, white, unless the row's is stated."""
    values: dict[str, object] = {'solver': 'exact', 'solvers': ['exact'], 'converter.bits': min(row.bits, 16)}
    for i, (shift, place) in enumerate(zip(SHIFTS, generator.PLACES, strict=True), start=1):
        values[f'psd_{i}.center'] = [p + s for p, s in zip(place, shift, strict=True)]
        values[f'psd_{i}.zero'] = [-s for s in shift]
        if row.stated:
            values[f'psd_{i}.noise'] = list(row.sigmas[3 * i - 3 : 3 * i - 1])
    return load_rig(overrides={**values, **overrides})


@cache
def motion(rest_s: int, steps: int) -> tuple[Array, Array]:
    """Volts (n, 6) without noise and poses (n / 20, 3) at the blocks' middles."""
    fine = _poses(rest_s, steps)
    return optics_of(fine), middles(fine)


def _poses(rest_s: int, steps: int, every_s: int = 5) -> Array:
    n, dwell = rest_s * 1000, every_s * 1000
    loads = np.zeros((n + steps * dwell, 3))
    for step in range(0, steps, 2):
        # Off the blocks' grid, each at another place in its block.
        first = n + step * dwell + 7 * step % SIZE
        loads[first : first + dwell] = (0.0, -50.0, -29.25)
    return generator.motion(loads, 0.585, [])


def optics_of(fine: Array, warm: Array | None = None, effects: Sequence[generator.Spec] = ()) -> Array:
    """Volts (n, 6) without noise; ``warm``: K above the first temperature, for ``effects`` of the sensors."""
    none = np.zeros(len(fine))
    shifted = [
        {'name': 'sensor_position', 'psd': i, 'x': x, 'y': y, 'aimed': False} for i, (x, y) in enumerate(SHIFTS, 1)
    ]
    dots = generator.optics(fine, none, none, 0.585, shifted)
    m, light = generator.sensors(dots, none, none if warm is None else warm, effects)
    return generator.electronics(m, light, none, [])


def middles(fine: Array) -> Array:
    """Poses (n / 20, 3) at the blocks' middles."""
    # Between samples 9 and 10: by the four fine places about it.
    at = np.arange(0, len(fine) - 99, 100) + 47
    return np.asarray((9.0 * (fine[at] + fine[at + 1]) - fine[at - 1] - fine[at + 2]) / 16.0)


def volts_of(row: Row, clean: Array, seed: int) -> Array:
    """What the converter gives, (n, 6) V."""
    out = clean + generator.electronic_noise(len(clean), seed, sigmas=row.sigmas, memory=row.memory, heavy=row.heavy)
    if row.corner:
        rng = np.random.default_rng(seed)
        out = clean + np.asarray(row.sigmas) * generator.flicker(len(clean), row.corner, rng)
    t = np.arange(len(clean)) / generator.RATE
    out += row.hum * np.sin(2.0 * np.pi * row.mains * t)[:, None] * HUMS
    if row.offsets:
        out[:, [0, 1, 3, 4]] += row.offsets
    return generator.output(out, [], row.bits)


def estimates(
    pipeline: Pipeline, volts: Array, here: npt.NDArray[np.bool_], *, zero_at: int = 0
) -> list[DeflectionEstimate]:
    """Return the primary estimates of samples (n, 6) V of which ``here`` (n,) arrive."""
    seq = np.flatnonzero(here)
    cut = int(np.searchsorted(seq, zero_at * SIZE))
    out: list[DeflectionEstimate] = []
    for part in (seq[:cut], seq[cut:]):
        if zero_at and out:
            pipeline.zero()
        out += _published(pipeline, part, volts)
    return out


def score(row: Row, loss: str, *, rest_s: int = 100, steps: int = 16, seed: int = 1, **overrides: object) -> Scored:
    clean, truth = motion(rest_s, steps)
    share, burst = LOSSES[loss]
    here = generator.present(len(clean), seed + 1000, share, burst)
    pipeline = Pipeline(rig(row, **overrides))
    got = estimates(pipeline, volts_of(row, clean, seed), here, zero_at=SETTLED if row.offsets else 0)
    return _scored(got, truth, rest_s, pipeline)


def _scored(got: Sequence[DeflectionEstimate], truth: Array, rest_s: int, pipeline: Pipeline) -> Scored:
    error, covariance, block = _errors(got, truth)
    first = rest_s * 1000 // SIZE
    rest = (block >= 2 * SETTLED) & (block < first)
    ringing = block >= first
    return Scored(
        inside(error[rest], covariance[rest]),
        inside(error[ringing], covariance[ringing]),
        pipeline.estimator.contradictions / len(got),
    )


def louder(times: float, every_s: int, rest_s: int = 10, seed: int = 1) -> Inside:
    """``rest_s`` at rest; then so many ``times`` the noise, while the load changes ``every_s``. Counted from 10 s later
    on."""
    fine = _poses(rest_s, 40 // every_s, every_s)
    clean, truth = optics_of(fine), middles(fine)
    volts = volts_of(ROWS[0], clean, seed)
    first = rest_s * 1000
    row = Row('changed', sigmas=tuple(times * s for s in ROWS[0].sigmas))
    volts[first:] = volts_of(row, clean, seed + 1)[first:]
    error, covariance, block = _errors(estimates(Pipeline(rig(row)), volts, np.ones(len(volts), bool)), truth)
    later = block >= (first + 10_000) // SIZE
    return inside(error[later], covariance[later])


def warming(reported: bool = True, rest_s: int = 60, steps: int = 8, seed: int = 1) -> Scored:
    """Readings that drift with temperature by what makers of PSDs state, ``DRIFT``, while it rises by ``RISE``.
    ``reported``: the rig file has the drift, and the temperature is told once a second, to 0.1 K."""
    fine = _poses(rest_s, steps)
    warm = np.linspace(0.0, RISE, len(fine))
    names = [{'name': 'thermal_drift', 'psd': psd, **drift} for psd, drift in enumerate(DRIFT, 1)]
    volts = volts_of(ROWS[0], optics_of(fine, warm, names), seed)
    known = {f'effects.drift_{one["psd"]}.{key}': value for one in names for key, value in one.items()}
    pipeline = Pipeline(rig(ROWS[0], **(known if reported else {})))
    got: list[DeflectionEstimate] = []
    for second, part in enumerate(np.split(np.arange(len(volts)), len(volts) // 1000)):
        if reported:
            pipeline.temperature(20.0 + round(float(warm[second * 1000 * generator.FINER]), 1))
        got += _published(pipeline, part, volts)
    return _scored(got, middles(fine), rest_s, pipeline)


def on_a_moving_base(seconds: int = 60, seed: int = 1) -> Inside:
    """A link without load whose base turns, as :func:`blind.motion.swung` moves it; its accelerations are told."""
    run = moving.make('joint', float(seconds), seed)
    pipeline = Pipeline(moving.rig_of())
    reported = list(run.reported)
    got: list[DeflectionEstimate] = []
    for part in np.split(np.arange(len(run.volts)), len(run.volts) // SIZE):
        while reported and reported[0].t_ns < int(part[-1] + 1) * 1_000_000:
            pipeline.accelerate(reported.pop(0))
        got += _published(pipeline, part, run.volts)
    error, covariance, block = _errors(got, generator.between(run.pose))
    in_motion = block >= int(moving.REST * generator.RATE) // SIZE
    return inside(error[in_motion], covariance[in_motion])


def _published(pipeline: Pipeline, part: npt.NDArray[np.int_], volts: Array) -> list[DeflectionEstimate]:
    chunk = RawChunk(part, part * 1_000_000, volts[part].astype(np.float32), np.zeros(len(part), np.uint8))
    return [r for r in pipeline.process(chunk) if isinstance(r, DeflectionEstimate) and r.primary]


def _errors(got: Sequence[DeflectionEstimate], truth: Array) -> tuple[Array, Array, npt.NDArray[np.int_]]:
    """Errors (k, 3), covariances (k, 3, 3) and blocks (k,) of estimates; ``truth`` (n, 3) of each block."""
    block = np.array([e.block for e in got])
    error = np.array([(e.dx, e.dy, e.theta) for e in got]) - truth[block]
    return error, np.array([e.covariance for e in got]).reshape(-1, 3, 3), block


class Shaken(NamedTuple):
    """A link that vibrates steadily. ``sd`` (3,): median of the published ones. ``named``: share of the blocks that say
    that it vibrates; ``reported``: of those whose error is beyond 3 standard deviations, NaN if there are none."""

    inside: Inside
    sd: tuple[float, float, float]
    named: float
    reported: float
    words: str


def shaken(
    hz: float, row: Row = ROWS[0], seconds: int = 60, seed: int = 1, size: float = 1.0, **overrides: object
) -> Shaken:
    """A link without load that vibrates with that frequency and ``size`` times ``SHAKEN``, from the first sample on."""
    n = seconds * int(generator.RATE)
    t = np.arange(n * generator.FINER) / (generator.RATE * generator.FINER)
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 3)
    fine = np.sin(2.0 * np.pi * hz * t[:, None] + phases) * SHAKEN * size
    pipeline = Pipeline(rig(row, **overrides))
    volts = volts_of(row, optics_of(fine), seed)
    records = list(pipeline.process(chunk(volts)))
    got = [r for r in records if isinstance(r, DeflectionEstimate) and r.primary and r.block >= 2 * SETTLED]
    spots = [r for r in records if isinstance(r, SpotMeans)]
    words = {s.index: next((f for f in s.findings if f.startswith('vibrates')), '') for s in spots}
    error, covariance, block = _errors(got, middles(fine))
    sd = np.sqrt(np.einsum('nii->ni', covariance))
    named = np.array([bool(words[b]) for b in block.tolist()])
    beyond = (np.abs(error) > 3.0 * sd).any(axis=1)
    x, y, theta = np.median(sd, axis=0).tolist()
    reported = float(named[beyond].mean()) if beyond.any() else float('nan')
    return Shaken(inside(error, covariance), (x, y, theta), float(named.mean()), reported, words[int(block[-1])])


def coarse(poses: int = 150, seed: int = 1, *, reported: bool = True, **overrides: object) -> Inside:
    """Return a 10 bit converter, whose step is ten times the noise: the last 20 blocks of 120 in each of many poses.
    ``reported``: the rig file says so, not 16 bit."""
    rng = np.random.default_rng(seed)
    row = Row('10 bit', bits=10)
    more = {'converter.bits': 10 if reported else 16, **overrides}
    errors, covariances = [], []
    for _ in range(poses):
        pose = rng.uniform(-1.0, 1.0, 3) * (1e-3, 1e-3, 1e-2)
        volts = volts_of(row, optics_of(np.tile(pose, (120 * SIZE * generator.FINER, 1))), int(rng.integers(1 << 30)))
        for e in estimates(Pipeline(rig(row, **more)), volts, np.ones(len(volts), bool))[100:]:
            errors.append(np.array((e.dx, e.dy, e.theta)) - pose)
            covariances.append(np.array(e.covariance).reshape(3, 3))
    return inside(np.array(errors), np.array(covariances))


def bound(row: Row) -> Array:
    """Least rms error (3,) that white noise of that size and 16 bits leave in a mean of 20 samples (Cramer-Rao)."""
    (ax, ay), (bx, by) = generator.PLACES
    a = np.array([[-1.0, 0.0, ay], [0.0, -1.0, -ax], [-1.0, 0.0, by], [0.0, -1.0, -bx]])
    sigmas = np.array(row.sigmas)[[0, 1, 3, 4]]
    variances = generator.MM_PER_V**2 * (sigmas**2 + generator.LSB**2 / 12.0) / SIZE
    return np.asarray(np.sqrt(np.linalg.inv((a.T / variances) @ a).diagonal()))


def over_the_bound(
    row: Row, solvers: Sequence[str], rest_s: int = 400, seed: int = 1, **more: object
) -> dict[str, Array]:
    """rms error (3,) of each solver on a link at rest over :func:`bound`."""
    n = rest_s * 1000
    volts = volts_of(row, optics_of(np.zeros((n * generator.FINER, 3))), seed)
    chosen = {'solver': solvers[0], 'solvers': list(solvers), **more}
    poses: dict[str, list[tuple[float, float, float]]] = {name: [] for name in solvers}
    for r in Pipeline(rig(row, **chosen)).process(chunk(volts)):
        if isinstance(r, DeflectionEstimate):
            poses[r.solver].append((r.dx, r.dy, r.theta))
    return {name: np.sqrt(np.square(found).mean(axis=0)) / bound(row) for name, found in poses.items()}


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
    if kind == 'dead':
        volts[:, column] = 0.0
    elif kind == 'stuck':
        volts[n // 4 :, column] = volts[n // 4, column]
    elif kind == 'inverted':
        volts[:, column] *= -1.0
    else:
        pair = [3 * channel, 3 * channel + 1]
        volts[:, pair] = volts[:, pair[::-1]]
    # Zeroed as it is: the readings at rest are what they are then.
    pipeline = Pipeline(rig(Row(kind)))
    worst = 0.0
    for e in estimates(pipeline, volts, np.ones(n, bool), zero_at=SETTLED // 2):
        if e.block < SETTLED // 2:
            continue
        sd = np.sqrt(np.array(e.covariance).reshape(3, 3).diagonal())
        worst = max(worst, float(np.abs((np.array((e.dx, e.dy, e.theta)) - truth[e.block]) / sd).max()))
    return worst, pipeline.estimator.most_likely_wrong()


WRONG = tuple(
    [(kind, channel) for kind in ('dead', 'stuck', 'inverted') for channel in range(4)]
    + [('swapped', psd) for psd in range(2)]
)


def one_wrong(rows: int | None) -> int:
    """Print :func:`fault` for every wrong reading, or the first so many, at 10, 30 and 50 N."""
    print('| wrong | load | largest error, own sd | named |\n|---|---|---|---|')
    for kind, channel in WRONG[:rows]:
        for force in (10.0, 30.0, 50.0):
            for name, load in (('sidebar', (0.0, -force, -0.585 * force)), ('link', (0.0, -force, 0.0))):
                worst, named = fault(kind, channel, load)
                words = f'{kind} {channel} | {force:g} N, {name} | {worst:.1f} | {named or "cannot be determined"}'
                print(f'| {words} |', flush=True)
    return 0


VIBRATION_SEEDS = 8

SHAKEN_HEAD = '| µm | Hz | ΔX | ΔY | θ | joint | within 3 sd | ΔY: rms error, µm | sd, µm | named | named beyond 3 sd |'


def vibrations(seeds: int) -> int:
    """Print a row for each of ``SIZES`` and ``TONES``: the mean of so many runs, with phases and noise of their own."""
    print(SHAKEN_HEAD)
    print('|---' * (SHAKEN_HEAD.count('|') - 1) + '|')
    for times, hz in itertools.product(SIZES, TONES):
        runs = [shaken(hz, seconds=16, seed=seed, size=times) for seed in range(1, seeds + 1)]
        shares = np.mean([(*r.inside.axes, r.inside.joint) for r in runs], axis=0)
        three = float(np.mean([r.inside.three for r in runs]))
        rms = float(np.sqrt(np.mean([r.inside.rms[1] ** 2 for r in runs])))
        sd = float(np.mean([r.sd[1] for r in runs]))
        named = float(np.mean([r.named for r in runs]))
        beyond = [r.reported for r in runs if not np.isnan(r.reported)]
        reported = f'{np.mean(beyond):.3f}' if beyond else 'none beyond'
        inner = ' | '.join(f'{v:.3f}' for v in shares)
        size = f'{rms * 1e6:.2f} | {sd * 1e6:.2f}'
        print(f'| {20.0 * times:g} | {hz:g} | {inner} | {three:.4f} | {size} | {named:.3f} | {reported} |', flush=True)
    return 0


def changes() -> int:
    """Print a row for each of ``LOUDER`` and ``EVERY``."""
    print('| times the noise | a load every | ΔX | ΔY | θ | joint | within 3 sd |\n|---|---|---|---|---|---|---|')
    for times, every_s in itertools.product(LOUDER, EVERY):
        found = louder(times, every_s)
        print(f'| {times:g} | {every_s} s | {_cells(found)} | {found.three:.4f} |', flush=True)
    return 0


HEAD = '| noise | loss | rest: ΔX | ΔY | θ | joint | ringing: ΔX | ΔY | θ | joint | within 3 sd | alarms |'


def _cells(i: Inside) -> str:
    return ' | '.join(f'{v:.3f}' for v in (*i.axes, i.joint))


def _job(job: tuple[Row, str]) -> tuple[Row, str, Scored]:
    return (*job, score(*job))


def main(argv: Sequence[str] | None = None) -> int:
    parser = options(__doc__, jobs=2)
    parser.add_argument('--rows', type=int, help='only the first kinds of noise, and only the table')
    parser.add_argument('--only', default='', metavar='TEXT', help='only kinds of noise with these words')
    parser.add_argument('--losses', type=int, default=len(LOSSES), help='only the first kinds of loss')
    parser.add_argument('--vibration', type=int, metavar='SEEDS', help='instead: steady tones, each by so many seeds')
    parser.add_argument('--changes', action='store_true', help='instead: noise that changes while loads do')
    parser.add_argument('--faults', action='store_true', help='instead: one wrong reading after the other')
    args = parser.parse_args(argv)
    if args.faults:
        return one_wrong(args.rows)
    if args.changes:
        return changes()
    if args.vibration:
        return vibrations(args.vibration)
    print(HEAD)
    print('|---' * (HEAD.count('|') - 1) + '|')
    motion(100, 16)
    rows = [row for row in ROWS[: args.rows] if args.only in row.label]
    pairs = [(row, loss) for row in rows for loss in list(LOSSES)[: args.losses]]
    pairs += [(row, 'none') for row in SLOW] if args.rows is None and not args.only else []
    cost: Array | None = None
    for row, loss, s in over(_job, pairs, args.jobs):
        print(
            _line(row.label if loss == 'none' else '', s.ringing.three, s.rest, s.ringing, s.alarms, loss), flush=True
        )
        cost = np.array(s.rest.rms) / bound(row) if cost is None else cost
    if cost is None or args.only or args.rows is not None:
        return 0
    base = on_a_moving_base()
    print(_line('white, moving base', base.three, None, base))
    for reported, more in ((True, ''), (False, ' that the rig file does not know')):
        s = warming(reported)
        print(_line(f'white, temperature ramp{more}', s.ringing.three, s.rest, s.ringing, s.alarms))
    for reported, label in ((True, '10 bit, no dither'), (False, '10 bit, the rig file says 16')):
        r = coarse(reported=reported)
        print(_line(label, r.three, r))
    print('\nrms error at rest over the Cramér–Rao bound, dX, dY, theta:')
    print(f'- white, no loss: {_three(cost)}')
    for name, ratio in over_the_bound(UNEQUAL, ('wls', 'exact', 'ols')).items():
        print(f'- unequal channels, {name}: {_three(ratio)}')
    print()
    return vibrations(VIBRATION_SEEDS)


def _line(
    label: str,
    three: float,
    rest: Inside | None,
    ringing: Inside | None = None,
    alarms: float = 0.0,
    loss: str = 'none',
) -> str:
    shares = ' | '.join(' | | | ' if i is None else _cells(i) for i in (rest, ringing))
    return f'| {label} | {loss} | {shares} | {three:.4f} | {alarms:.5f} |'


def _three(ratios: Array) -> str:
    return ', '.join(f'{r:.3f}' for r in ratios)


if __name__ == '__main__':
    raise SystemExit(main())
