# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Laws beyond the catalogue: ``python -m blind.laws [--laws 12] [--nulls 12] [--first 0]``."""

import itertools
import json
import math
import sys
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from blind import generator, law_forms
from blind.campaign import bound_line, conclude, options, over
from blind.cases import designs, gap_of
from psd_deflection.recordings.observation import Observation
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.search.screen import SignatureBank

_BANK, STAGES = SignatureBank(), tuple(law_forms.OF_STAGE)
WANTED = {'stage': 0.90, 'variables': 0.90, 'gap': 0.80, 'alarm': 0.0}
MOST_FLOORS = 1.2
UNDER_ONE = 0.99
"""A law acts under one load only if so much of what it does in square, with the ringing after it, is there."""
NOTHING = 1e-6  # A gap, in floors, that is none.


def drawn(first: int, count: int) -> list[dict[str, Any]]:
    """Laws number ``first`` on: each stage in turn, a form by chance, no form twice in a dozen if that can be."""
    out: list[dict[str, Any]] = []
    used: set[str] = set()
    for i in range(first, first + count):
        stage = STAGES[i % len(STAGES)]
        if i % 12 == 0:
            used.clear()
        rng = np.random.default_rng((20261122, i))
        unused = [f for f in law_forms.OF_STAGE[stage] if f not in used] or list(law_forms.OF_STAGE[stage])
        form = str(rng.choice(unused))
        used.add(form)
        # The second if the first law does nothing, and so on.
        texts = (f'law-{i}' + (f'-{again}' if again else '') for again in itertools.count())
        law = next(filter(_shows, (law_forms.draw(zlib.crc32(text.encode()), stage, form) for text in texts)))
        gap = float(np.exp(rng.uniform(math.log(5.0), math.log(30.0))))
        out.append({**law, 'number': i, 'gap': gap})
    return out


def _shows(law: dict[str, Any]) -> bool:
    """Return whether the law acts in the experiment at all: a threshold may lie beyond all loads."""
    return law['form'] == 'jitter' or gap_of(designs('one'), {**law, 'size': _small(law)}) > NOTHING


def _small(law: dict[str, Any]) -> float:
    """Return a size at which the readings answer in proportion."""
    return {'law_load': 1.0, 'law_link': 1e-5}.get(str(law['name']), 1e-6)


def sized(law: dict[str, Any]) -> dict[str, Any]:
    """Return the law with the size that gives its gap: the readings answer to it nearly in proportion."""
    design = designs('one')
    if law['form'] == 'jitter':
        # The noise of the channel, at full deflection, is 1.5 to 4 times what it is at rest.
        return {**law, 'size': generator.SIGMA * math.sqrt(law['gap'] / 2.0)}
    size = _small(law)
    for _ in range(3):
        size *= law['gap'] / gap_of(design, {**law, 'size': size})
    return {**law, 'size': size}


def observe(law: dict[str, Any] | None, seed: int) -> list[Observation]:
    (g,) = designs('one')
    volts = g.record([] if law is None else [law], 'white', seed)
    return [Observation('recording', load_rig(), volts, g.loads, g.temperature)]


def answer(law: dict[str, Any] | None, seed: int) -> dict[str, Any]:
    return discover(observe(law, seed), load_rig(), seed=0, bank=_BANK).tree()


def evaluated(law: dict[str, Any] | None, got: dict[str, Any]) -> dict[str, Any]:
    message = next((u['law'] for u in got['unknown'] if u['law']), None)
    row: dict[str, Any] = {'verdict': got['verdict'], 'law': None if message is None else message['expression']}
    row['effects'] = [e['name'] for e in got['effects']]
    if law is None:
        return {**row, 'alarm': message is not None}
    truth = law_forms.truth_of(law)
    listed = [] if message is None else [message, *message['equivalent']]
    if _reported_as_jumps(law, got):
        # Of a PSD that jumps, a beam that jumps and a voltage that jumps no reading tells one from the other.
        listed = [{'stage': truth['stage'], 'variables': ['time']}]
    elif _reported_as_note(law, got):
        listed = [truth]
    floor = got['gap']['floor']
    return {
        **row,
        'truth': truth,
        'gap': law['gap'],
        'stage': any(e['stage'] == truth['stage'] for e in listed),
        'stage_alone': message is not None and message['stage'] == truth['stage'],
        'variables': any(sorted(e['variables']) == truth['variables'] for e in listed),
        'variables_alone': message is not None and sorted(message['variables']) == truth['variables'],
        'kind': message is not None and message['kind'] == truth['kind'],
        'jumps': _reported_as_jumps(law, got),
        'note': _reported_as_note(law, got),
        'set': len(listed),
        'floors': (got['gap']['heldout_after'] if message is None else message['heldout_after']) / floor,
    }


def _reported_as_jumps(law: dict[str, Any], got: dict[str, Any]) -> bool:
    """Return whether the check of the recording names each time of a dot's law, as a jump of its PSD."""
    where = f'psd_{law["where"][-1]}'
    message = sorted(f['value'] for f in got['setup'] if f['name'] == 'jump' and f['where'] == where)
    jumps = law['form'] == 'events' and law['where'] in law_forms.DOTS and len(message) == len(law['times'])
    return jumps and bool(np.allclose(message, law['times'], atol=0.01))


def _reported_as_note(law: dict[str, Any], got: dict[str, Any]) -> bool:
    """Whether the law acts under one load only, and the answer is that another load hung there: no reading tells one
    from the other."""
    message = [f for f in got['setup'] if f['name'] == 'load_value']
    if len(message) != 1 or len(got['setup']) > 1 or got['effects'] or got['unknown']:
        return False
    (g,) = designs('one')
    number = int(message[0]['where'].removeprefix('load '))
    changes = np.flatnonzero(np.any(np.diff(g.loads, axis=0) != 0.0, axis=1)) + 1
    acts = np.sum((g.clean([law]) - g.clean([])) ** 2, axis=1)
    # The link rings on when that load is gone.
    rings = changes[number - 1] + (changes[number] - changes[number - 1]) * 2
    return float(acts[changes[number - 1] : rings].sum()) > UNDER_ONE * float(acts.sum())


def _answer_to_law(job: tuple[dict[str, Any] | None, int]) -> dict[str, Any]:
    law, seed = job
    start = time.perf_counter()
    law = None if law is None else sized(law)
    return {**evaluated(law, answer(law, seed)), 'number': seed, 'seconds': time.perf_counter() - start}


def summary(rows: Sequence[dict[str, Any]]) -> tuple[str, bool]:
    laws, nulls = [r for r in rows if 'truth' in r], [r for r in rows if 'truth' not in r]
    lines, passed = [], True
    for name, words in (('stage', 'right stage'), ('variables', 'right variables')):
        k, n = sum(r[name] for r in laws), len(laws)
        alone = sum(r[f'{name}_alone'] for r in laws)
        good = n == 0 or k >= WANTED[name] * n
        passed &= good
        proportion = f'{k}/{n} (wanted {100 * WANTED[name]:.0f} %); named itself: {alone}/{n}'
        lines.append(bound_line(good, f'{words}, named or listed as equivalent: {proportion}'))
    n_close, n = sum(r['floors'] <= MOST_FLOORS for r in laws), len(laws)
    good = n == 0 or n_close >= WANTED['gap'] * n
    alarms = sum(r['alarm'] for r in nulls)
    passed &= good and alarms == 0
    share = f'{n_close}/{n} (wanted {100 * WANTED["gap"]:.0f} %)'
    lines.append(bound_line(good, f'gap on unseen load cases at most {MOST_FLOORS} floors: {share}'))
    unwanted = f'{alarms}/{len(nulls)} (wanted 0)'
    lines.append(bound_line(alarms == 0, f'laws where nothing is missing: {unwanted}'))
    if laws:
        kinds, jumps, notes = (sum(r[name] for r in laws) for name in ('kind', 'jumps', 'note'))
        lines.append(f'     right kind: {kinds}/{n}; mean set: {np.mean([r["set"] for r in laws]):.1f}')
        alone = f'as another load under which alone it acts: {notes}/{n}'
        lines.append(f'     of these told as jumps of a PSD: {jumps}/{n}; {alone}')
        lines.append(f'     seconds a law: median {np.median([r["seconds"] for r in laws]):.0f}')
    return '\n'.join(lines), passed


def main(argv: Sequence[str] | None = None) -> int:
    parser = options(__doc__, jobs=1)
    parser.add_argument('--out', default='build/blind-laws', help='folder for the answers (default: build/blind-laws)')
    parser.add_argument('--laws', type=int, default=12)
    parser.add_argument('--nulls', type=int, default=12)
    parser.add_argument('--first', type=int, default=0, help='number of the first law: fresh ones')
    args = parser.parse_args(argv)
    folder = Path(args.out)
    folder.mkdir(parents=True, exist_ok=True)
    listed = drawn(args.first, args.laws)
    jobs: list[tuple[dict[str, Any] | None, int]] = [(law, law['number']) for law in listed]
    jobs += [(None, 100_000 + args.first + i) for i in range(args.nulls)]
    rows = []
    with (folder / f'answers-{args.first}.jsonl').open('w') as stream:
        for row in over(_answer_to_law, jobs, args.jobs, 'answers'):
            rows.append(row)
            stream.write(json.dumps(row) + '\n')
            stream.flush()
    return conclude(*summary(rows), folder / f'summary-{args.first}.txt')


if __name__ == '__main__':
    sys.exit(main())
