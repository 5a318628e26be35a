# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Independent measurements of the tip beside a recording: a table of a camera or a stage, or another recording.

The table is a CSV with a header: ``t`` (s) and ``dx,dy,theta`` (m, m, rad); ``sd_dx,sd_dy,sd_theta`` and ``status`` if
there are any. A row whose status is not ``ok`` has no measurement. ``psd-deflection camera`` writes such tables.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from psd_deflection.base.csv_table import CsvTable
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.sanitize import sanitize
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.csv_rows import MAX_SECONDS
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import replayed
from psd_deflection.records import (
    BlockStatus,
    DeflectionEstimate,
    FloatArray,
    IntArray,
    ReferencePose,
    SampleBlock,
    SpotMeans,
)

POSE = ('dx', 'dy', 'theta')
DEVIATIONS = ('sd_dx', 'sd_dy', 'sd_theta')
MAX_ROWS = 10_000_000
LONGEST_STATUS = 80


@dataclass(frozen=True)
class References:
    """Measurements in order of time.

    ``t_ns`` int64 (k,). ``poses`` (k, 3): m, m, rad. ``sd`` (k, 3) if the instrument states them. ``rejected``: status
    of the measurements that have no answer, and how many there are of each.
    """

    t_ns: IntArray
    poses: FloatArray
    sd: FloatArray | None = None
    rejected: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class TrustedSamples:
    """All trusted samples of a recording.

    ``t_ns`` int64 (n,). ``dots`` (n, 4), m, calibrated and corrected. ``estimate_sd`` (3,): median standard deviation
    of the published estimates, m, m, rad.
    """

    t_ns: IntArray
    dots: FloatArray
    estimate_sd: FloatArray


def references_of(recording: Recording) -> References:
    """The references in the recording; raises RecordingError if it has none."""
    found = references_in(recording)
    if found is None:
        raise RecordingError(
            f'{recording.path}: holds no reference (CSV columns ref_dx, ref_dy, ref_theta, or the topic '
            f'/reference/deflection); give one with --reference FILE'
        )
    return found


def references_in(recording: Recording) -> References | None:
    """The references in the recording, with the standard deviations that came with each; None if it has none."""
    stated = recording.references_with_covariance()
    found = recording.references() or [ReferencePose(r.t_ns, r.dx, r.dy, r.theta) for r in stated]
    if not found:
        return None
    variances = {r.t_ns: (r.covariance[0], r.covariance[4], r.covariance[8]) for r in stated}
    own = np.array([variances.get(r.t_ns, (0.0, 0.0, 0.0)) for r in found])
    # ROS states an unknown covariance as zeros.
    sd = np.sqrt(own) if np.all(own > 0.0) else None
    t_ns = np.array([r.t_ns for r in found], dtype=np.int64)
    return _in_order(t_ns, np.array([r[1:] for r in found]), sd, {})


def read_references(path: str | Path) -> References:
    """The references of a table, or of a recording. Raises RecordingError naming file, line and column of a fault."""
    path = Path(path)
    if path.suffix.lower() == '.csv' and 'x1' not in (table := CsvTable(path)).columns:
        return _of_table(table)
    return references_of(open_recording(path))


def _in_order(t_ns: IntArray, poses: FloatArray, sd: FloatArray | None, rejected: Mapping[str, int]) -> References:
    order = np.argsort(t_ns, kind='stable')
    return References(t_ns[order], poses[order], None if sd is None else sd[order], rejected)


def _of_table(table: CsvTable) -> References:
    wanted = ('t', *POSE)
    table.require(wanted, f'a table has {",".join(wanted)}', (*DEVIATIONS, 'status'))
    deviations = DEVIATIONS if all(name in table.columns for name in DEVIATIONS) else ()
    rows: list[list[float]] = []
    rejected: Counter[str] = Counter()
    for row in table.table_rows():
        if len(rows) >= MAX_ROWS:
            raise row.reject(f'has more than {MAX_ROWS} rows')
        word = row.text('status') if 'status' in table.columns else 'ok'
        if word != 'ok':
            rejected[sanitize(word, LONGEST_STATUS)] += 1
            continue
        rows.append([row.number(name, MAX_SECONDS) for name in (*wanted, *deviations)])
    if not rows:
        raise table.reject('holds no measurement with the status ok')
    values = np.array(rows)
    t_ns = np.rint(values[:, 0] * 1e9).astype(np.int64)
    return _in_order(t_ns, values[:, 1:4], values[:, 4:7] if deviations else None, dict(rejected))


def read_run(recording: Recording, pipeline: Pipeline, blocks: Iterable[SampleBlock] | None = None) -> TrustedSamples:
    """The samples of all blocks that ``pipeline``, made with the recording's block size, trusts.

    ``blocks``: the recording's, for a caller that counts them. Raises RecordingError if it trusts none.
    """
    times: list[IntArray] = []
    dots: list[FloatArray] = []
    deviations: list[FloatArray] = []
    trusted = False
    for records in replayed(recording, pipeline, blocks):
        for record in records:
            if isinstance(record, SpotMeans):
                trusted = record.status is BlockStatus.OK
            elif isinstance(record, SampleBlock) and trusted:
                times.append(record.t_ns)
                dots.append(pipeline.dots(record))
            elif isinstance(record, DeflectionEstimate) and record.primary:
                deviations.append(np.array(record.covariance).reshape(3, 3).diagonal())
    if not times:
        raise RecordingError(f'{recording.path}: no block has an estimate, so there is nothing to compare')
    return TrustedSamples(
        np.concatenate(times).astype(np.int64),
        np.concatenate(dots),
        np.sqrt(np.median(np.array(deviations), axis=0)) if deviations else np.full(3, np.nan),
    )
