# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""When the link moved last, by the dots of the last minute: a weight is noted after it was hung."""

from collections import deque

import numpy as np

from psd_deflection.measure.steps import last_load_change
from psd_deflection.records import BlockStatus, Record, SpotMeans
from psd_deflection.rig.config import Rig

REACH_S = 60.0
"""A step that is older is not looked for."""


class RecentDots:
    """A sink of records. It keeps the dots of two PSDs for ``REACH_S`` and computes when asked."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._period = rig.estimator.block_size / rig.converter.sample_rate_hz
        self._most = max(2, round(REACH_S / self._period))
        self._rows: deque[tuple[int, int, tuple[float, ...]]] = deque(maxlen=self._most)

    def put(self, record: Record) -> None:
        """Keep the dots of a good block."""
        if isinstance(record, SpotMeans) and record.status is BlockStatus.OK:
            self._rows.append((record.index, record.t_ns, record.dots[:4]))

    def step_ns(self) -> int | None:
        """When the last lasting step of the dots was, ns, or None. From any thread."""
        rows = tuple(self._rows)
        if not rows:
            return None
        last, last_ns, _ = rows[-1]
        # Blocks that are missing are rows without dots. After a restart numbers may begin anew.
        first = max(min(index for index, _, _ in rows), last - self._most + 1)
        dots = np.full((last - first + 1, 4), np.nan)
        for index, _, values in rows:
            if first <= index <= last:
                dots[index - first] = values
        step_s = last_load_change(self._rig, dots, self._period)
        # Times are those of the middles of blocks; a step lies between two.
        ago_s = None if step_s is None else (last - first + 0.5) * self._period - step_s
        return None if ago_s is None else last_ns - round(ago_s * 1e9)
