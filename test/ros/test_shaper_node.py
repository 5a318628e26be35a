# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The shaper over real DDS: trajectories and goals in, shaped ones out; played on the simulated arm."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest.mock import AsyncMock, Mock

import numpy as np
import pytest
import rclpy
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from rcl_interfaces.srv import GetParameters
from rclpy.action import ActionClient
from rclpy.duration import Duration
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bench.shapers import END, FREQUENCY, MOVE_S, NAMES, RATIO, START, move, played
from bench.trajectory_controller import ACTION, ServedController, TrajectoryController, arriving
from psd_deflection.arms.compensation.trajectory import checked
from psd_deflection.ros.endpoints import GuardedServer
from test.ros.conftest import LATCHED, WARNINGS, Peer, stamp
from tools.control_msgs import available
from tools.program import PSD_DEFLECTION, ROOT, WAIT_S, Program

pytestmark = pytest.mark.ros
ZVD = ('--frequency', str(FREQUENCY), '--damping-ratio', str(RATIO), '--shaper', 'zvd')
URDF = ROOT / 'config' / 'two_links.urdf'


@pytest.fixture
def node(launch: Callable[..., Program]) -> Iterator[Program]:
    program = launch('shaper', *ZVD)
    yield program
    assert program.end() == 0


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
    assert (shaped.joint_names, shaped.header.frame_id) == (list(NAMES), 'arm')
    assert stamp(shaped) >= begun + 100_000_000
    assert (list(shaped.points[0].positions), list(shaped.points[-1].positions)) == (START.tolist(), END.tolist())
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
def test_the_limits_come_from_the_robots_description(launch: Callable[..., Program], peer: Any) -> None:
    node = launch('shaper', *ZVD, '--urdf', 'robot_description')
    given = peer.node.create_publisher(JointTrajectory, '/shaper/trajectory', 5)
    heard = peer.collect(JointTrajectory, '/shaper/shaped')
    peer.until(lambda: given.get_subscription_count() > 0, 'the shaper')
    reported(peer, shoulder=START[0], elbow=START[1])
    move_of = {'slow': (2.0 * MOVE_S, END.tolist()), 'far': (MOVE_S, [1e3, 0.0])}

    def rejected(why: str, kind: str) -> None:
        good = message(point(0.0, START.tolist()), point(*move_of[kind]))
        peer.until(lambda: given.publish(good) or why in node.text, why)

    rejected('trajectory rejected: nobody has told the limits of the joints on robot_description yet', 'slow')
    described = peer.node.create_publisher(String, '/robot_description', LATCHED)
    described.publish(String(data='<robot'))
    peer.until(lambda: 'robot_description: rejected' in node.text, 'a rejection of what is no URDF')
    described.publish(String(data=URDF.read_text()))
    peer.until(lambda: 'limits of shoulder, elbow' in node.text, 'the limits')
    rejected('trajectory rejected: shoulder', 'far')
    good = message(point(0.0, START.tolist()), point(*move_of['slow']))
    peer.until(lambda: given.publish(good) or bool(heard), 'the shaped trajectory')
    assert node.end() == 0


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
    distant = message(point(0.0, [0.0, 0.0]))
    peer.until(lambda: given.publish(distant) or 'from where elbow is' in node.text, 'a rejection')
    assert 'must be at most 0.01' in node.text


JOINTS = ('shoulder', 'elbow')
BEGIN = np.array([0.3, -0.2])
WORDS = ('--frequency', '12', '--shaper', 'zvd', '--action', ACTION)
SUCCEEDED, CANCELED, ABORTED = GoalStatus.STATUS_SUCCEEDED, GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_ABORTED
FOLLOW = '/shaper/follow_joint_trajectory'


class Arm:
    """The shaper as a process; the controller and a planner in the peer's executor."""

    def __init__(self, peer: Peer, *words: str) -> None:
        from control_msgs.action import FollowJointTrajectory

        self.peer, self.action = peer, FollowJointTrajectory
        self.controller: ServedController | None = self.serving()
        self.stuck = False
        self._out = peer.node.create_publisher(JointState, '/joint_states', 5)
        peer.node.create_timer(0.005, self._step)
        self.client = ActionClient(peer.node, FollowJointTrajectory, FOLLOW)
        self.reports = peer.collect(DiagnosticArray, '/diagnostics')
        self.feedback: list[Any] = []
        self.shaper = Program([*PSD_DEFLECTION, 'shaper', *(words or WORDS)], env={'PYTHONWARNINGS': WARNINGS})
        peer.until(self.client.server_is_ready, 'the action of the shaper')

    def serving(self) -> ServedController:
        return ServedController(self.peer.node, JOINTS, TrajectoryController(BEGIN))

    def _step(self) -> None:
        now = self.peer.node.get_clock().now().nanoseconds / 1e9
        at = BEGIN
        if self.controller is not None:
            self.controller.step(now)
            if not self.stuck:
                at = self.controller.controller.state(now)[0]
        self._out.publish(JointState(name=list(JOINTS), position=at.tolist()))

    def ready(self) -> None:
        """The shaper has found the controller, and the joints."""
        self.peer.until(self._ready, 'the controller and the joints')

    def _ready(self) -> bool:
        observed = {s.name: s for r in self.reports for s in r.status if s.name.startswith('shaper: ')}
        return len(observed) == 2 and all(s.level == DiagnosticStatus.OK for s in observed.values())

    def goal(self, end: tuple[float, ...] = (0.5, 0.1), seconds: float = 0.3, names: tuple[str, ...] = JOINTS) -> Any:
        return self.action.Goal(trajectory=message(point(seconds, list(end)), names=names))

    def send(self, goal: Any) -> Any:
        """The client's handle of a goal, once the shaper has answered."""
        future = self.client.send_goal_async(goal, self.feedback.append)
        self.peer.until(future.done, 'an answer to the goal')
        return future.result()

    def result(self, handle: Any) -> Any:
        future = handle.get_result_async()
        self.peer.until(future.done, 'the result')
        return future.result()

    def followed(self, goal: Any) -> tuple[int, Any]:
        """Status and result."""
        handle = self.send(goal)
        assert handle.accepted
        response = self.result(handle)
        return response.status, response.result

    def away(self) -> float:
        """How far the controller is from where it began, rad."""
        assert self.controller is not None
        at = self.controller.controller.state(self.peer.node.get_clock().now().nanoseconds / 1e9)[0]
        return float(np.abs(at - BEGIN).max())

    def moves(self) -> bool:
        return self.away() > 0.02


Begin = Callable[..., Arm]


@pytest.fixture(scope='session')
def control_msgs() -> None:
    if not available():
        pytest.skip('control_msgs is not installed, and there is no compiler to build it')


@pytest.fixture
def begin(control_msgs: None, domain: int, peer: Peer) -> Iterator[Begin]:
    arms: list[Arm] = []

    def make(*words: str) -> Arm:
        arms.append(Arm(peer, *words))
        arms[-1].ready()
        return arms[-1]

    yield make
    for arm in arms:
        status = arm.shaper.end()
        print(*arm.shaper.lines[-50:], sep='\n')
        assert status == 0
        assert 'Traceback' not in arm.shaper.text
        arm.client.destroy()
        if arm.controller is not None:
            arm.controller.close()


def test_goal_is_shaped_with_result_of_controller(begin: Begin) -> None:
    arm = begin()
    goal = arm.goal()
    from control_msgs.msg import JointTolerance

    goal.path_tolerance = [JointTolerance(name='elbow', position=0.1)]
    goal.goal_tolerance = [JointTolerance(name='elbow', position=-1.0)]
    goal.goal_time_tolerance.sec = 3
    status, result = arm.followed(goal)
    assert (status, result.error_code, result.error_string) == (SUCCEEDED, 0, 'Goal successfully reached!')
    assert arm.controller is not None
    (sent,) = arm.controller.goals
    begun, path = arriving(sent.trajectory, JOINTS)
    assert np.allclose(path.states[0, 0], BEGIN, atol=1e-9)
    assert path.states[-1, 0].tolist() == [0.5, 0.1]
    assert path.duration == pytest.approx(0.3 + 0.0834, abs=1e-3)
    assert begun > 0.0
    for of in ('path_tolerance', 'goal_tolerance', 'goal_time_tolerance'):
        assert getattr(sent, of) == getattr(goal, of)
    assert arm.feedback[-1].feedback.joint_names == list(JOINTS)
    assert len(arm.feedback[-1].feedback.actual.positions) == 2


@pytest.mark.slow
def test_a_new_goal_takes_the_place_of_the_old_without_a_step(begin: Begin) -> None:
    arm = begin()
    first = arm.send(arm.goal(seconds=2.0))
    arm.peer.until(arm.moves, 'motion')
    status, _ = arm.followed(arm.goal((0.2, 0.0)))
    assert status == SUCCEEDED
    old = arm.result(first)
    assert (old.status, old.result.error_code) == (ABORTED, -1)
    assert 'preempted' in old.result.error_string
    assert arm.controller is not None
    (t0, replaced), (t1, latest) = (arriving(goal.trajectory, JOINTS) for goal in arm.controller.goals)
    # It begins where the one before it is then, and as fast.
    here = replaced.at(np.array([t1 - t0]))[0]
    np.testing.assert_allclose(latest.states[0, :2], here, atol=1e-5)


@pytest.mark.slow
def test_a_cancelled_goal_is_held_and_the_next_begins_there(begin: Begin) -> None:
    arm = begin()
    handle = arm.send(arm.goal(seconds=2.0))
    arm.peer.until(arm.moves, 'motion')
    cancelled = handle.cancel_goal_async()
    arm.peer.until(cancelled.done, 'the answer to the cancel request')
    assert arm.result(handle).status == CANCELED
    assert arm.controller is not None
    held = arm.controller.controller.state(0.0)[0]
    # The joints are told once more before the next goal comes.
    reports = len(arm.reports)
    arm.peer.until(lambda: len(arm.reports) > reports, 'a second')
    status, _ = arm.followed(arm.goal())
    assert status == SUCCEEDED
    _, path = arriving(arm.controller.goals[-1].trajectory, JOINTS)
    np.testing.assert_allclose(path.states[0], [held, [0.0, 0.0]], atol=1e-9)


@pytest.mark.slow
def test_joints_that_stand_are_believed_and_no_feedback(begin: Begin) -> None:
    arm = begin()
    arm.stuck = True
    first = arm.send(arm.goal(seconds=6.0))
    arm.peer.until(lambda: arm.away() > 0.2, 'motion')
    status, result = arm.followed(arm.goal())
    assert (status, result.error_code) == (ABORTED, -1)
    assert 'rad or m from where the last trajectory has it' in result.error_string
    assert arm.result(first).status == SUCCEEDED
    reached = 'says that it has reached the goal, but shoulder is 0.2 rad or m from where'
    arm.peer.until(lambda: reached in arm.shaper.text, 'the warning')


@pytest.mark.slow
def test_what_cannot_be_followed_is_aborted_with_the_reason(begin: Begin) -> None:
    arm = begin('--urdf', str(URDF), *WORDS)
    assert arm.controller is not None

    def aborted(goal: Any, code: int, why: str) -> None:
        status, result = arm.followed(goal)
        assert (status, result.error_code) == (ABORTED, code)
        assert why in result.error_string

    aborted(arm.goal((float('nan'), 0.0)), -1, 'point 0 is not finite')
    aborted(arm.goal((0.4, 0.0), seconds=0.01), -1, 'is as fast as')
    aborted(arm.goal((0.4, 0.0), names=('shoulder', 'z')), -2, 'the position of z is not known')
    aborted(arm.goal((0.4, 0.0), names=('shoulder', 'shoulder')), -2, 'joint_names')
    aborted(arm.action.Goal(), -2, 'joint_names')
    old = arm.goal()
    old.trajectory.header.stamp.sec = 1
    aborted(old, -3, 'its stamp is')
    bodies = arm.goal()
    bodies.multi_dof_trajectory.joint_names = ['base']
    aborted(bodies, -2, 'multi_dof_trajectory')
    assert arm.controller.goals == []
    arm.controller.rejects = True
    aborted(arm.goal(), -1, f'{ACTION} rejects it')
    arm.controller.rejects = False
    assert arm.followed(arm.goal(seconds=1.0))[0] == SUCCEEDED
    assert arm.shaper.text.count('follow_joint_trajectory: rejected: point 0 is not finite') == 1


@pytest.mark.slow
def test_what_no_goal_may_be_is_rejected_at_the_gate(begin: Begin) -> None:
    arm = begin()

    def rejected(goal: Any, why: str) -> None:
        assert not arm.send(goal).accepted
        arm.peer.until(lambda: why in arm.shaper.text, why)

    no_time = arm.goal()
    no_time.trajectory.header.stamp.sec = -5
    rejected(no_time, 'is no time')
    from control_msgs.msg import JointTolerance

    no_number = arm.goal()
    no_number.path_tolerance = [JointTolerance(name='elbow', velocity=float('inf'))]
    rejected(no_number, 'a tolerance is not finite')
    many = arm.goal()
    many.goal_tolerance = [JointTolerance(name='elbow')] * 1001
    rejected(many, '1001 tolerances: must be at most 1000')
    rejected(arm.goal((0.0,) * 60_000, names=('x',) * 60_000), ' bytes: must be at most 1000000')
    assert arm.controller is not None
    assert arm.controller.goals == []
    assert arm.peer.change('/shaper', Transition.TRANSITION_DEACTIVATE)
    rejected(arm.goal(), 'the node is not active')


@pytest.mark.slow
def test_a_flood_of_goals_is_cut_off(begin: Begin) -> None:
    arm = begin()

    def flooded() -> bool:
        # Of what comes at once DDS keeps ten, so not all are answered.
        arm.client.send_goal_async(arm.goal(names=()))
        return 'more than 20 goals a second' in arm.shaper.text

    arm.peer.until(flooded, 'the end of the flood')


@pytest.mark.slow
def test_what_no_client_of_ros_sends_ends_nothing(begin: Begin) -> None:
    arm = begin()
    for kind in ('half', 'text'):
        topic = f'rq{FOLLOW}/_action/send_goalRequest'
        stranger = Program([sys.executable, str(ROOT / 'test' / 'ros' / 'cyclone_stranger.py'), topic, kind])
        try:
            # Half a goal rmw drops itself; some are sent before those whose text is none, which are unpacked.
            stranger.until('sent 20')
            if kind == 'text':
                arm.peer.until(lambda: 'rejected: joint_names: must be' in arm.shaper.text, 'a rejection')
        finally:
            print(stranger.text)
            stranger.end(signal.SIGKILL)

    def taken() -> bool:
        # Of what the strangers have sent some may be on its way, and only so many goals a second are taken.
        handle = arm.send(arm.goal())
        return bool(handle.accepted) and arm.result(handle).status == SUCCEEDED

    arm.peer.until(taken, 'a goal that succeeds')


@pytest.mark.slow
def test_a_controller_that_is_not_there_ends_a_goal_at_once(begin: Begin) -> None:
    arm = begin()
    assert arm.controller is not None
    handle = arm.send(arm.goal(seconds=20.0))
    arm.peer.until(arm.moves, 'motion')
    arm.controller.close()
    arm.controller = None
    response = arm.result(handle)
    assert (response.status, response.result.error_code) == (ABORTED, -1)
    assert f'{ACTION} has gone' in response.result.error_string
    status, result = arm.followed(arm.goal())
    assert (status, result.error_code) == (ABORTED, -1)
    assert f'{ACTION} is served by nobody' in result.error_string
    arm.controller = arm.serving()
    arm.reports.clear()
    arm.ready()
    assert arm.followed(arm.goal())[0] == SUCCEEDED


@pytest.mark.slow
def test_a_controller_that_says_nothing_more_ends_a_goal(begin: Begin) -> None:
    arm = begin()
    assert arm.controller is not None
    handle = arm.send(arm.goal(seconds=1.0))
    arm.peer.until(lambda: bool(arm.feedback), 'feedback')
    arm.controller.mute = True
    response = arm.result(handle)
    assert response.status == ABORTED
    assert 'no feedback for 5 s' in response.result.error_string


@pytest.mark.slow
def test_a_controller_that_does_not_answer_ends_a_goal(begin: Begin, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = begin()
    assert arm.controller is not None

    with monkeypatch.context() as patched:
        patched.setattr(arm.controller._server, 'execute', AsyncMock())
        for handle in [arm.send(arm.goal()) for _ in range(2)]:
            response = arm.result(handle)
            assert (response.status, response.result.error_code) == (ABORTED, -1)
            assert f'{ACTION} has not answered within 2 s' in response.result.error_string
    assert arm.followed(arm.goal())[0] == SUCCEEDED


def test_what_rclpy_cannot_take_is_rejected(control_msgs: None, peer: Peer, monkeypatch: pytest.MonkeyPatch) -> None:
    from control_msgs.action import FollowJointTrajectory

    rejected: list[str] = []
    node = rclpy.create_node('served', context=peer.context)
    server = GuardedServer(node, FollowJointTrajectory, '/goals', rejected.append, print, print, print)
    broken = Mock(side_effect=UnicodeDecodeError('utf-8', b'x', 0, 1, '/a/path of the library'))
    monkeypatch.setattr(rclpy.action.ActionServer, 'take_data', broken)
    assert server.take_data() == {}
    assert rejected == ['no message of this type']
    server.destroy()
    node.destroy_node()


@pytest.mark.slow
def test_a_stopped_shaper_stops_the_arm(begin: Begin) -> None:
    arm = begin()
    handle = arm.send(arm.goal(seconds=20.0))
    arm.peer.until(arm.moves, 'motion')
    assert arm.peer.change('/shaper', Transition.TRANSITION_DEACTIVATE)
    response = arm.result(handle)
    assert (response.status, response.result.error_string) == (ABORTED, 'the shaper was deactivated')
    assert arm.controller is not None
    arm.peer.until(lambda: arm.controller is not None and arm.controller.controller.ends < 1e10, 'the hold')


@pytest.mark.slow
@pytest.mark.parametrize(
    ('action', 'why'), [('a b', "action = 'a b'"), (FOLLOW, 'must be the action of a controller, not our own')]
)
def test_an_action_that_cannot_be_is_rejected(control_msgs: None, domain: int, action: str, why: str) -> None:
    command = [*PSD_DEFLECTION, 'shaper', '--shaper', 'none', '--action', action]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert ended.returncode == 3, ended.stderr
    assert why in ended.stderr
