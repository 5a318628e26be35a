# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads recordings for calibrate into arrays on a sample grid without gaps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.read.references import References, read_references, references_in
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import check_psds
from psd_deflection.recordings.sample_table import MAX_SAMPLES, held_at
from psd_deflection.recordings.spans import FULL, Span
from psd_deflection.records import CHANNELS, FloatArray
from psd_deflection.rig.config import Rig, check_two_psds, load_rig, replace_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.calibrate.calibrate import calibrate
from psd_deflection.studies.calibrate.dark import DarkLevel, dark_levels, values_of_levels
from psd_deflection.studies.calibrate.observation import CalibrationRun, usable_dots
from psd_deflection.studies.calibrate.result import Calibrated
from psd_deflection.studies.loads.annotated_times import correct_loads
from psd_deflection.studies.loads.effective import effective_loads
from psd_deflection.studies.study import Notify, opened


def read_run(
    source: Recording | str | Path,
    rig: Rig,
    *,
    reference: str | Path | None = None,
    exposure: float = 0.0,
    namespace: str | None = None,
    span: Span = FULL,
) -> CalibrationRun:
    """Return one recording: the recording or its path. Raises RecordingError if it cannot be read.

    ``reference``: a table of it, or another recording; None: in the recording. ``exposure``: time over which each
    reference is a mean, s. ``span``: the part of the recording that is meant.
    """
    recording = source if isinstance(source, Recording) else open_recording(source, namespace=namespace, span=span)
    path = recording.path
    check_two_psds(rig, 'a calibration')
    check_psds(recording, rig)
    samples = recording.samples
    first = int(samples['seq'][0])
    n = int(samples['seq'][-1]) - first + 1
    if n > MAX_SAMPLES:
        raise RecordingError(f'{path}: {n} samples; calibrate takes at most {MAX_SAMPLES}')
    if n < 4 * rig.estimator.block_size:
        raise RecordingError(f'{path}: {n} samples; calibrate needs at least 4 blocks')
    place = (samples['seq'] - first).astype(np.int64)
    volts = np.full((n, 6), np.nan)
    for i, channel in enumerate(CHANNELS):
        volts[place, i] = samples[channel]
    start = int(samples['t_ns'][0])
    t = np.interp(np.arange(n), place, (samples['t_ns'] - start).astype(np.float64)) * 1e-9
    given = references_in(recording) if reference is None else read_references(reference)
    references = References(np.zeros(0, np.int64), np.zeros((0, 3))) if given is None else given
    applied = recording.loads()
    loads: FloatArray | None = None
    if applied:
        times = np.array([a.t_ns - start for a in applied], dtype=np.int64)
        grace = 0.25e9 / rig.converter.sample_rate_hz
        loads = held_at(times, np.array([a[1:] for a in applied]), t * 1e9, grace, np.zeros(3))
    return CalibrationRun(
        recording.name,
        t,
        Wiring.from_rig(rig).to_psds(volts),
        (references.t_ns - start).astype(np.float64) * 1e-9,
        references.poses,
        loads,
        recording.digest,
        references.sd,
        exposure,
        '' if recording.hello is None else str(recording.hello.get('serial', '')),
        _ends([r.celsius for r in recording.temperatures()]),
        recording.moments(),
    )


def _ends(values: Sequence[float]) -> tuple[float, float] | None:
    return (min(values), max(values)) if values else None


def read_runs(
    sources: Sequence[Recording | str | Path],
    rig: Rig,
    *,
    references: Sequence[str | Path] = (),
    exposure: float = 0.0,
    namespace: str | None = None,
    span: Span = FULL,
) -> list[CalibrationRun]:
    """Return all of ``sources``; ``references``: none, or the reference of each."""
    tables: Sequence[str | Path | None] = references or [None] * len(sources)
    return [
        read_run(source, rig, reference=table, exposure=exposure, namespace=namespace, span=span)
        for source, table in zip(sources, tables, strict=True)
    ]


def with_effective_loads(run: CalibrationRun, rig: Rig, notify: Notify) -> CalibrationRun:
    """``run`` with the loads that hung, at the times at which they acted, without what swayed; ``notify`` gets what was
    noted wrong.
    """
    if run.loads is None:
        return run
    corrected = correct_loads(rig, usable_dots(run, rig), run.loads)
    loads, notes = (run.loads, ()) if corrected is None else (corrected.loads, corrected.notes)
    effective = effective_loads(rig, run.volts, loads)
    for note in (*notes, *effective.notes):
        notify(note.words(run.name))
    if corrected is None and not effective.notes:
        return run
    return replace(run, volts=effective.volts, loads=effective.loads)


def today() -> str:
    """Return the date of a calibration, UTC."""
    return datetime.now(UTC).date().isoformat()


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """What is asked of a calibration; it goes to a worker process.

    ``params_file``: of the rig as it is known; None: the rig in the first recording. ``exposure``: time over which
    each reference is a mean, s. ``alone``: by the redundant reading alone. ``references``: none, or one for each
    recording. ``dark``: recordings with the lasers off. ``date``: of the calibration.
    ``span``: the part of each of the recordings, not of ``dark``.
    """

    params_file: str | None = None
    namespace: str | None = None
    exposure: float = 0.0
    alone: bool = False
    references: tuple[str | Path, ...] = ()
    dark: tuple[Recording | str | Path, ...] = ()
    date: str = field(default_factory=today)
    span: Span = FULL

    def rig(self, recordings: Sequence[Recording | str | Path], notify: Notify) -> Rig:
        """Return the known rig; ``notify`` gets a warning if neither a file nor the recording names one."""
        if self.params_file is not None:
            return load_rig(self.params_file)
        return opened(recordings[0], namespace=self.namespace, span=self.span, notify=notify).rig

    def runs(self, recordings: Sequence[Recording | str | Path], rig: Rig) -> list[CalibrationRun]:
        """Return the recordings with their references."""
        return read_runs(
            recordings,
            rig,
            references=self.references,
            exposure=self.exposure,
            namespace=self.namespace,
            span=self.span,
        )

    def levels(self, rig: Rig, runs: Sequence[CalibrationRun]) -> list[DarkLevel]:
        """Return the light in the recordings of ``dark``; ``runs``: with the lasers on."""
        if not self.dark:
            return []
        return dark_levels([read_run(source, rig, namespace=self.namespace) for source in self.dark], rig, runs)

    def calibrated(
        self,
        runs: Sequence[CalibrationRun],
        rig: Rig,
        levels: Sequence[DarkLevel],
        progress: Callable[[str], None],
        notify: Notify,
    ) -> Calibrated:
        """Return the answer; ``notify`` gets a warning if a load was noted late, or if the rig file cannot be
        edited.
        """
        runs = [with_effective_loads(run, rig, notify) for run in runs]
        lit = replace_values(rig, values_of_levels(levels))
        calibration = replace(calibrate(runs, lit, alone=self.alone, progress=progress), dark=levels)
        return Calibrated(calibration, lit, self.params_file, self.date, notify)
