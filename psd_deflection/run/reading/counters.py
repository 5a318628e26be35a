# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Counters of everything that a device sent or lost.

Every missing sample is counted once, under its cause if that is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from psd_deflection.base.bounds import Tally

BY_DEVICE = 'dropped by the device'
DAMAGED = 'damaged on the wire'
AWAY = 'while the port was away'
UNSEEN = 'on the wire, without a trace'
"""Why samples are missing."""


@dataclass(slots=True)
class AcquisitionCounters:
    """Samples and frames received and lost. Only the reader writes; any thread may read.

    ``map_steps``: of the time map, by more than a millisecond; ``squeezed``: samples with stamps 1 ns apart after one.
    ``queue_dropped``: samples that were read, and for which there was no room to wait; ``abandoned``: those that still
    waited at the end of the run; ``dropped_why``: the last reason of either.
    """

    bytes: int = 0
    samples: int = 0
    lost: int = 0
    lost_by: Tally = field(default_factory=Tally)
    repeated: int = 0
    queue_dropped: int = 0
    abandoned: int = 0
    dropped_why: str = ''
    device_dropped: int = 0
    device_overruns: int = 0
    restarts: int = 0
    disconnects: int = 0
    silences: int = 0
    rejected_reopenings: int = 0
    clock_jumps: int = 0
    map_steps: int = 0
    squeezed: int = 0
    pings: int = 0
    pongs: int = 0
    bad_frames: Tally = field(default_factory=Tally)
    temperature: float | None = None

    @property
    def bad(self) -> int:
        """Malformed frames, all reasons together."""
        return self.bad_frames.total()

    @property
    def dropped_here(self) -> int:
        """Samples that were read and are not processed."""
        return self.queue_dropped + self.abandoned

    def count_lost(self, missing: int, cause: str) -> None:
        """Count ``missing`` samples as lost."""
        self.lost += missing
        self.lost_by.add(cause, missing)
