# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The shaper's part of :mod:`bench.campaign.hold`: trajectories and goals of FollowJointTrajectory, over real DDS."""

import copy
import math
import signal
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rclpy.action import ActionClient
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bench.campaign.plant import NAMES, Spun, move_to
from bench.campaign.strange import Stranger
from bench.simulated_arm import largest_step_in_time
from bench.trajectory_controller import ACTION, ServedController, TrajectoryController, arriving
from psd_deflection.records import FloatArray
from tools.control_msgs import available
from tools.program import PSD_DEFLECTION, Program

MOVE_S = 0.6
LARGEST = 0.4  # Of a joint, rad.
FASTEST = 1.5 * 2.0 * LARGEST / (MOVE_S - 0.1)
"""Of a cubic from one end to the other within the time that is left of it, rad/s."""
STEP_S, LONGEST_S = 0.002, 60.0
Change = Callable[[Any], object]


def unchanged(message: Any) -> None:
    pass


def _last(**fields: Any) -> Change:
    def change(message: Any) -> None:
        for name, value in fields.items():
            setattr(message.points[-1], name, value)

    return change


REJECTED: dict[str, Change] = {
    'not finite': _last(positions=[math.nan, 0.0]),
    '1e300': _last(positions=[1e300, 0.0]),
    'before 1970': lambda message: setattr(message.header.stamp, 'sec', -1),
    'old stamp': lambda message: setattr(message.header.stamp, 'sec', 1),
    'unknown joint': lambda message: setattr(message, 'joint_names', ['shoulder', 'z']),
    'begins elsewhere': lambda message: message.points.insert(
        0, JointTrajectoryPoint(positions=[3.0, 0.0], velocities=[0.0, 0.0])
    ),
    'times that fall': lambda message: message.points.append(copy.deepcopy(message.points[0])),
    'efforts': _last(effort=[1.0, 0.0]),
    'ends in motion': _last(velocities=[1.0, 0.0]),
}
"""What is sent while a trajectory is under way, and must change nothing."""
OTHERS = ('replaced again and again', 'joints not told', 'killed and started again', 'stopped for 0.2 s')


class Moved(Spun):
    """The graph: the shaper, and what it moves. ``stamps`` (s) and ``commands`` of the joints; ``late``: the numbers of
    those before which a trajectory came after its begin. ``heard``: how many came. ``reports``: whether the joints are
    told."""

    def __init__(self) -> None:
        super().__init__('moved')
        self.controller = TrajectoryController(np.zeros(2))
        self.reports = True
        self.heard = 0
        self.stamps: list[float] = []
        self.commands: list[FloatArray] = []
        self.late: list[int] = []
        self._rng = np.random.default_rng(2)
        self._joints = self.node.create_publisher(JointState, '/joint_states', 5)
        self.given = self.node.create_publisher(JointTrajectory, '/shaper/trajectory', 5)
        self.node.create_subscription(JointTrajectory, '/shaper/shaped', self._arrived, 5)
        self.node.create_timer(STEP_S, self._step)
        self.start()

    def start(self, *words: str) -> None:
        """The shaper, until it is known on the graph."""
        command = [*PSD_DEFLECTION, 'shaper', '--frequency', '12', '--shaper', 'zvd', *words]
        self.shaper = self.program = Program(command)
        self.shaper.until('publishing /shaper/shaped')

    def _arrived(self, message: Any) -> None:
        self.heard += 1
        if not message.points:
            return
        now, (stamp, path) = time.time(), arriving(message, NAMES)
        if now > stamp:
            self.late.append(len(self.stamps))
        self.controller.arrive(now, stamp, path)

    def _step(self) -> None:
        now = time.time()
        self.stamps.append(now)
        self.commands.append(self.controller.state(now)[0])
        if self.reports and len(self.stamps) % 5 == 0:
            self._joints.publish(JointState(name=list(NAMES), position=self.commands[-1].tolist()))

    def move(self, change: Change = unchanged) -> None:
        """Give a trajectory to somewhere else, changed."""
        message = move_to(self._rng.uniform(-LARGEST, LARGEST, 2), MOVE_S)
        change(message)
        self.give(message)

    def give(self, message: Any) -> None:
        self.given.publish(message)

    def replaced(self) -> None:
        for _ in range(5):
            self.move()
            self.spin(float(self._rng.uniform(0.02, 0.2)))

    def stopped(self, seconds: float, then: Callable[[], None] = lambda: None) -> None:
        self.shaper.process.send_signal(signal.SIGSTOP)
        then()
        self.spin(seconds)
        self.shaper.process.send_signal(signal.SIGCONT)

    def under_way(self) -> None:
        heard = self.heard
        until = time.monotonic() + LONGEST_S
        while self.heard == heard and time.monotonic() < until:
            self.move()
            self.spin(0.5, lambda: self.heard > heard)
        self.spin(0.3)

    def inject(self, name: str) -> None:
        self.under_way()
        heard = self.heard
        if name in REJECTED or name == 'joints not told':
            self.reports = name in REJECTED
            self.spin(0.0 if self.reports else 1.5)
            self.move(REJECTED.get(name, unchanged))
            self.spin(0.2 if self.reports else 0.3)
            self.reports = True
            if self.heard != heard:
                raise RuntimeError(f'{name}: was not rejected')
        elif name == 'replaced again and again':
            self.replaced()
        elif name == 'killed and started again':
            self.shaper.process.kill()
            self.shaper.wait()
            # The joints still move: it must begin when they stand.
            self.start()
        else:
            self.stopped(0.2, self.move)
        self.under_way()
        self.spin(1.5)


def injected(moved: Moved, names: Sequence[str], times: int, label: str = 'shaper') -> float:
    """Inject each of them so often, and print a line for each; the largest step over what is allowed."""
    worst = 0.0
    try:
        for name in names:
            since, late = len(moved.stamps), len(moved.late)
            for _ in range(times):
                moved.inject(name)
            numbers = [number - since for number in moved.late[late:]]
            step = largest_step_in_time(moved.stamps[since:], moved.commands[since:], FASTEST, numbers)
            worst = max(worst, step)
            came = f', {len(numbers)} came too late' if numbers else ''
            print(f'{label}: {name:26}{times:4} times: largest step {step:.3f} of speed * dt{came}', flush=True)
    finally:
        moved.close()
    return worst


OF_ACTION = (
    *('strange goals', 'goal replaced', 'goal replaced, shaper starved', 'goal cancelled', 'controller rejects'),
    *('controller dies', 'controller says nothing more'),
)
MOST_S = 30.0  # Longest time until a goal ends that nobody follows any more, s.


class Followed(Moved):
    def __init__(self) -> None:
        from control_msgs.action import FollowJointTrajectory

        self._goal = FollowJointTrajectory.Goal
        self._sent: list[Any] = []
        self._stranger = Stranger(3)
        self._served: ServedController | None = None
        super().__init__()
        self._client = ActionClient(self.node, FollowJointTrajectory, '/shaper/follow_joint_trajectory')
        self._served = ServedController(self.node, NAMES, self.controller)

    def start(self, *words: str) -> None:
        super().start('--action', ACTION)

    def _step(self) -> None:
        if self._served is not None:
            if self._served.late:
                self.late.append(len(self.stamps))
                self._served.late = 0
            self._served.step(time.time())
            self.heard += len(self._served.goals)
            self._served.goals.clear()
        super()._step()

    def give(self, message: Any) -> None:
        self._sent.append(self._client.send_goal_async(self._goal(trajectory=message)))

    def _ended(self) -> None:
        deaf = time.monotonic() + MOST_S
        for sent in self._sent[-5:]:
            self.spin(LONGEST_S, sent.done, 'an answer to a goal')
            if sent.result().accepted:
                future = sent.result().get_result_async()
                self.spin(max(deaf - time.monotonic(), 1.0), future.done, 'the end of a goal')
        self._sent.clear()

    def _strange(self, message: Any) -> None:
        """Of joints that nobody has, with any content."""
        message.joint_names = ['y', 'z']
        self._stranger.change(message, 0.3)

    def inject(self, name: str) -> None:
        assert self._served is not None
        if name in REJECTED:
            super().inject(name)
        elif name != 'goal replaced, shaper starved':
            self.under_way()
        if name == 'strange goals':
            for _ in range(15):
                self.move(self._strange)
                self.spin(0.02)
        elif name == 'goal replaced':
            self.replaced()
        elif name == 'goal replaced, shaper starved':
            # It is so late that it takes old feedback for the last, and forgets a motion that goes on.
            for _ in range(4):
                self.move()
                for _ in range(4):
                    self.stopped(0.09)
                    self.spin(0.004)
        elif name == 'goal cancelled':
            self.spin(LONGEST_S, self._sent[-1].done, 'an answer to a goal')
            self._sent[-1].result().cancel_goal_async()
            self.spin(float(self._rng.uniform(0.0, 0.3)))
            self.move()
        elif name == 'controller rejects':
            self._served.rejects = True
            self.move()
            self.spin(0.2)
            self._served.rejects = False
        elif name == 'controller dies':
            self._served.close()
            self._served = None
            self.controller.hold(time.time())
            self.spin(float(self._rng.uniform(0.0, 2.0)))
            self._served = ServedController(self.node, NAMES, self.controller)
        elif name not in REJECTED:
            self._served.mute = True
            self._ended()
            self._served.mute = False
        self.under_way()
        self._ended()
        self.spin(0.3)


def shaper_faults(times: int) -> float:
    """All of the topic; as :func:`injected`."""
    return injected(Moved(), (*REJECTED, *OTHERS), times)


def action_faults(times: int) -> float:
    """All of the action; as :func:`injected`."""
    if not available():
        print('action: control_msgs is not installed and cannot be built: not tried')
        return 0.0
    return injected(Followed(), (*REJECTED, *OF_ACTION), times, 'action')
