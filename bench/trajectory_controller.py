"""What joint_trajectory_controller does with the trajectories that it gets, on a clock of the caller's.

Its rules, as of ros2_controllers for Jazzy: a stamp of 0 begins when the trajectory arrives, another at that time.
Until its first point it goes there from where the command is on arrival. After that it follows it, also from its
middle. After the last point it stays. The joints are where they are commanded. Times that do not rise are refused.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.arms.compensation.trajectory import Trajectory
from psd_deflection.records import FloatArray


class TrajectoryController:
    """``position`` (j,): where the joints are at the start."""

    def __init__(self, position: FloatArray) -> None:
        self._path = Trajectory(tuple(map(str, range(len(position)))), np.zeros(1), position[None, None])
        self._begins = 0.0

    def arrive(self, now: float, stamp: float, path: Trajectory) -> None:
        """A trajectory arrives at the time ``now``, s, with a ``stamp``, s. Raises ValueError if it is refused."""
        if not (np.diff(path.times, prepend=-1e-9) > 0.0).all() or not np.isfinite(path.states).all():
            raise ValueError(f'{path.times}: do not rise, or {path.states} are not finite')
        orders = path.states.shape[1]
        begins = stamp or now
        first = begins + path.times[0]
        if now < first:
            here = np.zeros_like(path.states[:1])
            same = min(orders, self._path.states.shape[1])
            here[0, :same] = self.state(now)[:same]
            path = Trajectory(path.names, np.append(now - begins, path.times), np.concatenate([here, path.states]))
        self._path, self._begins = path, begins

    def state(self, now: float) -> FloatArray:
        """Position, and velocity and acceleration if the trajectory has them, (k, j)."""
        out: FloatArray = self._path.at(np.array([now - self._begins]))[0]
        return out
