# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rows of ``make bench``: their ratios and bounds, the file that keeps them, and the page that is made of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench import cpu, limits, page
from bench.rows import ROOT, Row, figure, keep, read

pytestmark = pytest.mark.slow


def test_ratios_and_bounds_are_those_of_peers_and_limits() -> None:
    ours, peer = figure('mine', 'ours', [2.0, 1.8, 2.2]), figure('theirs', 'peer', [6.0], 3.0)
    limit, slow = figure('least', 'limit', [1.0], 1.5), figure('theirs', 'peer', [6.0], 3.1)
    row = Row('work', 's', [ours, peer, limit, slow])
    assert (ours.median, ours.low, ours.high, ours.runs) == (2.0, 1.9, 2.1, 3)
    assert (row.ratio(peer), row.ratio(limit)) == (3.0, 2.0)
    assert [row.met(f) for f in row.figures] == [True, True, False, False]
    assert not Row('rigs', 'rigs', [few := figure('8', 'ours', [8], 32)]).met(few)
    assert page.lines_of(row) == [
        '| work | 2 [1.9–2.1] s | peer: theirs, 6 | 3.00 × (≥ 3: met) |',
        '|  |  | limit: least, 1 | 2.00 × (≤ 1.5: **not met**) |',
        '|  |  | peer: theirs, 6 | 3.00 × (≥ 3.1: **not met**) |',
    ]


def test_a_row_in_which_outside_load_shows_is_not_judged() -> None:
    steady, torn = figure('mine', 'ours', [1.0, 1.1, 0.9]), figure('least', 'limit', [1.0, 1.0, 1.6], 0.5)
    message = 'not judged: quartiles 30 % apart, load from outside'
    assert Row('work', 's', [steady, torn]).verdict(torn) == message
    assert page.lines_of(Row('work', 's', [steady, torn]))[0].endswith(f': {message}) |')
    once = figure('least', 'limit', [1.0], 0.5)
    assert Row('work', 's', [steady, once]).verdict(once) == 'not met'
    assert Row('work', 's', [figure('mine', 'ours', [1.0, 1.0, 1.6]), once]).verdict(once) == message
    assert Row('work', 's', [steady, figure('least', 'limit', [1.0])]).verdict(figure('least', 'limit', [1.0])) == ''


def test_a_row_replaces_the_older_one_of_its_work(tmp_path: Path) -> None:
    path = tmp_path / 'results.json'
    keep([Row('a', 's', [figure('x', 'ours', [1.0])]), Row('b', 's', [figure('x', 'ours', [1.0])])], path)
    keep([Row('a', 's', [figure('x', 'ours', [2.0])])], path)
    rows, machine = read(path)
    assert [(row.work, row.figures[0].median) for row in rows] == [('a', 2.0), ('b', 1.0)]
    assert machine['versions']['numpy']


def test_the_page_is_made_of_the_results() -> None:
    assert page.PAGE.read_text(encoding='utf-8') == page.page(*read(), *read(cpu.RESULTS))
    assert '<!--' not in page.PAGE.read_text(encoding='utf-8')
    assert page.PAGE == ROOT / 'docs' / 'performance.md'
    text = page.README.read_text(encoding='utf-8')
    assert page.readme(text, read()[0]) == text
    assert sum(line.endswith(page.PRINTED_BY) for line in text.split('\n')) == 3


@pytest.mark.parametrize('rows', [lambda: limits.frames(1), lambda: limits.simulation(1)], ids=['frames', 'simulation'])
def test_a_row_can_be_measured(rows: object) -> None:
    assert callable(rows)
    for row in rows():
        assert row.figures[0].kind == 'ours'
        assert {f.kind for f in row.figures} == {'ours', 'peer', 'limit'}
