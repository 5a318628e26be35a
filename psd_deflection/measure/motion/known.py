# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Loads that other nodes announce: what they do to the tip from their stamps on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from psd_deflection.measure.motion.modal import Oscillator
from psd_deflection.measure.state import mismatch
from psd_deflection.records import AppliedLoad, FloatArray

DOUBT = 0.05
"""Share by which the deflection of a known load may differ from the rig file's link, one standard
deviation."""
MOST_LOADS = 1000
"""So many known loads may wait for samples."""


class Pushed(NamedTuple):
    """What the known loads of a block do.

    ``samples`` (3, N): to each sample, m, m, rad. ``end`` (3, 4): to the state at its end.
    ``variance`` (3,): what they add to that of the static deflection.
    """

    samples: FloatArray
    end: FloatArray
    variance: FloatArray


class KnownLoads:
    """The load that acts, and those whose stamps lie ahead of the samples.

    ``modes``: of dX, dY and theta. ``compliance`` (3,): m/N, m/N, rad/(N m). ``size``: samples of a
    block; ``period``: of them, s. ``held`` (3,): the load that acts, N, N, N m; None if none was
    told.
    """

    def __init__(self, modes: Sequence[Oscillator], compliance: FloatArray, size: int, period: float) -> None:
        self._modes, self._compliance = modes, compliance
        self._size, self._period = size, period
        self._waiting: list[AppliedLoad] = []
        self.held: FloatArray | None = None

    def __bool__(self) -> bool:
        """Whether any load is known."""
        return self.held is not None or bool(self._waiting)

    def is_new(self, load: AppliedLoad) -> bool:
        """Whether ``load`` differs from the last one that was reported."""
        if self._waiting:
            return load[1:] != self._waiting[-1][1:]
        return self.held is None or load[1:] != tuple(self.held.tolist())

    def add(self, load: AppliedLoad) -> None:
        """Take a load that acts from its stamp on; if more than ``MOST_LOADS`` wait, the oldest is forgotten."""
        self._waiting.append(load)
        del self._waiting[:-MOST_LOADS]

    def pushed(self, t_ns: int, first: bool) -> Pushed | None:
        """What the loads do in the block whose middle is ``t_ns``; None if none waits. ``first``: of a run."""
        if not self._waiting:
            return None
        period_ns = 1e9 * self._period
        end_ns = t_ns + round(0.5 * (self._size - 1) * period_ns)
        samples, end, variance = np.zeros((3, self._size)), np.zeros((3, 4)), np.zeros(3)
        while self._waiting and self._waiting[0].t_ns <= end_ns:
            load = self._waiting.pop(0)
            before, self.held = self.held, np.array(load[1:])
            since = self._period * self._size - (end_ns - load.t_ns) / 1e9
            # The first one may have acted before the run. One from before these samples was seen in
            # earlier ones.
            if first or before is None or since < 0.0:
                continue
            step = self._compliance * (self.held - before)
            variance = variance + np.square(DOUBT * step)
            for a, mode in enumerate(self._modes):
                pushed = step[a] * mode.pushed(self._period * np.arange(1.0, self._size + 1.0) - since)[:, 0]
                samples[a] += pushed[:, 0]
                end[a] += pushed[-1]
        return Pushed(samples, end, variance)

    def state(self) -> tuple[tuple[float, ...], list[float]]:
        """The load that acts, with whether there is one, four numbers; and those that wait, five numbers each."""
        held = (1.0, *self.held.tolist()) if self.held is not None else (0.0,) * 4
        return held, [v for load in self._waiting for v in (*split_ns(load.t_ns), *load[1:])]

    def load_state(self, name: str, values: tuple[float, ...]) -> None:
        """Go on from another one's :meth:`state_dict`. Raises ValueError, which names ``name``, for a wrong length."""
        if len(values) < 4 or (len(values) - 4) % 5:
            raise mismatch(name, values, 'four numbers and five for each load that waits')
        self.held = np.array(values[1:4]) if values[0] else None
        waiting = np.reshape(values[4:], (-1, 5)).tolist()
        self._waiting = [AppliedLoad(joined_ns(s, ns), fx, fy, tz) for s, ns, fx, fy, tz in waiting]


def split_ns(t_ns: int) -> tuple[float, float]:
    """Seconds and nanoseconds: one float does not hold a time to the nanosecond."""
    return float(t_ns // 1_000_000_000), float(t_ns % 1_000_000_000)


def joined_ns(seconds: float, ns: float) -> int:
    """The time that :func:`split_ns` split."""
    return 1_000_000_000 * int(seconds) + int(ns)
