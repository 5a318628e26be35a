# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The shaper over real DDS: a trajectory in, the shaped one out, played on the simulated arm."""

import time
from collections.abc import Iterator
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bench.shapers import END, FREQUENCY, MOVE_S, NAMES, RATIO, START, move, played
from psd_deflection.arms.compensation.trajectory import checked
from test.ros.conftest import WARNINGS, stamp
from tools.program import PSD_DEFLECTION, ROOT, Program

pytestmark = pytest.mark.ros

ZVD = ('--frequency', str(FREQUENCY), '--damping-ratio', str(RATIO), '--shaper', 'zvd')
URDF = ROOT / 'config' / 'two_links.urdf'


@pytest.fixture
def node(domain: int) -> Iterator[Program]:
    one = Program([*PSD_DEFLECTION, 'shaper', *ZVD], env={'PYTHONWARNINGS': WARNINGS})
    yield one
    status = one.end()
    print(*one.lines[-50:], sep='\n')
    assert status == 0


def message(*points: JointTrajectoryPoint, names: tuple[str, ...] = NAMES) -> JointTrajectory:
    return JointTrajectory(joint_names=list(names), points=list(points))


def point(seconds: float, positions: list[float]) -> JointTrajectoryPoint:
    at = Duration(nanoseconds=round(1e9 * seconds)).to_msg()
    return JointTrajectoryPoint(time_from_start=at, positions=positions, velocities=[0.0] * len(positions))


def reported(peer: Any, **positions: float) -> None:
    """Let joints be told again and again."""
    out = peer.node.create_publisher(JointState, '/joint_states', 5)
    stated = JointState(name=list(positions), position=list(positions.values()))
    peer.node.create_timer(0.02, lambda: out.publish(stated))


def test_a_move_is_shaped_and_a_bad_one_rejected(node: Program, peer: Any) -> None:
    node.until('publishing /shaper/shaped: ZVD for 12 Hz, damping ratio 0.02; motions take 83 ms longer')
    heard = peer.collect(JointTrajectory, '/shaper/shaped')
    reports = peer.collect(DiagnosticArray, '/diagnostics')
    given = peer.node.create_publisher(JointTrajectory, '/shaper/trajectory', 5)
    peer.until(lambda: given.get_subscription_count() > 0, 'the shaper')
    peer.until(lambda: peer.node.count_publishers('/shaper/shaped') > 0, 'its answers')

    unknown = 'nobody tells where the joints are on joint_states'
    peer.until(lambda: any(r.status[0].message == unknown for r in reports), 'diagnostics without joints')
    given.publish(message(point(0.0, [0.0]), names=('z',)))
    node.until('trajectory rejected: the position of z is not known')
    reported(peer, shoulder=START[0], elbow=START[1])
    given.publish(message(point(0.0, [1.0])))
    node.until('trajectory rejected: point 0 has 1 positions, must be 2')
    late = message(point(0.0, START.tolist()))
    late.header.stamp.sec = 1
    given.publish(late)
    node.until('trajectory rejected: its stamp is .* s old')
    peer.until(lambda: any('was rejected: its stamp' in r.status[0].message for r in reports), 'diagnostics')

    good = message(point(0.0, START.tolist()), point(MOVE_S, END.tolist()))
    good.points[0].effort = [0.0, 0.0]
    # Shaped: stamp and frame are kept, and the link is at rest when the joints are.
    begun = time.time_ns()
    good.header.stamp = peer.node.get_clock().now().to_msg()
    good.header.frame_id = 'arm'

    def answered() -> bool:
        # The first one may leave before DDS has connected both ways.
        if not heard:
            good.header.stamp = peer.node.get_clock().now().to_msg()
            given.publish(good)
        return bool(heard)

    peer.until(answered, 'the shaped trajectory')
    shaped = heard[0]
    assert shaped.joint_names == list(NAMES)
    assert shaped.header.frame_id == 'arm'
    assert stamp(shaped) >= begun + 100_000_000
    assert list(shaped.points[0].positions) == START.tolist()
    assert list(shaped.points[-1].positions) == END.tolist()
    times = [p.time_from_start.sec + p.time_from_start.nanosec / 1e9 for p in shaped.points]
    arrived = checked(NAMES, times, [[p.positions, p.velocities, p.accelerations] for p in shaped.points])
    assert arrived.duration == pytest.approx(MOVE_S + 0.0834, abs=1e-3)
    assert played(arrived) < 0.05 * played(move())
    reports.clear()
    peer.until(lambda: any('ZVD for 12 Hz' in r.status[0].message for r in reports), 'diagnostics')
    values = {v.key: v.value for v in reports[-1].status[0].values}
    assert (values['shaper'], values['delay (s)'], values['trajectories rejected']) == ('zvd', '0.0834', '3')

    # With another one of its name each motion would come twice: both reject.
    twin = peer.node.create_publisher(JointTrajectory, '/shaper/shaped', 5)
    reports.clear()
    held = 'it shapes nothing: another node publishes /shaper/shaped'
    peer.until(lambda: any(held == r.status[0].message for r in reports), 'a second publisher')
    good.header.stamp = peer.node.get_clock().now().to_msg()
    given.publish(good)
    node.until('trajectory rejected: another node publishes /shaper/shaped')
    peer.node.destroy_publisher(twin)

    heard.clear()
    given.publish(message())
    peer.until(lambda: any(not h.points for h in heard), 'the stop')


@pytest.mark.slow
def test_the_limits_come_from_the_robots_description(domain: int, peer: Any) -> None:
    words = [*ZVD, '--urdf', 'robot_description']
    node = Program([*PSD_DEFLECTION, 'shaper', *words], env={'PYTHONWARNINGS': WARNINGS})
    try:
        given = peer.node.create_publisher(JointTrajectory, '/shaper/trajectory', 5)
        heard = peer.collect(JointTrajectory, '/shaper/shaped')
        peer.until(lambda: given.get_subscription_count() > 0, 'the shaper')
        reported(peer, shoulder=START[0], elbow=START[1])
        move_of = {'slow': (2.0 * MOVE_S, END.tolist()), 'far': (MOVE_S, [1e3, 0.0])}

        def rejected(why: str, kind: str) -> None:
            good = message(point(0.0, START.tolist()), point(*move_of[kind]))
            peer.until(lambda: given.publish(good) or why in node.text, why)

        rejected('trajectory rejected: nobody has told the limits of the joints on robot_description yet', 'slow')
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        described = peer.node.create_publisher(String, '/robot_description', latched)
        described.publish(String(data='<robot'))
        peer.until(lambda: 'robot_description: rejected' in node.text, 'a rejection of what is no URDF')
        described.publish(String(data=URDF.read_text()))
        peer.until(lambda: 'limits of shoulder, elbow' in node.text, 'the limits')
        rejected('trajectory rejected: shoulder', 'far')
        good = message(point(0.0, START.tolist()), point(*move_of['slow']))
        peer.until(lambda: given.publish(good) or bool(heard), 'the shaped trajectory')
    finally:
        assert node.end() == 0
    print(node.text)


def test_settings_are_parameters(node: Program, peer: Any) -> None:
    node.until('publishing /shaper/shaped')
    asked = GetParameters.Request(names=['shaper', 'frequency', 'max_step', 'lead'])
    kind, frequency, step, lead = peer.call(GetParameters, '/shaper/get_parameters', asked).values
    assert (kind.string_value, frequency.double_value) == ('zvd', FREQUENCY)
    assert (step.double_value, lead.double_value) == (0.05, 0.1)

    assert peer.set('/shaper', 'max_step', 0.01).successful
    assert not peer.set('/shaper', 'max_step', -1.0).successful
    assert not peer.set('/shaper', 'frequency', 10.0).successful
    given = peer.node.create_publisher(JointTrajectory, '/shaper/trajectory', 5)
    peer.until(lambda: given.get_subscription_count() > 0, 'the shaper')
    reported(peer, shoulder=0.0, elbow=0.02)
    peer.until(
        lambda: given.publish(message(point(0.0, [0.0, 0.0]))) or 'from where elbow is' in node.text, 'a rejection'
    )
    assert 'must be at most 0.01' in node.text
