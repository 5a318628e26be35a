# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The samples of a recording as an array, and as a table with what was recorded beside them."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from psd_deflection.base.errors import RecordingError
from psd_deflection.base.tables import Column, Table, columns_of
from psd_deflection.records import AppliedLoad, FloatArray, IntArray, ReferencePose, TemperatureReading, channel_names

LOAD_COLUMNS = ('load_fx', 'load_fy', 'load_tz')
TEMPERATURE_COLUMN = 'temperature'
REFERENCE_COLUMNS = ('ref_dx', 'ref_dy', 'ref_theta')


def sample_dtype(psds: int) -> np.dtype[np.void]:
    """A sample. ``t``: s from the first sample. ``t_ns``: ns since the epoch, or since the CSV's zero."""
    volts = [(c, '<f4') for c in channel_names(psds)]
    return np.dtype([('t', '<f8'), ('t_ns', '<i8'), ('seq', '<i8'), *volts, ('flags', 'u1')])


def samples_table(
    samples: npt.NDArray[np.void],
    psds: int,
    loads: Sequence[AppliedLoad],
    temperatures: Sequence[TemperatureReading],
    references: Sequence[ReferencePose],
    path: str,
) -> Table:
    """One row a sample. Loads and temperatures are held; a reference is in the first row at or after its time."""
    t_ns = samples['t_ns']
    columns = [
        Column('seq', samples['seq'], '', 'number of the sample'),
        Column('t_ns', t_ns, 'ns', 'time, since the epoch if the recording has it'),
        *(Column(name, samples[name], 'V', f'channel {name}') for name in channel_names(psds)),
        Column('flags', samples['flags'], '', 'bit 0: over range, bit 1: samples were dropped before this one'),
    ]
    if loads:
        words = ['applied force along X', 'applied force along Y', 'applied torque about Z']
        columns += columns_of(_held(loads, t_ns), LOAD_COLUMNS, ('N', 'N', 'N m'), words)
    if temperatures:
        columns += columns_of(_held(temperatures, t_ns), (TEMPERATURE_COLUMN,), ('degC',), ['ambient temperature'])
    if references:
        words = ['reference displacement along X', 'reference displacement along Y', 'reference twist about Z']
        columns += columns_of(_once(references, t_ns), REFERENCE_COLUMNS, ('m', 'm', 'rad'), words)
    return Table(Column('t', samples['t'], 's', 'time from the first sample'), columns, {'path': path})


def _held(records: Sequence[AppliedLoad] | Sequence[TemperatureReading], t_ns: IntArray) -> FloatArray:
    """The values of ``records`` (n, number of values) at ``t_ns``, each held from its time; NaN before the first."""
    times = np.array([f.t_ns for f in records], dtype=np.int64)
    order = np.argsort(times, kind='stable')
    values = np.array([records[i][1:] for i in order], dtype=np.float64)
    index = np.searchsorted(times[order], t_ns, side='right') - 1
    out: FloatArray = values[np.maximum(index, 0)]
    out[index < 0] = np.nan
    return out


def _once(references: Sequence[ReferencePose], t_ns: IntArray) -> FloatArray:
    """The values of ``references`` (n, 3), each at the first of ``t_ns`` at or after its time; NaN in the others."""
    out = np.full((len(t_ns), 3), np.nan)
    index = np.searchsorted(t_ns, [f.t_ns for f in references], side='left')
    inside = index < len(t_ns)
    out[index[inside]] = np.array([f[1:] for f in references], dtype=np.float64)[inside]
    return out


MAX_SAMPLES = 20_000_000
"""Samples of a recording that is taken into memory whole."""


def held_at(
    times: IntArray, values: FloatArray, t_ns: FloatArray, grace: float, before: FloatArray | float
) -> FloatArray:
    """``values`` (k, ...) from ``times`` (k,) ns on, at ``t_ns`` or up to ``grace`` ns later; ``before`` the first."""
    order = np.argsort(times, kind='stable')
    index = np.searchsorted(times[order], t_ns + grace, side='right') - 1
    out = values[order][np.maximum(index, 0)].astype(np.float64)
    out[index < 0] = before
    return out


def digest_of(path: Path) -> str:
    """SHA-256 of a file, or of all files of a folder. Raises RecordingError if one cannot be read."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob('*') if p.is_file()) if path.is_dir() else [path]
    try:
        for file in files:
            with file.open('rb') as stream:
                while piece := stream.read(1 << 20):
                    digest.update(piece)
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
    return digest.hexdigest()
