# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A device on a pseudo-terminal with every fault a line can have, and a ledger of what it did to which sample."""

import contextlib
import fcntl
import os
import random
import select
import sys
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from psd_deflection.devices.protocol import frames as protocol
from psd_deflection.devices.pseudo_terminal import PseudoTerminal
from psd_deflection.records import CHANNELS

RATE, SERIAL = 1000, 'CAMPAIGN-1'
VOLTS_PER_COUNT = 10.0 / 32768
DIGIT = 4096  # Identities are written in two digits to this base: (id // base) in x2, (id % base) in x1.
LOOK_S, QUIET_LOOKS, READ_LIMIT_S = 0.005, 5, 5.0
Tamper = Callable[[int, bytes], bytes | None]
"""What becomes of a sample's frame on the line; None where it arrives as it is."""


def hello_of(serial: str = SERIAL, rate: float = 1000.0) -> protocol.HelloFrame:
    """What the device says of itself."""
    info: dict[str, object] = {'serial': serial, 'firmware': 'campaign', 'sample_rate_hz': rate}
    return protocol.HelloFrame(1, {**info, 'channels': list(CHANNELS), 'volts_per_count': VOLTS_PER_COUNT})


def identities(volts: npt.NDArray[np.float32]) -> npt.NDArray[np.int64]:
    """(n,) identities of samples in volts (n, 6)."""
    counts = np.rint(volts[:, [0, 3]] / VOLTS_PER_COUNT).astype(np.int64) + DIGIT // 2
    out: npt.NDArray[np.int64] = counts[:, 0] + counts[:, 1] * DIGIT
    return out


class Line:
    """The device and its cable. Faults change its attributes; ``lock`` keeps them apart from the sending."""

    def __init__(self, folder: Path, name: str = 'port') -> None:
        self.lock = threading.RLock()
        self.folder = folder
        self.random = random.Random(1)
        self.taken_by_fault: set[int] = set()
        self.sent = 0
        self.tamper: Tamper | None = None
        self.mute = False
        self.hold = False
        self.obedient = False
        self.optics: dict[int, int] = {}
        self.freeze = False
        self.flags = 0
        self.greeted = threading.Event()
        self.serial = SERIAL
        self._seq = 0
        self._clock_us = 0
        self._listening = False
        self._pending = bytearray()
        self._second = 0
        self._stop = threading.Event()
        self._terminal: PseudoTerminal | None = None
        self._decoder = protocol.FrameDecoder()
        self._start = time.monotonic()
        self.plug(name)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    # ---- what faults do

    def plug(self, name: str = 'port') -> None:
        with self.lock:
            self.greeted.clear()
            self._listening = False
            self._pending.clear()
            self._decoder = protocol.FrameDecoder()
            self.name = name
            self._terminal = PseudoTerminal(self.folder / name)

    def unplug(self) -> None:
        """Pull it once the host has read what was on its way: a kernel's buffer that a pulled cable
        empties is no loss of the daemon's, however late the daemon was."""
        with self.lock:
            self._listening = False
        self.wait_until_read()
        with self.lock:
            if self._terminal is not None:
                self._terminal.close()
            self._terminal = None

    def wait_until_read(self) -> int:
        """Wait until nothing sent is unread at several looks in a row; samples before the returned one are read. At one
        look bytes may be between two of the kernel's buffers, unseen: only what was sent before the first of the looks
        is sure to be read by the last."""
        deadline, quiet, sure = time.monotonic() + READ_LIMIT_S, 0, 0
        while quiet < QUIET_LOOKS and time.monotonic() < deadline:
            with self.lock:
                if self._pending or self._unread():
                    quiet = 0
                else:
                    sure = self.sent if quiet == 0 else sure
                    quiet += 1
            time.sleep(LOOK_S)
        return sure

    def _unread(self) -> int:
        if self._terminal is None:
            return 0
        descriptor = os.open(self._terminal.name, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            answer = fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4))
        finally:
            os.close(descriptor)
        return int.from_bytes(answer, sys.byteorder)

    @property
    def device_name(self) -> str:
        return self._terminal.name if self._terminal is not None else ''

    def restart(self, seq: int = 0, clock_us: int = 0) -> None:
        with self.lock:
            self._seq, self._clock_us = seq, clock_us

    def jump(self, samples: int = 0, clock_us: int = 0) -> None:
        with self.lock:
            self._seq += samples
            self._clock_us += clock_us

    def inject(self, garbage: bytes) -> None:
        with self.lock:
            self._pending += garbage

    def next_identity(self) -> int:
        with self.lock:
            return self.sent

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        if self._terminal is not None:
            self._terminal.close()

    # ---- the device itself

    def _run(self) -> None:
        while not self._stop.is_set():
            with self.lock:
                self._serve()
            time.sleep(0.002)

    def _serve(self) -> None:
        n_due = int((time.monotonic() - self._start) * RATE) - self.sent
        for _ in range(n_due):
            self._sample()
        terminal = self._terminal
        if terminal is None:
            return
        poll = select.poll()
        poll.register(terminal.master, select.POLLIN)
        mask = poll.poll(0)
        if mask and mask[0][1] & select.POLLHUP:
            self._listening = False
            self._pending.clear()
            return
        with contextlib.suppress(BlockingIOError, OSError):
            if mask:
                self._receive(os.read(terminal.master, 4096))
        with contextlib.suppress(BlockingIOError, OSError):
            if self._pending and not self.hold:
                del self._pending[: os.write(terminal.master, self._pending)]

    def _receive(self, received: bytes) -> None:
        for frame in self._decoder.feed(b'\x00' + received if not self._listening else received):
            if isinstance(frame, protocol.HelloRequestFrame):
                self._pending += protocol.encode(hello_of(self.serial))
                self._listening = True
                self.greeted.set()
            elif isinstance(frame, protocol.PingFrame):
                self._pending += protocol.encode(protocol.PongFrame(frame.cookie, self._clock_us))
            elif isinstance(frame, protocol.StartFrame) and self.obedient:
                self.mute = self.obedient = False

    def _sample(self) -> None:
        identity = self.sent
        self.sent += 1
        seq, t_us = self._seq, self._clock_us
        self._seq += 1
        self._clock_us += 1_000_000 // RATE
        if not self._listening or self.mute:
            self.taken_by_fault.add(identity)
            return
        high, low = divmod(identity, DIGIT)
        shake = 0 if self.freeze else self.random.randrange(-6, 7)
        counts = [low - DIGIT // 2, shake, 16384 + shake, high - DIGIT // 2, -shake, 16384 - shake]
        for channel, value in self.optics.items():
            counts[channel] = value
        if self.freeze:
            counts[3:] = [high - DIGIT // 2, 0, 16384]
        flags, self.flags = self.flags, 0
        frame = protocol.encode(protocol.SampleFrame(flags, seq % 2**32, max(t_us, 0), tuple(counts)))
        changed = self.tamper(identity, frame) if self.tamper is not None else None
        if changed is not None:
            self.taken_by_fault.add(identity)
            frame = changed
        self._pending += frame
        if self.sent // RATE != self._second:
            self._second = self.sent // RATE
            self._pending += protocol.encode(hello_of(self.serial)) + protocol.encode(protocol.StatusFrame(0, 2150))
