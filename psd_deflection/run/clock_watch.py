# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Follows the clock of a device: chooses the samples for the clock map, and detects jumps of the clock.

It reads no clock: every time comes from the caller. Times of samples are device microseconds, times of reads are
CLOCK_MONOTONIC nanoseconds.
"""

from collections.abc import Sequence

from psd_deflection.base.sequence import NEARBY, WRAP
from psd_deflection.devices.protocol.frames import SampleFrame
from psd_deflection.devices.source import Event, Sample
from psd_deflection.measure.timing import ClockMap, ClockState
from psd_deflection.records import IntArray

TORN_US = 50_000
"""If device time and sample numbers disagree by more than this, the clock jumped or the device paused."""


LAG_WINDOW_S = 10.0
"""Time over which sample numbers and device time are compared."""

LEVEL_S = 0.1
"""Device time less sample numbers is averaged over this time; two such levels show a step of the clock."""
FLAT_US = 1_000
"""A level over which device time and numbers disagree by more than this shows no step: the stamps jitter, or the step
is in it."""
STEP_US = 1_500
"""A step of the clock from here on is one."""

PONG_SLACK = 2.0
"""Periods by which an answer to a ping may lie outside the two samples that it came between."""


class _Levels:
    """Finds steps of a clock in device time less sample numbers, whose levels rise or fall evenly without one.

    ``before_us``: device time before the last step.
    """

    before_us = 0

    def __init__(self, period_us: float) -> None:
        self._period_us = period_us
        self._most = max(round(LEVEL_S * 1e6 / period_us), 4)
        self.clear()

    def clear(self) -> None:
        """Forget the levels: what comes next has nothing to do with them."""
        self._first: tuple[int, int] | None = None
        self._sum = self._least = self._largest = 0.0
        self._count = 0
        # Flat levels: number and device time of the last sample, mean.
        self._flat: list[tuple[int, int, float]] = []

    def add(self, number: int, t_us: int) -> int:
        """Take a sample; the step that it completes, us, or 0."""
        if self._first is None:
            self._first = number, t_us
        off = t_us - self._first[1] - (number - self._first[0]) * self._period_us
        self._least, self._largest = (min(self._least, off), max(self._largest, off)) if self._count else (off, off)
        self._sum += off
        self._count += 1
        if self._count < self._most:
            return 0
        mean, flat = self._sum / self._count, self._largest - self._least < FLAT_US
        self._sum, self._count = 0.0, 0
        if not flat:
            return 0
        self._flat = [*self._flat[-2:], (number, t_us, mean)]
        if len(self._flat) < 3 or number - self._flat[0][0] > 4.5 * self._most:
            return 0
        (n0, _, m0), (n1, before_us, m1), (n2, _, m2) = self._flat
        step = round(m2 - m1 - (m1 - m0) * (n2 - n1) / (n1 - n0))
        if abs(step) < STEP_US:
            return 0
        self.clear()
        self.before_us = before_us
        return step


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
        # A sample of the last LAG_WINDOW_S: extended number, device time.
        self._past = (0, 0)
        self._levels = _Levels(period_us)
        # An answer to a ping that waits for the sample after it: device time, sent, read.
        self._reply: tuple[int, int, int] | None = None

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
            if abs(t_us - last_t - passed) > TORN_US and self._torn_within(events):
                # The clock may have jumped within this read: only a look at each sample tells.
                return False
        return self.observe(seq, t_us, now)

    def _torn_within(self, events: Sequence[Event]) -> bool:
        """Whether a step in time between neighbours disagrees with the step in number.

        If none does, the device is only faster than it says, and its clock must still be followed.
        """
        last = self._taken
        for event in events:
            if type(event) is SampleFrame or type(event) is Sample:
                _, seq, t_us, _ = event
                if last is None or abs(t_us - last[1] - (seq - last[0]) % WRAP * self._period_us) > TORN_US:
                    return True
                last = seq, t_us
        return False

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
        torn = last is not None and abs(t_us - last[1] - (number - last[0]) * self._period_us) > TORN_US
        if self._reply is not None:
            reply, self._reply = self._reply, None
            if not torn and reply[0] <= t_us + PONG_SLACK * self._period_us:
                self._map.observe_reply(*reply)
        if last is None or torn:
            self._past = self._taken
            self._levels.clear()
        return torn

    def stepped(self, number: int, t_us: int) -> int:
        """By how much the device's clock jumped ahead shortly before this sample, us, and the map with it; else 0."""
        step_us = self._levels.add(number, t_us) if self.regressed else 0
        if step_us:
            self._map.shift(step_us, self._levels.before_us)
            self._past = number, t_us
        return step_us

    @property
    def drains(self) -> bool:
        """Whether what a late line held back arrives now: the map steps on."""
        return self._map.drains

    def take_step_ns(self) -> int:
        """By how much later the same device time is stamped since this was asked last, ns: a step of the map."""
        step, self._map.stepped_ns = self._map.stepped_ns, 0
        return step

    def lags(self, number: int, t_us: int, now: int) -> bool:
        """Whether device time has fallen behind the numbers of the samples, and by that behind the host as well.

        Each neighbour may agree with the one before: a clock that stands still is a millisecond behind at each.
        """
        if not self.regressed:
            return False
        passed = (number - self._past[0]) * self._period_us
        if passed - (t_us - self._past[1]) > TORN_US:
            return now - self._map.host_ns(t_us) > TORN_US * 1000
        if passed > LAG_WINDOW_S * 1e6:
            self._past = number, t_us
        return False

    def lay_anew(self, number: int, seq: int, t_us: int, now: int) -> None:
        """Forget what the map has learnt: this sample was taken at ``now``."""
        self._past = number, t_us
        self._observed = seq, t_us
        self._map.lay_anew(t_us, now)

    def reply(self, t_us: int, sent_ns: int, now: int) -> None:
        """The answer to a ping that was sent at ``sent_ns``.

        The map gets it when the next sample has come, if its time lies between the last sample and that one. An answer
        from another timer of the device than that of the samples would shift all stamps.
        """
        if not self.regressed or self._taken is None or t_us < self._taken[1] - PONG_SLACK * self._period_us:
            return
        self._reply = t_us, sent_ns, now

    def to_host_ns(self, t: IntArray) -> IntArray:
        """Host times (n,) of samples in order, ns."""
        return self._map.to_host_ns(t) if self.regressed else t

    def state(self) -> ClockState:
        """Offset and rate of the device's clock against the host's."""
        return self._map.state()
