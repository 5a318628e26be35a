# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording as a device, in real time (``source: replay``): samples keep their numbers, so a loss is a loss here;
``replay.stamps`` sets their times, ``now`` or ``recorded``."""

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from psd_deflection.base.errors import ConfigError, DeviceError, RecordingError
from psd_deflection.devices.device import PSDS, Device, described_psds
from psd_deflection.devices.protocol.frames import PROTOCOL_VERSION, HelloFrame
from psd_deflection.devices.source import Clock, Event, Received, Sample, Source, SourceEndedError
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import MOST_PSDS, SampleBlock, channel_names
from psd_deflection.rig.config import Rig

RATE_TOLERANCE = 2e-3
"""A recorded rate comes from stamps and is not round. If it differs by less than this, the rig's rate is used."""


class Pacer:
    """Computes when recorded things are due. A test can pass its own ``now_ns`` and ``wait`` (s)."""

    def __init__(self, now_ns: Callable[[], int], wait: Callable[[float], object]) -> None:
        self._now_ns = now_ns
        self._wait = wait
        self._shift_ns: int | None = None

    def until(self, recorded_ns: int, timeout: float) -> bool:
        """Wait until ``recorded_ns`` is due, at most ``timeout`` s; whether it is. The first call starts the clock."""
        if self._shift_ns is None:
            self._shift_ns = self._now_ns() - recorded_ns
        wait = (recorded_ns + self._shift_ns - self._now_ns()) * 1e-9
        if wait > 0:
            self._wait(min(wait, timeout))
        return wait <= timeout

    def host_ns(self, recorded_ns: int) -> int:
        """Time at which something recorded at ``recorded_ns`` is or was due, ns."""
        return recorded_ns + (self._shift_ns or 0)


class Replay(Source):
    """``source: replay``."""

    volts = True

    def __init__(self, rig: Rig) -> None:
        self.name = rig.acquisition.port
        if not self.name:
            raise ConfigError("source = replay: port = '': name the recording (a bag folder, an .mcap or a .csv)")
        self._stamps = rig.acquisition.replay_stamps
        self._rate = rig.converter.sample_rate_hz
        self._block_size = rig.estimator.block_size
        self.clock = Clock.RECORDED if self._stamps == 'recorded' else Clock.HOST
        self._recording: Recording | None = None
        self._blocks: Iterator[SampleBlock] = iter(())
        self._next: SampleBlock | None = None
        self._closed = threading.Event()
        self._pacer = Pacer(time.monotonic_ns, self._closed.wait)

    def open(self, timeout: float) -> HelloFrame:
        """Open the recording and read its first block."""
        try:
            recording = open_recording(Path(self.name), block_size=self._block_size)
            rate = recording.sample_rate_hz
        except RecordingError as error:
            raise DeviceError(str(error)) from None
        # Stamps include the clock's skew: a rate close to the rig's rate is the rig's rate.
        rate = self._rate if abs(rate - self._rate) < RATE_TOLERANCE * self._rate else rate
        self._recording = recording
        info = dict(recording.hello or {})
        info |= {
            'serial': str(info.get('serial', '')),
            'firmware': f'replay of {Path(self.name).name}',
            'sample_rate_hz': rate,
            'channels': list(channel_names(recording.psds)),
            'volts_per_count': None,
        }
        info.pop(PSDS, None)
        info |= described_psds(recording.psds)
        return HelloFrame(PROTOCOL_VERSION, info)

    def start(self) -> None:
        """From the beginning."""
        if self._recording is None:
            raise DeviceError(f'{self.name}: not open')
        self._blocks = self._recording.blocks()
        self._next = None

    def read(self, timeout: float) -> Received:
        """The next block, once its last sample is due."""
        try:
            block = self._next if self._next is not None else next(self._blocks, None)
        except RecordingError as error:
            raise SourceEndedError(f'the replay ends early: {error}') from None
        if block is None:
            raise SourceEndedError('the recording is at its end')
        self._next = block
        if not self._pacer.until(int(block.t_ns[-1]), timeout):
            return Received([], time.monotonic_ns(), 0)
        self._next = None
        times = block.t_ns.tolist()
        if self.clock is Clock.HOST:
            times = [self._pacer.host_ns(t) for t in times]
        numbers = (block.seq - self._begin_of(block)).tolist()
        events: list[Event] = [
            Sample(flags, seq, t, tuple(volts))
            for flags, seq, t, volts in zip(block.flags.tolist(), numbers, times, block.volts.tolist(), strict=True)
        ]
        return Received(events, time.monotonic_ns(), max(1, block.volts.nbytes))

    def _begin_of(self, block: SampleBlock) -> int:
        """What to take off the block's numbers: after a restart the device counts anew, as it did then."""
        restarts = self._recording.restarts if self._recording is not None else ()
        first = max((after for _, after in restarts if after <= int(block.seq[0])), default=0)
        return first - first % self._block_size

    def close(self) -> None:
        """End a read that waits; there is nothing else to close."""
        self._closed.set()
        self._blocks, self._next = iter(()), None

    def describe(self) -> Mapping[str, str]:
        """The recording, and the origin of its times."""
        return {
            'source': f'replay of {self.name}',
            'sample numbers': 'as recorded',
            'sample times': 'as recorded' if self._stamps == 'recorded' else 'of now, in the recorded rhythm',
        }


DEVICE = Device('replay', 'a recording, in real time', Replay, most_psds=MOST_PSDS)
