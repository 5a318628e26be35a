# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The campaign of strange messages: what it sends, and that it can fail."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')

from rclpy.serialization import deserialize_message  # noqa: E402
from sensor_msgs.msg import BatteryState, JointState  # noqa: E402

from bench.campaign.attacked import GOOD, NODES, UnknownInputError, good_of  # noqa: E402
from bench.campaign.messages import Budget  # noqa: E402
from bench.campaign.strange import Stranger  # noqa: E402
from test.ros.test_conformance import nodes_of_setup  # noqa: E402
from tools.program import ROOT, WAIT_S  # noqa: E402

ENDED = """
import sys
from bench.campaign.messages import main
from psd_deflection.arms.inputs import KnownJoints
def broken(*_):
    raise RuntimeError('a defect')
KnownJoints.notify = broken
sys.exit(main())
"""


def test_every_node_is_attacked() -> None:
    assert set(NODES) == set(nodes_of_setup())


@pytest.mark.parametrize('topic', GOOD)
def test_good_messages_become_strange_ones_of_their_type(topic: str) -> None:
    good, stranger, again = GOOD[topic](), Stranger(3), Stranger(3)
    kind = type(good)
    encoded = set()
    for _ in range(40):
        content, damaged = stranger.encode(stranger.change(GOOD[topic]()))
        if not damaged:
            assert isinstance(deserialize_message(content, kind), kind)
        encoded.add(content)
    assert len(encoded) > 1
    assert again.chance.random() == Stranger(3).chance.random()


def test_an_input_without_a_good_message_ends_the_campaign() -> None:
    with pytest.raises(UnknownInputError, match='/battery'):
        good_of('/left/battery', BatteryState)
    with pytest.raises(UnknownInputError, match='/joint_states'):
        good_of('/left/joint_states', BatteryState)
    assert type(good_of('/left/joint_states', JointState)()) is JointState


def test_a_budget_is_of_messages_or_of_time() -> None:
    assert [Budget(10, 0.0).share(n) for n in (0, 5, 10)] == [0.0, 0.5, 1.0]
    assert Budget(10, 1e9).share(10**6) < 1.0


@pytest.mark.parametrize(('script', 'wanted'), [('', 0), (ENDED, 1)])
def test_a_node_that_holds_and_one_that_ends(domain: int, script: str, wanted: int) -> None:
    command = ['-c', script] if script else ['-m', 'bench.campaign.messages']
    words = [sys.executable, *command, '300', '--node', 'shaper', '--dds', '0']
    ended = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert ended.returncode == wanted, ended.stderr[-3000:]
    assert ('EndedError' in ended.stderr) == bool(script)
