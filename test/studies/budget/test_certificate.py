# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A certificate of a calibration written by hand: each input against the exact model, every sum written again."""

import csv
import io
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psd_deflection import __version__
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.model.misalignment.model import ALL, INDEX, readings
from psd_deflection.model.misalignment.rig import vector_of_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.studies.budget import certificate_page
from psd_deflection.studies.budget.certificate import (
    Certificate,
    CertificateProblem,
    certify,
    default_poses,
    verdict_of,
)
from psd_deflection.studies.budget.certificate_page import Certified, read_calibration, read_fields
from psd_deflection.studies.budget.inputs import INPUTS, REFERENCE_INPUTS, read_inputs

EVERY = (*INPUTS, *REFERENCE_INPUTS)
AXES = ('dx', 'dy', 'theta')
SCALES = (1e6, 1e6, math.degrees(1e3))
# Standard deviations that a calibration found, and how three of them go together.
FOUND = {'psd_1.rotation': 1e-3, 'psd_2.gain_y': 2e-3, 'beam_1.angle_x': 5e-4}
JOINT = {('psd_1.rotation', 'psd_2.gain_y'): 0.5, ('psd_1.rotation', 'beam_1.angle_x'): -0.25}
RIG = replace_values(
    load_rig(),
    {
        'calibration.names': list(FOUND),
        'calibration.sds': list(FOUND.values()),
        # Each with those before it: 2 with 1, 3 with 1, 3 with 2.
        'calibration.correlations': [0.5, -0.25, 0.0],
        # One channel is worse, so that the solver trusts it less.
        'psd_2.noise': [8e-3, 2e-3],
        'psd_1.height': 0.02,
    },
)
POSES = [(1e-3, -2e-3, 0.015), (0.0, 0.0, 0.0), (-1.5e-3, 5e-4, -0.01)]


def _tree() -> dict[str, Any]:
    """As calibrate writes it, the parts that a certificate reads."""
    return {
        'kind': 'reference',
        'rejected': '',
        'parameters': {'psd_1.rotation': {'value': 0.012, 'used': 0.0}, 'psd_2.gain_y': {'value': 1e-3, 'used': 5e-3}},
        'reference': {'rows': 60, 'outliers': 7},
        'range': {'low': [-2e-3, -2.5e-3, -0.02], 'high': [1e-3, 2e-3, 0.03]},
        'provenance': {
            'date': '2026-01-02',
            'recordings': [
                {'name': 'a.csv', 'sha256': 'aa', 'device': 'U6', 'temperature': [21.5, 20.25]},
                {'name': 'b.csv', 'sha256': 'bb', 'device': 'U6', 'temperature': None},
                {'name': 'c.csv', 'sha256': 'cc', 'device': 'T7', 'temperature': [22.75]},
            ],
        },
    }


def _problem(**changes: Any) -> CertificateProblem:
    given = {'inputs': read_inputs(None, {'reference_scale': 2e-5}, declared=EVERY), 'poses': POSES}
    return CertificateProblem(**{'rig': RIG, 'calibration': _tree(), 'rig_file': 'new/rig.yaml', **given, **changes})


@pytest.fixture(scope='module')
def certificate() -> Certificate:
    return certify(_problem())


def _weighted_pose(rig: Rig, read: FloatArray, pose: tuple[float, float, float]) -> FloatArray:
    """One step of weighted least squares from the true pose, the slopes by differences of the plate's exact model."""
    p = vector_of_rig(rig).as_used
    length = rig.link.length

    def model(x: FloatArray) -> FloatArray:
        return readings(p, x[:, None], length)[:, 0]

    at = np.array(pose)
    jacobian = np.stack([(model(at + d) - model(at - d)) / 2e-7 for d in 1e-7 * np.eye(3)], axis=1)
    step = 2.0 * 10.0 / 2**16
    variances = np.array([2e-3, 2e-3, 8e-3, 2e-3]) ** 2 + step**2 / 12.0
    weighted = jacobian.T / variances
    return np.asarray(np.linalg.solve(weighted @ jacobian, weighted @ (read - model(at))))


@pytest.mark.parametrize('pose', range(len(POSES)))
def test_an_error_of_the_rig_file_makes_the_pose_wrong_by_c(certificate: Certificate, pose: int) -> None:
    """The true parameter is less by the error of what the rig file says of it; the exact readings are estimated."""
    p = vector_of_rig(RIG).as_used
    rows = [row for row in certificate.inputs if row.cause == 'calibration']
    assert [row.parameter for row in rows] == [p.name for p in ALL if 'zero' not in p.name]
    for row in rows:
        error = np.zeros(len(ALL))
        error[INDEX[row.parameter]] = 1e-2 * row.u
        up, down = (
            _weighted_pose(RIG, readings(p - sign * error, np.array(POSES[pose])[:, None], RIG.link.length)[:, 0], q)
            for sign, q in ((1.0, POSES[pose]), (-1.0, POSES[pose]))
        )
        expected = (up - down) / (2.0 * error.max())
        assert row.coefficients[pose] == pytest.approx(expected, rel=2e-5, abs=1e-9), row.parameter


def test_what_the_calibration_says_of_its_parameters(certificate: Certificate) -> None:
    rows = {row.parameter: row for row in certificate.inputs if row.cause == 'calibration'}
    for name, sd in FOUND.items():
        assert rows[name].u == pytest.approx(sd, rel=1e-9)
    assert rows['psd_2.rotation'].u == pytest.approx(0.010)
    assert {(row.observed, row.distribution) for row in rows.values()} == {(True, 'normal')}
    assert (rows['psd_1.rotation'].unit, rows['psd_1.gain_x'].unit, rows['psd_1.height'].unit) == ('rad', '', 'm')
    # 60 frames without 7 outliers, less two parameters.
    assert {row.freedom for row in rows.values()} == {51.0}
    expected = np.eye(len(rows))
    names = list(rows)
    for (a, b), value in JOINT.items():
        expected[names.index(a), names.index(b)] = expected[names.index(b), names.index(a)] = value
    assert certificate.correlations == pytest.approx(expected, abs=1e-9)


def test_a_parameter_that_is_known_exactly_has_no_correlation() -> None:
    exact = replace_values(RIG, {'calibration.sds': [0.0, 2e-3, 5e-4]})
    certificate = certify(_problem(rig=exact))
    assert certificate.inputs[0].u == 0.0
    assert certificate.correlations[0].tolist() == [0.0] * len(certificate.correlations)
    assert np.diag(certificate.correlations)[1:] == pytest.approx(1.0)


@pytest.mark.parametrize(('rows', 'outliers', 'freedom'), [(60, 0, 58.0), (10, 7, 1.0), (10, 8, 1.0), (10, 6, 2.0)])
def test_fit_with_few_frames_has_one_degree_of_freedom(rows: int, outliers: int, freedom: float) -> None:
    tree = {**_tree(), 'reference': {'rows': rows, 'outliers': outliers}}
    assert certify(_problem(calibration=tree)).inputs[0].freedom == freedom


def test_as_found_is_what_the_old_values_would_have_done(certificate: Certificate) -> None:
    rows = {row.parameter: row for row in certificate.inputs if row.cause == 'calibration'}
    # The old rotation was 12 mrad too small, the old gain 0.004 too large.
    expected = -0.012 * rows['psd_1.rotation'].coefficients + 0.004 * rows['psd_2.gain_y'].coefficients
    assert certificate.as_found == pytest.approx(expected, rel=1e-12)
    assert np.abs(certificate.as_found[0]).min() > 1e-7


def test_the_scale_of_the_reference_is_that_of_each_pose(certificate: Certificate) -> None:
    lengths, angles = (row for row in certificate.inputs if row.cause == 'reference')
    assert lengths.coefficients.tolist() == [[x, y, 0.0] for x, y, _ in POSES]
    assert angles.coefficients.tolist() == [[0.0, 0.0, theta] for *_, theta in POSES]
    assert (lengths.u, angles.u) == (2e-5, 1e-4)
    # A certificate of one pose has the same inputs.
    alone = certify(_problem(poses=POSES[1:2]))
    assert [row.parameter for row in alone.inputs] == [row.parameter for row in certificate.inputs]
    assert [row.u for row in alone.inputs] == [row.u for row in certificate.inputs]
    assert (lengths.unit, angles.unit, lengths.observed, angles.observed) == ('', '', False, False)
    assert (lengths.freedom, angles.freedom) == (math.inf, 8.0)


@pytest.mark.parametrize(('doubt', 'freedom'), [(0.5, 2.0), (1.0, 0.5), (0.0, math.inf), (1e-3, 5e5)])
def test_a_doubt_about_the_reference_is_its_degrees_of_freedom(doubt: float, freedom: float) -> None:
    inputs = read_inputs(None, {'assumption_doubt': doubt}, declared=EVERY)
    rows = [row for row in certify(_problem(inputs=inputs)).inputs if row.cause == 'reference']
    assert [row.freedom for row in rows] == pytest.approx([freedom, freedom])


def test_reading_shift_moves_pose_as_least_squares(certificate: Certificate) -> None:
    noise = [row for row in certificate.inputs if row.cause == 'amplifier_noise']
    p = vector_of_rig(RIG).as_used
    for n, pose in enumerate(POSES):
        exact = readings(p, np.array(pose)[:, None], RIG.link.length)[:, 0]
        for i, row in enumerate(noise):
            moved = exact + 1e-6 * np.eye(4)[i]
            assert row.coefficients[n] == pytest.approx(_weighted_pose(RIG, moved, pose) / 1e-6, rel=1e-5, abs=1e-6)


def test_default_poses_are_rest_and_observed_extremes() -> None:
    expected = [
        *((0.0, 0.0, 0.0), (-2e-3, 0.0, 0.0), (1e-3, 0.0, 0.0), (0.0, -2.5e-3, 0.0), (0.0, 2e-3, 0.0)),
        *((0.0, 0.0, -0.02), (0.0, 0.0, 0.03)),
    ]
    assert default_poses(_tree()) == expected
    assert certify(_problem(poses=())).poses.tolist() == [list(pose) for pose in expected]


def test_what_cannot_be_certified_says_why() -> None:
    with pytest.raises(ConfigError, match=r'new/rig\.yaml: calibration\.names: not there'):
        certify(_problem(rig=load_rig()))
    with pytest.raises(ConfigError, match=r'new/rig\.yaml: calibrated by loads, without a reference'):
        certify(_problem(calibration={**_tree(), 'kind': 'loads'}))
    # Each number of the pose in its place.
    with pytest.raises(ConfigError, match=r'^pose 0\.001 -0\.25 0\.02: the dot of psd_1 .*: take a smaller one$'):
        certify(_problem(poses=[(1e-3, -0.25, 0.02)]))


def test_a_solver_that_is_linear_weighs_nothing() -> None:
    """The direct method has one matrix, whatever the pose and the noise of a channel."""
    certificate = certify(_problem(rig=replace_values(RIG, {'solver': 'wls'})))
    noise = [row for row in certificate.inputs if row.cause == 'amplifier_noise']
    for row in noise:
        assert row.coefficients == pytest.approx(np.tile(row.coefficients[0], (3, 1)))
    # Two dots that both move by -1 move the plate by 1.
    assert noise[0].coefficients[0, 0] + noise[2].coefficients[0, 0] == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ('errors', 'uncertainty', 'verdict'),
    [
        # On the limit is within it; the powers of two make it exact.
        ((0.5, 0.0, 0.0), (0.5, 1.0, 1.0), ('conforms', 'conforms')),
        ((-0.5, 0.0, 0.0), (0.5, 1.0, 1.0), ('conforms', 'conforms')),
        ((0.5, 0.0, 0.0), (0.75, 1.0, 1.0), ('not decided', 'conforms')),
        ((1.5, 0.0, 0.0), (0.5, 1.0, 1.0), ('not decided', 'conforms')),
        ((1.75, 0.0, 0.0), (0.5, 1.0, 1.0), ('does not conform', 'conforms')),
        ((0.0, -1.75, 0.0), (0.5, 0.5, 1.0), ('does not conform', 'conforms')),
        # One axis is enough to fail, and all are needed to conform.
        ((0.0, 0.0, 3.0), (0.5, 0.5, 1.25), ('does not conform', 'not decided')),
        ((0.0, 0.0, 0.0), (2.0, 2.0, 2.0), ('not decided', 'not decided')),
    ],
)
def test_the_rule_is_guarded_by_u(
    errors: tuple[float, ...], uncertainty: tuple[float, ...], verdict: tuple[str, str]
) -> None:
    got = verdict_of(np.array(errors), np.array(uncertainty), np.ones(3))
    assert (got.as_found, got.as_left) == verdict


def _certified(certificate: Certificate, **changes: Any) -> Certified:
    return Certified(certificate, replace(_problem(), **changes))


LIMITS = (1e-4, 2e-4, 3e-3)


def test_the_rows_of_the_results_are_the_numbers(certificate: Certificate) -> None:
    rows = _certified(certificate, limits=LIMITS).result_rows()
    head, *rest = rows
    assert (len(head), head[1:4]) == (1 + 6 * 3 + 2, ['ΔX µm', 'ΔY µm', 'θ mdeg'])
    verdicts = _certified(certificate, limits=LIMITS).verdicts
    for n, (row, message) in enumerate(zip(rest, certificate.stated, strict=True)):
        assert (row[0], len(row)) == (str(n + 1), len(head))
        parts = (certificate.poses[n], certificate.as_found[n], message.standard)
        numbers = [scale * v for part in parts for scale, v in zip(SCALES, part.tolist(), strict=True)]
        assert [float(v) for v in row[1:10]] == pytest.approx(numbers, abs=6e-4)
        assert row[10:13] == [f'{v:.0f}' for v in message.freedom.tolist()]
        assert [float(v) for v in row[13:16]] == pytest.approx(message.factor.tolist(), abs=6e-4)
        expanded = [scale * v for scale, v in zip(SCALES, message.uncertainty.tolist(), strict=True)]
        assert [float(v) for v in row[16:19]] == pytest.approx(expanded, abs=6e-4)
        assert tuple(row[19:]) == tuple(verdicts[n])
    assert [row[: len(head) - 2] for row in rows] == _certified(certificate).result_rows()
    assert _certified(certificate).verdicts == []


def test_mixed_verdicts_are_all_named(certificate: Certificate) -> None:
    # One pose was a metre off, the others not at all.
    wrong = replace(certificate, as_found=np.diag([1.0, 0.0, 0.0]))
    message = _certified(wrong, limits=(0.5, 0.5, 0.5)).sentences()[2]
    assert message == 'As found: conforms, does not conform; as left: every pose conforms.'
    message = _certified(certificate, limits=(1e-12, 1.0, 1.0)).sentences()[2]
    assert message.endswith('as left: every pose not decided.')


def test_the_files_have_all_digits(certificate: Certificate) -> None:
    files = _certified(certificate, limits=LIMITS).files()
    assert list(files) == [*('certificate.html', 'certificate.json', 'inputs.csv', 'correlations.csv', 'results.csv')]
    read = {name: list(csv.DictReader(io.StringIO(text))) for name, text in files.items() if name.endswith('csv')}
    for row, source in zip(read['inputs.csv'], certificate.inputs, strict=True):
        assert (row['cause'], row['parameter'], row['unit']) == (source.cause, source.parameter, source.unit)
        assert row['type'] == {True: 'A', False: 'B'}[source.observed]
        assert (float(row['u']), float(row['nu'])) == (source.u, source.freedom)
        for n in range(3):
            assert [float(row[f'c_{a}_{n + 1}']) for a in AXES] == source.coefficients[n].tolist()
    names = [source.parameter for source in certificate.inputs if source.cause == 'calibration']
    assert [row[''] for row in read['correlations.csv']] == names
    for row, correlations in zip(read['correlations.csv'], certificate.correlations.tolist(), strict=True):
        assert [float(row[name]) for name in names] == correlations
    assert [row['pose'] for row in read['results.csv']] == ['1', '2', '3']
    for n, row in enumerate(read['results.csv']):
        message = certificate.stated[n]
        parts: Mapping[str, FloatArray] = {
            '': certificate.poses[n],
            'as_found_': certificate.as_found[n],
            'u_c_': message.standard,
            'nu_eff_': message.freedom,
            'k_': message.factor,
            'U_': message.uncertainty,
        }
        for kind, values in parts.items():
            assert [float(row[f'{kind}{axis}']) for axis in AXES] == values.tolist()


def test_the_tree_and_the_table_have_the_same_numbers(certificate: Certificate) -> None:
    answer = _certified(certificate, limits=LIMITS, fields={'number': 'A-17'})
    tree = json.loads(answer.json())
    assert (tree['limits'], tree['probability'], tree['range']) == (list(LIMITS), 0.95, _tree()['range'])
    assert tree['provenance'] == {'version': __version__, 'calibration': _tree()['provenance']}
    assert tree['fields']['number'] == 'A-17'
    assert np.array(tree['correlations']) == pytest.approx(certificate.correlations, abs=0.0)
    assert [row['coefficients'] for row in tree['inputs']] == [r.coefficients.tolist() for r in certificate.inputs]
    table = answer.table()
    assert table.index.values.tolist() == [1, 2, 3]
    columns = {column.name: column for column in table.columns}
    assert [columns[f'expanded_{axis}'].unit for axis in AXES] == ['m', 'm', 'rad']
    for n, pose in enumerate(tree['poses']):
        assert pose['pose'] == list(POSES[n]) == [columns[axis].values[n] for axis in AXES]
        assert pose['as_found'] == [columns[f'as_found_{axis}'].values[n] for axis in AXES]
        assert pose['standard'] == [columns[f'standard_{axis}'].values[n] for axis in AXES]
        assert pose['uncertainty'] == [columns[f'expanded_{axis}'].values[n] for axis in AXES]
        assert pose['uncertainty'] == certificate.stated[n].uncertainty.tolist()
        assert pose['conformity'] == answer.verdicts[n].tree()
    plain = _certified(certificate).tree()
    assert plain['limits'] is None
    assert [row['conformity'] for row in plain['poses']] == [None] * 3


def test_the_page_has_every_section(certificate: Certificate) -> None:
    answer = _certified(certificate, limits=LIMITS, fields={'number': 'A-17'})
    page = answer.report()
    for words in (
        'reference, type and serial number',
        'performed by',
        '<td>A-17</td>',
        '<td>. . . . ',
        'Largest errors allowed: ΔX 100 µm, ΔY 200 µm, θ 172 mdeg.',
        'Valid for poses of ΔX µm -2000.000 to 1000.000, ΔY µm -2500.000 to 2000.000, θ mdeg -1145.916 to 1718.873, ',
        # 20 samples at 1 kHz are 50 estimates a second, and nine tenths of these are held.
        'single estimates of 20 samples at 1000 Hz by the solver exact',
        'motion slower than 45 Hz',
        '<td>∞</td>',
        f'<td>{certificate.inputs[0].coefficients[0, 0]:.6g}</td>',
    ):
        assert words in page, words
    assert page.count('A-17') == 1
    assert 'No limits were given: nothing is judged.' in _certified(certificate).report()
    assert page.count('<td>. . .') == 13 + 5 + 3 - 3


def _folder(path: Path, tree: object) -> Path:
    (path / 'rig.yaml').write_text('/**:\n  ros__parameters:\n    psd_1: {height: 0.02}\n')
    (path / 'calibration.json').write_text(tree if isinstance(tree, str) else json.dumps(tree))
    return path


def test_a_folder_is_read_whole(tmp_path: Path) -> None:
    tree = _tree()
    del tree['provenance']['date']
    rig, content = read_calibration(_folder(tmp_path, tree))
    assert rig.heights.tolist() == [0.02, 0.0]
    assert content == {**_tree(), 'provenance': {**_tree()['provenance'], 'date': ''}}
    assert read_calibration(_folder(tmp_path, _tree()))[1] == _tree()


def _changed(*path: str | int, to: object) -> dict[str, Any]:
    tree = _tree()
    inner: Any = tree
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = to
    return tree


@pytest.mark.parametrize(
    ('tree', 'words'),
    [
        ('{', 'no JSON; give'),
        ('[' * 100_000, 'no JSON; give'),
        ([], 'no map; give'),
        (_changed('rejected', to='worse than before'), 'rejected: the calibration was rejected'),
        (_changed('kind', to='loads'), 'kind = loads: its scale is traceable to nothing'),
        (_changed('parameters', to=[]), 'parameters: not there'),
        (_changed('parameters', 'psd_2.gain_y', to=3.0), 'parameters.psd_2.gain_y: needs the numbers'),
        (_changed('parameters', 'psd_2.gain_y', to={'value': 1.0}), 'parameters.psd_2.gain_y: needs the numbers'),
        (_changed('parameters', 'psd_2.gain_y', to={'used': 1.0}), 'parameters.psd_2.gain_y: needs the numbers'),
        (_changed('parameters', 'psd_2.gain_y', 'used', to=math.inf), 'parameters.psd_2.gain_y: needs the numbers'),
        (_changed('parameters', 'psd_2.gain_y', 'used', to=True), 'parameters.psd_2.gain_y: needs the numbers'),
        (_changed('parameters', 'psd_2.gain_y', 'used', to='1'), 'parameters.psd_2.gain_y: needs the numbers'),
        (_changed('reference', to=None), 'reference: not there'),
        (_changed('reference', 'rows', to=None), 'reference.rows: not a number'),
        (_changed('reference', 'outliers', to='few'), 'reference.outliers: not a number'),
        (_changed('range', to=None), 'range: not there'),
        (_changed('range', 'low', to=[0.0, 0.0]), 'range.low: must be three'),
        (_changed('range', 'low', to=[0.0] * 4), 'range.low: must be three'),
        (_changed('range', 'high', to='abc'), 'range.high: must be three'),
        (_changed('range', 'high', to=[0.0, 0.0, None]), 'range.high: must be three'),
        (_changed('provenance', to='me'), 'provenance: not there'),
        (_changed('provenance', 'recordings', to={}), 'provenance.recordings: must be maps'),
        (_changed('provenance', 'recordings', 2, to='c.csv'), 'provenance.recordings: must be maps'),
        (_changed('provenance', 'recordings', 2, to={'name': 'c.csv'}), 'provenance.recordings: must be maps'),
        (_changed('provenance', 'recordings', 2, 'temperature', to=20.0), 'recordings.temperature: must be numbers'),
        (_changed('provenance', 'recordings', 2, 'temperature', to=['w']), 'recordings.temperature: must be numbers'),
    ],
    ids=lambda v: v if isinstance(v, str) and len(v) < 60 else '',
)
def test_what_calibrate_does_not_write_is_rejected(tree: object, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        read_calibration(_folder(tmp_path, tree))
    assert f'calibration.json: {words}'.partition('calibration.json: ')[2] in str(error.value)
    assert str(error.value).startswith(str(tmp_path / 'calibration.json'))


def test_a_file_that_is_too_long_or_not_there_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = _folder(tmp_path, _tree())
    size = (folder / 'calibration.json').stat().st_size
    # One of thirty parameters has 40 kB.
    assert 40_000 < certificate_page.LONGEST == 10**7
    monkeypatch.setattr(certificate_page, 'LONGEST', size)
    assert read_calibration(folder)[1] == _tree()
    monkeypatch.setattr(certificate_page, 'LONGEST', size - 1)
    with pytest.raises(ConfigError, match=f'more than {size - 1} bytes'):
        read_calibration(folder)
    (folder / 'calibration.json').unlink()
    with pytest.raises(RecordingError, match=r'calibration\.json: cannot be read'):
        read_calibration(folder)


def test_words_of_a_stranger_are_cut(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        read_calibration(_folder(tmp_path, _changed('kind', to='k' * 201)))
    assert f'kind = {"k" * 199}…:' in str(error.value)
    with pytest.raises(ConfigError) as error:
        read_calibration(_folder(tmp_path, _changed('kind', to='k' * 200)))
    assert f'kind = {"k" * 200}:' in str(error.value)


def test_fields_are_read_as_words(tmp_path: Path) -> None:
    path = tmp_path / 'fields.yaml'

    def read(text: str) -> dict[str, str]:
        path.write_text(text)
        return read_fields(str(path))

    assert read_fields(None) == {}
    assert read('number: A-17\npressure: 1013\ncustomer:\n') == {'number': 'A-17', 'pressure': '1013', 'customer': ''}
    for text, words in (
        ('- number', 'fields are lines'),
        ('nummer: 1', 'nummer: no such field; did you mean number'),
        ('number: [1]', 'number: must be words'),
        ('number: {a: 1}', 'number: must be words'),
    ):
        with pytest.raises(ConfigError, match=words) as error:
            read(text)
        assert str(error.value).startswith(str(path))
