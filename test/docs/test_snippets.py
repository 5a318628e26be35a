# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A rig's lines in the documents can be pasted into a file as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from psd_deflection.rig.config import load_rig
from psd_deflection.rig.declarations import BY_NAME
from tools.program import ROOT

PAGES = sorted([ROOT / 'README.md', *(ROOT / 'docs').rglob('*.md')])
SNIPPETS = [
    (page.relative_to(ROOT), text)
    for page in PAGES
    for text in re.findall(r'^```yaml\n(.*?)^```', page.read_text(encoding='utf-8'), re.MULTILINE | re.DOTALL)
]
SECTIONS = {name.partition('.')[0] for name in BY_NAME} | {'effects'}
NO_RIGS = {'target', 'connection', 'name', 'distributed', 'scrape_configs', 'controller_manager'}


def test_there_are_snippets_of_rigs() -> None:
    assert sum('ros__parameters' in text for _, text in SNIPPETS) >= 5


@pytest.mark.parametrize(('page', 'text'), SNIPPETS, ids=[f'{p.stem}_{i}' for i, (p, _) in enumerate(SNIPPETS)])
def test_a_rig_in_a_page_can_be_pasted(page: Path, text: str, tmp_path: Path) -> None:
    tree = YAML(typ='safe').load(text)
    if not isinstance(tree, dict):
        return
    bare = set(tree) & SECTIONS - NO_RIGS
    assert not bare, f'{page}: {", ".join(bare)}: below "/**: ros__parameters:"'
    if '/**' in tree:
        (tmp_path / 'rig.yaml').write_text(text, encoding='utf-8')
        assert load_rig(tmp_path / 'rig.yaml').psds
