"""Follows the measured deflection with joint offsets, within limits, and holds as soon as it cannot be trusted.

With the joints at q + o, the rigid pose T(q + o) and the measured deflection D, the end effector is at T(q + o) D. It
is to be at T(q). Each estimate moves o by a damped least squares step (Nakamura & Hanafusa 1986) that lessens the
difference on the chosen axes; a first-order lag lets the offsets follow a load that is held, and not a vibration.

The offsets hold (they keep their last value) while the deflection is stale, not finite, too uncertain or jumping, or
the joints are not known. They move again after some good estimates in a row. When the compensation is switched off they
go back to zero at the limit of their rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.compensation.arm import Arm
from psd_deflection.base.errors import ConfigError
from psd_deflection.records import FloatArray

AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')
LONGEST_S = 0.1
"""A step is never longer than this: after a pause the offsets do not leap."""


class State(StrEnum):
    """What the offsets do."""

    OFF = 'off'
    FOLLOWING = 'following'
    HOLDING = 'holding'
    RELEASING = 'releasing'


@dataclass(frozen=True, slots=True)
class CompensatorSettings:
    """``axes``: of the end effector that are corrected. Offsets and rates of each joint: rad or m, and 1/s.

    ``time_constant`` s; ``damping`` of the least squares, m; an error of 1 rad counts as one of 1 m. The offsets hold
    if the newest deflection is older than ``stale`` (s), if a standard deviation on the axes is above ``max_sd`` (m,
    rad), or if the deflection changes by more than ``jump`` (m, rad) from one estimate to the next. They follow again
    after ``good`` estimates in a row.

    Raises ConfigError for values that cannot be.
    """

    axes: tuple[str, ...] = ('x', 'y', 'z')
    max_offset: float = 0.05
    max_rate: float = 0.1
    time_constant: float = 0.2
    damping: float = 0.01
    stale: float = 0.08
    max_sd: float = 1e-3
    jump: float = 0.02
    good: int = 25

    def __post_init__(self) -> None:
        for axis in self.axes:
            if axis not in AXES:
                raise ConfigError(f'axes = {axis}: must be some of {", ".join(AXES)}')
        if not self.axes or len(set(self.axes)) < len(self.axes):
            raise ConfigError('axes: must be at least one, and none of them twice')
        for name in ('max_offset', 'max_rate', 'time_constant', 'damping', 'stale', 'max_sd', 'jump'):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ConfigError(f'{name} = {value}: must be above 0 and finite')
        if self.good < 1:
            raise ConfigError(f'good = {self.good}: must be at least 1')


class Observed(NamedTuple):
    """A measured deflection. ``t``: its stamp, s; ``age``: time from the stamp to now, s.

    ``deflection`` and ``covariance`` (6, 6): in the frame of the rigid pose.
    """

    t: float
    deflection: Transform
    covariance: FloatArray
    age: float = 0.0


class Command(NamedTuple):
    """``offsets`` (n,) of the joints, rad or m; ``why``: of a state that is not ``following``, else ''.

    ``residual``: distance from the rigid pose on the axes that are corrected, m; NaN if it is not known.
    ``limited``: whether a limit keeps the offsets from what the deflection asks for.
    """

    offsets: FloatArray
    state: State
    why: str = ''
    residual: float = math.nan
    limited: bool = False


class Compensator:
    """The offsets of the joints of ``arm``. The times ``now`` are seconds of a clock that is never set. For one thread.

    ``enabled``: whether the offsets follow; :meth:`enable` changes it. ``dry``: the joints do not get the offsets.
    """

    def __init__(self, arm: Arm, settings: CompensatorSettings, dry: bool = False) -> None:
        self.arm = arm
        self.settings = settings
        self.enabled = False
        self._dry = dry
        self._rows = [AXES.index(axis) for axis in settings.axes]
        self._offsets = np.zeros(len(arm.names))
        self._joints: FloatArray | None = None
        self._joints_t = -math.inf
        self._last: Observed | None = None
        self._last_now = -math.inf
        self._good = settings.good
        self._fault = 'no deflection yet'
        self._residual = math.nan
        self._limited = False
        self._released_t: float | None = None

    def enable(self, wanted: bool) -> None:
        """Let the offsets follow from where they are, or let them go back to zero."""
        self.enabled = wanted
        self._released_t = None

    def joints(self, now: float, positions: FloatArray) -> None:
        """Where the joints are, offsets included unless ``dry``, in the order of the arm; passed over if not finite."""
        if np.all(np.isfinite(positions)):
            self._joints, self._joints_t = np.asarray(positions, dtype=np.float64), now

    def observe(self, now: float, seen: Observed) -> Command:
        """Take a deflection at the time ``now``; return the offsets."""
        settings = self.settings
        before, fault = self._last, self._refusal(now, seen)
        if fault:
            self._hold(fault)
            return self.watch(now)
        if before is not None and seen.t <= before.t:
            return self.watch(now)
        self._last, self._last_now = seen, now - max(seen.age, 0.0)
        if before is not None:
            moved = _vector(before.deflection.inverse() @ seen.deflection)[self._rows]
            if np.abs(moved).max() > settings.jump:
                self._hold(f'the deflection jumps by {np.abs(moved).max():.3g}')
        if self._fault:
            self._good += 1
            if self._good < settings.good:
                return self.watch(now)
            self._fault = ''
        if self.enabled and self._joints is not None:
            elapsed = seen.t - before.t if before is not None else 0.0
            nominal = self._joints if self._dry else self._joints - self._offsets
            self._follow(nominal, seen.deflection, min(max(elapsed, 0.0), LONGEST_S))
        return self.watch(now)

    def watch(self, now: float) -> Command:
        """The offsets at the time ``now``. To be called often: this finds that deflections come no more."""
        if not self._fault:
            stale = self.settings.stale
            if now - self._last_now > stale:
                self._hold(f'no deflection for {stale:g} s')
            elif now - self._joints_t > stale:
                self._hold(f'no positions of the joints for {stale:g} s')
        if not self.enabled:
            return self._release(now)
        if self._fault:
            return Command(self._offsets.copy(), State.HOLDING, self._fault)
        return Command(self._offsets.copy(), State.FOLLOWING, '', self._residual, self._limited)

    def keep(self, offsets: FloatArray) -> None:
        """Hold at ``offsets``: those that the joints got. Newer ones were never sent."""
        self._offsets = offsets.copy()

    def _refusal(self, now: float, seen: Observed) -> str:
        settings = self.settings
        finite = all(np.all(np.isfinite(part)) for part in (*seen.deflection, seen.covariance))
        if not finite or not math.isfinite(seen.t):
            return 'the deflection is not finite'
        variances = np.diag(seen.covariance)[self._rows]
        if variances.min() < 0.0 or math.sqrt(variances.max()) > settings.max_sd:
            return f'the deflection is uncertain by more than {settings.max_sd:g}'
        if abs(seen.age) > settings.stale:
            what = 'is older than' if seen.age > 0.0 else 'has a stamp ahead of our clock by more than'
            return f'the deflection {what} {settings.stale:g} s'
        if self._joints is None or now - self._joints_t > settings.stale:
            return 'the positions of the joints are not known'
        return ''

    def _hold(self, fault: str) -> None:
        self._fault, self._good = fault, 0

    def _follow(self, nominal: FloatArray, deflection: Transform, elapsed: float) -> None:
        """One step towards the offsets at which T(q + o) D is T(q)."""
        settings = self.settings
        wanted = self.arm.pose(nominal)
        error = _vector(wanted.inverse() @ self.arm.pose(nominal + self._offsets) @ deflection)[self._rows]
        self._residual = float(np.linalg.norm(error))
        jacobian = self.arm.jacobian(nominal + self._offsets)
        in_wanted = np.vstack([wanted.rotation.T @ jacobian[:3], wanted.rotation.T @ jacobian[3:]])
        rows = in_wanted[self._rows]
        square = rows.T @ rows + settings.damping**2 * np.eye(len(self._offsets))
        step = -np.linalg.solve(square, rows.T @ error) * -math.expm1(-elapsed / settings.time_constant)
        limit = settings.max_rate * elapsed
        allowed = np.clip(step, -limit, limit)
        # A joint that is beyond its limit by itself is not pulled back by us.
        low = np.clip(self.arm.lower - nominal, -settings.max_offset, 0.0)
        high = np.clip(self.arm.upper - nominal, 0.0, settings.max_offset)
        after = np.clip(self._offsets + allowed, low, high)
        self._limited = bool(np.any(np.abs(self._offsets + step - after) > 1e-12))
        self._offsets = after

    def _release(self, now: float) -> Command:
        elapsed = 0.0 if self._released_t is None else min(max(now - self._released_t, 0.0), LONGEST_S)
        self._released_t = now
        limit = self.settings.max_rate * elapsed
        self._offsets = self._offsets - np.clip(self._offsets, -limit, limit)
        if np.any(self._offsets):
            return Command(self._offsets.copy(), State.RELEASING, 'going back to zero')
        return Command(self._offsets.copy(), State.OFF, self._fault)


def _vector(pose: Transform) -> FloatArray:
    """(6,): position and rotation vector."""
    return np.concatenate([pose.position, pose.rotation_vector])
