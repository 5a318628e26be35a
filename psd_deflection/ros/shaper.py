# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node ``shaper``: joint trajectories (``~/trajectory``, or goals of ``action``) in, the same shaped out, so that
they do not ring the link. What cannot be followed is rejected with the reason."""

import time
from collections.abc import Iterable, Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.time import Time
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from psd_deflection.arms.compensation.arm import limits_of
from psd_deflection.arms.compensation.settings import DESCRIPTION, SHAPING, ShaperSettings, trajectory_shaper
from psd_deflection.arms.compensation.trajectory import QUANTITIES, Trajectory, checked, start_of
from psd_deflection.arms.inputs import KnownJoints, joints_fault
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import WARNING, LogCallback
from psd_deflection.base.text import sanitize
from psd_deflection.ros.declared import DeclaredParameters
from psd_deflection.ros.follow import Follower
from psd_deflection.ros.gate import listen_to_description, stamp_fault
from psd_deflection.ros.node import BaseNode, Health, serve
from psd_deflection.ros.running import ros
from psd_deflection.ros.topics import JOINT_STATES, SHAPED, TRAJECTORY
from psd_deflection.run.diagnostics import OK, STALE, WARN
from psd_deflection.run.rate_limited_log import RateLimitedLog

NODE_NAME = 'shaper'
NEWS = 6
"""Rejections that are reported one by one, before they are counted and told together."""
LONGEST = 200
"""Characters of a rejection, in which a stranger's words may be."""


class ShaperNode(BaseNode[ShaperSettings]):
    """The node. Raises ConfigError for a bad parameter or file."""

    def __init__(self, settings: ShaperSettings, log: LogCallback) -> None:
        self._asked = settings
        self._known = KnownJoints()
        self._shaped = self._rejected = 0
        self._why = ''
        self._follow: Follower | None = None
        super().__init__(NODE_NAME, log)

    def declare(self) -> DeclaredParameters[ShaperSettings]:
        """Those of a shaper."""
        return self.declare_section(SHAPING, self._asked, self._changed)

    def set_up(self) -> None:
        """Listen to trajectories and joints."""
        self._shaper, self._described = trajectory_shaper(self.settings)
        self._limited_log = RateLimitedLog(self.log)
        self._out = self.publisher(SHAPED)
        self.gate.listen(TRAJECTORY, _trajectory_fault, self._given)
        self.gate.listen(JOINT_STATES, lambda m: joints_fault(m.name, m.position, ()), self._joints)
        if self.settings.action:
            self._follow = Follower(self, self.settings.action, self._shape, self._shaper, self._joints_fault)
        self._undescribed = self.settings.urdf == DESCRIPTION
        if self._undescribed:
            listen_to_description(self.gate, self._described_as)
        self.log(f'publishing {self._out.topic_name}: {self._described}')

    def _described_as(self, urdf: str) -> None:
        self._shaper.limits = limits = limits_of(urdf, DESCRIPTION)
        self._undescribed = False
        self.log(f'limits of {", ".join(limits)} from {DESCRIPTION}')

    def _changed(self, settings: ShaperSettings) -> None:
        self._shaper.max_step = settings.max_step

    def _joints(self, message: Any) -> None:
        self._known.notify(time.monotonic(), message.name, message.position)

    def _joints_fault(self) -> str:
        return self._shaper.joints_fault(self.now_ns(), self._known.measured(time.monotonic()))

    def _given(self, message: Any) -> None:
        if not self.active:
            return
        if not message.points:
            # Some controllers stop at an empty one. Whoever listens to us gets it.
            self._shaper.forget()
            self._stop('stopped by an empty trajectory')
            self._out.publish(message)
            return
        try:
            shaped = self._shape(message)
        except ConfigError as error:
            self._rejected += 1
            self._why = sanitize(str(error), LONGEST)
            kind = 'undescribed' if self._undescribed else 'rejected'
            self._limited_log.log(kind, f'trajectory rejected: {self._why}', WARNING, time.monotonic(), NEWS)
            return
        self._why = ''
        self._out.publish(shaped)

    def _shape(self, message: Any) -> Any:
        """The message of a trajectory, shaped. Raises ConfigError for one that cannot be followed."""
        if contested := self.contested_topics():
            # Both would answer, and the arm would get each motion twice.
            raise ConfigError(f'another node publishes {contested[0]}')
        if self._undescribed:
            raise ConfigError(f'nobody has told the limits of the joints on {DESCRIPTION} yet')
        trajectory = _trajectory(message)
        stamp_ns = int(Time.from_msg(message.header.stamp).nanoseconds)
        start_ns = start_of(self.now_ns(), stamp_ns, self.settings.lead)
        if self._shaper.moves(start_ns) and (why := self._joints_fault()):
            raise ConfigError(why)
        shaped = self._shaper.shape(start_ns, trajectory, self._known.measured(time.monotonic()))
        self._shaped += 1
        # Whoever gets it begins when we did, however long the message takes: one that replaces
        # another makes no step.
        message.header.stamp = Time(nanoseconds=start_ns).to_msg()
        return _message(shaped, message.header)

    def deactivate(self) -> None:
        """Shape nothing more; what goals have begun is stopped."""
        super().deactivate()
        self._stop('the shaper was deactivated')

    def cleanup(self) -> None:
        """The same."""
        super().cleanup()
        self._stop('the shaper has ended')

    def at_rest(self) -> bool:
        """Whether no goal is under way: after a signal they are stopped."""
        self._stop('the shaper ends')
        return self._follow is None or self._follow.at_rest()

    def leave(self) -> None:
        """Leave the graph."""
        if self._follow is not None:
            self._follow.close()
        super().leave()

    def exclusive_topics(self) -> Iterable[str]:
        """What it publishes, and the feedback of its action."""
        yield from super().exclusive_topics()
        if self._follow is not None:
            yield self._follow.topic()

    def _stop(self, why: str) -> None:
        if self._follow is not None:
            self._follow.stop(why)

    def _state(self) -> tuple[int, str]:
        if not self.active:
            return STALE, 'not active'
        if contested := self.contested_topics():
            return WARN, f'it shapes nothing: another node publishes {contested[0]}'
        if self._why:
            return WARN, f'the last trajectory was rejected: {self._why}'
        if self._undescribed:
            return WARN, f'nobody has told the limits of the joints on {DESCRIPTION} yet'
        if not self._known.measured(time.monotonic()):
            return WARN, f'nobody tells where the joints are on {JOINT_STATES}'
        return OK, self._described

    def health(self) -> Iterable[Health]:
        """What was shaped and rejected."""
        self._limited_log.settle(time.monotonic())
        level, text = self._state()
        shaper = self._shaper.shaper
        values = (
            ('joints known', str(len(self._known.measured(time.monotonic())))),
            ('shaper', shaper.name),
            ('delay (s)', f'{shaper.duration:.4f}'),
            ('trajectories shaped', str(self._shaped)),
            ('trajectories rejected', str(self._rejected)),
        )
        yield Health('trajectories', level, text, values)
        if self._follow is not None:
            ready, action = self._follow.ready(), self._follow.action
            level, text = (OK, f'goals go to {action}') if ready else (WARN, f'{action} is served by nobody')
            counts = ('goals under way', self._follow.under_way), ('goals taken by the controller', self._follow.taken)
            yield Health('action', level, text, tuple((name, str(count)) for name, count in counts))


def _trajectory_fault(message: Any) -> str:
    stamp = message.header.stamp
    return stamp_fault(stamp.sec, stamp.nanosec)


def _trajectory(message: Any) -> Trajectory:
    times, points = [], []
    for i, point in enumerate(message.points):
        # Many leave zeros there for no effort.
        if any(point.effort):
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


def run_shaper(ros_args: Sequence[str], settings: ShaperSettings, log: LogCallback) -> int:
    """Run the node until SIGINT or SIGTERM."""
    with ros(NODE_NAME, ros_args) as signals:
        owner = ShaperNode(settings, log)
        try:
            serve(owner, signals)
        finally:
            owner.close()
    return 0
