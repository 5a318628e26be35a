"""The output of calibrate: calibration.json and the values of the rig file (docs/calibration.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from psd_deflection import __version__
from psd_deflection.model.misalignment.model import ALL, COUNT, ZERO
from psd_deflection.model.misalignment.rig import CLAMP, rig_values
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.studies.calibrate.calibrate import Calibration
from psd_deflection.studies.calibrate.dark import result_of_levels, source_of_levels, values_of_levels
from psd_deflection.studies.calibrate.fit import CLAMP_AT, CLOCK, NAMES
from psd_deflection.studies.calibrate.observation import CHANNEL_NAMES

REPORTED = (*range(ZERO), CLAMP_AT, CLAMP_AT + 1)
"""Parameters of calibration.json, by their index: the zero has a place of its own."""
UNITS = (*(p.unit for p in ALL), *(['rad/(N m)'] * len(CLAMP)), 's')


def result(found: Calibration, date: str) -> dict[str, Any]:
    """The tree of calibration.json. ``date``: of the calibration, for the provenance."""
    sd = found.sd

    def one(i: int) -> dict[str, Any]:
        file = float(found.prior.mean[i])
        return {'value': float(found.values[i]), 'sd': float(sd[i]), 'unit': UNITS[i], 'file': file}

    at = list(REPORTED)
    reference = found.fit.noise.reference
    return {
        'parameters': {NAMES[i]: one(i) for i in at},
        'covariance': {'names': [NAMES[i] for i in at], 'matrix': found.covariance[np.ix_(at, at)].tolist()},
        'undetermined': [{'direction': d.parts, 'needs': d.needs} for d in found.undetermined],
        'noise': dict(zip(CHANNEL_NAMES, found.noise.tolist(), strict=True)),
        'gap': {'unit': 'm', **found.gap._asdict()},
        'kind': found.kind,
        'zero': {NAMES[i]: one(i) for i in range(ZERO, COUNT)},
        'reference': {
            'noise': dict(zip(('dx', 'dy', 'theta'), reference.tolist(), strict=True)),
            'clock_offset': {'value': found.clock + float(found.values[CLOCK]), 'sd': float(sd[CLOCK]), 'unit': 's'},
            'rows': len(found.rows),
            'outliers': int(np.sum(found.fit.weights == 0.0)),
        }
        if found.kind == 'reference'
        else None,
        'dark': result_of_levels(found.dark) or None,
        'refused': found.refused or None,
        'widened': found.widened,
        'dropped': found.dropped,
        'provenance': {
            'version': __version__,
            'date': date,
            'recordings': [{'name': run.name, 'sha256': run.digest} for run in found.runs],
        },
    }


def source_of(found: Calibration, date: str) -> str:
    """Where a calibrated rig file comes from, in one line."""
    recordings = ', '.join(f'{run.name} (sha256 {run.digest[:16]})' for run in found.runs)
    dark = f'; dark levels from {source_of_levels(found.dark)}' if found.dark else ''
    return f'psd-deflection {__version__}, {date}, from {recordings}{dark}'


def values_of(found: Calibration, date: str) -> tuple[dict[str, object], list[ActiveEffect]]:
    """Flat values that a rig file gets, and its effects; noise and dark levels alone if the calibration was refused."""
    noise = {f'psd_{n}.noise': [float(f'{v:.4g}') for v in found.noise[2 * n - 2 : 2 * n]] for n in (1, 2)}
    measured = {**noise, **values_of_levels(found.dark)}
    if found.refused:
        return measured, []
    clamp = {name: float(found.values[CLAMP_AT + i]) for i, name in enumerate(CLAMP)}
    values, effects = rig_values(found.vector, found.values[:COUNT], clamp)
    at = np.array([*range(COUNT), *(CLAMP_AT + i for i in range(2) if found.fit.free[CLAMP_AT + i])])
    sd = found.sd[at]
    scale = np.where(sd > 0.0, sd, 1.0)
    correlation = found.covariance[np.ix_(at, at)] / np.outer(scale, scale)
    return {
        **values,
        **measured,
        'calibration.names': [NAMES[i] for i in at],
        'calibration.sds': [float(f'{v:.10g}') for v in sd],
        'calibration.correlations': [
            float(f'{np.clip(correlation[i, j], -1.0, 1.0):.12f}') for i in range(1, len(at)) for j in range(i)
        ],
        'calibration.source': source_of(found, date),
    }, effects


def sentence(found: Calibration) -> str:
    """The answer in one sentence."""
    if found.refused:
        return f'Refused: {found.refused}.'
    g = found.gap
    known = int(sum(found.fit.free[i] for i in REPORTED))
    what = {'reference': 'the reference', 'loads': 'the known loads', 'self': 'the redundant reading'}[found.kind]
    return (
        f'{known} of {len(REPORTED)} parameters are determined by {what}; on motion that was not fitted the readings '
        f'are predicted to {g.heldout_after * 1e6:.2f} µm rms, before {g.heldout_before * 1e6:.2f} µm.'
    )
