# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Halves and doubles each declared threshold of ``discover``, and lists the cases with another answer:
``python -m blind.sweep``; ``--cases hand,null``: only these."""

import ast
import importlib.util
import itertools
import multiprocessing
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blind.campaign import options
from blind.cases import Case, cases_by_hand, designs, scaled, short_cases

TABLES = ('psd_deflection.studies.loads.thresholds', 'psd_deflection.studies.discover.thresholds')
CASES = 'rotation-3-s,creep,spot,pair,alien,mistake,null-s0,wrong-s0,wrong-s1,hand-late,hand-one,plant'


def declared() -> Iterator[tuple[str, str, list[str]]]:
    """Table and name of each threshold; its unit, its reason and what it trades."""
    for table in TABLES:
        spec = importlib.util.find_spec(table)
        body = ast.parse(Path(str(spec and spec.origin)).read_text('utf-8')).body
        for line, below in itertools.pairwise(body):
            if isinstance(line, ast.Assign):
                words = ast.literal_eval(below.value) if isinstance(below, ast.Expr) else ''
                yield table, ast.unparse(line.targets[0]), words.split(' | ')


def asked(names: str) -> list[tuple[Case, list[dict[str, Any]]]]:
    """The cases with one of ``names`` in theirs, and what is hidden in each."""
    subset = [c for c in (*short_cases(), *cases_by_hand(31000, 11)) if any(n in c.key for n in names.split(','))]
    return [(c, [scaled(c.seed, name, gap, designs(c.design)) for name, gap in c.wanted]) for c in subset]


def times(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(times(v, factor) for v in value)
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def answers(job: tuple[str, str, float, Any, bool]) -> dict[str, Any]:
    """What is answered with one threshold changed, in a process that has imported nothing that uses it."""
    table, name, factor, cases, plant = job
    setattr(importlib.import_module(table), name, times(getattr(importlib.import_module(table), name), factor))
    from blind import run
    from psd_deflection.studies.discover.plant_csv import CsvPlant
    from psd_deflection.studies.discover.plant_search import discover_in

    try:
        trees = {case.key: run.answer(case, truth)[0] for case, truth in cases}
        with tempfile.NamedTemporaryFile('w', suffix='.csv') as file:
            u = np.linspace(-1.0, 1.0, 80)
            y = 3.0 * u + 0.4 * u**2 + 0.05 * np.random.default_rng(0).standard_normal(80)
            np.savetxt(file, np.column_stack((u, y)), delimiter=',', header='u,y', comments='')
            file.flush()
            trees |= {'plant': discover_in(CsvPlant(file.name, ['u'], ['y'])).tree()} if plant else {}
    except Exception as error:
        return {repr(error): None}
    return {key: named(tree) for key, tree in trees.items()}


def named(tree: dict[str, Any]) -> Any:
    """What an answer names, without its numbers."""
    effects = sorted((e['name'], *sorted(e.get('equivalent', ()))) for e in tree['effects'])
    laws = [bool(u.get('law')) for u in tree['unknown']]
    return tree['verdict'], effects, sorted((s['name'], s['where']) for s in tree.get('setup', ())), laws


def main() -> None:
    parser = options(__doc__)
    parser.add_argument('--cases', default=CASES)
    names = parser.parse_args().cases
    cases, plant = asked(names), 'plant' in names
    jobs = [(table, name, factor, cases, plant) for table, name, _ in declared() for factor in (0.5, 2.0)]
    with multiprocessing.get_context('fork').Pool(1, maxtasksperchild=1) as pool:
        got = pool.imap(answers, [(*jobs[0][:2], 1.0, cases, plant), *jobs])
        usual = next(got)
        for (_, name, factor, *_), other in zip(jobs, got, strict=True):
            keys = [key for key in {**usual, **other} if usual.get(key) != other.get(key)]
            print(f'{name} x {factor:g}: {len(keys)} of {len(usual)} {" ".join(keys)}', flush=True)


if __name__ == '__main__':
    main()
