"""A simulated recording in memory: what :func:`psd_deflection.simulate` returns. It has no estimates: replay it."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from msg_adapters import LOAD, REFERENCE, SAMPLES, TEMPERATURE
from psd_deflection.model.detector import counts_to_volts
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.read.mcap_reader import RawMessage
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import AppliedLoad, FloatArray, RawChunk, ReferencePose, TemperatureReading
from psd_deflection.rig.config import Rig


class SimulatedRecording(Recording):
    """The samples of a simulated rig. ``rig``: the true one, with hidden effects; ``known``: what the recording names.

    ``loads_applied`` (n, 3): N, N, N m, one row a sample. ``temperature`` (n,): degrees Celsius, or None.
    ``pose`` (n, 3): the true dX m, dY m, theta rad at each sample. ``dots`` (n, 4): the true x1 y1 x2 y2 on the
    plate, m. The same rig, loads and ``seed`` give the same samples.
    """

    temperatures_held = True

    def __init__(
        self, rig: Rig, known: Rig, loads: FloatArray, temperature: FloatArray | None = None, seed: int = 0
    ) -> None:
        super().__init__(Path('simulated'), None)
        self.parameters = known.flat()
        self.rig, self.known, self.loads_applied, self.temperature = rig, known, loads, temperature
        simulated = RigSimulator(rig, seed).step(loads, temperature)
        self.pose, self.dots = simulated.pose, simulated.dots
        n = len(loads)
        seq = np.arange(n, dtype=np.int64)
        t_ns = np.rint(seq * (1e9 / rig.converter.sample_rate_hz)).astype(np.int64)
        volts = counts_to_volts(simulated.counts, rig.converter.volts_per_count)
        self._samples = RawChunk(seq, t_ns, volts, np.zeros(n, dtype=np.uint8))

    @property
    def digest(self) -> str:
        """Nothing: it is in memory."""
        return ''

    @property
    def complete(self) -> bool:
        """True: nothing is missing."""
        return True

    @property
    def warnings(self) -> Sequence[str]:
        """None."""
        return ()

    def _chunks(self) -> Iterator[RawChunk]:
        yield self._samples

    def topics(self) -> dict[str, int]:
        """Number of messages by topic, as in a bag of the same samples."""
        counts = {SAMPLES: sum(1 for _ in self.blocks()), LOAD: len(self.loads()), REFERENCE: len(self.pose)}
        if self.temperature is not None:
            counts[TEMPERATURE] = len(self.temperatures())
        return counts

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """None: there is no file."""
        return iter(())

    def _at_changes(self, values: FloatArray) -> list[tuple[int, list[float]]]:
        """Time and values (n, m) of the first sample and of each whose values differ from those before it."""
        changed = np.flatnonzero(np.any(np.diff(values, axis=0, prepend=np.nan) != 0.0, axis=1))
        return list(zip(self._samples.t_ns[changed].tolist(), values[changed].tolist(), strict=True))

    def loads(self) -> list[AppliedLoad]:
        """The first load and each that differs from the one before it."""
        return [AppliedLoad(t_ns, *load) for t_ns, load in self._at_changes(self.loads_applied)]

    def references(self) -> list[ReferencePose]:
        """The true pose at every sample."""
        return [ReferencePose(t, *p) for t, p in zip(self._samples.t_ns.tolist(), self.pose.tolist(), strict=True)]

    def temperatures(self) -> list[TemperatureReading]:
        """The first temperature and each that differs from the one before it."""
        if self.temperature is None:
            return []
        return [TemperatureReading(t_ns, *value) for t_ns, value in self._at_changes(self.temperature[:, None])]

    def estimates(self) -> dict[str, EstimateSeries]:
        """None were recorded: :func:`psd_deflection.replay` computes them."""
        return {}
