"""The simulated rig as a device: contract frames over a pseudo-terminal, in real time.

:class:`SimulatedDevice` is the device without its line or clock: bytes from the host in, bytes due
by a given instant out. :func:`serve` gives it both. Like a USB device it sends nothing while no one
has the port open, and when the host does not read it drops samples, counts them (STATUS) and says
so in the next one (flags, bit 1).
"""

from __future__ import annotations

import os
import select
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import numpy as np

from psd_deflection import __version__
from psd_deflection.config import Rig
from psd_deflection.errors import ConfigError
from psd_deflection.protocol.frames import (
    PROTOCOL_VERSION,
    FrameDecoder,
    HelloFrame,
    HelloRequestFrame,
    PingFrame,
    PongFrame,
    SampleFrame,
    StartFrame,
    StatusFrame,
    StopFrame,
    encode,
)
from psd_deflection.records import CHANNELS, FLAG_DEVICE_DROPPED, FLAG_OVER_RANGE, FloatArray
from psd_deflection.simulation.simulator import RigSimulator

SECOND_NS = 1_000_000_000
BATCH = 50
OUTPUT_LIMIT = 4096
"""Bytes that the device keeps for a host that does not read: about 0.12 s of samples."""

CATCH_UP_NS = 20_000_000

LoadSource = Callable[[int, int], FloatArray]
"""``loads(first_sample, n)`` -> (n, 3): Fx, Fy N and Tz N m held before each sample."""


class SimulatedDevice:
    """The device's own logic. ``skew_ppm``: its clock runs fast by this much.

    ``first_seq``: its first sample number (a device that has run for long). ``lose``: sample numbers
    that the wire loses; ``dark``: half-open sample ranges with the laser of PSD 1 or 2 off, for
    demonstrations and for golden recordings.
    """

    def __init__(
        self,
        rig: Rig,
        loads: LoadSource,
        *,
        seed: int = 0,
        skew_ppm: float = 0.0,
        first_seq: int = 0,
        serial: str = 'SIM-0001',
        lose: frozenset[int] = frozenset(),
        dark: tuple[tuple[int, int, int], ...] = (),
    ) -> None:
        self._rig = rig
        self._loads = loads
        self._simulator = RigSimulator(rig, seed)
        self._rate = rig.converter.sample_rate_hz
        self._period_device_us = 1e6 / self._rate
        self._period_host_ns = 1e9 / self._rate / (1.0 + skew_ppm * 1e-6)
        self._first_seq = first_seq
        self._serial = serial
        self._lose = lose
        self._dark = dark
        self._decoder = FrameDecoder()
        self._taken = 0
        self._streaming = True
        self._overruns = 0
        self._dropped = False
        self._batch: Iterator[tuple[int, ...]] = iter(())
        self.poses: list[FloatArray] | None = None

    @property
    def hello(self) -> HelloFrame:
        """What it says of itself."""
        return HelloFrame(
            PROTOCOL_VERSION,
            {
                'serial': self._serial,
                'firmware': f'psd_deflection simulated rig {__version__}',
                'sample_rate_hz': self._rate,
                'channels': list(CHANNELS),
                'volts_per_count': self._rig.converter.volts_per_count,
            },
        )

    def greeting(self) -> bytes:
        """What it sends when someone opens its port: the end of what was half sent, and HELLO."""
        return b'\x00' + encode(self.hello)

    @property
    def taken(self) -> int:
        """Samples taken since power-up."""
        return self._taken

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Host nanoseconds until the next sample; 0 or less: it is due."""
        return int(self._taken * self._period_host_ns) - since_power_up_ns

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """Replies to what the host sent; what is no frame is passed over."""
        replies = b''
        for frame in self._decoder.feed(received):
            match frame:
                case HelloRequestFrame():
                    replies += encode(self.hello)
                case PingFrame(cookie):
                    # The clock of the samples, which a device that has run for long has from its first one.
                    elapsed = (self._first_seq + since_power_up_ns / self._period_host_ns) * self._period_device_us
                    replies += encode(PongFrame(cookie, int(elapsed)))
                case StartFrame():
                    self._streaming = True
                case StopFrame():
                    self._streaming = False
                case _:
                    pass
        return replies

    def take(self, since_power_up_ns: int, room: int = OUTPUT_LIMIT) -> bytes:
        """Take every sample that is due; the frames to send, at most about ``room`` bytes.

        With no room left a sample is taken and dropped, as a device with a full buffer does.
        """
        out = bytearray()
        while self.due_in_ns(since_power_up_ns) <= 0:
            counts = self._next_counts()
            number = self._taken
            self._taken += 1
            seq = (self._first_seq + number) % (1 << 32)
            if len(out) >= room:
                self._overruns += 1
                self._dropped = True
            elif self._streaming and number not in self._lose:
                over = any(c in (-32768, 32767) for c in counts)
                flags = (FLAG_OVER_RANGE if over else 0) | (FLAG_DEVICE_DROPPED if self._dropped else 0)
                self._dropped = False
                t_us = round((self._first_seq + number) * self._period_device_us)
                out += encode(SampleFrame(flags, seq, t_us, counts))
            if number % round(self._rate) == 0 and len(out) < room:
                out += encode(self.hello) + encode(StatusFrame(self._overruns, 2150))
        return bytes(out)

    def _next_counts(self) -> tuple[int, int, int, int, int, int]:
        row = next(self._batch, None)
        if row is None:
            first = self._taken
            chunk = self._simulator.step(self._loads(first, BATCH))
            counts = np.array(chunk.counts)
            for psd, start, stop in self._dark:
                numbers = np.arange(first, first + BATCH)
                off = (numbers >= start) & (numbers < stop)
                columns = slice(0, 3) if psd == 1 else slice(3, 6)
                # Without light the divider has nothing to divide: only the noise is left.
                counts[off, columns] = counts[off, columns] % 13 - 6
            if self.poses is not None:
                self.poses.append(chunk.pose)
            self._batch = iter([tuple(r) for r in counts.tolist()])
            row = next(self._batch)
        x1, y1, sum1, x2, y2, sum2 = row
        return (x1, y1, sum1, x2, y2, sum2)


class PseudoTerminal:
    """The device's side of a port that pyserial can open: ``name`` is the host's side.

    ``link``: a symbolic link to it, which replaces an older link and nothing else; ConfigError where it cannot be made.
    """

    def __init__(self, link: str | Path | None = None) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.name = os.ttyname(slave)
        # Only once it was opened and closed does the kernel report that no one has it open.
        os.close(slave)
        os.set_blocking(self.master, False)
        self._link = Path(link) if link is not None else None
        if self._link is not None:
            try:
                if self._link.is_symlink():
                    self._link.unlink()
                self._link.symlink_to(self.name)
            except OSError as error:
                os.close(self.master)
                raise ConfigError(f'{self._link}: no link can be made there ({error.strerror})') from None

    def close(self) -> None:
        """Take the port away, as a pulled cable does."""
        os.close(self.master)
        # It may be another's by now.
        if self._link is not None and self._link.is_symlink() and str(self._link.readlink()) == self.name:
            self._link.unlink()


class LineDevice(Protocol):
    """A device without its line and clock; times are host nanoseconds since power-up."""

    def greeting(self) -> bytes:
        """What it sends when someone opens its port."""

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Until it next has something to send; 0 or less: it has."""

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """Replies to what the host sent."""

    def take(self, since_power_up_ns: int, room: int = OUTPUT_LIMIT) -> bytes:
        """What is due, at most about ``room`` bytes."""


def serve(device: LineDevice, port: PseudoTerminal, stopped: Callable[[], bool]) -> None:
    """Run the device in real time until ``stopped()``."""
    poll = select.poll()
    poll.register(port.master, select.POLLIN)
    start = time.monotonic_ns()
    pending = b''
    listening = False
    while not stopped():
        wait_ms = max(device.due_in_ns(time.monotonic_ns() - start), 0) / 1e6
        events = poll.poll(wait_ms)
        mask = events[0][1] if events else 0
        now = time.monotonic_ns() - start
        if mask & select.POLLHUP:
            listening, pending = False, b''
            device.take(now, room=1 << 30)
            # A hung-up line is always "ready": wait for the next sample by the clock instead.
            time.sleep(1e-3)
            continue
        if not listening:
            listening = True
            pending = device.greeting()
        try:
            if mask & select.POLLIN:
                pending += device.receive(os.read(port.master, 4096), now)
            until = now + min(device.due_in_ns(now), 0)
            caught_up = False
            while not caught_up:
                # A device is never late; this process may be, on a busy machine. What fell due
                # meanwhile is sent piece by piece: only a host that does not read makes it drop.
                until = min(until + CATCH_UP_NS, now)
                caught_up = until == now
                pending += device.take(until, room=OUTPUT_LIMIT - len(pending))
                if pending:
                    pending = pending[os.write(port.master, pending) :]
        except BlockingIOError:
            pass
        except OSError:
            # The host closed the port between poll and write.
            listening, pending = False, b''
