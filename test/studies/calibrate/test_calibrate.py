# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Calibration against rigs of the second generator in blind/, whose optics are not ours."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from blind import calibration as campaign
from blind import misaligned
from psd_deflection.base.errors import RecordingError
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, replace_values, rig_from_values
from psd_deflection.studies.calibrate import calibrate as module
from psd_deflection.studies.calibrate.calibrate import Calibration, calibrate
from psd_deflection.studies.calibrate.check import check
from psd_deflection.studies.calibrate.fit import NAMES, CalibrationFit, prior_of_rig
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


def test_a_turned_psd_is_found_with_its_sign(nominal: Rig, pose: FloatArray) -> None:
    found = calibrated(nominal, only(psd_2__rotation=0.02), pose)
    rotated = found.values[AT['psd_2.rotation']]
    # Half the difference of the crosstalks looks the same, and gets its share.
    skew = found.values[AT['psd_2.crosstalk_xy']] - found.values[AT['psd_2.crosstalk_yx']]
    assert rotated + skew / 2.0 == pytest.approx(0.02, abs=2e-4)
    assert rotated > 0.015


def test_errors_are_those_that_are_reported(nominal: Rig, pose: FloatArray) -> None:
    """All tolerances at once, two rigs; the campaign has many."""
    rng = np.random.default_rng(5)
    errors: list[float] = []
    for _ in range(2):
        truth = misaligned.draw(rng)
        found = calibrated(nominal, truth, pose, seed=int(rng.integers(1 << 30)), outliers=0.02)
        errors += [float((found.values[AT[n]] - v) / found.sd[AT[n]]) for n, v in truth.items() if n in AT]
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


def test_the_noise_of_reference_and_channels_is_reported(nominal: Rig, pose: FloatArray) -> None:
    found = calibrated(nominal, only(), pose, spread=(5e-6, 20e-6, 1e-3))
    assert found.fit.noise.reference == pytest.approx((5e-6, 20e-6, 1e-3), rel=0.12)
    assert found.noise == pytest.approx(np.full(4, 2e-3), rel=0.03)


def test_undetermined_parameter_keeps_value_and_sd(nominal: Rig) -> None:
    """Forces along Y alone move no dot along x and turn nothing."""
    rng = np.random.default_rng(4)
    loads = misaligned.pushes(rng, 12, 2.0) * (0.0, 1.0, 0.0)
    found = calibrated(nominal, misaligned.draw(rng), misaligned.poses(loads))
    alone = {next(iter(d.parts)) for d in found.undetermined if len(d.parts) == 1}
    for name in ('psd_1.center_y', 'psd_2.center_x', 'beam_1.angle_x'):
        assert name in alone
        assert found.values[AT[name]] == found.prior.mean[AT[name]]
        assert found.sd[AT[name]] == pytest.approx(found.prior.sd[AT[name]])
    assert 'psd_1.gain_y' not in alone


def test_frames_count_as_much_as_they_say(nominal: Rig, pose: FloatArray) -> None:
    """Every second frame is three times as noisy, and says so: too little for an outlier."""
    pose = pose[:8000]
    recorded = misaligned.record(only(), pose, np.random.default_rng(2))
    run = campaign.run_of(recorded)
    share = np.where(np.arange(len(run.reference)) % 2, 3.0, 1.0)[:, None] * np.ones(3)
    noisy = pose[recorded.frames] + (run.reference - pose[recorded.frames]) * share
    # In its own units: only the proportions are believed.
    stated = CalibrationRun(
        run.name, run.t, run.volts, run.reference_t, noisy, reference_sd=7.0 * share * misaligned.CAMERA
    )
    unstated = CalibrationRun(run.name, run.t, run.volts, run.reference_t, noisy)
    known, guessed = calibrate([stated], nominal), calibrate([unstated], nominal)
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
    (_, exact, small), (_, beam, own) = (
        campaign.measured(replace_values(rig, {'solver': name}), volts) for name in ('exact', 'beam')
    )
    assert np.abs(exact).max(axis=0).min() > 1e-3
    assert beam == pytest.approx(exact, abs=1e-8)
    assert own == pytest.approx(small, rel=0.1, abs=1e-16)


def test_every_recording_has_a_zero_of_its_own(nominal: Rig) -> None:
    """The beams were aimed anew between two recordings, by 0.3 mm: a hundred times what the readings are good for."""
    rng = np.random.default_rng([77, 1])
    truth, runs = misaligned.draw(rng), []
    for _ in range(2):
        now = truth | {f'beam_{n}.{axis}': rng.normal(0.0, 3e-4) for n in (1, 2) for axis in 'xy'}
        pose = misaligned.poses(misaligned.pushes(rng, 6, 1.2))
        runs.append(campaign.run_of(misaligned.record(now, pose, rng)))
    found = calibrate(runs, nominal)
    assert found.fit.noise.dots == pytest.approx(1.0, abs=0.15)
    errors = np.array([(found.values[AT[n]] - v) / found.sd[AT[n]] for n, v in truth.items() if n in AT])
    assert np.abs(errors).max() < 4.0
    assert np.mean(errors**2) < 2.0


@pytest.mark.slow
def test_a_late_reference_is_put_right(nominal: Rig, pose: FloatArray) -> None:
    recorded = misaligned.record(only(), pose, np.random.default_rng(2))
    run = campaign.run_of(recorded)
    late = CalibrationRun(run.name, run.t, run.volts, run.reference_t + 0.0123, run.reference)
    found = calibrate([late], nominal)
    clock = found.clock + found.values[AT['reference.clock']]
    assert clock == pytest.approx(-0.0123, abs=2e-4)
    assert found.gap.heldout_after < 1.2 * calibrate([run], nominal).gap.heldout_after


def test_a_reference_that_is_no_reference_is_rejected(nominal: Rig, pose: FloatArray) -> None:
    run = campaign.run_of(misaligned.record(only(), pose, np.random.default_rng(2)))
    wrong = CalibrationRun(
        run.name, run.t, run.volts, run.reference_t, np.random.default_rng(1).permutation(run.reference)
    )
    found = calibrate([wrong], nominal)
    assert found.rejected.startswith('on motion that was not fitted')
    values, effects = values_of(found, 'today')
    assert not effects
    assert set(values) == {'psd_1.noise', 'psd_2.noise'}


def test_a_recording_without_reference_and_loads_is_rejected(nominal: Rig, pose: FloatArray) -> None:
    run = campaign.run_of(misaligned.record(only(), pose[:2000], np.random.default_rng(2)))
    with pytest.raises(RecordingError, match=r'neither a reference .* nor known loads; --self'):
        calibrate([CalibrationRun(run.name, run.t, run.volts, run.reference_t[:0], run.reference[:0])], nominal)


@pytest.mark.slow
def test_the_redundant_reading_alone_reports_a_relative_gain(nominal: Rig, pose: FloatArray) -> None:
    run = campaign.run_of(misaligned.record(only(psd_1__gain_x=0.02), pose, np.random.default_rng(2)))
    found = calibrate(
        [CalibrationRun(run.name, run.t, run.volts, run.reference_t[:0], run.reference[:0])], nominal, alone=True
    )
    # Along the base line (0.1, 0.07), which the one reading too many sees when the plate goes along X.
    v = {name: found.values[i] for name, i in AT.items()}
    along = v['psd_1.gain_x'] - v['psd_2.gain_x']
    across = v['psd_1.crosstalk_yx'] - v['psd_2.crosstalk_yx'] - v['psd_1.rotation'] + v['psd_2.rotation']
    assert 0.1 * along + 0.07 * across == pytest.approx(0.1 * 0.02, rel=0.25)
    assert found.gap.heldout_after < 0.2 * found.gap.heldout_before


def test_known_loads_alone_leave_the_scale_to_the_clamp(nominal: Rig) -> None:
    rng = np.random.default_rng(6)
    loads = misaligned.pushes(rng, 14, 3.0)
    truth = only(psd_1__gain_x=0.02, psd_2__rotation=0.015)
    run = campaign.run_of(misaligned.record(truth, misaligned.poses(loads), rng))
    held = CalibrationRun(run.name, run.t, run.volts, run.reference_t[:0], run.reference[:0], loads)
    found = calibrate([held], nominal)
    relative = found.values[AT['psd_1.gain_x']] - found.values[AT['psd_2.gain_x']]
    assert relative == pytest.approx(0.02, abs=0.006)
    # Common to all gains, against the clamp: no better than the tolerance of four of them.
    assert found.sd[AT['psd_1.gain_x']] > 0.003


@pytest.mark.slow
def test_check_names_what_moved(nominal: Rig, pose: FloatArray) -> None:
    rng = np.random.default_rng(9)
    truth = misaligned.draw(rng)
    rig, _ = campaign.calibrated_rig(nominal, campaign.run_of(misaligned.record(truth, pose, rng)))
    assert check([campaign.run_of(misaligned.record(truth, pose, rng))], rig).unchanged
    moved = truth | {'psd_1.rotation': truth['psd_1.rotation'] + 0.03}
    found = check([campaign.run_of(misaligned.record(moved, pose, rng))], rig)
    assert not found.unchanged
    assert found.groups[0].group == 'psd_1.rotation'
    value, sd = found.groups[0].shifts['psd_1.rotation']
    assert abs(value - 0.03) < 4.0 * sd


def test_contradicted_priors_widen_once_worst_first(nominal: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clamp, too: it has no parameter in the rig file that the other numbers are counted by."""
    prior = prior_of_rig(nominal)
    worst, next_one = AT['clamp.bending_compliance'], AT['psd_1.rotation']
    values = prior.mean.copy()
    values[worst] += 400.0 * prior.sd[worst]
    values[next_one] += 300.0 * prior.sd[next_one]
    first = cast(CalibrationFit, SimpleNamespace(values=values, covariance=1e-6 * prior.covariance))
    # A fit that stays where it is.
    monkeypatch.setattr(module, 'fit', lambda *_, start, **__: start)
    free = np.ones(len(NAMES), dtype=bool)
    _, wider, widened = module.believed_fit(first, cast(Rows, None), nominal, prior, 'loads', free)
    assert widened == ['clamp.bending_compliance', 'psd_1.rotation']
    sd = prior.sd.copy()
    sd[[worst, next_one]] *= module.WIDER
    assert wider.sd == pytest.approx(sd)
