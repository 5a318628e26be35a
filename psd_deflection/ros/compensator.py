"""The node ``compensator``: the end effector's deflection in, offsets of the joints out.

It subscribes to ``end_effector/deflection`` and ``joint_states``. Every 10 ms it publishes the offsets as
trajectory_msgs/JointTrajectory with one point: on ``~/proposed`` if it runs dry, else on ``~/offsets``, which a
controller adds to its commands. Then ``~/enable`` lets the offsets follow, or go back to zero.

A thread of its own publishes the offsets and finds that deflections come no more, whatever the main thread waits for: a
message, a terminal that does not read, a disk. On a busy machine it may be late. Then it sends no offset that it did
not send before: what is sent is never newer than a deflection that is not stale.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from msg_adapters import DEFLECTION_WITH_COVARIANCE, DIAGNOSTICS, END_EFFECTOR, TOPIC_TYPES, to_messages
from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.compensation.arm import Arm
from psd_deflection.arms.compensation.compensator import Compensator, CompensatorSettings, Observed, State
from psd_deflection.base.errors import Warned
from psd_deflection.recordings import cdr
from psd_deflection.records import DiagnosticEntry, DiagnosticReport
from psd_deflection.ros.names import JOINT_STATES
from psd_deflection.ros.running import SPIN_S, executor_of, ros
from psd_deflection.ros.wires import message_class, qos, relative
from psd_deflection.run.diagnostics import ERROR, OK, WARN
from psd_deflection.run.repeats import Repeats

NODE_NAME = 'compensator'
ENABLE = '~/enable'
OFFSETS, PROPOSED = '~/offsets', '~/proposed'
PERIOD_S = 0.01
TOLD_S = 0.02
"""Changes of state that are shorter are not told, s."""
NEWS = 6
"""Changes to one state that are told one by one, before they are counted and told together."""

RELEASE_S = 10.0
"""Longest time that the end waits for the offsets to go back to zero, s."""

LEAVE_S = 0.3
"""Time for the last offsets to leave, s."""

_LEVELS = {State.OFF: OK, State.FOLLOWING: OK, State.RELEASING: WARN, State.HOLDING: ERROR}


class CompensatorNode:
    """The node; ``drive``: publish offsets for a controller, else proposals."""

    def __init__(self, arm: Arm, settings: CompensatorSettings, say: Callable[[str], None], drive: bool) -> None:
        self.compensator = Compensator(arm, settings, dry=not drive)
        self.compensator.enable(not drive)
        self._lock = threading.Lock()
        """Of the compensator and of what was sent."""
        self.command = self._told = self.compensator.watch(time.monotonic())
        self._ended = threading.Event()
        self._failed: BaseException | None = None
        self._sender = threading.Thread(target=self._send_until_the_end, name='offsets', daemon=True)
        self._say = say
        self._repeats = Repeats(say)
        self._names = list(arm.names)
        self._places: tuple[list[str], list[int]] = ([], [])
        self.node = node = Node(NODE_NAME)
        kind = message_class(TOPIC_TYPES[DEFLECTION_WITH_COVARIANCE])
        node.create_subscription(kind, relative(END_EFFECTOR), self._seen, 5)
        node.create_subscription(message_class('sensor_msgs/msg/JointState'), JOINT_STATES, self._joints, 5)
        self._out = node.create_publisher(JointTrajectory, OFFSETS if drive else PROPOSED, 5)
        self._health = node.create_publisher(message_class(TOPIC_TYPES[DIAGNOSTICS]), DIAGNOSTICS, qos(DIAGNOSTICS))
        if drive:
            node.create_service(SetBool, ENABLE, self._enable)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(TOLD_S, self._tell, clock=steady)
        node.create_timer(1.0, self._report, clock=steady)
        self._sender.start()
        say(f'publishing {self._out.topic_name} for {", ".join(arm.names)}')

    def release(self) -> bool:
        """Let the offsets go back to zero; True when they are there."""
        with self._lock:
            if self.compensator.enabled:
                self.compensator.enable(False)
        return not np.any(self.command.offsets)

    def _seen(self, message: Any) -> None:
        at, turned = message.pose.pose.position, message.pose.pose.orientation
        quaternion = np.array([turned.x, turned.y, turned.z, turned.w])
        rotation = np.full((3, 3), np.nan)
        if np.all(np.isfinite(quaternion)) and np.any(quaternion):
            rotation = Rotation.from_quat(quaternion).as_matrix()
        stamp = message.header.stamp
        t_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        deflection = Transform(rotation, np.array([at.x, at.y, at.z]))
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        seen = Observed(t_ns / 1e9, deflection, covariance, (time.time_ns() - t_ns) / 1e9)
        with self._lock:
            self.compensator.observe(time.monotonic(), seen)

    def _joints(self, message: Any) -> None:
        names = list(message.name)
        if names != self._places[0]:
            missing = [name for name in self._names if name not in names]
            if missing:
                # Another part of the robot may publish its joints on the same topic.
                return
            self._places = names, [names.index(name) for name in self._names]
        positions = np.array(message.position, dtype=np.float64)
        if len(positions) == len(names):
            with self._lock:
                self.compensator.joints(time.monotonic(), positions[self._places[1]])

    def _send_until_the_end(self) -> None:
        """Send the offsets every ``PERIOD_S``; a time that was missed is left out."""
        due = time.monotonic()
        try:
            while not self._ended.wait(max(due - time.monotonic(), 0.0)):
                self._send()
                due = max(due + PERIOD_S, time.monotonic())
        except BaseException as error:
            self._failed = error

    def _send(self) -> None:
        with self._lock:
            now, t_ns = time.monotonic(), time.time_ns()
            command = self.compensator.watch(now)
            if command.state is State.HOLDING:
                self.compensator.keep(self.command.offsets)
                command = command._replace(offsets=self.command.offsets)
            self.command = command
        point = JointTrajectoryPoint(positions=command.offsets.tolist())
        message = JointTrajectory(joint_names=self._names, points=[point])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 1_000_000_000)
        self._out.publish(message)

    def check(self) -> None:
        """Raise what ended the thread that sends the offsets, if anything did."""
        if self._failed is not None:
            raise self._failed

    def _tell(self) -> None:
        self._repeats.settle(time.monotonic())
        command = self.command
        before, self._told = self._told, command
        if before.state is not command.state or (command.state is State.HOLDING and before.why != command.why):
            line = f'{command.state}{": " if command.why else ""}{command.why}'
            bad = command.state is State.HOLDING
            self._repeats.tell(str(command.state), Warned(line) if bad else line, time.monotonic(), NEWS)

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        with self._lock:
            self.compensator.enable(request.data)
            command = self.compensator.watch(time.monotonic())
        response.success = True
        response.message = f'{command.state}{": " if command.why else ""}{command.why}'
        return response

    def _report(self) -> None:
        command = self.command
        level, text = _LEVELS[command.state], str(command.state) + (f': {command.why}' if command.why else '')
        if command.limited:
            level, text = WARN, f'{text}: a limit keeps the offsets from what the deflection asks for'
        values = [(f'offset {name}', f'{v:.6f}') for name, v in zip(self._names, command.offsets, strict=True)]
        values.append(('residual (m)', f'{command.residual:.6f}'))
        node = self.node.get_fully_qualified_name().removeprefix('/')
        entry = DiagnosticEntry(f'{node}: offsets', level, text, tuple(values))
        for message in to_messages(DiagnosticReport(time.time_ns(), (entry,))):
            self._health.publish(cdr.encode(message.type, message.fields))

    def close(self) -> None:
        """Send no more, and leave the graph."""
        self._ended.set()
        self._sender.join()
        self.node.destroy_node()


def run_compensator(
    ros_args: Sequence[str], arm: Arm, settings: CompensatorSettings, say: Callable[[str], None], drive: bool
) -> int:
    """Run the node until SIGINT or SIGTERM; then let the offsets go back to zero, unless a second signal comes."""
    with ros(NODE_NAME, ros_args) as signals:
        owner = CompensatorNode(arm, settings, say, drive)
        try:
            with executor_of(owner.node) as executor:
                while not signals.stop:
                    executor.spin_once(timeout_sec=SPIN_S)
                    owner.check()
                signals.stop = False
                until = time.monotonic() + RELEASE_S
                while drive and not (owner.release() or signals.stop) and time.monotonic() < until:
                    executor.spin_once(timeout_sec=SPIN_S)
                # DDS does not say when the last offsets have left. If the publisher goes first, they are lost.
                until = time.monotonic() + LEAVE_S
                while drive and not signals.stop and time.monotonic() < until:
                    executor.spin_once(timeout_sec=SPIN_S)
        finally:
            owner.close()
    return 0
