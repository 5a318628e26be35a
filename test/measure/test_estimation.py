# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Corrected dots and the uncertainty of an estimate, by formulas written again and rules of one line."""

import cmath
import math
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.correction import Correction, Surroundings
from psd_deflection.measure.estimation import Estimation
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.misalignment.model import INDEX
from psd_deflection.records import ENVIRONMENT, BlockStatus, DeflectionEstimate, FloatArray, RawChunk, SpotMeans
from psd_deflection.rig.config import load_rig


def chunk(volts: FloatArray, first: int = 0) -> RawChunk:
    seq = np.arange(first, first + len(volts))
    return RawChunk(seq, seq * 1_000_000, volts.astype(np.float32), np.zeros(len(seq), np.uint8))


def estimates(volts: FloatArray, values: Mapping[str, object]) -> list[DeflectionEstimate]:
    """The primary ones of blocks of 20."""
    pipeline = Pipeline(load_rig(overrides=values))
    return [r for r in pipeline.process(chunk(volts)) if isinstance(r, DeflectionEstimate) and r.primary]


def at_rest(blocks: int, total: float = 5.0) -> FloatArray:
    volts = np.zeros((20 * blocks, 6))
    volts[:, 2::3] = total
    return volts


@pytest.mark.parametrize('seconds', [0.02, 0.5])
def test_the_variance_of_a_held_twist_grows_to_that_of_any_twist(seconds: float) -> None:
    """Ornstein-Uhlenbeck: v + s^2 (1 - exp(-t/T)), and the variance of the translation by the lever of the twist."""
    blocks = 1 + round(seconds / 0.02)
    volts = at_rest(blocks)
    volts[20:, :3] = 0.0
    held = estimates(volts, {'degraded': 'hold', 'twist_sd': 0.01, 'twist_hold': 0.7})
    assert len(held) == blocks
    first, last = (np.array(e.covariance).reshape(3, 3) for e in (held[0], held[-1]))
    want = first[2, 2] + 1e-4 * (1.0 - math.exp(-seconds / 0.7))
    assert last[2, 2] == pytest.approx(want, rel=1e-11, abs=0.0)
    assert held[-1].theta == held[0].theta
    # PSD 2 is 0.1 m from the tip's axis along -X: a twist moves its dot in y.
    assert last[1, 1] - last[0, 0] == pytest.approx(0.1**2 * want, rel=1e-3)


@pytest.mark.parametrize('earlier_ms', [0, 1, 300])
def test_a_twist_is_not_held_for_less_than_no_time(earlier_ms: int) -> None:
    """A device that was set back: the held variance stays as it was measured."""
    pipeline = Pipeline(load_rig(overrides={'degraded': 'hold'}))
    first, dark = chunk(at_rest(1)), at_rest(1)
    dark[:, :3] = 0.0
    second = replace(chunk(dark, 20), t_ns=first.t_ns - earlier_ms * 1_000_000)
    held = [r for c in (first, second) for r in pipeline.process(c) if isinstance(r, DeflectionEstimate) and r.primary]
    assert held[1].covariance[8] == held[0].covariance[8]
    assert (held[1].solver, held[1].phi, held[1].omega, held[1].residual_rms) == ('one_psd', 0.0, 0.0, 0.0)


def test_a_twist_that_is_taken_for_none_is_as_unsure_as_any() -> None:
    volts = at_rest(1)
    volts[:, :3] = 0.0
    (estimate,) = estimates(volts, {'degraded': 'zero', 'twist_sd': 0.02})
    assert (estimate.theta, estimate.covariance[8]) == (0.0, 0.02**2)
    assert estimate.covariance[4] - estimate.covariance[0] == pytest.approx(0.1**2 * 0.02**2, rel=1e-9)


BASE = {'psd_1.height': -0.585, 'psd_2.height': -0.485, 'solver': 'base_pair', 'solvers': ['base_pair']}


def test_zero_noise_of_base_psds_is_that_of_rig_file(monkeypatch: pytest.MonkeyPatch) -> None:
    want = 5e-4**2 * (2e-3**2 + (10.0 / 2**15) ** 2 / 12.0) / 20.0
    # Of the others it is that of a block's mean, as it was measured.
    for rig, noise in ((load_rig(overrides=BASE), want), (load_rig(), 20e-12)):
        estimation = Estimation(rig, ())
        monkeypatch.setattr(estimation.estimator, 'mean_variances', lambda size: (size * 1e-12,) * 4)
        assert estimation.zero_noise(20) == pytest.approx((noise,) * 4, rel=1e-9, abs=0.0)


def test_fewer_samples_make_the_mean_less_sure() -> None:
    """Of twelve samples the variance is 20/12 of that of twenty."""
    pipeline = Pipeline(load_rig())
    list(pipeline.process(chunk(at_rest(1)[:12])))
    (few,) = (r for r in pipeline.flush() if isinstance(r, DeflectionEstimate) and r.primary)
    (full,) = estimates(at_rest(1), {})
    np.testing.assert_allclose(few.covariance, 20.0 / 12.0 * np.array(full.covariance), rtol=1e-8, atol=1e-24)


def test_other_light_may_come_from_anywhere_on_the_active_area() -> None:
    """A share b of light from a place that is uniform over the length L: variance (b L/2)^2/3 in each reading."""
    length, share = 10e-3, (8.0 - 5.0) / 8.0
    dark, bright = (np.array(estimates(at_rest(1, v), {})[0].covariance) for v in (5.0, 8.0))
    # Readings of one variance v: that of the twist is v over the sum of squares about the middle of the base line.
    sigma2 = dark[8] * (0.1**2 + 0.07**2) / 2.0
    np.testing.assert_allclose(bright, dark * (1.0 + (share * length / 2.0) ** 2 / 3.0 / sigma2), rtol=1e-6, atol=1e-20)


def test_a_finding_that_says_nothing_of_light_leaves_the_covariance() -> None:
    """Sums above their limit, and not above what is nominal; in the second block of one PSD alone."""
    volts = at_rest(2)
    volts[20:, :3] = 0.0
    quiet, bright = (estimates(volts, {'sum_max': most, 'degraded': 'zero'}) for most in (8.0, 4.5))
    assert [e.solver for e in bright] == ['exact', 'one_psd']
    assert bright == quiet


def test_half_the_light_doubles_the_noise_of_one_detector() -> None:
    """Where both are lit by half, and the spot of one leaves its area; a twist that is none adds no variance."""
    lit = []
    for total in (5.0, 2.5):
        volts = at_rest(1, total)
        volts[:, 0] = 10.0
        lit += estimates(volts, {'splitter': True, 'degraded': 'zero', 'twist_sd': 1e-12})
    assert [e.solver for e in lit] == ['one_psd', 'one_psd']
    np.testing.assert_allclose(lit[1].covariance[:5], 4.0 * np.array(lit[0].covariance[:5]), rtol=1e-9, atol=1e-20)


def calibrated(**sds: float) -> dict[str, object]:
    """A calibration that left these standard deviations; a name with ``__`` for the dot."""
    by_name = {name.replace('__', '.'): sd for name, sd in sds.items()}
    return {'calibration.names': [*INDEX], 'calibration.sds': [by_name.get(name, 0.0) for name in INDEX]}


def test_the_chi_square_allows_for_what_a_calibration_left_open() -> None:
    """r = a e with a = (n, -n)/sqrt 2 along the base line: r^2 over a C a, to which a zero's s^2 adds a_x^2 s^2."""
    volts = at_rest(1)
    volts[:, 0] = 20e-6 / 5e-4
    sure, unsure = (estimates(volts, calibrated(psd_1__zero_x=sd))[0] for sd in (0.0, 3e-6))
    square = 0.1**2 / (0.1**2 + 0.07**2) / 2.0
    variance = square * (20e-6) ** 2 / sure.chi_square
    assert variance == pytest.approx((2e-3 * 5e-4) ** 2 / 20.0, rel=0.05)
    assert unsure.chi_square == pytest.approx(square * (20e-6) ** 2 / (variance + square * (3e-6) ** 2), rel=1e-3)


@pytest.mark.parametrize('psd', [0, 1])
@pytest.mark.parametrize('axis', [0, 1])
def test_zero_variance_of_single_psd_follows_rotation(psd: int, axis: int) -> None:
    """d = l - R(theta) (c + m): to C come s^2 of l, and v g g^T of the twist's variance v, g = -R'(theta) (c + m)."""
    theta = 0.3
    c, s = math.cos(theta), math.sin(theta)
    rotated, slope = np.array([[c, -s], [s, c]]), np.array([[-s, -c], [c, -s]])
    volts = at_rest(2)
    beams = np.array([[0.0, 0.07], [-0.1, 0.0]])
    for n, beam in enumerate(beams):
        volts[:, 3 * n : 3 * n + 2] = (rotated.T @ (beam - (1e-3, 2e-3)) - beam) / 5e-4
    dot = volts[0, 3 * psd : 3 * psd + 2] * 5e-4
    volts[20:, 3 - 3 * psd : 6 - 3 * psd] = 0.0
    name = f'psd_{psd + 1}__zero_{"xy"[axis]}'
    area = {f'psd_{n}.active_area': [0.1, 0.1] for n in (1, 2)}
    sure, unsure = (
        estimates(volts, {**calibrated(**{name: sd}), **area, 'converter.full_scale': 100.0, 'degraded': 'hold'})[1]
        for sd in (0.0, 1e-4)
    )
    assert unsure.pose == pytest.approx((1e-3, 2e-3, theta), abs=1e-6)
    more = (np.array(unsure.covariance) - sure.covariance).reshape(3, 3)
    g = -slope @ (beams[psd] + dot)
    of_zero = np.diag([1e-8 if i == axis else 0.0 for i in range(2)])
    np.testing.assert_allclose(more[:2, :2], of_zero + more[2, 2] * np.outer(g, g), rtol=1e-3, atol=1e-12)


def test_calibration_covariance_is_reported_beside_noise() -> None:
    """``systematic`` is what the covariance holds besides noise, of the last estimate."""
    rig = {**calibrated(psd_1__zero_x=3e-6, psd_2__zero_y=2e-6), 'consistency': 'report', 'solvers': ['exact']}
    covariances = []
    for values in (rig, {**rig, 'covariance': 'noise'}):
        pipeline = Pipeline(load_rig(overrides=values))
        (record,) = (r for r in pipeline.process(chunk(at_rest(1))) if isinstance(r, DeflectionEstimate) and r.primary)
        covariances.append(np.array(record.covariance).reshape(3, 3))
        if values is rig:
            reported = pipeline.estimation.systematic
        else:
            assert pipeline.estimation.systematic is None
    assert reported is not None
    np.testing.assert_allclose(reported, covariances[0] - covariances[1], rtol=1e-9, atol=1e-24)
    assert reported[0, 0] > 1e-12


def test_inconsistent_reading_widens_covariance() -> None:
    volts = at_rest(1)
    volts[:, 0] = 1e-3 / 5e-4
    (widened,), (reported,) = (estimates(volts, {'consistency': c}) for c in ('widen', 'report'))
    assert widened.pose == reported.pose
    assert max(np.abs(widened.pose) / np.sqrt(np.array(widened.covariance)[[0, 4, 8]])) < 2.0
    assert max(np.abs(reported.pose) / np.sqrt(np.array(reported.covariance)[[0, 4, 8]])) > 100.0


def test_inconsistent_readings_are_rejected_on_request() -> None:
    volts = at_rest(1)
    volts[:, 0] = 1e-3 / 5e-4
    records = list(Pipeline(load_rig(overrides={'consistency': 'reject'})).process(chunk(volts)))
    assert not [r for r in records if isinstance(r, DeflectionEstimate)]
    (spots,) = (r for r in records if isinstance(r, SpotMeans))
    assert spots.status is BlockStatus.INCONSISTENT
    assert re.fullmatch(r'the four readings contradict each other: chi-square \d{4,} of 1', spots.reason)


def test_a_method_without_a_covariance_has_none() -> None:
    pipeline = Pipeline(load_rig(overrides={'solvers': ['exact', 'iterative_printed', 'wls']}))
    by_solver = {r.solver: r for r in pipeline.process(chunk(at_rest(1))) if isinstance(r, DeflectionEstimate)}
    assert list(by_solver) == ['exact', 'iterative_printed', 'wls']
    assert np.isnan(by_solver['iterative_printed'].covariance).all()
    assert not np.isnan(by_solver['wls'].covariance).any()


REST = np.zeros((2, 4))


def correction(*effects: dict[str, object]) -> Correction:
    named = {f'effects.e{i}.{k}': v for i, values in enumerate(effects) for k, v in values.items()}
    return Correction.from_rig(load_rig(overrides=named))


def test_without_a_temperature_and_a_time_nothing_has_drifted() -> None:
    around = Surroundings()
    assert around.warmer == 0.0
    around.load_state_dict(dict(zip(ENVIRONMENT, (0.0, 20.0, 21.5), strict=True)))
    assert around.warmer == 1.5
    warm = correction({'name': 'thermal_drift', 'psd': 2, 'x': 3e-6, 'y': -1e-6})
    assert (warm.uses_temperature, warm.uses_time) == (True, False)
    np.testing.assert_array_equal(warm.apply(REST), REST)
    np.testing.assert_allclose(warm.apply(REST, None, 2.0), [[0.0, 0.0, -6e-6, 2e-6]] * 2, rtol=1e-12)
    late = correction({'name': 'laser_pointing_drift', 'psd': 1, 'rate_x': 2e-6, 'rate_y': 1e-6})
    assert (late.uses_temperature, late.uses_time) == (False, True)
    np.testing.assert_allclose(late.apply(REST), REST, atol=1e-18)
    # The beam of PSD 1 has gone so far, and the dot with it.
    got = late.apply(REST, t=np.array([0.0, 3.0]))
    np.testing.assert_allclose(got, [[0.0] * 4, [-6e-6, -3e-6, 0.0, 0.0]], rtol=1e-4, atol=1e-18)


def test_a_beam_that_leans_is_corrected_on_the_plate_alone() -> None:
    leans = {'beam_1.angle': [0.0, 1e-3]}
    assert Correction.from_rig(load_rig(overrides=leans)).active
    assert not Correction.from_rig(load_rig(overrides=BASE)).active
    with pytest.raises(ConfigError, match=r'^beam_N\.angle: '):
        Correction.from_rig(load_rig(overrides={**BASE, **leans}))


@pytest.mark.parametrize('psd', [1, 2])
def test_ambient_light_is_removed_with_sum_of_its_psd(psd: int) -> None:
    """Of S + level at the centroid (S m + level c)/(S + level); without a sum S + level is the nominal 5 V."""
    light = correction({'name': 'ambient_light', 'psd': psd, 'level': 0.5, 'x': 1e-3, 'y': -2e-3})
    dots = np.array([[1e-4, 2e-4, 3e-4, 4e-4]])
    column = 2 * psd - 2
    for sums, total in ((None, 5.0), (np.array([[4.0, 3.0]]), 5.0 - psd)):
        wanted = dots.copy()
        read = dots[0, column : column + 2]
        wanted[0, column : column + 2] = (total * read - 0.5 * np.array([1e-3, -2e-3])) / (total - 0.5)
        np.testing.assert_allclose(light.apply(dots, sums), wanted, rtol=1e-12)


def test_samples_are_corrected_with_their_own_sums() -> None:
    """Of 4 V, where the nominal sum is 5 V."""
    light = {'name': 'ambient_light', 'psd': 1, 'level': 0.5, 'x': 1e-3, 'y': -2e-3}
    rig = load_rig(overrides={f'effects.light.{name}': value for name, value in light.items()})
    (spots,) = (r for r in Pipeline(rig).process(chunk(at_rest(1, 4.0))) if isinstance(r, SpotMeans))
    assert spots.dots == pytest.approx((-0.5e-3 / 3.5, 1e-3 / 3.5, 0.0, 0.0))


def test_what_came_last_is_taken_off_first() -> None:
    """A PSD is turned, then its axes mix, then it is scaled: three that do not commute."""
    c, s = np.cos(0.3), np.sin(0.3)
    rotated, mixed, scaled = np.array([[c, s], [-s, c]]), np.array([[1.0, 0.2], [-0.1, 1.0]]), np.diag([1.5, 0.8])
    true = np.array([1e-3, -0.4e-3])
    dots = np.array([[*(scaled @ mixed @ rotated @ true), 0.0, 0.0]])
    of_all = correction(
        {'name': 'sensor_gain', 'psd': 1, 'x': 0.5, 'y': -0.2},
        {'name': 'sensor_rotation', 'psd': 1, 'angle': 0.3},
        {'name': 'axis_crosstalk', 'psd': 1, 'xy': 0.2, 'yx': -0.1},
    )
    np.testing.assert_allclose(of_all.apply(dots), [[*true, 0.0, 0.0]], rtol=1e-12, atol=1e-18)


def test_the_pose_is_found_in_three_passes() -> None:
    """PSD 1 and its laser are 6 mm off. With plane vectors as complex numbers, m = exp(-i theta)(l - d) - c."""
    centers, off = np.array([0.07j, -0.1]), np.array([5e-3 + 3e-3j, 0.0])

    def shown(theta: float, d: complex, at: FloatArray) -> FloatArray:
        return np.asarray(cmath.exp(-1j * theta) * (at - d) - at)

    theta, d = 0.04, 2e-3 - 1e-3j
    read = shown(theta, d, centers + off)
    dots = read
    for _ in range(3):
        points = centers + dots
        from_middle = points - points.mean(), centers - centers.mean()
        angle = cmath.phase(np.sum(from_middle[0].conj() * from_middle[1]))
        moved = centers.mean() - cmath.exp(1j * angle) * points.mean()
        dots = read - (shown(angle, moved, centers + off) - shown(angle, moved, centers))
    given = np.column_stack([read.real, read.imag]).reshape(1, 4)
    got = correction({'name': 'sensor_position', 'psd': 1, 'x': 5e-3, 'y': 3e-3}).apply(given)
    np.testing.assert_allclose(got, np.column_stack([dots.real, dots.imag]).reshape(1, 4), atol=1e-13)
    # Each pass leaves some per cent of the error of the one before.
    true = shown(theta, d, centers)
    assert 1e-10 < np.abs(dots - true).max() < 1e-7
