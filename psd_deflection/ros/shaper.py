"""The node ``shaper``: joint trajectories in, the same out, shaped so that they do not ring the link.

It subscribes to ``~/trajectory`` and publishes ``~/shaped``, one for each. What cannot be followed is refused, with the
reason in the log and in ``/diagnostics``. ``joint_states`` tells where the joints are. Everything is done in the main
thread.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.time import Time
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from msg_adapters import DIAGNOSTICS, TOPIC_TYPES, to_messages
from psd_deflection.arms.compensation.trajectory import QUANTITIES, Trajectory, TrajectoryShaper, checked
from psd_deflection.arms.inputs import is_position, joints_fault, stamp_fault
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import WARNING, Say
from psd_deflection.base.printable import printable
from psd_deflection.recordings import cdr
from psd_deflection.records import DiagnosticEntry, DiagnosticReport
from psd_deflection.ros.declared import node_with_overrides, refuse_unknown
from psd_deflection.ros.gate import InputGate
from psd_deflection.ros.log import NodeLog
from psd_deflection.ros.names import JOINT_STATES
from psd_deflection.ros.running import SPIN_S, executor_of, ros
from psd_deflection.ros.wires import message_class, qos
from psd_deflection.run.diagnostics import OK, WARN
from psd_deflection.run.repeats import Repeats

NODE_NAME = 'shaper'
GIVEN, SHAPED = '~/trajectory', '~/shaped'
OLDEST_S = 1.0
"""A trajectory whose start is longer ago than this is refused."""
KNOWN_S = 0.5
"""For so long the position of a joint is known after it was told, s."""
NEWS = 6
"""Refusals that are told one by one, before they are counted and told together."""
LONGEST = 200
"""Characters of a refusal, in which a stranger's words may be."""


class ShaperNode:
    """The node. ``described``: the shaper, for people."""

    def __init__(self, shaper: TrajectoryShaper, described: str, say: Say) -> None:
        self._shaper = shaper
        self._described = described
        self.node = node = node_with_overrides(NODE_NAME)
        try:
            refuse_unknown(node, {})
        except ConfigError:
            node.destroy_node()
            raise
        self._log = NodeLog(node, say)
        self._gate = InputGate(node, self._log)
        self._repeats = Repeats(self._log)
        self._measured: dict[str, tuple[float, float]] = {}
        self._shaped = self._refused = 0
        self._why = ''
        states = message_class('sensor_msgs/msg/JointState')
        self._gate.listen(JointTrajectory, GIVEN, _trajectory_fault, self._given, 10)
        self._gate.listen(states, JOINT_STATES, lambda m: joints_fault(m.name, m.position, ()), self._joints)
        self._out = node.create_publisher(JointTrajectory, SHAPED, 10)
        self._health = node.create_publisher(message_class(TOPIC_TYPES[DIAGNOSTICS]), DIAGNOSTICS, qos(DIAGNOSTICS))
        node.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._log(f'publishing {self._out.topic_name}: {described}')

    def _joints(self, message: Any) -> None:
        now = time.monotonic()
        for name, position in zip(message.name, message.position, strict=False):
            if is_position(position):
                self._measured[name] = position, now

    def _given(self, message: Any) -> None:
        if not message.points:
            # joint_trajectory_controller stops at an empty one, and so does whoever listens to us.
            self._shaper.forget()
            self._out.publish(message)
            return
        now = time.monotonic()
        measured = {name: at for name, (at, then) in self._measured.items() if now - then <= KNOWN_S}
        try:
            trajectory = _trajectory(message)
            start_ns = self._start_ns(message)
            shaped = self._shaper.shape(start_ns, trajectory, measured)
        except ConfigError as error:
            self._refused += 1
            self._why = printable(str(error), LONGEST)
            self._repeats.tell('refused', f'trajectory refused: {self._why}', WARNING, now, NEWS)
            return
        self._shaped += 1
        self._why = ''
        # Whoever gets it begins when we did, however long the messages take: one that replaces another makes no step.
        message.header.stamp = Time(nanoseconds=start_ns).to_msg()
        self._out.publish(_message(shaped, message.header))

    def _start_ns(self, message: Any) -> int:
        """When it starts, by the node's clock; without a stamp now. Raises ConfigError if that was long ago."""
        now_ns = int(self.node.get_clock().now().nanoseconds)
        stamp_ns = int(Time.from_msg(message.header.stamp).nanoseconds)
        if stamp_ns == 0:
            return now_ns
        ago = (now_ns - stamp_ns) / 1e9
        if ago > OLDEST_S:
            raise ConfigError(f'its stamp is {ago:.3g} s old, must be at most {OLDEST_S:g} s (or 0, for at once)')
        return stamp_ns

    def _report(self) -> None:
        self._repeats.settle(time.monotonic())
        self._gate.settle()
        level, text = (WARN, f'the last trajectory was refused: {self._why}') if self._why else (OK, self._described)
        shaper = self._shaper.shaper
        values = (
            ('shaper', shaper.name),
            ('delay (s)', f'{shaper.duration:.4f}'),
            ('trajectories shaped', str(self._shaped)),
            ('trajectories refused', str(self._refused)),
            *self._gate.values(),
        )
        node = self.node.get_fully_qualified_name().removeprefix('/')
        entry = DiagnosticEntry(f'{node}: trajectories', level, text, values)
        for message in to_messages(DiagnosticReport(time.time_ns(), (entry,))):
            self._health.publish(cdr.encode(message.type, message.fields))

    def close(self) -> None:
        """Leave the graph."""
        self._log.close()
        self.node.destroy_node()


def _trajectory_fault(message: Any) -> str:
    stamp = message.header.stamp
    return stamp_fault(stamp.sec, stamp.nanosec)


def _trajectory(message: Any) -> Trajectory:
    times, points = [], []
    for i, point in enumerate(message.points):
        if len(point.effort):
            raise ConfigError(f'point {i} has efforts, which cannot be shaped')
        times.append(point.time_from_start.sec + point.time_from_start.nanosec / 1e9)
        points.append([getattr(point, name) for name in QUANTITIES])
    return checked(message.joint_names, times, points)


def _message(trajectory: Trajectory, header: Any) -> Any:
    out = JointTrajectory(header=header, joint_names=list(trajectory.names))
    for t, states in zip(trajectory.times.tolist(), trajectory.states.tolist(), strict=True):
        fields = dict(zip(QUANTITIES, states, strict=False))
        since = Duration(nanoseconds=round(1e9 * t)).to_msg()
        out.points.append(JointTrajectoryPoint(time_from_start=since, **fields))
    return out


def run_shaper(ros_args: Sequence[str], shaper: TrajectoryShaper, described: str, say: Say) -> int:
    """Run the node until SIGINT or SIGTERM."""
    with ros(NODE_NAME, ros_args) as signals:
        owner = ShaperNode(shaper, described, say)
        try:
            with executor_of(owner.node) as executor:
                while not signals.stop:
                    executor.spin_once(timeout_sec=SPIN_S)
        finally:
            owner.close()
    return 0
