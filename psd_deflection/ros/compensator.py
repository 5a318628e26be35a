"""The node ``compensator``: the end effector's deflection in, offsets of the joints out.

It subscribes to ``end_effector/deflection`` and ``joint_states``, every 10 ms it publishes offsets as
std_msgs/Float64MultiArray, one for each joint in the order of the parameter ``joints``: on ``~/proposed`` if it runs
dry, else on ``~/offsets``. With the parameter ``output`` at ``commands`` it publishes positions plus offsets on
``~/commands``, too. It is silent until ``~/enable`` lets the offsets follow, and again when they are back at zero.

A thread of its own publishes the offsets and finds that deflections come no more, whatever the main thread waits for: a
message, a terminal that does not read, a disk. On a busy machine it may be late. Then the offsets move later, by no
more than their rate allows for a tenth of a second, and not at all if the deflection has become stale meanwhile.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.publisher import Publisher
from scipy.spatial.transform import Rotation
from std_srvs.srv import SetBool

from msg_adapters import DEFLECTION_WITH_COVARIANCE, DIAGNOSTICS, END_EFFECTOR, TOPIC_TYPES, to_messages
from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.compensation.arm import Arm
from psd_deflection.arms.compensation.compensator import (
    ALL_JOINTS,
    COMMANDS,
    SETTINGS,
    Compensator,
    CompensatorSettings,
    Observed,
    State,
)
from psd_deflection.arms.inputs import LARGEST_POSITION, frame_fault, joints_fault, quaternion_fault, stamp_fault
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import INFO, WARNING, Say
from psd_deflection.recordings import cdr
from psd_deflection.records import DiagnosticEntry, DiagnosticReport, FloatArray
from psd_deflection.ros.declared import DeclaredParameters, node_with_overrides
from psd_deflection.ros.gate import InputGate
from psd_deflection.ros.log import NodeLog
from psd_deflection.ros.names import END_REST, JOINT_STATES
from psd_deflection.ros.running import SPIN_S, executor_of, ros
from psd_deflection.ros.wires import message_class, qos, relative
from psd_deflection.run.diagnostics import ERROR, OK, WARN
from psd_deflection.run.repeats import Repeats

NODE_NAME = 'compensator'
ENABLE = '~/enable'
OFFSETS, SUMS, PROPOSED = '~/offsets', '~/commands', '~/proposed'
APPLIED, RUNNING = '~/applied', '~/robot_running'
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
    """The node; ``drive``: publish offsets for a controller, else proposals. Raises ConfigError for a bad parameter."""

    def __init__(self, arm: Arm, settings: CompensatorSettings, say: Say, drive: bool) -> None:
        self.node = node = node_with_overrides(NODE_NAME)
        try:
            values = dataclasses.asdict(settings)
            values = {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}
            parameters = DeclaredParameters(node, SETTINGS, values, self._change)
            self._order = _order(arm, parameters.settings.joints)
        except ConfigError:
            node.destroy_node()
            raise
        self._settings = parameters.settings
        self.log = NodeLog(node, say)
        self.compensator = Compensator(arm, self._settings, dry=not drive)
        self.compensator.enable(not drive)
        self._lock = threading.Lock()
        """Of the compensator and of what was sent."""
        self._drive = drive
        self._repeats = Repeats(self.log)
        self._gate = InputGate(node, self.log)
        self._names = list(arm.names)
        self._places: tuple[list[str], list[int]] = ([], [])
        self._running = True
        self._listen()
        self._outputs = [PROPOSED] if not drive else [OFFSETS, SUMS] if self._sums else [OFFSETS]
        kind = message_class('std_msgs/msg/Float64MultiArray')
        self._array = kind
        self._publishers: dict[str, Publisher] = {name: node.create_publisher(kind, name, 5) for name in self._outputs}
        self._health = node.create_publisher(message_class(TOPIC_TYPES[DIAGNOSTICS]), DIAGNOSTICS, qos(DIAGNOSTICS))
        if drive:
            node.create_service(SetBool, ENABLE, self._enable)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(TOLD_S, self._tell, clock=steady)
        node.create_timer(1.0, self._report, clock=steady)
        self.command = self._told = self.compensator.watch(time.monotonic())
        self._ended, self._ramped = threading.Event(), threading.Event()
        self._failed: BaseException | None = None
        self._sender = threading.Thread(target=self._send_until_the_end, name='offsets', daemon=True)
        self._sender.start()
        out = self._publishers[self._outputs[-1]].topic_name
        when = ', once it is enabled' if drive else ''
        self.log(f'publishing {out} for {", ".join(self._names[i] for i in self._order)}{when}')

    @property
    def _sums(self) -> bool:
        return self._settings.output == COMMANDS

    def _listen(self) -> None:
        listen = self._gate.listen
        kind = message_class(TOPIC_TYPES[DEFLECTION_WITH_COVARIANCE])
        listen(kind, relative(END_EFFECTOR), self._deflection_fault, self._seen)
        listen(message_class('sensor_msgs/msg/JointState'), JOINT_STATES, self._joints_fault, self._joints)
        if self._drive:
            listen(message_class('std_msgs/msg/Bool'), RUNNING, lambda message: '', self._robot)
        if self._drive and not self._sums:
            listen(message_class('std_msgs/msg/Float64MultiArray'), APPLIED, self._applied_fault, self._applied)

    def _change(self, settings: CompensatorSettings) -> None:
        with self._lock:
            self._settings = self.compensator.settings = settings

    def release(self) -> bool:
        """Let the offsets go back to zero; True when they are there."""
        with self._lock:
            if self.compensator.enabled:
                self.compensator.enable(False)
        return not np.any(self.command.offsets)

    def _deflection_fault(self, message: Any) -> str:
        stamp, turned = message.header.stamp, message.pose.pose.orientation
        wanted = self._settings.frame_prefix + END_REST
        return (
            stamp_fault(stamp.sec, stamp.nanosec)
            or frame_fault(message.header.frame_id, wanted)
            or quaternion_fault([turned.x, turned.y, turned.z, turned.w])
        )

    def _seen(self, message: Any) -> None:
        at, turned = message.pose.pose.position, message.pose.pose.orientation
        rotation = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w]).as_matrix()
        stamp = message.header.stamp
        t_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        deflection = Transform(rotation, np.array([at.x, at.y, at.z]))
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        seen = Observed(t_ns / 1e9, deflection, covariance, self._age(t_ns))
        with self._lock:
            self.compensator.observe(time.monotonic(), seen)

    def _age(self, t_ns: int) -> float:
        """s, by the node's clock: that of the simulation with ``use_sim_time``."""
        return (int(self.node.get_clock().now().nanoseconds) - t_ns) / 1e9

    def _joints_fault(self, message: Any) -> str:
        stamp = message.header.stamp
        fault = stamp_fault(stamp.sec, stamp.nanosec) or joints_fault(message.name, message.position, self._names)
        if fault or not set(self._names) <= set(message.name):
            return fault
        t_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        # A driver without a clock leaves the stamp at 0.
        age = self._age(t_ns) if t_ns else 0.0
        return f'its stamp is {age:.3g} s old' if abs(age) > self._settings.stale else ''

    def _joints(self, message: Any) -> None:
        names = list(message.name)
        if not len(message.position):
            return
        if names != self._places[0]:
            if not set(self._names) <= set(names):
                # Another part of the robot may publish its joints on the same topic.
                return
            self._places = names, [names.index(name) for name in self._names]
        positions = np.array(message.position, dtype=np.float64)
        with self._lock:
            self.compensator.joints(time.monotonic(), positions[self._places[1]])

    def _applied_fault(self, message: Any) -> str:
        count, wanted = len(message.data), len(self._names)
        if count != wanted:
            return f'{count} offsets: must be {wanted}'
        good = all(abs(v) <= LARGEST_POSITION for v in message.data)
        return '' if good else f'an offset is not finite or beyond {LARGEST_POSITION:g}'

    def _applied(self, message: Any) -> None:
        offsets = np.empty(len(self._names))
        offsets[self._order] = message.data
        with self._lock:
            self.compensator.applied(offsets)

    def _robot(self, message: Any) -> None:
        self._running = bool(message.data)
        self._check_robot()

    def _check_robot(self) -> None:
        """Hold while the robot does not run, or while another node publishes what we publish."""
        rivals = [p.topic_name for p in self._publishers.values() if self.node.count_publishers(p.topic_name) > 1]
        why = '' if self._running else 'the robot does not run'
        with self._lock:
            self.compensator.stop(f'another node publishes {rivals[0]}' if rivals else why)

    def _send_until_the_end(self) -> None:
        """Send the offsets every ``PERIOD_S``; a time that was missed is left out."""
        due = time.monotonic()
        try:
            while not self._ended.wait(max(due - time.monotonic(), 0.0)):
                self._send()
                due = max(due + PERIOD_S, time.monotonic())
        except BaseException as error:
            self._failed = error
            try:
                self._ramp_down()
            finally:
                self._ramped.set()

    def _send(self) -> None:
        with self._lock:
            before = self.command.state
            self.command = command = self.compensator.watch(time.monotonic())
            sums = self.compensator.commands() if self._sums else None
            waits = self.compensator.waits
        # The last one before the silence is that of no offset.
        if waits or (self._drive and command.state is State.OFF and before is State.OFF):
            return
        self._publish(command.offsets, sums)

    def _publish(self, offsets: FloatArray, sums: FloatArray | None) -> None:
        for name, publisher in self._publishers.items():
            values = sums if name == SUMS else offsets
            if values is not None:
                publisher.publish(self._array(data=values[self._order].tolist()))

    def _ramp_down(self) -> None:
        """Take the last offsets back at their rate, whatever has failed."""
        offsets, sums = self.command.offsets.copy(), self.compensator.commands() if self._sums else None
        held = None if sums is None else sums - offsets
        step = self._settings.max_rate * PERIOD_S
        while np.any(offsets) and not self._ended.wait(PERIOD_S):
            offsets -= np.clip(offsets, -step, step)
            self._publish(offsets, None if held is None else held + offsets)
        self.command = self.command._replace(offsets=offsets)

    def check(self) -> None:
        """Raise what ended the thread that sends the offsets, if anything did, once it has taken them back."""
        if self._failed is not None and self._ramped.is_set():
            raise self._failed

    def _tell(self) -> None:
        self._repeats.settle(time.monotonic())
        self._gate.settle()
        self._check_robot()
        command = self.command
        before, self._told = self._told, command
        if before.state is not command.state or (command.state is State.HOLDING and before.why != command.why):
            line = f'{command.state}{": " if command.why else ""}{command.why}'
            bad = command.state is State.HOLDING
            self._repeats.tell(str(command.state), line, WARNING if bad else INFO, time.monotonic(), NEWS)

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
        if self._failed is not None:
            level, text = ERROR, f'{type(self._failed).__name__}: {self._failed}: the offsets go back to zero'
        elif command.limited:
            level, text = WARN, f'{text}: a limit keeps the offsets from what the deflection asks for'
        values = [(f'offset {name}', f'{v:.6f}') for name, v in zip(self._names, command.offsets, strict=True)]
        values += [('residual (m)', f'{command.residual:.6f}'), *self._gate.values()]
        node = self.node.get_fully_qualified_name().removeprefix('/')
        entry = DiagnosticEntry(f'{node}: offsets', level, text, tuple(values))
        for message in to_messages(DiagnosticReport(time.time_ns(), (entry,))):
            self._health.publish(cdr.encode(message.type, message.fields))

    def close(self) -> None:
        """Send no more, and leave the graph."""
        self._ended.set()
        self._sender.join()
        self.log.close()
        self.node.destroy_node()


def _order(arm: Arm, joints: Sequence[str]) -> list[int]:
    """Where each of ``joints`` is in the arm. Raises ConfigError if they are not those of the arm."""
    if tuple(joints) == (ALL_JOINTS,):
        return list(range(len(arm.names)))
    if sorted(joints) != sorted(arm.names):
        raise ConfigError(f'joints = {list(joints)}: must be those of the arm, in any order: {", ".join(arm.names)}')
    return [arm.names.index(name) for name in joints]


def run_compensator(ros_args: Sequence[str], arm: Arm, settings: CompensatorSettings, say: Say, drive: bool) -> int:
    """Run the node until SIGINT or SIGTERM; then let the offsets go back to zero, unless a second signal comes."""
    if settings.joints == (ALL_JOINTS,):
        settings = dataclasses.replace(settings, joints=arm.names)
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
