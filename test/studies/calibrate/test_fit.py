# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The fit and the check of an old calibration: against another minimiser, polynomials, plain linear algebra."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import minimize
from scipy.stats import chi2, multivariate_normal

import psd_deflection
from blind import misaligned
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.misalignment.model import COUNT, INDEX, PARAMETERS, TOLERANCES, ZERO
from psd_deflection.model.misalignment.rig import known_of_rig, vector_of_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import replace_values, rig_from_values
from psd_deflection.studies.calibrate import check as checking
from psd_deflection.studies.calibrate import fit as fitting
from psd_deflection.studies.calibrate import observation
from psd_deflection.studies.calibrate.calibrate import OPEN, ROTATED, undetermined, with_clamp
from psd_deflection.studies.calibrate.check import LEVEL, MovedGroup, fitted_group, moved_group, overall_p
from psd_deflection.studies.calibrate.fit import SIZE
from psd_deflection.studies.calibrate.progress import CalibrationProgress, Need, ParameterProgress, progress_of
from psd_deflection.studies.calibrate.result import result, values_of
from tools.program import ROOT

RIG = rig_from_values({})
PRIOR = fitting.prior_of_rig(RIG)


def test_a_noisy_reading_weighs_less_in_the_pose() -> None:
    """The pose has the least sum of squares, each reading over its own variance: no other pose is as likely."""
    p, length = vector_of_rig(RIG).values, RIG.link.length
    rng = np.random.default_rng(2)
    true = rng.uniform(-1.0, 1.0, (3, 3)) * (1e-3, 1e-3, 5e-3)
    sd = np.array([2e-6, 20e-6, 8e-6, 1e-6]) * rng.uniform(0.5, 2.0, (3, 4))
    dots = misaligned.dots(misaligned.nominal(), true) + sd * rng.normal(size=sd.shape)
    poses = fitting.pose_of_readings(dots, sd**2, p, length)

    def chi_square(x: FloatArray, pose: FloatArray, row: int) -> float:
        moved = pose + x * (1e-6, 1e-6, 1e-5)
        residual = (dots[row] - misaligned.dots(misaligned.nominal(), moved[None])[0]) / sd[row]
        return float(residual @ residual)

    for row, pose in enumerate(poses):
        best = minimize(chi_square, np.zeros(3), (pose, row), 'Nelder-Mead', options={'xatol': 1e-4, 'fatol': 1e-9})
        np.testing.assert_allclose(best.x, 0.0, atol=0.02)
        assert chi_square(np.zeros(3), pose, row) == pytest.approx(best.fun, abs=1e-3)


def test_clamp_prior_is_a_fifth_of_link_compliance() -> None:
    """In the deflection by a tip force, L^3/3EI, and in the twist by a moment, L/GJ."""
    bends, twists = PRIOR.sd[fitting.CLAMP_AT : fitting.CLAMP_AT + 2]
    length = RIG.link.length
    assert bends * length**2 == pytest.approx(0.2 * length**3 / (3.0 * RIG.link.bending_stiffness))
    assert twists == pytest.approx(0.2 * length / RIG.link.torsional_stiffness)


def test_rows_that_are_worth_fewer_weigh_less() -> None:
    rng = np.random.default_rng(4)
    rows = cast(Any, SimpleNamespace(sd=np.ones((5, 3)), variances=rng.uniform(1.0, 2.0, (5, 4)) * 1e-12))
    linear = fitting.Linear(np.zeros((5, 4)), np.zeros((5, 4, 2)), rng.normal(size=(5, 4, 3)))
    noise = fitting.Noise(np.array([1e-6, 2e-6, 3e-6]), 1.5)
    each = fitting.weight_matrices(linear, rows, noise)
    covariance = linear.pose_slopes[2] @ np.diag(noise.reference**2) @ linear.pose_slopes[2].T
    np.testing.assert_allclose(each[2], np.linalg.inv(covariance + np.diag(1.5**2 * rows.variances[2])), rtol=1e-9)
    np.testing.assert_allclose(fitting.weight_matrices(linear, rows, replace(noise, fewer=4.0)), each / 4.0, rtol=1e-12)


def rows_of_two(offset: FloatArray) -> observation.Rows:
    """Two recordings of one rig; before the second the beams were aimed anew, by ``offset`` (4,), m."""
    rng, n = np.random.default_rng(8), 120
    pose = rng.uniform(-1.0, 1.0, (n, 3)) * (3e-3, 3e-3, 2e-2)
    run = np.repeat([0, 1], n // 2)
    aimed = dict(zip(('beam_1.x', 'beam_1.y', 'beam_2.x', 'beam_2.y'), offset.tolist(), strict=True))
    first, second = (misaligned.dots(misaligned.nominal() | beams, pose) for beams in ({}, aimed))
    dots = np.where(run[:, None], second, first) + 1e-6 * rng.normal(size=(n, 4))
    loads, velocity = rng.uniform(-10.0, 10.0, (n, 3)), rng.normal(size=(n, 3)) * 1e-3
    pose += rng.normal(size=(n, 3)) * (2e-5, 2e-5, 2e-4)
    moved, nothing = np.full((n, 4), 1e-12), np.zeros(n, dtype=bool)
    t = np.linspace(0.0, 11.9, n)
    return observation.Rows(t, run, pose, dots, moved, velocity, loads, nothing, np.ones((n, 3)))


@pytest.mark.parametrize('kind', ['reference', 'loads', 'self'])
def test_a_zero_of_its_own_is_as_a_parameter_of_its_recording(kind: fitting.Kind) -> None:
    """Score and information are those of dense least squares with four more unknowns, less those (Schur)."""
    rows = rows_of_two(np.full(4, 1e-4))
    weights = np.random.default_rng(1).uniform(0.1, 1.0, len(rows))
    noise, none = fitting.Noise(np.array([3e-5, 2e-5, 1e-4]), 1.5, 2.0), np.zeros((SIZE, SIZE))
    linear = fitting.linearised(rows, PRIOR.mean, RIG, kind)
    for i in (fitting.CLAMP_AT, fitting.CLAMP_AT + 1, fitting.CLOCK):
        step = PRIOR.sd[i] * (np.arange(SIZE) == i)
        less = linear.residual - fitting.linearised(rows, PRIOR.mean + step, RIG, kind).residual
        np.testing.assert_allclose(linear.slopes @ step, less, atol=1e-9 * np.abs(linear.residual).max())
    best = fitting.CalibrationFit(PRIOR.mean, none, none, linear, weights, noise, np.ones(SIZE, dtype=bool))
    score, information = fitting.score_at(rows, PRIOR.mean, RIG, kind, best)
    normal, right = np.zeros((SIZE + 4, SIZE + 4)), np.zeros(SIZE + 4)
    normal[SIZE:, SIZE:] = np.diag(TOLERANCES[ZERO:COUNT] ** -2)
    for j in range(len(rows)):
        slopes = np.hstack([linear.slopes[j], linear.slopes[j][:, ZERO:COUNT] * (rows.run[j] == 1)])
        covariance = linear.pose_slopes[j] @ np.diag(noise.reference**2) @ linear.pose_slopes[j].T
        inverse = weights[j] * np.linalg.inv(covariance + 1.5**2 * np.diag(rows.variances[j])) / 2.0
        normal += slopes.T @ inverse @ slopes
        right += slopes.T @ inverse @ linear.residual[j]
    gain = normal[:SIZE, SIZE:] @ np.linalg.inv(normal[SIZE:, SIZE:])
    size = np.sqrt(np.abs(np.diag(normal[:SIZE, :SIZE]))) + 1e-30
    scale = np.outer(size, size)
    reduced = normal[:SIZE, :SIZE] - gain @ normal[SIZE:, :SIZE]
    np.testing.assert_allclose(information / scale, reduced / scale, atol=1e-8)
    reach = np.abs(right).max() + np.abs(right[:SIZE] / size).max() * size
    np.testing.assert_allclose(score / reach, (right[:SIZE] - gain @ right[SIZE:]) / reach, atol=1e-8)


def test_two_recordings_have_one_zero_after_the_offset_is_taken_off() -> None:
    """As much as a beam may be off. What is left is the dots' noise and its mean's."""
    offset = np.array([4e-4, -3e-4, 2e-4, 5e-4])
    free = (np.arange(SIZE) >= ZERO) & (np.arange(SIZE) < COUNT)
    rows, best = fitting.with_common_zero(rows_of_two(offset), RIG, PRIOR, 'reference', free)
    np.testing.assert_allclose(rows.dots, rows_of_two(np.zeros(4)).dots, atol=6e-6)
    assert best.noise.reference == pytest.approx([2e-5, 2e-5, 2e-4], rel=0.25)
    assert best.noise.dots == pytest.approx(1.0, rel=0.25)
    again = fitting.fit(rows, RIG, PRIOR, 'reference', free=free)
    np.testing.assert_allclose(best.values[ZERO:COUNT], again.values[ZERO:COUNT], atol=1e-8)
    np.testing.assert_allclose(best.covariance, fitting.posterior(best.information, PRIOR, free), rtol=1e-9)
    assert not np.any(best.values[:ZERO] - PRIOR.mean[:ZERO])


def test_the_evidence_of_a_prior_is_the_probability_of_all_readings_at_once() -> None:
    """Their covariance has a part of the prior's; a constant is left out, so that one prior is held against another."""
    rows = rows_of_two(np.zeros(4)).at(np.arange(20))
    noise = fitting.Noise(np.array([2e-5, 2e-5, 2e-4]))
    free = np.isin(fitting.NAMES, ('psd_1.gain_x', 'psd_1.rotation', 'psd_2.gain_y'))
    mean = PRIOR.mean + 0.1 * free * PRIOR.sd
    linear, none = fitting.linearised(rows, mean, RIG, 'reference'), np.zeros((SIZE, SIZE))
    best = fitting.CalibrationFit(PRIOR.mean, none, none, linear, np.ones(len(rows)), noise, free)
    of_rows = block_diag(*np.linalg.inv(fitting.weight_matrices(linear, rows, noise)))
    slopes, off = linear.slopes[:, :, free].reshape(-1, 3), []
    for factor in (1.0, 0.01):
        covariance = factor * PRIOR.covariance
        evidence, z = fitting.explained(rows, RIG, fitting.Prior(mean, covariance), 'reference', free, best)
        shared = slopes @ covariance[np.ix_(free, free)]
        all_at_once = of_rows + shared @ slopes.T
        off.append(evidence - multivariate_normal(cov=1e12 * all_at_once).logpdf(1e6 * linear.residual.ravel()))
        shift = shared.T @ np.linalg.solve(all_at_once, linear.residual.ravel())
        np.testing.assert_allclose((z - mean)[free] / PRIOR.sd[free], shift / PRIOR.sd[free], atol=0.01)
    assert off[0] == pytest.approx(off[1], abs=5e-3)


def test_frames_with_a_chi_square_above_27_are_excluded() -> None:
    rows = rows_of_two(np.zeros(4))
    rows.pose[::40, 0] += 2e-5 * np.linspace(5.0, 7.0, 3)
    best = fitting.fit(rows, RIG, PRIOR, 'reference', free=np.arange(SIZE) < 4)
    off, inverse = best.linear.residual, fitting.weight_matrices(best.linear, rows, best.noise)
    chi_square = np.einsum('ni,nij,nj->n', off, inverse, off) * best.noise.fewer
    assert best.weights.tolist() == (chi_square < 27.0).tolist()


def test_without_reference_the_noise_of_the_dots_alone_is_found() -> None:
    free = np.arange(SIZE) < ZERO // 2
    noise = fitting.fit(rows_of_two(np.zeros(4)), RIG, PRIOR, 'self', free=free).noise
    assert (noise.reference.tolist(), noise.fewer) == ([1.0, 1.0, 1.0], 1.0)
    assert noise.dots == pytest.approx(1.0, rel=0.15)


@pytest.mark.parametrize('kind', ['reference', 'loads', 'self'])
@pytest.mark.parametrize(('share', 'reported'), [(0.0, 0.3), (0.2, 0.3), (0.4, 0.4), (2.0, 2.0)])
def test_dots_are_believed_up_to_three_tenths_of_their_noise(kind: fitting.Kind, share: float, reported: float) -> None:
    """The redundant reading has ``share`` of the noise that is stated, of either sign; nothing was fitted."""
    rng = np.random.default_rng(6)
    n, sd = 200, 3e-6
    by_pose = rng.normal(size=(n, 4, 3))
    # The direction that no pose reaches, by cofactors.
    across = np.array([[(-1) ** i * np.linalg.det(np.delete(m, i, axis=0)) for i in range(4)] for m in by_pose])
    across /= np.linalg.norm(across, axis=1)[:, None]
    moved = np.einsum('nij,nj->ni', by_pose, rng.normal(size=(n, 3)) * 1e-4)
    residual = moved + share * sd * rng.choice([-1.0, 1.0], n)[:, None] * across
    rows = cast(
        Any, SimpleNamespace(sd=np.ones((n, 3)), variances=np.full((n, 4), sd**2), run=np.zeros(n, dtype=np.int64))
    )
    linear = fitting.Linear(residual, np.zeros((n, 4, SIZE)), by_pose)
    noise = fitting.variance_components(linear, rows, np.ones(n), kind, 1, np.zeros((SIZE, SIZE)), PRIOR)
    assert noise.dots == pytest.approx(reported)


PERIOD = 1e-3


def seconds(n: int, period: float = PERIOD) -> FloatArray:
    return np.asarray(period * np.arange(n), dtype=np.float64)


T = seconds(200)
WHERE = np.array([30.0, 57.3, 99.6, 150.49])
CURVES = np.random.default_rng(0).normal(size=(7, 4)) * 1e-3
"""Coefficients of polynomials of degree 6 in (t - 0.1 s) / 0.02 s: the fit has their degree."""


def on_curves(t: FloatArray, derivative: int = 0) -> FloatArray:
    u = (t - 0.1) / 0.02
    columns = [np.polynomial.Polynomial(c).deriv(derivative)(u) for c in CURVES.T]
    return np.stack(columns, axis=1) / 0.02**derivative


def test_polynomial_of_fit_degree_is_found_with_slope() -> None:
    smooth = observation.smoothed(on_curves(T), PERIOD, WHERE)
    assert smooth.good.all()
    scale = np.abs(on_curves(T)).max()
    np.testing.assert_allclose(smooth.dots, on_curves(WHERE * PERIOD), atol=1e-9 * scale)
    np.testing.assert_allclose(smooth.speed, on_curves(WHERE * PERIOD, 1), atol=1e-6 * np.abs(on_curves(T, 1)).max())
    assert smooth.squares.max() < 1e-18 * scale


def test_gain_is_value_variance_over_sample_variance() -> None:
    smooth = observation.smoothed(np.zeros((200, 4)), PERIOD, WHERE)
    for place, gain in zip(WHERE, smooth.gain, strict=True):
        middle = round(place)
        u = np.arange(-10, 11) / 10.0
        basis = np.vander(u, 7, increasing=True)
        weights = np.linalg.pinv(basis).T @ np.vander([(place - middle) / 10.0], 7, increasing=True)[0]
        assert gain == pytest.approx(float(weights @ weights), rel=1e-9)


def test_over_an_exposure_it_is_the_mean() -> None:
    exposure = 0.008
    smooth = observation.smoothed(on_curves(T), PERIOD, WHERE, exposure)
    at = (np.arange(4000) + 0.5) / 4000 - 0.5
    means = [on_curves(place * PERIOD + exposure * at).mean(axis=0) for place in WHERE]
    np.testing.assert_allclose(smooth.dots, means, atol=1e-6 * np.abs(means).max())


def test_a_place_needs_seventeen_samples_about_it_on_both_sides() -> None:
    dots = np.zeros((200, 4))
    assert observation.smoothed(dots, PERIOD, np.array([0.0, 5.0, 6.0, 193.0, 194.0, 199.0])).good.tolist() == [
        *(False, False, True, True, False, False)
    ]
    dots[95:99] = np.nan
    assert observation.smoothed(dots, PERIOD, np.array([100.0])).good.all()
    dots[99] = np.nan
    assert not observation.smoothed(dots, PERIOD, np.array([100.0])).good.any()
    assert not observation.smoothed(np.zeros((200, 4)), PERIOD, np.array([-3.0])).good.any()


def run_of(volts: FloatArray, loads: FloatArray | None = None) -> observation.CalibrationRun:
    return observation.CalibrationRun('x', seconds(len(volts)), volts, np.zeros(0), np.zeros((0, 3)), loads)


def lit(n: int, noise: tuple[float, float, float, float], seed: int = 1) -> FloatArray:
    volts = np.tile([0.5, -0.2, 5.0, 0.1, 0.3, 5.0], (n, 1))
    volts[:, [0, 1, 3, 4]] += np.random.default_rng(seed).normal(size=(n, 4)) * noise
    return volts


def test_the_noise_of_each_channel_is_found() -> None:
    noise = (1e-3, 2e-3, 4e-3, 8e-3)
    assert observation.noise_of(run_of(lit(20_000, noise)), RIG) == pytest.approx(noise, rel=0.05)
    # The steps of the converter are no noise.
    rig, step = rig_from_values({'converter.bits': 10}), 20.0 / 1024.0
    volts = np.round(lit(40_000, (0.6 * step,) * 4) / step) * step
    assert observation.noise_of(run_of(volts), rig) == pytest.approx([0.6 * step] * 4, rel=0.03)


def test_a_load_is_at_rest_in_the_second_half_of_its_hold() -> None:
    # The first hold is of 1024 steps of 1/1024 s, without a rounding; the second is too short, the third of 1499.
    t, loads = seconds(3000, 1.0 / 1024.0), np.zeros((3000, 3))
    loads[1025:1500, 0] = 5.0
    assert np.flatnonzero(observation.at_rest(loads, t)).tolist() == [*range(512, 1025), *range(2250, 3000)]
    assert not observation.at_rest(None, t).any()


def test_rows_without_reference_are_one_per_block() -> None:
    noise = np.array([1e-3, 2e-3, 4e-3, 8e-3])
    loads = np.tile([0.0, -5.0, 1.0], (2000, 1))
    rows = observation.rows_of(run_of(lit(2000, (0.0, 0.0, 0.0, 0.0)), loads), RIG, noise)
    assert len(rows) == 100
    np.testing.assert_allclose(np.diff(rows.t), 0.02, rtol=1e-9)
    assert np.all(rows.loads == [0.0, -5.0, 1.0])
    # 5 mm at 10 V, and the even distribution of a step.
    sample = (5e-4) ** 2 * (noise**2 + (20.0 / 65536.0) ** 2 / 12.0)
    u = np.vander(np.arange(-10, 11) / 10.0, 7, increasing=True)
    gain = float(np.linalg.inv(u.T @ u)[0, 0])
    # At the end of the recording a sample is missing.
    np.testing.assert_allclose(rows.variances[:-1], np.tile(gain * sample, (99, 1)), rtol=1e-6)


def test_settled_rows_are_means_no_better_than_the_calmest() -> None:
    t = seconds(100, 0.02)
    loads = np.zeros((100, 3))
    loads[50:, 1] = -10.0
    dots = np.random.default_rng(2).normal(size=(100, 4)) * 1e-6
    small, large = np.full((100, 4), 1e-20), np.full((100, 4), 1e-10)
    zeros, run = np.zeros((100, 3)), np.zeros(100, dtype=np.int64)
    noise = np.array([1e-3, 2e-3, 4e-3, 8e-3])
    for variances in (small, large):
        rows = observation.Rows(t, run, zeros, dots, variances, zeros, loads, t >= 0.5, np.ones((100, 3)))
        means = observation.rest_means(rows, RIG, noise)
        assert len(means) >= 6
        assert {tuple(row) for row in means.loads.tolist()} == {(0.0, 0.0, 0.0), (0.0, -10.0, 0.0)}
        if variances is small:
            least = np.tile((5e-4 * noise) ** 2 * observation.CALM_LEAST, (len(means), 1))
            np.testing.assert_allclose(means.variances, least)
        else:
            # Twelve or thirteen rows in a quarter of a second.
            assert 1e-10 / 13.001 < means.variances.min() <= np.median(means.variances) < 1e-10 / 11.999
    # Nothing moves, so that a mean is a mean.
    first = t[(t >= 0.5) & (t < 0.75 - 1e-9)]
    np.testing.assert_allclose(means.dots[0], dots[[round(x / 0.02) for x in first]].mean(axis=0), rtol=1e-6)


def test_references_count_by_their_proportions_if_all_state_them() -> None:
    zeros, run = np.zeros((4, 3)), np.zeros(4, dtype=np.int64)
    rest = np.ones(4, dtype=bool)

    def rows(sd: float) -> observation.Rows:
        dots = np.zeros((4, 4))
        return observation.Rows(seconds(4, 1.0), run, zeros, dots, dots + 1.0, zeros, zeros, rest, np.full((4, 3), sd))

    both = observation.joined([rows(1e-6), rows(3e-6), rows(3e-6)])
    assert both.run.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert sorted(set(both.sd.ravel().round(9).tolist())) == pytest.approx([1.0 / 3.0, 1.0])
    assert np.all(observation.joined([rows(1e-6), rows(np.nan)]).sd == 1.0)


def test_half_of_the_deviations_report_that_of_all() -> None:
    values = np.random.default_rng(3).normal(0.0, 2.0, 20_000)
    assert fitting.deviation_of(values, False) == pytest.approx(2.0, rel=0.02)
    assert fitting.deviation_of(values, True) == pytest.approx(2.0, rel=0.03)
    values[::10] += 1000.0
    assert fitting.deviation_of(values, True) == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize('seed', range(3))
def test_a_group_has_moved_by_what_its_rows_and_its_prior_say(seed: int) -> None:
    names = [p.group for p in PARAMETERS[:ZERO]]
    group = max(names, key=names.count)
    members = [i for i, name in enumerate(names) if name == group]
    at = np.arange(ZERO)
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(ZERO, ZERO))
    m, score, scale = root @ root.T, rng.normal(size=ZERO), rng.uniform(0.5, 2.0, ZERO)
    moved = moved_group(group, at, score, m, scale)
    # In units of the prior, whose information is 1.
    covariance = np.linalg.inv(m[np.ix_(members, members)] + np.eye(len(members)))
    shift, sd = scale[members] * (covariance @ score[members]), scale[members] * np.sqrt(np.diag(covariance))
    np.testing.assert_allclose([*moved.shifts.values()], np.column_stack([shift, sd]), rtol=1e-6)


def test_moved_group_is_fitted_with_three_tolerances(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [p.name for p in PARAMETERS if p.group == 'psd_1.gain']
    given: list[fitting.Prior] = []

    def explained(rows: object, rig: object, prior: fitting.Prior, *_: object) -> tuple[float, FloatArray]:
        given.append(prior)
        return 7.0, prior.mean + 0.5

    monkeypatch.setattr(checking, 'explained', explained)
    group = MovedGroup('psd_1.gain', 0.01, 1.0, 2, dict.fromkeys(names, (0.0, 0.1)))
    nothing = cast(Any, None)
    moved = fitted_group(group, nothing, nothing, PRIOR, 'reference', nothing, nothing, 3.0)
    wider, at = np.zeros(SIZE), [INDEX[n] for n in names]
    wider[at] = 9.0 * TOLERANCES[at] ** 2
    (prior,) = given
    np.testing.assert_allclose(prior.covariance, PRIOR.covariance + np.diag(wider), rtol=1e-12)
    assert np.array_equal(prior.mean, PRIOR.mean)
    # Against nothing moved; and what it moved by.
    assert moved.evidence == pytest.approx(4.0)
    assert [v for v, _ in moved.shifts.values()] == pytest.approx([0.5] * len(names))


@pytest.mark.parametrize(('shared', 'least', 'most'), [(0.0, 0.042, 0.055), (0.9, 0.005, 0.055)])
def test_at_most_5_percent_of_sound_rigs_are_reported(shared: float, least: float, most: float) -> None:
    """20,000 rigs in which nothing moved, of as many groups as there are, independent or with a common part."""
    groups = len({p.group for p in PARAMETERS[:ZERO]})
    rng = np.random.default_rng(8)
    common, independent = rng.standard_normal((20_000, 1, 2)), rng.standard_normal((20_000, groups, 2))
    z = np.sqrt(shared) * common + np.sqrt(1.0 - shared) * independent
    each = chi2.sf(np.sum(z**2, axis=2), 2)
    assert least < np.mean([overall_p(rig) < LEVEL for rig in each.tolist()]) < most
    assert (LEVEL, overall_p([]), overall_p([0.4, 0.9])) == (0.05, 1.0, 0.8)


def test_uninformed_parameters_are_undetermined() -> None:
    free = np.ones(SIZE, dtype=bool)
    information = np.diag(1e4 / PRIOR.sd**2)
    open_one, (a, b) = INDEX['psd_2.height'], (INDEX['psd_1.gain_x'], INDEX['psd_2.gain_x'])
    information[open_one, open_one] = 0.0
    # Of two gains only the sum is told.
    pair = np.zeros(SIZE)
    pair[[a, b]] = 1.0 / PRIOR.sd[[a, b]]
    information[[a, b], [a, b]] = 0.0
    information += 1e4 * np.outer(pair, pair)
    # Of two lengths it knows a little: to 0.89 and to 0.91 of the tolerance.
    for name, ratio in (('psd_1.center_x', 0.89), ('psd_1.center_y', 0.91)):
        information[INDEX[name], INDEX[name]] = (ratio**-2 - 1.0) / PRIOR.sd[INDEX[name]] ** 2
    covariance = fitting.posterior(information, PRIOR, free)
    full = cast(Any, SimpleNamespace(covariance=covariance, information=information, free=free))
    parts = {tuple(sorted(d.parts)): d.parts for d in undetermined(full, PRIOR)}
    assert set(parts) == {('psd_2.height',), ('psd_1.center_y',), ('psd_1.gain_x', 'psd_2.gain_x')}
    first, other = parts['psd_1.gain_x', 'psd_2.gain_x'].values()
    assert (abs(first), first + other) == pytest.approx((0.5**0.5, 0.0), abs=2e-4)


def test_yielding_clamp_is_found_beside_outlier_pose() -> None:
    n = 40
    rng = np.random.default_rng(7)
    loads = np.column_stack([rng.uniform(-50.0, 50.0, (n, 2)), rng.uniform(-20.0, 20.0, n)])
    bends, twists = 2e-5, 3e-4
    compliance = np.diag(LinkStatics.from_rig(RIG).compliance)
    pose = loads * (compliance + np.array([bends, bends, twists]) * [RIG.link.length**2, RIG.link.length**2, 1.0])
    pose[3] += (5e-3, 5e-3, 0.1)
    weights, zeros = np.ones(n), np.zeros((n, 3))
    weights[3] = 0.0
    rest, run = np.ones(n, dtype=bool), np.zeros(n, dtype=np.int64)
    seconds = np.asarray(0.02 * np.arange(n), dtype=np.float64)
    rows = observation.Rows(seconds, run, pose, np.zeros((n, 4)), np.ones((n, 4)), zeros, loads, rest, zeros + 1.0)
    linear, none = fitting.Linear(np.zeros((n, 4)), np.zeros((n, 4, SIZE)), np.zeros((n, 4, 3))), np.zeros((SIZE, SIZE))
    noise = fitting.Noise(np.array([1e-7, 1e-7, 1e-7]))
    full = fitting.CalibrationFit(np.zeros(SIZE), none, none, linear, weights, noise, np.zeros(SIZE, dtype=bool))
    fit = with_clamp(full, rows, RIG, PRIOR)
    clamp = slice(fitting.CLAMP_AT, fitting.CLAMP_AT + 2)
    assert fit.values[clamp] == pytest.approx([bends, twists], rel=1e-3)
    forces = replace(rows, loads=loads * [1.0, 1.0, 0.0])
    assert with_clamp(full, forces, RIG, PRIOR).free[clamp].tolist() == [True, False]


def calibrated(*loads: tuple[float, float, float]) -> CalibrationProgress:
    """By loads of a second each and a reference."""
    made = psd_deflection.simulate(None, [(0, 0, 0), *loads], seconds=1, seed=3)
    return progress_of(psd_deflection.calibrate(made, ROOT / 'config' / 'thesis_rig.yaml').calibration)


@pytest.mark.slow
def test_a_force_along_x_leaves_open_what_only_others_determine() -> None:
    along_x, all_round = calibrated((40, 0, 0)), calibrated((40, 0, 0), (0, -50, -29), (-40, 40, 20))
    assert len(along_x.parameters) == len(fitting.REPORTED)
    assert along_x.determined < all_round.determined
    for progress in (along_x, all_round):
        assert ROTATED not in [need.motion for need in progress.needs]
        for p in progress.parameters:
            assert p.sd_ratio <= OPEN or not p.determined
        assert {p.name for p in progress.parameters if not p.determined} == {
            n for need in progress.needs for n in need.names
        }
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
    ('ratio', 'determined', 'filled'),
    [(1.0, True, 0.0), (0.1, True, 0.5), (0.01, True, 1.0), (1e-5, True, 1.0), (0.1, False, 0.0), (np.nan, True, 0.0)],
)
def test_the_bar_is_full_at_a_hundredth_of_the_tolerance(ratio: float, determined: bool, filled: float) -> None:
    parameter = ParameterProgress(name='n', words='', value='', sd_ratio=ratio, determined=determined)
    assert parameter.filled == pytest.approx(filled)


def test_the_tree_has_each_parameter_with_its_bar_and_each_need() -> None:
    parameter = ParameterProgress(name='n', words='a', value='b', sd_ratio=0.1, determined=True)
    tree = CalibrationProgress('reference', 2.0, (parameter,), (Need('push', ('n',)),), 'too short').tree()
    row = {'name': 'n', 'words': 'a', 'value': 'b', 'sd_ratio': 0.1, 'determined': True, 'filled': parameter.filled}
    assert (tree.pop('parameters'), tree.pop('needs')) == ([row], [{'motion': 'push', 'names': ('n',)}])
    assert tree == {'kind': 'reference', 'seconds': 2.0, 'determined': 1, 'rejected': 'too short'}


def test_the_zero_of_a_check_is_in_its_file_by_psd_and_axis() -> None:
    groups = [MovedGroup('psd_1.gain', 0.01, 3.0, 2, {'psd_1.gain_x': (0.02, 0.001)})]
    checked = checking.CalibrationCheck(
        False, 0.01, groups, ['psd_2.gain'], np.array([0.0, 1e-6, 2e-6, 3e-6]), np.full(4, 1e-7)
    )
    tree = checking.result(checked)
    assert [*tree['zero']] == [f'psd_{psd}.zero_{axis}' for psd in (1, 2) for axis in 'xy']
    assert [v['value'] for v in tree['zero'].values()] == [0.0, 1e-6, 2e-6, 3e-6]
    assert (tree['verdict'], tree['moved'], tree['or']) == ('moved', 'psd_1.gain', ['psd_2.gain'])
    assert tree['groups'][0]['shifts'] == {'psd_1.gain_x': {'value': 0.02, 'sd': 0.001}}


def test_rejection_and_covariance_are_in_the_file_and_none_is_null() -> None:
    made = psd_deflection.simulate(None, [(0, 0, 0), (40, 0, 0)], seconds=1, seed=3)
    study = psd_deflection.calibrate(made, ROOT / 'config' / 'thesis_rig.yaml')
    assert set(study.files()) == {'rig.yaml', 'report.html', 'calibration.json'}
    calibration = replace(study.calibration, rejected='')
    assert result(calibration, '2026-11-26')['rejected'] is None
    assert result(replace(calibration, rejected='worse than before'), '2026-11-26')['rejected'] == 'worse than before'
    # One parameter is known exactly: it is correlated with nothing.
    covariance = calibration.covariance * (np.arange(SIZE) != 3) * (np.arange(SIZE)[:, None] != 3)
    values, _ = values_of(replace(calibration, fit=replace(calibration.fit, covariance=covariance)), '2026-11-26')
    written = known_of_rig(replace_values(calibration.rig, values)).covariance
    off = (written - covariance[:COUNT, :COUNT]) / np.outer(TOLERANCES, TOLERANCES)
    np.testing.assert_allclose(off, 0.0, atol=1e-8)


def test_a_stated_deviation_of_zero_cannot_be_calibrated() -> None:
    rig = replace_values(RIG, {'calibration.names': ['psd_1.gain_x'], 'calibration.sds': [0.0]})
    with pytest.raises(ConfigError, match=r'calibration\.sds: 0 for psd_1\.gain_x: must be greater than 0'):
        fitting.prior_of_rig(rig)
