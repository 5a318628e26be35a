# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node ``compensator``: the end effector's deflection in, offsets of the joints out.

It subscribes to ``end_effector/deflection`` and ``joint_states``, every 10 ms it publishes offsets
as std_msgs/Float64MultiArray, one for each joint in the order of the parameter ``joints``: on
``~/proposed`` if it runs dry, else on ``~/offsets``. With the parameter ``output`` at ``commands``
it publishes positions plus offsets on ``~/commands``, too. It is silent until ``~/enable`` lets the
offsets follow, and again when they are back at zero.

A thread of its own publishes the offsets and finds that deflections come no more, whatever the main
thread waits for: a message, a terminal that does not read, a disk. On a busy machine it may be
late. Then the offsets move later, by no more than their rate allows for a tenth of a second, and
not at all if the deflection has become stale meanwhile.

However the node ends or is deactivated, also by an error of its own, the offsets first go back to
zero. If that takes longer than ``RELEASE_S``, the node is not deactivated: the transition fails and
says which offset is left. Offsets that stay with a controller that tells nothing are said, too.
"""

import contextlib
import dataclasses
import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from rclpy.clock import Clock, ClockType
from scipy.spatial.transform import Rotation
from std_srvs.srv import SetBool

from msg_adapters import END_EFFECTOR
from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.compensation.arm import NO_TIP, Arm, arm_of, read_arm
from psd_deflection.arms.compensation.compensator import Command, Compensator, Observed, State
from psd_deflection.arms.compensation.settings import ALL_JOINTS, SETTINGS, CompensatorSettings
from psd_deflection.arms.compensation.settings import COMMANDS as WITH_COMMANDS
from psd_deflection.arms.inputs import LARGEST_POSITION, RobotWatch, joints_fault
from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.base.log import INFO, WARNING, LogCallback
from psd_deflection.records import FloatArray
from psd_deflection.ros.declared import DeclaredParameters, given_of
from psd_deflection.ros.endpoints import message_class
from psd_deflection.ros.gate import frame_fault, quaternion_fault, robot_description, stamp_fault
from psd_deflection.ros.node import BaseNode, Health, serve
from psd_deflection.ros.running import ros
from psd_deflection.ros.topics import (
    APPLIED,
    COMMANDS,
    CONTROLLER,
    END_REST,
    JOINT_STATES,
    OFFSETS,
    PROPOSED,
    PUBLISHED,
    REFERENCE_COMMAND,
    ROBOT_DESCRIPTION,
    RUNNING,
    SCALING,
)
from psd_deflection.run.diagnostics import ERROR, OK, WARN
from psd_deflection.run.rate_limited_log import RateLimitedLog
from psd_deflection.run.realtime import StopRequestedError

NODE_NAME = 'compensator'
ENABLE = '~/enable'
PERIOD_S = 0.01
REPORTED_S = 0.02
"""Changes of state that are shorter are not reported, s."""
NEWS = 6
"""Changes to one state that are reported one by one, before they are counted and told together."""
LOOK_S = 1.0
"""Time in which DDS finds another node that commands the robot, before anything is sent, s."""
RELEASE_S = 10.0
"""Longest time that an end waits for the offsets to go back to zero, s."""
OWED_S = 2.0
"""Longest time that an end waits for a controller that does not tell the offsets that it has, s."""
LEAVE_S = 0.3
"""Time for the last offsets to leave, s. DDS does not say when. If the publisher goes first, they
are lost."""
MOST_SCALING = 1000.0

_LEVELS = {State.OFF: OK, State.FOLLOWING: OK, State.RELEASING: WARN, State.HOLDING: ERROR}


class CompensatorNode(BaseNode[CompensatorSettings]):
    """The node. Raises ConfigError for a bad parameter or arm.

    ``describe``: returns the text on ``robot_description``, which it waits for. ``hurried``: whether its end is not to
    wait for the offsets to go back to zero.
    """

    def __init__(
        self,
        settings: CompensatorSettings,
        log: LogCallback,
        describe: Callable[[], str],
        hurried: Callable[[], bool] = lambda: False,
    ) -> None:
        self._given, self._describe, self._hurried = settings, describe, hurried
        self._places: tuple[list[str], list[int]] = ([], [])
        self._lock = threading.Lock()
        """Of the compensator and of what was sent."""
        self._robot = RobotWatch()
        self._sender: threading.Thread | None = None
        self._ended, self._ramped = threading.Event(), threading.Event()
        self._failed: BaseException | None = None
        self._alone: BaseException | None = None
        self._rest_t: float | None = None
        self._release_until = math.inf
        # Since when only offsets that the controller does not tell are left.
        self._owed_t: float | None = None
        super().__init__(NODE_NAME, log)

    def declare(self) -> DeclaredParameters[CompensatorSettings]:
        """Those of a compensator; ``joints`` names those of its arm."""
        given = given_of(self.node, SETTINGS, SETTINGS.values(self._given))
        self._drive = given.drive
        self._arm = arm = self._read(given)
        self._names = list(arm.names)
        if self._given.joints == (ALL_JOINTS,):
            self._given = dataclasses.replace(self._given, joints=arm.names)
        return self.declare_section(SETTINGS, self._given, self._changed)

    def _read(self, given: CompensatorSettings) -> Arm:
        if given.urdf:
            return read_arm(given.urdf, given.tip, given.base)
        if not given.tip:
            # Before it waits for the robot.
            raise ConfigError(NO_TIP)
        return arm_of(self._describe(), ROBOT_DESCRIPTION, given.tip, given.base)

    def set_up(self) -> None:
        """Listen to deflections, joints and the robot; make the outputs."""
        self._order = _order(self._arm, self.settings.joints)
        self._sums = self.settings.output == WITH_COMMANDS
        self.compensator = Compensator(self._arm, self.settings, dry=not self._drive)
        self.command = self._reported = self.compensator.command()
        self._limited_log = RateLimitedLog(self.log)
        self._listen()
        self._array = message_class(PUBLISHED[OFFSETS].type)
        outputs = [PROPOSED] if not self._drive else [OFFSETS, COMMANDS] if self._sums else [OFFSETS]
        self._publishers = {topic: self.publisher(topic) for topic in outputs}
        if self._drive:
            self.node.create_service(SetBool, ENABLE, self._enable)
        self.node.create_timer(REPORTED_S, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._begun = time.monotonic()
        out = self._publishers[outputs[-1]].topic_name
        when = ', once it is enabled' if self._drive else ''
        self.log(f'publishing {out} for {", ".join(self._names[i] for i in self._order)}{when}')

    def _listen(self) -> None:
        listen = self.gate.listen
        listen(END_EFFECTOR, self._deflection_fault, self._observed)
        listen(JOINT_STATES, self._joints_fault, self._joints)
        if not self._drive:
            return
        listen(RUNNING, _nothing_wrong, self._runs)
        listen(SCALING, _scaling_fault, self._scaled)
        if state := self.settings.controller_state:
            _check_installed(state)
            listen(CONTROLLER, self._controlled_fault, self._controlled, type_name=state)
        if self._sums:
            listen(REFERENCE_COMMAND, self._reference_fault, self._reference)
        else:
            listen(APPLIED, self._applied_fault, self._applied)

    def _changed(self, settings: CompensatorSettings) -> None:
        with self._lock:
            self.compensator.settings = settings

    def activate(self) -> None:
        """Send offsets: at once if it runs dry, else when it is enabled."""
        super().activate()
        self.compensator.enable(not self._drive)
        self._release_until = math.inf
        self._ended.clear()
        self._sender = threading.Thread(target=self._send_until_the_end, name='offsets', daemon=True)
        self._sender.start()

    def deactivate(self) -> None:
        """Let the offsets go back to zero, and send no more.

        Raises DeviceError, and stays active, if they are not there after ``RELEASE_S``.
        """
        self._come_to_rest()
        if self.command.sends and (offset := self._remaining_offset()):
            self._release_until = math.inf
            raise DeviceError(
                f'{offset} is left after {RELEASE_S:g} s ({self.command.text}, max_rate = {self.settings.max_rate:g}): '
                'it goes on; deactivate again'
            )
        super().deactivate()
        self._fall_silent()

    def cleanup(self) -> None:
        """The same; it ends in any case, and says what is left."""
        self._come_to_rest()
        super().deactivate()
        self._fall_silent()

    def _come_to_rest(self) -> None:
        try:
            while not (self.at_rest() or self._hurried()) and time.monotonic() < self._release_until:
                time.sleep(PERIOD_S)
                # The executor waits for this transition. Offsets go back only while the controller
                # and the joints are heard.
                self.gate.take_in()
                self._report()
        except BaseException as error:
            # Whatever failed, the sender's thread takes the offsets back alone.
            self._alone = error
            if self._sender is not None:
                self._ramped.wait(RELEASE_S)

    def _fall_silent(self) -> None:
        if self._sender is None:
            return
        self._ended.set()
        self._sender.join()
        self._sender = None
        if offset := self._remaining_offset():
            self.log(f'{offset} is left with the controller: {self.command.text}', WARNING)

    def _remaining_offset(self) -> str:
        """The largest offset that the controller may still have, in words; '' if it has none."""
        if not self._drive:
            return ''
        with self._lock:
            offsets = self.command.offsets if self._failed is not None else self.compensator.remaining_offsets
        worst = int(np.abs(offsets).argmax())
        return f'an offset of {offsets[worst]:.3g} at {self._names[worst]}' if offsets[worst] else ''

    def at_rest(self) -> bool:
        """Let the offsets go back to zero; whether they are there, and the last ones have left."""
        if self._sender is None or not self._drive:
            return True
        now = time.monotonic()
        if self._release_until == math.inf:
            self._release_until = now + RELEASE_S
        with self._lock:
            if self.compensator.enabled:
                self.compensator.enable(False)
            sends, owes = self.compensator.enabled or self.command.sends, self.compensator.owed
        if self._failed is not None:
            sends, owes = not self._ramped.is_set(), False
        self._owed_t = (self._owed_t or now) if owes and not sends else None
        if sends or (self._owed_t is not None and now - self._owed_t < OWED_S):
            self._rest_t = now
        return self._rest_t is None or now - self._rest_t > LEAVE_S

    def runs(self) -> bool:
        """True. Raises what ended the thread that sends the offsets, once it has taken them back."""
        if self._failed is not None and self._ramped.is_set():
            raise self._failed
        return True

    def _deflection_fault(self, message: Any) -> str:
        stamp, rotated = message.header.stamp, message.pose.pose.orientation
        wanted = self.settings.frame_prefix + END_REST
        return (
            stamp_fault(stamp.sec, stamp.nanosec)
            or frame_fault(message.header.frame_id, wanted)
            or quaternion_fault([rotated.x, rotated.y, rotated.z, rotated.w])
        )

    def _observed(self, message: Any) -> None:
        at, rotated = message.pose.pose.position, message.pose.pose.orientation
        rotation = Rotation.from_quat([rotated.x, rotated.y, rotated.z, rotated.w]).as_matrix()
        t_ns = _ns(message.header.stamp)
        deflection = Transform(rotation, np.array([at.x, at.y, at.z]))
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        observed = Observed(t_ns / 1e9, deflection, covariance, self._age(t_ns))
        with self._lock:
            self.compensator.observe(time.monotonic(), observed)

    def _age(self, t_ns: int) -> float:
        """s, by the node's clock: that of the simulation with ``use_sim_time``."""
        return (self.now_ns() - t_ns) / 1e9

    def _joints_age(self, message: Any) -> float:
        # A driver without a clock leaves the stamp at 0.
        t_ns = _ns(message.header.stamp)
        return self._age(t_ns) if t_ns else 0.0

    def _joints_fault(self, message: Any) -> str:
        stamp = message.header.stamp
        fault = stamp_fault(stamp.sec, stamp.nanosec) or joints_fault(message.name, message.position, self._names)
        if fault or not set(self._names) <= set(message.name):
            return fault
        age = self._joints_age(message)
        return f'its stamp is {age:.3g} s old' if abs(age) > self.settings.stale else ''

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
            self.compensator.joints(time.monotonic(), positions[self._places[1]], self._joints_age(message))

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
            self.compensator.controller_has(time.monotonic(), offsets)

    def _reference_fault(self, message: Any) -> str:
        return joints_fault(message.name, message.position, self._names)

    def _reference(self, message: Any) -> None:
        self._commanded(list(message.name), message.position)

    def _commanded(self, names: list[str], positions: Sequence[float]) -> None:
        """Take the command that the controller has, if it is one of all our joints."""
        if not set(self._names) <= set(names) or len(names) != len(positions):
            return
        command = np.array([positions[names.index(name)] for name in self._names], dtype=np.float64)
        with self._lock:
            self.compensator.controller_has(time.monotonic(), command)

    def _runs(self, message: Any) -> None:
        self._robot.runs(bool(message.data))
        self._check_robot()

    def _scaled(self, message: Any) -> None:
        self._robot.scaled(time.monotonic(), float(message.data))
        self._check_robot()

    def _controlled(self, message: Any) -> None:
        self._robot.controlled(time.monotonic())
        if self._sums and hasattr(message, 'joint_names') and hasattr(message, 'reference'):
            self._commanded(list(message.joint_names), message.reference.positions)

    def _controlled_fault(self, message: Any) -> str:
        if not self._sums or not (hasattr(message, 'joint_names') and hasattr(message, 'reference')):
            return ''
        return joints_fault(message.joint_names, message.reference.positions, self._names)

    def _check_robot(self) -> None:
        """Hold while the robot does not run, or while another node publishes what we publish."""
        now = time.monotonic()
        self.gate.subscribe_to_kept()
        contested = self.contested_topics() if self._drive else []
        other = f'another node publishes {contested[0]}' if contested else ''
        if self._drive and now - self._begun < LOOK_S:
            other = other or 'it looks whether another node commands the robot'
        with self._lock:
            self.compensator.stop(other or self._robot.fault(now), other_publisher=bool(other))

    def _send_until_the_end(self) -> None:
        """Send the offsets every ``PERIOD_S``; a time that was missed is left out."""
        next_time = time.monotonic()
        try:
            while not self._ended.wait(max(next_time - time.monotonic(), 0.0)):
                if self._alone is not None:
                    raise self._alone
                self._send()
                next_time = max(next_time + PERIOD_S, time.monotonic())
        except BaseException as error:
            self._failed = error
            try:
                self._ramp_down()
            finally:
                self._ramped.set()

    def _send(self) -> None:
        with self._lock:
            self.command = command = self.compensator.watch(time.monotonic())
        if command.sends:
            self._publish(command)
            # The next step counts from here on, however long that took.
            with self._lock:
                self.compensator.sent(time.monotonic(), command)

    def _publish(self, command: Command) -> None:
        for name, publisher in self._publishers.items():
            values = command.positions if name == COMMANDS else command.offsets
            if values is not None:
                publisher.publish(self._array(data=values[self._order].tolist()))

    def _ramp_down(self) -> None:
        """Take the last offsets back at their rate, whatever has failed."""
        command = self.command
        offsets: FloatArray = command.offsets.copy()
        pose = None if command.positions is None else command.positions - offsets
        step = self.settings.max_rate * PERIOD_S
        while command.sends and np.any(offsets) and not self._ended.wait(PERIOD_S):
            # Without memory for a step, it is tried again.
            with contextlib.suppress(MemoryError):
                less = offsets - np.clip(offsets, -step, step)
                self._publish(command._replace(offsets=less, positions=None if pose is None else pose + less))
                offsets = less
        # The process may end as soon as this does.
        self._ended.wait(LEAVE_S)
        self.command = command._replace(offsets=offsets, sends=False)

    def _report(self) -> None:
        self._limited_log.settle(time.monotonic())
        self._check_robot()
        command = self.command
        before, self._reported = self._reported, command
        reported = command.foreign != before.foreign
        if command.state in (State.HOLDING, State.FOLLOWING):
            reported = before.why != command.why
        if before.state is not command.state or reported:
            warns = command.foreign or (command.why and command.state is not State.OFF)
            level = WARNING if warns and command.state is not State.RELEASING else INFO
            self._limited_log.log(str(command.state), command.text, level, time.monotonic(), NEWS)

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if not self.active:
            response.success, response.message = False, 'the node is not active'
            return response
        with self._lock:
            self.compensator.enable(request.data)
            command = self.compensator.command()
        response.success, response.message = True, command.text
        return response

    def health(self) -> Iterable[Health]:
        """State and offsets."""
        command = self.command
        level, text = _LEVELS[command.state], command.text
        if command.foreign or (command.state is State.FOLLOWING and command.why):
            level = WARN
        if self._failed is not None:
            level, text = ERROR, f'{type(self._failed).__name__}: {self._failed}: the offsets go back to zero'
        elif command.limited:
            level, text = WARN, f'{text}: a limit keeps the offsets from what the deflection asks for'
        values = [(f'offset {name}', f'{v:.6f}') for name, v in zip(self._names, command.offsets, strict=True)]
        values.append((f'residual{"" if self._drive else " if it were applied"} (m)', f'{command.residual:.6f}'))
        if self._drive:
            with self._lock:
                response = self.compensator.response
                measured = zip(self._names, response.slopes.tolist(), response.half_widths.tolist(), strict=True)
                reported = self.compensator.controller_text(time.monotonic())
            slopes = [(f'moves by, of its offset: {n}', f'{s:.2f} ± {w:.2f} (measured)') for n, s, w in measured]
            values += [(name, text if 'nan' not in text else 'not yet measured') for name, text in slopes]
            values.append(('the controller has, as it tells', reported))
        return (Health('offsets', level, text, tuple(values)),)


def _ns(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _nothing_wrong(message: Any) -> str:
    return ''


def _scaling_fault(message: Any) -> str:
    # NaN is no number within the bounds.
    return '' if 0.0 <= message.data <= MOST_SCALING else f'{message.data:g}: must be at least 0 and at most 1000'


def _check_installed(kind: str) -> None:
    """Raises ConfigError if the message ``kind`` is not installed."""
    try:
        message_class(kind)
    except (ImportError, AttributeError, ValueError, LookupError):
        raise ConfigError(f'controller_state = {kind!r}: no message of that name is installed') from None


def _order(arm: Arm, joints: Sequence[str]) -> list[int]:
    """Where each of ``joints`` is in the arm. Raises ConfigError if they are not those of the arm."""
    if tuple(joints) == (ALL_JOINTS,):
        return list(range(len(arm.names)))
    if sorted(joints) != sorted(arm.names):
        raise ConfigError(f'joints = {list(joints)}: must be those of the arm, in any order: {", ".join(arm.names)}')
    return [arm.names.index(name) for name in joints]


def run_compensator(ros_args: Sequence[str], settings: CompensatorSettings, log: LogCallback) -> int:
    """Run the node until SIGINT or SIGTERM; then let the offsets go back to zero, unless a second signal comes."""
    with ros(NODE_NAME, ros_args) as signals, contextlib.suppress(StopRequestedError):
        owner = CompensatorNode(settings, log, lambda: robot_description(signals, log), lambda: bool(signals.stop))
        try:
            serve(owner, signals, owner.runs)
        finally:
            owner.close()
    return 0
