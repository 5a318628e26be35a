# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The nodes that ``bench.campaign.messages`` attacks: each as it is used, what is right for it, and what is not."""

import contextlib
import functools
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import AccelStamped, PoseStamped, PoseWithCovarianceStamped, WrenchStamped
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, JointState, Temperature
from std_msgs.msg import Bool, Float64, Float64MultiArray, String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bench.simulated_arm import largest_step
from blind.render import Pose, Scene, photograph
from msg_adapters import ACCELERATION, LOAD, MARK, REFERENCE, REFERENCE_WITH_COVARIANCE, TEMPERATURE
from psd_deflection.arms.compensation.compensator import State
from psd_deflection.arms.compensation.settings import CompensatorSettings, ShaperSettings
from psd_deflection.arms.compensation.trajectory import KINK_S, Trajectory
from psd_deflection.arms.inputs import REST_S
from psd_deflection.base.log import null_log
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.records import FloatArray
from psd_deflection.ros.camera import CameraNode
from psd_deflection.ros.chain import ChainNode
from psd_deflection.ros.compensator import CompensatorNode
from psd_deflection.ros.estimator import EstimatorNode
from psd_deflection.ros.node import BaseNode
from psd_deflection.ros.shaper import ShaperNode
from psd_deflection.run.realtime import Signals
from psd_deflection.run.session import Session
from tools.program import ROOT

URDF = ROOT / 'config' / 'two_links.urdf'
CHAIN = ROOT / 'config' / 'two_links.yaml'
NAMES = ['shoulder', 'elbow']
JOINTS = [1.2, 0.6]
MOST_STEP = 1.0 + 1e-6
FASTEST = 1.0  # Speed limit of the joints of the URDF file, rad/s.
Good = Callable[[], Any]


def now() -> Any:
    sec, nanosec = divmod(time.time_ns(), 10**9)
    return Time(sec=sec, nanosec=nanosec)


def _stamped(message: Any, frame: str = '') -> Any:
    message.header.stamp, message.header.frame_id = now(), frame
    return message


def _load() -> Any:
    # Without a frame it is that of the rig, whatever its prefix is.
    out = _stamped(WrenchStamped())
    out.wrench.force.x = 3.0
    return out


def _pose(out: Any, pose: Any, frame: str) -> Any:
    pose.position.x, pose.position.y, pose.orientation.w = 1e-3, 2e-3, 1.0
    return _stamped(out, frame)


def _covered(frame: str) -> Any:
    out = PoseWithCovarianceStamped()
    out.pose.covariance = (np.eye(6) * 1e-12).ravel()
    return _pose(out, out.pose.pose, frame)


def deflection() -> Any:
    return _covered('end_effector_rest')


def _reference() -> Any:
    out = PoseStamped()
    return _pose(out, out.pose, '')


def joints() -> Any:
    return _stamped(JointState(name=list(NAMES), position=list(JOINTS)))


def trajectory() -> Any:
    """A move of half a second."""
    out = JointTrajectory(joint_names=list(NAMES))
    for at in (0.2, 0.5):
        point = JointTrajectoryPoint(positions=[q + 0.1 * at for q in JOINTS], velocities=[0.0, 0.0])
        point.time_from_start.nanosec = round(at * 1e9)
        out.points.append(point)
    return out


SCENE = Scene(width=320, height=240, focal=1000.0, centre=(165.0, 114.0))


@functools.cache
def _photograph(kind: str = '') -> Any:
    """Of the target: rows of pixels, or a file of that kind."""
    if kind:
        return opencv().imencode(f'.{kind}', _photograph())[1].tobytes()
    return photograph(SCENE, [Pose()], np.random.default_rng(0))


def _image() -> Any:
    size = {'height': SCENE.height, 'width': SCENE.width, 'step': SCENE.width}
    return _stamped(Image(encoding='mono8', data=_photograph().tobytes(), **size))


def _compressed() -> Any:
    kind = ('png', 'jpeg')[time.monotonic_ns() // 1000 % 2]
    return _stamped(CompressedImage(format=kind, data=_photograph(kind)))


GOOD: Mapping[str, Good] = {
    LOAD: _load,
    REFERENCE: _reference,
    REFERENCE_WITH_COVARIANCE: lambda: _covered(''),
    TEMPERATURE: lambda: _stamped(Temperature(temperature=21.0)),
    MARK: lambda: String(data='a mark'),
    ACCELERATION: lambda: _stamped(AccelStamped(), 'link_base'),
    '/image': _image,
    '/image/compressed': _compressed,
    '/camera_info': lambda: _stamped(CameraInfo(k=[float(v) for v in SCENE.matrix], d=[0.0] * 5)),
    '/end_effector/deflection': deflection,
    '/joint_states': joints,
    '/compensator/applied': lambda: Float64MultiArray(data=[0.0, 0.0]),
    '/compensator/robot_running': lambda: Bool(data=True),
    '/compensator/speed_scaling': lambda: Float64(data=1.0),
    '/compensator/controller_state': lambda: Bool(data=True),
    '/shaper/trajectory': trajectory,
    '/robot_description': lambda: String(data=URDF.read_text()),
    '/clock': lambda: Clock(clock=now()),
}
"""A good message of every input, by the end of its topic: a chain has those of its links in namespaces of theirs."""


class UnknownInputError(Exception):
    """A node has an input of which this campaign has no good message."""


def good_of(topic: str, kind: type) -> Good:
    """What makes good messages of ``topic``. Raises UnknownInputError."""
    matches = [GOOD[end] for end in sorted(GOOD, key=len) if topic.endswith(end)]
    if not matches or type(matches[-1]()) is not kind:
        raise UnknownInputError(f'{topic} ({kind.__name__}): is in no table of {__name__}: add a good message of it')
    return matches[-1]


class Attacked(ABC):
    """A node in this process. ``hand``: gives it an encoded message as DDS does; set by whoever attacks."""

    every: ClassVar[int] = 6  # So many strange messages come between what is right.

    def __init__(self, owner: BaseNode[Any]) -> None:
        self.owner = owner
        self.hand: Callable[[str, bytes], None] = lambda topic, content: None

    def runs(self) -> None:
        """Raises what ended the node."""
        if self.owner.error is not None:
            raise self.owner.error

    def right(self) -> None:
        """Hand over what is right, if the node needs any."""
        self.give()

    def rejected(self) -> int:
        return self.owner.gate.rejected.total()

    @abstractmethod
    def faults(self) -> list[str]:
        """What is wrong, at the end."""

    @abstractmethod
    def summary(self) -> str:
        """What it did meanwhile."""

    def give(self, *topics: str) -> None:
        for topic in topics:
            self.hand(topic, serialize_message(GOOD[topic]()))

    def close(self) -> None:
        self.owner.close()


class Measuring(Attacked):
    """A node with sessions: none may end, and estimates must come."""

    @abstractmethod
    def sessions(self) -> list[Session]:
        """Those that it has now."""

    def runs(self) -> None:
        for session in self.sessions():
            if not session.processing.alive:
                raise session.failed or RuntimeError('a pipeline has ended')

    def rejected(self) -> int:
        return sum(s.rejected.total() + s.processing.requests_dropped for s in self.sessions())

    def _estimates(self) -> int:
        return sum(s.pipeline.counters.estimates for s in self.sessions())

    def faults(self) -> list[str]:
        return [] if self._estimates() > 100 else ['no estimate came']

    def summary(self) -> str:
        return f'{self._estimates()} estimates'


class Estimator(Measuring):
    def __init__(self, folder: Path) -> None:
        # What the watch holds is soon as much as it may be.
        watch = {'watch': 'on', 'watch_dir': str(folder), 'watch_minutes': 0.5, 'watch_memory': 2_000_000}
        given = {'filter': 'modal', 'keep_zero': False, 'bag_dir': str(folder), **watch}
        self._node = EstimatorNode(given, null_log, Signals())
        super().__init__(self._node)

    def sessions(self) -> list[Session]:
        return [self._node.session] if self._node.session is not None else []


class Chain(Measuring):
    def __init__(self, folder: Path) -> None:
        self._node = ChainNode(str(CHAIN), {'bag_dir': str(folder)}, None, null_log, Signals())
        super().__init__(self._node)

    def sessions(self) -> list[Session]:
        return list(self._node.chain.sessions) if self._node.chain is not None else []

    def rejected(self) -> int:
        return super().rejected() + self.owner.gate.rejected.total()


class Camera(Attacked):
    """A node that sees three discs."""

    every = 20

    def __init__(self, folder: Path) -> None:
        self._answers = 0
        super().__init__(CameraNode(CameraSettings(rest_frames=1), null_log))
        _listen('/reference/deflection', self._heard)

    def _heard(self, message: Any) -> None:
        self._answers += 1

    def right(self) -> None:
        self.give('/image')

    def faults(self) -> list[str]:
        return [] if self._answers else ['no image was answered']

    def summary(self) -> str:
        return f'{self._answers} answers'


def _listen(topic: str, heard: Callable[[Any], None]) -> None:
    """Let ``heard`` have each message that this process publishes on ``topic``, before it leaves."""
    first = Publisher.publish

    def publish(publisher: Any, message: Any) -> None:
        if publisher.topic_name.endswith(topic):
            heard(message)
        first(publisher, message)

    Publisher.publish = publish


class Compensator(Attacked):
    """Offsets that follow: silence and holds are what it may do, a step is not."""

    def __init__(self, folder: Path) -> None:
        # A busy machine is late, and what is right would be stale.
        state, axes, names = 'std_msgs/msg/Bool', ('x', 'z'), tuple(NAMES)
        settings = CompensatorSettings(
            tip='tool', urdf=str(URDF), drive=True, axes=axes, joints=names, good=1, stale=1.0, controller_state=state
        )
        self._node = CompensatorNode(settings, null_log, str)
        super().__init__(self._node)
        self._stamps: list[float] = []
        self._commands: list[FloatArray] = []
        self._rates = [settings.max_rate]
        self.step = 0.0
        self.states: Counter[State] = Counter()
        _listen('/compensator/offsets', self._heard)

    def _heard(self, message: Any) -> None:
        self._rates = [*self._rates[-1:], self._node.settings.max_rate]
        self._stamps = [*self._stamps[-1:], time.monotonic()]
        self._commands = [*self._commands[-1:], np.array(message.data)]
        self.step = max(self.step, largest_step(self._stamps, self._commands, max(self._rates)))

    def runs(self) -> None:
        self._node.runs()
        self.states[self._node.command.state] += 1

    def right(self) -> None:
        """The robot runs, the deflection is good, the offsets are wanted."""
        if not self._node.compensator.enabled:
            self._enable()
        held = self._commands[-1].tolist() if self._commands else [0.0, 0.0]
        for _ in range(2):
            self.give(*(f'/compensator/{word}' for word in ('robot_running', 'speed_scaling', 'controller_state')))
            self.hand('/compensator/applied', serialize_message(Float64MultiArray(data=held)))
            self.give('/joint_states', '/end_effector/deflection')

    def _enable(self) -> None:
        (service,) = (s for s in self._node.node.services if s.service_name.endswith('/enable'))
        asked = service.callback(SetBool.Request(data=True), SetBool.Response())
        with contextlib.suppress(StopIteration):
            asked.send(None)

    def faults(self) -> list[str]:
        out = [] if self.states[State.FOLLOWING] else ['the offsets never followed']
        return out + ([f'a step of {self.step:.4f} of max_rate * dt'] if self.step > MOST_STEP else [])

    def summary(self) -> str:
        followed = self.states[State.FOLLOWING] / max(self.states.total(), 1)
        return f'the offsets followed {followed:.0%} of the time; largest step {self.step:.4f} of max_rate * dt'


class Shaper(Attacked):
    """Trajectories that replace each other."""

    def __init__(self, folder: Path) -> None:
        self._shaped, self.step, self._turns = 0, 0.0, 0
        self._wrong: list[str] = []
        self._last: tuple[int, Trajectory] | None = None
        super().__init__(ShaperNode(ShaperSettings(frequency=12.0, urdf='robot_description'), null_log))
        _listen('/shaper/shaped', self._heard)

    def _heard(self, message: Any) -> None:
        """It must be finite and in order, and begin where the one before it is."""
        if not message.points:
            self._last = None
            return
        self._shaped += 1
        states = np.array(
            [[part for part in (p.positions, p.velocities, p.accelerations) if len(part)] for p in message.points]
        )
        times = np.array([p.time_from_start.sec + p.time_from_start.nanosec / 1e9 for p in message.points])
        start_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        if not np.all(np.isfinite(states)) or np.any(np.diff(times) <= 0.0) or not start_ns > 0:
            self._wrong.append(f'passed on: {message}'[:500])
            return
        new, last = Trajectory(tuple(message.joint_names), times, states), self._last
        self._last = start_ns, new
        if last is not None and set(last[1].names) == set(new.names):
            since = (start_ns - last[0]) / 1e9
            if 0.0 <= since < last[1].duration:
                at = last[1].ordered(new.names).at(np.array([since]))
                apart = float(np.abs(at[0, 0] - states[0, 0]).max())
                self.step = max(self.step, apart / (FASTEST * KINK_S))

    def right(self) -> None:
        """The joints' limits and where they are, and a move; one in a hundred begins at joints that stand."""
        self.give('/joint_states')
        if self._turns % 100 == 0:
            # Also if strange positions were told before.
            for _ in range(2):
                time.sleep(1.05 * REST_S)
                self.give('/joint_states')
        self._turns += 1
        if self._shaped % 50 == 0:
            self.give('/robot_description')
        self.give('/shaper/trajectory')

    def faults(self) -> list[str]:
        out = self._wrong[:3] + ([] if self._shaped else ['no trajectory was shaped'])
        return out + ([f'a step of {self.step:.4f} of speed * {KINK_S:g} s'] if self.step > MOST_STEP else [])

    def summary(self) -> str:
        return f'{self._shaped} trajectories shaped; largest step {self.step:.4f} of speed * {KINK_S:g} s'


EVERY = (Estimator, Camera, Chain, Compensator, Shaper)
NODES: Mapping[str, type[Any]] = {node.__name__.lower(): node for node in EVERY}
