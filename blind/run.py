# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the blind suite: seal the truths, let discover answer, score. ``python -m blind.run --help``."""

import argparse
import dataclasses
import hashlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from blind import byhand, score
from blind.campaign import conclude, options, over
from blind.cases import Case, all_cases, designs, possible, scaled, short_cases
from blind.mistakes import observed
from psd_deflection.recordings.observation import Observation
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search.screen import SignatureBank

COUNTS = (
    ('--seeds', 4, 'draws of each effect and gap'),
    ('--nulls', 300, 'without an effect'),
    ('--wrong', 102, 'the same, with other noise'),
    ('--pairs', 60, 'two effects'),
    ('--spreads', 60, 'pairs and triples of very different size'),
    ('--mistakes', 5, 'sizes of each mistake of the set-up'),
    ('--fours', 40, 'four effects at once'),
    ('--sixes', 20, 'six effects at once'),
    ('--hand', 44, 'loads applied and noted by hand'),
    ('--first', 0, 'number of the first seed: fresh cases'),
)
"""Options of the selection: so many cases."""
_BANKS: dict[str, SignatureBank] = {}


def truth_of(case: Case) -> list[dict[str, Any]]:
    """Return the effects of a case, scaled to their gaps; none that no machine can have."""
    effects = [scaled(case.seed, name, gap, designs(case.design)) for name, gap in case.wanted]
    return [e for e in effects if possible(e)]


def observe(case: Case, truth: Sequence[dict[str, Any]]) -> list[Observation]:
    rig = load_rig()
    if case.kind == 'hand':
        hand = byhand.drawn(case.design)
        volts = designs(case.design)[0].record(truth, case.noise, case.seed)
        return [Observation('recording 1', rig, volts, hand.annotated, hand.temperature)]
    if case.mistake[0]:
        return observed(case.mistake, designs(case.design)[0], rig, case.noise, case.seed)
    out = []
    for i, g in enumerate(designs(case.design)):
        rig_of_length = replace_values(rig, {'link.length': g.length}) if g.length != rig.link.length else rig
        volts = g.record(truth, case.noise, case.seed + i)
        out.append(Observation(f'recording {i + 1}', rig_of_length, volts, g.loads, g.temperature))
    return out


def answer(case: Case, truth: Sequence[dict[str, Any]]) -> tuple[dict[str, Any], Discovery]:
    # A mistake may change the rig, the loads or the length of the recording.
    bank = None if case.mistake[0] else _BANKS.setdefault(case.design, SignatureBank())
    observed = observe(case, truth)
    rig = observed[0].rig if case.mistake[0] else load_rig()
    discovery = discover(observed, rig, seed=0, without=case.without, bank=bank)
    return discovery.tree(), discovery


def _answer_case(job: tuple[Case, Path]) -> None:
    case, folder = job
    path = folder / 'answers' / f'{case.key}.json'
    if not path.exists():
        truth = json.loads((folder / 'sealed' / path.name).read_text())['truth']
        start = time.perf_counter()
        got, _ = answer(case, truth)
        _write(path, json.dumps({**got, 'seconds': time.perf_counter() - start}))


def _write(path: Path, text: str) -> None:
    """The file is whole, or it is not there."""
    partial = path.with_suffix('.partial')
    partial.write_text(text)
    partial.replace(path)


def _sealed(given: tuple[Case, Path]) -> None:
    case, path = given
    if not path.exists():
        sealed = {'case': dataclasses.asdict(case), 'truth': truth_of(case)}
        wrong = {'wrong': byhand.drawn(case.design).wrong} if case.kind == 'hand' else {}
        _write(path, json.dumps(sealed | wrong, sort_keys=True))


def seal(cases: Sequence[Case], folder: Path, jobs: int = 1) -> str:
    """Write truths and thresholds, with ``jobs`` processes; returns the hash over all of them."""
    truths = folder / 'sealed'
    truths.mkdir(parents=True, exist_ok=True)
    paths = [truths / f'{case.key}.json' for case in cases]
    for _ in over(_sealed, list(zip(cases, paths, strict=True)), jobs, 'sealing truths'):
        pass
    digest = hashlib.sha256(json.dumps(score.THRESHOLDS, sort_keys=True).encode())
    for path in paths:
        digest.update(path.read_bytes())
    (folder / 'thresholds.json').write_text(json.dumps(score.THRESHOLDS, indent=1))
    (folder / 'seal.sha256').write_text(digest.hexdigest() + '\n')
    return digest.hexdigest()


def selection(parser: argparse.ArgumentParser) -> Callable[[argparse.Namespace], list[Case]]:
    """Return the options that choose cases, added to ``parser``, and what gives these of the parsed ones."""
    parser.add_argument('--out', default='build/blind', help='folder for truths and answers (default: build/blind)')
    parser.add_argument('--short', action='store_true', help='the slice that runs on every change')
    for name, default, words in COUNTS:
        parser.add_argument(name, type=int, default=default, help=f'{words} (default: %(default)s)')
    parser.add_argument('--only', default='', help='only cases whose name contains this')

    def chosen(args: argparse.Namespace) -> list[Case]:
        counts = {name[2:]: getattr(args, name[2:]) for name, *_ in COUNTS}
        listed = short_cases() if args.short else all_cases(**counts)
        return [c for c in listed if args.only in c.key]

    return chosen


def main(argv: Sequence[str] | None = None) -> int:
    parser = options(__doc__, jobs=1)
    chosen = selection(parser)
    parser.add_argument('--score', action='store_true', help='only score the answers that are there, of any tool')
    args = parser.parse_args(argv)
    folder = Path(args.out)
    summary = folder / 'summary.txt'
    if args.score:
        keys = [p.stem for p in sorted((folder / 'sealed').glob('*.json')) if args.only in p.stem]
        return conclude(*score.summary(score.load(folder, keys)), summary)
    cases = chosen(args)
    print(f'{len(cases)} cases; truths sealed: {seal(cases, folder, args.jobs)}')
    (folder / 'answers').mkdir(parents=True, exist_ok=True)
    for _ in over(_answer_case, [(case, folder) for case in cases], args.jobs, 'answers'):
        pass
    return conclude(*score.summary(score.load(folder, [c.key for c in cases])), summary)


if __name__ == '__main__':
    sys.exit(main())
