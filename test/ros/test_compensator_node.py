"""The loop closed over real DDS: a simulated arm of two links, its deflection, and the offsets of its joints."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402

from bench.campaign.hold import FAULTS, URDF, Plant, faithful  # noqa: E402
from test.ros.conftest import WARNINGS  # noqa: E402
from tools.program import PSD_DEFLECTION, ROOT, WAIT_S, Program  # noqa: E402

ARGUMENTS = ('compensator', str(URDF), '--tip', 'tool', '--axes', 'x,z', '--drive')

HANGS = """
import sys
from pathlib import Path
from psd_deflection.cli.main import main
from psd_deflection.ros.compensator import CompensatorNode
def hang(self, request, response):
    print('hangs', flush=True)
    sys.stdin.read()
    return response
first = CompensatorNode._enable
CompensatorNode._enable = lambda *words: (first if words[1].data else hang)(*words)
sys.exit(main())
"""
"""Our program, whose main thread waits for its input for ever when the offsets are to be released."""


@pytest.fixture
def compensator(domain: int) -> Iterator[Program]:
    # A busy machine is late; test/arms/compensation has the default of 0.08 s.
    command = [*PSD_DEFLECTION, *ARGUMENTS, '--stale', '0.5']
    one = Program(command, env={'PYTHONWARNINGS': WARNINGS})
    yield one
    one.end()
    print(*one.lines[-50:], sep='\n')


def test_the_loop_is_closed_held_and_handed_over(compensator: Program, peer: Any) -> None:
    plant = Plant(peer.node)
    peer.until(lambda: len(plant.offsets) > 20, 'offsets')
    assert not np.any(plant.offsets)
    free = plant.error()
    assert free > 2e-3
    # Closed.
    assert peer.call(SetBool, '/compensator/enable', SetBool.Request(data=True)).success
    peer.until(lambda: plant.error() < 0.02 * free, 'an error of less than 2 %')

    # Held.
    for fault, why in FAULTS.values():
        said = len(compensator.text)
        plant.tell = fault

        def holds(said: int = said, why: str = why) -> bool:
            return re.search(f'holding: .*{why}', compensator.text[said:]) is not None

        peer.until(holds, why)
        # What was on its way before it held has come.
        held = len(plant.offsets) + 5
        peer.until(lambda held=held: len(plant.offsets) > held + 20, 'offsets that are held')
        assert np.ptp(plant.offsets[held:], axis=0).max() == 0.0
        said = len(compensator.text)
        plant.tell = faithful
        peer.until(lambda said=said: 'following' in compensator.text[said:], 'following')
    reports = peer.collect(DiagnosticArray, '/diagnostics')
    peer.until(lambda: bool(reports), 'diagnostics')
    assert [s.name for s in reports[0].status] == ['compensator: offsets']
    # Handed over: it ends at no offset.
    compensator.process.send_signal(2)
    peer.until(lambda: not np.any(plant.offsets[-1]), 'no offset')
    steps = np.abs(np.diff(plant.offsets, axis=0)).max()
    assert compensator.wait() == 0
    assert steps < 0.1 * 0.1 * 1.001


def test_a_main_thread_that_hangs_does_not_keep_the_offsets_from_holding(domain: int, peer: Any) -> None:
    reading, writing = os.pipe()
    process = subprocess.Popen([sys.executable, '-c', HANGS, *ARGUMENTS, '--stale', '0.5'], cwd=ROOT, stdin=reading)
    os.close(reading)
    try:
        plant = Plant(peer.node)
        peer.until(lambda: len(plant.offsets) > 20, 'offsets')
        free = plant.error()
        assert peer.call(SetBool, '/compensator/enable', SetBool.Request(data=True)).success
        peer.until(lambda: plant.error() < 0.5 * free, 'offsets that follow')
        client = peer.node.create_client(SetBool, '/compensator/enable')
        peer.until(client.service_is_ready, 'the service')
        client.call_async(SetBool.Request(data=False))
        # Deflections go on, and nobody takes them: after the half second they are stale.
        asked = time.monotonic()
        peer.until(lambda: time.monotonic() > asked + 1.0, 'a second')
        held = len(plant.offsets)
        peer.until(lambda: len(plant.offsets) > held + 30, 'offsets of a thread that is not the main one')
        assert np.any(plant.offsets[-1])
        assert np.ptp(plant.offsets[held:], axis=0).max() == 0.0
    finally:
        os.close(writing)
        process.terminate()
        process.wait(WAIT_S)
