# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rows of ``make bench``: their ratios and bounds, the file that keeps them, and the page that is made of it."""

import pytest

from bench import cpu, page
from bench.rows import ROOT, Row, figure, read

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


def test_the_page_is_made_of_the_results() -> None:
    assert page.PAGE.read_text(encoding='utf-8') == page.page(*read(), *read(cpu.RESULTS))
    assert '<!--' not in page.PAGE.read_text(encoding='utf-8')
    assert page.PAGE == ROOT / 'docs' / 'performance.md'
    text = page.README.read_text(encoding='utf-8')
    assert page.readme(text, read()[0]) == text
    assert sum(line.endswith(page.PRINTED_BY) for line in text.split('\n')) == 3
