# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The graph of a campaign: a simulated arm, which may tell what is not so, and the compensator as a program."""

import math
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bench.simulated_arm import SimulatedArm, largest_step
from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.compensation.settings import CompensatorSettings
from psd_deflection.records import FloatArray
from tools.program import ROOT, Program

NAMES = ('shoulder', 'elbow')
NOMINAL = np.array([1.2, 0.6])
LOAD = (0.0, 0.0, -40.0)  # N, at the end effector.
PERIOD_S, NOISE = 0.02, 1e-6
MAX_RATE, FOLLOW_ERROR = CompensatorSettings().max_rate, CompensatorSettings().follow_error
LATE_S = 0.05
"""With a longer time between two steps of the arm, the compensator finds rightly that nobody tells it anything, s."""
Notify = Callable[[Any], bool]


def faithful(message: Any) -> bool:
    return True


def wrong(field: str, *values: Any, added: bool = False) -> Notify:
    """``field``, or each of its parts x, y, z, w, has another value, or ``added`` to what it had."""

    def changed(message: Any) -> bool:
        *path, last = field.split('.')
        for name in path:
            message = getattr(message, name)
        for part, value in zip('xyzw' if len(values) > 1 else (last,), values, strict=False):
            owner = getattr(message, last) if len(values) > 1 else message
            setattr(owner, part, getattr(owner, part) + value if added else value)
        return True

    return changed


def by_seconds(seconds: float) -> Notify:
    """A stamp that is so much later."""

    def shifted(message: Any) -> bool:
        t_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec + round(1e9 * seconds)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(max(t_ns, 0), 10**9)
        return True

    return shifted


def leaps(message: Any) -> bool:
    message.position = [v + 1.0 for v in message.position]
    return True


PLACE = 'pose.pose.position'
DEFLECTIONS: dict[str, tuple[Notify, str]] = {
    'not finite': (wrong(f'{PLACE}.x', math.nan), 'not finite'),
    'jump': (wrong(f'{PLACE}.x', 0.1, added=True), 'jumps by'),
    'stale': (by_seconds(-1.0), 'is older than'),
    'silent': (lambda message: False, 'no deflection for'),
    '1e300': (wrong(f'{PLACE}.z', 1e300), 'more than the links can have'),
    'ten metres': (wrong(f'{PLACE}.z', 10.0), 'more than the links can have'),
    'denormal quaternion': (wrong('pose.pose.orientation', 0.0, 0.0, 0.0, 1e-200), 'no deflection for'),
    'wrong frame': (wrong('header.frame_id', 'world'), 'no deflection for'),
    # Zeros are ROS's word for an unknown one.
    'zero covariance': (wrong('pose.covariance', np.zeros(36)), 'does not say how certain'),
    'covariance of metres': (wrong('pose.covariance', np.eye(6).ravel()), 'uncertain by more than'),
    'clock set by an hour': (by_seconds(3600.0), 'ahead of our clock'),
}
"""What the arm tells of its deflection, and what the compensator says then."""
JOINTS: dict[str, tuple[Notify, str]] = {
    'stale joints': (by_seconds(-1.0), 'no positions of the joints'),
    'leaping joints': (leaps, 'leap by'),
    'joints at 1e300': (wrong('position', [1e300, 1e300]), 'no positions of the joints'),
}


def move_to(end: FloatArray, seconds: float) -> JointTrajectory:
    """To rest at ``end``, rad, in that time."""
    at = Duration(seconds=seconds).to_msg()
    point = JointTrajectoryPoint(positions=end.tolist(), velocities=[0.0, 0.0], time_from_start=at)
    return JointTrajectory(joint_names=list(NAMES), points=[point])


class Spun:
    """A node of a campaign, which is spun here. ``program``: what it waits for, whose last words an error has."""

    def __init__(self, name: str) -> None:
        rclpy.init()
        self.node = rclpy.create_node(name)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.program: Program | None = None

    def spin(self, seconds: float, condition: Callable[[], bool] = lambda: False, what: str = '') -> bool:
        """Spin until ``condition``, or for ``seconds``; then it is an error if there is a ``what``. Whether it came."""
        until = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > until:
                if what:
                    message = self.program.text[-1000:] if self.program is not None else ''
                    raise RuntimeError(f'waited {seconds:g} s for {what}\n{message}')
                return False
            self.executor.spin_once(timeout_sec=0.01)
        return True

    def close(self) -> None:
        if self.program is not None:
            self.program.end()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()


def message_of(deflection: Transform, chance: np.random.Generator) -> Any:
    """What the chain publishes of a deflection of its end effector, without a stamp: with noise, and how much."""
    out = PoseWithCovarianceStamped()
    place, rotated = out.pose.pose.position, out.pose.pose.orientation
    place.x, place.y, place.z = (deflection.position + chance.normal(size=3) * NOISE).tolist()
    rotated.x, rotated.y, rotated.z, rotated.w = deflection.quaternion.tolist()
    out.pose.covariance = (np.eye(6) * NOISE**2).ravel()
    return out


class Plant:
    """The arm on the graph: it adds the offsets that it hears to its commands, and tells them, its deflection and its
    joints. ``notify`` and ``notify_joints`` may change what it says, and withhold it by False. ``stands``: a protective
    stop. ``applies``: the controller runs, and tells what it has: ``held``. ``share``: how much of that it adds,
    whatever it tells. ``droop``, rad: how far its servos leave the joints below their command. ``commands``: it takes
    commands, not offsets; ``held`` is its command less the nominal one. ``offsets``: all that were heard, and
    ``stamps`` when they were sent, s. ``late``: whether a step was later than ``LATE_S``."""

    def __init__(self, node: Any, topic: str = '/end_effector/deflection', joints: str = '/joint_states') -> None:
        self.arm = SimulatedArm(read_chain(ROOT / 'config' / 'two_links.yaml').chain, NOMINAL, damping=0.1)
        self.arm.force = np.array(LOAD)
        self.rigid = self.arm.chain.rigid(NOMINAL.tolist())
        self.offsets: list[FloatArray] = [np.zeros(2)]
        self.stamps = [0.0]
        self.notify: Notify = faithful
        self.notify_joints: Notify = faithful
        self.stands, self.applies, self.held = False, True, np.zeros(2)
        self.share, self.droop, self.commands = 1.0, 0.0, False
        self.late = False
        self._noise = np.random.default_rng(0)
        self._deflections = node.create_publisher(PoseWithCovarianceStamped, topic, 5)
        self._joints = node.create_publisher(JointState, joints, 5)
        node.create_subscription(Float64MultiArray, '/compensator/offsets', self._offset, 5)
        node.create_subscription(Float64MultiArray, '/compensator/commands', self._commanded, 5)
        self._applied = node.create_publisher(Float64MultiArray, '/compensator/applied', 5)
        self._reference = node.create_publisher(JointState, '/compensator/reference', 5)
        self._then = time.monotonic()
        node.create_timer(PERIOD_S, self._step)

    def _offset(self, message: Any, info: Any) -> None:
        if not self.commands:
            self._take(np.array(message.data), info)

    def _commanded(self, message: Any, info: Any) -> None:
        if self.commands:
            self._take(np.array(message.data) - NOMINAL, info)

    def _take(self, offsets: FloatArray, info: Any) -> None:
        self.offsets.append(offsets)
        self.stamps.append(info['source_timestamp'] / 1e9)
        if self.applies:
            self.held = self.offsets[-1]

    def _step(self) -> None:
        now = time.monotonic()
        commanded = NOMINAL + self.share * self.held - self.droop
        self.arm.step(self.arm.angles.copy() if self.stands else commanded, now - self._then)
        self.late |= now - self._then > LATE_S
        self._then = now
        if self.applies:
            self._applied.publish(Float64MultiArray(data=self.held.tolist()))
            has = (NOMINAL + self.held)[::-1].tolist()
            self._reference.publish(JointState(name=['elbow', 'shoulder'], position=has))
        stamp_s, stamp_ns = divmod(time.time_ns(), 10**9)
        joints = JointState(name=['elbow', 'shoulder'], position=self.arm.angles[::-1].tolist())
        message = message_of(self.arm.end().deflection, self._noise)
        for header in (joints.header, message.header):
            header.stamp.sec, header.stamp.nanosec = stamp_s, stamp_ns
        if self.notify_joints(joints):
            self._joints.publish(joints)
        if self.notify(message):
            self._deflections.publish(message)

    def error(self) -> float:
        """Distance of the end effector from its rigid pose, m."""
        return float(np.linalg.norm(self.arm.end().deflected.position - self.rigid.position))

    def step(self, since: int = 0) -> float:
        """The largest step between two commands, from number ``since`` on, over what the rate allows."""
        return largest_step(self.stamps[since:], self.offsets[since:], MAX_RATE)


URDF = ROOT / 'config' / 'two_links.urdf'
LONGEST_S, ASK_AGAIN_S = 60.0, 5.0
READY = 'once it is enabled'  # What the compensator logs when it can be enabled.
BREAKS = """
import sys, time
from pathlib import Path
from psd_deflection.cli.main import main
from psd_deflection.ros.compensator import CompensatorNode
from psd_deflection.ros.gate import InputGate
flag, owner = Path(sys.argv[1]), {'health': CompensatorNode, 'take_in': InputGate}[sys.argv[2]]
original = getattr(owner, sys.argv[2])
def failing(*given):
    if flag.exists():
        if not flag.read_text():
            flag.write_text(repr(time.time()))
        raise {'health': RuntimeError, 'take_in': MemoryError}[sys.argv[2]]('an error of its own')
    return original(*given)
setattr(owner, sys.argv[2], failing)
sys.exit(main(sys.argv[3:]))
"""
"""Our program. A method fails as soon as the file exists that is its first argument: ``health``, which ends the node by
an error, or ``take_in``, which its way out needs as well."""


class Graph(Spun):
    """A node of the campaign, the arm, and the compensator, which ``start`` starts. ``topics``: the arm's outputs."""

    def __init__(self, *topics: str) -> None:
        super().__init__('campaign')
        self.plant = Plant(self.node, *topics)
        self.flag = Path(tempfile.mkdtemp()) / 'flag'
        self.start()

    def start(self, *arguments: str, breaks: str = 'health') -> Program:
        """Start the compensator with further arguments; ``breaks``: what fails once ``flag`` exists."""
        base = ['compensator', '--urdf', str(URDF), '--tip', 'tool', '--axes', 'x,z', '--drive']
        self.compensator = self.program = Program(
            [sys.executable, '-c', BREAKS, str(self.flag), breaks, *base, *arguments]
        )
        return self.compensator

    def start_again(self, *arguments: str, breaks: str = 'health', enabled: bool = True) -> None:
        """Start the compensator, wait until it can be enabled, and enable it unless not ``enabled``."""
        self.start(*arguments, breaks=breaks)
        self.spin(LONGEST_S, lambda: READY in self.compensator.text, 'the node')
        if enabled:
            self.enable()

    def enable(self, wanted: bool = True) -> None:
        client = self.node.create_client(SetBool, '/compensator/enable')
        self.spin(LONGEST_S, client.service_is_ready, 'the service')
        requests: list[Any] = []

        def answered() -> bool:
            # DDS loses a request to a service that it has just found.
            if not requests or time.monotonic() - began > ASK_AGAIN_S * len(requests):
                requests.append(client.call_async(SetBool.Request(data=wanted)))
            return any(request.done() for request in requests)

        began = time.monotonic()
        self.spin(LONGEST_S, answered, 'its answer')
        self.node.destroy_client(client)
