# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The loop closed over real DDS: a simulated arm of two links, its deflection, and the offsets of its joints."""

import copy
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, String
from std_srvs.srv import SetBool

from bench.campaign.hold import WITHIN
from bench.campaign.plant import BREAKS, DEFLECTIONS, JOINTS, URDF, Plant, faithful
from test.ros.conftest import LATCHED
from tools.program import PSD_DEFLECTION, ROOT, WAIT_S, Program

pytestmark = pytest.mark.ros
STALE = '0.8'
"""s. On a busy machine this process is late too; test/arms/compensation has the default of 0.08 s."""
ARGUMENTS = ('compensator', '--urdf', str(URDF), '--tip', 'tool', '--axes', 'x,z', '--drive', '--stale', STALE)
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
"""Our program, whose main thread waits for input without end when the offsets are to be released."""
Launch = Callable[..., Program]


@pytest.fixture
def compensator(launch: Launch) -> Program:
    return launch(*ARGUMENTS)


def following(peer: Any, share: float = 0.05) -> Plant:
    """An arm whose offsets have come to follow its deflection, to this share of it."""
    plant = Plant(peer.node)
    peer.until(lambda: plant.error() > 2e-3, 'a deflection')
    free = plant.error()
    assert peer.call(SetBool, '/compensator/enable', SetBool.Request(data=True)).success
    peer.until(lambda: plant.error() < share * free, 'offsets that follow')
    return plant


def longest_rest(plant: Plant, since: int) -> int:
    """The most offsets in a row that are equal, from the one of number ``since`` on."""
    changes = np.flatnonzero(np.any(np.diff(np.array(plant.offsets[since:]), axis=0), axis=1))
    return int(np.diff([-1, *changes, len(plant.offsets) - since - 1]).max())


def test_the_loop_is_closed_held_and_handed_over(compensator: Program, peer: Any) -> None:
    plant = Plant(peer.node)
    peer.until(lambda: 'once it is enabled' in compensator.text, 'the node')
    states = peer.collect(DiagnosticArray, '/diagnostics')
    peer.until(lambda: len(states) > 1, 'its diagnostics')
    assert len(plant.offsets) == 1
    free = plant.error()
    assert free > 2e-3
    assert peer.call(SetBool, '/compensator/enable', SetBool.Request(data=True)).success
    peer.until(lambda: plant.error() < 0.02 * free, 'an error of less than 2 %')

    for topic, fault, why in (
        ('notify', *DEFLECTIONS['not finite']),
        ('notify', *DEFLECTIONS['silent']),
        ('notify', *DEFLECTIONS['wrong frame']),
        ('notify_joints', *JOINTS['stale joints']),
        ('notify_joints', *JOINTS['leaping joints']),
    ):
        stated, since = len(compensator.text), len(plant.offsets)
        setattr(plant, topic, fault)

        def holds(stated: int = stated, why: str = why) -> bool:
            return re.search(f'holding: .*{why}', compensator.text[stated:]) is not None

        peer.until(holds, why)
        # Joints that leapt once are followed again after 25 good estimates.
        least = 15 if why == 'leap by' else 60
        peer.until(lambda since=since, least=least: longest_rest(plant, since) >= least, 'offsets that are held')
        stated = len(compensator.text)
        plant.notify = plant.notify_joints = faithful
        peer.until(lambda stated=stated: 'following' in compensator.text[stated:], 'following')
    assert [s.name for s in states[0].status] == ['compensator: offsets']
    compensator.process.send_signal(2)
    peer.until(lambda: not np.any(plant.offsets[-1]), 'no offset')
    assert compensator.wait() == 0
    assert plant.step() <= WITHIN


@pytest.mark.slow
def test_a_transition_lets_the_offsets_go_back_to_zero(compensator: Program, peer: Any) -> None:
    plant = following(peer)
    # So slowly that what was heard before it is stale by then.
    seconds = 1.5
    assert peer.set('/compensator', 'max_rate', np.abs(plant.offsets[-1]).max() / seconds).successful
    for wanted in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
        assert peer.change('/compensator', wanted)
    peer.until(lambda: not np.any(plant.offsets[-1]), 'no offset')
    assert plant.step() <= WITHIN


@pytest.mark.slow
def test_a_transition_with_offsets_that_stay_fails_and_says_so(compensator: Program, peer: Any) -> None:
    """Offsets that take too long to go back, and a controller that does not tell what it has."""
    plant = following(peer)
    # This process may be silent for longer than that on a busy machine, and is no controller that tells nothing.
    assert peer.set('/compensator', 'stale', 10.0).successful
    assert peer.set('/compensator', 'max_rate', 1e-4).successful
    asked = len(plant.offsets)
    assert not peer.change('/compensator', Transition.TRANSITION_DEACTIVATE)
    remains = re.compile(r'an offset of \S+ at \w+ is left after 10 s')
    peer.until(lambda: remains.search(compensator.text) is not None, 'what is left')
    # It goes on meanwhile, and the next attempt waits anew.
    assert 0.0 < np.abs(plant.offsets[-1]).max() < np.abs(plant.offsets[asked]).max()
    assert peer.set('/compensator', 'max_rate', 0.1).successful
    assert peer.change('/compensator', Transition.TRANSITION_DEACTIVATE)
    peer.until(lambda: not np.any(plant.offsets[-1]), 'no offset')
    assert peer.change('/compensator', Transition.TRANSITION_ACTIVATE)
    assert peer.call(SetBool, '/compensator/enable', SetBool.Request(data=True)).success
    peer.until(lambda: plant.error() < 1e-4, 'offsets that follow')
    plant.applies = False
    peer.until(lambda: 'does not tell the offsets' in compensator.text, 'a controller that tells nothing')
    assert peer.change('/compensator', Transition.TRANSITION_DEACTIVATE)
    peer.until(lambda: 'is left with the controller' in compensator.text, 'what is left')
    assert plant.step() <= WITHIN


@pytest.mark.slow
def test_main_thread_that_hangs_lets_offsets_hold(domain: int, peer: Any) -> None:
    reading, writing = os.pipe()
    process = subprocess.Popen([sys.executable, '-c', HANGS, *ARGUMENTS], cwd=ROOT, stdin=reading)
    os.close(reading)
    try:
        plant = following(peer, share=0.5)
        client = peer.node.create_client(SetBool, '/compensator/enable')
        peer.until(client.service_is_ready, 'the service')
        client.call_async(SetBool.Request(data=False))
        # Deflections go on, and nobody takes them: after the half second they are stale.
        asked = time.monotonic()
        peer.until(lambda: time.monotonic() > asked + 1.0, 'a second')
        held = len(plant.offsets) - 1
        peer.until(lambda: time.monotonic() > asked + 2.0, 'another second')
        assert np.any(plant.offsets[-1])
        assert np.ptp(plant.offsets[held:], axis=0).max() == 0.0
    finally:
        os.close(writing)
        process.terminate()
        process.wait(WAIT_S)


def strange_messages() -> dict[str, tuple[Any, str, str]]:
    """What strangers send: the message, its topic, and what the node says of it."""
    pose = PoseWithCovarianceStamped()
    pose.header.stamp.sec = int(time.time())
    pose.pose.pose.orientation.w = 1.0
    pose.pose.covariance = (np.eye(6) * 1e-12).ravel()
    poses = {name: copy.deepcopy(pose) for name in ('frame', 'before 1970', 'no rotation', 'denormal')}
    poses['frame'].header.frame_id = 'world'
    poses['before 1970'].header.stamp.sec = -1
    poses['no rotation'].pose.pose.orientation.w = 0.0
    poses['denormal'].pose.pose.orientation.w = 5e-324
    joints = {
        'not finite': JointState(name=['elbow', 'shoulder'], position=[math.nan, 0.0]),
        'beyond all bounds': JointState(name=['elbow', 'shoulder'], position=[1e300, 1e300]),
        'too few': JointState(name=['elbow', 'shoulder'], position=[0.0]),
        'twice': JointState(name=['elbow', 'elbow'], position=[0.0, 0.0]),
        'old': JointState(name=['elbow', 'shoulder'], position=[0.0, 0.0]),
    }
    joints['old'].header.stamp.sec = 1
    reported = {
        'frame': "frame_id 'world': must be end_effector_rest",
        'before 1970': 'is no time',
        'no rotation': 'no unit quaternion',
        'denormal': 'no unit quaternion',
        'not finite': 'elbow = nan: must be finite',
        'beyond all bounds': 'elbow = 1e+300: must be finite and at most 10000',
        'too few': '1 positions of 2 joints',
        'twice': 'a joint is named twice',
        'old': 's old',
    }
    topics = {'/end_effector/deflection': poses, '/joint_states': joints}
    return {name: (m, topic, reported[name]) for topic, by_name in topics.items() for name, m in by_name.items()}


@pytest.mark.slow
def test_what_strangers_send_is_rejected_and_moves_nothing(compensator: Program, peer: Any) -> None:
    plant = following(peer)
    states = peer.collect(DiagnosticArray, '/diagnostics')
    kinds = {topic: type(message) for message, topic, _ in strange_messages().values()}
    senders = {topic: peer.node.create_publisher(kind, topic, 5) for topic, kind in kinds.items()}
    peer.until(lambda: all(s.get_subscription_count() for s in senders.values()), 'that it listens')

    def rejections(topic: str) -> int:
        values = {v.key: v.value for s in states[-1].status for v in s.values} if states else {}
        return int(values.get(f'messages rejected: {topic.strip("/")}', '0'))

    def rejected(topic: str, why: str) -> Callable[[], bool]:
        wanted, before = compensator.text.count(why), rejections(topic)
        return lambda: compensator.text.count(why) > wanted or (before >= 3 and rejections(topic) > before)

    for name, (message, topic, why) in strange_messages().items():
        send = partial(senders[topic].publish, message)
        peer.until_sent(send, rejected(topic, why), f'the rejection of what is {name}')
    peer.until(lambda: rejections('/end_effector/deflection') >= 4 and rejections('/joint_states') >= 5, 'their counts')
    assert compensator.process.poll() is None
    assert plant.step() <= WITHIN


@pytest.mark.slow
def test_a_robot_that_does_not_run_holds_the_offsets(launch: Launch, peer: Any) -> None:
    """By what its driver said before the node came, by its speed, and by a controller that ends."""
    runs = peer.node.create_publisher(Bool, '/compensator/robot_running', LATCHED)
    scaling = peer.node.create_publisher(Float64, '/compensator/speed_scaling', 5)
    states = peer.node.create_publisher(Float64, '/compensator/controller_state', 5)
    runs.publish(Bool(data=False))
    plant, scale, active = Plant(peer.node), 1.0, True

    def reported() -> None:
        scaling.publish(Float64(data=scale))
        if active:
            states.publish(Float64())

    peer.node.create_timer(0.05, reported)
    node = launch(*ARGUMENTS, '--controller-state', 'std_msgs/msg/Float64')
    peer.until(lambda: plant.error() > 2e-3, 'a deflection')
    assert peer.call(SetBool, '/compensator/enable', SetBool.Request(data=True)).success
    peer.until(lambda: 'holding: the robot does not run' in node.text, 'that it does not run')
    assert len(plant.offsets) == 1
    runs.publish(Bool(data=True))
    peer.until(lambda: plant.error() < 1e-4, 'offsets that follow')
    for why in ('its speed scaling is 0', 'its state of the controller comes no more'):
        stated = len(node.text)
        scale, active = (0.0, True) if 'speed' in why else (1.0, False)
        # A protective stop while the load changes: the arm must not be asked to leap when it ends.
        plant.stands = True
        plant.arm.force *= 1.2
        peer.until(lambda stated=stated, why=why: f'run: {why}' in node.text[stated:], why)
        held = len(plant.offsets) + 5
        peer.until(lambda held=held: len(plant.offsets) > held + 20, 'offsets that are held')
        assert np.ptp(plant.offsets[held:], axis=0).max() == 0.0
        scale, active, plant.stands = 1.0, True, False
        peer.until(lambda stated=stated: 'following' in node.text[stated:], 'following')
    assert plant.step() <= WITHIN


def test_a_controller_state_that_is_not_installed_is_rejected(domain: int) -> None:
    command = [*PSD_DEFLECTION, *ARGUMENTS, '--controller-state', 'control_msgs/msg/NoSuchThing']
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert ended.returncode == 3
    assert 'no message of that name is installed' in ended.stderr


@pytest.mark.slow
def test_after_an_error_of_its_own_the_offsets_go_back_to_zero(launch: Launch, peer: Any, tmp_path: Path) -> None:
    flag = tmp_path / 'flag'
    node = launch(str(flag), 'health', *ARGUMENTS, program=(sys.executable, '-c', BREAKS))
    plant = following(peer)
    flag.touch()
    peer.until(lambda: not np.any(plant.offsets[-1]), 'no offset')
    assert plant.step() <= WITHIN
    peer.until(lambda: node.process.poll() is not None, 'its end')
    assert node.process.returncode == 1
    assert 'an error of its own' in node.text


OUT_OF_MEMORY = """
import sys
from psd_deflection.cli.main import main
from psd_deflection.ros.gate import InputGate
def take_in(self):
    raise MemoryError
InputGate.take_in = take_in
sys.exit(main())
"""
"""Our program, whose gate has no memory on the way out."""


@pytest.mark.slow
@pytest.mark.parametrize(
    'program',
    [(sys.executable, '-c', OUT_OF_MEMORY), ('sh', '-c', 'exec "$@" 2> /dev/full', 'sh', *PSD_DEFLECTION)],
    ids=['no memory', 'full log'],
)
def test_a_way_out_without_memory_or_log_leaves_no_offset(program: list[str], launch: Launch, peer: Any) -> None:
    node = launch(*ARGUMENTS, program=program)
    plant = following(peer)
    if program[0] == 'sh':
        node.process.send_signal(signal.SIGINT)
    else:
        peer.change('/compensator', Transition.TRANSITION_DEACTIVATE)
    peer.until(lambda: not np.any(plant.offsets[-1]), 'no offset')
    # Then every 10 ms by what the rate of 0.1 /s allows.
    steps = np.abs(np.diff(plant.offsets[-8:], axis=0))
    assert program[0] == 'sh' or np.isclose(steps, 0.1 * 0.01, rtol=1e-6).any()
    assert plant.step() <= WITHIN


@pytest.mark.slow
def test_killed_and_started_again_it_makes_no_step(launch: Launch, peer: Any) -> None:
    """The controller keeps the offsets that it had, and says so; ours begin there. Two at once hold."""
    first = launch(*ARGUMENTS)
    plant = following(peer)
    first.process.kill()
    first.wait()
    heard, held = len(plant.offsets), plant.offsets[-1]
    assert np.any(held)
    first = launch(*ARGUMENTS)
    peer.until(lambda: 'once it is enabled' in first.text, 'the node')
    states = peer.collect(DiagnosticArray, '/diagnostics')
    count = len(plant.offsets)
    peer.until(lambda: len(states) > 1, 'diagnostics of the second')
    assert len(plant.offsets) == count
    assert peer.call(SetBool, '/compensator/enable', SetBool.Request(data=True)).success
    peer.until(lambda: 'following' in first.text, 'that it follows')
    peer.until(lambda: len(plant.offsets) > heard + 50, 'offsets')
    assert plant.step() <= WITHIN
    second = launch(*ARGUMENTS, '--ros-args', '-r', '__node:=other', '-r', '/other/offsets:=/compensator/offsets')
    peer.until(lambda: 'another node publishes /compensator/offsets' in first.text, 'that it is not alone')
    assert peer.call(SetBool, '/other/enable', SetBool.Request(data=True)).success
    peer.until(lambda: 'holding: another node publishes' in second.text, 'that the other is not alone')
    now = len(plant.offsets)
    peer.until(lambda: len(plant.offsets) > now + 50, 'offsets')
    assert np.ptp(plant.offsets[now:], axis=0).max() == 0.0
    assert plant.step() <= WITHIN


def test_without_a_file_the_arm_is_the_one_of_robot_description(launch: Launch, peer: Any) -> None:
    node = launch('compensator', '--ros-args', '-p', 'tip:=tool', '-p', 'drive:=true')
    node.until('waiting for the robot on /robot_description')
    peer.node.create_publisher(String, '/robot_description', LATCHED).publish(String(data=URDF.read_text()))
    node.until('publishing /compensator/offsets for shoulder, elbow, once it is enabled')
    assert node.end() == 0


@pytest.mark.slow
def test_a_signal_ends_the_waiting_for_robot_description(launch: Launch) -> None:
    node = launch('compensator', '--tip', 'tool')
    node.until('waiting for the robot on /robot_description')
    assert node.end() == 0, node.lines
