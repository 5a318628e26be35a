# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What joint_trajectory_controller does with the trajectories that it gets, on a clock of the caller's."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from psd_deflection.arms.compensation.trajectory import QUANTITIES, Trajectory
from psd_deflection.records import FloatArray

FEEDBACK_S, ACTION = 0.05, '/joint_trajectory_controller/follow_joint_trajectory'


def arriving(message: Any, names: Sequence[str]) -> tuple[float, Trajectory]:
    """The stamp, s, and the trajectory of a message, with its joints in the order of ``names``."""
    times = [p.time_from_start.sec + p.time_from_start.nanosec / 1e9 for p in message.points]
    orders = [order for order in QUANTITIES if len(getattr(message.points[0], order))]
    states = np.array([[getattr(p, order) for order in orders] for p in message.points])
    stamp = message.header.stamp.sec + message.header.stamp.nanosec / 1e9
    given = list(message.joint_names)
    return stamp, Trajectory(tuple(names), np.array(times), states[:, :, [given.index(name) for name in names]])


class TrajectoryController:
    """``position`` (j,): where the joints are at the start."""

    def __init__(self, position: FloatArray) -> None:
        self._path = Trajectory(tuple(map(str, range(len(position)))), np.zeros(1), position[None, None])
        self._begins = 0.0

    def arrive(self, now: float, stamp: float, path: Trajectory) -> None:
        """A trajectory arrives at the time ``now``, s, with a ``stamp``, s. Raises ValueError if it is rejected."""
        if not (np.diff(path.times, prepend=-1e-9) > 0.0).all() or not np.isfinite(path.states).all():
            raise ValueError(f'{path.times}: do not rise, or {path.states} are not finite')
        orders = path.states.shape[1]
        begins = stamp or now
        first = begins + path.times[0]
        if now < first:
            here, same = np.zeros_like(path.states[:1]), min(orders, self._path.states.shape[1])
            here[0, :same] = self.state(now)[:same]
            path = Trajectory(path.names, np.append(now - begins, path.times), np.concatenate([here, path.states]))
        self._path, self._begins = path, begins

    @property
    def ends(self) -> float:
        return self._begins + self._path.duration

    def hold(self, now: float) -> None:
        self._path, self._begins = Trajectory(self._path.names, np.zeros(1), self.state(now)[None, :1]), now

    def state(self, now: float) -> FloatArray:
        """Position, and velocity and acceleration if the trajectory has them, (k, j)."""
        out: FloatArray = self._path.at(np.array([now - self._begins]))[0]
        return out


class ServedController:
    """``controller`` as the action ``name`` of a node that somebody spins, on the system's clock. ``rejects``: it takes
    no goal. ``mute``: it says nothing more of a goal that it has taken. ``goals``: those that it has been asked.
    ``late``: how many came after they should have begun."""

    def __init__(self, node: Any, names: Sequence[str], controller: TrajectoryController, name: str = ACTION) -> None:
        # The stand-in itself needs no ROS.
        from psd_deflection.ros.endpoints import GuardedServer, action_class
        from psd_deflection.ros.topics import FOLLOW, SERVED

        self.controller, self._names = controller, tuple(names)
        self.rejects = self.mute = False
        self.goals: list[Any] = []
        self.late = 0
        self._handle: Any = None
        self._reported = 0.0
        self.rejected: list[str] = []
        self._kind = kind = action_class(SERVED[FOLLOW].type)
        calls = self.rejected.append, self._asked, self._accepted, self._cancelled
        self._server = GuardedServer(node, kind, name, *calls)

    def _asked(self, goal: Any) -> Any:
        from rclpy.action import GoalResponse

        self.goals.append(goal)
        good = not self.rejects and sorted(goal.trajectory.joint_names) == sorted(self._names)
        return GoalResponse.ACCEPT if good and goal.trajectory.points else GoalResponse.REJECT

    def _accepted(self, handle: Any) -> None:
        if self._handle is not None:
            self._end('abort', self._kind.Result.INVALID_GOAL, 'Current goal preempted by new incoming action.')
        stamp, path = arriving(handle.request.trajectory, self._names)
        now = time.time()
        self.late += bool(stamp) and now > stamp
        self.controller.arrive(now, stamp, path)
        self._handle = handle

    def _cancelled(self, handle: Any) -> None:
        if self._handle is not None and handle == self._handle:
            self.controller.hold(time.time())
            self._end('canceled')

    def _end(self, how: str, code: int = 0, text: str = '') -> None:
        handle, self._handle = self._handle, None
        if self.mute:
            return

        def finish(handle: Any) -> Any:
            getattr(handle, how)()
            return self._kind.Result(error_code=code, error_string=text)

        self._server.finish(handle, finish)

    def step(self, now: float) -> None:
        if self._handle is None or self.mute:
            return
        if now - self._reported >= FEEDBACK_S:
            self._reported = now
            feedback = self._kind.Feedback(joint_names=list(self._names))
            feedback.actual.positions = self.controller.state(now)[0].tolist()
            self._handle.publish_feedback(feedback)
        if now >= self.controller.ends:
            self._end('succeed', text='Goal successfully reached!')

    def close(self) -> None:
        """It dies: its goals have no end."""
        self._handle = None
        self._server.destroy()
