"""Reads recordings for calibrate into arrays on a sample grid without gaps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.read.grid import MAX_SAMPLES, digest_of, held_at
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.read.references import References, read_references, references_in
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import check_psds
from psd_deflection.records import CHANNELS, FloatArray
from psd_deflection.rig.config import Rig, check_two_psds
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.calibrate.observation import CalibrationRun


def read_run(
    source: Recording | str | Path,
    rig: Rig,
    *,
    reference: str | Path | None = None,
    exposure: float = 0.0,
    namespace: str | None = None,
) -> CalibrationRun:
    """One recording: the recording or its path. Raises RecordingError if it cannot be read.

    ``reference``: a table of it, or another recording; None: in the recording. ``exposure``: time over which each
    reference is a mean, s.
    """
    recording = source if isinstance(source, Recording) else open_recording(source, namespace=namespace)
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
    found = references_in(recording) if reference is None else read_references(reference)
    references = References(np.zeros(0, np.int64), np.zeros((0, 3))) if found is None else found
    applied = recording.loads()
    loads: FloatArray | None = None
    if applied:
        times = np.array([a.t_ns - start for a in applied], dtype=np.int64)
        grace = 0.25e9 / rig.converter.sample_rate_hz
        loads = held_at(times, np.array([a[1:] for a in applied]), t * 1e9, grace, np.zeros(3))
    return CalibrationRun(
        path.name,
        t,
        Wiring.from_rig(rig).to_psds(volts),
        (references.t_ns - start).astype(np.float64) * 1e-9,
        references.poses,
        loads,
        digest_of(path) if path.exists() else '',
        references.sd,
        exposure,
    )


def read_runs(
    sources: Sequence[Recording | str | Path],
    rig: Rig,
    *,
    references: Sequence[str | Path] = (),
    exposure: float = 0.0,
    namespace: str | None = None,
) -> list[CalibrationRun]:
    """All of ``sources``; ``references``: none, or the reference of each."""
    tables: Sequence[str | Path | None] = references or [None] * len(sources)
    return [
        read_run(source, rig, reference=table, exposure=exposure, namespace=namespace)
        for source, table in zip(sources, tables, strict=True)
    ]
