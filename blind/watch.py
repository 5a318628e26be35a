# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Does the watch see what happens to a rig, and is it silent while nothing does? ``make campaign NAME=blind-watch``."""

import math
import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from blind.campaign import chunk, conclude, options, over
from blind.generator import EI, GJ, LSB, MM_PER_V, SIGMA, Array, Generator
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.watch import Alarm, Watch
from psd_deflection.model.solvers.registry import solver_from_rig
from psd_deflection.records import AppliedLoad, BlockStatus, DeflectionEstimate, Record, SpotMeans, TipLoad
from psd_deflection.rig.config import load_rig

RATE, LENGTH = 1000, 0.585
BUMP, GAIN, SLIP = 5e-6, 0.02, 20e-6
SIZES = {'bump': f'{1e6 * BUMP:g} µm', 'gain': f'{100 * GAIN:g} %', 'slip': f'{1e6 * SLIP:g} µrad'}
WITHIN_S, WANTED = 10.0, 0.95
RUN_S, HELD_FROM_S = 24.0, 2.0
LEVELS = ((0, 0, 0), (0, -30, 0), (0, -50, -29.25), (40, 0, 0), (0, -20, 20), (-30, -30, 0))
DRIFT, DRIFT_HOURS = 2e-6, 3.0
HOLD_S, HOLDS = 30, 12
BLOCK, CHUNK = 20, 1000
FITTED = 1.5  # A parabola through a block has so many times the noise of its mean, in the middle (sqrt(9/4)).
PROCESS_NOISE = np.zeros((4, 4))


class Run(NamedTuple):
    """What came of one run; ``after``: from the event to the alarm, s, NaN if there was none; ``early``: before it."""

    kind: str
    after: float
    early: bool
    channel: str


class Chain:
    def __init__(self) -> None:
        rig = load_rig(overrides={'solvers': ['exact']})
        self.pipeline = Pipeline(rig)
        self.watch = Watch(rig, self.pipeline.tip_loads.compliance)
        self.at = 0
        self.raised: list[Alarm] = []

    def load(self, load: Array | Sequence[float]) -> None:
        self.watch.note(AppliedLoad(self.at * 1_000_000, *map(float, load)))

    def feed(self, volts: Array) -> None:
        before, samples = self.watch.alarms, chunk(volts, self.at)
        self.at += len(volts)
        for record in self.pipeline.process(samples):
            self.watch.put(record)
        if self.watch.alarms > before and self.watch.alarm is not None:
            self.raised.append(self.watch.alarm)


def read(clean: Array, rng: np.random.Generator) -> Array:
    """Volts with noise, as a converter of 16 bit has them."""
    return np.asarray(np.round((clean + SIGMA * rng.standard_normal(clean.shape)) / LSB) * LSB)


def happened(kind: str, seed: int) -> tuple[Array, Array, float]:
    """Return one event of a kind, drawn by ``seed``: the load (3,), volts (n, 6) and the time of the event, s."""
    rng = np.random.default_rng((seed, len(kind)))
    n, held = round(RUN_S * RATE), round(HELD_FROM_S * RATE)
    event = round(rng.uniform(11.0, 13.5) * RATE)
    # A change of gain shows where the dots are off the centre.
    load = np.array(LEVELS[int(rng.integers(kind == 'gain', len(LEVELS)))], dtype=np.float64)
    acting = np.zeros((n, 3))
    acting[held:] = load
    if kind == 'slip':
        axis, sign = int(rng.integers(3)), float(rng.choice((-1.0, 1.0)))
        # The load that moves the tip as far as the clamp does.
        acting[event:, axis] += sign * SLIP * (3.0 * EI / LENGTH**2 if axis < 2 else GJ / LENGTH)
    volts = Generator(acting, np.full(n, 20.0), LENGTH).clean([])
    psd = int(rng.integers(2))
    if kind == 'bump':
        angle = rng.uniform(0.0, 2.0 * math.pi)
        volts[event:, 3 * psd : 3 * psd + 2] += BUMP / MM_PER_V * np.array([math.cos(angle), math.sin(angle)])
    elif kind == 'gain':
        volts[event:, 3 * psd : 3 * psd + 2] *= 1.0 + float(rng.choice((-1.0, 1.0))) * GAIN
    return load, read(volts, rng), event / RATE


def watch_run(job: tuple[str, int]) -> Run:
    kind, seed = job
    load, volts, event = happened(kind, seed)
    held, chain = round(HELD_FROM_S * RATE), Chain()
    chain.load((0.0, 0.0, 0.0))
    chain.feed(volts[:held])
    chain.load(load)
    for start in range(held, len(volts), CHUNK):
        chain.feed(volts[start : start + CHUNK])
    early = any(a.observed_ns < 1e9 * event for a in chain.raised)
    alarm = next((a for a in chain.raised if a.observed_ns >= 1e9 * event), None)
    after = math.nan if alarm is None else alarm.observed_ns / 1e9 - event
    return Run(kind, after, early, '' if alarm is None else alarm.channel)


def quiet(job: tuple[float, int]) -> tuple[float, int, list[str], float]:
    """Hours in which nothing happens: hours, alarms, what they said, and seconds of the watch for each block. The watch
    is given block means of the second generator's clean readings with fresh noise, as much as a block's fit leaves, and
    the poses that the method has for them: a day of samples would take the pipeline half an hour."""
    hours, seed = job
    rng, rig = np.random.default_rng(seed), load_rig()
    solver = solver_from_rig('exact', rig)
    compliance = Pipeline(rig).tip_loads.compliance
    watch = Watch(rig, compliance)
    levels = np.array([LEVELS[i % len(LEVELS)] for i in range(HOLDS)], dtype=np.float64)
    loads = np.repeat(levels, HOLD_S * RATE, axis=0)
    clean = Generator(loads, np.full(len(loads), 20.0), LENGTH).clean([])[:, [0, 1, 3, 4]] * MM_PER_V
    clean = clean.reshape(-1, BLOCK, 4).mean(axis=1)
    noise = FITTED * SIGMA * MM_PER_V / math.sqrt(BLOCK)
    variances = np.full(4, noise**2)
    covariance = tuple((noise**2 * np.eye(3)).ravel().tolist())
    phases = rng.uniform(0.0, 2.0 * math.pi, 4)
    hold = HOLD_S * RATE // BLOCK
    message: list[str] = []
    at, seconds = 0, 0.0
    step_ns = BLOCK * 1_000_000
    while at * BLOCK < hours * 3600 * RATE:
        # Each repetition begins with a link at rest, as it is half a minute after its last load.
        t = (at + np.arange(len(clean))) * BLOCK / RATE
        drift = DRIFT * np.sin(2.0 * math.pi * t[:, None] / (3600.0 * DRIFT_HOURS) + phases)
        dots = clean + drift + noise * rng.standard_normal(clean.shape)
        poses = solver.solve_many(dots, variances).pose
        late = {i * hold + int(rng.integers(2 * RATE // BLOCK)): LEVELS[i % len(LEVELS)] for i in range(HOLDS)}
        for i, (four, pose) in enumerate(zip(dots.tolist(), poses.tolist(), strict=True)):
            t_ns = (at + i) * step_ns
            records: list[Record] = []
            if i in late:
                records.append(AppliedLoad(t_ns, *map(float, late[i])))
            dx, dy, theta = pose[:3]
            records += [
                DeflectionEstimate(t_ns, at + i, 'exact', dx, dy, theta, 0.0, 0.0, covariance, 0.0, True),
                TipLoad(t_ns, dx / compliance[0], dy / compliance[1], theta / compliance[2]),
                SpotMeans(t_ns, at + i, tuple(four), (5.0, 5.0), PROCESS_NOISE, BLOCK, 0, BlockStatus.OK, ''),
            ]
            before, began = watch.alarms, time.thread_time()
            for record in records:
                watch.put(record)
            seconds += time.thread_time() - began
            if watch.alarms > before and watch.alarm is not None:
                message.append(watch.alarm.words)
        at += len(clean)
    return at * BLOCK / 3600.0 / RATE, watch.alarms, message, seconds / at


def table(runs: Sequence[Run], hours: float, alarms: int, message: Sequence[str], cost: float) -> tuple[str, bool]:
    lines, met = [], alarms == 0
    for kind in dict.fromkeys(r.kind for r in runs):
        of = [r for r in runs if r.kind == kind]
        observed = [r for r in of if r.after <= WITHIN_S]
        early = sum(r.early for r in of)
        met = met and len(observed) >= WANTED * len(of) and not early
        after = np.array([r.after for r in observed] or [math.nan])
        when = f'after {np.median(after):.1f} s in the middle, {after.max():.1f} s at most; {early} alarms before it'
        lines.append(f'{kind} of {SIZES[kind]}: seen within {WITHIN_S:g} s in {len(observed)} of {len(of)}, {when}')
    if hours:
        lines.append(f'{hours:.2f} quiet hours: {alarms} alarms; {1e6 * cost:.1f} us a block')
        lines += [f'    {words}' for words in message[:20]]
    return '\n'.join(lines), met


def main(argv: Sequence[str] | None = None) -> int:
    parser = options(__doc__, jobs=1)
    parser.add_argument('--runs', type=int, default=100, help='events of each kind')
    parser.add_argument('--hours', type=float, default=24.0, help='quiet hours')
    parser.add_argument('--first', type=int, default=0, help='number of the first seed')
    args = parser.parse_args(argv)
    jobs = [(kind, args.first + i) for i in range(args.runs) for kind in SIZES]
    parts = [(args.hours / args.jobs, args.first + i) for i in range(args.jobs)] if args.hours else []
    runs = list(over(watch_run, jobs, args.jobs, 'events'))
    silence = list(over(quiet, parts, args.jobs, 'quiet hours'))
    message = [words for _, _, of, _ in silence for words in of]
    cost = float(np.mean([cost for *_, cost in silence])) if silence else 0.0
    return conclude(*table(runs, sum(s[0] for s in silence), sum(s[1] for s in silence), message, cost))


if __name__ == '__main__':
    sys.exit(main())
