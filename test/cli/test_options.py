# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Options that set declared parameters."""

from __future__ import annotations

import argparse
from typing import Any

import pytest

from psd_deflection.arms.compensation.settings import SETTINGS
from psd_deflection.arms.compensation.shaping import SHAPING
from psd_deflection.base.errors import UsageError
from psd_deflection.cli import _options
from psd_deflection.rig.parameters import Parameter, Section

SECTIONS: list[Section[Any]] = [SETTINGS, SHAPING]


def as_written(declared: Parameter) -> str:
    """The default, as a person writes it."""
    default = declared.default
    if isinstance(default, bool):
        return str(default).lower()
    return ','.join(map(str, default)) if isinstance(default, list) else str(default)


@pytest.mark.parametrize('section', SECTIONS)
def test_the_default_of_every_option_can_be_written(section: Section[Any]) -> None:
    parser = argparse.ArgumentParser()
    _options.section_options(parser, section)
    written = [(p.name.replace('_', '-'), as_written(p)) for p in section.parameters.values()]
    words = [f'--{name}={text}' for name, text in written if text]
    assert words
    given = parser.parse_args(words)
    assert _options.of_options(given, section) == _options.of_options(parser.parse_args([]), section)


def test_a_switch_takes_true_and_false() -> None:
    parser = argparse.ArgumentParser()
    _options.section_options(parser, SECTIONS[0])
    assert parser.parse_args(['--takeover', 'false']).takeover is False
    assert parser.parse_args(['--takeover', 'True']).takeover is True
    with pytest.raises(UsageError, match='must be true or false'):
        parser.parse_args(['--takeover=maybe'])
