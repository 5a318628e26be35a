# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node's states, its zero from run to run, and its end in every state."""

import itertools
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import GetState
from rcl_interfaces.msg import Log, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.base.log import null_log
from psd_deflection.devices.ports import SerialPort
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.ros import estimator, node
from psd_deflection.ros.running import OTHER_CHOICES, TRANSPORTS, ros
from test.heard import WAIT_S
from test.ros.conftest import LATCHED, PATIENT, stamp

pytestmark = pytest.mark.ros


def change(peer: Any, transition: int) -> bool:
    return bool(peer.change('/estimator', transition))


def state(peer: Any) -> int:
    return int(peer.call(GetState, '/estimator/get_state', GetState.Request()).current_state.id)


def parameters(peer: Any, *names: str) -> list[Any]:
    answer = peer.call(GetParameters, '/estimator/get_parameters', GetParameters.Request(names=list(names)))
    return [list(v.double_array_value) for v in answer.values]


def test_states_one_after_the_other(start: Callable[..., Any], peer: Any, simulated_port: str, tmp_path: Path) -> None:
    bags = tmp_path / 'bags'
    words = ('autostart:=false', f'bag_dir:={bags}', 'record:=true', 'markers:=true')
    daemon = start('--port', simulated_port, '--ros-args', *(w for word in words for w in ('-p', word)))
    daemon.until('waiting to be configured')
    assert state(peer) == State.PRIMARY_STATE_UNCONFIGURED
    poses = peer.collect(PoseStamped, '/link_tip/deflection')
    markers = peer.collect(MarkerArray, '/link_tip/markers')
    health = peer.collect(DiagnosticArray, '/diagnostics')
    peer.until(lambda: any(s.message == 'not configured' for m in health for s in m.status), 'STALE')
    assert peer.call(Trigger, '/estimator/zero', Trigger.Request()).message == 'not zeroed: the node is not configured'
    assert not peer.call(SetBool, '/estimator/record', SetBool.Request(data=True)).success
    # The port is not ours yet: somebody else can have it.
    SerialPort(simulated_port, 921_600).close()
    assert change(peer, Transition.TRANSITION_CONFIGURE)
    assert state(peer) == State.PRIMARY_STATE_INACTIVE
    with pytest.raises(DeviceError, match='another program has the port open'):
        SerialPort(simulated_port, 921_600)
    observed = len(health)
    peer.until(lambda: len(health) > observed + 1, 'diagnostics while inactive')
    assert not poses
    assert not markers
    assert change(peer, Transition.TRANSITION_ACTIVATE)
    daemon.until('publishing on ROS domain')
    # What this state does not have is rejected, and measuring goes on.
    for wrong in (Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_CONFIGURE, 77):
        assert not change(peer, wrong)
    # The second is how rclpy of Kilted answers.
    daemon.until('change_state: rejected|Unable to start transition')
    strange = ParameterMessage(name='sum_min', value=ParameterValue(type=42))
    answer = peer.call(SetParameters, '/estimator/set_parameters', SetParameters.Request(parameters=[strange]))
    assert [(r.successful, '42' in r.reason) for r in answer.results] == [(False, True)]
    peer.until(lambda: len(poses) >= 10 and len(markers) > 0, 'estimates')
    assert change(peer, Transition.TRANSITION_DEACTIVATE)
    observed = len(health)
    peer.until(lambda: len(health) > observed + 1, 'diagnostics while inactive')
    stopped, drawn = len(poses), len(markers)
    observed = len(health)
    peer.until(lambda: len(health) > observed, 'more diagnostics')
    assert (len(poses), len(markers)) == (stopped, drawn)
    assert change(peer, Transition.TRANSITION_CLEANUP)
    SerialPort(simulated_port, 921_600).close()
    (folder,) = bags.iterdir()
    recording = open_recording(folder)
    assert recording.complete
    assert recording.topics()['/link_tip/deflection'] > stopped + 50
    assert change(peer, Transition.TRANSITION_CONFIGURE)
    assert change(peer, Transition.TRANSITION_ACTIVATE)
    peer.until(lambda: len(poses) >= stopped + 10, 'estimates once more')
    assert daemon.end() == 0, daemon.lines


def put(peer: Any, **values: object) -> str:
    """Why the values are rejected, '' if they are taken; ``__`` in a name stands for a dot."""
    changes = [Parameter(n.replace('__', '.'), value=v).to_parameter_msg() for n, v in values.items()]
    request = SetParametersAtomically.Request(parameters=changes)
    answer = peer.call(SetParametersAtomically, '/estimator/set_parameters_atomically', request).result
    assert answer.successful == (answer.reason == '')
    return str(answer.reason)


def cycle(peer: Any, *transitions: str) -> None:
    for name in transitions:
        assert change(peer, getattr(Transition, f'TRANSITION_{name.upper()}')), name


def value_of(peer: Any, name: str) -> Any:
    (value,) = peer.call(GetParameters, '/estimator/get_parameters', GetParameters.Request(names=[name])).values
    return parameter_value_to_python(value)


@pytest.mark.slow
def test_parameters_set_unconfigured_are_kept(
    start: Callable[..., Any], peer: Any, simulated_port: str, tmp_path: Path
) -> None:
    words = ['autostart:=false', f'zero_file:={tmp_path / "zero.json"}']
    words += ['effects.axis_crosstalk.psd:=1', 'effects.axis_crosstalk.xy:=0.01']
    daemon = start('--port', '/dev/nothing_here', '--ros-args', *(w for word in words for w in ('-p', word)))
    daemon.until('waiting to be configured')
    assert not change(peer, Transition.TRANSITION_CONFIGURE)
    daemon.until('no such port')
    # Rejected at once, all of them, by the words that reject a file.
    assert 'must be less than sum_max' in put(peer, sum_min=9.0, solver='ols')
    assert "solver = 'magic': must be one of" in put(peer, solver='magic')
    assert 'comparison only' in put(peer, solver='appendix_d')
    assert put(peer, autostart=True) == 'autostart: is read at the start of the process'
    # Nobody on the network shall run programs here.
    assert put(peer, watch_command='true') == 'watch_command: is read at the start of the process'
    assert put(peer, watch_webhook='http://a') == 'watch_webhook: is read at the start of the process'
    assert value_of(peer, 'solver') == 'exact'
    assert put(peer, port=simulated_port, solver='ols', block_size=10, sum_min=2.4, markers=True) == ''
    assert put(peer, effects__axis_crosstalk__xy=0.02) == ''
    rigs = peer.collect(String, '/link_tip/rig', LATCHED)
    poses = peer.collect(PoseStamped, '/link_tip/deflection')
    of_ols = peer.collect(PoseStamped, '/link_tip/ols/deflection')
    markers = peer.collect(MarkerArray, '/link_tip/markers')
    cycle(peer, 'configure', 'activate')
    peer.until(lambda: len(poses) >= 30 and len(of_ols) >= 30 and len(markers) > 0 and rigs != [], 'estimates of ols')
    reported = json.loads(rigs[-1].data)['parameters']
    assert [reported[n] for n in ('block_size', 'sum_min', 'effects.axis_crosstalk.xy')] == [10, 2.4, 0.02]
    assert value_of(peer, 'solvers')[0] == 'ols'
    assert min(stamp(b) - stamp(a) for a, b in itertools.pairwise(poses)) < 15_000_000
    for fixed in ({'port': '/dev/other'}, {'effects__axis_crosstalk__xy': 0.03}):
        assert 'is read when the node is configured' in put(peer, **fixed)
    assert put(peer, sum_min=2.3) == ''
    peer.zero()
    taken = parameters(peer, 'psd_1.zero', 'psd_2.zero')
    cycle(peer, 'deactivate', 'cleanup')
    assert value_of(peer, 'sum_min') == 2.3
    assert put(peer, solver='wls', markers=False) == ''
    rigs.clear()
    cycle(peer, 'configure', 'activate')
    daemon.until('zero of the last run')
    now = len(poses)
    peer.until(lambda: len(poses) >= now + 30 and rigs != [], 'estimates of wls')
    reported = json.loads(rigs[-1].data)['parameters']
    assert [reported[n] for n in ('solver', 'block_size', 'sum_min')] == ['wls', 10, 2.3]
    assert parameters(peer, 'psd_1.zero', 'psd_2.zero') == taken == [reported['psd_1.zero'], reported['psd_2.zero']]
    topics = dict(peer.node.get_topic_names_and_types())
    peer.until(lambda: peer.node.count_publishers('/link_tip/markers') == 0, 'the markers to be gone')
    assert '/link_tip/wls/deflection' in topics
    cycle(peer, 'deactivate', 'cleanup')
    assert put(peer, psd_1__zero=[0.0004, 0.0]) == ''
    cycle(peer, 'configure')
    assert parameters(peer, 'psd_1.zero') == [[0.0004, 0.0]]
    assert daemon.end() == 0, daemon.lines


def test_a_device_that_is_not_there_leaves_the_node_unconfigured(start: Callable[..., Any], peer: Any) -> None:
    daemon = start('--port', '/dev/nothing_here', '--ros-args', '-p', 'autostart:=false', '--log-level', 'warn')
    log = peer.collect(Log, '/rosout', QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    assert not change(peer, Transition.TRANSITION_CONFIGURE)
    daemon.until(r'\[ERROR\] .*no such port')
    peer.until(lambda: any('no such port' in m.msg and m.level == 40 for m in log), 'the error on /rosout')
    assert not any('waiting to be configured' in line for line in daemon.lines)
    assert state(peer) == State.PRIMARY_STATE_UNCONFIGURED
    assert daemon.end(signal.SIGTERM) == 0, daemon.lines


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_waiting_for_a_device(start: Callable[..., Any], device: Any, number: signal.Signals) -> None:
    device.answer = b''
    daemon = start('--port', str(device.link), script=PATIENT)
    assert device.greeted.wait(WAIT_S)
    assert daemon.end(number) == 0, daemon.lines
    assert not any('Traceback' in line for line in daemon.lines)


def test_an_unforeseen_error_at_the_start_is_not_swallowed(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimator, 'Session', Mock(side_effect=ZeroDivisionError('of our own making')))
    with pytest.raises(ZeroDivisionError, match='of our own making'):
        estimator.run(['--ros-args'], {}, null_log)


def test_a_rejection_by_dds_is_one_line(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rejected = RuntimeError('error creating node: no security libraries\nPlease compile')
    monkeypatch.setattr(node, '_ManagedNode', Mock(side_effect=rejected))
    with pytest.raises(ConfigError, match=r'^ROS: error creating node: no security libraries Please compile$'):
        estimator.run(['--ros-args'], {}, null_log)


@pytest.fixture
def no_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    for choice in OTHER_CHOICES:
        monkeypatch.setenv(choice, '')
        monkeypatch.delenv(choice)


@pytest.mark.slow
@pytest.mark.parametrize('shared_memory', [False, True])
@pytest.mark.usefixtures('domain', 'no_choice')
def test_a_process_that_is_killed_makes_no_other_deaf(shared_memory: bool) -> None:
    with ros('one', [], shared_memory):
        assert os.environ.get(TRANSPORTS) == (None if shared_memory else 'UDPv4')


@pytest.mark.slow
@pytest.mark.parametrize('choice', OTHER_CHOICES)
@pytest.mark.usefixtures('domain', 'no_choice')
def test_the_choice_of_the_user_stays(monkeypatch: pytest.MonkeyPatch, choice: str) -> None:
    monkeypatch.setenv(choice, 'SHM' if choice == TRANSPORTS else '')
    with ros('one', []):
        assert os.environ.get(TRANSPORTS) == ('SHM' if choice == TRANSPORTS else None)
