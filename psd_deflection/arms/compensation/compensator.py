"""Follows the measured deflection with joint offsets, within limits, and holds as soon as it cannot be trusted.

With the joints at q + o, the rigid pose T(q + o) and the measured deflection D, the end effector is at T(q + o) D. It
is to be at T(q). Each estimate moves o by a damped least squares step (Nakamura & Hanafusa 1986) that lessens the
difference on the chosen axes; a first-order lag lets the offsets follow a load that is held, and not a vibration.

The offsets hold (they keep their last value) while the deflection is stale, not finite, too uncertain, too large or
jumping, the joints are not known, leap or do not follow, the robot does not run, or somebody else commands it. They
move again after some good estimates in a row. When the compensation is switched off they go back to zero. Whatever
happens, they move by no more than ``max_rate`` times the time since they were taken last.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.compensation.arm import Arm
from psd_deflection.arms.inputs import LARGEST_POSITION
from psd_deflection.base.errors import ConfigError
from psd_deflection.records import FloatArray
from psd_deflection.rig.parameters import Section, check_value, parameter

AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')
OFFSETS, COMMANDS = 'offsets', 'commands'
ALL_JOINTS = 'all'
LONGEST_S = 0.1
"""A step is never longer than this: after a pause the offsets do not leap."""
FOLLOW_S = 0.3
"""For so long a joint may be away from its command, s: its controller lags."""
MOVED_SHARE = 0.1
"""Joints that moved by less than this share of what the offsets did do not follow them."""


class State(StrEnum):
    """What the offsets do."""

    OFF = 'off'
    FOLLOWING = 'following'
    HOLDING = 'holding'
    RELEASING = 'releasing'


@dataclass(frozen=True, slots=True)
class CompensatorSettings:
    """What the offsets may do and what makes them hold; the node has them as ROS parameters.

    Offsets and rates are those of each joint: rad or m. Raises ConfigError for a value out of bounds.
    """

    axes: tuple[str, ...] = parameter(
        ('x', 'y', 'z'), '', "axes of the end effector's rigid pose that are corrected", choices=AXES
    )
    output: str = parameter(
        OFFSETS,
        '',
        'what a controller gets: offsets that it adds to its commands, or commands (position plus offset)',
        choices=(OFFSETS, COMMANDS),
    )
    joints: tuple[str, ...] = parameter(
        (ALL_JOINTS,), '', 'joints in the order of the outputs; all: those of the URDF file, from the base on'
    )
    takeover: bool = parameter(
        True, '', 'with offsets: wait until the controller tells those that it applies, and begin there; false: at 0'
    )
    frame_prefix: str = parameter('', '', 'prefix of the frames of the deflection')
    max_offset: float = parameter(0.05, 'rad or m', 'largest offset of a joint', above=0.0, maximum=10.0, live=True)
    max_rate: float = parameter(
        0.1,
        'rad/s or m/s',
        'largest rate of an offset, also on the way back to zero',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    time_constant: float = parameter(
        0.2, 's', 'lag of the offsets behind the deflection', minimum=1e-3, maximum=100.0, live=True
    )
    damping: float = parameter(
        0.01,
        'm',
        'damping of the least squares; an error of 1 rad counts as one of 1 m',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    stale: float = parameter(
        0.08,
        's',
        'age of a deflection or of joint positions from which on the offsets hold',
        minimum=1e-3,
        maximum=10.0,
        live=True,
    )
    max_sd: float = parameter(
        1e-3,
        'm or rad',
        'standard deviation above which a deflection is not followed',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    jump: float = parameter(
        0.02,
        'm or rad',
        'change between two deflections above which the offsets hold',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    max_deflection: float = parameter(
        0.25,
        'm or rad',
        'largest deflection that the links can have; a larger one is not followed',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    max_joint_speed: float = parameter(
        10.0,
        'rad/s or m/s',
        'speed of a joint above which its positions leap, and the offsets hold',
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    follow_error: float = parameter(
        0.01,
        'rad or m',
        'offset, or distance from a command, that the joints must be seen to follow',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    good: int = parameter(
        25, '', 'good estimates in a row after which held offsets follow again', minimum=1, maximum=10000, live=True
    )

    def __post_init__(self) -> None:
        for name, declared in SETTINGS.parameters.items():
            check_value(declared, getattr(self, name), 'compensator')
        if len(set(self.axes)) < len(self.axes):
            raise ConfigError('compensator: axes: none may be there twice')


SETTINGS = Section(CompensatorSettings)


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
        self._offsets = np.zeros(len(arm.names))
        self._wanted = self._offsets
        self._moved_t: float | None = None
        self._joints: FloatArray | None = None
        self._joints_t = -math.inf
        self._held_at: FloatArray | None = None
        self._anchor: tuple[FloatArray, FloatArray] | None = None
        self._away_t: float | None = None
        self._applied: FloatArray | None = None
        self._stop = ''
        self._broken = ''
        self._last: Observed | None = None
        self._last_now = -math.inf
        self._good = settings.good
        self._fault = 'no deflection yet'
        self._residual = math.nan
        self._limited = False

    @property
    def _rows(self) -> list[int]:
        return [AXES.index(axis) for axis in self.settings.axes]

    def enable(self, wanted: bool) -> None:
        """Let the offsets follow from where they are, or let them go back to zero.

        Joints that did not follow keep the offsets held until this is called again.
        """
        if wanted == self.enabled and not self._broken:
            return
        if wanted and not self.enabled and not np.any(self._offsets):
            # With commands the arm keeps the pose that it has now.
            self._held_at = None
            if self._applied is not None and self.settings.output == OFFSETS:
                self._offsets = self._wanted = self._applied.copy()
        self.enabled = wanted
        self._broken = ''
        self._anchor = self._away_t = None

    def stop(self, why: str) -> None:
        """Hold for as long as ``why`` is not '': the robot does not run, or somebody else commands it."""
        self._stop = why

    def applied(self, offsets: FloatArray) -> None:
        """The offsets that the controller says it applies: where ours begin when they are enabled."""
        waited = self.waits
        self._applied = np.array(offsets, dtype=np.float64)
        if waited and self.enabled:
            self._offsets = self._wanted = self._applied.copy()

    def joints(self, now: float, positions: FloatArray) -> None:
        """Where the joints are, offsets included unless ``dry``, in the order of the arm.

        Passed over if one is not finite or beyond ``LARGEST_POSITION``.
        """
        if not np.all(np.abs(positions) <= LARGEST_POSITION):
            return
        seen = np.array(positions, dtype=np.float64)
        before, then = self._joints, self._joints_t
        self._joints, self._joints_t = seen, now
        if before is not None:
            leap = float(np.abs(seen - before).max())
            if leap > self.settings.max_joint_speed * min(max(now - then, 0.02), 1.0):
                self._hold(f'the positions of the joints leap by {leap:.3g}')
        if self.enabled and not self._dry and not self._broken:
            self._broken = self._not_followed(now, seen)
            if self._broken:
                self._hold(self._broken)

    def observe(self, now: float, seen: Observed) -> Command:
        """Take a deflection at the time ``now``; return what :meth:`watch` gave last, with the state of now."""
        before, fault = self._last, self._refusal(now, seen)
        if fault:
            self._hold(fault)
            return self._command()
        if before is not None and seen.t <= before.t:
            return self._command()
        self._last, self._last_now = seen, now - max(seen.age, 0.0)
        if before is not None:
            moved = _vector(before.deflection.inverse() @ seen.deflection)[self._rows]
            if np.abs(moved).max() > self.settings.jump:
                self._hold(f'the deflection jumps by {np.abs(moved).max():.3g}')
        if self._fault:
            self._good += 1
            if self._good < self.settings.good:
                return self._command()
            self._fault = ''
        nominal = self._nominal() if self.enabled else None
        if nominal is not None:
            elapsed = seen.t - before.t if before is not None else 0.0
            self._follow(nominal, seen.deflection, min(max(elapsed, 0.0), LONGEST_S))
        return self._command()

    def watch(self, now: float) -> Command:
        """The offsets to send at the time ``now``. To be called often: here they move, and deflections are missed."""
        if not self._fault:
            stale = self.settings.stale
            if self._stop or self._broken:
                self._hold(self._stop or self._broken)
            elif now - self._last_now > stale:
                self._hold(f'no deflection for {stale:g} s')
            elif now - self._joints_t > stale:
                self._hold(f'no positions of the joints for {stale:g} s')
        elapsed = 0.0 if self._moved_t is None else min(max(now - self._moved_t, 0.0), LONGEST_S)
        self._moved_t = now
        if not self.enabled:
            self._wanted = np.zeros(len(self._offsets))
        elif self._fault:
            self._wanted = self._offsets
        limit = self.settings.max_rate * elapsed
        self._offsets = self._offsets + np.clip(self._wanted - self._offsets, -limit, limit)
        return self._command()

    @property
    def waits(self) -> bool:
        """Whether nothing may be sent yet, because the controller has not told which offsets it applies."""
        settings = self.settings
        return settings.takeover and settings.output == OFFSETS and not self._dry and self._applied is None

    def commands(self) -> FloatArray | None:
        """Positions (n,) of the joints with the offsets; None as long as the joints' own positions are not known."""
        return None if self._held_at is None else self._held_at + self._offsets

    def _command(self) -> Command:
        offsets = self._offsets.copy()
        if not self.enabled:
            if np.any(offsets):
                return Command(offsets, State.RELEASING, 'going back to zero')
            return Command(offsets, State.OFF, self._fault)
        if self._fault:
            return Command(offsets, State.HOLDING, self._fault, self._residual)
        return Command(offsets, State.FOLLOWING, '', self._residual, self._limited)

    def _nominal(self) -> FloatArray | None:
        """Where the joints are to be without offsets; None if that is not known."""
        if self._joints is None or self._dry:
            return self._joints
        if self.settings.output == OFFSETS:
            return self._joints - (self._offsets if self._applied is None else self._applied)
        if self._held_at is None:
            self._held_at = self._joints - self._offsets
        return self._held_at

    def _not_followed(self, now: float, seen: FloatArray) -> str:
        """Why the joints at ``seen`` do not do what the offsets ask for; '' if they do, as far as one can tell."""
        allowed = self.settings.follow_error
        asked = self.commands() if self.settings.output == COMMANDS else None
        if self.settings.output == OFFSETS and self._applied is not None:
            asked, seen = self._offsets, self._applied
        if asked is not None:
            away = np.abs(seen - asked)
            if away.max() <= allowed:
                self._away_t = None
                return ''
            self._away_t = now if self._away_t is None else self._away_t
            worst = int(away.argmax())
            late = now - self._away_t > FOLLOW_S
            return f'{self.arm.names[worst]} is {away[worst]:.3g} from what it was sent' if late else ''
        if self.settings.output == COMMANDS:
            return ''
        # A controller that adds the offsets to motions of its own is only caught if the joints stand still.
        if self._anchor is None:
            self._anchor = self._offsets.copy(), seen
        offsets, joints = self._anchor
        sent = np.abs(self._offsets - offsets).max()
        if sent < allowed:
            return ''
        moved = np.abs(seen - joints).max()
        self._anchor = None
        return 'the joints do not move with the offsets' if moved < MOVED_SHARE * sent else ''

    def _refusal(self, now: float, seen: Observed) -> str:
        settings = self.settings
        finite = all(np.all(np.isfinite(part)) for part in (*seen.deflection, seen.covariance))
        if not finite or not math.isfinite(seen.t):
            return 'the deflection is not finite'
        size = float(np.abs(_vector(seen.deflection)).max())
        if size > settings.max_deflection:
            return f'a deflection of {size:.3g} is more than the links can have'
        variances = np.diag(seen.covariance)[self._rows]
        if variances.min() <= 0.0:
            return 'the deflection does not say how certain it is'
        if math.sqrt(variances.max()) > settings.max_sd:
            return f'the deflection is uncertain by more than {settings.max_sd:g}'
        if abs(seen.age) > settings.stale:
            what = 'is older than' if seen.age > 0.0 else 'has a stamp ahead of our clock by more than'
            return f'the deflection {what} {settings.stale:g} s'
        if self._joints is None or now - self._joints_t > settings.stale:
            return 'the positions of the joints are not known'
        if self.waits:
            return 'the controller has not told the offsets that it applies'
        return self._stop or self._broken

    def _hold(self, fault: str) -> None:
        self._fault, self._good = fault, 0
        self._wanted = self._offsets

    def _follow(self, nominal: FloatArray, deflection: Transform, elapsed: float) -> None:
        """Choose the offsets one step nearer to those at which T(q + o) D is T(q)."""
        settings, rows = self.settings, self._rows
        wanted = self.arm.pose(nominal)
        error = _vector(wanted.inverse() @ self.arm.pose(nominal + self._offsets) @ deflection)[rows]
        measured = error
        if not self._dry and self._joints is not None:
            measured = _vector(wanted.inverse() @ self.arm.pose(self._joints) @ deflection)[rows]
        self._residual = float(np.linalg.norm(measured))
        jacobian = self.arm.jacobian(nominal + self._offsets)
        in_wanted = np.vstack([wanted.rotation.T @ jacobian[:3], wanted.rotation.T @ jacobian[3:]])[rows]
        square = in_wanted.T @ in_wanted + settings.damping**2 * np.eye(len(self._offsets))
        step = -np.linalg.solve(square, in_wanted.T @ error) * -math.expm1(-elapsed / settings.time_constant)
        # A joint that is beyond its limit by itself is not pulled back by us.
        low = np.clip(self.arm.lower - nominal, -settings.max_offset, 0.0)
        high = np.clip(self.arm.upper - nominal, 0.0, settings.max_offset)
        self._wanted = np.clip(self._offsets + step, low, high)
        beyond = np.abs(self._offsets + step - self._wanted).max() > 1e-12
        self._limited = bool(beyond or np.abs(step).max() > settings.max_rate * elapsed * (1.0 + 1e-9))


def _vector(pose: Transform) -> FloatArray:
    """(6,): position and rotation vector."""
    return np.concatenate([pose.position, pose.rotation_vector])
