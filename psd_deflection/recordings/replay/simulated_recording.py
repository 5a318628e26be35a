# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A simulated recording in memory: what :func:`psd_deflection.simulate` returns. It has no estimates: replay it."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.detector import counts_to_volts
from psd_deflection.model.simulation.simulator import RigSimulator, SimulatedStep
from psd_deflection.recordings.in_memory import RecordingInMemory
from psd_deflection.records import (
    AppliedLoad,
    FloatArray,
    IntArray,
    RawChunk,
    Record,
    ReferencePose,
    TemperatureReading,
)
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


CHUNK_SECONDS = 1.0

BAG_START_NS = 1_000_000_000
"""Stamps of a simulated bag start here: many tools treat zero as "no stamp"."""


@dataclass(frozen=True)
class SimulatedRun:
    """One run. ``rig``: the true rig. ``known``: the rig that the daemon assumes; only its effects are corrected.

    ``loads`` (n, 3): N, N, N m, one row a sample. ``temperature`` (n,): degrees Celsius, or None.
    ``reference``: whether the true pose is recorded, once per block; ``reference_noise``: its standard deviations, m,
    m, rad.
    """

    rig: Rig
    known: Rig
    loads: FloatArray
    temperature: FloatArray | None = None
    seed: int = 0
    reference: bool = False
    reference_noise: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def records(self, start_ns: int = BAG_START_NS) -> Iterator[Record]:
        """All records in order of time; the first sample is at ``start_ns``."""
        rig, loads, temperature = self.rig, self.loads, self.temperature
        simulator, pipeline = RigSimulator(rig, self.seed), Pipeline(self.known)
        measured = np.random.default_rng([self.seed, 1])
        period = 1e9 / rig.converter.sample_rate_hz
        block = rig.estimator.block_size
        # A temperature takes effect with the next block, so process block by block.
        size = max(1, round(CHUNK_SECONDS * rig.converter.sample_rate_hz)) if temperature is None else block
        made = simulator.step(loads, temperature) if simulator.ahead else None
        last: tuple[float, ...] | None = None
        last_temperature: float | None = None
        for start in range(0, len(loads), size):
            stop = min(start + size, len(loads))
            seq = np.arange(start, stop, dtype=np.int64)
            t_ns = start_ns + np.rint(seq * period).astype(np.int64)
            for i in range(start, stop):
                load = (float(loads[i, 0]), float(loads[i, 1]), float(loads[i, 2]))
                if load != last:
                    last = load
                    applied = AppliedLoad(int(t_ns[i - start]), *load)
                    yield applied
                    # It acts from its stamp on: what replays the recording needs no note of the block.
                    pipeline.load(applied)
                # One temperature reading per estimate is enough: air temperature changes slowly.
                if temperature is not None and i % block == 0 and float(temperature[i]) != last_temperature:
                    last_temperature = float(temperature[i])
                    yield TemperatureReading(int(t_ns[i - start]), last_temperature)
                    warmer = pipeline.temperature(last_temperature)
                    if warmer is not None:
                        yield warmer
            if made is None:
                part = simulator.step(loads[start:stop], None if temperature is None else temperature[start:stop])
            else:
                part = SimulatedStep(made.counts[start:stop], made.pose[start:stop], made.dots[start:stop])
            if self.reference:
                for i in range(0, stop - start, block):
                    # The estimate is for the middle of the block.
                    k = min(i + block // 2, stop - start - 1)
                    off = self.reference_noise * measured.standard_normal(3)
                    yield ReferencePose(int(t_ns[k]), *(float(v) for v in part.pose[k] + off))
            flags = np.zeros(stop - start, dtype=np.uint8)
            yield from pipeline.process(RawChunk(seq, t_ns, part.counts, flags, rig.converter.volts_per_count))
        yield from pipeline.flush()
