# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The check of an old calibration, against plain linear algebra, and what a calibration has determined so far."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import chi2

import psd_deflection
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.misalignment.model import INDEX, PARAMETERS, ZERO
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import rig_from_values
from psd_deflection.studies.calibrate import check as checking
from psd_deflection.studies.calibrate.calibrate import OPEN, ROTATED, undetermined, with_clamp
from psd_deflection.studies.calibrate.check import LEVEL, MovedGroup, fitted_group, moved_group, overall_p
from psd_deflection.studies.calibrate.fit import (
    CLAMP_AT,
    REPORTED,
    CalibrationFit,
    Linear,
    Noise,
    Prior,
    posterior,
    prior_of_rig,
)
from psd_deflection.studies.calibrate.observation import Rows
from psd_deflection.studies.calibrate.progress import CalibrationProgress, Need, ParameterProgress, progress_of
from psd_deflection.studies.calibrate.result import result
from tools.program import ROOT


@pytest.mark.parametrize('seed', range(3))
def test_a_group_has_moved_by_what_its_rows_and_its_prior_say(seed: int) -> None:
    names = [p.group for p in PARAMETERS[:ZERO]]
    group = max(names, key=names.count)
    own = [i for i, name in enumerate(names) if name == group]
    at = np.arange(ZERO)
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(ZERO, ZERO))
    m, score, scale = root @ root.T, rng.normal(size=ZERO), rng.uniform(0.5, 2.0, ZERO)
    found = moved_group(group, at, score, m, scale)
    # In units of the prior, whose information is 1.
    covariance = np.linalg.inv(m[np.ix_(own, own)] + np.eye(len(own)))
    shift = scale[own] * (covariance @ score[own])
    sd = scale[own] * np.sqrt(np.diag(covariance))
    assert [v for v, _ in found.shifts.values()] == pytest.approx(shift.tolist())
    assert [s for _, s in found.shifts.values()] == pytest.approx(sd.tolist())


def test_moved_group_is_fitted_with_three_tolerances(monkeypatch: pytest.MonkeyPatch) -> None:
    reported = prior_of_rig(rig_from_values({}))
    names = [p.name for p in PARAMETERS if p.group == 'psd_1.gain']
    given: list[Prior] = []

    def explained(rows: object, rig: object, prior: Prior, *_: object) -> tuple[float, FloatArray]:
        given.append(prior)
        return 7.0, prior.mean + 0.5

    monkeypatch.setattr(checking, 'explained', explained)
    group = MovedGroup('psd_1.gain', 0.01, 1.0, 2, dict.fromkeys(names, (0.0, 0.1)))
    nothing = cast(Any, None)
    found = fitted_group(group, nothing, nothing, reported, 'reference', nothing, nothing, 3.0)
    wider = np.zeros(len(reported.mean))
    for p in PARAMETERS:
        if p.name in names:
            wider[INDEX[p.name]] = 9.0 * p.tolerance**2
    (prior,) = given
    assert np.all(wider[[INDEX[n] for n in names]] > 0.0)
    np.testing.assert_allclose(prior.covariance, reported.covariance + np.diag(wider), rtol=1e-12)
    assert np.array_equal(prior.mean, reported.mean)
    # Against nothing moved; and what it moved by.
    assert found.evidence == pytest.approx(4.0)
    assert [v for v, _ in found.shifts.values()] == pytest.approx([0.5] * len(names))


@pytest.mark.parametrize(('shared', 'least', 'most'), [(0.0, 0.042, 0.055), (0.9, 0.005, 0.055)])
def test_at_most_5_percent_of_sound_rigs_are_reported(shared: float, least: float, most: float) -> None:
    """20,000 rigs in which nothing moved, of as many groups as there are, independent or with a common part."""
    groups = len({p.group for p in PARAMETERS[:ZERO]})
    rng = np.random.default_rng(8)
    common, own = rng.standard_normal((20_000, 1, 2)), rng.standard_normal((20_000, groups, 2))
    z = np.sqrt(shared) * common + np.sqrt(1.0 - shared) * own
    each = chi2.sf(np.sum(z**2, axis=2), 2)
    assert least < np.mean([overall_p(rig) < LEVEL for rig in each.tolist()]) < most
    assert (LEVEL, overall_p([]), overall_p([0.4, 0.9])) == (0.05, 1.0, 0.8)


def test_uninformed_parameters_are_undetermined() -> None:
    prior = prior_of_rig(rig_from_values({}))
    size = len(prior.mean)
    free = np.ones(size, dtype=bool)
    each = 1e4 / prior.sd**2
    information = np.diag(each)
    open_one, (a, b) = INDEX['psd_2.height'], (INDEX['psd_1.gain_x'], INDEX['psd_2.gain_x'])
    information[open_one, open_one] = 0.0
    # Of two gains only the sum is told.
    pair = np.zeros(size)
    pair[[a, b]] = 1.0 / prior.sd[[a, b]]
    information[[a, b], [a, b]] = 0.0
    information += 1e4 * np.outer(pair, pair)
    full = cast(
        Any, SimpleNamespace(covariance=posterior(information, prior, free), information=information, free=free)
    )
    found = {tuple(sorted(d.parts)): d.parts for d in undetermined(full, prior)}
    assert set(found) == {('psd_2.height',), ('psd_1.gain_x', 'psd_2.gain_x')}
    one, other = found['psd_1.gain_x', 'psd_2.gain_x'].values()
    assert (abs(one), one + other) == pytest.approx((0.5**0.5, 0.0), abs=2e-4)


def test_yielding_clamp_is_found_beside_outlier_pose() -> None:
    rig = rig_from_values({})
    prior = prior_of_rig(rig)
    n, size = 40, len(prior.mean)
    rng = np.random.default_rng(7)
    loads = np.column_stack([rng.uniform(-50.0, 50.0, (n, 2)), rng.uniform(-20.0, 20.0, n)])
    bends, twists = 2e-5, 3e-4
    own = np.diag(LinkStatics.from_rig(rig).compliance)
    pose = loads * (own + np.array([bends, bends, twists]) * [rig.link.length**2, rig.link.length**2, 1.0])
    pose[3] += (5e-3, 5e-3, 0.1)
    weights, zeros = np.ones(n), np.zeros((n, 3))
    weights[3] = 0.0
    rest, run = np.ones(n, dtype=bool), np.zeros(n, dtype=np.int64)
    seconds = np.asarray(0.02 * np.arange(n), dtype=np.float64)
    rows = Rows(seconds, run, pose, np.zeros((n, 4)), np.ones((n, 4)), zeros, loads, rest, zeros + 1.0)
    linear = Linear(np.zeros((n, 4)), np.zeros((n, 4, size)), np.zeros((n, 4, 3)))
    free = np.zeros(size, dtype=bool)
    noise = Noise(np.array([1e-7, 1e-7, 1e-7]))
    full = CalibrationFit(np.zeros(size), np.zeros((size, size)), np.zeros((size, size)), linear, weights, noise, free)
    found = with_clamp(full, rows, rig, prior)
    assert found.values[CLAMP_AT : CLAMP_AT + 2] == pytest.approx([bends, twists], rel=1e-3)


def calibrated(*loads: tuple[float, float, float]) -> CalibrationProgress:
    """By loads of a second each and a reference."""
    made = psd_deflection.simulate(None, [(0, 0, 0), *loads], seconds=1, seed=3)
    return progress_of(psd_deflection.calibrate(made, ROOT / 'config' / 'thesis_rig.yaml').found)


@pytest.mark.slow
def test_a_force_along_x_leaves_open_what_only_others_determine() -> None:
    along_x, all_round = calibrated((40, 0, 0)), calibrated((40, 0, 0), (0, -50, -29), (-40, 40, 20))
    assert len(along_x.parameters) == len(REPORTED)
    assert along_x.determined < all_round.determined
    for progress in (along_x, all_round):
        assert ROTATED not in [need.motion for need in progress.needs]
        for p in progress.parameters:
            assert p.determined == (p.left <= OPEN)
    of_motion = {need.motion: need.names for need in along_x.needs}
    gains = 'a motion of the dot along that axis, by forces along X and Y and a torque'
    assert 'psd_1.gain_y' in of_motion[gains]
    assert 'psd_1.gain_x' not in of_motion.get(gains, ())
    # What needs a better reference than most have comes last.
    motions = [need.motion for need in along_x.needs]
    assert motions[0] == gains
    assert 'a reference of a micrometre' in motions[-3]
    assert all(len(set(need.names)) == len(need.names) for need in along_x.needs)


@pytest.mark.parametrize(
    ('left', 'determined', 'filled'),
    [(1.0, True, 0.0), (0.1, True, 0.5), (0.01, True, 1.0), (1e-5, True, 1.0), (0.1, False, 0.0), (np.nan, True, 0.0)],
)
def test_the_bar_is_full_at_a_hundredth_of_the_tolerance(left: float, determined: bool, filled: float) -> None:
    parameter = ParameterProgress(name='n', words='', value='', left=left, determined=determined)
    assert parameter.filled == pytest.approx(filled)


def test_the_tree_has_each_parameter_with_its_bar_and_each_need() -> None:
    parameter = ParameterProgress(name='n', words='a', value='b', left=0.1, determined=True)
    row = {**parameter._asdict(), 'filled': parameter.filled}
    assert CalibrationProgress('reference', 2.0, (parameter,), (Need('push', ('n',)),), 'too short').tree() == {
        'kind': 'reference',
        'seconds': 2.0,
        'determined': 1,
        'rejected': 'too short',
        'parameters': [row],
        'needs': [{'motion': 'push', 'names': ('n',)}],
    }


def test_the_zero_of_a_check_is_in_its_file_by_psd_and_axis() -> None:
    groups = [MovedGroup('psd_1.gain', 0.01, 3.0, 2, {'psd_1.gain_x': (0.02, 0.001)})]
    found = checking.CalibrationCheck(
        False, 0.01, groups, ['psd_2.gain'], np.array([0.0, 1e-6, 2e-6, 3e-6]), np.full(4, 1e-7)
    )
    tree = checking.result(found)
    assert [*tree['zero']] == [f'psd_{psd}.zero_{axis}' for psd in (1, 2) for axis in 'xy']
    assert [v['value'] for v in tree['zero'].values()] == [0.0, 1e-6, 2e-6, 3e-6]
    assert (tree['verdict'], tree['moved'], tree['or']) == ('moved', 'psd_1.gain', ['psd_2.gain'])
    assert tree['groups'][0]['shifts'] == {'psd_1.gain_x': {'value': 0.02, 'sd': 0.001}}


def test_a_rejection_is_in_the_file_and_none_is_null() -> None:
    made = psd_deflection.simulate(None, [(0, 0, 0), (40, 0, 0)], seconds=1, seed=3)
    found = psd_deflection.calibrate(made, ROOT / 'config' / 'thesis_rig.yaml').found
    assert result(replace(found, rejected=''), '2026-11-26')['rejected'] is None
    assert result(replace(found, rejected='worse than before'), '2026-11-26')['rejected'] == 'worse than before'
