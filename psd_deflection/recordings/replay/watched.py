# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The watch over a replay: it hears of loads and changes when the run did."""

from __future__ import annotations

from collections.abc import Callable

from psd_deflection.measure.watch import Alarm, Watch
from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.model.simulation.tip_load import TipLoads
from psd_deflection.recordings.recording import Recording, RecordingWindow
from psd_deflection.records import ParameterChange, Record, SampleBlock
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.rig.declarations import BY_NAME


class WatchedReplay:
    """Takes the records of a replay of ``recording`` with ``rig``. ``alarms``: all, the first first.

    ``raised``: gets each, as soon as it is sure. ``part``: what is given, if it is not the whole; its loads.
    """

    def __init__(
        self,
        rig: Rig,
        recording: Recording,
        raised: Callable[[Alarm], None] = lambda alarm: None,
        part: RecordingWindow | None = None,
    ) -> None:
        self.watch = Watch(rig, TipLoads(rig, effects_of_rig(rig)).compliance)
        self.alarms: list[Alarm] = []
        self._rig, self._raised = rig, raised
        self._loads = (recording if part is None else part).loads()[::-1]

    def put(self, record: Record) -> None:
        """One record."""
        if isinstance(record, ParameterChange):
            values = {n: list(v) if isinstance(v, tuple) else v for n, v in record.values if n in BY_NAME}
            self._rig = replace_values(self._rig, values) if values else self._rig
            self.watch.changed(record, self._rig)
            return
        self.watch.put(record)
        if isinstance(record, SampleBlock):
            if self.watch.alarms > len(self.alarms) and self.watch.alarm is not None:
                self.alarms.append(self.watch.alarm)
                self._raised(self.watch.alarm)
            # As live: a load is noted between two blocks.
            while self._loads and self._loads[-1].t_ns <= record.t_ns[-1]:
                self.watch.put(self._loads.pop())
