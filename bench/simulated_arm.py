# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""An arm whose links bend under a load at its end, and the one criterion for what moves it: no step is too large."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from psd_deflection.arms.chains.chain import Chain, EndEffector, TipDeflection
from psd_deflection.records import FloatArray

LAG_S = 0.02  # Time constant of the joints.
_CERTAIN = np.zeros((3, 3))


class SimulatedArm:
    """``chain``: the links; ``angles``: of its joints at the start, rad; ``frequency`` Hz and ``damping`` of the mode.
    ``force`` (3,): the load at the end effector, N in the base. ``angles``: where the joints are now. ``mass``, kg, at
    the end effector: only its inertia, as of the rigid arm."""

    def __init__(
        self, chain: Chain, angles: FloatArray, frequency: float = 12.0, damping: float = 0.01, mass: float = 0.0
    ) -> None:
        self.chain = chain
        self.mass = mass
        self.angles = np.array(angles, dtype=np.float64)
        self.force = np.zeros(3)
        self._omega, self._damping = 2.0 * math.pi * frequency, damping
        self._swing = np.zeros((2, len(chain.links), 3))
        self._rigid = chain.rigid(self.angles.tolist()).position
        self._velocity = np.zeros(3)

    def step(self, commanded: FloatArray, seconds: float) -> None:
        """Let ``seconds`` pass with the joints commanded to ``commanded`` (n,), rad."""
        self.angles += (commanded - self.angles) * -math.expm1(-seconds / LAG_S)
        load = self.force
        if self.mass:
            before, self._rigid = self._rigid, self.chain.rigid(self.angles.tolist()).position
            earlier, self._velocity = self._velocity, (self._rigid - before) / seconds
            load = load - self.mass * (self._velocity - earlier) / seconds
        static = self.chain.tips_under(load, self.angles.tolist())
        # Exact for a load that is held over the step.
        swing, speed = self._swing
        x, v = swing - static, speed
        decay, damped = self._damping * self._omega, self._omega * math.sqrt(1.0 - self._damping**2)
        c, s, e = math.cos(damped * seconds), math.sin(damped * seconds), math.exp(-decay * seconds)
        self._swing[0] = static + e * (x * c + (v + decay * x) / damped * s)
        self._swing[1] = e * (v * c - (self._omega**2 * x + decay * v) / damped * s)

    def settle(self) -> None:
        """Let the links come to rest under their load."""
        self._swing[0], self._swing[1] = self.chain.tips_under(self.force, self.angles.tolist()), 0.0

    def end(self) -> EndEffector:
        return self._composed(self._swing[0])

    def vibration(self) -> float:
        """Amplitude of the end effector's swing about where it comes to rest, m."""
        static = self.chain.tips_under(self.force, self.angles.tolist())
        there = self._composed(static).deflected.position
        size = 0.0
        for part in (self._swing[0] - static, self._swing[1] / self._omega):
            size += float(np.sum(np.square(self._composed(static + part).deflected.position - there)))
        return math.sqrt(size)

    def _composed(self, tips: FloatArray) -> EndEffector:
        return self.chain.compose([TipDeflection(tip, _CERTAIN) for tip in tips], self.angles.tolist())


def largest_step(stamps: Sequence[float], commands: Sequence[FloatArray], max_rate: float) -> float:
    """The largest step over ``max_rate`` times the time between the two, 1 at most if all is well; 0 of fewer than two.
    ``stamps`` (n,): when ``commands`` (n, joints) were sent, s. Infinite if one is not finite or time stands still."""
    if len(commands) < 2:
        return 0.0
    sent = np.array(commands)
    steps = np.abs(np.diff(sent, axis=0)).max(axis=1)
    if not np.all(np.isfinite(sent)):
        return float('inf')
    allowed = max_rate * np.diff(np.array(stamps))
    # A nanosecond is the resolution of a stamp.
    with np.errstate(divide='ignore', invalid='ignore'):
        shares = np.where(steps <= 1e-9 * max_rate, 0.0, steps / np.maximum(allowed, 0.0))
    return float(shares.max())


def largest_step_in_time(
    stamps: Sequence[float], commands: Sequence[FloatArray], max_rate: float, late: Sequence[int]
) -> float:
    """The same without the steps to the commands of the numbers ``late``, before which something came too late."""
    cuts = sorted({0, *(n for n in late if 0 < n < len(stamps)), len(stamps)})
    parts = [slice(a, b) for a, b in itertools.pairwise(cuts)]
    return max((largest_step(stamps[part], commands[part], max_rate) for part in parts), default=0.0)
