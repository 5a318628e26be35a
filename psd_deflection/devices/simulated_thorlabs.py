"""The simulated rig behind a pair of simulated Thorlabs aligners, which answer when they are asked."""

from __future__ import annotations

import threading

from psd_deflection.config import Rig
from psd_deflection.devices.simulated_feed import LoadSource, RigFeed
from psd_deflection.protocol.apt import (
    DEVICE,
    FULL_SCALE,
    HOST,
    INFO_REQUEST,
    READINGS_REQUEST,
    SUM_VOLTS,
    encode_info,
    encode_readings,
)

ANSWER_NS = 2_100_000
"""What the field notes found a poll to take."""

IDLE_NS = 20_000_000


class SharedRig:
    """One rig that two devices look at, each from its own thread; the rig moves on with their time."""

    def __init__(self, rig: Rig, loads: LoadSource, seed: int) -> None:
        self._feed = RigFeed(rig, loads, seed)
        self._rate = rig.converter.sample_rate_hz
        self._volts = rig.converter.volts_per_count
        self._lock = threading.Lock()

    def volts(self, since_power_up_ns: int, psd: int) -> tuple[float, float, float]:
        """x, y and sum of one PSD as the rig's amplifier would give them, V."""
        with self._lock:
            row = self._feed.at(int(since_power_up_ns * 1e-9 * self._rate))
        x, y, total = row[3 * psd - 3 : 3 * psd]
        return x * self._volts, y * self._volts, total * self._volts


class SimulatedAligner:
    """One KPA101. ``psd``: 1 or 2."""

    def __init__(self, shared: SharedRig, psd: int, *, answer_ns: int = ANSWER_NS) -> None:
        self._shared = shared
        self._psd = psd
        self._serial = 69_000_000 + psd
        self._answer_ns = answer_ns
        self._input = b''
        self._queue: list[tuple[int, bytes]] = []

    def greeting(self) -> bytes:
        """Nothing: it speaks when it is spoken to."""
        return b''

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Host nanoseconds until the next answer goes out."""
        return self._queue[0][0] - since_power_up_ns if self._queue else IDLE_NS

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """Take questions; the answers come later, through :meth:`take`."""
        self._input = (self._input + received)[-256:]
        while len(self._input) >= 6:
            if self._input[4] != DEVICE or self._input[5] != HOST:
                self._input = self._input[1:]
                continue
            question, self._input = self._input[:6], self._input[6:]
            at = since_power_up_ns + self._answer_ns
            if question == READINGS_REQUEST:
                x, y, total = self._shared.volts(since_power_up_ns, self._psd)
                # The device gives differences, not quotients.
                scale = total / FULL_SCALE * 32767.0 / 10.0
                sum_count = min(max(round(total / SUM_VOLTS), 0), 65535)
                self._queue.append((at, encode_readings(_int16(x * scale), _int16(y * scale), sum_count)))
            elif question == INFO_REQUEST:
                self._queue.append((at, encode_info(self._serial, 'KPA101')))
        return b''

    def take(self, since_power_up_ns: int, room: int = 4096) -> bytes:
        """The answers that are due."""
        out = b''
        while self._queue and self._queue[0][0] <= since_power_up_ns:
            out += self._queue.pop(0)[1]
        return out[:room]


def _int16(value: float) -> int:
    return min(max(round(value), -32768), 32767)
