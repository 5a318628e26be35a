"""Counters of everything that a device sent or lost.

Every missing sample is counted once, under its cause if that is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field

BY_DEVICE = 'dropped by the device'
DAMAGED = 'damaged on the wire'
AWAY = 'while the port was away'
UNSEEN = 'on the wire, without a trace'
"""Why samples are missing."""


@dataclass(slots=True)
class AcquisitionCounters:
    """Samples and frames received and lost. Only the reader writes; any thread may read."""

    bytes: int = 0
    samples: int = 0
    lost: int = 0
    lost_by: dict[str, int] = field(default_factory=dict)
    repeated: int = 0
    queue_dropped: int = 0
    device_dropped: int = 0
    device_overruns: int = 0
    restarts: int = 0
    disconnects: int = 0
    silences: int = 0
    refused_reopenings: int = 0
    clock_jumps: int = 0
    pings: int = 0
    pongs: int = 0
    bad_frames: dict[str, int] = field(default_factory=dict)
    temperature: float | None = None

    @property
    def bad(self) -> int:
        """Malformed frames, all reasons together."""
        return sum(self.bad_frames.values())

    def count_lost(self, missing: int, cause: str) -> None:
        """Count ``missing`` samples as lost."""
        self.lost += missing
        self.lost_by[cause] = self.lost_by.get(cause, 0) + missing
