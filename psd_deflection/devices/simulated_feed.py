"""The simulated rig's converter readings one by one, for every device that is simulated."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from psd_deflection.config import Rig
from psd_deflection.records import FloatArray
from psd_deflection.simulation.simulator import RigSimulator

BATCH = 50

LoadSource = Callable[[int, int], FloatArray]
"""``loads(first_sample, n)`` -> (n, 3): Fx, Fy N and Tz N m held before each sample."""


class RigFeed:
    """One row of counts a sample period; made in batches, which is what the simulation is quick at."""

    def __init__(self, rig: Rig, loads: LoadSource, seed: int) -> None:
        self._simulator = RigSimulator(rig, seed)
        self._loads = loads
        self._batch: Iterator[list[int]] = iter(())
        self._row: list[int] = []
        self.taken = 0

    def next(self) -> list[int]:
        """The next sample: x1 y1 sum1 x2 y2 sum2, counts."""
        row = next(self._batch, None)
        if row is None:
            self._batch = iter(self._simulator.step(self._loads(self.taken, BATCH)).counts.tolist())
            row = next(self._batch)
        self.taken += 1
        self._row = row
        return row

    def at(self, number: int) -> list[int]:
        """Sample ``number``, not before the last one asked for: what a device that is polled sees."""
        while self.taken <= number:
            self.next()
        return self._row
