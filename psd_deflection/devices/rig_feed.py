# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The simulated rig's converter readings one by one, for all simulated devices."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.rig.wiring import Wiring

BATCH = 50

LoadSource = Callable[[int, int], FloatArray]
"""``loads(first_sample, n)`` -> (n, 3): Fx, Fy N and Tz N m held before each sample."""


class RigFeed:
    """Gives one row of counts per sample period; computed in batches, which is faster.

    ``taken``: rows given so far. ``dark``: (PSD, from 1, first, end) of the samples without laser light,
    for demonstrations and golden recordings. ``poses``: a list that gets the true poses (n, 3) of each
    batch, or None.
    """

    def __init__(
        self, rig: Rig, loads: LoadSource, *, seed: int = 0, dark: Sequence[tuple[int, int, int]] = ()
    ) -> None:
        self.rig = rig
        self.taken = 0
        self.poses: list[FloatArray] | None = None
        self._simulator = RigSimulator(rig, seed)
        self._loads = loads
        self._dark = dark
        self._wiring = Wiring.from_rig(rig)
        self._batch: Iterator[list[int]] = iter(())
        self._row: list[int] = []

    def next(self) -> list[int]:
        """The next sample: x1 y1 sum1 x2 y2 sum2 ..., counts."""
        row = next(self._batch, None)
        if row is None:
            self._batch = self._make()
            row = next(self._batch)
        self.taken += 1
        self._row = row
        return row

    def at(self, number: int) -> list[int]:
        """Sample ``number``, for devices that are polled. Numbers must not decrease from call to call."""
        while self.taken <= number:
            self.next()
        return self._row

    def _make(self) -> Iterator[list[int]]:
        chunk = self._simulator.step(self._loads(self.taken, BATCH))
        counts = np.array(chunk.counts)
        numbers = np.arange(self.taken, self.taken + BATCH)
        for psd, start, stop in self._dark:
            off = (numbers >= start) & (numbers < stop)
            first = 3 * (self._wiring.input_of(psd) - 1)
            columns = slice(first, first + 3)
            # Without light the quotient is undefined: only noise is left.
            counts[off, columns] = counts[off, columns] % 13 - 6
        if self.poses is not None:
            self.poses.append(chunk.pose)
        return iter(counts.tolist())
