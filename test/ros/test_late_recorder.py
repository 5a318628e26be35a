# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Over real DDS: what a late recorder and the filter's topics give replays bit for bit."""

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import AccelStamped, PoseWithCovarianceStamped, TwistStamped, WrenchStamped
from rclpy.serialization import deserialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

from msg_adapters import RIG, SAMPLES
from psd_deflection.cli.main import main
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.records import KNOWN_LOAD
from psd_deflection.rig.config import load_rig
from psd_deflection.ros.endpoints import message_class, qos
from psd_deflection.ros.topics import PUBLISHED
from psd_deflection.run.fanout import published
from test.late import Heard, written
from test.ros.conftest import BLOCK_NS, stamp
from tools.program import WAIT_S


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
    for subscription in listening:
        peer.node.destroy_subscription(subscription)
    return written(folder / f'late_{len(list(folder.iterdir()))}', heard)


def messages_lost(bag: Path) -> int:
    """Blocks of which it has no sample. A sample that the node itself lost is lost in the replay too."""
    blocks = open_recording(bag).samples['seq'] // load_rig().estimator.block_size
    return int(np.maximum(np.diff(blocks) - 1, 0).sum())


@pytest.mark.slow
def test_late_recorder_of_node_replays_bit_for_bit(
    start: Callable[..., Any], peer: Any, simulated_port: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
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


@pytest.mark.ros
@pytest.mark.slow
def test_velocity_and_filtered_pose_replay_bit_for_bit(
    start: Callable[..., Any], peer: Any, tmp_path: Path, simulated_port: str, capsys: pytest.CaptureFixture[str]
) -> None:
    estimator = start('--port', simulated_port, '--ros-args', '-p', 'filter:=modal', '-p', f'bag_dir:={tmp_path}')
    speeds = peer.collect(TwistStamped, '/link_tip/velocity')
    poses = peer.collect(PoseWithCovarianceStamped, '/link_tip/filtered/deflection')
    health = peer.collect(DiagnosticArray, '/diagnostics')
    load = peer.node.create_publisher(WrenchStamped, '/link_tip/load', 10)
    peer.until(lambda: len(speeds) >= 30, 'velocities')
    begun = peer.call(SetBool, '/estimator/record', SetBool.Request(data=True))
    folder = Path(begun.message.removeprefix('recording to '))
    for force in (0.0, -10.0):
        message = WrenchStamped()
        message.wrench.force.y = force
        for _ in range(5):
            load.publish(message)
            peer.until_of_now(speeds, 'velocities after the load')
    turning = peer.node.create_publisher(AccelStamped, '/link_base/acceleration', 10)
    peer.until(lambda: turning.get_subscription_count() > 0, 'the subscription')

    def count_of(key: str) -> int:
        (status,) = [s for s in health[-1].status if s.name == 'estimator: motion'] if health else [None]
        return int({v.key: v.value for v in status.values}[key]) if status is not None else 0

    now, reported = len(speeds), 0
    while count_of('base accelerations') < 10 or count_of('base accelerations, rejected') < 2 or len(speeds) < now + 50:
        base = AccelStamped()
        base.header.stamp = peer.node.get_clock().now().to_msg()
        base.header.frame_id = 'link_base' if reported % 10 else 'tool0'
        base.accel.angular.x = math.nan if reported % 10 == 5 else float(reported % 7)
        turning.publish(base)
        reported += 1
        assert reported < 1000
        peer.until_of_now(speeds, 'velocities of a turning base')
    peer.call(SetBool, '/estimator/record', SetBool.Request(data=False))
    assert {m.header.frame_id for m in (*speeds, *poses)} == {'link_tip_rest'}
    assert [stamp(m) for m in speeds[:30]] == [stamp(m) for m in poses[:30]]
    assert np.median(np.diff([stamp(m) for m in speeds])) == pytest.approx(BLOCK_NS, abs=100_000)
    covariance = np.reshape(poses[-1].pose.covariance, (6, 6))
    assert 1e-9 < covariance[0, 0] ** 0.5 < 1e-5
    status = next(s for s in health[-1].status if s.name == 'estimator: motion')
    assert status.level in (DiagnosticStatus.OK, DiagnosticStatus.WARN)
    assert float({v.key: v.value for v in status.values}['NIS a sample, dX']) > 0.5
    # Best effort: either may have come first.
    (wanted, *_) = [line for line in estimator.lines if '/link_base/acceleration: rejected' in line]
    assert "frame_id 'tool0': must be link_base" in wanted or 'angular x = nan: must be finite' in wanted
    recording = open_recording(folder)
    annotated = [name for change in recording.changes for name, _ in change.values]
    assert annotated.count(KNOWN_LOAD) == 2
    bases = [base for _, base in recording.accelerations()]
    assert 10 <= len(bases) == recording.topics()['/link_base/acceleration'] <= reported * 8 // 10
    assert {base.angular[0] for base in bases} <= {0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0}
    assert recording.topics()['/link_tip/velocity'] == recording.topics()['/link_tip/filtered/deflection'] > 60
    assert main(['replay', str(folder), '--compare']) == 0
    assert 'no bit differs' in capsys.readouterr().out
