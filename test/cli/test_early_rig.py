# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The simulated rig's process, started before its daemon is ready for it."""

import subprocess
import sys
from pathlib import Path

import pytest

from psd_deflection.cli.run.estimator import simulates_at_once
from psd_deflection.rig.config import load_rig
from psd_deflection.run import simulated_rig
from psd_deflection.run.simulated_rig import SimulatedRigProcess, started_early

# Nothing else shows a process that nobody has taken yet.
WAITING = simulated_rig._waiting
ROOT = Path(__file__).parent.parent.parent


@pytest.mark.parametrize(
    ('overrides', 'ros_arguments', 'wanted'),
    [
        ({}, (), True),
        ({'source': 'dataq'}, ('--ros-args', '-p', 'record:=true'), True),
        ({'port': '/dev/ttyACM0'}, (), False),
        ({'source': 'replay'}, (), False),
        ({'source': 'nonsense'}, (), False),
        ({}, ('--ros-args', '-p', 'port:=/dev/ttyACM0'), False),
        ({}, ('--ros-args', '--params-file', 'rig.yaml'), False),
    ],
)
def test_it_is_started_where_no_port_is_known(
    overrides: dict[str, object], ros_arguments: tuple[str, ...], wanted: bool
) -> None:
    assert simulates_at_once(overrides, ros_arguments) is wanted


def test_early_rig_is_taken_by_first_user_or_closed() -> None:
    with started_early(True):
        (process,) = WAITING
        rig = SimulatedRigProcess(load_rig())
        assert rig.port.startswith('/dev/')
        assert WAITING == []
        assert process.poll() is None
        rig.close()
        assert process.poll() is not None
    with started_early(True):
        (unused,) = WAITING
    assert unused.poll() is not None
    with started_early(False):
        assert WAITING == []


def test_it_ends_without_a_word_when_its_daemon_is_gone_before() -> None:
    command = [sys.executable, '-m', 'psd_deflection.devices.serve']
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')
