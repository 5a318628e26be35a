"""The simulated rig behind a simulated DATAQ converter: its command line, echoes and bare scans."""

from __future__ import annotations

import struct

from psd_deflection import __version__
from psd_deflection.config import Rig
from psd_deflection.devices.simulated_feed import LoadSource, RigFeed
from psd_deflection.protocol.dataq import ANALOG, CLOCK_HZ, COUNTER

IDLE_NS = 100_000_000


class SimulatedDataq:
    """A DI-2108 or like one. ``per_channel``: takes srate as conversions a second, as some do.

    It sends nothing before ``start``, echoes commands while it does not scan, and does not echo
    ``start``. Inputs past the sixth read zero.
    """

    def __init__(
        self,
        rig: Rig,
        loads: LoadSource,
        *,
        seed: int = 0,
        skew_ppm: float = 0.0,
        model: str = '2108',
        per_channel: bool = False,
        serial: str = '5D2A0001',
    ) -> None:
        self._feed = RigFeed(rig, loads, seed)
        self._fast = 1.0 + skew_ppm * 1e-6
        self._info = {'0': 'DATAQ', '1': model, '2': f'SIM {__version__}', '6': serial, '9': str(CLOCK_HZ)}
        self._per_channel = per_channel
        self._list: dict[int, int] = {0: 0}
        self._srate, self._dec = 6000, 1
        self._scanning = False
        self._started_ns = 0
        self._sent = 0
        self._line = b''

    def greeting(self) -> bytes:
        """Nothing: it speaks when it is spoken to."""
        return b''

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Host nanoseconds until the next scan."""
        if not self._scanning:
            return IDLE_NS
        return self._started_ns + int(self._sent * self._period_ns()) - since_power_up_ns

    def _period_ns(self) -> float:
        ticks = self._srate * self._dec * (len(self._list) if self._per_channel else 1)
        return ticks * 1e9 / CLOCK_HZ / self._fast

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """Replies to whole command lines."""
        *lines, self._line = (self._line + received)[-4096:].split(b'\r')
        replies = b''
        for line in lines:
            replies += self._obey(line.decode('ascii', 'replace').strip(), since_power_up_ns)
        return replies

    def _obey(self, text: str, now: int) -> bytes:
        scanning = self._scanning
        words = text.split()
        answer = text
        match words:
            case ['stop']:
                # It echoes even while it scans.
                self._scanning = scanning = False
            case ['start', *_]:
                self._scanning, self._started_ns, self._sent = True, now, 0
                return b''
            case ['info', number]:
                answer = f'{text} {self._info.get(number, "0")}'
            case ['slist', position, word] if position.isdigit() and word.isdigit():
                if position == '0':
                    self._list = {}
                self._list[int(position)] = int(word)
            case ['srate', number] if number.isdigit() and int(number) > 0:
                self._srate = int(number)
            case ['dec', number] if number.isdigit() and int(number) > 0:
                self._dec = int(number)
            case _:
                pass
        # Replies come padded with a zero now and then.
        return b'' if scanning or not text else answer.encode('ascii', 'replace') + b'\r\x00'

    def take(self, since_power_up_ns: int, room: int = 4096) -> bytes:
        """The scans that are due. With no room left they are lost, unsaid: that is how these devices are."""
        out = bytearray()
        while self._scanning and self.due_in_ns(since_power_up_ns) <= 0:
            row = self._feed.next()
            self._sent += 1
            if len(out) < room:
                words = [self._list[p] & 15 for p in sorted(self._list)]
                values = [-32768 if w == COUNTER else row[w] if w < ANALOG else 0 for w in words]
                out += struct.pack(f'<{len(values)}h', *values)
        return bytes(out)
