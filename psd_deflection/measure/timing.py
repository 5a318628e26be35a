# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts device time to host time by regression; a sample's arrival time is never its stamp.

Theory of operation. A byte cannot arrive before it was sent: host time minus device time is the
clocks' offset plus a delay. The delay is never negative and often far above its minimum. So only
the smallest delay of each second of device time is kept (``WINDOW_S`` of them). The fitted line is
the lower edge of these points: the edge of their lower convex hull that spans their middle.
(``test/measure/test_timing.py`` checks that stamps stay within 50 us of the true times.) Until there are
``FIT_AFTER_S`` points, a one-sided filter is used instead (Olson, "A passive solution to the sensor
synchronization problem", IROS 2010). It takes the smallest delay so far, after raising each older
one by the most that the clocks may have drifted apart since (``MAX_SKEW``). A clock that is off by more than
that is fitted as soon as it shows (``STRAY_NS``).

Samples at 1 kHz beat with the 1 ms polling of USB, so the smallest delay of a second may stay high
for many seconds. If the device answers pings, the answers arrive at random phase and enter the same
minima. One-way times cannot show the constant part of the delay. Pings bound it: it is at most the
shortest round trip (``ClockState.round_trip_ns``). If it is known, ``latency_offset`` subtracts it.

The map from device to host time does not jump to a better fit. It stays continuous and strictly
rising, and approaches the fit with a bounded slope, so stamps stay evenly spaced. Only if the
device's clock itself jumped (a restart, a step) does the map start again; such resets are counted. A step that the
sample numbers reveal shifts the map by as much (:meth:`ClockMap.shift`), and what it has learnt stays.
"""

import itertools
from typing import NamedTuple

import numpy as np

from psd_deflection.records import IntArray

SECOND_NS = 1_000_000_000
WINDOW_S = 300
ASKED_WINDOW_S = 50
"""With answers to pings, which do not beat, fewer seconds are enough, and a rate that wanders is followed: 50 ppm in
300 s cost 0.3 ms at most."""
FIT_AFTER_S = 10
SETTLING_S = 10
STEER_SETTLING = 2e-3
"""Largest extra slope in the first ``SETTLING_S``: 20 ms between blocks stay 20 ms within 40 us."""
FAR_NS = 1_000_000
"""If the map is this far from the fit, it approaches it as in the first ``SETTLING_S``; nearer, within 5 s, so by 2e-4
at most: 20 ms stay 20 ms within 4 us.
"""
EARLY_NS = 50_000_000
"""A sample that arrives this much earlier than the map allows: the device's clock jumped ahead."""
DRAINING = 1.2
"""While what a late line held back arrives, device time passes faster than host time by this factor at least."""
DRAINED_NS = 2_000_000
"""Meanwhile a sample this early shows that those before it were late."""
MAX_SKEW = 1e-4
STRAY_POINTS = 3
STRAY_NS = 2_000_000
"""A clock that runs off by this much over the points so far, ``STRAY_POINTS`` at least and all on one line, is
fitted before ``FIT_AFTER_S``: it is worse than ``MAX_SKEW``."""
LATE_NS = 5 * SECOND_NS
"""A whole second of samples this late: the device's clock jumped back, or stood still."""


class ClockState(NamedTuple):
    """For diagnostics: skew in ppm, offset (host minus device) and residual in ns, resets.

    ``round_trip_ns``: the shortest ping since the map started; None if no ping was answered.
    """

    skew_ppm: float
    offset_ns: int
    residual_ns: float
    points: int
    resets: int
    round_trip_ns: int | None = None


class ClockMap:
    """Maps device microseconds to host nanoseconds (CLOCK_MONOTONIC)."""

    def __init__(self) -> None:
        self.resets = 0
        # By how much stamps of one device time became later as the map stepped, ns.
        self.stepped_ns = 0
        # Whether what a late line held back arrives now.
        self.drains = False
        self._started = False
        self._start(0, 0)

    def _start(self, device_ns: int, host_ns: int) -> None:
        self._origin = device_ns
        self._minima: list[tuple[int, int]] = []  # Bound: WINDOW_S.
        self._bucket = 0
        self._bucket_min: tuple[int, int] | None = None
        self._anchor_device = device_ns
        self._anchor_host = host_ns
        self._slope = 0.0
        self._mapped = device_ns - SECOND_NS
        self._skew = 0.0
        self._last_device = device_ns
        self._last_host = host_ns
        self.drains = False
        self._residual = 0.0
        self._round_trip: int | None = None

    def observe(self, t_device_us: int, t_host_ns: int, passed_us: float | None = None) -> bool:
        """One pair: the newest sample of a read, and when the read returned.

        ``passed_us``: device time since the last pair according to the sample numbers, if they tell
        it. If a sample arrives too early for the map but the clock agrees with the sample numbers,
        then the first samples were late: the map starts again without counting a jump. Returns True
        if the device's clock jumped and the map started again.
        """
        device = t_device_us * 1000
        if not self._started:
            self._started = True
            self._start(device, t_host_ns)
        early_ns = self._host(device) - t_host_ns
        delay = t_host_ns - device
        bucket = (device - self._origin) // SECOND_NS
        passed = device - self._last_device
        self.drains = (
            self.drains
            and passed_us is not None
            and passed > DRAINING * (t_host_ns - self._last_host)
            and abs(passed - 1000.0 * passed_us) < 0.1 * passed
        )
        early = early_ns > (DRAINED_NS if self.drains else EARLY_NS)
        if passed < 0 or early or (bucket != self._bucket and self._second_was_late()):
            return self._restart(device, delay, early_ns if early else 0, passed_us)
        self._last_device, self._last_host = device, t_host_ns
        if bucket != self._bucket:
            self._close_second(bucket, device)
        if self._bucket_min is None or delay < self._bucket_min[1]:
            self._bucket_min = (device, delay)
            if len(self._minima) < FIT_AFTER_S:
                self._refit(device)
        return False

    def _second_was_late(self) -> bool:
        """Whether all samples of the last second came later than the map by ``LATE_NS``."""
        if self._bucket_min is None:
            return False
        device, delay = self._bucket_min
        return delay - (self._host(device) - device) > LATE_NS

    def _restart(self, device: int, delay: int, early_ns: int, passed_us: float | None) -> bool:
        """Start again with this pair; True if the clock jumped, False if the first samples were late."""
        steady = (
            passed_us is not None
            and device > self._last_device
            and abs(device - self._last_device - passed_us * 1000.0) < EARLY_NS
            and early_ns > 0
        )
        self.resets += not steady
        self.stepped_ns -= early_ns if steady else 0
        self._start(device, device + delay)
        self.drains = steady
        self._bucket_min = (device, delay)
        return not steady

    def _close_second(self, bucket: int, device: int) -> None:
        if self._bucket_min is not None:
            self._minima.append(self._bucket_min)
            del self._minima[: -(WINDOW_S if self._round_trip is None else ASKED_WINDOW_S)]
        self._bucket, self._bucket_min = bucket, None
        self._refit(device)

    def lay_anew(self, t_device_us: int, t_host_ns: int) -> None:
        """The clock cannot be followed: begin again with this pair."""
        device = t_device_us * 1000
        self.resets += 1
        self.stepped_ns += t_host_ns - self._host(device)
        self._start(device, t_host_ns)
        self._bucket_min = (device, t_host_ns - device)

    def shift(self, by_us: int, before_us: int) -> None:
        """The device's clock jumped ahead by ``by_us`` after it was ``before_us``: host times go on as before.

        What was observed since then is forgotten.
        """
        jump, before = by_us * 1000, before_us * 1000
        self._origin += jump
        self._anchor_device += jump
        self._mapped += jump if self._mapped <= before else 0
        self._minima = [(device + jump, delay - jump) for device, delay in self._minima if device <= before]
        if self._bucket_min is not None:
            device, delay = self._bucket_min
            self._bucket_min = (device + jump, delay - jump) if device <= before else None
        self.stepped_ns -= jump

    def host_ns(self, t_device_us: int) -> int:
        """Where the map has this device time now."""
        return self._host(t_device_us * 1000)

    def observe_reply(self, t_device_us: int, sent_ns: int, t_host_ns: int) -> None:
        """A ping was sent at ``sent_ns``, answered at this device time, and the answer read at ``t_host_ns``."""
        device = t_device_us * 1000
        delay = t_host_ns - device
        # A reply is not used to detect a jump of the clock; the samples are.
        if self._bucket_min is None or abs(self._host(device) - t_host_ns) > EARLY_NS:
            return
        trip = t_host_ns - sent_ns
        self._round_trip = trip if self._round_trip is None else min(self._round_trip, trip)
        if (device - self._origin) // SECOND_NS == self._bucket and delay < self._bucket_min[1]:
            self._bucket_min = (device, delay)

    def to_host_ns(self, t_device_us: IntArray) -> IntArray:
        """Host time of samples in their order, (n,) int64 ns, n >= 1; rises with device time."""
        device = t_device_us * 1000
        since = device - self._anchor_device
        self._mapped = max(self._mapped, int(device[-1]))
        host: IntArray = self._anchor_host + since + np.rint(since * self._slope).astype(np.int64)
        return host

    def state(self) -> ClockState:
        """Skew, offset and residual of the current map."""
        return ClockState(
            self._skew * 1e6,
            self._anchor_host - self._anchor_device,
            self._residual,
            len(self._minima),
            self.resets,
            self._round_trip,
        )

    def _host(self, device: int) -> int:
        since = device - self._anchor_device
        return self._anchor_host + since + round(since * self._slope)

    def _refit(self, now: int) -> None:
        points = [*self._minima, self._bucket_min] if self._bucket_min is not None else list(self._minima)
        if not points:
            return
        stray = self._stray() if STRAY_POINTS <= len(self._minima) < FIT_AFTER_S else None
        if stray is not None:
            skew, intercept = stray
        elif len(self._minima) < FIT_AFTER_S:
            skew, intercept = 0.0, float(min(delay + MAX_SKEW * max(now - device, 0) for device, delay in points))
        else:
            skew, intercept = lower_line([(d - self._origin, y) for d, y in self._minima])
        self._skew = skew
        # The slope changes at the last stamp that was returned, so the map stays continuous.
        anchor = max(self._mapped, self._anchor_device)
        target = anchor + intercept + skew * (anchor - self._origin)
        host = self._host(anchor)
        error = target - host
        self._residual = error
        settling = now - self._origin < SETTLING_S * SECOND_NS or abs(error) > FAR_NS
        steer = min(max(error / (1.0 if settling else 5.0) / SECOND_NS, -STEER_SETTLING), STEER_SETTLING)
        self._anchor_device, self._anchor_host, self._slope = anchor, host, skew + steer

    def _stray(self) -> tuple[float, float] | None:
        """Slope and intercept if the clock is evidently worse than ``MAX_SKEW``."""
        points = [(d - self._origin, y) for d, y in self._minima]
        slope, intercept = lower_line(points)
        if abs(slope) <= MAX_SKEW or abs(slope) * (points[-1][0] - points[0][0]) < STRAY_NS:
            return None
        # A start that came late, or a stall, is no rate.
        return (slope, intercept) if all(y - slope * x - intercept < FAR_NS for x, y in points) else None


def lower_line(points: list[tuple[int, int]]) -> tuple[float, float]:
    """Slope and intercept of the lower-hull edge over the mean abscissa of ``points`` (x ns, y ns).

    Source: Zhang, Liu, Xia, "Clock synchronization algorithms for network measurements", 2002: of
    all lines below the points, this one has the least summed distance to them.
    """
    hull: list[tuple[int, int]] = []
    for p in sorted(points):
        while len(hull) >= 2 and (hull[-1][0] - hull[-2][0]) * (p[1] - hull[-2][1]) <= (hull[-1][1] - hull[-2][1]) * (
            p[0] - hull[-2][0]
        ):
            hull.pop()
        hull.append(p)
    middle = sum(x for x, _ in points) / len(points)
    for a, b in itertools.pairwise(hull):
        if a[0] <= middle <= b[0] and b[0] > a[0]:
            slope = (b[1] - a[1]) / (b[0] - a[0])
            return slope, a[1] - slope * a[0]
    return 0.0, float(min(y for _, y in points))
