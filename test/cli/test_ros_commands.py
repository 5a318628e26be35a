# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The commands that need ROS 2, on a machine that has none, or no shared memory for it."""

from __future__ import annotations

import importlib.util
import os
from types import SimpleNamespace
from typing import Any

import pytest

from psd_deflection.cli.main import main
from tools.program import ROOT

CHAIN = str(ROOT / 'config' / 'two_links.yaml')
COMMANDS = [
    ['estimator'],
    ['chain', CHAIN],
    ['compensator', '--tip', 'tool'],
    ['shaper', '--frequency', '12'],
    ['camera'],
]


@pytest.mark.parametrize('words', COMMANDS, ids=lambda words: words[0])
def test_full_shared_memory_is_reported_before_ros_starts(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """ROS 2 would end the process by SIGBUS."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, 'find_spec', lambda name: find('sys' if name == 'rclpy' else name))
    asked: list[Any] = []

    def full(path: str) -> Any:
        asked.append(path)
        return SimpleNamespace(f_bavail=15, f_frsize=4096)

    monkeypatch.setattr(os, 'statvfs', full)
    assert main(words) == 71
    assert asked == ['/dev/shm']
    assert '/dev/shm has 61440 bytes left, ROS 2 needs 65536: delete what nobody uses' in capsys.readouterr().err
