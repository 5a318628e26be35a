# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""References without samples, as a table of readings: a row for each time in which one load hung and the link rested.

A camera or a stage measures the tip's pose while loads hang on the link; nobody recorded the PSDs. What the simulation
lacks of the link and of the loads can be found in that, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.read.readings_table import TIMES, ReadingsTable
from psd_deflection.recordings.read.references import references_in
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.discover.search.fit import BoolArray
from psd_deflection.studies.discover.setup.noise import settling

FEWEST = 3
"""References of a row."""
FAR = 5.0
"""Standard deviations of most references under one load: what is further off is not under it."""
MOST_OF_IT = 0.5
"""Share of the time under one load that is waited for the link to come to rest, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Resting:
    """``loads`` (k, 3) N, N, N m; ``poses`` (k, 3) m, m, rad; ``temperature`` (k,) degrees Celsius or None."""

    loads: FloatArray
    poses: FloatArray
    temperature: FloatArray | None


def resting_in(recording: Recording, rig: Rig) -> Resting:
    """The references of a recording without samples. Raises RecordingError if it has no loads or too few of them."""
    references = references_in(recording)
    applied = sorted(recording.loads(), key=lambda load: load.t_ns)
    if references is None or not applied:
        raise RecordingError(
            f'{recording.path}: holds references, but neither samples nor loads; loads (topic /link_tip/load) are '
            f'needed to compare it with a simulation'
        )
    start = int(references.t_ns[0])
    t = np.asarray((references.t_ns - start) * 1e-9, dtype=np.float64)
    times = np.array([(a.t_ns - start) * 1e-9 for a in applied], dtype=np.float64)
    warm = recording.temperatures()
    at = np.array([(w.t_ns - start) * 1e-9 for w in warm])
    celsius = np.asarray(np.interp(t, at, [w.celsius for w in warm]), dtype=np.float64) if warm else None
    return _rows(
        str(recording.path),
        rig,
        times,
        np.array([a[1:] for a in applied], dtype=np.float64),
        t,
        references.poses,
        celsius,
    )


def resting_rows(
    table: ReadingsTable, rig: Rig, loads: FloatArray, poses: FloatArray, warm: FloatArray | None
) -> Resting:
    """The references of a table with times, of which each row says its load (n, 3); a pose that is not there is NaN."""
    t = table.column(TIMES)
    order = np.argsort(t, kind='stable')
    celsius = None if warm is None else warm[order]
    return _rows(str(table.path), rig, t[order], loads[order], t[order], poses[order], celsius)


def _rows(
    name: str,
    rig: Rig,
    annotated: FloatArray,
    loads: FloatArray,
    t: FloatArray,
    poses: FloatArray,
    warm: FloatArray | None,
) -> Resting:
    """Medians of ``poses`` (n, 3) at ``t`` (n,) s, between changes of ``loads`` (k, 3) that were noted at (k,) s.

    A load is often noted late. If more than half of the time is under it, what is far from the median is not.
    """
    new = np.append(True, np.any(np.diff(loads, axis=0) != 0.0, axis=1))
    starts, changed = annotated[new], loads[new]
    stops = np.append(starts[1:], math.inf)
    there = np.isfinite(poses).all(axis=1)
    of, means, celsius = list[FloatArray](), list[FloatArray](), list[float]()
    for load, start, stop in zip(changed, starts, stops, strict=True):
        end = min(stop, float(t[-1]))
        applied = there & (t >= start) & (t < stop)
        if np.count_nonzero(applied) < FEWEST:
            continue
        settled_samples = (
            applied & _near(poses, applied) & (t >= start + min(settling(rig), MOST_OF_IT * max(end - start, 0.0)))
        )
        if np.count_nonzero(settled_samples) >= FEWEST:
            of.append(load)
            means.append(np.median(poses[settled_samples], axis=0))
            celsius.append(math.nan if warm is None else float(warm[settled_samples].mean()))
    if not of:
        raise RecordingError(f'{name}: no load hung for as long as {FEWEST} references')
    return Resting(np.array(of), np.array(means), None if warm is None else np.array(celsius))


def _near(poses: FloatArray, applied: BoolArray) -> BoolArray:
    """(n,): whether ``poses`` (n, 3) are about as near to the median of those that ``applied`` as most of them."""
    off = np.abs(poses - np.median(poses[applied], axis=0))
    return np.asarray((off <= FAR * 1.4826 * np.median(off[applied], axis=0)).all(axis=1))
