# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Loads that a person noted some seconds late: the motion says when they were hung, and every study says so alike."""

import math

import numpy as np
import pytest

from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import DOT_CHANNELS, FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.calibrate.from_recordings import with_effective_loads
from psd_deflection.studies.calibrate.observation import CalibrationRun
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.loads.annotated_times import ALIKE_S, CorrectedLoads, CorrectedNote, correct_loads, shifted
from test.studies.held_loads import RIG, answers, read

LEVELS = np.array([(0, 0, 0), (0, -20, 0), (0, -50, 0), (0, -50, -29), (30, 0, 0), (40, -40, 20), (0, 0, 0)], float)
DWELL = 5000
COUNT = DWELL * len(LEVELS)
LATE = (1.3, 1.7, 3.4, 2.7, 0.3, 2.3)
JITTER = (0.012, -0.02, 0.004, 0.028, -0.009, 0.017)


def applied(took: float = 0.0) -> FloatArray:
    """Loads as they act: the next level every 5 s, in ``took`` s."""
    out = np.empty((COUNT, 3))
    for i, level in enumerate(LEVELS):
        before = LEVELS[max(i - 1, 0)]
        share = np.ones(DWELL) if took == 0.0 else np.clip(np.arange(DWELL) / (1000.0 * took), 0.0, 1.0)
        out[i * DWELL : (i + 1) * DWELL] = before + (level - before) * share[:, None]
    return out


def annotated(late: tuple[float, ...]) -> FloatArray:
    """Loads as a person notes them, each so many seconds late."""
    out = np.tile(LEVELS[0], (COUNT, 1))
    for i, seconds in enumerate(late, start=1):
        out[i * DWELL + round(1000 * seconds) :] = LEVELS[i]
    return out


def volts(loads: FloatArray, seed: int = 0, **true: object) -> FloatArray:
    """What the device reads (n, 6), V, of a rig that differs by ``true`` from the rig file."""
    return read(loads, seed, **true)


QUIET = volts(applied())
ROTATED = volts(applied(), effects__e__name='sensor_rotation', effects__e__psd=1, effects__e__angle=0.02)


def corrected(read: FloatArray, loads: FloatArray, rig: Rig = RIG) -> CorrectedLoads | None:
    return correct_loads(rig, read[:, list(DOT_CHANNELS)] * RIG.amplifier.sensitivity, loads)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('late', 'rotated'),
    [
        (LATE, True),
        *(
            (late, False)
            for late in (
                LATE,
                (0, 0, 3, 0, 0, 0),
                (2.0,) * 6,
                (-1.5, 0.4, -2.0, 0.2, -0.3, 1.0),
                (4.5, 3.0, 4.8, 4.0, 2.0, 4.0),
                JITTER,
            )
        ),
    ],
)
def test_each_late_or_early_load_gets_the_time_of_its_motion(late: tuple[float, ...], rotated: bool) -> None:
    found = corrected(ROTATED if rotated else QUIET, annotated(late))
    assert found is not None
    wrong = {i: seconds for i, seconds in enumerate(late, start=1) if abs(seconds) > ALIKE_S}
    assert {n.number: n.delay for n in found.notes} == pytest.approx(wrong, abs=0.002)
    assert not found.unused.any()
    assert np.count_nonzero(np.abs(found.loads - applied()).max(axis=1) > 0.1) <= 2 * len(LEVELS)


@pytest.mark.parametrize(
    'loads',
    [annotated((0.0,) * 6), annotated((0.3,) * 6), annotated((0.001, 0, 0.002, 0, 0.001, 0)), applied(1.2)],
    ids=['right', 'alike', 'a sample', 'a noted ramp'],
)
def test_right_times_and_small_delay_are_unchanged(loads: FloatArray) -> None:
    assert corrected(QUIET, loads) is None
    assert corrected(ROTATED, loads) is None


def test_slow_loads_noted_as_steps_are_ramps() -> None:
    found = corrected(volts(applied(0.8)), annotated((0.4,) * 6))
    assert found is not None
    assert [n.took for n in found.notes] == pytest.approx([0.8] * 6, abs=0.01)
    assert {n.name for n in found.notes} == {'load_ramp'}
    assert 'as a ramp until 5.80' in found.notes[0].words('x.csv')
    assert not found.unused.any()


def test_other_natural_frequencies_change_no_time() -> None:
    read = volts(applied(), dynamics__bending_frequency=14.7, dynamics__torsion_frequency=20.4)
    assert corrected(read, annotated((0.0,) * 6)) is None


@pytest.mark.slow
def test_wiring_signs_and_units_change_no_time() -> None:
    other = QUIET[:, [1, 0, 2, 4, 3, 5]] * np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    found = corrected(other, annotated(LATE) * np.array([-0.102, 0.102, 0.102]))
    assert found is not None
    assert [n.delay for n in found.notes] == pytest.approx(LATE, abs=0.002)


@pytest.mark.slow
def test_lost_samples_change_no_time() -> None:
    read = QUIET.copy()
    read[np.random.default_rng(1).random(COUNT) < 0.3] = np.nan
    read[2 * DWELL - 20 : 2 * DWELL + 20] = np.nan
    found = corrected(read, annotated(LATE))
    assert found is not None
    assert [n.delay for n in found.notes] == pytest.approx(LATE, abs=0.003)


def test_slow_load_annotated_as_step_is_a_ramp() -> None:
    found = corrected(volts(applied(0.8)), annotated((0.0, 2.0, 0.0, 0.0, 0.0, 0.0)))
    assert found is not None
    assert [n.took for n in found.notes] == pytest.approx([0.8] * 6, abs=0.01)
    assert [n.name for n in found.notes] == ['load_ramp', 'load_time', *['load_ramp'] * 4]
    assert [round(n.value, 2) for n in found.notes[:2]] == [0.8, 2.0]
    assert 'as a ramp until 5.80' in found.notes[0].words('x.csv')
    assert not found.unused.any()


@pytest.mark.slow
def test_motion_that_no_ramp_describes_is_left_out() -> None:
    smooth = applied(0.8)
    for i in range(1, len(LEVELS)):
        share = np.clip(np.arange(DWELL) / 800.0, 0.0, 1.0)
        part = slice(i * DWELL, (i + 1) * DWELL)
        smooth[part] = LEVELS[i - 1] + (LEVELS[i] - LEVELS[i - 1]) * (share**2 * (3.0 - 2.0 * share))[:, None]
    found = corrected(volts(smooth), annotated((1.0, 2.0, 1.5, 1.0, 0.5, 2.0)))
    assert found is not None
    assert found.notes[0].rest_only
    assert found.unused[DWELL + 300]
    assert not found.unused[DWELL - 500]
    assert 'at rest' in found.notes[0].words('x.csv')


@pytest.mark.slow
def test_check_and_calibrate_say_the_same() -> None:
    expected = corrected(QUIET, annotated(LATE))
    assert expected is not None
    words = [n.words('x') for n in expected.notes]
    checked, again, log, _ = answers(QUIET, annotated(LATE))
    assert [f.fix for f in checked.findings if f.name == 'load_time'] == words
    assert {f.name for f in checked.findings} == {'load_time'}
    assert checked.sizes == pytest.approx([1.0] * 3, abs=0.01)
    assert log == words
    assert again.loads is not None
    # The correction gives dots in 32 bits: a time differs by some microseconds.
    assert np.abs(again.loads - expected.loads).max() < 0.5
    right = CalibrationRun('x', np.arange(COUNT) / 1000.0, QUIET, np.zeros(0), np.zeros((0, 3)), applied())
    assert with_effective_loads(right, RIG, log.append) is right


@pytest.mark.slow
def test_discover_mends_the_times_and_names_the_hidden_effect() -> None:
    found = discover([Observation('x', RIG, ROTATED, annotated(LATE))])
    assert [e.active.label for e in found.effects] == ['sensor_rotation (psd 1)']
    assert found.effects[0].active.values['angle'] == pytest.approx(0.02, abs=1e-4)
    assert found.verdict == 'effects_found'
    assert found.floors < 1.05
    assert {f.name for f in found.setup} == {'load_time'}
    assert not found.values
    assert '; load 3, 3.4 s late; load 4, ' in found.sentence
    assert found.gap_before > 100.0 * found.gap_after


@pytest.mark.parametrize('moments', [0.0, 1.0, 2.0, 3.0, 4.0, 5.4, -1.0, -2.6])
def test_load_between_samples_moves_link_at_its_time(moments: float) -> None:
    frequency, ratio, first = 14.0, 0.02, 100
    loads = np.zeros((1000, 3))
    loads[first:, 1] = -50.0
    note = CorrectedNote(1, (0.0, -50.0, 0.0), 0.1, 0.1, 0.0)
    later = shifted(note, loads, 1e-3)
    moved = Filter(mode_coefficients(frequency, ratio, 1e-3))((loads + later([moments]))[:, 1] / -50.0)
    # The step response of an oscillator, from the time of the step on.
    w = 2.0 * math.pi * frequency
    damped = w * math.sqrt(1.0 - ratio**2)
    since = np.maximum(np.arange(1000) * 1e-3 - 0.1 - moments * 0.25e-3, 0.0)
    ringing = np.cos(damped * since) + ratio * w / damped * np.sin(damped * since)
    exact = 1.0 - np.exp(-ratio * w * since) * ringing
    away = np.abs(np.arange(1000) - first) > 4
    # The mean of that sample alone is off by 1e-3.
    assert np.abs(moved - exact)[away].max() < 5e-5


def test_load_from_second_sample_is_shifted_completely() -> None:
    loads = np.tile([0.0, -20.0, 0.0], (100, 1))
    loads[0] = 0.0
    note = CorrectedNote(1, (0.0, -20.0, 0.0), 0.001, 0.001, 0.0)
    later = shifted(note, loads, 0.001)
    # Four quarters of a sample later nothing acts in the second sample.
    assert later([4.0])[1] == pytest.approx([0.0, 20.0, 0.0])
    assert later([4.0])[2:] == pytest.approx(0.0)
