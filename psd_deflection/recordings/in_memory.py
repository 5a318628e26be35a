# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording whose samples are in memory: simulated, or read by a format of another package."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from msg_adapters import LOAD, REFERENCE, SAMPLES, TEMPERATURE
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.read.mcap_reader import RawMessage
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import AppliedLoad, RawChunk, ReferencePose, TemperatureReading


class RecordingInMemory(Recording):
    """``samples``, all of them, and what was noted beside them, in order of time. It has no estimates."""

    temperatures_held = True

    def __init__(
        self,
        path: Path,
        block_size: int | None,
        samples: RawChunk,
        loads: Sequence[AppliedLoad] = (),
        references: Sequence[ReferencePose] = (),
        temperatures: Sequence[TemperatureReading] = (),
    ) -> None:
        super().__init__(path, block_size)
        self._samples = samples
        self._loads, self._references, self._temperatures = loads, references, temperatures

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
        beside = ((LOAD, self.loads()), (REFERENCE, self.references()), (TEMPERATURE, self.temperatures()))
        return {SAMPLES: sum(1 for _ in self.blocks()), **{topic: len(rows) for topic, rows in beside if rows}}

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """None: there are no messages."""
        return iter(())

    def loads(self) -> list[AppliedLoad]:
        """The first load and each that differs from the one before it."""
        return list(self._loads)

    def references(self) -> list[ReferencePose]:
        """Measurements of the tip by something else."""
        return list(self._references)

    def temperatures(self) -> list[TemperatureReading]:
        """The first temperature and each that differs from the one before it."""
        return list(self._temperatures)

    def estimates(self) -> dict[str, EstimateSeries]:
        """None were recorded: :func:`psd_deflection.replay` computes them."""
        return {}
