# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Calibration against rigs of the second generator in blind/; dark levels against photocurrents that add."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from blind import calibration as campaign
from blind import misaligned
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.model.detector import VoltsToDots
from psd_deflection.recordings.in_memory import RecordingInMemory
from psd_deflection.records import AppliedLoad, FloatArray, RawChunk
from psd_deflection.rig.config import Rig, replace_values, rig_from_values
from psd_deflection.studies.calibrate import calibrate as module
from psd_deflection.studies.calibrate.calibrate import Calibration, calibrate
from psd_deflection.studies.calibrate.check import check
from psd_deflection.studies.calibrate.dark import dark_levels, result_of_levels, values_of_levels, words_of_level
from psd_deflection.studies.calibrate.fit import NAMES, CalibrationFit, fit, prior_of_rig
from psd_deflection.studies.calibrate.from_recordings import CalibrationOptions
from psd_deflection.studies.calibrate.observation import CalibrationRun, Rows
from psd_deflection.studies.calibrate.result import values_of

AT = {name: i for i, name in enumerate(NAMES)}


@pytest.fixture(scope='module')
def nominal() -> Rig:
    return rig_from_values({})


@pytest.fixture(scope='module')
def pose() -> FloatArray:
    return misaligned.poses(misaligned.pushes(np.random.default_rng(3), 12, 2.0))


def only(**parameters: float) -> dict[str, float]:
    """The nominal rig (k = 1.5) but for these; ``psd_2__rotation`` is psd_2.rotation."""
    return misaligned.nominal() | {name.replace('__', '.'): v for name, v in parameters.items()}


def calibrated(rig: Rig, truth: dict[str, float], pose: FloatArray, seed: int = 1, **more: Any) -> Calibration:
    recorded = misaligned.record(truth, pose, np.random.default_rng(seed), **more)
    return calibrate([campaign.run_of(recorded)], rig)


def test_a_turned_psd_is_found_with_its_sign_and_the_noise(nominal: Rig, pose: FloatArray) -> None:
    calibration = calibrated(nominal, only(psd_2__rotation=0.02), pose, 6, reference_sd=(5e-6, 20e-6, 1e-3))
    # Without the non-linearities unseen motion is predicted better here, but by less than two standard errors.
    assert calibration.dropped == []
    rotated = calibration.values[AT['psd_2.rotation']]
    # Half the difference of the crosstalks looks the same, and gets its share.
    skew = calibration.values[AT['psd_2.crosstalk_xy']] - calibration.values[AT['psd_2.crosstalk_yx']]
    assert rotated + skew / 2.0 == pytest.approx(0.02, abs=2e-4)
    assert rotated > 0.015
    assert calibration.fit.noise.reference == pytest.approx((5e-6, 20e-6, 1e-3), rel=0.12)
    assert calibration.noise == pytest.approx(np.full(4, 2e-3), rel=0.03)


def test_errors_are_those_that_are_reported(nominal: Rig, pose: FloatArray) -> None:
    """All tolerances at once, two rigs; the campaign has many."""
    rng = np.random.default_rng(5)
    errors: list[float] = []
    for _ in range(2):
        truth = misaligned.draw(rng)
        calibration = calibrated(nominal, truth, pose, seed=int(rng.integers(1 << 30)), outliers=0.02)
        errors += [float((calibration.values[AT[n]] - v) / calibration.sd[AT[n]]) for n, v in truth.items() if n in AT]
    assert 0.3 < np.mean(np.square(errors)) < 2.0
    assert np.max(np.abs(errors)) < 4.5


def test_outliers_do_not_move_it(nominal: Rig, pose: FloatArray) -> None:
    truth = misaligned.draw(np.random.default_rng(8))
    clean, dirty = (calibrated(nominal, truth, pose, outliers=share) for share in (0.0, 0.1))
    # Both non-linearities, 287 and 432 / m^2, predict unseen motion better.
    assert dirty.dropped == clean.dropped == []
    assert dirty.fit.weights.mean() == pytest.approx(0.9, abs=0.05)
    assert dirty.gap.heldout_after == pytest.approx(clean.gap.heldout_after, rel=0.1)
    off = np.abs(dirty.values - clean.values) / clean.sd
    assert off[: AT['psd_1.zero_x']].max() < 3.0


def test_undetermined_parameter_keeps_value_and_sd(nominal: Rig) -> None:
    """Forces along Y alone move no dot along x and turn nothing."""
    rng = np.random.default_rng(4)
    loads = misaligned.pushes(rng, 12, 2.0) * (0.0, 1.0, 0.0)
    calibration = calibrated(nominal, misaligned.draw(rng), misaligned.poses(loads))
    alone = {next(iter(d.parts)) for d in calibration.undetermined if len(d.parts) == 1}
    for name in ('psd_1.center_y', 'psd_2.center_x', 'beam_1.angle_x'):
        assert name in alone
        assert calibration.values[AT[name]] == calibration.prior.mean[AT[name]]
        assert calibration.sd[AT[name]] == pytest.approx(calibration.prior.sd[AT[name]])
    assert 'psd_1.gain_y' not in alone


def test_frames_count_as_much_as_they_say(nominal: Rig, pose: FloatArray) -> None:
    """Every second frame is three times as noisy, and says so: too little for an outlier."""
    pose = pose[:8000]
    recorded = misaligned.record(only(), pose, np.random.default_rng(2))
    run = campaign.run_of(recorded)
    share = np.where(np.arange(len(run.reference)) % 2, 3.0, 1.0)[:, None] * np.ones(3)
    noisy = pose[recorded.frames] + (run.reference - pose[recorded.frames]) * share
    # In its own units: only the proportions are believed.
    known, guessed = (
        calibrate([replace(run, reference=noisy, reference_sd=sd)], nominal)
        for sd in (7.0 * share * misaligned.CAMERA, None)
    )
    clock = AT['reference.clock']
    assert known.sd[clock] < guessed.sd[clock] / 1.4
    assert abs(known.clock + known.values[clock]) < 4.0 * known.sd[clock]


def test_the_beam_solver_takes_a_calibrated_file(nominal: Rig, pose: FloatArray) -> None:
    """What tilts and heights did is taken off the dots: it must not be taken off twice."""
    truth = misaligned.draw(np.random.default_rng(8))
    rig, _ = campaign.calibrated_rig(nominal, campaign.run_of(misaligned.record(truth, pose, np.random.default_rng(1))))
    rng = np.random.default_rng(6)
    later = misaligned.poses(misaligned.pushes(rng, 3, 1.0))
    volts = misaligned.record(truth, later, rng).volts
    (_, exact, small), (_, beam, of_beam) = (
        campaign.measured(replace_values(rig, {'solver': name}), volts) for name in ('exact', 'beam')
    )
    assert np.abs(exact).max(axis=0).min() > 1e-3
    assert beam == pytest.approx(exact, abs=1e-8)
    assert of_beam == pytest.approx(small, rel=0.1, abs=1e-16)


def test_every_recording_has_a_zero_of_its_own(nominal: Rig) -> None:
    """The beams were aimed anew between two recordings, by 0.3 mm: a hundred times what the readings are good for."""
    rng = np.random.default_rng([77, 1])
    truth, runs = misaligned.draw(rng), []
    for _ in range(2):
        now = truth | {f'beam_{n}.{axis}': rng.normal(0.0, 3e-4) for n in (1, 2) for axis in 'xy'}
        runs.append(campaign.run_of(misaligned.record(now, misaligned.poses(misaligned.pushes(rng, 6, 1.2)), rng)))
    calibration = calibrate(runs, nominal)
    assert calibration.fit.noise.dots == pytest.approx(1.0, abs=0.15)
    errors = np.array([(calibration.values[AT[n]] - v) / calibration.sd[AT[n]] for n, v in truth.items() if n in AT])
    assert np.abs(errors).max() < 4.0
    assert np.mean(errors**2) < 2.0


@pytest.mark.slow
def test_a_late_reference_is_put_right(nominal: Rig, pose: FloatArray) -> None:
    run = campaign.run_of(misaligned.record(only(), pose, np.random.default_rng(2)))
    calibration = calibrate([replace(run, reference_t=run.reference_t + 0.0123)], nominal)
    assert calibration.clock + calibration.values[AT['reference.clock']] == pytest.approx(-0.0123, abs=2e-4)
    assert calibration.gap.heldout_after < 1.2 * calibrate([run], nominal).gap.heldout_after


def test_a_non_linearity_that_does_not_last_is_dropped(nominal: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the other sign in every second eighth: on what was left out of a fit it is worse than none."""
    pose = misaligned.poses(np.tile(misaligned.pushes(np.random.default_rng(4), 6, 0.1), (8, 1)))
    first, other = (
        misaligned.record(only(psd_1__nonlinearity=k), pose, np.random.default_rng(1), every=10) for k in (2e2, -2e2)
    )
    odd, fits = np.arange(len(pose))[:, None] * 8 // len(pose) % 2 == 1, list[CalibrationFit]()

    def recorded(*given: Any, **also: Any) -> CalibrationFit:
        fits.append(fit(*given, **also))
        return fits[-1]

    monkeypatch.setattr(module, 'fit', recorded)
    calibration = calibrate([campaign.run_of(replace(first, volts=np.where(odd, other.volts, first.volts)))], nominal)
    at = AT['psd_1.nonlinearity']
    assert 'psd_1.nonlinearity' in calibration.dropped
    assert calibration.values[at] == 0.0
    # It is known better all the same: as well as the fit knew it, and as far as that was from 0.
    assert calibration.sd[at] ** 2 == pytest.approx(fits[0].covariance[at, at] + fits[0].values[at] ** 2)
    assert calibration.sd[at] < 0.5 * calibration.prior.sd[at]


def test_a_recording_is_taken_with_its_rig_and_the_load_of_each_sample(tmp_path: Path) -> None:
    """A load that is a fifth of a sample late counts for that sample, one that is a third late for the next."""
    rig = rig_from_values({'link.length': 0.6})
    t_ns, volts = 10**9 + 10**6 * np.arange(80), np.full((80, 6), 5.0, dtype=np.float32)
    loads = [AppliedLoad(1_020_200_000, 10.0, 0.0, 0.0), AppliedLoad(1_060_333_000, 20.0, 0.0, 0.0)]
    recording = RecordingInMemory(tmp_path, None, RawChunk(np.arange(80), t_ns, volts, np.zeros(80, np.uint8)), loads)
    recording.parameters = rig.flat()
    assert CalibrationOptions().rig([recording], pytest.fail).flat() == rig.flat()
    (run,) = CalibrationOptions().runs([recording], rig)
    assert run.loads is not None
    assert run.loads.tolist() == [[10.0 * (i >= 20) + 10.0 * (i >= 61), 0.0, 0.0] for i in range(80)]
    assert (len(run.reference_t), len(run.reference)) == (0, 0)
    with pytest.raises(RecordingError, match=r'neither a reference .* nor known loads; --self'):
        calibrate([replace(run, loads=None)], rig)


def test_a_reference_that_is_no_reference_is_rejected(nominal: Rig, pose: FloatArray) -> None:
    run = campaign.run_of(misaligned.record(only(), pose, np.random.default_rng(2)))
    calibration = calibrate([replace(run, reference=np.random.default_rng(1).permutation(run.reference))], nominal)
    assert calibration.rejected.startswith('on motion that was not fitted')
    values, effects = values_of(calibration, 'today')
    assert not effects
    assert set(values) == {'psd_1.noise', 'psd_2.noise'}


@pytest.mark.slow
def test_the_redundant_reading_alone_reports_a_relative_gain(nominal: Rig, pose: FloatArray) -> None:
    run = campaign.run_of(misaligned.record(only(psd_1__gain_x=0.02), pose, np.random.default_rng(2)))
    calibration = calibrate([run], nominal, alone=True)
    # Along the base line (0.1, 0.07), which the one reading too many sees when the plate goes along X.
    v = {name: calibration.values[i] for name, i in AT.items()}
    along = v['psd_1.gain_x'] - v['psd_2.gain_x']
    across = v['psd_1.crosstalk_yx'] - v['psd_2.crosstalk_yx'] - v['psd_1.rotation'] + v['psd_2.rotation']
    assert 0.1 * along + 0.07 * across == pytest.approx(0.1 * 0.02, rel=0.25)
    assert calibration.gap.heldout_after < 0.2 * calibration.gap.heldout_before


def test_known_loads_alone_leave_the_scale_to_the_clamp(nominal: Rig) -> None:
    rng = np.random.default_rng(6)
    loads = misaligned.pushes(rng, 14, 3.0)
    truth = only(psd_1__gain_x=0.02, psd_2__rotation=0.015)
    run = campaign.run_of(misaligned.record(truth, misaligned.poses(loads), rng))
    held = CalibrationRun(run.name, run.t, run.volts, run.reference_t[:0], run.reference[:0], loads)
    calibration = calibrate([held], nominal)
    relative = calibration.values[AT['psd_1.gain_x']] - calibration.values[AT['psd_2.gain_x']]
    assert relative == pytest.approx(0.02, abs=0.006)
    # Common to all gains, against the clamp: no better than the tolerance of four of them.
    assert calibration.sd[AT['psd_1.gain_x']] > 0.003


def test_a_check_reports_where_the_beams_are_from_the_zero_of_the_file(nominal: Rig) -> None:
    pose = misaligned.poses(misaligned.pushes(np.random.default_rng(3), 3, 0.5))
    truth = only(beam_1__x=1.2e-3, beam_1__y=-2.1e-3, beam_2__x=2e-4)
    rig = replace_values(nominal, {'psd_1.zero': [1e-3, -2e-3], 'psd_2.zero': [3e-4, 1e-4]})
    checkup, moved = (
        check([campaign.run_of(misaligned.record(truth | more, pose, np.random.default_rng(1)))], rig)
        for more in ({}, {'psd_1.rotation': 0.1})
    )
    off = np.abs(checkup.zero - (2e-4, -1e-4, -1e-4, -1e-4))
    assert (checkup.unchanged, moved.unchanged, moved.groups[0].group) == (True, False, 'psd_1.rotation')
    assert np.all((off < 2e-5) & (off < 4.0 * checkup.zero_sd))


@pytest.mark.slow
def test_check_names_what_moved(nominal: Rig, pose: FloatArray) -> None:
    rng = np.random.default_rng(9)
    truth = misaligned.draw(rng)
    rig, _ = campaign.calibrated_rig(nominal, campaign.run_of(misaligned.record(truth, pose, rng)))
    assert check([campaign.run_of(misaligned.record(truth, pose, rng))], rig).unchanged
    moved = truth | {'psd_1.rotation': truth['psd_1.rotation'] + 0.03}
    checkup = check([campaign.run_of(misaligned.record(moved, pose, rng))], rig)
    assert not checkup.unchanged
    assert checkup.groups[0].group == 'psd_1.rotation'
    value, sd = checkup.groups[0].shifts['psd_1.rotation']
    assert abs(value - 0.03) < 4.0 * sd


def test_contradicted_priors_widen_once_worst_first(nominal: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clamp, too: it has no parameter in the rig file that the other numbers are counted by."""
    prior = prior_of_rig(nominal)
    worst, next_one = AT['clamp.bending_compliance'], AT['psd_1.rotation']
    values = prior.mean.copy()
    values[[worst, next_one]] += (400.0, 300.0) * prior.sd[[worst, next_one]]
    first = cast(CalibrationFit, SimpleNamespace(values=values, covariance=1e-6 * prior.covariance))
    # A fit that stays where it is.
    monkeypatch.setattr(module, 'fit', lambda *_, start, **__: start)
    free = np.ones(len(NAMES), dtype=bool)
    _, wider, widened = module.believed_fit(first, cast(Rows, None), nominal, prior, 'loads', free)
    assert widened == ['clamp.bending_compliance', 'psd_1.rotation']
    sd = prior.sd.copy()
    sd[[worst, next_one]] *= module.WIDER
    assert wider.sd == pytest.approx(sd)


RATE = 1000
LIT = misaligned.Light(0.12, 3.0, -2.0, 0.0, 0.0, 0.0)
DIM = misaligned.Light(0.06, -1.0, 0.5, 0.0, 0.0, 0.0)


def run_of(volts: FloatArray, name: str = 'off.csv') -> CalibrationRun:
    return CalibrationRun(name, np.arange(len(volts)) / RATE, volts, np.zeros(0), np.zeros((0, 3)), digest='ab' * 32)


def darkness(seconds: float = 5.0, seed: int = 1, light: tuple[Any, Any] = (LIT, DIM)) -> FloatArray:
    return np.array(misaligned.darkness(light, seconds, np.random.default_rng(seed)))


def white(levels: tuple[float, ...], n: int = 5000, sigma: float = 2e-3) -> FloatArray:
    return np.array(levels) + np.random.default_rng(2).normal(0.0, sigma, (n, 6))


def test_levels_are_within_what_is_reported_of_them_in_95_of_100(nominal: Rig) -> None:
    """Coloured noise and flicker: the error of white noise would be a third of that."""
    rng = np.random.default_rng(12)
    deviates: list[FloatArray] = []
    for _ in range(40):
        light = misaligned.draw_light(rng)
        levels = dark_levels([run_of(np.array(misaligned.darkness(light, 5.0, rng)))], nominal)
        for level, truth in zip(levels, light, strict=True):
            true = (truth.x + truth.offset_x, truth.y + truth.offset_y, truth.level + truth.offset_sum)
            deviates.append((level.volts - true) / level.sd)
    z = np.array(deviates)
    assert 0.92 <= np.mean(np.abs(z) < 1.96) <= 0.98
    assert 0.85 < np.sqrt(np.mean(z**2)) < 1.2


STUDENT = 2.093024 / 1.959964


@pytest.mark.parametrize(
    ('off', 'sd', 'rel'),
    [
        # Means of twenty pieces; none follows from the one before.
        (np.repeat([1e-3, -1e-3] * 10, 250), STUDENT * 1e-3 / 19**0.5, 1e-5),
        # Of neighbours 17 are alike and 2 are not: a correlation of 15/20, and (1 + 3/4)/(1 - 3/4) count as one.
        (np.repeat(1e-3 * np.array([1] * 5 + [-1] * 10 + [1] * 5), 250), STUDENT * 1e-3 * (7.0 / 19.0) ** 0.5, 1e-5),
        # White noise has the error of a mean.
        (np.random.default_rng(2).normal(0.0, 2e-3, 16_000), 2e-3 / 16_000**0.5, 0.45),
        # A steady number on a converter of 305 µV a step may be anything within the step.
        (np.zeros(4000), 20.0 / 65536.0 / 12.0**0.5, 0.01),
    ],
)
def test_the_error_of_a_level_is_that_of_what_varies(nominal: Rig, off: FloatArray, sd: float, rel: float) -> None:
    (level, _) = dark_levels([run_of(np.array((1.0, 2.0, 0.1, 0.0, 0.0, 0.1)) + off[:, None])], nominal)
    assert level.sd == pytest.approx(np.full(3, sd), rel=rel)


def test_what_is_reported_of_one_psd(nominal: Rig) -> None:
    lit = run_of(white((0.0, 0.0, 5.12, 0.0, 0.0, 5.06), 500, 0.0))
    (level, two) = dark_levels([run_of(darkness())], nominal, [lit])
    assert level.lit_sum == 5.12
    assert level.share == pytest.approx(0.12 / 5.12, rel=4e-3)
    assert two.share == pytest.approx(0.06 / 5.06, rel=8e-3)
    # 0.5 mm a volt, in metres; what is left is the error of the share times half of 10 mm.
    assert level.place == pytest.approx([1.5e-3, -1.0e-3], abs=1e-6)
    assert level.residual == pytest.approx(5e-3 * level.sd[2] / 5.12)
    tree = result_of_levels([level])['psd_1']
    assert tree['sum'] == {'value': level.volts[2], 'sd': level.sd[2], 'unit': 'V', 'file': 0.0}
    assert tree['recording'] == {'name': 'off.csv', 'sha256': 'ab' * 32}
    assert words_of_level(level).startswith('psd_1 with its laser off: sum 0.119')
    assert ' % of the light pulls to (+1.50, -1.00) mm; what ' in words_of_level(level).replace('%', ' %')
    (alone, _) = dark_levels([run_of(darkness())], nominal)
    assert alone.lit_sum == pytest.approx(5.0 + alone.volts[2])


def test_lasers_may_be_off_one_after_the_other_and_for_a_part(nominal: Rig) -> None:
    """The beam of the other laser is on: each PSD takes the longest time without its own, but for its borders."""
    first, second = darkness(), darkness(seed=2)
    first[:, 3:] = (0.0, 0.0, 5.0)
    second[:, :3] = (0.0, 0.0, 5.0)
    # While a laser goes off and comes on its light is between.
    second[:600, 3:] = (0.0, 0.0, 5.0)
    second[600:690, 5] = 2.0
    second[4900:, 3:] = (0.0, 0.0, 5.0)
    second[4850:4900, 5] = 2.0
    (level, two) = dark_levels([run_of(first, 'a'), run_of(second, 'b')], nominal)
    assert (level.recording, level.seconds) == ('a', 5.0)
    assert (two.recording, two.seconds) == ('b', 4.1)
    assert (level.volts[2], two.volts[2]) == pytest.approx((0.12, 0.06), abs=1e-3)


def test_lost_samples_are_left_out(nominal: Rig) -> None:
    volts = darkness()
    full = dark_levels([run_of(volts)], nominal)
    volts[1000:1500] = np.nan
    gaps = dark_levels([run_of(volts)], nominal)
    assert gaps[0].seconds == 4.5
    assert np.abs(gaps[0].volts - full[0].volts).max() < 3e-4


@pytest.mark.parametrize(
    ('rows', 'column', 'value', 'words'),
    [
        (
            slice(None),
            5,
            4.9,
            r'^off\.csv: the laser of psd_2 is off for 0\.0 s; a dark level needs 4 s with sum2 below 2\.5 V '
            r'\(sum_min\), and its median is 4\.900 V$',
        ),
        (slice(1500, 2600), 2, 5.0, r'the laser of psd_1 is off for 2\.3 s'),
        (slice(700, 702), 1, 9.95, r'^off\.csv: y1 is saturated with the laser off: 9\.950 V, .*is 10 V'),
    ],
)
def test_a_recording_that_reports_no_dark_level_is_rejected(
    nominal: Rig, rows: slice, column: int, value: float, words: str
) -> None:
    volts = darkness()
    volts[rows, column] = value
    with pytest.raises(RecordingError, match=words):
        dark_levels([run_of(volts)], nominal)


def test_a_drift_is_rejected_if_it_moves_a_dot(nominal: Rig) -> None:
    """1 mV of the sum are 1 µm at the edge; 2 mV of x are 0.02 µm with 2 % of the light."""
    ramp = np.linspace(-1e-3, 1e-3, 5000)
    volts = white((3.0, -2.0, 0.12, -1.0, 0.5, 0.06), sigma=5e-4)
    volts[:, [0, 5]] += ramp[:, None] * (1.0, 0.22)
    dark_levels([run_of(volts)], nominal)
    volts[:, 5] += 0.08 * ramp
    with pytest.raises(RecordingError, match=r'sum2 drifts with the laser off: by \+0\.[56]\d mV in 5\.0 s, noise'):
        dark_levels([run_of(volts)], nominal)


def test_without_light_x_and_y_mean_nothing_and_are_not_judged(nominal: Rig) -> None:
    """A quotient of nothing may be at the rail. A sum of 0 or below is no light."""
    levels = dark_levels([run_of(white((9.99, 0.0, -3e-3, 0.0, -9.99, 1e-6), sigma=1e-4))], nominal)
    assert levels[0].share == 0.0
    assert 'no other light' in words_of_level(levels[0])
    rig = replace_values(nominal, values_of_levels(levels[:1]))
    sample = np.array([[1.0, 2.0, 5.0, 3.0, 4.0, 5.0]], dtype=np.float32)
    np.testing.assert_array_equal(VoltsToDots.from_rig(rig).dots(sample), VoltsToDots.from_rig(nominal).dots(sample))


def test_light_is_not_taken_off_twice(nominal: Rig) -> None:
    runs = [run_of(darkness())]
    corrected = replace_values(
        nominal, {'effects.a.name': 'ambient_light', 'effects.a.psd': 1, 'effects.a.level': 0.1, 'effects.a.x': 1e-3}
    )
    for rejected in (lambda: dark_levels(runs, corrected), lambda: calibrate(runs, corrected)):
        with pytest.raises(ConfigError, match=r'^effects: ambient_light.*would count it twice; take it out'):
            rejected()
    old = replace_values(nominal, {'calibration.names': ['psd_1.gain_x'], 'calibration.sds': [1e-3]})
    with pytest.raises(ConfigError, match=r'^psd_1\.dark: this rig file was calibrated without it'):
        dark_levels(runs, old)
    dark_levels(runs, replace_values(old, {'psd_1.dark': [0.0, 0.0, 0.1], 'psd_2.dark': [0.0, 0.0, 0.1]}))


def lit_poses(rig: Rig, light: Any, seed: int) -> float:
    """Largest error of ΔX and ΔY, m, of the nominal rig in that light, zeroed in it."""
    rng = np.random.default_rng(seed)
    pose = misaligned.poses(misaligned.pushes(rng, 3, 1.0))
    volts = misaligned.record(misaligned.nominal() | {'link.slope_ratio': 0.0}, pose, rng, light=light).volts
    block, estimate, _ = campaign.measured(rig, volts)
    a, b, c, d = (pose[10 + i :: 20] for i in (-2, -1, 0, 1))
    return float(np.abs(estimate - ((9.0 * (b + c) - a - d) / 16.0)[block])[:, :2].max())


@pytest.mark.slow
def test_estimates_are_free_of_light_and_of_offsets(nominal: Rig) -> None:
    """2 % of the light moves the estimate by 2 % of the deflection; with dark levels half of its noise band is left.

    Offsets of x and y of 20 mV (10 µm) go with the zero.
    """
    light = (LIT._replace(offset_x=0.02), DIM._replace(offset_y=-0.02))
    rig = campaign.darkened(nominal, light, np.random.default_rng(1))
    before, after = lit_poses(nominal, light, 5), lit_poses(rig, light, 5)
    assert before > 30e-6
    assert after < 2.5e-6
    assert after < 1.2 * lit_poses(nominal, (misaligned.DARK, misaligned.DARK), 5) + 0.3e-6
