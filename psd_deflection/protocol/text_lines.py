"""One sample a line of text: what a quick Arduino can send and a person can read; pure.

Theory of operation. A line is ``seq,t_us,x1,y1,sum1,x2,y2,sum2`` and a newline (a carriage return
before it is passed over): ``seq`` and ``t_us`` whole numbers modulo 2^32, the six readings decimal.
A line that begins with ``#`` describes the device: a JSON object with ``sample_rate_hz`` and, where
the readings are converter counts, ``volts_per_count``; without it they are volts. It is sent at
power-up and once a second.

A line may end in ``*hh``, the exclusive-or of all bytes before the ``*`` in hexadecimal (as NMEA 0183
has it). Lines without it are taken as they come, and a digit that the wire changed is then not seen:
text has no CRC. Lost lines are seen by ``seq``.
"""

from __future__ import annotations

import functools
import json
import re
from typing import NamedTuple

from psd_deflection.protocol.frames import BadFrame
from psd_deflection.protocol.sequence import WRAP
from psd_deflection.protocol.words import device_words, finite

MAX_LINE = 400
"""Bytes. What is longer is no line of ours."""

FIELDS = 8
_WHOLE = re.compile(rb'\d{1,10}')
_DECIMAL = re.compile(rb'[+-]?(\d{1,9}(\.\d{0,9})?|\.\d{1,9})')
MAX_VOLTS = 1e3


class Line(NamedTuple):
    """A sample: ``seq`` and ``t_us`` modulo 2^32, the readings as they were written."""

    seq: int
    t_us: int
    readings: tuple[float, ...]


class Description(NamedTuple):
    """What a ``#`` line says."""

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
    if len(fields) != FIELDS:
        return BadFrame('not eight fields', size)
    if not (_WHOLE.fullmatch(fields[0]) and _WHOLE.fullmatch(fields[1])):
        return BadFrame('seq or t_us is no whole number', size)
    seq, t_us = int(fields[0]), int(fields[1])
    if seq >= WRAP or t_us >= WRAP:
        return BadFrame('seq or t_us is over 32 bits', size)
    if not all(_DECIMAL.fullmatch(f) for f in fields[2:]):
        return BadFrame('a reading is no number', size)
    return Line(seq, t_us, tuple(float(f) for f in fields[2:]))


def _description(text: bytes, size: int) -> Item:
    """A comment that is no JSON object is nobody's fault, but no description either."""
    try:
        info = json.loads(text)
    except (ValueError, RecursionError):
        return BadFrame('comment without a description', size)
    return (
        Description(device_words(info)) if isinstance(info, dict) else BadFrame('comment without a description', size)
    )


def positive(value: object) -> float | None:
    """``value`` where it is a number above zero."""
    number = finite(value)
    return number if number is not None and number > 0.0 else None


class LineDecoder:
    """Cuts a stream at its newlines; what comes before the first is the tail of a line begun before we listened."""

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
    """Microseconds of 32 bits (``micros()`` wraps after 71.6 minutes) to ones that go on.

    Time that went back while the sample number went on has wrapped; while the number went back as
    well, the device started anew, and so does its time.
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
                    # An old line once more: not for the clock.
                    return self._high + line.t_us
                self._high = 0
            elif last.t_us - line.t_us > WRAP // 2:
                self._high += WRAP
        self._last = line
        return self._high + line.t_us
