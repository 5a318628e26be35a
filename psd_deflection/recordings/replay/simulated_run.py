# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A simulated recording: the samples of the rig, and the estimates that the daemon computes from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import (
    AppliedLoad,
    FloatArray,
    RawChunk,
    Record,
    ReferencePose,
    TemperatureReading,
)
from psd_deflection.rig.config import Rig

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
            part = simulator.step(loads[start:stop], None if temperature is None else temperature[start:stop])
            if self.reference:
                for i in range(0, stop - start, block):
                    # The estimate is for the middle of the block.
                    k = min(i + block // 2, stop - start - 1)
                    off = self.reference_noise * measured.standard_normal(3)
                    yield ReferencePose(int(t_ns[k]), *(float(v) for v in part.pose[k] + off))
            flags = np.zeros(stop - start, dtype=np.uint8)
            yield from pipeline.process(RawChunk(seq, t_ns, part.counts, flags, rig.converter.volts_per_count))
        yield from pipeline.flush()
