# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What an arm's node may believe of a message: joint positions, and whether the robot runs. Each check gives the reason
why not."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

LARGEST_POSITION = 1e4
"""Bound of a joint's position, rad or m: a number beyond it is no position."""
LONGEST_LIST = 1000
"""Joints in a message."""
KNOWN_S = 0.5
"""For so long the position of a joint is known after it was told, s."""
REST_S = 0.1
"""The speed of a joint is that over at least this time, s: noise of its encoder is no motion."""


def joints_fault(names: Sequence[str], positions: Sequence[float], ours: Collection[str]) -> str:
    """Why positions of joints cannot be used; '' if they can. Of other joints than ``ours`` the values do not count."""
    if len(names) > LONGEST_LIST:
        return f'{len(names)} joints: must be at most {LONGEST_LIST}'
    if len(set(names)) < len(names):
        return 'a joint is named twice'
    if not len(positions):
        # A driver may tell speeds or forces alone.
        return ''
    if len(positions) != len(names):
        return f'{len(positions)} positions of {len(names)} joints'
    for name, position in zip(names, positions, strict=True):
        if name in ours and not is_position(position):
            return f'{name} = {position:g}: must be finite and at most {LARGEST_POSITION:g}'
    return ''


def is_position(value: float) -> bool:
    """Whether a number can be a joint's position, rad or m."""
    return abs(value) <= LARGEST_POSITION


class MeasuredJoint(NamedTuple):
    """``position``, rad or m; ``speed`` over ``REST_S`` or more, rad/s or m/s, NaN if it was not told for so long."""

    position: float
    speed: float


def standing(positions: Mapping[str, float]) -> dict[str, MeasuredJoint]:
    """Joints that are known to stand at ``positions``, rad or m."""
    return {name: MeasuredJoint(position, 0.0) for name, position in positions.items()}


class _Reported(NamedTuple):
    """What was told last, and two readings of before that are ``REST_S`` or more apart: (value, time)."""

    last: tuple[float, float]
    newer: tuple[float, float]
    older: tuple[float, float] | None

    def next(self, position: float, now: float) -> _Reported:
        last = position, now
        return _Reported(last, last, self.newer) if now - self.newer[1] >= REST_S else self._replace(last=last)

    def measured(self) -> MeasuredJoint:
        (at, then), older = self.last, self.older
        return MeasuredJoint(at, abs(at - older[0]) / (then - older[1]) if older is not None else math.nan)


class KnownJoints:
    """Where joints are, by name, of ``LONGEST_LIST`` of them at most, however many names are told.

    The times ``now`` are s of a clock that is never set.
    """

    def __init__(self) -> None:
        self._reported: dict[str, _Reported] = {}  # Bound: LONGEST_LIST.

    def notify(self, now: float, names: Sequence[str], positions: Sequence[float]) -> None:
        """Take what a message tells; a new name is passed over if there are too many of late."""
        if len(self._reported) + len(names) > LONGEST_LIST:
            self._reported = {
                name: reported for name, reported in self._reported.items() if now - reported.last[1] <= KNOWN_S
            }
        for name, position in zip(names, positions, strict=False):
            if is_position(position) and (name in self._reported or len(self._reported) < LONGEST_LIST):
                known, last = self._reported.get(name), (position, now)
                late = known is None or now - known.last[1] > KNOWN_S
                self._reported[name] = (
                    _Reported(last, last, None) if late or known is None else known.next(position, now)
                )

    def measured(self, now: float) -> dict[str, MeasuredJoint]:
        """The joints that were reported recently."""
        return {
            name: reported.measured() for name, reported in self._reported.items() if now - reported.last[1] <= KNOWN_S
        }

    def __len__(self) -> int:
        return len(self._reported)


LEAST_SPEED = 1e-3
"""A speed scaling below it is a stop. Drivers tell shares or per cent."""
SILENT_S = 0.5
"""What comes again and again has ended if it was not heard for so long, s."""


class RobotWatch:
    """Nothing that was never heard counts. The times ``now`` are s of a clock that is never set."""

    def __init__(self) -> None:
        self._runs = True
        self._scaling = 1.0
        self._heard: dict[str, float] = {}

    def runs(self, value: bool) -> None:
        """The driver says whether the robot runs; it may say so once."""
        self._runs = value

    def scaled(self, now: float, scaling: float) -> None:
        """The driver says how fast the robot is, of what it was asked for; it says so again and again."""
        self._scaling = scaling
        self._heard['speed scaling'] = now

    def controlled(self, now: float) -> None:
        """The controller told its state, as it does again and again while it is active."""
        self._heard['state of the controller'] = now

    def fault(self, now: float) -> str:
        """Why the robot does not run; '' if it does, as far as one can tell."""
        if not self._runs:
            return 'the robot does not run'
        # NaN is no speed.
        if not self._scaling >= LEAST_SPEED:
            return f'the robot does not run: its speed scaling is {self._scaling:g}'
        ended = next((what for what, then in self._heard.items() if now - then > SILENT_S), '')
        return f'the robot does not run: its {ended} comes no more' if ended else ''
