# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whatever a plug-in does on import ends in one error that names it, for every group of entry points."""

import ast
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.plugins import loaded
from psd_deflection.devices import registry
from psd_deflection.devices.registry import find_device, known_devices
from psd_deflection.model.simulation import catalogue

PACKAGE = Path(psd_deflection.__file__).parent


@pytest.mark.parametrize(
    ('code', 'cause'),
    [
        ('import sys; sys.exit(7)', 'SystemExit: 7'),
        ('raise SystemExit', 'SystemExit'),
        ('raise GeneratorExit', 'GeneratorExit'),
        ('1 / 0', 'ZeroDivisionError'),
        ('import no_such_module', 'no_such_module'),
        ('x = (', 'SyntaxError'),
    ],
)
def test_a_plug_in_that_ends_is_an_error_of_either_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, cause: str
) -> None:
    (tmp_path / 'ending_plug_in.py').write_text(code)
    monkeypatch.syspath_prepend(tmp_path)

    def points(group: str) -> list[EntryPoint]:
        return [EntryPoint('ending', 'ending_plug_in:THING', group)]

    monkeypatch.setattr(registry, 'entry_points', points)
    monkeypatch.setattr('importlib.metadata.entry_points', points)
    with pytest.raises(ConfigError, match=cause) as rejected:
        find_device('ending')
    assert "source = 'ending': ending_plug_in:THING" in str(rejected.value)
    devices, rejections = known_devices()
    assert devices
    assert len(rejections) == 1
    with pytest.raises(ConfigError, match=cause) as rejected:
        catalogue.catalogue()
    assert 'ending_plug_in:THING' in str(rejected.value)


def test_ctrl_c_still_ends_the_program() -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loaded('a plug-in', interrupted)


def test_who_looks_for_entry_points_loads_them_by_the_one_loader() -> None:
    for path in PACKAGE.rglob('*.py'):
        tree = ast.parse(path.read_text())
        names: set[Any] = {n.attr if isinstance(n, ast.Attribute) else getattr(n, 'id', None) for n in ast.walk(tree)}
        if names & {'entry_points', 'exec_module'}:
            assert 'loaded' in names, f'{path}: loads a plug-in without base.plugins.loaded'
