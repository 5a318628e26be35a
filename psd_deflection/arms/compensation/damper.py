# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Active damping: a joint moves against the velocity of its link's tip.

The tip moves by q against the joint, which turns by o at the distance L: q'' + 2 zeta w q' + w^2 q = -L o''. The offset
o = -2 z q'/(w L) adds z to the damping ratio while the link rings with its mode (Preumont, Vibration Control of Active
Structures, 2018, chapter 6: velocity feedback).

An observer at the mode's frequency follows the measured velocity. It passes neither a slow motion nor the noise on, and
it tells the velocity at the time at which the joint will have moved. The offset is bounded by making the whole
oscillation smaller, not by cutting its tops or its slope off: that would delay it, and a delay drives the mode.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import NamedTuple

from psd_deflection.arms.compensation.compensator import State
from psd_deflection.base.errors import ConfigError

OBSERVER = 0.3
"""Share of what the observer did not foretell that it believes."""
LONGEST_S = 0.1
"""A step is never longer than this: after a pause the offset does not leap."""
GROWS, PERIODS = 1.05, 6
"""If the vibration of each period is so many times that of the one before, for so many periods, damping drives it."""
HALF_TURN = 0.9 * math.pi
"""The mode turns less than this between two velocities, rad."""


@dataclass(frozen=True, slots=True)
class DamperSettings:
    """``frequency`` Hz and ``damping`` ratio of the mode; ``lever``: distance of the tip from the joint, m, below 0 if
    the joint moves the tip the other way.

    ``added``: to the damping ratio. ``lag``: time by which the joint follows its command late, s. ``max_offset`` rad,
    ``max_rate`` rad/s. Damping stops if the newest velocity is older than ``stale`` (s), less certain than ``max_sd``
    (m/s) or above ``max_speed`` (m/s). It goes on after ``good`` velocities in a row.

    Raises ConfigError for values that cannot be.
    """

    frequency: float
    damping: float
    lever: float
    added: float = 0.1
    lag: float = 0.0
    max_offset: float = 0.005
    max_rate: float = 0.3
    stale: float = 0.08
    max_sd: float = 0.02
    max_speed: float = 2.0
    good: int = 10

    def __post_init__(self) -> None:
        for name in ('frequency', 'added', 'max_offset', 'max_rate', 'stale', 'max_sd', 'max_speed'):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ConfigError(f'{name} = {value}: must be above 0 and finite')
        if not 0.0 <= self.damping < 1.0:
            raise ConfigError(f'damping = {self.damping}: must be at least 0 and below 1')
        if not 0.0 <= self.lag <= 0.5 / self.frequency:
            raise ConfigError(f'lag = {self.lag} s: must be at least 0 and at most half a period of the mode')
        if not 1e-3 <= abs(self.lever) < math.inf:
            raise ConfigError(f'lever = {self.lever} m: must be at least 0.001 in size, and finite')
        if self.good < 1:
            raise ConfigError(f'good = {self.good}: must be at least 1')


class Damping(NamedTuple):
    """``offset`` of the joint, rad; ``why``: of a state that is not ``following``; ``limited``: by size or rate."""

    offset: float
    state: State
    why: str = ''
    limited: bool = False


class Damper:
    """The offset of one joint. The times are seconds of a clock that is never set. For one thread. Off at the start."""

    def __init__(self, settings: DamperSettings) -> None:
        self.settings = settings
        self.enabled = False
        self._w = 2.0 * math.pi * settings.frequency
        self._turn = complex(-settings.damping * self._w, self._w * math.sqrt(1.0 - settings.damping**2))
        self._phasor = 0.0j
        self._t: float | None = None
        self._offset, self._then = 0.0, -math.inf
        self._good, self._fault = 0, 'no velocity yet'
        self._largest, self._period_t, self._before, self._grown = 0.0, -math.inf, math.inf, 0

    def enable(self, wanted: bool) -> None:
        """Damp, or let the offset go back to zero. This also forgets that damping drove the vibration."""
        self.enabled = wanted
        self._grown, self._before, self._largest = 0, math.inf, 0.0
        self._period_t = -math.inf

    @property
    def amplitude(self) -> float:
        """Of the velocity at the mode's frequency, m/s."""
        return abs(self._phasor)

    def observe(self, t: float, velocity: float, deviation: float) -> None:
        """Take a velocity of the tip, m/s, at its time ``t``, with its standard deviation."""
        settings = self.settings
        if not (math.isfinite(velocity) and math.isfinite(deviation)):
            self._stop('the velocity is not finite')
        elif not 0.0 <= deviation <= settings.max_sd:
            self._stop(f'the velocity is uncertain by more than {settings.max_sd:g} m/s')
        elif abs(velocity) > settings.max_speed:
            self._stop(f'the velocity is above {settings.max_speed:g} m/s')
        elif self._t is not None and t <= self._t:
            return
        elif self._t is None or (t - self._t) * self._w > HALF_TURN:
            if not self._fault:
                self._stop('velocities come too seldom for the frequency of the mode')
            self._phasor, self._t = 0.0j, t
        else:
            self._phasor *= cmath.exp(self._turn * (t - self._t))
            self._phasor += 2.0 * OBSERVER * (velocity - self._phasor.real)
            self._t = t
            self._good += 1
            if self._good >= settings.good:
                self._fault = ''
            self._look_whether_it_grows(t)

    def watch(self, now: float) -> Damping:
        """The offset at the time ``now``; to be called often."""
        settings = self.settings
        if not self._fault and self._t is not None and now - self._t > settings.stale:
            self._stop(f'no velocity for {settings.stale:g} s')
        drives = self._grown >= PERIODS
        acts = self.enabled and not self._fault and not drives and self._t is not None
        wanted, limited = 0.0, False
        if acts and self._t is not None:
            # Where the phasor will be when the joint has moved.
            ahead = self._phasor * cmath.exp(self._turn * (now - self._t + settings.lag))
            aim = -2.0 * settings.added / (self._w * settings.lever) * ahead
            most = min(settings.max_offset, settings.max_rate / self._w)
            limited = abs(aim) > most
            wanted = (aim * (most / abs(aim)) if limited else aim).real
        # At the start, and on the way back to zero.
        step = settings.max_rate * min(max(now - self._then, 0.0), LONGEST_S)
        self._then = now
        self._offset += min(max(wanted - self._offset, -step), step)
        if acts:
            return Damping(self._offset, State.FOLLOWING, '', limited)
        why = 'damping drives the vibration: check lever, lag and frequency' if drives else self._fault
        if not self.enabled:
            return Damping(self._offset, State.RELEASING if self._offset else State.OFF, why)
        return Damping(self._offset, State.HOLDING, why)

    def _stop(self, why: str) -> None:
        self._fault, self._good = why, 0

    def _look_whether_it_grows(self, t: float) -> None:
        self._largest = max(self._largest, self.amplitude)
        if t - self._period_t < 1.0 / self.settings.frequency or self._grown >= PERIODS:
            return
        self._grown = self._grown + 1 if self.enabled and self._largest > GROWS * self._before else 0
        self._before, self._largest, self._period_t = self._largest, 0.0, t
