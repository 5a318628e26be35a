# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs the watch over a recording, by the records that its replay gives (as ``replay --watch``); its answer: alarms."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from psd_deflection.base.charts import Chart, Panel, Series, TimeAxis
from psd_deflection.base.pages import table
from psd_deflection.base.tables import Column, Table, text_column
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.watch import Alarm, alarm_sentences
from psd_deflection.recordings.charts import FROM_FIRST, moments
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import WatchedReplay, replayed
from psd_deflection.records import Moment, SampleBlock
from psd_deflection.rig.config import Rig
from psd_deflection.studies.study import PageSection, StudyResult


@dataclass(frozen=True, repr=False)
class WatchedRun(StudyResult):
    """The alarms of a recording, the first first. ``start_ns``: of its first sample.

    ``watched``: what was watched, in words; ``marks``: of the recording, from its first sample.
    ``seconds``: it took. ``made_from``: see :attr:`StudyResult.sources`.
    """

    alarms: tuple[Alarm, ...]
    watched: str
    start_ns: int
    made_from: Mapping[str, str]
    marks: tuple[Moment, ...] = ()
    seconds: float = 0.0

    study = 'watch'
    title = 'Does the rig still match its model?'
    json_name = 'watch.json'

    def since_s(self, alarm: Alarm) -> float:
        """When an alarm began, s from the first sample."""
        return (alarm.since_ns - self.start_ns) / 1e9

    def sentences(self) -> list[str]:
        """Return each alarm with its time; or that there was none, and what was watched."""
        return alarm_sentences(self.alarms, self.start_ns, self.watched)

    def tree(self) -> dict[str, Any]:
        """Return the alarms: times in s from the first sample, shifts in m (of theta in rad)."""
        return {
            'same': not self.alarms,
            'watched': self.watched,
            'alarms': [
                {
                    'since_s': self.since_s(a),
                    'seen_s': (a.observed_ns - self.start_ns) / 1e9,
                    'channel': a.channel,
                    'shift': a.shift,
                    'sd': a.sd,
                    'also': list(a.also),
                }
                for a in self.alarms
            ],
        }

    def sections(self) -> Iterable[PageSection]:
        """Return the alarms as a table."""
        rows = [
            (f'{self.since_s(a):.1f}', a.channel, f'{a.shift * 1e6:z.2f} ± {a.sd * 1e6:.2f}', ', '.join(a.also))
            for a in self.alarms
        ]
        if rows:
            words = table(('since, s', 'what', 'shift, µm (theta: µrad)', 'also'), rows)
            yield PageSection('Alarms', (words, self._chart()))

    def _chart(self) -> Chart:
        along = TimeAxis(FROM_FIRST, self.marks)
        panels = []
        for channel in dict.fromkeys(a.channel for a in self.alarms):
            alarms_of_channel = [a for a in self.alarms if a.channel == channel]
            t, shift, sd = np.array([(self.since_s(a), 1e6 * a.shift, 1e6 * a.sd) for a in alarms_of_channel]).T
            series = Series('', t, shift, 'red', 'points', 1.96 * sd)
            label = f'{channel} / {"µrad" if channel == "theta" else "µm"}'
            model = Series('', np.array([0.0, max(self.seconds, *t)]), np.zeros(2), 'quiet')
            panels.append(Panel((model, series), along, label))
        return Chart('what shifted, since when and by how much (95 %)', panels)

    @property
    def sources(self) -> Mapping[str, str]:
        """Recording and rig."""
        return self.made_from

    def table(self) -> Table:
        """One row an alarm over ``since`` (s from the first sample): ``seen`` s, ``channel``, ``shift`` and ``sd``.

        Shifts are in m, of ``theta`` in rad.
        """
        alarms = self.alarms
        return Table(
            Column('since', np.array([self.since_s(a) for a in alarms], dtype=np.float64), 's', 'when it began'),
            [
                Column(
                    'detected',
                    np.array([(a.observed_ns - self.start_ns) / 1e9 for a in alarms]),
                    's',
                    'when it was sure',
                ),
                text_column('channel', [a.channel for a in alarms], 'what shifted'),
                Column('shift', np.array([a.shift for a in alarms], dtype=np.float64), 'm, rad', 'by how much'),
                Column('sd', np.array([a.sd for a in alarms], dtype=np.float64), 'm, rad', 'its standard deviation'),
            ],
            {'watched': self.watched},
        )


def watch(recording: Recording, rig: Rig, sources: dict[str, str]) -> WatchedRun:
    """The alarms of ``recording`` with ``rig``, as it was at the start. Raises RecordingError and SolverError."""
    watched = WatchedReplay(rig, recording)
    start_ns: int | None = None
    last_ns = 0
    for records in replayed(recording, Pipeline(rig)):
        for record in records:
            if start_ns is None and isinstance(record, SampleBlock):
                start_ns = int(record.t_ns[0])
            if isinstance(record, SampleBlock):
                last_ns = int(record.t_ns[-1])
            watched.put(record)
    first_ns = start_ns or 0
    marks = moments(recording.marks(), first_ns)
    alarms, state = tuple(watched.alarms), str(watched.watch.state)
    return WatchedRun(alarms, state, first_ns, sources, marks, (last_ns - first_ns) / 1e9)
