# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One sample per line of text, simple to send from an Arduino and readable; no I/O.

Theory of operation. A line is ``seq,t_us,x1,y1,sum1,x2,y2,sum2`` and a newline (a carriage return before it is
ignored): ``seq`` and ``t_us`` whole numbers modulo 2^32, signed or not, the six readings decimal. A device with more
PSDs sends three readings of each further one. Where the electrodes themselves are converted, four readings of each
PSD take their place. A line that begins with ``#`` describes the device: a JSON object with ``sample_rate_hz``,
``psds`` if there are more than two, and, if the readings are converter counts, ``volts_per_count``. Without
``volts_per_count`` the readings are volts. The device sends this line at power-up and once a second.

A line may end in ``*hh``, the exclusive-or of all bytes before the ``*`` in hexadecimal (as in NMEA
0183). Lines without it are accepted unchecked. Without the checksum, a corrupted digit goes
unnoticed. Lost lines are detected by ``seq``.
"""

import functools
import json
import re
from typing import NamedTuple

from psd_deflection.base.sequence import WRAP
from psd_deflection.devices.protocol.frames import BadFrame
from psd_deflection.devices.protocol.words import device_words, finite
from psd_deflection.records import MOST_PSDS

MAX_LINE = 400
"""Bytes. Longer lines are malformed."""

READINGS = 3
ELECTRODES = 4
"""Readings of one PSD."""
_COUNTS = frozenset(of * n for n in range(2, MOST_PSDS + 1) for of in (READINGS, ELECTRODES))
_INTEGER = re.compile(rb'-?\d{1,10}')
_DECIMAL = re.compile(rb'[+-]?(\d{1,9}(\.\d{0,9})?|\.\d{1,9})')
MAX_VOLTS = 1e3
LEAST = -WRAP // 2
"""Of a counter of 32 bits that is printed as a signed one."""


class Line(NamedTuple):
    """A sample: ``seq`` and ``t_us`` modulo 2^32, the readings as they were written."""

    seq: int
    t_us: int
    readings: tuple[float, ...]


class Description(NamedTuple):
    """The JSON object of a ``#`` line."""

    info: dict[str, object]


Item = Line | Description | BadFrame


def with_check(line: str) -> bytes:
    """A line with its check and newline, as a device sends it."""
    body = line.encode('ascii')
    return body + b'*%02X\n' % _check(body)


def _check(body: bytes) -> int:
    return functools.reduce(lambda a, b: a ^ b, body, 0)


def parse(line: bytes) -> Item | None:
    """One line without its end; None for an empty one."""
    line = line.strip(b' \t\r')
    if not line:
        return None
    size = len(line)
    body, star, check = line.rpartition(b'*')
    if star and not line.startswith(b'#'):
        if not re.fullmatch(rb'[0-9A-Fa-f]{2}', check) or int(check, 16) != _check(body):
            return BadFrame('check differs', size)
        line = body
    if line.startswith(b'#'):
        return _description(line[1:], size)
    fields = [f.strip() for f in line.split(b',')]
    if len(fields) - 2 not in _COUNTS:
        return BadFrame('no number of fields that a sample has', size)
    if not (_INTEGER.fullmatch(fields[0]) and _INTEGER.fullmatch(fields[1])):
        return BadFrame('seq or t_us is no whole number', size)
    seq, t_us = int(fields[0]), int(fields[1])
    if not (LEAST <= seq < WRAP and LEAST <= t_us < WRAP):
        return BadFrame('seq or t_us is over 32 bits', size)
    if not all(_DECIMAL.fullmatch(f) for f in fields[2:]):
        return BadFrame('a reading is no number', size)
    return Line(seq % WRAP, t_us % WRAP, tuple(float(f) for f in fields[2:]))


def _description(text: bytes, size: int) -> Item:
    """The description of a comment line; a BadFrame if the comment is not a JSON object."""
    try:
        info = json.loads(text)
    except (ValueError, RecursionError):
        return BadFrame('comment without a description', size)
    return (
        Description(device_words(info)) if isinstance(info, dict) else BadFrame('comment without a description', size)
    )


def positive(value: object) -> float | None:
    """``value`` if it is a number above zero, else None."""
    number = finite(value)
    return number if number is not None and number > 0.0 else None


class LineDecoder:
    """Cuts a stream at its newlines; ignores the incomplete line before the first newline."""

    def __init__(self) -> None:
        self._rest = b''
        self._dropped = 0
        self._in_step = False

    def feed(self, received: bytes) -> list[Item]:
        """The lines that end in ``received``."""
        out: list[Item] = []
        *ended, last = received.split(b'\n')
        for piece in ended:
            self._keep(piece)
            item = BadFrame('longer than a line', self._dropped) if self._dropped else parse(self._rest)
            if item is not None and (self._in_step or not isinstance(item, BadFrame)):
                out.append(item)
            self._rest, self._dropped, self._in_step = b'', 0, True
        self._keep(last)
        return out

    def _keep(self, more: bytes) -> None:
        if self._dropped:
            self._dropped += len(more)
            return
        self._rest += more
        if len(self._rest) > MAX_LINE:
            self._dropped, self._rest = len(self._rest), b''


class TimeExtender:
    """Extends 32-bit microseconds (``micros()`` wraps after 71.6 minutes).

    If time goes back while the sample number advances, the time has wrapped. If the number goes
    back as well, the device has restarted and its time starts again.
    """

    def __init__(self) -> None:
        self._last: Line | None = None
        self._high = 0

    def extend(self, line: Line) -> int:
        """Microseconds since the device's time last started."""
        last = self._last
        if last is not None and line.t_us < last.t_us:
            ahead = (line.seq - last.seq) % WRAP
            if not 0 < ahead < WRAP // 2:
                if (last.seq - line.seq) % WRAP < 64 and last.t_us - line.t_us < WRAP // 2 and line.seq > 64:
                    # A repeated old line: it does not change the clock.
                    return self._high + line.t_us
                self._high = 0
            elif last.t_us - line.t_us > WRAP // 2:
                self._high += WRAP
        self._last = line
        return self._high + line.t_us
