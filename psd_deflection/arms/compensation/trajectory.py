# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Shapes a joint trajectory as ros2_control interpolates it (line, cubic, quintic): a weighted sum, weights positive
with sum 1, of the same motion begun at the shaper's times, so all bounds hold. What is shaped is the whole history."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PPoly

from psd_deflection.arms.compensation.arm import JointLimits
from psd_deflection.arms.inputs import MeasuredJoint
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.link.shapers import Shaper
from psd_deflection.records import FloatArray

MOST_POINTS = 10_000
MOST_SECONDS = 3600.0
LARGEST = 1e6
"""Of a position, velocity or acceleration, rad or m."""
KINK_S = 1e-3
"""Where a motion is replaced its velocity may leap. A point so long before keeps the leap short, s."""
SAME_S = 1e-6
"""Points of the shaped trajectory that are no further apart are one, s."""
AT_REST = 1e-6
"""Velocity below which a trajectory ends at rest, rad/s or m/s."""
STANDS = 0.05
"""A joint that is measured to be slower than this stands, rad/s or m/s: until a trajectory begins, 0.1 s later by
default, it goes a tenth of what ``max_step`` allows."""
PARTS = 8
"""Parts of each piece of a trajectory whose ends are held against the limits."""
LATE_S = 0.3
"""Joints may be where they were commanded to be so long ago, s: a servo lags, and so do messages."""
OLDEST_S = 1.0
"""A trajectory whose start is longer ago than this is rejected."""
QUANTITIES = ('positions', 'velocities', 'accelerations')


class JointsError(ConfigError):
    """The trajectory is of joints that cannot be: not named, not known, or other ones are under way."""


class MovingError(ConfigError):
    """The trajectory would begin at rest, while the joints still move, or are not known for long enough."""


class OldStampError(ConfigError):
    """The trajectory should have begun too long ago."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """``times`` (n,), s from the start, rising. ``states`` (n, k, j) of j joints: positions, rad or m; then velocities
    if k > 1, accelerations if k > 2."""

    names: tuple[str, ...]
    times: FloatArray
    states: FloatArray

    @property
    def duration(self) -> float:
        """Time of the last point, s."""
        return float(self.times[-1])

    @functools.cached_property
    def _curve(self) -> PPoly:
        """Position over time, of two points or more: a polynomial from each point to the next."""
        h = np.diff(self.times)[:, None]
        orders = self.states.shape[1]
        (p, v, a), (p1, v1, a1) = (
            [side[:, k] if k < orders else 0.0 for k in range(3)] for side in (self.states[:-1], self.states[1:])
        )
        d = (p1 - p) / h
        if orders == 1:
            powers = [d, p]
        elif orders == 2:
            powers = [(v + v1 - 2.0 * d) / h**2, (3.0 * d - 2.0 * v - v1) / h, v, p]
        else:
            powers = [
                (6.0 * d - 3.0 * (v + v1) + 0.5 * (a1 - a) * h) / h**4,
                (8.0 * v + 7.0 * v1 - 15.0 * d + (1.5 * a - a1) * h) / h**3,
                (10.0 * d - 6.0 * v - 4.0 * v1 + (0.5 * a1 - 1.5 * a) * h) / h**2,
                0.5 * a,
                v,
                p,
            ]
        return PPoly(np.stack(powers), self.times)

    def at(self, times: FloatArray) -> FloatArray:
        """States (m, k, j) at ``times`` (m,), s from the start: before the first point and from the last on at rest."""
        points, orders, joints = self.states.shape
        out = np.zeros((len(times), orders, joints))
        out[:, 0] = np.where((times < self.times[0])[:, None], self.states[0, 0], self.states[-1, 0])
        inside = (times >= self.times[0]) & (times < self.times[-1])
        if points > 1 and inside.any():
            for order in range(orders):
                out[inside, order] = self._curve(times[inside], nu=order)
        return out

    def fastest(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Least and largest position and largest speed of each joint, (j,) each."""
        if len(self.times) == 1:
            return self.states[0, 0], self.states[0, 0], np.zeros(self.states.shape[2])
        parts = np.arange(PARTS) / PARTS
        at = np.append((self.times[:-1, None] + np.diff(self.times)[:, None] * parts).ravel(), self.times[-1])
        positions, speeds = self._curve(at), np.abs(self._curve(at, nu=1))
        return positions.min(axis=0), positions.max(axis=0), speeds.max(axis=0)

    def ordered(self, names: Sequence[str]) -> Trajectory:
        """The same with its joints in another order."""
        return Trajectory(tuple(names), self.times, self.states[:, :, [self.names.index(n) for n in names]])


def checked(names: Sequence[str], times: Sequence[float], points: Sequence[Sequence[Sequence[float]]]) -> Trajectory:
    """The trajectory of ``points``: positions, velocities, accelerations of each, empty if it has none.

    Raises ConfigError with the reason for one that cannot be followed.
    """
    if not names or len(set(names)) < len(names) or not all(names):
        raise JointsError('joint_names: must be at least one, none empty and none twice')
    if not 0 < len(points) <= MOST_POINTS:
        raise ConfigError(f'points: there are {len(points)}, must be 1 to {MOST_POINTS}')
    orders = next((k for k, values in enumerate(points[0]) if not len(values)), len(points[0]))
    if not orders:
        raise ConfigError('point 0 has no positions')
    for i, point in enumerate(points):
        for k, values in enumerate(point):
            wanted = len(names) if k < orders else 0
            if len(values) != wanted:
                raise ConfigError(f'point {i} has {len(values)} {QUANTITIES[k]}, must be {wanted} as of the others')
    states = np.array([[list(values) for values in point[:orders]] for point in points], dtype=np.float64)
    # NaN is no number within the bound.
    invalid = np.argwhere(~(np.abs(states) <= LARGEST))
    if len(invalid):
        raise ConfigError(f'point {invalid[0, 0]} is not finite, or beyond {LARGEST:g}')
    at = np.array(times, dtype=np.float64)
    late = np.flatnonzero(~(np.diff(at, prepend=-KINK_S) >= KINK_S * (1.0 - 1e-6)))
    if len(late):
        raise ConfigError(
            f'point {late[0]}: time_from_start = {at[late[0]]:g} s: must be {KINK_S:g} s after the point before it'
        )
    if at[-1] > MOST_SECONDS:
        raise ConfigError(f'it takes {at[-1]:g} s, must be at most {MOST_SECONDS:g} s')
    if orders > 1 and np.abs(states[-1, 1]).max() > AT_REST:
        joint = int(np.abs(states[-1, 1]).argmax())
        raise ConfigError(f'it ends in motion: {names[joint]} at {states[-1, 1, joint]:g} rad/s or m/s')
    if orders > 1:
        states[-1, 1] = 0.0
    return Trajectory(tuple(names), at, states)


def start_of(now_ns: int, stamp_ns: int, lead: float) -> int:
    """When a trajectory with this stamp (0: at once) begins, ns: not before it has arrived, which takes ``lead`` s.

    One that began earlier than it arrived would begin in its middle. Raises ConfigError if its stamp is too old.
    """
    ago = (now_ns - stamp_ns) / 1e9
    if stamp_ns and ago > OLDEST_S:
        raise OldStampError(f'its stamp is {ago:.3g} s old, must be at most {OLDEST_S:g} s (or 0, for at once)')
    return max(stamp_ns, now_ns + round(1e9 * lead))


class _Piece(NamedTuple):
    """A trajectory that was commanded from ``start_ns`` on, until the next piece."""

    start_ns: int
    path: Trajectory


class TrajectoryShaper:
    """``max_step``: a trajectory may begin so far from where the joints are, or are commanded, rad or m.

    ``limits``: of joints by name; what is given must be within them, and other joints are rejected. ``history``: what
    was commanded and is not over. Owns no clock; for one thread.
    """

    def __init__(self, shaper: Shaper, limits: Mapping[str, JointLimits] | None = None, max_step: float = 0.05) -> None:
        self.shaper = shaper
        self.max_step = max_step
        self.limits: Mapping[str, JointLimits] = dict(limits or {})
        self.history: tuple[_Piece, ...] = ()

    def forget(self) -> None:
        """The motion was stopped: the next trajectory begins at rest."""
        self.history = ()

    def moves(self, t_ns: int) -> bool:
        """Whether a shaped trajectory is under way."""
        if not self.history:
            return False
        start_ns, path = self.history[-1]
        return (t_ns - start_ns) / 1e9 < path.duration + self.shaper.duration

    def joints_fault(self, now_ns: int, measured: Mapping[str, MeasuredJoint]) -> str:
        """Why the joints are not where the last trajectory has them; '' if each of them is within ``max_step`` of where
        it was commanded to be at some time of the last ``LATE_S``, or is not measured."""
        if not self.history:
            return ''
        names = self.history[-1].path.names
        pieces = [_Piece(t, path.ordered(names)) for t, path in self.history]
        commanded = self._shaped(pieces, now_ns, np.linspace(-LATE_S, 0.0, 31), 1)[:, 0]
        for name, way in zip(names, commanded.T, strict=True):
            at = measured[name].position if name in measured else way[-1]
            if max(way.min() - at, at - way.max()) > self.max_step:
                away = abs(at - way[-1])
                return (
                    f'{name} is {away:.3g} rad or m from where the last trajectory has it: does the controller follow?'
                )
        return ''

    def shape(self, start_ns: int, given: Trajectory, measured: Mapping[str, MeasuredJoint]) -> Trajectory:
        """``given`` shaped, both from ``start_ns`` on. ``measured``: the joints; one that is to move must be known.

        A trajectory without a point at 0 begins where the one before it is, or at the measured positions, if the joints
        stand there: joints that still move, by a command that is forgotten, would be pulled back to where they were.
        Raises ConfigError with the reason; then nothing has changed.
        """
        moves = self.moves(start_ns)
        pieces = [p for p in self.history if p.start_ns < start_ns] if moves else []
        # One that begins earlier than what is kept takes its place.
        if pieces and set(pieces[-1].path.names) != set(given.names):
            raise JointsError('other joints are under way: ' + ', '.join(pieces[-1].path.names))
        pieces = [_Piece(t, path.ordered(given.names)) for t, path in pieces]
        given = self._begun(start_ns, given, pieces, measured)
        self._check_limits(given)
        pieces.append(_Piece(start_ns, given))
        out = self._sum(start_ns, pieces)
        # What was replaced longer ago than the shaper looks back is over.
        replaced = [start_ns - p.start_ns for p in pieces[1:]] + [0]
        self.history = tuple(p for p, ago in zip(pieces, replaced, strict=True) if ago / 1e9 <= self.shaper.duration)
        return out

    def _begun(
        self, start_ns: int, given: Trajectory, pieces: Sequence[_Piece], measured: Mapping[str, MeasuredJoint]
    ) -> Trajectory:
        """``given`` with a point at 0. Raises ConfigError if it begins elsewhere than the joints are."""
        here = np.zeros_like(given.states[:1])
        if pieces:
            here[0] = _state(pieces, start_ns, np.zeros(1), given.states.shape[1])[0]
        else:
            missing = next((name for name in given.names if name not in measured), None)
            if missing is not None:
                raise JointsError(f'the position of {missing} is not known')
            here[0, 0] = [measured[name].position for name in given.names]
            for name in given.names:
                # NaN is not slow.
                if not (speed := measured[name].speed) < STANDS:
                    still = 'is known too shortly' if math.isnan(speed) else f'still moves, at {speed:.3g} rad/s or m/s'
                    raise MovingError(f'{name} {still}: a trajectory begins at rest, or goes on from the one before it')
        if given.times[0] > 0.0:
            return Trajectory(given.names, np.append(0.0, given.times), np.concatenate([here, given.states]))
        away = np.abs(given.states[0, 0] - here[0, 0])
        joint = int(away.argmax())
        if away[joint] > self.max_step:
            where = 'is commanded' if pieces else 'is'
            raise ConfigError(
                f'it begins {away[joint]:.3g} rad or m from where {given.names[joint]} {where}, '
                f'must be at most {self.max_step:g}'
            )
        if pieces and len(given.times) > 1:
            # Its own first point would be a step, if a small one.
            return Trajectory(given.names, given.times, np.concatenate([here, given.states[1:]]))
        return given

    def _check_limits(self, given: Trajectory) -> None:
        low, high, speed = given.fastest()
        for j, name in enumerate(given.names):
            if not self.limits:
                return
            limits = self.limits.get(name)
            if limits is None:
                raise JointsError(f'{name}: the URDF file has no joint of that name that moves')
            for value, bound, word in ((low[j], limits.lower, 'least'), (high[j], limits.upper, 'most')):
                if (value < bound - AT_REST) if word == 'least' else (value > bound + AT_REST):
                    raise ConfigError(f'{name} goes to {value:.4g}, must be at {word} {bound:g} rad or m')
            if speed[j] > limits.speed + AT_REST:
                raise ConfigError(f'{name} is as fast as {speed[j]:.4g}, must be at most {limits.speed:g} rad/s or m/s')

    def _sum(self, start_ns: int, pieces: Sequence[_Piece]) -> Trajectory:
        """The shaped trajectory from ``start_ns`` on."""
        given = pieces[-1].path
        orders = given.states.shape[1]
        shifts = np.array(self.shaper.times)
        end = given.duration + self.shaper.duration
        ends_ns = [p.start_ns for p in pieces[1:]] + [start_ns + round(1e9 * end)]
        points, seams = [np.array([0.0, end])], []
        for piece, end_ns in zip(pieces, ends_ns, strict=True):
            begun = (piece.start_ns - start_ns) / 1e9
            knots = begun + piece.path.times
            points.append((knots[knots <= (end_ns - start_ns) / 1e9, None] + shifts).ravel())
            seams.append((np.array([begun, begun + piece.path.duration])[:, None] + shifts).ravel())
        seam = np.concatenate(seams)
        leap = self._shaped(pieces, start_ns, seam, orders) - self._shaped(pieces, start_ns, seam - SAME_S, orders)
        # In a microsecond a smooth motion goes some micrometres at most.
        bound = 1e-4 if orders > 1 else 1e-5
        points += [seam, seam[np.abs(leap).reshape(len(seam), -1).max(axis=1) > bound] - KINK_S]
        at = np.sort(np.concatenate(points))
        at = at[np.diff(at, prepend=-1.0) > SAME_S]
        at = at[(at > SAME_S) & (at < end - SAME_S)]
        at = np.concatenate([[0.0], at, [end]]) if end > 0.0 else np.zeros(1)
        states = self._shaped(pieces, start_ns, at, orders)
        states[-1, 0] = given.states[-1, 0]
        if len(pieces) == 1:
            states[0, 0] = given.states[0, 0]
        return Trajectory(given.names, at, states)

    def _shaped(self, pieces: Sequence[_Piece], start_ns: int, at: FloatArray, orders: int) -> FloatArray:
        out = np.zeros((len(at), orders, len(pieces[-1].path.names)))
        for time, size in zip(self.shaper.times, self.shaper.sizes, strict=True):
            out += size * _state(pieces, start_ns, at - time, orders)
        return out


def _state(pieces: Sequence[_Piece], start_ns: int, at: FloatArray, orders: int) -> FloatArray:
    """What ``pieces`` command, unshaped, (m, orders, j), at the times ``at`` (m,), s from ``start_ns``."""
    out = np.zeros((len(at), orders, len(pieces[-1].path.names)))
    for i, (begun_ns, path) in enumerate(pieces):
        # To the nanosecond: a sum of times hits a point again.
        since = np.round(at + (start_ns - begun_ns) / 1e9, 9)
        used = np.full(len(at), True) if i == 0 else since >= 0.0
        states = path.at(since[used])
        same = min(orders, states.shape[1])
        out[used] = 0.0
        out[used, :same] = states[:, :same]
    return out
