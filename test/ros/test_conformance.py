# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every node does alike: for ``make campaign NAME=nodes``.

The nodes are those executables of `ros2 run` whose command uses rclpy. A new one has no profile, and fails every check.
A profile says what a node is asked with; a text in its place says why the check does not apply, and is in the table.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import math
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import GetState
from rcl_interfaces.msg import Log, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.action import ActionClient, get_action_server_names_and_types_by_node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from blind.render import Pose, Scene, photograph
from psd_deflection.ros.topics import FOLLOW, HEARD, PUBLISHED, SERVED
from test.ros.conftest import LATCHED, WARNINGS, Peer, stamp
from tools.control_msgs import available
from tools.program import PSD_DEFLECTION, ROOT, WAIT_S, Program

pytestmark = pytest.mark.ros
ROS = ROOT / 'psd_deflection' / 'ros'
NAMESPACE = '/left'
GRAPH = ('/rosout', '/parameter_events', '/diagnostics', '/tf', '/tf_static', '/clock')
"""Topics that have one name for all nodes."""
ROS_OWN = ('use_sim_time', 'qos_overrides.', 'start_type_description_service')


def nodes_of_setup() -> list[str]:
    """The executables of `ros2 run` whose command imports our ROS room."""
    names = sorted(path.name for path in (ROOT / 'resource' / 'ros2_run').iterdir())
    files = {path.stem: path for path in (ROOT / 'psd_deflection' / 'cli').rglob('*.py')}
    return [name for name in names if 'psd_deflection.ros' in files[name].read_text()]


Sent = tuple[type, str, Any]
"""A message: its class, its topic in the namespace, itself."""


@dataclass(frozen=True)
class Profile:
    """What a node is asked with; a text instead says why it is not.

    ``words``: what the command needs. ``params``: the parameter file of the run. ``published``: a topic of its own.
    ``fixed``: a parameter that is read at the start; ``live``: one that may be set; each with another value than it
    has. ``used``: whether that of ``live`` acts. ``beyond``: a value out of bounds. ``rejected``: messages by check.
    ``frames``: whether the prefix among the parameters acts.
    """

    published: tuple[type, str]
    fixed: tuple[str, object]
    out_of_range: tuple[str, object]
    rejected: Mapping[str, Sent | str]
    live: tuple[str, object] | str
    frames: Callable[[Running], bool] | str
    words: tuple[str, ...] = ()
    params: Mapping[str, object] = field(default_factory=dict)
    used: Callable[[Running], bool] = lambda running: False
    sim_time: str = 'works'


class Running:
    """One node in a namespace, and what it says."""

    def __init__(self, name: str, peer: Peer, folder: Path) -> None:
        self.name, self.peer, self.profile = name, peer, PROFILES[name]
        file = folder / 'params.yaml'
        lines = [f'    {key}: {value}' for key, value in self.profile.params.items()]
        file.write_text('\n'.join([f'{NAMESPACE}/{name}:', '  ros__parameters:', *lines]) + '\n')
        latched = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.lines: list[Log] = peer.collect(Log, '/rosout', latched)
        self.reports: list[DiagnosticArray] = peer.collect(DiagnosticArray, '/diagnostics')
        words = (*self.profile.words, '--ros-args', '-r', f'__ns:={NAMESPACE}', '--params-file', str(file))
        self.program = Program([*PSD_DEFLECTION, name, *words], env={'PYTHONWARNINGS': WARNINGS}, cwd=folder)
        self._publishers: dict[str, Any] = {}

    def call(self, kind: Any, service: str, request: Any) -> Any:
        return self.peer.call(kind, f'{NAMESPACE}/{self.name}/{service}', request)

    def set(self, name: str, value: object) -> Any:
        return self.peer.set(f'{NAMESPACE}/{self.name}', name, value)

    def get(self, name: str) -> Any:
        values = self.call(GetParameters, 'get_parameters', GetParameters.Request(names=[name])).values
        return parameter_value_to_python(values[0])

    def described(self) -> list[Any]:
        names = self.call(ListParameters, 'list_parameters', ListParameters.Request()).result.names
        selected = [name for name in names if not name.startswith(ROS_OWN)]
        request = DescribeParameters.Request(names=selected)
        return list(self.call(DescribeParameters, 'describe_parameters', request).descriptors)

    def state(self) -> int:
        return int(self.call(GetState, 'get_state', GetState.Request()).current_state.id)

    def change(self, transition: int) -> bool:
        return self.peer.change(f'{NAMESPACE}/{self.name}', transition)

    def send(self, sent: Sent) -> None:
        kind, topic, message = sent
        if topic not in self._publishers:
            self._publishers[topic] = self.peer.node.create_publisher(kind, f'{NAMESPACE}/{topic}', 5)
        self._publishers[topic].publish(message)

    def logged(self, text: str, level: int = 0) -> bool:
        return any(text in line.msg and line.level >= level for line in self.lines)

    def texts(self, since: int) -> str:
        """All that its diagnostics have said from report number ``since`` on."""
        statuses = [s for report in self.reports[since:] for s in report.status]
        return ' '.join([s.message for s in statuses] + [v.value for s in statuses for v in s.values])

    def rejections(self) -> int:
        """As its diagnostics count them."""
        prefix = f'{NAMESPACE}/{self.name}'.removeprefix('/')
        last = {s.name: s for report in self.reports for s in report.status if s.name.startswith(prefix)}
        counts = (v.value for s in last.values() for v in s.values if 's rejected' in v.key)
        return sum(int(count) for count in counts)


def wrench(sec: int = 0, frame: str = '', **force: float) -> WrenchStamped:
    """A load; ``sec``: of its stamp, 0 for now."""
    message = WrenchStamped()
    message.header.frame_id = frame
    message.header.stamp.sec = sec
    for axis, value in force.items():
        setattr(message.wrench.force, axis, value)
    return message


def loads_at(topic: str) -> dict[str, Sent | str]:
    return {
        'nan': (WrenchStamped, topic, wrench(x=math.nan)),
        'huge': (WrenchStamped, topic, wrench(x=1e300)),
        'frame': (WrenchStamped, topic, wrench(x=7.0, frame='tool0')),
        'stamp': (WrenchStamped, topic, wrench(sec=-(2**31), x=7.0)),
        'size': (WrenchStamped, topic, wrench(frame='x' * 10_000)),
    }


def deflection(x: float = 0.0, frame: str = 'end_effector_rest', sec: int | None = None) -> PoseWithCovarianceStamped:
    message = PoseWithCovarianceStamped()
    message.header.frame_id = frame
    message.header.stamp.sec = int(time.time()) if sec is None else sec
    message.pose.pose.position.x = x
    return message


def trajectory(position: float, names: int = 1, sec: int = 0) -> JointTrajectory:
    point = JointTrajectoryPoint(positions=[position] * names)
    message = JointTrajectory(joint_names=[f'joint_{i}' for i in range(names)], points=[point])
    message.header.stamp.sec = sec
    return message


def photo(sec: int, size: int = 0) -> Image:
    if size:
        return Image(height=1, width=size, encoding='mono8', step=size, data=bytes(size))
    image = photograph(Scene(), [Pose()], np.random.default_rng(0))
    out = Image(height=image.shape[0], width=image.shape[1], encoding='mono8', step=image.shape[1])
    out.data = image.tobytes()
    out.header.stamp.sec = sec
    return out


def sum_min_acts(running: Running) -> bool:
    """The rig that the node tells has it."""
    reported = running.peer.collect(String, f'{NAMESPACE}/link_tip/rig', LATCHED)
    running.peer.until(lambda: bool(reported), 'the rig')
    return '"sum_min": 2.25' in reported[-1].data or '"sum_min":2.25' in reported[-1].data


def exposure_acts(running: Running) -> bool:
    """The stamp is that of the middle of the exposure."""
    poses = running.peer.collect(PoseStamped, f'{NAMESPACE}/reference/deflection')

    def answered() -> bool:
        running.send((Image, 'image', photo(5)))
        return bool(poses)

    running.peer.until(answered, 'a reference')
    return stamp(poses[-1]) == 5_250_000_000


def lead_acts(running: Running) -> bool:
    """What has no stamp begins later by the lead."""
    shaped = running.peer.collect(JointTrajectory, f'{NAMESPACE}/shaper/shaped')

    def answered() -> bool:
        running.send((JointState, 'joint_states', JointState(name=['joint_0'], position=[0.5])))
        running.send((JointTrajectory, 'shaper/trajectory', trajectory(0.5)))
        return bool(shaped)

    running.peer.until(answered, 'a shaped trajectory')
    heard_ns = time.time_ns()
    return stamp(shaped[-1]) > heard_ns + 300_000_000


def age_acts(running: Running) -> bool:
    """Joints that are older than they had been allowed to be are taken, still older ones are rejected."""

    def old(seconds: int) -> JointState:
        message = JointState(name=['shoulder', 'elbow'], position=[0.1, 0.2])
        message.header.stamp.sec = int(time.time()) - seconds
        return message

    running.send((JointState, 'joint_states', old(3)))
    count = running.rejections()
    subscribers = running.peer.node.count_subscribers
    running.peer.until(lambda: subscribers(f'{NAMESPACE}/joint_states') > 0, 'the subscription')
    for _ in range(50):
        running.send((JointState, 'joint_states', old(3)))
    reports = len(running.reports)

    def rejected() -> bool:
        return ' s old' in running.texts(reports) and running.rejections() > count

    running.peer.until_sent(lambda: running.send((JointState, 'joint_states', old(30))), rejected, 'a rejection')
    # What another test sent may be counted late, but it was no fifty.
    return running.rejections() - count < 50


def frame_of(kind: type, topic: str, frame: str) -> Callable[[Running], bool]:
    """Whether what the node publishes is in this frame."""

    def framed(running: Running) -> bool:
        heard = running.peer.collect(kind, f'{NAMESPACE}/{topic}')

        def published() -> bool:
            if running.name == 'camera':
                running.send((Image, 'image', photo(7)))
            return bool(heard)

        running.peer.until(published, topic)
        return {message.header.frame_id for message in heard} == {frame}

    return framed


def taken_in_the_prefixed_frame_alone(running: Running) -> bool:
    """A deflection in the frame without the prefix is rejected."""
    sent = PoseWithCovarianceStamped, 'end_effector/deflection', deflection()
    return rejects(running, sent, ("'end_effector_rest': must be left_end_effector_rest",))


def follow_of(name: str) -> tuple[str, ...]:
    """The words with which a shaper serves its action, if control_msgs is there."""
    return ('--action', name) if available() else ()


PREFIX = 'left_'
PROFILES: Mapping[str, Profile] = {
    'estimator': Profile(
        params={'sum_min': 2.0, 'frame_prefix': PREFIX, 'keep_zero': False},
        published=(PoseStamped, 'link_tip/deflection'),
        fixed=('link.length', 0.4),
        live=('sum_min', 2.25),
        used=sum_min_acts,
        out_of_range=('amplifier.noise', -1.0),
        rejected=loads_at('link_tip/load'),
        frames=frame_of(PoseStamped, 'link_tip/deflection', 'left_link_tip_rest'),
        sim_time='rejected',
    ),
    'camera': Profile(
        params={'target.spacing': 0.025, 'rest.frames': 1, 'frame_prefix': PREFIX},
        published=(PoseStamped, 'reference/deflection'),
        fixed=('frame_prefix', 'right_'),
        live=('camera.exposure', 0.5),
        used=exposure_acts,
        out_of_range=('target.radius', -1.0),
        rejected={
            'nan': (CameraInfo, 'camera_info', CameraInfo(k=[math.nan] * 9)),
            'huge': (CameraInfo, 'camera_info', CameraInfo(k=[1e300] * 9)),
            'frame': 'an image is in the frame of its camera, whatever its name is',
            'stamp': (Image, 'image', photo(-5)),
            'size': (CameraInfo, 'camera_info', CameraInfo(d=[0.0] * 200_000)),
        },
        frames=frame_of(PoseStamped, 'reference/deflection', 'left_link_tip_rest'),
    ),
    'chain': Profile(
        words=(str(ROOT / 'config' / 'two_links.yaml'),),
        params={'slopes': 'ratio', 'frame_prefix': PREFIX},
        published=(PoseWithCovarianceStamped, 'end_effector/deflection'),
        fixed=('base_frame', 'stand'),
        live='all its parameters are read at the start',
        out_of_range=('slopes', 'none'),
        rejected=loads_at('upper/link_tip/load'),
        frames=frame_of(PoseWithCovarianceStamped, 'end_effector/deflection', 'left_end_effector_rest'),
        sim_time='rejected',
    ),
    'compensator': Profile(
        words=('--urdf', str(ROOT / 'config' / 'two_links.urdf'), '--tip', 'tool', '--axes', 'x,z'),
        params={'max_offset': 0.01, 'frame_prefix': PREFIX},
        published=(Float64MultiArray, 'compensator/proposed'),
        fixed=('drive', True),
        live=('stale', 10.0),
        used=age_acts,
        out_of_range=('max_rate', -1.0),
        rejected={
            'nan': (JointState, 'joint_states', JointState(name=['shoulder'], position=[math.nan])),
            'huge': (JointState, 'joint_states', JointState(name=['elbow'], position=[1e300])),
            'frame': (PoseWithCovarianceStamped, 'end_effector/deflection', deflection(frame='world')),
            'stamp': (PoseWithCovarianceStamped, 'end_effector/deflection', deflection(sec=-5, frame='')),
            'size': (PoseWithCovarianceStamped, 'end_effector/deflection', deflection(frame='x' * 2_000_000)),
        },
        frames=taken_in_the_prefixed_frame_alone,
    ),
    'shaper': Profile(
        words=('--shaper', 'none', *follow_of('arm/follow_joint_trajectory')),
        params={'max_step': 0.04},
        published=(JointTrajectory, 'shaper/shaped'),
        fixed=('shaper', 'zv'),
        live=('lead', 0.9),
        used=lead_acts,
        out_of_range=('max_step', -1.0),
        rejected={
            'nan': (JointTrajectory, 'shaper/trajectory', trajectory(math.nan)),
            'huge': (JointTrajectory, 'shaper/trajectory', trajectory(1e300)),
            'frame': 'joint positions are in no frame; that of a trajectory is passed on',
            'stamp': (JointTrajectory, 'shaper/trajectory', trajectory(0.0, sec=-5)),
            'size': (JointTrajectory, 'shaper/trajectory', trajectory(0.0, names=60_000)),
        },
        frames='joint positions are in no frame',
    ),
}


@pytest.fixture(scope='module')
def complete_peer(domain: int) -> Iterator[Peer]:
    with contextlib.closing(Peer()) as made:
        yield made


@pytest.fixture(scope='module', params=nodes_of_setup())
def node_of_module(
    request: pytest.FixtureRequest, complete_peer: Peer, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[], Running]]:
    """The node of these tests: started anew for the test after one that ended it."""
    name = request.param
    assert name in PROFILES, f'{name} is a node without a profile'
    started: list[Running] = []

    def alive() -> Running:
        if not started or started[-1].program.process.poll() is not None:
            started.append(Running(name, complete_peer, tmp_path_factory.mktemp(name)))
            complete_peer.until(lambda: bool(started[-1].reports), f'diagnostics of {name}')
        return started[-1]

    yield alive
    for node in started:
        node.program.end()
        print(*node.program.lines[-30:], sep='\n')


@pytest.fixture
def running(node_of_module: Callable[[], Running]) -> Running:
    return node_of_module()


def rejects(running: Running, sent: Sent, words: tuple[str, ...]) -> bool:
    """Whether the message is counted as rejected in the node's diagnostics, for a reason with one of ``words``."""
    before, reports = running.rejections(), len(running.reports)

    def send() -> None:
        running.send(sent)
        if running.name == 'shaper':
            # Without it every trajectory is rejected.
            running.send((JointState, 'joint_states', JointState(name=['joint_0'], position=[0.5])))

    def is_counted() -> bool:
        why = running.texts(reports)
        return running.rejections() > before and any(word in why for word in words)

    running.peer.until_sent(send, is_counted, f'the rejection of {sent[1]} for one of {words}')
    return running.program.process.poll() is None


def test_parameters_are_described(running: Running) -> None:
    described = running.described()
    assert described
    assert [d.name for d in described if not d.description] == []


def test_numbers_have_bounds(running: Running) -> None:
    numbers = [d for d in running.described() if d.type in (Parameter.Type.DOUBLE.value, Parameter.Type.INTEGER.value)]
    if not numbers:
        pytest.skip('none of its parameters is a number')
    free = [d.name for d in numbers if not (d.floating_point_range or d.integer_range or d.additional_constraints)]
    assert free == []


@pytest.mark.parametrize('name', nodes_of_setup())
@pytest.mark.parametrize('why', ['unknown', pytest.param('out of bounds', marks=pytest.mark.slow)])
def test_invalid_parameter_ends_the_start(name: str, why: str, domain: int, tmp_path: Path) -> None:
    parameter, value = PROFILES[name].out_of_range if why == 'out of bounds' else ('max_ofset', 0.5)
    command = [*PSD_DEFLECTION, name, *PROFILES[name].words, '--ros-args', '-p', f'{parameter}:={value}']
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert ended.returncode == 3, ended.stderr
    assert parameter in ended.stderr
    assert why == 'unknown' or 'must be' in ended.stderr


def test_a_parameter_is_of_the_file_or_it_is_unknown(running: Running) -> None:
    assert {name: running.get(name) for name in running.profile.params} == dict(running.profile.params)
    answer = running.set('max_ofset', 0.5)
    assert not answer.successful
    assert 'max_ofset' in answer.reason


def test_value_out_of_bounds_cannot_be_set(running: Running) -> None:
    name, value = running.profile.out_of_range
    before = running.get(name)
    answer = running.set(name, value)
    assert not answer.successful
    assert name in answer.reason
    assert running.get(name) == before


def test_invalid_type_is_answered(running: Running) -> None:
    strange = ParameterMessage(name=running.profile.fixed[0], value=ParameterValue(type=77))
    request = SetParameters.Request(parameters=[strange])
    answers = running.call(SetParameters, 'set_parameters', request).results
    assert [(a.successful, '77' in a.reason) for a in answers] == [(False, True)]


def test_what_is_read_at_the_start_says_so(running: Running) -> None:
    name, value = running.profile.fixed
    (constraint,) = (d.additional_constraints for d in running.described() if d.name == name)
    assert 'read ' in constraint
    before = running.get(name)
    answer = running.set(name, value)
    assert not answer.successful
    assert 'read ' in answer.reason
    assert running.get(name) == before


def test_live_parameter_acts(running: Running) -> None:
    if isinstance(running.profile.live, str):
        pytest.skip(running.profile.live)
    name, value = running.profile.live
    before = running.get(name)
    assert before != value
    answer = running.set(name, value)
    assert answer.successful, answer.reason
    assert running.get(name) == value
    assert running.profile.used(running)
    assert running.set(name, before).successful


def test_log_and_diagnostics_are_named_after_the_node(running: Running) -> None:
    running.peer.until(lambda: any(line.name == f'left.{running.name}' for line in running.lines), 'its log')
    names = {status.name for report in running.reports for status in report.status}
    prefix = f'left/{running.name}'
    assert [name for name in names if not name.startswith((f'{prefix}: ', f'{prefix}/'))] == []


def test_namespace_holds_its_topics(running: Running) -> None:
    node = running.peer.node
    mine = node.get_publisher_names_and_types_by_node(running.name, NAMESPACE)
    mine += node.get_subscriber_names_and_types_by_node(running.name, NAMESPACE)
    assert mine
    assert [topic for topic, _ in mine if not topic.startswith(f'{NAMESPACE}/') and topic not in GRAPH] == []


def test_frame_prefix_acts(running: Running) -> None:
    framed = running.profile.frames
    if isinstance(framed, str):
        pytest.skip(framed)
    assert framed(running)


def test_simulated_time_acts_or_is_rejected(running: Running) -> None:
    answer = running.set('use_sim_time', True)
    if running.profile.sim_time == 'rejected':
        assert not answer.successful
        assert 'system clock' in answer.reason
        return
    assert answer.successful, answer.reason
    clock = running.peer.node.create_publisher(Clock, '/clock', 5)
    observed, rejected = len(running.reports), running.rejections()

    def reported(sec: int) -> None:
        message = Clock()
        message.clock.sec = sec
        clock.publish(message)

    def of_that_time() -> bool:
        return any(report.header.stamp.sec == 1234 for report in running.reports[observed:])

    try:
        running.peer.until_sent(lambda: reported(1234), of_that_time, 'diagnostics in simulated time')
        before_1970 = 'the rejection of a time before 1970'
        running.peer.until_sent(lambda: reported(-5), lambda: running.rejections() > rejected, before_1970)
    finally:
        running.peer.node.destroy_publisher(clock)
        assert running.set('use_sim_time', False).successful


@pytest.mark.parametrize(
    ('kind', 'words'),
    [
        ('nan', ('nan', 'finite')),
        ('huge', ('1e+300', 'beyond')),
        ('frame', ('frame_id',)),
        ('stamp', ('is no time',)),
        ('size', (' bytes: must be at most',)),
    ],
)
def test_message_that_cannot_be_used_is_rejected(running: Running, kind: str, words: tuple[str, ...]) -> None:
    sent = running.profile.rejected[kind]
    if isinstance(sent, str):
        pytest.skip(sent)
    assert rejects(running, sent, words)


def test_rejections_are_warnings(running: Running) -> None:
    # Each test may run in a process of its own: what the others sent may not have been sent here.
    sent = next(sent for sent in running.profile.rejected.values() if not isinstance(sent, str))

    running.peer.until_sent(lambda: running.send(sent), lambda: running.logged('rejected', 30), 'a warning')
    levels = {line.level for line in running.lines if 'rejected: ' in line.msg}
    assert levels == {30}


def test_second_publisher_is_reported(running: Running) -> None:
    kind, topic = running.profile.published
    name = f'{NAMESPACE}/{topic}'
    alternative = running.peer.node.create_publisher(kind, name, 5)
    try:
        running.peer.until(lambda: running.logged(f'another node publishes on {name} too', 30), 'the warning')
    finally:
        running.peer.node.destroy_publisher(alternative)


def test_its_topics_are_rows_of_the_table(running: Running) -> None:
    """On the graph there is nothing else, with these types; what rclpy makes itself is in no table."""
    node = running.peer.node
    of_rclpy = ('/parameter_events', '/clock', f'/{running.name}/transition_event')
    publishers = (node.get_publisher_names_and_types_by_node, lambda row: (row,), PUBLISHED)
    subscriptions = (node.get_subscriber_names_and_types_by_node, lambda rows: rows, HEARD)
    for graph, rows_of, table in (publishers, subscriptions):
        rows = {row.name.replace('~', f'/{running.name}'): row for entry in table.values() for row in rows_of(entry)}
        topics = dict(graph(running.name, NAMESPACE))
        assert topics or graph is subscriptions[0]
        for topic, kinds in topics.items():
            # Those of a chain's links lie below the link's name.
            name = re.sub('^/(upper|fore)(?=/)', '', topic.removeprefix(NAMESPACE))
            if name in of_rclpy or topic in of_rclpy or '/_action/' in topic:
                continue
            row = rows.get(name) or rows[name.removeprefix('/')]
            assert [row.type] == kinds, topic


def served(running: Running) -> dict[str, list[str]]:
    """The rows of its actions as the graph has them; skips if there are none."""
    graph = dict(get_action_server_names_and_types_by_node(running.peer.node, running.name, NAMESPACE))
    rows = [row for row in SERVED.values() if row.node == running.name]
    if not rows:
        assert graph == {}
        pytest.skip('it serves no action')
    if '--action' not in running.profile.words:
        pytest.skip('control_msgs is not installed, and no compiler to build it')
    return {row.name.replace('~', f'{NAMESPACE}/{running.name}'): [row.type] for row in rows}


def test_its_actions_are_rows_of_the_table(running: Running) -> None:
    rows, node = served(running), running.peer.node

    def served_only() -> bool:
        return dict(get_action_server_names_and_types_by_node(node, running.name, NAMESPACE)) == rows

    running.peer.until(served_only, f'{rows} and no other action')


def test_goal_that_cannot_be_used_is_rejected(running: Running) -> None:
    (name,) = served(running)
    from control_msgs.action import FollowJointTrajectory
    from control_msgs.msg import JointTolerance

    assert name.endswith(FOLLOW.removeprefix('~'))
    client = ActionClient(running.peer.node, FollowJointTrajectory, name)
    goal = FollowJointTrajectory.Goal
    strange = {
        'is no time': goal(trajectory=trajectory(0.0, sec=-5)),
        'not finite': goal(path_tolerance=[JointTolerance(position=math.nan)]),
        ' bytes: must be at most': goal(trajectory=trajectory(0.0, names=60_000)),
    }
    try:
        running.peer.until(client.server_is_ready, name)
        for why, sent in strange.items():
            before, reports = running.rejections(), len(running.reports)

            def is_counted(before: int = before, reports: int = reports, why: str = why) -> bool:
                return running.rejections() > before and why in running.texts(reports)

            future = client.send_goal_async(sent)
            running.peer.until(future.done, 'the answer to a goal')
            assert not future.result().accepted
            running.peer.until(is_counted, f'the rejection of a goal: {why}')
    finally:
        client.destroy()


def test_lifecycle_goes_down_and_up_again(running: Running) -> None:
    assert running.state() == State.PRIMARY_STATE_ACTIVE
    assert running.change(Transition.TRANSITION_DEACTIVATE)
    assert running.state() == State.PRIMARY_STATE_INACTIVE
    assert running.change(Transition.TRANSITION_CLEANUP)
    assert running.change(Transition.TRANSITION_CONFIGURE)
    assert running.change(Transition.TRANSITION_ACTIVATE)
    assert not running.change(Transition.TRANSITION_ACTIVATE)
    assert running.state() == State.PRIMARY_STATE_ACTIVE


def test_interrupt_ends_it_with_status_0(running: Running) -> None:
    running.program.send(signal.SIGINT)
    assert running.program.wait() == 0, running.program.lines
    assert not any('Traceback' in line for line in running.program.lines)


def test_every_node_of_the_room_is_an_executable() -> None:
    modules = {path.stem: ast.parse(path.read_text()) for path in ROS.glob('*.py')}
    names = {
        importlib.import_module(f'psd_deflection.ros.{name}').NODE_NAME
        for name, tree in modules.items()
        for statement in tree.body
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == 'NODE_NAME'
    }
    assert names == set(nodes_of_setup()) == set(PROFILES)
