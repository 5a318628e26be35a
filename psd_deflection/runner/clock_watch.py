"""Follows the clock of a device: chooses the samples for the clock map, and detects jumps of the clock.

It reads no clock: every time comes from the caller. Times of samples are device microseconds, times of reads are
CLOCK_MONOTONIC nanoseconds.
"""

from __future__ import annotations

from collections.abc import Sequence

from psd_deflection.devices.source import Event, Sample
from psd_deflection.protocol.frames import SampleFrame
from psd_deflection.protocol.sequence import NEARBY, WRAP
from psd_deflection.records import IntArray
from psd_deflection.timing import ClockMap, ClockState

TORN_US = 50_000
"""If device time and sample numbers disagree by more than this, the clock jumped or the device paused."""


class ClockWatch:
    """``period_us``: nominal time between two samples. ``regressed``: whether the device's clock needs the map at
    all; if it does not, times go through as they are."""

    def __init__(self, period_us: float, *, regressed: bool) -> None:
        self.regressed = regressed
        self._period_us = period_us
        self._map = ClockMap()
        # The last pair that the map was given: sequence number as sent (32 bits), device time.
        self._observed: tuple[int, int] | None = None
        # The last sample that was taken: extended number, device time.
        self._taken: tuple[int, int] | None = None

    def newest(self, events: Sequence[Event], now: int) -> bool:
        """Give the map the samples of one read at ``now``, before any is stamped; True if the clock jumped.

        Only the newest sample of a read tells the delay of the line.
        """
        if not self.regressed:
            return False
        newest = next((e for e in reversed(events) if type(e) is SampleFrame or type(e) is Sample), None)
        if newest is None:
            return False
        _, seq, t_us, _ = newest
        if self._observed is not None:
            last_seq, last_t = self._observed
            if (last_seq - seq) % WRAP < NEARBY and t_us <= last_t:
                # Repeated: it carries no information.
                return False
            passed = (seq - last_seq) % WRAP * self._period_us
            if abs(t_us - last_t - passed) > TORN_US:
                # The clock may have jumped within this read: only a look at each sample tells.
                return False
        return self.observe(seq, t_us, now)

    def observe(self, seq: int, t_us: int, now: int) -> bool:
        """Give the map one sample that was read at ``now``; True if the clock jumped and the map restarted."""
        passed = None if self._observed is None else (seq - self._observed[0]) % WRAP * self._period_us
        self._observed = (seq, t_us)
        return self._map.observe(t_us, now, passed)

    def torn(self, number: int, t_us: int) -> bool:
        """Whether the step in time from the previous sample disagrees with the step in number."""
        if not self.regressed:
            return False
        last, self._taken = self._taken, (number, t_us)
        return last is not None and abs(t_us - last[1] - (number - last[0]) * self._period_us) > TORN_US

    def reply(self, t_us: int, sent_ns: int, now: int) -> None:
        """Give the map the answer to a ping that was sent at ``sent_ns``."""
        if self.regressed:
            self._map.observe_reply(t_us, sent_ns, now)

    def to_host_ns(self, t: IntArray) -> IntArray:
        """Host times (n,) of samples in order, ns."""
        return self._map.to_host_ns(t) if self.regressed else t

    def state(self) -> ClockState:
        """Offset and rate of the device's clock against the host's."""
        return self._map.state()
