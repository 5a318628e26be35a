# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Does ``discover --next`` plan recordings that settle what one leaves open? ``make campaign NAME=blind-next``."""

import sys
import time
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from blind.campaign import conclude, options, over
from blind.cases import DRAWS, EFFECTS, gap_of, scaled
from blind.generator import Array, Generator
from psd_deflection.recordings.observation import Observation
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.experiment import Limits, Setting, proposals
from psd_deflection.studies.discover.loop import run_loop
from psd_deflection.studies.discover.planning import Plan

RIG = load_rig()
GAP = 4.0  # Size of the hidden effect in the first recording, in floors.
MOST = 3
WANTED_SHARE, WANTED_MEDIAN = 1.0, 1.0


def first_recordings() -> dict[str, tuple[Array, Array]]:
    """Loads and temperature of designs that leave much open, some seconds each."""

    def held(*levels: tuple[float, float, float]) -> Array:
        return np.repeat(np.array([(0, 0, 0), *levels, (0, 0, 0)], dtype=np.float64), 1500, axis=0)

    weights = held((0, -10, -5.85), (0, -30, -17.55), (0, -50, -29.25), (0, 0, 0), (0, -30, 0), (0, -50, 0))
    single = {'one weight': (0, -30, 0), 'sidebar': (0, -30, -17.55), 'torque': (0, 0, 20), 'sideways': (30, 0, 0)}
    even = {name: (loads := held(load), np.full(len(loads), 21.0)) for name, load in single.items()}
    warming = np.linspace(21.0, 24.0, len(weights))
    return {**even, 'rest, warming': (np.zeros_like(weights), warming), 'weights, warming': (weights, warming)}


def observed(
    truth: Sequence[dict[str, Any]], loads: Array, temperature: Array | None, length: float, seed: int, name: str
) -> Observation:
    steady = np.full(len(loads), 20.0) if temperature is None else temperature
    volts = Generator(loads, steady, length).record(truth, 'white', seed)
    rig = replace_values(RIG, {'link.length': length}) if length != RIG.link.length else RIG
    return Observation(name, rig, volts, loads, temperature)


def ask_next(job: tuple[str, str, float]) -> dict[str, Any]:
    """Return the effect ``name`` hidden in the first recording ``design``: what became of it."""
    name, design, gap = job
    start, seed = time.perf_counter(), zlib.crc32(f'{name}-{design}'.encode())
    loads, temperature = first_recordings()[design]
    generator = (Generator(loads, temperature, RIG.link.length),)
    row: dict[str, Any] = {'effect': name, 'design': design, 'gap': 0.0}
    try:
        sizes = ({'name': name, **DRAWS[name](np.random.default_rng(seed), size)} for size in (1.0, 100.0))
        if all(gap_of(generator, effect) < 1e-6 for effect in sizes):
            return {**row, 'kind': 'hidden'}
        hidden = scaled(seed, name, gap, generator)
        row['gap'] = gap_of(generator, hidden)
    except (ValueError, OverflowError):
        # A size that the generator cannot make.
        return {**row, 'kind': 'hidden'}
    if not 0.5 * gap < row['gap'] < 2.0 * gap:
        # The first recording cannot show it.
        return {**row, 'kind': 'hidden'}
    first = observed([hidden], loads, temperature, RIG.link.length, seed, 'first')
    made: list[Observation] = []
    alternatives: list[list[str]] = []

    def measured(setting: Setting, loads: Array, seed: int, name: str) -> Observation:
        length = float(str(setting.changes.get('link.length', RIG.link.length)))
        return observed([hidden], loads, setting.temperature(len(loads)), length, seed, name)

    def record(plan: Plan, number: int) -> Observation:
        alternatives.append(sorted({t.alternative for t in plan.discriminations}))
        made.append(measured(plan.setting, plan.loads, seed + number, f'next {number}'))
        return made[-1]

    done = run_loop([first], lambda known: discover(known, RIG), record, most=MOST)
    named = [*(e.active.effect.name for e in done.discovery.effects), *(f.name for f in done.discovery.setup)]
    together = sorted(done.discovery.unsettled)
    row |= {'outcome': done.outcome, 'recordings': len(done.plans), 'named': named, 'together': together}
    row |= {'left': alternatives, 'planned': [p.words for p in done.plans], 'verdict': done.discovery.verdict}
    row['right'] = named == [name] or (done.outcome != 'unique' and name in (*named, *together))
    row['kind'] = 'confounded' if done.plans or done.outcome != 'unique' else 'alone'
    if done.outcome == 'limits':
        every = enumerate(proposals(RIG, Limits()))
        more = [measured(p.setting, p.piece.loads(1000.0), seed + 100 + i, f'all {i}') for i, p in every]
        best = discover([first, *made, *more], RIG)
        row['separable'] = [e.active.effect.name for e in best.effects] == [name] and not best.unsettled
    row['seconds'] = time.perf_counter() - start
    return row


def table(rows: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    lines = []
    of = [r for r in rows if r['kind'] == 'confounded']
    ended = [r for r in of if r['outcome'] == 'limits']
    can = [r for r in of if r['outcome'] != 'limits' or r['separable']]
    done = [r for r in can if r['outcome'] == 'unique' and r['right']]
    counts = [r['recordings'] for r in done]
    for r in of:
        words = f'{r["effect"]} in {r["design"]}: {", ".join(r["named"]) or "none"}'
        words += f' (or {", ".join(r["together"])})' if r['together'] else ''
        more = '' if r['outcome'] != 'limits' else ', separable' if r['separable'] else ', nor would all together'
        wrong = '' if r['right'] else ' WRONG'
        lines.append(f'{words}; {r["outcome"]} after {r["recordings"]}{more}{wrong}')
        lines += [f'    {" | ".join(a)}: {words}' for a, words in zip(r['left'], r['planned'], strict=True)]
    alone = [r for r in rows if r['kind'] == 'alone']
    unseen = sum(r['kind'] == 'hidden' for r in rows)
    lines.append(f'{len(rows)} recordings; {unseen} cannot show their effect')
    lines.append(f'named at once: {sum(r["right"] for r in alone)} of {len(alone)}')
    lines += [f'    {r["effect"]} in {r["design"]}: {r["verdict"]} {r["named"]}' for r in alone if not r['right']]
    lines.append(f'left open by the first recording: {len(of)}')
    lines.append(f'separable within the limits: {len(can)}; settled and right in at most {MOST}: {len(done)}')
    lines.append(f'said to be inseparable: {len(ended)}, rightly: {sum(not r["separable"] for r in ended)}')
    middle = float(np.median(counts)) if counts else 0.0
    by_count = ', '.join(f'{counts.count(k)} with {k}' for k in range(1, MOST + 1))
    lines.append(f'recordings needed: {by_count}; median {middle:g}')
    met = bool(can) and len(done) >= WANTED_SHARE * len(can) and middle <= WANTED_MEDIAN
    return '\n'.join(lines), met


def main(argv: Sequence[str] | None = None) -> int:
    parser = options(__doc__, jobs=1)
    parser.add_argument('--only', default='', help='only effects whose name contains this')
    parser.add_argument('--designs', default='', help='only first recordings whose name contains this')
    args = parser.parse_args(argv)
    effects = [n for n in EFFECTS if args.only in n]
    jobs = [(n, d, GAP) for d in first_recordings() if args.designs in d for n in effects]
    return conclude(*table(list(over(ask_next, jobs, args.jobs))))


if __name__ == '__main__':
    sys.exit(main())
