# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs the watch over a recording, by the records that its replay gives: the same as ``replay --watch``."""

from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.charts import moments
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import WatchedReplay, replayed
from psd_deflection.records import SampleBlock
from psd_deflection.rig.config import Rig
from psd_deflection.studies.watch.result import WatchedRun


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
