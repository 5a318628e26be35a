"""The simulated rig as a quick Arduino: a line of text a sample."""

from __future__ import annotations

import json

from psd_deflection import __version__
from psd_deflection.config import Rig
from psd_deflection.devices.simulated_feed import LoadSource, RigFeed
from psd_deflection.protocol.text_lines import with_check


class SimulatedLines:
    """Sends from power-up, with checks; describes itself at power-up and once a second."""

    def __init__(
        self, rig: Rig, loads: LoadSource, *, seed: int = 0, skew_ppm: float = 0.0, first_seq: int = 0
    ) -> None:
        self._feed = RigFeed(rig, loads, seed)
        self._rate = rig.converter.sample_rate_hz
        self._period_host_ns = 1e9 / self._rate / (1.0 + skew_ppm * 1e-6)
        self._first_seq = first_seq
        self._description = {
            'serial': 'SIM-LINES-1',
            'firmware': f'psd_deflection simulated lines {__version__}',
            'sample_rate_hz': self._rate,
            'volts_per_count': rig.converter.volts_per_count,
        }

    def greeting(self) -> bytes:
        """The end of whatever was half sent, and what it says of itself."""
        return b'\n# ' + json.dumps(self._description).encode() + b'\n'

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Host nanoseconds until the next sample."""
        return int(self._feed.taken * self._period_host_ns) - since_power_up_ns

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """It does not listen."""
        return b''

    def take(self, since_power_up_ns: int, room: int = 4096) -> bytes:
        """The lines that are due; with no room left they are lost, and the number shows it."""
        out = bytearray()
        while self.due_in_ns(since_power_up_ns) <= 0:
            number = self._feed.taken
            row = self._feed.next()
            if len(out) >= room:
                continue
            if number % round(self._rate) == 0:
                out += self.greeting()
            t_us = round((self._first_seq + number) * 1e6 / self._rate) % 2**32
            out += with_check(','.join(map(str, ((self._first_seq + number) % 2**32, t_us, *row))))
        return bytes(out)
