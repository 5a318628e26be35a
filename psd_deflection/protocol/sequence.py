"""Extends sequence numbers beyond 32 bits and interprets jumps in them.

The wire's ``seq`` wraps at 2^32 (49 days at 1 kHz). Blocks are cut by the extended number, which
always increases. If a device restarts, from any number, its numbers continue in the next block of
``alignment`` above the last sample, at the same place in the block. So its blocks stay aligned to its own
numbers. The few numbers between belong to no sample.
"""

from __future__ import annotations

from enum import Enum

WRAP = 1 << 32


class Step(Enum):
    """How a sample follows the one before it."""

    FIRST = 'first'
    NEXT = 'next'
    GAP = 'gap'
    REPEAT = 'repeat'
    RESTART = 'restart'


NEARBY = 64
"""A number this close to the last one counts as its neighbour, whatever the clock says."""


class SequenceExtender:
    """Extends u32 sequence numbers to 64 bits.

    A number just ahead of the last one follows it, even if the device's clock jumped. A number
    further ahead (modulo 2^32, less than half way round) is a gap if device time advanced. The last
    number again, or one just behind it with a device time that is not newer, is a duplicated frame.
    Anything else means that the device restarted.
    """

    def __init__(self, alignment: int) -> None:
        self._alignment = alignment
        self._last: int | None = None
        self._last_time = 0
        self._offset = 0

    def extend(self, seq: int, t_device_us: int) -> tuple[int, Step, int]:
        """``(extended number, step, samples missing before it)``.

        After a RESTART the number of missing samples cannot be known and is given as 0. A REPEAT
        leaves the state as it was.
        """
        last = self._last
        if last is None:
            self._last, self._last_time = seq, t_device_us
            return seq, Step.FIRST, 0
        ahead = (seq + self._offset - last) % WRAP
        if 0 < ahead < NEARBY or (ahead < WRAP // 2 and ahead > 0 and t_device_us > self._last_time):
            self._last, self._last_time = last + ahead, t_device_us
            return last + ahead, (Step.NEXT if ahead == 1 else Step.GAP), ahead - 1
        behind = -ahead % WRAP
        if behind == 0 or (behind < NEARBY and t_device_us <= self._last_time):
            return last - behind, Step.REPEAT, 0
        number = self._next_base() + seq % self._alignment
        self._offset = (number - seq) % WRAP
        self._last, self._last_time = number, t_device_us
        return number, Step.RESTART, 0

    def restart(self) -> int | None:
        """The next sample is number 0 again; for devices whose samples the host numbers.

        Returns the extended number that 0 will have, None if there was no sample yet.
        """
        if self._last is None:
            return None
        base = self._next_base()
        self._offset, self._last, self._last_time = base % WRAP, base - 1, -1
        return base

    def _next_base(self) -> int:
        return -(-((self._last or 0) + 1) // self._alignment) * self._alignment
