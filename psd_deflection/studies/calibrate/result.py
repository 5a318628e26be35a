# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The answer of calibrate: calibration.json, the page, and the rig file (docs/calibration.md)."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection import __version__
from psd_deflection.base.tables import Column, Table, text_column
from psd_deflection.model.misalignment.model import COUNT, ZERO
from psd_deflection.model.misalignment.rig import CLAMP, rig_values
from psd_deflection.model.simulation.catalogue import effects_of_rig, effects_to_values
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.rig.config import Rig
from psd_deflection.rig.parameter_files import with_effects_section, with_values
from psd_deflection.studies.calibrate.calibrate import ROTATED, Calibration
from psd_deflection.studies.calibrate.dark import result_of_levels, source_of_levels, values_of_levels, words_of_level
from psd_deflection.studies.calibrate.fit import CLAMP_AT, CLOCK, NAMES, REPORTED, UNITS
from psd_deflection.studies.calibrate.observation import CHANNEL_NAMES
from psd_deflection.studies.calibrate.progress import progress_of
from psd_deflection.studies.study import (
    Notify,
    PageSection,
    StudyResult,
    described,
    edited_rig_file,
    named,
    warn_caller,
)


@dataclass(frozen=True, repr=False)
class Calibrated(StudyResult):
    """``calibration``: the fit and what it means. ``rig``: as it was known, with the parameter file it has, if any.

    ``date``: of the calibration, for the provenance. ``notify``: takes warnings.
    """

    study, json_name = 'calibrate', 'calibration.json'
    title = 'Calibration'

    calibration: Calibration
    rig: Rig
    params_file: str | Path | None
    date: str
    notify: Notify = warn_caller

    @property
    def sources(self) -> dict[str, str]:
        """Version, date, recordings with their digests."""
        runs = {f'recording {n}': named(run.name, run.digest, 64) for n, run in enumerate(self.calibration.runs, 1)}
        return {'version': __version__, 'date': self.date, **runs}

    def sentences(self) -> list[str]:
        """Return the answer in one sentence, the dark levels, and what is left open."""
        calibration = self.calibration
        statements = [sentence(calibration), *map(words_of_level, calibration.dark)]
        statements += [
            f'undetermined: {", ".join(n.names)}; needed: {n.motion}' for n in progress_of(calibration).needs
        ]
        if any(d.needs == ROTATED for d in calibration.undetermined):
            statements.append(f'rotation and crosstalk: {ROTATED}')
        return statements

    def tree(self) -> dict[str, Any]:
        """Parameters with covariance, what is left open, noise, gap, provenance."""
        return result(self.calibration, self.date)

    def table(self) -> Table:
        """One row a parameter: ``value``, ``sd``, what the ``file`` had, what the new one has (``used``), ``unit``."""
        calibration, at = self.calibration, list(REPORTED)
        return Table(
            text_column('parameter', [NAMES[i] for i in at], 'of the rig'),
            [
                Column('value', calibration.values[at], '', 'calibrated, in the unit of the row'),
                Column('sd', calibration.sd[at], '', 'its standard deviation'),
                Column('file', calibration.prior.mean[at], '', 'of the rig file before'),
                Column('used', calibration.used[at], '', 'of the rig file after'),
                text_column('unit', [UNITS[i] for i in at], 'of the row'),
            ],
            {'kind': calibration.kind, 'gap_before_m': calibration.gap.before, 'gap_after_m': calibration.gap.after},
        )

    def sections(self) -> Iterable[PageSection]:
        """Before and after, parameters, what is left open, noise, dark levels, what to do next."""
        from psd_deflection.studies.calibrate.pictures import sections

        return sections(self.calibration)

    def rig_yaml(self) -> str:
        """Return the user's parameter file with the calibration, comments kept; without one what describes the rig."""
        calibration = self.calibration
        values, effects = values_of(calibration, self.date)

        def edit(text: str, path: Path) -> str:
            # Without a calibration the effects are those of the file.
            plain = text if calibration.rejected else with_effects_section(text, effects_to_values(effects), path)
            return with_values(plain, values, f'Calibrated by {source_of(calibration, self.date)}', path)

        kept_effects = effects_of_rig(self.rig) if calibration.rejected else effects
        return edited_rig_file(
            self.params_file, 'rig.yaml', lambda: described(self.rig, kept_effects), edit, self.notify
        )

    def files(self) -> dict[str, str]:
        """Return the rig file, the page and the JSON."""
        return {'rig.yaml': self.rig_yaml(), **super().files()}


def result(calibration: Calibration, date: str) -> dict[str, Any]:
    """Return the tree of calibration.json. ``date``: of the calibration, for the provenance."""
    sd = calibration.sd

    def parameter(i: int) -> dict[str, Any]:
        file = float(calibration.prior.mean[i])
        value, used = float(calibration.values[i]), float(calibration.used[i])
        return {'value': value, 'sd': float(sd[i]), 'unit': UNITS[i], 'file': file, 'used': used}

    at = list(REPORTED)
    reference_range = calibration.reference_range
    reference = calibration.fit.noise.reference
    return {
        'parameters': {NAMES[i]: parameter(i) for i in at},
        'covariance': {'names': [NAMES[i] for i in at], 'matrix': calibration.covariance[np.ix_(at, at)].tolist()},
        'undetermined': [{'direction': d.parts, 'needs': d.needs} for d in calibration.undetermined],
        'noise': dict(zip(CHANNEL_NAMES, calibration.noise.tolist(), strict=True)),
        'gap': {'unit': 'm', **calibration.gap._asdict()},
        'kind': calibration.kind,
        'zero': {NAMES[i]: parameter(i) for i in range(ZERO, COUNT)},
        'reference': {
            'noise': dict(zip(('dx', 'dy', 'theta'), reference.tolist(), strict=True)),
            'clock_offset': {
                'value': calibration.clock + float(calibration.values[CLOCK]),
                'sd': float(sd[CLOCK]),
                'unit': 's',
            },
            'rows': len(calibration.rows),
            'outliers': int(np.sum(calibration.fit.weights == 0.0)),
        }
        if calibration.kind == 'reference'
        else None,
        'range': None
        if reference_range is None
        else {'low': reference_range[0].tolist(), 'high': reference_range[1].tolist()},
        'dark': result_of_levels(calibration.dark) or None,
        'rejected': calibration.rejected or None,
        'widened': calibration.widened,
        'dropped': calibration.dropped,
        'provenance': {
            'version': __version__,
            'date': date,
            'recordings': [
                {'name': run.name, 'sha256': run.digest, 'device': run.device, 'temperature': run.temperature}
                for run in calibration.runs
            ],
        },
    }


def source_of(calibration: Calibration, date: str) -> str:
    """Where a calibrated rig file comes from, in one line."""
    recordings = ', '.join(named(run.name, run.digest) for run in calibration.runs)
    dark = f'; dark levels from {source_of_levels(calibration.dark)}' if calibration.dark else ''
    return f'psd-deflection {__version__}, {date}, from {recordings}{dark}'


def values_of(calibration: Calibration, date: str) -> tuple[dict[str, object], list[ActiveEffect]]:
    """Flat values that a rig file gets, and its effects; noise and dark levels alone if the calibration was
    rejected.
    """
    noise = {f'psd_{n}.noise': [float(f'{v:.4g}') for v in calibration.noise[2 * n - 2 : 2 * n]] for n in (1, 2)}
    measured = {**noise, **values_of_levels(calibration.dark)}
    if calibration.rejected:
        return measured, []
    clamp = {name: float(calibration.values[CLAMP_AT + i]) for i, name in enumerate(CLAMP)}
    values, effects = rig_values(calibration.vector, calibration.values[:COUNT], clamp)
    at = np.array([*range(COUNT), *(CLAMP_AT + i for i in range(2) if calibration.fit.free[CLAMP_AT + i])])
    sd = calibration.sd[at]
    scale = np.where(sd > 0.0, sd, 1.0)
    correlation = calibration.covariance[np.ix_(at, at)] / np.outer(scale, scale)
    return {
        **values,
        **measured,
        'calibration.names': [NAMES[i] for i in at],
        'calibration.sds': [float(f'{v:.10g}') for v in sd],
        'calibration.correlations': [
            float(f'{np.clip(correlation[i, j], -1.0, 1.0):.12f}') for i in range(1, len(at)) for j in range(i)
        ],
        'calibration.source': source_of(calibration, date),
        **(
            {}
            if calibration.reference_range is None
            else {'calibration.range': [float(f'{v:.6g}') for v in calibration.reference_range.ravel()]}
        ),
    }, effects


def sentence(calibration: Calibration) -> str:
    """Return the answer in one sentence."""
    if calibration.rejected:
        return f'Rejected: {calibration.rejected}.'
    g = calibration.gap
    known = progress_of(calibration).determined
    what = {'reference': 'the reference', 'loads': 'the known loads', 'self': 'the redundant reading'}[calibration.kind]
    return (
        f'{known} of {len(REPORTED)} parameters are determined by {what}; on motion that was not fitted the readings '
        f'are predicted to {g.heldout_after * 1e6:.2f} µm rms, before {g.heldout_before * 1e6:.2f} µm.'
    )
