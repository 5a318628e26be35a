# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the pages on devices print is what the code takes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from psd_deflection.devices.protocol.text_lines import Description, Line, parse
from psd_deflection.devices.registry import DEVICES
from psd_deflection.rig.config import load_rig

PAGES = Path(__file__).parent.parent.parent / 'docs' / 'devices'


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf'```{language}\n(.*?)```', (PAGES / page).read_text(), re.DOTALL)


def test_every_source_has_its_row() -> None:
    table, _, _ = (PAGES / 'README.md').read_text().partition('\n## ')
    rows = re.findall(r'^\| `(\w+)` \|', table, re.MULTILINE)
    assert rows == list(DEVICES)


@pytest.mark.parametrize('page', [f'{name}.md' for name in DEVICES if name not in ('serial', 'replay')])
def test_the_parameters_of_a_page_are_parameters(page: str, tmp_path: Path) -> None:
    (text,) = blocks(page, 'yaml')
    path = tmp_path / 'rig.yaml'
    path.write_text(text)
    assert load_rig(path).acquisition.source == page.removesuffix('.md')


def test_the_example_lines_are_lines() -> None:
    (example,) = blocks('lines.md', '')[:1]
    items = [parse(line.encode()) for line in example.splitlines()]
    assert [type(i) for i in items] == [Description, Line, Line]


def test_the_sketch_is_of_twenty_lines_and_describes_itself() -> None:
    (sketch,) = blocks('lines.md', 'cpp')
    assert len(sketch.splitlines()) <= 21
    described = re.search(r'F\("(.*)"\)', sketch)
    assert described is not None
    item = parse(described[1].replace('\\"', '"').encode())
    assert item == Description({'serial': 'UNO-1', 'sample_rate_hz': 100})
