# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One reading of numbers in texts, and every part uses it."""

from __future__ import annotations

import ast
import math
from pathlib import Path

import pytest

import psd_deflection
from psd_deflection.arms.compensation.arm import read_arm
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.numbers import plain_number
from psd_deflection.camera.footage import Footage
from psd_deflection.cli.main import main
from psd_deflection.model.simulation.load_words import load_history
from psd_deflection.rig.config import load_rig

PACKAGE = Path(psd_deflection.__file__).parent
ODD = ['-1_0', '1_000', '٣', '１', '0x10', '1e', '', 'one', '1 2']


@pytest.mark.parametrize('text', ODD)
def test_what_is_no_number_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match='is not a number'):
        plain_number(text)


@pytest.mark.parametrize('text', [' 1.5 ', '-3', '+.5', '69e9', '1e-05', '2.'])
def test_what_loggers_write_is_read_as_python_reads_it(text: str) -> None:
    assert plain_number(text) == float(text)


def test_what_is_not_finite_is_for_the_caller_to_judge() -> None:
    assert math.isnan(plain_number('nan'))
    assert plain_number('-Inf') == -math.inf


@pytest.mark.parametrize('text', ['-1_0', '٣'])
def test_parameters_options_loads_frames_and_arms_reject_it(text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match='must be a number'):
        load_rig(overrides={'link.length': text})
    with pytest.raises(ConfigError, match='not a list of numbers'):
        load_history(f'constant:0,{text},0:20', 1000.0)
    (tmp_path / 'frames.csv').write_text(f'file,t,exposure\na.png,{text},0\n')
    with pytest.raises(RecordingError, match=r"column t holds '.*', which is not a number"):
        Footage(str(tmp_path), 0.0)
    urdf = tmp_path / 'arm.urdf'
    urdf.write_text(
        '<robot name="a"><link name="base"/><link name="tool"/><joint name="j" type="revolute"><parent link="base"/>'
        f'<child link="tool"/><axis xyz="0 0 1"/><limit lower="{text}" upper="1" velocity="1" effort="1"/>'
        '</joint></robot>'
    )
    with pytest.raises(ConfigError, match='must be 1 finite number'):
        read_arm(urdf, 'tool')
    assert main(['load', '--url', 'http://127.0.0.1:1/', '--', '0', text, '0']) == 2


def _readings(node: ast.AST) -> list[ast.expr]:
    """Where a text may become a number: as the type of an option; ``float(x)`` if ``x`` may be none (ValueError)."""
    if isinstance(node, ast.keyword) and node.arg == 'type' and _is_reader(node.value):
        return [node.value]
    if not isinstance(node, ast.Try) or not any(h.type and 'ValueError' in ast.unparse(h.type) for h in node.handlers):
        return []
    calls = [n for statement in node.body for n in ast.walk(statement) if isinstance(n, ast.Call) and n.args]
    of_map = [c for c in calls if isinstance(c.func, ast.Name) and c.func.id == 'map' and _is_reader(c.args[0])]
    direct = [c for c in calls if _is_reader(c.func) and not _is_checked(node, c)]
    return [*of_map, *direct]


def _is_reader(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id == 'float'


def _is_checked(attempt: ast.Try, call: ast.Call) -> bool:
    """Whether the same attempt reads the text by ``plain_number`` before."""
    return 'plain_number' in ast.unparse(attempt) and 'isinstance' in ast.unparse(attempt)
