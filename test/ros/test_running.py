# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How rclpy is started."""

from __future__ import annotations

import os

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')

from psd_deflection.ros.running import OTHER_CHOICES, TRANSPORTS, ros  # noqa: E402


@pytest.mark.slow
@pytest.mark.parametrize('shared_memory', [False, True])
def test_a_process_that_is_killed_makes_no_other_deaf(
    domain: int, monkeypatch: pytest.MonkeyPatch, shared_memory: bool
) -> None:
    for choice in OTHER_CHOICES:
        monkeypatch.setenv(choice, '')
        monkeypatch.delenv(choice)
    with ros('one', [], shared_memory):
        assert os.environ.get(TRANSPORTS) == (None if shared_memory else 'UDPv4')


@pytest.mark.slow
@pytest.mark.parametrize('choice', OTHER_CHOICES)
def test_the_choice_of_the_user_stays(domain: int, monkeypatch: pytest.MonkeyPatch, choice: str) -> None:
    for one in OTHER_CHOICES:
        monkeypatch.setenv(one, '')
        monkeypatch.delenv(one)
    monkeypatch.setenv(choice, 'SHM' if choice == TRANSPORTS else '')
    with ros('one', []):
        assert os.environ.get(TRANSPORTS) == ('SHM' if choice == TRANSPORTS else None)
