# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the pages say of settings is what is declared, and bounds are round numbers."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from psd_deflection.arms.chains import chain_file
from psd_deflection.arms.compensation import settings, shaping
from psd_deflection.rig.parameters import Section

DOCS = Path(__file__).parents[2] / 'docs'
ROW = re.compile(r'^\| (`[^|]*`) \| ([^|]+) \|', re.MULTILINE)
SECTIONS = (settings.SETTINGS, shaping.SHAPING, chain_file.SETTINGS, chain_file.JOINT, chain_file.LINK)


def stated(page: str) -> dict[str, str]:
    """Of each name in the first column of a page's tables, the first word of the second."""
    found: dict[str, str] = {}
    for names, values in ROW.findall((DOCS / page).read_text()):
        words = [value.split()[0] for value in values.split(', ') if value.split()]
        found |= dict(zip(re.findall('`([^`]*)`', names), words, strict=False))
    return found


def test_the_page_has_the_defaults_of_the_compensator() -> None:
    message, declared = stated('compensation.md'), settings.SETTINGS.parameters
    numbers = {p.name: p.default for p in declared.values() if p.live}
    assert {name: float(message[name]) for name in numbers} == numbers
    assert (message['takeover'], declared['takeover'].default) == ('true', True)


def test_what_may_be_set_while_a_node_runs_is_what_the_pages_say() -> None:
    assert {p.name for p in shaping.SHAPING.parameters.values() if p.live} == {'max_step', 'lead'}
    at_start = {p.name for p in settings.SETTINGS.parameters.values() if not p.live}
    of_the_arm = {'tip', 'base', 'urdf', 'joints'}
    of_the_controller = {'drive', 'output', 'takeover', 'controller_state'}
    assert at_start == {'axes', 'frame_prefix', *of_the_arm, *of_the_controller}


@pytest.mark.parametrize('section', SECTIONS, ids=lambda s: next(iter(s.parameters)))
def test_bounds_are_round(section: Section[object]) -> None:
    """One, two or five times a power of ten, or 0.9 of a ratio below 1: what a person chose."""
    for p in section.parameters.values():
        for bound in (p.minimum, p.maximum, p.above):
            if bound:
                digits = f'{abs(bound):e}'.split('e')[0].rstrip('0').rstrip('.')
                assert digits in ('1', '2', '5') or bound == 0.9, f'{p.name}: {bound}'
