# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Loads that swayed, that nobody noted, lost at their step or measured by a cell: every study says so alike."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.optimize import brentq

from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.loads import effective
from psd_deflection.studies.loads.annotated_times import MeasuredLoad, correct_loads, without_cell_noise
from psd_deflection.studies.loads.effective import (
    SwayingLoad,
    effective_loads,
    excluded,
    swaying_loads,
    unannotated_times,
)
from psd_deflection.studies.loads.holds import Hold, ImpliedLoads, find_holds, implied_beside_rig
from test.studies.held_loads import DWELL, HELD, RIG, T, answers, read


def swung(force: float, frequency: float, axis: int = 0, number: int = 3) -> FloatArray:
    """The loads with a swing in one hold."""
    out = HELD.copy()
    since = T - number * DWELL / 1000.0
    held = (since > 0.0) & (since < DWELL / 1000.0)
    out[:, axis] += np.where(held, force * np.sin(2.0 * np.pi * frequency * since), 0.0)
    return out


SWUNG = read(swung(1.0, 1.3))


def test_sway_is_named_alike_everywhere() -> None:
    checked, steady, log, discovery = answers(SWUNG, HELD)
    assert [(f.name, f.where, f.value) for f in checked.findings] == [('load_value', 'load 3', None)]
    words = checked.findings[0].fix
    assert words.startswith('the weight that hung on the link of x from 12.000 s to 16.000 s swayed at 1.3')
    assert checked.verdict == 'wrong'
    assert checked.sizes == pytest.approx([1.0] * 3, abs=0.01)
    assert log == [words]
    assert np.isnan(steady.volts[12_000:16_000]).all()
    assert np.isfinite(steady.volts[:12_000]).all()
    assert np.isfinite(steady.volts[20_000:]).all()
    assert ([f.fix for f in discovery.setup], discovery.verdict) == ([words], 'nothing_missing')


@pytest.mark.slow
@pytest.mark.parametrize(('force', 'frequency', 'axis'), [(0.5, 0.9, 0), (2.0, 1.6, 0), (1.0, 1.1, 1)])
def test_force_and_frequency_are_those_of_the_swing(force: float, frequency: float, axis: int) -> None:
    (sway,) = swaying_loads(RIG, read(swung(force, frequency, axis)), HELD)
    assert sway.hold.number == 3
    assert sway.frequency == pytest.approx(frequency, abs=0.02)
    assert sway.force == pytest.approx(force, rel=0.1)
    # How it swung, but for how much more a link of 14 Hz swings than under a load that rests.
    assert sway.swung is not None
    true = (swung(force, frequency, axis) - HELD)[3 * DWELL : 4 * DWELL]
    assert np.abs(sway.swung - true).max() < 0.03 * force
    assert effective.swung(len(HELD), []) is None
    every = effective.swung(len(HELD), [sway])
    assert every is not None
    np.testing.assert_array_equal(every[3 * DWELL : 4 * DWELL], sway.swung)


def test_apparent_step_excludes_sway_from_its_start() -> None:
    asked, annotated = implied_beside_rig(RIG, SWUNG, HELD), find_holds(RIG, SWUNG, HELD, annotated_only=True)
    cut = 3 * DWELL + 1200
    pieces = [
        *annotated[:3],
        dataclasses.replace(annotated[3], last=cut),
        dataclasses.replace(annotated[3], first=cut, unannotated=True),
        *annotated[4:],
    ]
    (sway,) = effective.swaying(asked(pieces), annotated, asked, 1e-3)
    assert (sway.hold.first, sway.hold.last) == (3 * DWELL, 4 * DWELL)


ROTATED = {'effects__e__name': 'sensor_rotation', 'effects__e__psd': 1, 'effects__e__angle': 0.02}
STICKS = {'effects__e__name': 'clamp_friction', 'effects__e__width': 1.4e-5, 'effects__e__axis': 3}


@pytest.mark.slow
@pytest.mark.parametrize(
    'true', [{}, ROTATED, STICKS, {'dynamics__bending_damping_ratio': 0.01}, {'link__length': 0.6}]
)
def test_what_no_weight_does_is_no_sway(true: dict[str, object]) -> None:
    assert swaying_loads(RIG, read(HELD, **true), HELD) == []


def test_the_time_is_left_out_until_the_link_has_come_to_rest() -> None:
    rig = load_rig(overrides={'dynamics.bending_frequency': 10.0, 'dynamics.bending_damping_ratio': 0.05})
    volts = np.zeros((9000, 6))
    swayed = [SwayingLoad(Hold(0, 2000, 5000, 1, False, np.zeros(3)), 1.0, 1.0, 1e-3)]
    rest = round(-math.log(0.01) / (2.0 * math.pi * 10.0 * 0.05) / 1e-3)
    gone = np.flatnonzero(np.isnan(excluded(rig, volts, swayed)).all(axis=1))
    assert gone.tolist() == list(range(2000, 5000 + rest))
    assert not volts.any()


def test_a_peak_is_the_vertex_of_a_log_parabola() -> None:
    f = np.array([0.5, 1.0, 1.5, 2.0])
    top = np.exp(-(((f - 1.1) / 0.4) ** 2))
    assert effective.peak_frequency(f, top) == pytest.approx(1.1)
    assert effective.peak_frequency(f, np.array([1.0, 0.5, 0.2, 0.1])) == pytest.approx(0.5, abs=0.01)
    assert effective.peak_frequency(f, np.zeros(4)) == 0.0
    assert effective.peak_frequency(f[:2], np.array([1.0, 3.0])) == 1.0
    assert effective.peak_frequency(np.zeros(0), np.zeros(0)) == 0.0


def test_a_swing_is_what_no_constant_load_explains() -> None:
    """A tone of 1.3 Hz that fades from 2 N, in means of four samples."""
    n, size = 4000, 4
    held = tuple(Hold(0, n * k, n * (k + 1), k, False, np.zeros(3)) for k in range(6))
    t = np.arange(n) * 1e-3
    force = 2.0 * (1.0 - 0.1 * t) * np.sin(2.0 * math.pi * 1.3 * t + 0.4)
    rest = 1e-9 * np.random.default_rng(0).standard_normal((3, 6 * n // size))
    rest[1, 3 * n // size : n] += 2e-5 * force.reshape(-1, size).mean(axis=1)
    none = np.zeros((6, 3))
    implied = ImpliedLoads(held, none, rest, rest, rest[:1], none[:, 0], np.array([1e-5, 2e-5, 1e-4]), size)
    (sway,) = effective.swaying(implied, held, lambda _: implied, 1e-3)
    assert sway.hold is held[3]
    assert [sway.frequency, sway.force] == [pytest.approx(1.3, abs=0.01), pytest.approx(1.6, abs=0.1)]
    assert sway.swung is not None
    np.testing.assert_allclose(sway.swung[:, 1], force, atol=5e-3)
    assert np.abs(sway.swung[:, [0, 2]]).max() < 1e-3
    # Of two lost holds nothing is known, and what is less than eight times the median is no sway.
    lost = rest.copy()
    lost[:, n // size : 3 * n // size] = np.nan
    lost[:, -900:-890] = np.nan
    lost[1, n:] += 2e-6 * np.tile(force, 2).reshape(-1, size).mean(axis=1)
    implied = dataclasses.replace(implied, rest=lost)
    assert [s.hold for s in effective.swaying(implied, held, lambda _: implied, 1e-3)] == [held[3]]


MANY_LEVELS = np.array(
    [
        *[(0, 0, 0), (30, 0, 0), (0, -50, -29), (0, 0, 0)],
        *[(40, -40, 20), (0, -30, 0), (25, 10, -10), (10, 0, 0), (0, -40, 10), (15, 0, 0), (0, -9, 0), (0, -45, 0)],
    ],
    float,
)
SHORT_DWELL = 2000
SHORT_HELD = np.repeat(MANY_LEVELS, SHORT_DWELL, axis=0)
WORDS = 'nobody noted it: note each change; this time is left out'
STOPPED = SHORT_HELD.copy()
STOPPED[4 * SHORT_DWELL :] = 0.0
"""Somebody noted nothing any more after the second load was taken off."""
VOLTS = read(SHORT_HELD)


@pytest.mark.slow
def test_unannotated_loads_are_named_alike_everywhere() -> None:
    words = f'x: from 8.000 s to the end the load changed 8 times, and {WORDS}'
    checked, known, log, discovery = answers(VOLTS, STOPPED)
    # The loads that are left move all readings, but none of them along Y alone.
    reported, pushes = checked.findings
    assert (reported.name, reported.where, reported.fix) == ('load_coverage', 'load_fx load_fy load_tz', words)
    assert (pushes.name, pushes.where) == ('load_coverage', 'fy tz')
    assert checked.verdict == 'wrong'
    assert f'load_fx load_fy load_tz: not seen: {words}' in checked.sentences()
    assert log == [words]
    assert np.isnan(known.volts[8_000:]).all()
    assert np.isfinite(known.volts[:8_000]).all()
    (reported,) = discovery.setup
    assert (reported.name, reported.fix) == ('load_coverage', words)
    assert reported.value == pytest.approx(16 / 24)
    assert discovery.verdict == 'nothing_missing'
    assert discovery.simulations <= 300


def test_missing_loads_are_excluded_until_next_note() -> None:
    annotated = SHORT_HELD.copy()
    annotated[2 * SHORT_DWELL : 10 * SHORT_DWELL] = MANY_LEVELS[1]
    effective = effective_loads(RIG, VOLTS, annotated)
    assert [n.words('x') for n in effective.notes] == [
        f'x: from 4.000 s to 20.000 s the load changed 8 times, and {WORDS}'
    ]
    gone = np.flatnonzero(np.isnan(effective.volts).all(axis=1))
    assert (gone[0], gone[-1], len(gone)) == (4000, 19_999, 16_000)
    np.testing.assert_array_equal(effective.loads, annotated)


@pytest.mark.slow
def test_a_recording_without_any_noted_load_stays_as_it_is() -> None:
    effective = effective_loads(RIG, VOLTS, np.zeros_like(SHORT_HELD))
    assert not effective.notes
    assert np.isfinite(effective.volts).all()


def asked(more: list[float], *, alone: int, across: float = 0.0, annotated: float = 10.0) -> ImpliedLoads:
    """Holds of 2 s under one annotated load; all but the first ``alone`` are unnoted. ``more``: N along Y."""
    rows = np.array([(0.0, y, 0.0) for y in more])
    listed = tuple(
        Hold(0, 2000 * i, 2000 * (i + 1), 1, i >= alone, np.array((0.0, annotated, 0.0))) for i in range(len(more))
    )
    other = Hold(0, 2000 * len(more), 2000 * len(more) + 2000, 2, False, np.array((0.0, 20.0, 0.0)))
    nothing, residual = np.zeros((3, 0)), np.array([across] * len(more) + [0.0])
    implied, sd = np.vstack((rows, np.zeros((1, 3)))), np.array((4e-5, 4e-5, 6e-5))
    return ImpliedLoads((*listed, other), implied, nothing, nothing, np.zeros(0), residual, sd, 4)


def test_change_counts_above_three_times_allowed_effects() -> None:
    """That is 0.3 N and 1 % of the largest load, which is 20 N: 1.5 N in all."""
    (span,) = unannotated_times(asked([0.0, 1.6, 0.0, 1.6], alone=1), 20_000, 0.001)
    assert (span.first, span.last, span.changes) == (2000, 8000, 3)
    assert span.value == span.size == pytest.approx(0.3)
    assert unannotated_times(asked([0.0, 1.4, 0.0, 1.4], alone=1), 20_000, 0.001) == []
    # Where nobody knows any load there is nothing left to compare.
    of = asked([0.0, 1.6, 0.0, 1.6], alone=1)
    known = [dataclasses.replace(p, annotated=np.zeros(3)) if i in (0, 4) else p for i, p in enumerate(of.holds)]
    assert unannotated_times(dataclasses.replace(of, holds=tuple(known)), 20_000, 0.001) == []
    # Two changes are too few, and noted ones do not count.
    assert unannotated_times(asked([0.0, 9.0, 0.0], alone=1), 20_000, 0.001) == []
    assert unannotated_times(asked([0.0, 9.0, 0.0, 9.0], alone=2), 20_000, 0.001) == []


LOST_LEVELS = np.array([(0, 0, 0), (0, -20, 0), (0, -50, -29), (30, 0, 0), (20, -40, 12), (0, 0, 0)], float)
LONG_DWELL = 5000
APPLIED = np.repeat(LOST_LEVELS, LONG_DWELL, axis=0)
READ = np.asarray(RigSimulator(RIG, 3).step(APPLIED).counts * RIG.converter.volts_per_count, dtype=np.float64)
DOTS = READ[:, [0, 1, 3, 4]] * RIG.sensitivities.ravel()
LATE = (2.3, 0.9, 3.1, 1.7, 2.6)


def annotated() -> FloatArray:
    out = np.zeros_like(APPLIED)
    for i, late in enumerate(LATE, start=1):
        out[i * LONG_DWELL + round(1000 * late) :] = LOST_LEVELS[i]
    return out


def reported(dots: FloatArray) -> list[float]:
    corrected = correct_loads(RIG, dots, annotated())
    assert corrected is not None
    return [note.delay for note in corrected.timed]


@pytest.mark.slow
@pytest.mark.parametrize(('lost', 'share'), [(80, 0.98), (150, 0.5), (450, 0.02), (1500, 0.5)])
def test_time_in_lost_samples_is_found_by_ringing(lost: int, share: float) -> None:
    dots = DOTS.copy()
    first = 2 * LONG_DWELL - round(share * lost)
    dots[first : first + lost] = np.nan
    assert reported(dots) == pytest.approx(LATE, abs=2e-3)


def test_samples_lost_between_the_steps_change_no_time() -> None:
    dots = DOTS.copy()
    for at in range(2000, 27_000, 5000):
        dots[at : at + 1200] = np.nan
    assert reported(dots) == pytest.approx(LATE, abs=1e-3)


@pytest.mark.slow
def test_equal_delays_after_lost_samples_are_corrected() -> None:
    """Rows of a CSV have the load: after a loss it seems to begin late."""
    dots, after = DOTS.copy(), APPLIED.copy()
    for at in range(LONG_DWELL, len(APPLIED), LONG_DWELL):
        dots[at - 100 : at + 200] = np.nan
        after[at : at + 200] = APPLIED[at - 1]
    corrected = correct_loads(RIG, dots, after)
    assert corrected is not None
    assert [note.delay for note in corrected.notes] == pytest.approx([0.2] * 5, abs=2e-3)
    assert correct_loads(RIG, dots, APPLIED) is None


def measured_along_y(values: FloatArray, *, held: int = 2) -> tuple[FloatArray, tuple[MeasuredLoad, ...]]:
    """What becomes of ``values`` (k,) of a cell along Y, each held for so many samples."""
    loads = np.zeros((held * len(values), 3))
    loads[:, 1] = np.repeat(values, held)
    return without_cell_noise(loads)


def with_memory(count: int, wanted: float) -> FloatArray:
    """Values whose correlation with the next one is as ``wanted``."""
    white = np.random.default_rng(2).normal(size=count + 1)

    def mixed(share: float) -> FloatArray:
        return np.asarray(white[1:] + share * white[:-1])

    def memory(share: float) -> float:
        about = mixed(share) - mixed(share).mean()
        return float(about[1:] @ about[:-1] / (about @ about))

    return mixed(brentq(lambda share: memory(share) - wanted, -0.99, 0.99))


@pytest.mark.parametrize(
    ('count', 'memory', 'noise'),
    [
        *((400, 0.19, True), (400, -0.19, True), (400, 0.21, False), (400, -0.21, False), (10_000, 0.195, True)),
        *((10_000, 0.205, False), (10_000, -0.205, False)),
    ],
)
def test_noise_correlation_is_below_four_over_root_n(count: int, memory: float, noise: bool) -> None:
    values = with_memory(count, memory)
    loads, measured = measured_along_y(values)
    assert len(measured) == noise
    if noise:
        assert loads[:, 1] == pytest.approx(np.full(2 * count, values.mean()))
    assert len(measured_along_y(1e-3 * values)[1]) == noise
    assert len(measured_along_y(np.concatenate((with_memory(count, 0.0), 1000.0 + values)))[1]) == 1 + noise
    # That along Y says all, whatever the others do.
    both = np.zeros((2 * count, 3))
    both[:, 1] = np.repeat(values, 2)
    both[:, 0] = np.repeat(np.random.default_rng(3).normal(size=count), 2)
    assert len(without_cell_noise(both)[1]) == noise


@pytest.mark.parametrize(
    ('changes', 'samples', 'reported'), [(49, 400, 0), (50, 400, 1), (99, 5000, 0), (100, 5000, 1)]
)
def test_loads_that_change_at_a_fiftieth_are_measured(changes: int, samples: int, reported: int) -> None:
    loads = np.zeros((samples, 3))
    at = np.arange(changes + 1) * (samples // (changes + 1))
    for first, value in zip(at.tolist(), np.random.default_rng(4).normal(size=changes + 1).tolist(), strict=True):
        loads[first:, 0] = value
    assert len(without_cell_noise(loads)[1]) == reported


@pytest.mark.parametrize(('times', 'parts'), [(7.9, 1), (8.1, 2), (-7.9, 1), (-8.1, 2)])
def test_load_step_is_above_eight_deviations_of_noise(times: float, parts: int) -> None:
    values = np.random.default_rng(5).normal(size=2001)
    steps = np.abs(np.diff(values))
    # The median of a normal law's absolute values is 0.6745 deviations; of a difference the deviation is root 2 larger.
    noise = float(np.median(steps)) / 0.67449 / 2.0**0.5
    assert steps.max() < 7.0 * noise
    # Back in two smaller ones.
    values[1000:1002] = values[999] + np.array([1.0, 0.5]) * times * noise
    assert len(measured_along_y(values)[1]) == parts


def test_a_step_of_1e_9_n_is_none() -> None:
    noise = np.random.default_rng(6).normal(size=600)
    for step, parts in ((0.5, 2), (2e-8, 2), (8.0 * 1e-9, 1), (5e-9, 1)):
        loads = np.zeros((600, 3))
        loads[:, 1] = noise
        loads[300:, 2] = step
        assert [m.first for m in without_cell_noise(loads)[1]] == [0, 300][:parts]
