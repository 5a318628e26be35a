# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A simulated recording in memory: what :func:`psd_deflection.simulate` returns. It has no estimates: replay it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psd_deflection.model.detector import counts_to_volts
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.in_memory import RecordingInMemory
from psd_deflection.records import AppliedLoad, FloatArray, IntArray, RawChunk, ReferencePose, TemperatureReading
from psd_deflection.rig.config import Rig


class SimulatedRecording(RecordingInMemory):
    """The samples of a simulated rig. ``rig``: the true one, with hidden effects; ``known``: what the recording names.

    ``loads_applied`` (n, 3): N, N, N m, one row a sample. ``temperature`` (n,): degrees Celsius, or None.
    ``pose`` (n, 3): the true dX m, dY m, theta rad at each sample. ``dots`` (n, 4): the true x1 y1 x2 y2 on the
    plate, m. The same rig, loads and ``seed`` give the same samples.
    """

    def __init__(
        self, rig: Rig, known: Rig, loads: FloatArray, temperature: FloatArray | None = None, seed: int = 0
    ) -> None:
        simulated = RigSimulator(rig, seed).step(loads, temperature)
        n = len(loads)
        seq = np.arange(n, dtype=np.int64)
        t_ns = np.rint(seq * (1e9 / rig.converter.sample_rate_hz)).astype(np.int64)
        volts = counts_to_volts(simulated.counts, rig.converter.volts_per_count)
        warm = [] if temperature is None else _at_changes(t_ns, temperature[:, None])
        super().__init__(
            Path('simulated'),
            None,
            RawChunk(seq, t_ns, volts, np.zeros(n, dtype=np.uint8)),
            loads=[AppliedLoad(t, *load) for t, load in _at_changes(t_ns, loads)],
            temperatures=[TemperatureReading(t, *value) for t, value in warm],
        )
        self.parameters = known.flat()
        self.rig, self.known, self.loads_applied, self.temperature = rig, known, loads, temperature
        self.pose, self.dots = simulated.pose, simulated.dots

    def references(self) -> list[ReferencePose]:
        """The true pose at every sample."""
        times = self._samples.t_ns.tolist()
        return [ReferencePose(t, *p) for t, p in zip(times, self.pose.tolist(), strict=True)]

    @property
    def digest(self) -> str:
        """Nothing: it is in memory."""
        return ''


def _at_changes(t_ns: IntArray, values: FloatArray) -> list[tuple[int, list[float]]]:
    """Time and values (n, m) of the first sample and of each whose values differ from those before it."""
    changed = np.flatnonzero(np.any(np.diff(values, axis=0, prepend=np.nan) != 0.0, axis=1))
    return list(zip(t_ns[changed].tolist(), values[changed].tolist(), strict=True))
