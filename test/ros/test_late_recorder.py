# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recorder that joins a running node late, over real DDS: its bag replays bit for bit."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from msg_adapters import RIG, SAMPLES
from psd_deflection.cli.main import main
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.rig.config import load_rig
from psd_deflection.ros.endpoints import message_class, qos
from psd_deflection.ros.topics import PUBLISHED
from psd_deflection.run.fanout import published
from test.late import Heard, written
from tools.program import WAIT_S

pytestmark = pytest.mark.slow


def recorded_late(peer: Any, poses: list[Any], folder: Path) -> Path:
    """A bag of what is heard from now on until two seconds after the node has told all that it remembers."""
    heard: list[Heard] = []
    listening = []
    # Those that a rig publishes in its namespace; of the samples none may be lost, so the rig first.
    for topic, kind in published(load_rig()).items():
        name = topic if topic == '/diagnostics' else f'/arm{topic}'

        def take(message: bytes, name: str = name, kind: str = kind) -> None:
            heard.append(Heard(name, kind, message, time.time_ns()))

        delivery = qos(PUBLISHED[topic].delivery)
        # What is not taken at once waits: a busy machine may give this process no turn for a second.
        delivery.depth = 1000
        listening.append(peer.node.create_subscription(message_class(kind), name, take, delivery, raw=True))

    def memories() -> int:
        texts = (deserialize_message(m.cdr, String).data for m in heard if m.topic == f'/arm{RIG}')
        return sum('memory' in json.loads(text) for text in texts)

    # The latched one is of before it joined; on a busy machine the samples come after it, and others with it.
    peer.until(lambda: any(m.topic == f'/arm{SAMPLES}' for m in heard), 'the first samples')
    before = max(memories(), 1)
    peer.until(lambda: memories() > before, 'the next memory')
    observed = len(poses)
    peer.until(lambda: len(poses) >= observed + 100, 'two seconds after it')
    for one in listening:
        peer.node.destroy_subscription(one)
    return written(folder / f'late_{len(list(folder.iterdir()))}', heard)


def messages_lost(bag: Path) -> int:
    """Blocks of which it has no sample. A sample that the node itself lost is lost in the replay too."""
    blocks = open_recording(bag).samples['seq'] // load_rig().estimator.block_size
    return int(np.maximum(np.diff(blocks) - 1, 0).sum())


def test_late_recorder_of_node_replays_bit_for_bit(
    start: Callable[..., Any],
    peer: Any,
    simulated_port: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    start('--port', simulated_port, '--ros-args', '-p', 'keep_zero:=false', '-r', '__ns:=/arm')
    poses = peer.collect(message_class('geometry_msgs/msg/PoseStamped'), '/arm/link_tip/deflection')
    peer.until(lambda: len(poses) >= 150, 'a run of three seconds')
    deadline = time.monotonic() + WAIT_S
    # Where this process is starved, DDS drops messages before they are taken: what is then written is no judge.
    while messages_lost(bag := recorded_late(peer, poses, tmp_path)):
        assert time.monotonic() < deadline, f'{bag}: nothing but recordings with losses'
    assert main(['replay', str(bag), '--compare']) == 0
    output = capsys.readouterr().out
    assert 'starts in mid-run; compared from block' in output
    assert 'no bit differs' in output
