# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A certificate of calibration: what it is made from, its page, and its numbers as tables that a spreadsheet opens."""

import csv
import html
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection import __version__
from psd_deflection.base.axes import AXES as POSE
from psd_deflection.base.axes import SHOWN_UNITS, SYMBOLS
from psd_deflection.base.axes import UNITS as POSE_UNITS
from psd_deflection.base.charts import SMALL, Chart, Panel, Rule, Series
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.foreign_yaml import tree_of_file
from psd_deflection.base.pages import table
from psd_deflection.base.tables import Column, Table, columns, columns_of
from psd_deflection.base.text import did_you_mean, sanitize
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.budget.certificate import Certificate, CertificateProblem, Conformity, verdict_of
from psd_deflection.studies.budget.evaluate import PROBABILITY
from psd_deflection.studies.budget.result import SHOWN, UNITS, display_values, freedom_words, in_words
from psd_deflection.studies.study import PageSection, StudyResult

OBJECT = {
    'number': 'certificate number',
    'laboratory': 'laboratory',
    'customer': 'customer',
    'link': 'link, serial number',
    'psd_1': 'PSD 1, type and serial number',
    'psd_2': 'PSD 2, type and serial number',
    'laser_1': 'laser 1, serial number',
    'laser_2': 'laser 2, serial number',
    'device': 'amplifier and converter, serial number',
    'place': 'place of the calibration',
    'temperature': 'air temperature, °C',
    'pressure': 'air pressure, hPa',
    'humidity': 'relative humidity, %',
}
"""Fields of the object and its surroundings, in the order of the page."""
TRACEABLE = {
    'reference': 'reference, type and serial number',
    'reference_certificate': 'its certificate, number',
    'reference_laboratory': 'issued by',
    'reference_date': 'on',
    'reference_uncertainty': 'its expanded uncertainty as stated there',
}
SIGNED = {'performed_by': 'performed by', 'approved_by': 'approved by', 'signed': 'date, signature'}
FIELDS: Mapping[str, str] = {**OBJECT, **TRACEABLE, **SIGNED}
_OPEN = '. . . . . . . . . . . . . . . .'
"""What nobody filled in is for a pen."""


@dataclass(frozen=True, eq=False, repr=False)
class Certified(StudyResult):
    """``certificate``: the numbers of ``problem``."""

    study, json_name = 'certificate', 'certificate.json'
    title = 'Certificate of calibration'

    certificate: Certificate
    problem: CertificateProblem

    @property
    def sources(self) -> dict[str, str]:
        """Version, the calibration and its recordings."""
        given = self.problem.calibration['provenance']
        runs = {f'recording {n}': f'{r["name"]} (sha256 {r["sha256"]})' for n, r in enumerate(given['recordings'], 1)}
        rig = {'calibrated rig file': self.problem.rig_file}
        return {'version': __version__, **rig, 'calibrated on': str(given['date']), **runs}

    @property
    def fields(self) -> dict[str, str]:
        """The fields as given; device and temperature of the recordings if nobody gave them."""
        runs = self.problem.calibration['provenance']['recordings']
        devices = dict.fromkeys(str(r['device']) for r in runs if r.get('device'))
        warm = [v for r in runs for v in r.get('temperature') or ()]
        entries = {'device': ', '.join(devices), 'temperature': f'{min(warm):.1f} to {max(warm):.1f}' if warm else ''}
        return {name: self.problem.fields.get(name) or entries.get(name, '') for name in FIELDS}

    @property
    def verdicts(self) -> list[Conformity]:
        """Of each pose; empty without limits."""
        if self.problem.limits is None:
            return []
        limits = np.array(self.problem.limits)
        pairs = zip(self.certificate.as_found, self.certificate.stated, strict=True)
        return [verdict_of(error, uncertainty.uncertainty, limits) for error, uncertainty in pairs]

    def sentences(self) -> list[str]:
        """Return the largest U, the largest error as found, the verdict."""
        largest = np.max([uncertainty.uncertainty for uncertainty in self.certificate.stated], axis=0)
        out = [
            f'Expanded uncertainty for 95 %, the largest of {len(self.certificate.poses)} poses: {in_words(largest)}.'
        ]
        out.append(f'As found the pose was wrong by up to {in_words(np.abs(self.certificate.as_found).max(axis=0))}.')
        if verdicts := self.verdicts:
            as_found, as_left = ({getattr(v, part) for v in verdicts} for part in ('as_found', 'as_left'))
            out.append(f'As found: {_all_of(as_found)}; as left: {_all_of(as_left)}.')
        return out

    def lines(self) -> list[str]:
        """Return the sentences and the table of poses."""
        return [*self.sentences(), '', *columns(self.result_rows(), align_left=4).splitlines()]

    def tree(self) -> dict[str, Any]:
        """SI; (ΔX, ΔY, θ) in this order."""
        verdicts: Sequence[Conformity | None] = self.verdicts or [None] * len(self.certificate.poses)
        rows = zip(self.certificate.poses, self.certificate.as_found, self.certificate.stated, verdicts, strict=True)
        return {
            'unit': ['m', 'm', 'rad'],
            'probability': PROBABILITY,
            'fields': self.fields,
            'poses': [
                {
                    'pose': pose.tolist(),
                    'as_found': error.tolist(),
                    **{name: value.tolist() for name, value in uncertainty._asdict().items()},
                    'conformity': None if verdict is None else verdict.tree(),
                }
                for pose, error, uncertainty, verdict in rows
            ],
            'limits': None if self.problem.limits is None else list(self.problem.limits),
            'range': self.problem.calibration['range'],
            'inputs': [{**row._asdict(), 'coefficients': row.coefficients.tolist()} for row in self.certificate.inputs],
            'correlations': self.certificate.correlations.tolist(),
            'provenance': {'version': __version__, 'calibration': self.problem.calibration['provenance']},
        }

    def table(self) -> Table:
        """Return one row a pose: what it was, how far the estimate was off as found, u_c and U; m, m, rad."""
        stated = self.certificate.stated
        parts = (
            ('', self.certificate.poses, 'pose'),
            ('as_found_', self.certificate.as_found, 'error as found'),
            ('standard_', np.array([uncertainty.standard for uncertainty in stated]), 'standard uncertainty'),
            ('expanded_', np.array([uncertainty.uncertainty for uncertainty in stated]), 'expanded uncertainty, 95 %'),
        )
        out = []
        for before, values, words in parts:
            out += columns_of(np.asarray(values), [f'{before}{a}' for a in POSE], POSE_UNITS, [words] * 3)
        return Table(Column('number', np.arange(1, len(stated) + 1), '', 'of the pose'), out)

    def files(self) -> dict[str, str]:
        """Return the page, the JSON, and the tables with all their digits."""
        return {
            'certificate.html': self.report(),
            self.json_name: self.json(),
            'inputs.csv': _csv(self._inputs(repr)),
            'correlations.csv': _csv(self._correlations(repr)),
            'results.csv': _csv(self._numbers()),
        }

    def sections(self) -> Iterable[PageSection]:
        """Object, reference, results, inputs, rules, signatures."""
        return [
            PageSection('Object and surroundings', (self._filled(OBJECT),)),
            PageSection('Reference', (self._filled(TRACEABLE),)),
            PageSection('Results', (_table(self.result_rows()), self.chart(), self._range())),
            PageSection('Decision rule', (f'<p>{html.escape(self._rule())}</p>',)),
            PageSection('How U was computed', (_HOW, _table(self._inputs(_six)))),
            PageSection('Correlations of the calibration', (_table(self._correlations(_six)),)),
            PageSection('Signatures', (self._filled(SIGNED),)),
        ]

    def _filled(self, names: Mapping[str, str]) -> str:
        given = self.fields
        return table(('', ''), [(words, given[name] or _OPEN) for name, words in names.items()])

    def result_rows(self) -> list[list[str]]:
        """Return the head first."""
        classified = self.verdicts
        head = ['pose', *UNITS, *(f'as found {u}' for u in UNITS), *(f'u_c {u}' for u in UNITS)]
        head += [f'ν_eff {a}' for a in SYMBOLS] + [f'k {a}' for a in SYMBOLS] + [f'U {u}' for u in UNITS]
        rows = [head + (['as found', 'as left'] if classified else [])]
        for n, (pose, error, uncertainty) in enumerate(
            zip(self.certificate.poses, self.certificate.as_found, self.certificate.stated, strict=True)
        ):
            row = [str(n + 1), *display_values(pose), *display_values(error), *display_values(uncertainty.standard)]
            row += map(freedom_words, uncertainty.freedom.tolist())
            row += [f'{k:.3f}' for k in uncertainty.factor.tolist()] + display_values(uncertainty.uncertainty)
            rows.append(row + (list(classified[n]) if classified else []))
        return rows

    def chart(self) -> Chart:
        """Return the error of each pose as found with its expanded uncertainty, and the limits."""
        number = np.arange(1.0, len(self.certificate.poses) + 1.0)
        limits = self.problem.limits
        panels = []
        for i, (axis, unit) in enumerate(zip(SYMBOLS, SHOWN_UNITS, strict=True)):
            errors = SHOWN[i] * np.array([error[i] for error in self.certificate.as_found])
            expanded = SHOWN[i] * np.array([uncertainty.uncertainty[i] for uncertainty in self.certificate.stated])
            curve = Series('as found ± U', number, errors, 'blue', 'points', half_width=expanded)
            ends = () if limits is None else (-SHOWN[i] * limits[i], SHOWN[i] * limits[i])
            rules = [Rule(float(at), 'limit', across=True, colour='red') for at in ends]
            panels.append(Panel((curve,), 'pose', f'{axis} / {unit}', rules=rules, height=SMALL))
        return Chart('error of each pose as found, with its expanded uncertainty', panels, beside=3)

    def _numbers(self) -> list[list[str]]:
        """As ``result_rows``, in SI units with all digits."""
        names = ('dx', 'dy', 'theta')
        kinds = ('', 'as_found_', 'u_c_', 'nu_eff_', 'k_', 'U_')
        rows = [['pose', *(f'{kind}{name}' for kind in kinds for name in names)]]
        for n, (pose, error, uncertainty) in enumerate(
            zip(self.certificate.poses, self.certificate.as_found, self.certificate.stated, strict=True), start=1
        ):
            values = (
                pose,
                error,
                uncertainty.standard,
                uncertainty.freedom,
                uncertainty.factor,
                uncertainty.uncertainty,
            )
            rows.append([str(n), *(repr(v) for part in values for v in part.tolist())])
        return rows

    def _inputs(self, words: Any) -> list[list[str]]:
        head = ['cause', 'parameter', 'type', 'distribution', 'u', 'unit', 'nu']
        head += [f'c_{a}_{n + 1}' for n in range(len(self.certificate.poses)) for a in ('dx', 'dy', 'theta')]
        rows = [head]
        for row in self.certificate.inputs:
            kind = 'A' if row.observed else 'B'
            row_words = [row.cause, row.parameter, kind, row.distribution, words(row.u), row.unit, words(row.freedom)]
            rows.append(row_words + [words(c) for c in row.coefficients.ravel().tolist()])
        return rows

    def _correlations(self, words: Any) -> list[list[str]]:
        names = [row.parameter for row in self.certificate.inputs[: len(self.certificate.correlations)]]
        rows = [['', *names]]
        rows += [
            [name, *map(words, coefficients)]
            for name, coefficients in zip(names, self.certificate.correlations.tolist(), strict=True)
        ]
        return rows

    def _range(self) -> str:
        calibrated_range, rig = self.problem.calibration['range'], self.problem.rig
        low, high = (display_values(np.array(calibrated_range[key])) for key in ('low', 'high'))
        ends = (f'{unit} {a} to {b}' for unit, a, b in zip(UNITS, low, high, strict=True))
        rate, size = rig.converter.sample_rate_hz, rig.estimator.block_size
        words = (
            f'Valid for poses of {", ".join(ends)}, single estimates of {size} samples at {rate:g} Hz by the solver '
            f'{rig.estimator.solver}, after a zero at rest, and for motion slower than {0.9 * rate / size:g} Hz. '
            f'Outside that range, and while the link vibrates faster, the estimates say so in their findings. As left, '
            f'the error is corrected by the calibrated rig file; what may be left of it is U.'
        )
        return f'<p>{html.escape(words)}</p>'

    def _rule(self) -> str:
        if self.problem.limits is None:
            return 'No limits were given: nothing is judged.'
        return (
            f'Largest errors allowed: {in_words(np.array(self.problem.limits))}. A pose conforms if |error| + U is '
            f'within the limit on every axis, and does not if |error| − U is beyond it on any (JCGM 106:2012, 8.3.2, '
            f'guard band U); otherwise it is not decided.'
        )


_HOW = (
    '<p>u: standard uncertainty of an input, nu: its degrees of freedom, c: how ΔX, ΔY (m) and θ (rad) of each pose go '
    'with it. With g = u c the variance of a cause is the sum of g² over its parameters; that of the calibration, '
    'whose parameters are correlated, is the sum of g_p r_pq g_q (JCGM 100:2008, 5.2.2). u_c² is the sum of all; '
    'ν_eff = u_c⁴ / Σ u_i⁴/ν_i over the causes (G.2b), down to a whole number; k is the quantile of Student’s t for '
    '95 %; U = k u_c. The same tables with all digits: inputs.csv, correlations.csv, results.csv.</p>'
)


def _six(value: float) -> str:
    return '∞' if math.isinf(value) else f'{value:.6g}'


def _table(rows: list[list[str]]) -> str:
    head, *body = rows
    return table(head, body)


def _all_of(words: set[str]) -> str:
    return f'every pose {next(iter(words))}' if len(words) == 1 else ', '.join(sorted(words))


def _csv(rows: list[list[str]]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator='\n').writerows(rows)
    return out.getvalue()


LONGEST = 10_000_000
"""Bytes of a calibration.json: one of 30 parameters has some 40 kB."""
LONGEST_WORDS = 200
"""Characters of one field, and of what a message repeats."""


def read_calibration(folder: Path) -> tuple[Rig, dict[str, Any]]:
    """Return the calibrated rig and the tree of calibration.json in ``folder``.

    Raises ConfigError if a file or a key is missing, if a value is none that calibrate writes, or if the calibration
    was rejected.
    """
    rig = load_rig(folder / 'rig.yaml')
    path = folder / 'calibration.json'
    try:
        if path.stat().st_size > LONGEST:
            raise ConfigError(f'{path}: more than {LONGEST} bytes; give the folder of a calibration')
        tree = json.loads(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
    except (ValueError, RecursionError):
        raise ConfigError(f'{path}: no JSON; give the folder of a calibration') from None
    _check(tree, path)
    return rig, tree


def _check(tree: Any, path: Path) -> None:
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: no map; give the folder of a calibration')
    if tree.get('rejected'):
        raise ConfigError(f'{path}: rejected: the calibration was rejected, and there is nothing to certify')
    if tree.get('kind') != 'reference':
        raise ConfigError(
            f'{path}: kind = {_words(tree.get("kind"))}: its scale is traceable to nothing; calibrate with a reference'
        )
    for name, entry in _map(tree, 'parameters', path).items():
        words = f'parameters.{_words(name)}'
        if not isinstance(entry, dict) or not all(_is_number(entry.get(key)) for key in ('value', 'used')):
            raise ConfigError(f'{path}: {words}: needs the numbers value and used; calibrate again')
    reference = _map(tree, 'reference', path)
    for key in ('rows', 'outliers'):
        if not _is_number(reference.get(key)):
            raise ConfigError(f'{path}: reference.{key}: not a number; calibrate again')
    _check_range(_map(tree, 'range', path), path)
    _check_provenance(_map(tree, 'provenance', path), path)


def _check_range(calibrated_range: Mapping[str, Any], path: Path) -> None:
    for key in ('low', 'high'):
        ends = calibrated_range.get(key)
        if not isinstance(ends, list) or len(ends) != 3 or not all(map(_is_number, ends)):
            raise ConfigError(f'{path}: range.{key}: must be three numbers; calibrate again')


def _check_provenance(given: dict[str, Any], path: Path) -> None:
    runs = given.get('recordings')
    if not isinstance(runs, list) or not all(isinstance(r, dict) and {'name', 'sha256'} <= r.keys() for r in runs):
        raise ConfigError(f'{path}: provenance.recordings: must be maps with name and sha256; calibrate again')
    for run in runs:
        warm = run.get('temperature')
        if warm is not None and not (isinstance(warm, list) and all(map(_is_number, warm))):
            raise ConfigError(f'{path}: provenance.recordings.temperature: must be numbers; calibrate again')
    given.setdefault('date', '')


def _words(value: object) -> str:
    return sanitize(str(value), LONGEST_WORDS)


def _map(tree: Mapping[str, Any], key: str, path: Path) -> dict[str, Any]:
    value = tree.get(key)
    if not isinstance(value, dict):
        raise ConfigError(f'{path}: {key}: not there; calibrate again with this version')
    return value


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def read_fields(path: str | None) -> dict[str, str]:
    """Return the fields of the page of a YAML file, printable; none without a file.

    Raises ConfigError naming the file and the field.
    """
    if path is None:
        return {}
    tree = tree_of_file(Path(path), 'file of fields')
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: fields are lines of "name: words"')
    out = {}
    for name, words in tree.items():
        if name not in FIELDS:
            raise ConfigError(f'{path}: {_words(name)}: no such field{did_you_mean(str(name), FIELDS)}')
        if isinstance(words, dict | list):
            raise ConfigError(f'{path}: {name}: must be words or a number')
        out[str(name)] = '' if words is None else _words(words)
    return out
