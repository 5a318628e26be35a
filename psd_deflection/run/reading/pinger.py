# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Asks the device for its time now and then, at random phase to its samples.

It reads no clock: every time comes from the caller.
"""

from __future__ import annotations

import random

from psd_deflection.devices.source import Source

PING_S = (0.1, 0.4)
"""Bounds of the random time between two pings: their phase to the samples must not repeat."""

UNANSWERED = 20
"""After this many unanswered pings in a row the device does not support them, and gets no more."""

MOST_UNDER_WAY = 100
"""Pings that may still be answered."""

ANSWER_NS = 20_000_000
"""An answer is awaited for this time; it may come later."""


class Pinger:
    """Keeps the last pings under way: an answer that is seconds late shows how late the line is."""

    def __init__(self) -> None:
        self._random = random.Random()
        self._next_s = 0.0
        self._unanswered = 0
        self._under_way: dict[int, int] = {}
        self._sent_ns: int | None = None

    def is_due(self, now_s: float) -> bool:
        """Whether the next ping is due."""
        return self._unanswered < UNANSWERED and now_s >= self._next_s

    def awaits(self, now_ns: int) -> bool:
        """Whether an answer may come at any moment. ``now_ns``: CLOCK_MONOTONIC."""
        return self._sent_ns is not None and now_ns - self._sent_ns < ANSWER_NS

    def ask(self, source: Source, now_s: float, sent_ns: int) -> bool:
        """Ping ``source``; False if it cannot be asked. ``sent_ns``: CLOCK_MONOTONIC.

        Raises PortClosedError.
        """
        self._next_s = now_s + self._random.uniform(*PING_S)
        cookie = self._random.getrandbits(63)
        if not source.ping(cookie):
            self._unanswered = UNANSWERED
            return False
        self._unanswered += 1
        self._under_way = dict([*self._under_way.items()][1 - MOST_UNDER_WAY :])
        self._under_way[cookie] = self._sent_ns = sent_ns
        return True

    def answered(self, cookie: int) -> int | None:
        """When the ping with this cookie was sent, ns; None if it is none of those under way."""
        sent_ns = self._under_way.pop(cookie, None)
        if sent_ns is not None:
            self._unanswered = 0
            self._sent_ns = None if sent_ns == self._sent_ns else self._sent_ns
        return sent_ns
