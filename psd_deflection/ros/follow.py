# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Goals of FollowJointTrajectory, passed on with shaped trajectories, one after the other; what the controller says is
what the sender hears. Nothing waits: no answer ends a goal after a bounded time, with the reason."""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.clock import Clock, ClockType
from trajectory_msgs.msg import JointTrajectory

from psd_deflection.arms.compensation.trajectory import JointsError, MovingError, OldStampError, TrajectoryShaper
from psd_deflection.arms.inputs import LONGEST_LIST
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import WARNING
from psd_deflection.ros.declared import SOURCE
from psd_deflection.ros.endpoints import OF_RCLPY
from psd_deflection.ros.gate import stamp_fault
from psd_deflection.ros.node import BaseNode
from psd_deflection.ros.topics import FOLLOW

ANSWER_S = 2.0
"""Longest time for an answer of the controller, s: to a goal, to a cancel request, and for the result of
a goal that another one replaced. It answers within one of its cycles."""
SILENT_S = 5.0
"""A controller that has sent feedback, and then none for so long, is gone, s. It sends 20 a second by
default. DDS itself notices after 20 s that a process was killed."""
FRESH_S = 0.5
"""With feedback older than this, s, nobody knows whether the controller still moves: a new goal begins
where the joints are."""
LEAVE_S = 0.3
"""Time for the last result to leave, s."""
LOOK_S = 0.1
"""Time between two looks at what is due, s."""
MOST_WAITING = 20
"""Goals that may wait for the controller's answer to the one before them."""
INVALID = 'INVALID_GOAL'
CODES = (JointsError, 'INVALID_JOINTS'), (OldStampError, 'OLD_HEADER_TIMESTAMP')
"""Of an error that is more than that."""
COMPONENTS = ('position', 'velocity', 'acceleration')
Shape = Callable[[Any], Any]


class _Goal:
    """One goal of a sender, by its ``handle``.

    ``sent``: the controller's handle of it, once it has taken it. ``future``: the answer that is
    awaited. When, by a monotonic clock, s: ``came`` it was accepted, ``asked`` it was sent,
    ``reported`` feedback came last, ``stopped`` it was cancelled, ``replaced`` by another.
    """

    def __init__(self, handle: Any) -> None:
        self.handle = handle
        self.sent: Any = None
        self.future: Any = None
        self.ended = False
        self.came = time.monotonic()
        self.asked: float | None = None
        self.reported: float | None = None
        self.stopped: float | None = None
        self.replaced: float | None = None


class Follower:
    """Serves the action, and is a client of ``action``, the controller's.

    ``shape``: makes a trajectory what the controller gets, or raises ConfigError; it works on
    ``shaper``. ``joints_fault``: why the joints are not where they should be, or ''. Raises ConfigError if ``action``
    is no name, or control_msgs is not installed.

    ``taken``: goals that the controller has taken. ``under_way``: how many have not ended.
    """

    def __init__(
        self, owner: BaseNode[Any], action: str, shape: Shape, shaper: TrajectoryShaper, joints_fault: Callable[[], str]
    ) -> None:
        self._owner, self._shape, self._shaper, self._joints_fault = owner, shape, shaper, joints_fault
        self.taken = 0
        # Bound: MOST_WAITING, and MOST_GOALS a second that end within ANSWER_S of being replaced.
        self._goals: list[_Goal] = []
        self._waiting: deque[_Goal] = deque(maxlen=MOST_WAITING)
        self._asked: _Goal | None = None
        self._newest: _Goal | None = None
        self._unanswered: _Goal | None = None
        self._held = False
        self._last_end = -math.inf
        node = owner.node
        self._server = owner.gate.serve(FOLLOW, self._fault, self._accepted, self._cancelled)
        try:
            self.action = str(node.resolve_service_name(action))
            if self.action == node.resolve_service_name(FOLLOW):
                raise ConfigError(f'{SOURCE}: action = {action!r}: must be the action of a controller, not our own')
            self._client = owner.gate.ask(FOLLOW, action)
        except (ValueError, RuntimeError) as error:
            raise ConfigError(f'{SOURCE}: action = {action!r}: {" ".join(str(error).split())}') from None
        self._result = self._server.action_type.Result
        node.create_timer(LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @property
    def under_way(self) -> int:
        """Goals that have not ended."""
        return len(self._goals)

    def ready(self) -> bool:
        """Whether the controller's action is served."""
        return bool(self._client.server_is_ready())

    def topic(self) -> str:
        """Where the feedback of our own action is published."""
        return f'{self._owner.node.resolve_service_name(FOLLOW)}/_action/feedback'

    def stop(self, why: str) -> None:
        """Cancel every goal at the controller, and end it for the reason ``why``; the next begins at rest."""
        self._asked = None
        self._shaper.forget()
        for goal in tuple(self._goals):
            self._give_up(goal, why)

    def at_rest(self) -> bool:
        """Whether every goal has ended and its result has left."""
        return not self._goals and time.monotonic() - self._last_end > LEAVE_S

    def close(self) -> None:
        """Leave the graph."""
        self._goals.clear()
        self._server.destroy()
        self._client.destroy()

    # What comes from senders.

    def _fault(self, goal: Any) -> str:
        """Why a goal is not even taken."""
        if not self._owner.active:
            return 'the node is not active'
        if len(self._waiting) == MOST_WAITING:
            return f'{MOST_WAITING} goals wait for the controller'
        stamp, leeway = goal.trajectory.header.stamp, goal.goal_time_tolerance
        tolerances = (*goal.path_tolerance, *goal.goal_tolerance)
        components = (*goal.component_path_tolerance, *goal.component_goal_tolerance)
        if len(tolerances) + len(components) > LONGEST_LIST:
            return f'{len(tolerances) + len(components)} tolerances: must be at most {LONGEST_LIST}'
        for tolerance in (*tolerances, *components):
            if not all(math.isfinite(getattr(tolerance, name)) for name in COMPONENTS):
                return 'a tolerance is not finite'
        # A negative leeway is one that is erased.
        return stamp_fault(stamp.sec, stamp.nanosec) or stamp_fault(abs(leeway.sec), leeway.nanosec)

    def _accepted(self, handle: Any) -> None:
        goal = _Goal(handle)
        self._goals.append(goal)
        self._waiting.append(goal)
        self._pump()

    def _cancelled(self, handle: Any) -> None:
        """The controller holds the joints where they are, and the next goal begins there."""
        goal = next((g for g in self._goals if g.handle == handle), None)
        if goal is not None:
            goal.stopped = time.monotonic()
            self._cancel(goal)

    # What is asked of the controller.

    def _pump(self) -> None:
        """Send the next goal, unless an answer is awaited."""
        while self._waiting and self._asked is None:
            goal = self._waiting.popleft()
            if goal.stopped is not None:
                self._end(goal, GoalStatus.STATUS_CANCELED, self._reply('cancelled before it was sent', 'SUCCESSFUL'))
            elif not goal.ended and not self._send(goal):
                self._waiting.appendleft(goal)
                return

    def _send(self, goal: _Goal) -> bool:
        """Whether it was sent, or has ended; else it waits for joints that still move."""
        reported = self._newest.reported if self._newest is not None else None
        if reported is not None and time.monotonic() - reported > FRESH_S:
            self._shaper.forget()
        request, before = goal.handle.request, self._shaper.history
        try:
            if not self.ready():
                raise ConfigError(f'{self.action} is served by nobody: is the controller active?')
            if request.multi_dof_trajectory.joint_names or request.multi_dof_trajectory.points:
                raise JointsError('multi_dof_trajectory: cannot be shaped, must be empty')
            request.trajectory = self._shape(request.trajectory)
            future = self._client.send_goal_async(request, lambda message: self._fed(goal, message))
        except OF_RCLPY as error:
            if isinstance(error, MovingError) and time.monotonic() - goal.came < ANSWER_S:
                return False
            self._abort(goal, str(error), next((code for kind, code in CODES if isinstance(error, kind)), INVALID))
            return True
        self._asked, goal.asked, goal.future = goal, time.monotonic(), future
        after = self._shaper.history
        self._when(future, lambda sent: self._answered(goal, sent, before, after))
        # rclpy keeps the handle of a goal for a while: not what may be large of it.
        request.trajectory = JointTrajectory()
        return True

    def _when(self, future: Any, do: Callable[[Any], None]) -> None:
        """``do`` with what comes; what fails is rejected, and the goal ends when it is due."""

        def done(future: Any) -> None:
            try:
                if not future.cancelled():
                    do(future.result())
            except OF_RCLPY as error:
                self._owner.gate.reject(self.action, f'{type(error).__name__}: {error}')

        future.add_done_callback(done)

    def _answered(self, goal: _Goal, sent: Any, before: Any, after: Any) -> None:
        held = self._held
        if self._asked is goal:
            self._asked, self._held = None, False
        if sent.accepted:
            self._took(goal, sent)
        else:
            if self._shaper.history is after:
                # The controller goes on with what it had.
                self._shaper.history = () if held else before
            self._abort(goal, f'{self.action} rejects it: the log of the controller says why')
        self._pump()

    def _took(self, goal: _Goal, sent: Any) -> None:
        goal.sent = sent
        if goal.ended or goal.stopped is not None:
            # Too late.
            self._cancel(goal)
            if goal.ended:
                return
        self.taken += 1
        if self._newest is not None:
            self._newest.replaced = time.monotonic()
        self._newest = goal
        goal.future = sent.get_result_async()
        self._when(goal.future, lambda response: self._resulted(goal, response))

    def _cancel(self, goal: _Goal) -> None:
        if goal in (self._newest, self._asked):
            self._shaper.forget()
        if goal.sent is not None:
            goal.sent.cancel_goal_async()

    # What the controller says.

    def _fed(self, goal: _Goal, message: Any) -> None:
        goal.reported = time.monotonic()
        if not goal.ended:
            goal.handle.publish_feedback(message.feedback)

    def _resulted(self, goal: _Goal, response: Any) -> None:
        if response.status == GoalStatus.STATUS_SUCCEEDED:
            if goal is self._newest and (why := self._joints_fault()):
                self._owner.log(f'{self.action} says that it has reached the goal, but {why}', WARNING)
        elif goal is self._newest:
            # It holds the joints, unless the goal that it is asked for has taken the place of this one.
            self._held = self._asked is not None
            if not self._held:
                self._shaper.forget()
        self._end(goal, response.status, response.result)

    def _look(self) -> None:
        """End what the controller has left without an answer."""
        now = time.monotonic()
        silent = f'{self.action} has not answered within {ANSWER_S:g} s'

        def overdue(since: float | None, after: float = ANSWER_S) -> bool:
            return since is not None and now - since > after

        for goal in tuple(self._goals):
            if goal is self._asked and overdue(goal.asked):
                # Whether it follows this one or that before it, nobody knows.
                self.stop(silent)
                self._late(goal)
            elif goal.sent is None:
                continue
            elif overdue(goal.stopped) or overdue(goal.replaced):
                self._give_up(goal, silent)
            elif not self.ready():
                self._give_up(goal, f'{self.action} has gone')
            elif overdue(goal.reported, SILENT_S):
                self._give_up(goal, f'{self.action} has sent no feedback for {SILENT_S:g} s')
        self._pump()

    def _late(self, goal: _Goal) -> None:
        """Its answer may still come, until the next one is late."""
        if self._unanswered is not None:
            self._unanswered.future.cancel()
        self._unanswered = goal

    # Ends.

    def _give_up(self, goal: _Goal, why: str) -> None:
        """End a goal that the controller may still follow."""
        self._cancel(goal)
        self._abort(goal, why)

    def _reply(self, why: str, code: str) -> Any:
        return self._result(error_code=getattr(self._result, code), error_string=why)

    def _abort(self, goal: _Goal, why: str, code: str = INVALID) -> None:
        if not goal.ended:
            gate = self._owner.gate
            gate.reject(FOLLOW, why)
            self._end(goal, GoalStatus.STATUS_ABORTED, self._reply(gate.why[FOLLOW], code))

    def _end(self, goal: _Goal, status: int, result: Any) -> None:
        if goal.ended:
            return
        goal.ended, self._last_end = True, time.monotonic()
        self._goals.remove(goal)
        if goal is self._newest:
            self._newest = None
        if goal.sent is not None:
            goal.future.cancel()

        def log(handle: Any) -> Any:
            if status == GoalStatus.STATUS_SUCCEEDED:
                handle.succeed()
            elif status == GoalStatus.STATUS_CANCELED and handle.is_cancel_requested:
                handle.canceled()
            else:
                handle.abort()
            return result

        if self._owner.node.executor is not None:
            self._server.finish(goal.handle, log)
