# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Extends sequence numbers beyond 32 bits and interprets jumps in them.

The wire's ``seq`` wraps at 2^32 (49 days at 1 kHz). Blocks are cut by the extended number, which
always increases. If a device restarts, from any number, its numbers continue in the next block of
``alignment`` above the last sample, at the same place in the block. So its blocks stay aligned to its own
numbers. The few numbers between belong to no sample.
"""

from collections.abc import Callable
from enum import Enum

import numpy as np

from psd_deflection.records import IntArray

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

FASTEST = 20.0
"""Times as fast as its declared rate a device may be, and its gaps are still taken for losses."""


class SequenceExtender:
    """Extends u32 sequence numbers to 64 bits.

    A number just ahead of the last one follows it, even if the device's clock jumped. A number
    further ahead (modulo 2^32, less than half way round) is a gap if device time advanced, and, if ``period`` says how
    far it advances from sample to sample, by at least a twentieth of what the gap takes: numbers at random are no
    losses. The last
    number again, or one just behind it with a device time that is not newer, is a duplicated frame.
    Anything else means that the device restarted.
    """

    def __init__(self, alignment: int, period: float = 0.0) -> None:
        self._alignment = alignment
        self._period = period
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
        if 0 < ahead < self._reach(t_device_us - self._last_time):
            self._last, self._last_time = last + ahead, t_device_us
            return last + ahead, (Step.NEXT if ahead == 1 else Step.GAP), ahead - 1
        lag = -ahead % WRAP
        if lag == 0 or (lag < NEARBY and t_device_us <= self._last_time):
            return last - lag, Step.REPEAT, 0
        number = next_block(last, self._alignment) + seq % self._alignment
        self._offset = (number - seq) % WRAP
        self._last, self._last_time = number, t_device_us
        return number, Step.RESTART, 0

    def _reach(self, passed: int) -> float:
        """How far ahead a number may be that belongs to the same run, ``passed`` of device time after the last."""
        if passed <= 0:
            return NEARBY
        return min(NEARBY + FASTEST * passed / self._period, WRAP // 2) if self._period else WRAP // 2

    def restart(self) -> int | None:
        """The next sample is number 0 again; for devices whose samples the host numbers.

        Returns the extended number that 0 will have, None if there was no sample yet.
        """
        if self._last is None:
            return None
        base = next_block(self._last, self._alignment)
        self._offset, self._last, self._last_time = base % WRAP, base - 1, -1
        return base


class RecordedSequence:
    """Extends the sample numbers of a recording, which has host times and no device times.

    A number that goes back is a wrap if that many samples fit into the elapsed time; any other one is a restart, and
    no block mixes the two runs. ``warn`` is called with a sentence, ``note_restart`` with the extended numbers before
    and after. Numbers that were recorded ``full`` do not wrap.
    """

    _FASTEST_HZ = 20_000

    def __init__(self, block_size: int, warn: Callable[[str], None], note_restart: Callable[[int, int], None]) -> None:
        self._block_size = block_size
        self._warn = warn
        self._note_restart = note_restart
        self._wrapped = 0
        self._moved = 0
        self._last: int | None = None
        self._last_t = -1

    def follows(self, seq: IntArray, t_ns: IntArray, full: bool) -> bool:
        """Whether these samples continue the last ones without a number or time going back."""
        return (
            (self._last is None or int(seq[0]) + self._base(full) > self._last)
            and int(t_ns[0]) > self._last_t
            and bool((np.diff(seq) > 0).all())
            and bool((np.diff(t_ns) > 0).all())
        )

    def _base(self, full: bool) -> int:
        return self._moved if full else self._moved + self._wrapped

    def extended(self, seq: IntArray, t_ns: IntArray, full: bool) -> IntArray:
        """Numbers that increase from call to call. Raises ValueError if they do not increase within one call."""
        seq = seq.copy()
        if not full:
            seq[seq < seq[0]] += WRAP
        if bool((np.diff(seq) <= 0).any()):
            raise ValueError('seq does not rise within the message')
        if bool((np.diff(t_ns) <= 0).any()):
            raise ValueError('dt does not rise within the message')
        first = int(seq[0]) + self._base(full)
        if self._last is not None and first <= self._last:
            self._go_on(self._last, first, int(t_ns[0]), full)
        if t_ns[0] <= self._last_t:
            self._warn(f'time goes back to {t_ns[0]} ns')
        seq += self._base(full)
        self._last, self._last_t = int(seq[-1]), int(t_ns[-1])
        return seq

    def _go_on(self, last: int, first: int, t_ns: int, full: bool) -> None:
        """Continue counting after ``last`` at ``first``, which is not greater."""
        step = (first - last) % WRAP
        if not full and 0 < step <= 1000 + (t_ns - self._last_t) * self._FASTEST_HZ // 1_000_000_000:
            self._wrapped += last + step - first
            return
        self._warn(f'sample numbers start again after {last}')
        number = next_block(last, self._block_size) + first % self._block_size
        self._moved += number - first
        self._note_restart(last, number)


def next_block(last: int, block_size: int) -> int:
    """First number of the block after that of the sample ``last``: there the numbers of a restart continue."""
    return (last // block_size + 1) * block_size
