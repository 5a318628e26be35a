# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Two simulated rigs in one node: the end effector and each link over real DDS."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from psd_deflection.arms.chains.chain import TipDeflection
from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.ros.chain import chain_transforms
from psd_deflection.run.chain import Composed
from test.ros.conftest import BLOCK_NS, stamp
from tools.program import ROOT, Program

pytestmark = pytest.mark.ros
EXAMPLE = ROOT / 'config' / 'two_links.yaml'


@pytest.fixture
def chain(launch: Callable[..., Program], tmp_path: Path) -> Program:
    """The node on the example, which records below ``tmp_path`` when it is asked to."""
    return launch('chain', '--ros-args', '-p', f'chain:={EXAMPLE}', cwd=tmp_path)


def test_end_effector_links_joints_zero_and_recording(chain: Program, peer: Any, tmp_path: Path) -> None:
    ends = peer.collect(PoseWithCovarianceStamped, '/end_effector/deflection')
    topic = '/{}/link_tip/deflection_with_covariance'
    tips = [peer.collect(PoseWithCovarianceStamped, topic.format(name)) for name in ('upper', 'fore')]
    health = peer.collect(DiagnosticArray, '/diagnostics')
    joints = peer.node.create_publisher(JointState, '/joint_states', 10)
    peer.until(lambda: len(ends) >= 30 and all(len(t) >= 30 for t in tips), 'estimates of both links')
    begun = peer.call(SetBool, '/chain/record', SetBool.Request(data=True))
    assert begun.success
    assert peer.call(Trigger, '/chain/zero', Trigger.Request()).message.count('psd_2 (') <= 2

    def rotated() -> bool:
        joints.publish(JointState(name=['elbow', 'wrist'], position=[0.25, math.nan]))
        stated = [v.value for m in health for s in m.status for v in s.values if v.key == 'angle elbow']
        return stated[-1:] == ['0.250000']

    peer.until(rotated, 'the turned joint in /diagnostics')
    ended = peer.call(SetBool, '/chain/record', SetBool.Request(data=False))
    assert {m.header.frame_id for m in ends} == {'end_effector_rest'}
    assert [m[-1].header.frame_id for m in tips] == ['upper_link_tip_rest', 'fore_link_tip_rest']
    # The end effector is composed at the stamps of the first link.
    assert {stamp(m) for m in ends[5:20]} <= {stamp(m) for m in tips[0]}
    assert np.median(np.diff([stamp(m) for m in ends])) == pytest.approx(BLOCK_NS, abs=100_000)
    covariance = np.reshape(ends[-1].pose.covariance, (6, 6))
    assert np.allclose(covariance, covariance.T)
    assert 1e-8 < covariance[0, 0] ** 0.5 < 1e-4
    names = {s.name for m in health for s in m.status}
    assert {'chain: end effector', 'chain/upper: acquisition', 'chain/fore: acquisition'} <= names

    def sound() -> bool:
        return DiagnosticStatus.OK in [s.level for m in health for s in m.status if s.name == 'chain: end effector']

    # A busy machine may be too slow for both links at first.
    peer.until(sound, 'an end effector that is composed')
    folders = [Path(name) for name in ended.message.removeprefix('recording ended: ').split(', ')]
    assert [folder.parts[:2] for folder in folders] == [('recordings', 'upper'), ('recordings', 'fore')]
    for folder in folders:
        assert open_recording(tmp_path / folder).topics()['/link_tip/deflection'] > 5


@pytest.mark.slow
def test_the_frames_lead_from_base_to_deflected_end() -> None:
    file = read_chain(EXAMPLE)
    tips = file.chain.tips_under(np.array([3.0, 5.0, -2.0]), file.angles)
    end = file.chain.compose([TipDeflection(t, np.eye(3)) for t in tips], file.angles)
    sent = {t.child_frame_id: t for t in chain_transforms(file, Composed(5, end))}
    assert list(sent) == [
        *('upper_link_base', 'upper_link_tip', 'fore_link_base', 'fore_link_tip'),
        *('end_effector', 'end_effector_rest'),
    ]
    assert sent['upper_link_tip'].header.frame_id == 'upper_link_tip_rest'
    assert chain_transforms(file, Composed(5, None, 'fore: no estimate')) == []
    # What tf2 makes of them.
    at, frame = np.zeros(3), 'end_effector'
    lengths = {'upper_link_tip_rest': 0.585, 'fore_link_tip_rest': 0.585}
    while frame != 'base_link':
        if frame in lengths:
            at, frame = at + np.array([0.0, 0.0, lengths[frame]]), frame.replace('tip_rest', 'base')
            continue
        t = sent[frame].transform
        v = np.array([t.rotation.x, t.rotation.y, t.rotation.z])
        at = at + 2.0 * np.cross(v, np.cross(v, at) + t.rotation.w * at)
        at = at + np.array([t.translation.x, t.translation.y, t.translation.z])
        frame = sent[frame].header.frame_id
    assert at == pytest.approx(end.deflected.position, abs=1e-12)
