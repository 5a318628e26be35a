# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What known accelerations of the link's base do to its tip.

``link_tip_rest`` moves with the base, and the tip lags behind by its inertia. With a the acceleration that the tip
would have if the link were rigid, each of dX, dY and theta obeys

    q'' + 2 zeta w q' + w^2 (q - u) = -a,

as if u were u - a / w^2. Of a base with acceleration b and angular acceleration alpha, both in ``link_base``, a is
b + alpha x L e_z for dX and dY, and alpha_z for theta (kinematics of a rigid body). Centripetal and Coriolis terms are
left out, and so is the mass of the link beside that of its tip.
"""

import bisect
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from psd_deflection.measure.motion.modal import Oscillator
from psd_deflection.records import BaseAcceleration, FloatArray

HOLD_NS = 100_000_000
"""An acceleration holds until the next one, but no longer than this. Then it is 0."""
AHEAD_NS = 10_000_000_000
"""Longest time that an acceleration may arrive before it acts, ns."""
MOST_REPORTED = 100_000
"""Accelerations that may wait for their samples."""
SHARE = 0.05
"""Share by which a change of what accelerations do may differ from this model, one standard deviation."""
CHANGE_SHARE = 0.1
"""Share of a change of acceleration by which the velocity is unsure (:meth:`Inertia.unsure`)."""
LARGEST = 1e4
"""m/s^2 or rad/s^2: a larger one is a mistake."""


class Forced(NamedTuple):
    """What accelerations do from rest: ``at`` (3, n, 4) the state of :mod:`psd_deflection.measure.motion.modal` at n
    times.

    u and r in it are 0. ``doubt`` (3,): by how much the static deflection may differ from the model, for the changes
    in this time: one standard deviation, m, m, rad.
    """

    at: FloatArray
    doubt: FloatArray


class Inertia:
    """Keeps the accelerations that may still act.

    ``reported``: time (ns) and static deflection (m, m, rad) of each, in order. ``count``: how many came so far,
    ``late``: how many of them after samples on which they acted, ``ended``: how many were not 0 and had no other after
    them in time.
    """

    def __init__(self, modes: Sequence[Oscillator], length: float) -> None:
        """``modes``: of dX, dY, theta. ``length``: L, m."""
        self._modes = modes
        self._length = length
        self._gives = np.array([-1.0 / mode.xp.square(mode.w) for mode in modes])
        self.reported: list[tuple[int, tuple[float, ...]]] = []  # Bound: MOST_TOLD.
        self.ended = 0
        self.late = 0
        self.count = 0

    @property
    def known(self) -> bool:
        """Whether anything was reported that may still act."""
        return bool(self.reported)

    def notify(self, new: BaseAcceleration, there_ns: int) -> None:
        """One more. Of two with the same stamp the later one counts. ``there_ns``: just after the last block.

        Raises ValueError if it acts too long before or after that, or is too large.
        """
        for name, vector in (('linear', new.linear), ('angular', new.angular)):
            for axis, value in zip('xyz', vector, strict=True):
                if not abs(value) <= LARGEST:
                    raise ValueError(f'accel.{name}.{axis} is {value:g}, the bound is {LARGEST:g} either way')
        away_ns = new.t_ns - there_ns
        if away_ns < -HOLD_NS:
            raise ValueError(
                f'header.stamp is {-away_ns / 1e9:.3f} s before the last sample, and an acceleration holds for '
                f'{HOLD_NS / 1e9:g} s: are the clocks of both computers the same?'
            )
        if away_ns > AHEAD_NS:
            raise ValueError(
                f'header.stamp is {away_ns / 1e9:.3f} s after the last sample; one may come {AHEAD_NS / 1e9:g} s '
                'before it acts'
            )
        if len(self.reported) >= MOST_REPORTED:
            raise ValueError(f'{MOST_REPORTED} accelerations wait already for their samples')
        self.count += 1
        self.late += new.t_ns < there_ns
        (x, y, _), (ax, ay, az) = new.linear, new.angular
        deflection = self._gives * (x + self._length * ay, y - self._length * ax, az)
        there = bisect.bisect_left(self.reported, new.t_ns, key=lambda entry: entry[0])
        same = there < len(self.reported) and self.reported[there][0] == new.t_ns
        self.reported[there : there + same] = [(new.t_ns, tuple(deflection.tolist()))]

    def forget_before(self, t_ns: int) -> None:
        """Keep what acts from ``t_ns`` on."""
        while (
            self.reported and (self.reported[1][0] if len(self.reported) > 1 else self.reported[0][0] + HOLD_NS) <= t_ns
        ):
            until = self.reported[0][0] + HOLD_NS
            self.ended += any(self.reported[0][1]) and (len(self.reported) == 1 or self.reported[1][0] > until)
            del self.reported[0]

    def _changes(self) -> Iterator[tuple[int, FloatArray, float]]:
        """Time, static deflection from then on, and the share of its change that is doubted."""
        until: int | None = None
        for k, (t_ns, deflection) in enumerate(self.reported):
            # Nobody knows for how long it acted unsaid.
            yield t_ns, np.array(deflection), SHARE if until is not None and t_ns <= until else 1.0
            until = t_ns + HOLD_NS
            if k + 1 == len(self.reported) or self.reported[k + 1][0] > until:
                yield until, np.zeros(3), 1.0

    def unsure(self, t_ns: int) -> FloatArray:
        """Standard deviation (3,) of q'/w at ``t_ns``: an acceleration is a mean over the time until the next one.

        If it changes there evenly, or by a step at any one time, the velocity is off by a tenth of the change times
        that time, root mean square, at three quarters of it; at its end by nothing.
        """
        there = bisect.bisect_right(self.reported, t_ns, key=lambda entry: entry[0])
        if there < 2:
            return np.zeros(3)
        (before_ns, before), (now_ns, now) = self.reported[there - 2 : there]
        seconds = min(now_ns - before_ns, HOLD_NS) / 1e9
        w = np.array([mode.w for mode in self._modes])
        return np.asarray(CHANGE_SHARE * np.abs(np.subtract(now, before)) * w * seconds)

    def forced(self, begin_ns: int, seconds: FloatArray) -> Forced:
        """At ``seconds`` (n,) after ``begin_ns``, the last one latest, from rest then."""
        end_ns = begin_ns + round(1e9 * float(seconds[-1]))
        held, doubt = np.zeros(3), np.zeros(3)
        since, sizes = [0.0], [held]
        for t_ns, deflection, share in self._changes():
            if t_ns > end_ns:
                break
            if t_ns <= begin_ns:
                sizes[0] = deflection
            else:
                since.append((t_ns - begin_ns) / 1e9)
                sizes.append(deflection - held)
                doubt = doubt + share * np.abs(deflection - held)
            held = deflection
        times = (seconds[:, None] - np.array(since)).ravel()
        at = np.zeros((3, len(seconds), 4))
        for a, mode in enumerate(self._modes):
            pushed = mode.pushed(times)[:, 0, :2].reshape(len(seconds), len(since), 2)
            at[a, :, :2] = mode.xp.einsum('nsc,s->nc', pushed, np.array(sizes)[:, a])
        return Forced(at, doubt)
