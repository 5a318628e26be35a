# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The action's part of :mod:`bench.campaign.hold`: goals of FollowJointTrajectory through the shaper, over real DDS."""

import signal
import time
from typing import Any

from rclpy.action import ActionClient

from bench.campaign.shaper_faults import LONGEST_S, NAMES, REJECTED, Moved, injected
from bench.campaign.strange import Stranger
from bench.trajectory_controller import ACTION, ServedController
from tools.control_msgs import available
from tools.program import PSD_DEFLECTION, Program

OTHERS = (
    'strange goals',
    'goal replaced',
    'goal replaced, shaper starved',
    'goal cancelled',
    'controller rejects',
    'controller dies',
    'controller says nothing more',
)
MOST_S = 30.0  # Longest time until a goal ends that nobody follows any more, s.


class Followed(Moved):
    """The graph, with goals in place of messages."""

    def __init__(self) -> None:
        from control_msgs.action import FollowJointTrajectory

        self._goal = FollowJointTrajectory.Goal
        self._sent: list[Any] = []
        self._stranger = Stranger(3)
        self._served: ServedController | None = None
        super().__init__()
        self._client = ActionClient(self.node, FollowJointTrajectory, '/shaper/follow_joint_trajectory')
        self._served = ServedController(self.node, NAMES, self.controller)

    def started(self) -> Program:
        words = ['--frequency', '12', '--shaper', 'zvd', '--action', ACTION]
        out = Program([*PSD_DEFLECTION, 'shaper', *words])
        out.until('publishing /shaper/shaped')
        return out

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
        """Every goal that was sent has ended."""
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
        """One fault while a goal is under way."""
        assert self._served is not None
        if name in REJECTED:
            super().inject(name)
        elif name == 'strange goals':
            self.under_way()
            for _ in range(15):
                self.move(self._strange)
                self.spin(0.02)
        elif name == 'goal replaced':
            self.under_way()
            for _ in range(5):
                self.move()
                self.spin(float(self._rng.uniform(0.02, 0.2)))
        elif name == 'goal replaced, shaper starved':
            # It is so late that it takes old feedback for the last, and forgets a motion that goes on.
            for _ in range(4):
                self.move()
                for _ in range(4):
                    self.shaper.process.send_signal(signal.SIGSTOP)
                    self.spin(0.09)
                    self.shaper.process.send_signal(signal.SIGCONT)
                    self.spin(0.004)
        elif name == 'goal cancelled':
            self.under_way()
            self.spin(LONGEST_S, self._sent[-1].done, 'an answer to a goal')
            self._sent[-1].result().cancel_goal_async()
            self.spin(float(self._rng.uniform(0.0, 0.3)))
            self.move()
        elif name == 'controller rejects':
            self.under_way()
            self._served.rejects = True
            self.move()
            self.spin(0.2)
            self._served.rejects = False
        elif name == 'controller dies':
            self.under_way()
            self._served.close()
            self._served = None
            self.controller.hold(time.time())
            self.spin(float(self._rng.uniform(0.0, 2.0)))
            self._served = ServedController(self.node, NAMES, self.controller)
        else:
            self.under_way()
            self._served.mute = True
            self._ended()
            self._served.mute = False
        self.under_way()
        self._ended()
        self.spin(0.3)


def action_faults(times: int) -> float:
    """As :func:`bench.campaign.shaper_faults.injected`."""
    if not available():
        print('action: control_msgs is not installed and cannot be built: not tried')
        return 0.0
    return injected(Followed(), (*REJECTED, *OTHERS), times, 'action')
