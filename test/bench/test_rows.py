# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page of ``make bench`` is made of the file that keeps its rows."""

import pytest

from bench import cpu, page
from bench.rows import ROOT, read

pytestmark = pytest.mark.slow


def test_the_page_is_made_of_the_results() -> None:
    assert page.PAGE.read_text(encoding='utf-8') == page.page(*read(), *read(cpu.RESULTS))
    assert '<!--' not in page.PAGE.read_text(encoding='utf-8')
    assert page.PAGE == ROOT / 'docs' / 'performance.md'
    text = page.README.read_text(encoding='utf-8')
    assert page.readme(text, read()[0]) == text
    assert sum(line.endswith(page.PRINTED_BY) for line in text.split('\n')) == 3
