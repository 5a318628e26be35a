"""Interface of all recordings: bags, single MCAP files and CSV."""

from __future__ import annotations

import abc
import functools
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from psd_deflection.averaging import BlockCutter
from psd_deflection.recordings.mcap_reader import RawMessage
from psd_deflection.records import (
    CHANNELS,
    AppliedLoad,
    FloatArray,
    IntArray,
    ParameterChange,
    RawChunk,
    ReferencePose,
    SampleBlock,
    TemperatureReading,
)

DEFAULT_BLOCK_SIZE = 20

SAMPLE_DTYPE = np.dtype(
    [('t', '<f8'), ('t_ns', '<i8'), ('seq', '<i8'), *((c, '<f4') for c in CHANNELS), ('flags', 'u1')]
)
"""``t``: s from the first sample. ``t_ns``: ns since the epoch, or since the CSV's zero."""


@dataclass(frozen=True, slots=True, eq=False)
class EstimateSeries:
    """The deflections that were recorded on one topic, in the order of the recording.

    ``t_ns`` int64 (n,). ``pose`` (n, 3): dX m, dY m, theta rad. ``tilt`` (n, 2): phi, omega, rad.
    ``covariance`` (n, 3, 3) of the pose, or None if the topic has none.
    """

    topic: str
    t_ns: IntArray
    pose: FloatArray
    tilt: FloatArray
    covariance: FloatArray | None = None


class Recording(abc.ABC):
    """An opened recording. Every iterator starts from the front and may be taken more than once.

    ``path``: what was opened. ``parameters``: the flat parameter set it was made with, {} if it holds
    none. ``hello``: the device's, or None. ``version``: of the software that recorded, or ''.
    ``node``: full name of the ROS node that recorded itself, or ''.
    ``rig_from_messages``: whether these come from messages, because the file lacks our metadata.
    ``changes``: of parameters during the run, in order. ``restarts``: of the device, each as the last sample
    number before and the first after; the numbers between belong to no sample. ``restarts`` and ``warnings``
    (one line each) are complete after the first full pass over the recording.
    """

    def __init__(self, path: Path, block_size: int | None) -> None:
        self.path = path
        self.parameters: Mapping[str, Any] = {}
        self.hello: Mapping[str, Any] | None = None
        self.version = ''
        self.node = ''
        self.rig_from_messages = False
        self.changes: Sequence[ParameterChange] = ()
        self.restarts: set[tuple[int, int]] = set()
        self._block_size = block_size

    @property
    def namespace(self) -> str:
        """Namespace of the recorded node, '' if it had none."""
        return ''

    @property
    def block_size(self) -> int:
        """Samples per block: the requested number, else the recorded one, else 20."""
        if self._block_size is not None:
            return self._block_size
        recorded = self.parameters.get('block_size')
        return recorded if isinstance(recorded, int) and 1 <= recorded <= 1000 else DEFAULT_BLOCK_SIZE

    @property
    @abc.abstractmethod
    def complete(self) -> bool:
        """False if the end is missing or a part that was read is damaged."""

    @property
    @abc.abstractmethod
    def warnings(self) -> Sequence[str]:
        """Faults that did not stop the reading."""

    def blocks(self) -> Iterator[SampleBlock]:
        """The samples, cut into blocks at seq // block_size.

        Raises RecordingError if there are none, or if they cannot be read.
        """
        cutter = BlockCutter(self.block_size)
        for chunk in self._chunks():
            yield from cutter.add(chunk, chunk.readings.astype(np.float32, copy=False))
        yield from cutter.flush()

    def lost(self, first: int, last: int, present: int) -> int:
        """Samples lost from number ``first`` to ``last``, of which ``present`` are there."""
        missing = last - first + 1 - present
        if missing and self.restarts:
            before, after = np.array(list(self.restarts), np.int64).T
            missing -= int(np.clip(np.minimum(last + 1, after) - np.maximum(first, before + 1), 0, None).sum())
        return max(missing, 0)

    @abc.abstractmethod
    def _chunks(self) -> Iterator[RawChunk]:
        """The samples in order, any number at a time, in volts; ``seq`` always increases."""

    @abc.abstractmethod
    def topics(self) -> dict[str, int]:
        """Number of messages of each topic; for a CSV, as in a bag of the same samples."""

    @abc.abstractmethod
    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Encoded messages of the files, of ``topics`` or of all; none from a CSV."""

    @abc.abstractmethod
    def loads(self) -> list[AppliedLoad]:
        """Known loads, each held until the next."""

    @abc.abstractmethod
    def references(self) -> list[ReferencePose]:
        """Independent measurements of the tip."""

    @abc.abstractmethod
    def temperatures(self) -> list[TemperatureReading]:
        """Ambient temperatures."""

    @abc.abstractmethod
    def estimates(self) -> dict[str, EstimateSeries]:
        """Recorded deflections by topic; {} if none were recorded."""

    @functools.cached_property
    def sample_rate_hz(self) -> float:
        """Samples a second, from the sample numbers and times of the first thousand or so."""
        first = last = None
        for block in self.blocks():
            first = first if first is not None else (int(block.seq[0]), int(block.t_ns[0]))
            last = (int(block.seq[-1]), int(block.t_ns[-1]))
            if last[0] - first[0] >= 1000:
                break
        if first is None or last is None or last[1] <= first[1]:
            return 0.0
        return (last[0] - first[0]) * 1e9 / (last[1] - first[1])

    @functools.cached_property
    def samples(self) -> npt.NDArray[np.void]:
        """Every sample as a structured array (n,) of ``SAMPLE_DTYPE``, read at first use."""
        blocks = list(self.blocks())
        out = np.empty(sum(len(b.seq) for b in blocks), SAMPLE_DTYPE)
        out['seq'] = np.concatenate([b.seq for b in blocks])
        out['t_ns'] = np.concatenate([b.t_ns for b in blocks])
        out['t'] = (out['t_ns'] - out['t_ns'][0]) * 1e-9
        volts = np.concatenate([b.volts for b in blocks])
        for i, channel in enumerate(CHANNELS):
            out[channel] = volts[:, i]
        out['flags'] = np.concatenate([b.flags for b in blocks])
        return out


def from_json(values: Mapping[str, str]) -> dict[str, Any]:
    """Metadata values parsed as JSON; other values stay text."""
    out: dict[str, Any] = {}
    for key, text in values.items():
        try:
            out[key] = json.loads(text)
        except (ValueError, RecursionError):
            out[key] = text
    return out
