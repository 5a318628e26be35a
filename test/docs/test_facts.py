# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files, options and defaults that the pages name in running text are those of the program."""

from __future__ import annotations

import re

import pytest

from psd_deflection.arms.compensation.shaping import SHAPING
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.rig.parameters import Section
from tools.program import ROOT
from tools.run_commands import FENCE, PAGES

FOLDERS = 'bags|bench|blind|config|docs|launch|msg_adapters|packaging|psd_deflection|resource|test|tools'
OF_OTHERS = {'--group-add', '--show-args', '--log-level'}
"""Options of Docker, ros2 launch and rcl."""
SPOKEN = [
    (page.name, code) for page in PAGES for code in re.findall(r'`([^`\n]+)`', FENCE.sub('', page.read_text('utf-8')))
]


def test_every_file_named_on_a_page_exists() -> None:
    named = [(page, code) for page, code in SPOKEN if re.fullmatch(rf'(?:{FOLDERS})/[\w./-]+', code)]
    assert len(named) > 30
    # NAME and ROOM stand for any.
    missing = [(page, code) for page, code in named if not re.search('[A-Z]{4}', code) and not (ROOT / code).exists()]
    assert missing == []


def test_every_option_named_on_a_page_is_declared() -> None:
    folders = ('psd_deflection', 'bench', 'blind', 'tools')
    sources = [ROOT / 'test/conftest.py', *(path for folder in folders for path in (ROOT / folder).rglob('*.py'))]
    text = '\n'.join(path.read_text('utf-8') for path in sources)
    declared = set(re.findall(r"""['"`](--[a-z][a-z-]*)""", text)) | OF_OTHERS
    # The options of settings are made of their fields.
    declared |= {f'--{name.replace("_", "-")}' for name in re.findall(r'^    (\w+): .*= parameter\(', text, re.M)}
    ours = [
        (page, code) for page, code in SPOKEN if not re.match(r'(apt|curl|docker|git|mcap|pip|ros2|ssh|uvx) ', code)
    ]
    named = {(page, option) for page, code in ours for option in re.findall(r'(?<![\w-])--[a-z][a-z-]*', code)}
    assert len(named) > 60
    assert {(page, option) for page, option in named if option not in declared} == set()


def rows(page: str) -> dict[str, list[str]]:
    """The first three cells of each row whose first cell has names, by name; several names share a row."""
    found: dict[str, list[str]] = {}
    for line in (ROOT / 'docs' / page).read_text('utf-8').splitlines():
        cells = [cell.strip() for cell in line.strip('|').split('|')]
        for name in re.findall('`([^`]+)`', cells[0]) if line.startswith('| `') else []:
            found[name] = cells[1:3]
    return found


@pytest.mark.parametrize('name', ['max_step', 'lead'])
def test_defaults_of_the_shaper_are_on_its_page(name: str) -> None:
    stated = rows('shaping.md')[f'--{name.replace("_", "-")}'][0].split()[0]
    assert float(stated) == SHAPING.parameters[name].default


def test_defaults_of_the_camera_are_on_its_page() -> None:
    stated = rows('camera.md')
    declared = Section(CameraSettings).parameters
    for names in (('spacing', 'radius'), ('square', 'marker', 'gap'), ('turn',), ('exposure',), ('rest_frames',)):
        given = [float(number) for number in stated[declared[names[0]].name][1].split(', ')]
        assert given == [declared[name].default for name in names]
