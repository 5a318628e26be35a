# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A server whose source and clock are the test's."""

import dataclasses
import threading
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection.base.log import texts
from psd_deflection.measure.watch import Alarm
from psd_deflection.records import BlockStatus, DeflectionEstimate, DiagnosticEntry, DiagnosticReport, SpotMeans
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run.monitor.feed import Feed
from psd_deflection.run.monitor.metrics import Family, counter
from psd_deflection.run.monitor.server import MonitorServer
from psd_deflection.run.monitor.shown import RejectedError
from test.heard import until

START_NS = 1_700_000_000_000_000_000
BLOCK_NS = 20_000_000


class StillShown:
    """Remembers what was asked of it; ``rejection`` is what it answers, where there is one."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.zeros = 0
        self.loads: list[tuple[float, float, float, bool]] = []
        self.agos: list[float | None] = []
        self.lates: list[float] = []
        self.stepped = '3.40'
        self.marks: list[str] = []
        self.played: list[tuple[bool | None, float | None]] = []
        self.recordings: list[str | None] = []
        self.rejection = ''
        self.folder = 'recordings/test'
        self.reports = 0
        self.alarmed: Alarm | None = None
        self.finished = threading.Event()

    def describe(self) -> dict[str, Any]:
        return {'kind': 'live', 'name': 'test', 'recording': self.recordings[-1] if self.recordings else None}

    def health(self, t_ns: int) -> DiagnosticReport:
        self.reports += 1
        return DiagnosticReport(
            t_ns, (DiagnosticEntry('psd_deflection: acquisition', 0, 'samples flow', (('rate (samples/s)', '1000'),)),)
        )

    def metrics(self) -> list[Family]:
        return [counter('samples', 'Samples that came', 40)]

    def zero(self, late_s: float) -> str:
        self.lates.append(late_s)
        if self.rejection:
            raise RejectedError(self.rejection)
        self.zeros += 1
        self.finished.set()
        return 'unloaded dots taken'

    async def record(self, wanted: bool) -> str:
        if self.rejection:
            raise RejectedError(self.rejection)
        self.recordings.append(self.folder if wanted else None)
        return 'recording' if wanted else 'recording ended'

    def load(self, fx: float, fy: float, tz: float, add: bool, ago_s: float | None, late_s: float) -> str:
        if self.rejection:
            raise RejectedError(self.rejection)
        self.loads.append((fx, fy, tz, add))
        self.agos.append(ago_s)
        self.lates.append(late_s)
        return 'load noted'

    def step(self) -> str:
        if self.rejection:
            raise RejectedError(self.rejection)
        return self.stepped

    def mark(self, text: str, late_s: float) -> str:
        if self.rejection:
            raise RejectedError(self.rejection)
        self.marks.append(text)
        self.lates.append(late_s)
        return f'mark: {text}'

    def play(self, paused: bool | None, seek_s: float | None) -> str:
        self.played.append((paused, seek_s))
        return 'playing'

    def alarm(self) -> Alarm | None:
        return self.alarmed

    def history_file(self) -> Path | None:
        return None


def spots_of(index: int, *, status: BlockStatus = BlockStatus.OK, lost: int = 0) -> SpotMeans:
    phase = index / 10.0
    dots = (1e-3 * np.cos(phase), 2e-3 * np.sin(phase), 0.5e-3, -1e-3 * np.sin(phase))
    t_ns, why = START_NS + index * BLOCK_NS, '' if status is BlockStatus.OK else 'a reason'
    places = (float(dots[0]), float(dots[1]), dots[2], float(dots[3]))
    return SpotMeans(t_ns, index, places, (5.0, 5.0), np.zeros((4, 4)), 20 - lost, lost, status, why)


def estimate_of(index: int, *, primary: bool = True, scale: float = 1.0) -> DeflectionEstimate:
    phase = index / 10.0
    sd = (2e-7 * scale, 3e-7 * scale, 3e-6 * scale)
    covariance = (sd[0] ** 2, 0.0, 0.0, 0.0, sd[1] ** 2, 0.0, 0.0, 0.0, sd[2] ** 2)
    pose = (float(1e-3 * np.sin(phase)), float(-1e-3 * np.cos(phase)), float(1e-2 * np.sin(phase)))
    return DeflectionEstimate(
        START_NS + index * BLOCK_NS, index, 'exact', *pose, 0.0, 0.0, covariance, 1e-7, primary=primary
    )


class Serving:
    """A started server with what it shows."""

    def __init__(self, overrides: dict[str, object]) -> None:
        self.rig = load_rig(overrides={'monitor_port': 0, **overrides})
        self.shown = StillShown(self.rig)
        self.feed = Feed()
        self.logged: list[str] = []
        self.server = MonitorServer(self.shown, self.feed, self.rig.monitor, texts(self.logged.append))
        self.url = self.server.start()
        self.port = int(self.url.rstrip('/').rpartition(':')[2])

    def give(self, first: int, count: int, *, scale: float = 1.0, every: int = 1, **options: Any) -> None:
        """Blocks ``first`` and so on; ``every`` times as slowly as the rig would."""
        for index in range(first, first + count):
            t_ns = START_NS + index * every * BLOCK_NS
            if options.get('status', BlockStatus.OK) is BlockStatus.OK:
                self.feed.put(estimate_of(index, scale=scale)._replace(t_ns=t_ns))
            self.feed.put(dataclasses.replace(spots_of(index, **options), t_ns=t_ns))

    def settle(self) -> None:
        """Wait until the server has taken what was given."""
        until(lambda: not self.feed.waiting)
