# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Loads noted some seconds late: the motion says when they were hung, each study says so; and each piece of it."""

import itertools
import math
from typing import cast

import numpy as np
import pytest

from psd_deflection.measure import steps as found_steps
from psd_deflection.measure.steps import DotStep, last_load_change
from psd_deflection.model.simulation.catalogue import with_effects
from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import DOT_CHANNELS, FloatArray, IntArray
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.calibrate.from_recordings import with_effective_loads
from psd_deflection.studies.calibrate.observation import CalibrationRun
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.loads import annotated_times
from psd_deflection.studies.loads import steps as steps_module
from psd_deflection.studies.loads.alignment import aligned
from psd_deflection.studies.loads.plate_motion import across_of, across_plate, moved_plate
from psd_deflection.studies.loads.thresholds import DISTINCT_SD
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


def corrected(read: FloatArray, loads: FloatArray, rig: Rig = RIG) -> annotated_times.CorrectedLoads | None:
    return annotated_times.correct_loads(rig, read[:, list(DOT_CHANNELS)] * RIG.amplifier.sensitivity, loads)


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
                (1.0,) * 6,
                (-1.5, 0.4, -2.0, 0.2, -0.3, 1.0),
                (4.5, 3.0, 4.8, 4.0, 2.0, 4.0),
                JITTER,
            )
        ),
    ],
)
def test_each_late_or_early_load_gets_the_time_of_its_motion(late: tuple[float, ...], rotated: bool) -> None:
    correction = corrected(ROTATED if rotated else QUIET, annotated(late))
    assert correction is not None
    wrong = {i: seconds for i, seconds in enumerate(late, start=1) if abs(seconds) > annotated_times.ALIKE_S}
    assert {n.number: n.delay for n in correction.notes} == pytest.approx(wrong, abs=0.002)
    assert not correction.unused.any()
    assert np.count_nonzero(np.abs(correction.loads - applied()).max(axis=1) > 0.1) <= 2 * len(LEVELS)


@pytest.mark.parametrize(
    'loads',
    [annotated((0.0,) * 6), annotated((0.85,) * 6), annotated((0.001, 0, 0.002, 0, 0.001, 0)), applied(1.2)],
    ids=['right', 'alike', 'a sample', 'a noted ramp'],
)
def test_right_times_and_small_delay_are_unchanged(loads: FloatArray) -> None:
    assert corrected(QUIET, loads) is None
    assert corrected(ROTATED, loads) is None


@pytest.mark.parametrize(('psd', 'rows'), [(1, 40), (2, 8), (2, -40), (2, 3000)])
def test_the_psd_that_agrees_with_the_loads_stays(psd: int, rows: int) -> None:
    late, n = slice(3 * psd - 3, 3 * psd), COUNT - abs(rows)
    read, loads = QUIET[max(rows, 0) :][:n].copy(), applied()[max(rows, 0) :][:n]
    in_time = read.copy()
    read[:, late] = QUIET[max(-rows, 0) :][:n, late]
    moved, (late_psd,) = aligned(RIG, read, loads)
    assert (late_psd.psd, late_psd.rows, late_psd.reference) == (psd, rows, 3 - psd)
    there = np.isfinite(moved).all(axis=1)
    assert np.count_nonzero(~there) == abs(rows)
    np.testing.assert_array_equal(moved[there], in_time[there])
    # What the rig file says of it is nothing new, and what is right stays.
    known = with_effects(RIG, [f'channel_skew,psd={psd},delay={1e-3 * rows}'], 'test')
    for rig, volts in ((known, read), (RIG, in_time)):
        assert aligned(rig, volts, loads) == (volts, ())
    # Clocks are looked for up to 4 s apart.
    distant = np.hstack([QUIET[4500:, :3], QUIET[:-4500, 3:]])
    assert aligned(RIG, distant, applied()[4500:]) == (distant, ())


def test_other_natural_frequencies_change_no_time() -> None:
    read = volts(applied(), dynamics__bending_frequency=14.7, dynamics__torsion_frequency=20.4)
    assert corrected(read, annotated((0.0,) * 6)) is None


@pytest.mark.slow
def test_wiring_signs_and_units_change_no_time() -> None:
    other = QUIET[:, [1, 0, 2, 4, 3, 5]] * np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    correction = corrected(other, annotated(LATE) * np.array([-0.102, 0.102, 0.102]))
    assert correction is not None
    assert [n.delay for n in correction.notes] == pytest.approx(LATE, abs=0.002)


@pytest.mark.slow
def test_lost_samples_change_no_time() -> None:
    read = QUIET.copy()
    read[np.random.default_rng(1).random(COUNT) < 0.3] = np.nan
    read[2 * DWELL - 20 : 2 * DWELL + 20] = np.nan
    correction = corrected(read, annotated(LATE))
    assert correction is not None
    assert [n.delay for n in correction.notes] == pytest.approx(LATE, abs=0.003)


@pytest.mark.parametrize(
    ('late', 'names'),
    [
        *(((late,) * 6, ['load_ramp'] * 6) for late in (0.0, 0.4)),
        ((0.0, 2.0, 0.0, 0.0, 0.0, 0.0), ['load_ramp', 'load_time', *['load_ramp'] * 4]),
    ],
)
def test_slow_load_annotated_as_step_is_a_ramp(late: tuple[float, ...], names: list[str]) -> None:
    correction = corrected(volts(applied(0.8)), annotated(late))
    assert correction is not None
    assert [n.took for n in correction.notes] == pytest.approx([0.8] * 6, abs=0.01)
    assert [n.name for n in correction.notes] == names
    assert [round(n.value, 2) for n in correction.notes[:2]] == [0.8, max(0.8, late[1])]
    assert 'as a ramp until 5.80' in correction.notes[0].words('x.csv')
    assert not correction.unused.any()


@pytest.mark.slow
def test_motion_that_no_ramp_describes_is_left_out() -> None:
    smooth = applied(0.8)
    for i in range(1, len(LEVELS)):
        share = np.clip(np.arange(DWELL) / 800.0, 0.0, 1.0)
        part = slice(i * DWELL, (i + 1) * DWELL)
        smooth[part] = LEVELS[i - 1] + (LEVELS[i] - LEVELS[i - 1]) * (share**2 * (3.0 - 2.0 * share))[:, None]
    correction = corrected(volts(smooth), annotated((1.0, 2.0, 1.5, 1.0, 0.5, 2.0)))
    assert correction is not None
    assert correction.notes[0].rest_only
    assert correction.unused[DWELL + 300]
    assert not correction.unused[DWELL - 500]
    assert 'at rest' in correction.notes[0].words('x.csv')


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
    discovery = discover([Observation('x', RIG, ROTATED, annotated(LATE))])
    assert [e.active.label for e in discovery.effects] == ['sensor_rotation (psd 1)']
    assert discovery.effects[0].active.values['angle'] == pytest.approx(0.02, abs=1e-4)
    assert discovery.verdict == 'effects_found'
    assert discovery.floors < 1.05
    assert {f.name for f in discovery.setup} == {'load_time'}
    assert not discovery.values
    assert '; load 3, 3.4 s late; load 4, ' in discovery.sentence
    assert discovery.gap_before > 100.0 * discovery.gap_after


@pytest.mark.parametrize('moments', [0.0, 1.0, 2.0, 3.0, 4.0, 5.4, -1.0, -2.6])
def test_load_between_samples_moves_link_at_its_time(moments: float) -> None:
    frequency, ratio, first = 14.0, 0.02, 100
    loads = np.zeros((1000, 3))
    loads[first:, 1] = -50.0
    note = annotated_times.CorrectedNote(1, (0.0, -50.0, 0.0), 0.1, 0.1, 0.0)
    assert note.moved([moments], 1e-3).took == 0.0
    assert note.moved((), 1e-3) == note  # Its time was not fitted: the link at rest under it alone was seen.
    later = annotated_times.shifted(note, loads, 1e-3)
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
    note = annotated_times.CorrectedNote(1, (0.0, -20.0, 0.0), 0.001, 0.001, 0.0)
    later = annotated_times.shifted(note, loads, 0.001)
    # Four quarters of a sample later nothing acts in the second sample.
    assert later([4.0])[1] == pytest.approx([0.0, 20.0, 0.0])
    assert later([4.0])[2:] == pytest.approx(0.0)


def note(
    annotated: float, applied: float, took: float = 0.0, *, rest_only: bool = False, number: int = 3
) -> annotated_times.CorrectedNote:
    return annotated_times.CorrectedNote(number, (1.5, -2.0, 0.25), annotated, applied, took, rest_only)


@pytest.mark.parametrize(
    ('note', 'text'),
    [
        (
            note(3.0, 1.0, 1.75),
            'was noted 2.000 s late and applied over 1.8 s: note it 1.000 s after the first sample, '
            'as a ramp until 2.750 s, not 3.000 s',
        ),
        (note(1.125, 1.0), 'was noted 0.125 s late: note it 1.000 s after the first sample, not 1.125 s'),
        (note(1.0, 1.125), 'was noted 0.125 s early: note it 1.125 s after the first sample, not 1.000 s'),
        (
            note(1.0, 1.0, 0.5, rest_only=True),
            'was applied over 0.5 s: note it 1.000 s after the first sample, as a ramp until 1.500 s, not 1.000 s; '
            'here only the link at rest under it is used',
        ),
    ],
)
def test_a_wrong_time_is_reported_in_words_and_so_is_what_to_do(note: annotated_times.CorrectedNote, text: str) -> None:
    assert note.words('x') == f'the 3rd load of x (1.5 N, -2 N, 0.25 N m) {text}'


@pytest.mark.parametrize(
    ('note', 'name', 'value', 'size', 'wrong'),
    [
        (note(3.0, 1.0, 1.75), 'load_time', 2.0, 2.0, True),
        # As late as it took: noted when it was done.
        (note(3.0, 1.0, 2.0), 'load_ramp', 2.0, 2.0, True),
        (note(1.0, 3.0, 2.5), 'load_ramp', 2.5, 2.0, True),
        # Two milliseconds are no delay.
        (note(0.002, 0.0), 'load_ramp', 0.0, 0.002, False),
        (note(0.0, 0.0021), 'load_time', -0.0021, 0.0021, True),
    ],
)
def test_a_late_note_is_late_by_2_ms_and_the_ramp_time(
    note: annotated_times.CorrectedNote, name: str, value: float, size: float, wrong: bool
) -> None:
    assert (note.name, note.where, note.value, note.size, note.wrong) == (name, 'load 3', value, size, wrong)


def test_ordinals_end_as_their_last_word() -> None:
    def ending(number: int) -> str:
        # eleventh, twelfth, thirteenth ... nineteenth
        teens = 10 < number % 100 < 20
        return 'th' if teens else ['th', 'st', 'nd', 'rd', *['th'] * 6][int(str(number)[-1])]

    assert [annotated_times.ordinal(n) for n in range(1, 1001)] == [f'{n}{ending(n)}' for n in range(1, 1001)]


def stepped(n: int, steps: dict[int, float], noise: float = 0.0, seed: int = 0) -> FloatArray:
    """Dots (n, 4) whose x1 steps by so much at so many samples."""
    dots = noise * np.random.default_rng(seed).normal(size=(n, 4))
    for at, size in steps.items():
        dots[at:, 0] += size
    return dots


def sizes_of(dots: FloatArray, width: int) -> dict[int, float]:
    """By how much the mean of ``width`` samples differs from that before, with more than a quarter of both there."""
    out = {}
    for at in range(width, len(dots) - width):
        before, after = (part[np.isfinite(part).all(axis=1)] for part in (dots[at - width : at], dots[at : at + width]))
        enough = min(len(before), len(after)) > width // 4
        out[at] = float(np.linalg.norm(after.mean(axis=0) - before.mean(axis=0))) if enough else 0.0
    return out


@pytest.mark.parametrize(
    ('width', 'lost', 'unit'), [(16, 0.3, 1.0), (16, 0.6, 1e-4), (16, 0.7, 1e-4), (16, 0.75, 1.0), (3, 0.4, 1e-4)]
)
@pytest.mark.parametrize('seed', range(4))
def test_a_step_agrees_with_a_sample_by_sample_account(width: int, lost: float, unit: float, seed: int) -> None:
    dots = unit * stepped(600, {100: 1.0, 110: 0.5, 300: -2.0, 470: 0.3}, 0.01, 3)
    dots[np.random.default_rng(seed).random(600) < lost] = np.nan
    dots[296:304] = np.nan
    dots[470 - 2 * width : 470, 1] = np.nan
    sizes = sizes_of(dots, width)
    least = max(10.0 * float(np.median([*sizes.values()])), 0.03 * max(sizes.values()))
    stretches: list[list[int]] = []
    for at, size in sizes.items():
        if size > least:
            if not stretches or stretches[-1][-1] != at - 1:
                stretches.append([])
            stretches[-1].append(at)
    wanted = []
    for stretch in stretches:
        if len(stretch) < width // 2:
            continue
        half = 0.5 * max(sizes[at] for at in stretch)
        over = {at: sizes[at] - half for at in stretch if sizes[at] > half}
        first, last = stretch[0], stretch[-1] + 1
        parts = [dots[last : last + width], dots[first - width : first]]
        there = [p[np.isfinite(p).all(axis=1)] for p in parts]
        after, before = (p.mean(axis=0) if len(p) else np.zeros(4) for p in there)
        middle = sum(at * w for at, w in over.items()) / sum(over.values())
        wanted.append((middle, float(np.linalg.norm(after - before)), first, last))
    with np.errstate(invalid='raise', divide='raise'):
        steps = [(s.at, s.size, s.first, s.last) for s in found_steps.steps_among_samples(dots, width)]
    assert len(steps) == len(wanted)
    assert np.array(steps) == pytest.approx(np.array(wanted), rel=1e-7)


def as_steps(*places: tuple[float, float]) -> list[DotStep]:
    return [DotStep(at, size, round(at) - 5, round(at) + 5) for at, size in places]


def cheapest(changes: IntArray, sizes: FloatArray, steps: list[DotStep], period: float) -> list[tuple[int, int]]:
    """Of all ways to pair notes and steps in their order that of the least cost, one by one."""
    observed = [i for i in range(len(changes)) if sizes[i] > 0.03 * max(sizes)]
    factor = sum(s.size for s in steps) / sum(sizes[i] for i in observed)
    close = [any(abs(step.at - changes[i]) * period <= 0.03 for step in steps) for i in observed]
    bonus = 9.0 if sum(close) >= len(observed) / 2 else 0.0
    best: tuple[float, list[tuple[int, int]]] = (math.inf, [])
    for count in range(min(len(observed), len(steps)) + 1):
        for notes in itertools.combinations(observed, count):
            for indices in itertools.combinations(range(len(steps)), count):
                pairs = list(zip(notes, indices, strict=True))
                cost = 9.0 * (len(observed) - count) + 4.0 * (len(steps) - count)
                for i, j in pairs:
                    away = abs(steps[j].at - changes[i]) * period
                    unlike = 2.0 * math.log(max(steps[j].size, 1e-12) / factor / sizes[i])
                    cost += away / 5.0 + min(unlike**2, 8.0)
                    cost -= bonus if away <= 0.03 else 0.0
                if cost < best[0]:
                    best = cost, pairs
    return best[1]


@pytest.mark.parametrize('seed', range(40))
def test_notes_and_steps_are_paired_at_least_cost(seed: int) -> None:
    chance = np.random.default_rng(seed)
    changes = np.sort(chance.choice(6000, 5, replace=False))
    sizes = 1e-4 * np.exp(chance.normal(size=5))
    sizes[chance.integers(5)] *= 0.01
    places = np.sort(changes[:4] + chance.normal(size=4) * chance.choice([1.0, 4.0, 20.0, 300.0, 1500.0]))
    steps = as_steps(*zip(places.tolist(), (2e-4 * np.exp(chance.normal(size=4))).tolist(), strict=True))
    assert annotated_times.matched_notes(changes, sizes, steps, 0.01) == cheapest(changes, sizes, steps, 0.01)


def test_a_note_on_time_like_half_of_the_others_stays() -> None:
    # A load of 10 hung 12 s before the third note, which says that all came off: only the second step is at a note.
    sizes = np.array([40.0, 30.0, 40.0])
    steps = as_steps((1000.0, 40.0), (3000.0, 30.0), (3800.0, 35.0), (5000.0, 10.0))
    on_time = np.array([1000, 3000, 5000])
    assert annotated_times.matched_notes(on_time, sizes, steps, 0.01) == [(0, 0), (1, 1), (2, 3)]
    # If the others are late, that one is at a step by chance.
    late = np.array([1400, 3600, 5000])
    assert annotated_times.matched_notes(late, sizes, steps, 0.01) == [(0, 0), (1, 1), (2, 2)]


def test_step_keeps_its_time_and_ramp_its_share() -> None:
    t = np.arange(8.0)
    assert steps_module.applied(t, 3.0, 0.0, 1.0) == pytest.approx([0, 0, 0, 1, 1, 1, 1, 1])
    # A quarter after 3: three quarters of that sample, and 0.5 * 3/4 * 1/4 that the one before lacks.
    more = 0.5 * 0.75 * 0.25
    assert steps_module.applied(t, 3.25, 0.0, 1.0) == pytest.approx([0, 0, -more, 0.75 + more, 1, 1, 1, 1])
    assert steps_module.applied(t, 3.25, 1.0, 1.0) == pytest.approx([0, 0, -more, 0.75 + more, 1, 1, 1, 1])
    # A ramp from 2 to 4.5, at the end of each sample.
    assert steps_module.applied(t, 2.0, 2.5, 1.0) == pytest.approx([0, 0, 0.4, 0.8, 1, 1, 1, 1])
    # A millionth of a sample is none.
    assert steps_module.applied(t, 3.0000004, 0.0, 1.0).tolist() == [0, 0, 0, 1, 1, 1, 1, 1]
    assert steps_module.applied(t, 3.000001, 0.0, 1.0)[3] < 1.0
    assert steps_module.applied(t, 3.00001, 0.0, 1.0)[3] == pytest.approx(1 - 0.5e-5, abs=1e-8)


def test_later_and_slower_shift_what_the_load_changed_by() -> None:
    t = 0.5 * np.arange(40.0)
    loads = np.column_stack((t, -2.0 * t, t**2))
    # Applied from sample 20 to 28: before is the sample before 19, after is the second one beyond 28.
    step = loads[30] - loads[18]
    effective = annotated_times.shifted(note(12.0, 10.0, 4.0), loads, 0.5)

    def share(start: float, took: float) -> FloatArray:
        return np.asarray(np.clip((t + 0.5 - start) / took, 0.0, 1.0))

    # A moment is an eighth of a second here.
    assert effective([4.0, 0.0]) == pytest.approx(np.outer(share(10.5, 4.0) - share(10.0, 4.0), step), abs=1e-3)
    assert effective([0.0, 8.0]) == pytest.approx(np.outer(share(10.0, 5.0) - share(10.0, 4.0), step), abs=1e-3)
    # Faster than at once it cannot be.
    assert effective([0.0, -100.0]) == pytest.approx(np.outer((t >= 10.0) - share(10.0, 4.0), step), abs=1e-3)
    assert effective([0.0, 0.0]) == pytest.approx(0.0)
    # Both at once are no sum of the two: its end moves by both.
    both = np.outer(share(9.5, 4.75) - share(10.0, 4.0), step)
    assert effective([-4.0, 6.0]) == pytest.approx(both, abs=1e-3)
    assert np.abs(effective([-4.0, 0.0]) + effective([0.0, 6.0]) - both).max() > 0.01 * np.abs(step).max()
    # At the begin and at the end of a recording there is no more.
    first = annotated_times.shifted(note(0.0, 0.0, 1.0), loads, 0.5)
    assert first([4.0, 0.0])[0] == pytest.approx(-(loads[4] - loads[0]) / 2.0, rel=1e-5)
    last = annotated_times.shifted(note(19.0, 19.0, 1.0), loads, 0.5)
    assert last([4.0, 0.0])[38] == pytest.approx(-(loads[39] - loads[36]) / 2.0, rel=1e-5)


def times(n: int) -> FloatArray:
    return np.asarray(np.arange(n, dtype=np.float64) * 1e-3)


def ringing(t: FloatArray) -> FloatArray:
    """Both modes, ringing since long before."""
    out = np.zeros_like(t)
    for frequency, size in ((14.0, 1.0), (21.0, 0.7)):
        w = 2.0 * math.pi * frequency
        out += size * np.exp(-0.02 * w * t) * np.cos(w * math.sqrt(1.0 - 0.02**2) * t + 0.3)
    return out


def moved_by(start: float, took: float, n: int = 6000, rung: float = 1.0) -> FloatArray:
    """Dots (n, 4), m, that a load from ``start`` on moves, beside drift and the ringing of an older one, ``rung``
    times as large.
    """
    t = times(n)
    share = np.clip((t + 1e-3 - start) / max(took, 1e-3), 0.0, 1.0)
    bend, twist = (Filter(mode_coefficients(f, 0.02, 1e-3))(share) for f in (14.0, 21.0))
    moved = np.column_stack((bend, 0.1 * bend + 0.2 * twist, bend + 0.3 * twist, -0.2 * bend))
    beside = (
        rung * ringing(t)[:, None] * (3.0, 2.0, -1.0, 2.0) + t[:, None] * (0.1, -0.2, 0.0, 0.3) + (1.0, 2.0, 3.0, 4.0)
    )
    return np.asarray(1e-4 * (moved + beside))


class Looked:
    """Dots that note which of them are looked at."""

    def __init__(self, dots: FloatArray) -> None:
        self.dots, self.parts = dots, list[slice]()

    def __len__(self) -> int:
        return len(self.dots)

    def __getitem__(self, part: slice) -> FloatArray:
        self.parts.append(part)
        return self.dots[part]


@pytest.mark.parametrize(
    ('start', 'took', 'middle'), [(3.0, 0.0, 3.0), (3.0, 0.0, 3.14), (3.0, 0.0, 2.86), (3.0, 0.2, 3.1), (3.0, 2.0, 4.0)]
)
def test_step_time_is_fitted_beside_drift_and_ringing(start: float, took: float, middle: float) -> None:
    step = DotStep(1000.0 * middle, 1e-4, round(1000.0 * start) - 200, round(1000.0 * (start + took)) + 200)
    fitted = steps_module.time_of_step(RIG, moved_by(start, took), step, (2000.0, 6000.0), 1e-3)
    assert fitted == pytest.approx((start, took), abs=1e-3 if took else 2e-5)


@pytest.mark.parametrize(
    ('between', 'window'),
    [
        # A second before the step and two after it,
        ((0.0, 9000.0), (3900, 7100)),
        # but not nearer than a tenth of a second to the steps before and after,
        ((4000.4, 6000.6), (4101, 5900)),
        # and the stretch of the step itself in any case.
        ((4950.0, 5050.0), (4900, 5100)),
    ],
)
def test_a_step_is_fitted_without_its_neighbours(between: tuple[float, float], window: tuple[int, int]) -> None:
    looked = Looked(moved_by(5.0, 0.0, 9000))
    step = DotStep(5000.0, 1e-4, 4900, 5100)
    steps_module.time_of_step(RIG, cast(FloatArray, looked), step, between, 1e-3)
    assert {(part.start, part.stop) for part in looked.parts} == {window}


def test_a_time_late_in_a_long_recording_is_fitted_as_well() -> None:
    class Later(Looked):
        def __len__(self) -> int:
            return 1_006_000

        def __getitem__(self, part: slice) -> FloatArray:
            return self.dots[part.start - 1_000_000 : part.stop - 1_000_000]

    step = DotStep(1_003_000.0, 1e-4, 1_002_800, 1_003_200)
    fitted = steps_module.time_of_step(
        RIG, cast(FloatArray, Later(moved_by(3.0, 0.0, rung=100.0))), step, (0.0, 2e6), 1e-3
    )
    assert fitted == pytest.approx((1003.0, 0.0), abs=3e-4)


def test_motion_is_rough_beyond_three_times_the_noise() -> None:
    # Steps of 1 from block to block are a variance of a half; 0, 0, c, c one of c^2/4: nine halves at sqrt 18.
    rings = np.arange(28) >= 24
    for c, rough in ((4.24, False), (4.25, True), (-4.25, True)):
        rest = np.array([*(0.0, 1.0) * 12, 0.0, 0.0, c, c])[:, None] * (0.0, 1.0, 0.0, 0.0)
        assert annotated_times.is_rough(rest, rings, 1) is rough
    assert not annotated_times.is_rough(rest, np.arange(28) >= 25, 1)


def test_rough_motion_under_a_slow_load_is_excluded() -> None:
    loads, count = np.zeros((6000, 3)), 6000
    quiet = np.repeat(np.random.default_rng(1).normal(size=(300, 4)), 20, axis=0)
    rest = quiet.copy()
    rest[2500:4000] += 20.0 * np.sin(np.arange(1500) / 40.0)[:, None]
    slow, sudden = note(2.0, 2.0, 0.5), note(2.5, 2.5)
    rough = note(2.0, 2.0, 0.5, rest_only=True)
    assert annotated_times.without_rough_motion(RIG, loads, [slow, sudden], rest).notes == (rough, sudden)
    correction = annotated_times.without_rough_motion(RIG, loads, [sudden, slow], rest)
    assert correction.loads is loads
    assert correction.notes == (sudden, rough)
    ends = 2.5 - math.log(0.01) / (2.0 * math.pi * 14.0 * 0.02)
    assert np.flatnonzero(correction.unused).tolist() == list(range(1980, math.floor(1000.0 * ends) + 1))
    rest = quiet.copy()
    rest[1000:2520] += 100.0 * np.sin(np.arange(1520) / 40.0)[:, None]
    rest[2500:2520] = 1000.0
    correction = annotated_times.without_rough_motion(RIG, loads, [slow], rest)
    assert (correction.notes, correction.unused.sum(), len(correction.unused)) == ((slow,), 0, count)


def with_pieces(
    monkeypatch: pytest.MonkeyPatch,
    steps: list[DotStep],
    fitted: dict[float, tuple[float, float]],
    residual: tuple[float, float] = (1.0, 100.0),
) -> list[tuple[float, float]]:
    """Steps, their fitted times and what corrected and annotated loads leave; between which samples a time was
    fitted.
    """
    between: list[tuple[float, float]] = []

    def fit(
        rig: Rig, dots: FloatArray, step: DotStep, edges: tuple[float, float], period: float
    ) -> tuple[float, float]:
        between.append(edges)
        return fitted[step.at]

    leaves = iter([residual[0], residual[1]] * 9)
    monkeypatch.setattr(annotated_times, 'lasting_steps', lambda dots, width: steps)
    monkeypatch.setattr(found_steps, 'lasting_steps', lambda dots, width: steps)
    monkeypatch.setattr(annotated_times, 'time_of_step', fit)
    monkeypatch.setattr(
        annotated_times, 'residual_of_dots', lambda rig, dots, loads: (next(leaves), 1e-7 * np.ones((len(dots), 4)))
    )
    return between


def annotated_at(*places: int, count: int = 20_000) -> FloatArray:
    """Loads (n, 3) that change along X, along Y and by a torque in turn."""
    loads = np.zeros((count, 3))
    for k, at in enumerate(places):
        loads[at:, k % 3] += (10.0, 10.0, 3.0)[k % 3]
    return loads


def test_last_step_is_the_last_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    with_pieces(monkeypatch, as_steps((100.0, 1.0), (250.0, 1.0), (900.5, 1.0)), {})
    assert last_load_change(RIG, np.zeros((1000, 4)), 0.02) == pytest.approx(18.01)


def test_changes_within_a_quarter_of_a_second_are_a_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [DotStep(at, 1.0, int(at) - 200, int(at) + 200) for at in (3000.0, 8000.0)]
    with_pieces(monkeypatch, steps, {3000.0: (3.01, 0.0), 8000.0: (8.0, 0.0)})
    dots = np.zeros((20_000, 4))
    for apart, reported in ((249, []), (250, [3.01])):
        assert annotated_times.unannotated_steps(RIG, dots, annotated_at(8000, 8000 + apart)) == reported
        assert (annotated_times.correct_loads(RIG, dots, annotated_at(3000, 9000, 9000 + apart)) is None) == (
            not reported
        )
    # A note is of a step from two widths before its first sample to two after its last.
    width = 2 * round(4.0 / RIG.dynamics.bending_frequency * 1000.0)
    for at, reported in ((2800 - width, []), (2799 - width, [3.01]), (3200 + width, []), (3201 + width, [3.01])):
        assert annotated_times.unannotated_steps(RIG, dots, annotated_at(at, 8000)) == reported
    # A ramp is one change, which ends once; one that comes two samples later is another.
    assert annotated_times.unannotated_steps(RIG, dots, annotated_at(*range(8000, 8100))) == [3.01]
    assert annotated_times.unannotated_steps(RIG, dots, annotated_at(8000, 8002)) == []
    # Its end may come with a note of the next one within a quarter of a second.
    assert annotated_times.unannotated_steps(RIG, dots, annotated_at(*range(8000, 8100), 8200)) == []
    assert annotated_times.unannotated_steps(RIG, dots, annotated_at(*range(8000, 8100), 8400)) == [3.01]


@pytest.mark.parametrize(('longer', 'fitted'), [(0, 0), (1, 2)])
def test_right_times_are_fitted_if_steps_are_long(longer: int, fitted: int, monkeypatch: pytest.MonkeyPatch) -> None:
    long = 2 * round(4.0 / RIG.dynamics.bending_frequency * 1000.0) + 100 + longer
    steps = [DotStep(at, 1.0, int(at), int(at) + long) for at in (3000.0, 8000.0)]
    between = with_pieces(monkeypatch, steps, {3000.0: (3.0, 0.0), 8000.0: (8.0, 0.0)})
    assert annotated_times.correct_loads(RIG, np.zeros((20_000, 4)), annotated_at(3000, 8000)) is None
    assert len(between) == fitted


@pytest.mark.parametrize(('share', 'rough'), [(0.99, False), (1.01, True)])
def test_ringing_beyond_the_noise_of_the_blocks_is_rough(share: float, rough: bool) -> None:
    """Blocks of +-1 um differ by 2 um: a variance of 2 um^2, ``ROUGH`` squared of which may ring."""
    rest = 1e-6 * np.resize([[1.0, 0.0], [-1.0, 0.0]], (100, 2))
    ringing = np.arange(100) < 10
    rest[ringing] = share * DISTINCT_SD * math.sqrt(2e-12) * np.repeat([[0.0, 1.0], [0.0, -1.0]], 5, axis=0)
    assert annotated_times.is_rough(np.repeat(rest, 4, axis=0), np.repeat(ringing, 4), 4) is rough


def test_load_cell_noise_is_removed_for_any_times(monkeypatch: pytest.MonkeyPatch) -> None:
    dots, chance = np.zeros((2000, 4)), np.random.default_rng(1)
    noisy = np.where(np.arange(2000)[:, None] < 1500, 0.0, 50.0) + chance.normal(size=(2000, 3))
    with_pieces(monkeypatch, [], {})
    corrected = annotated_times.correct_loads(RIG, dots, noisy)
    assert corrected is not None
    assert [m.first for m in corrected.measured] == [0, 1500]
    assert (corrected.notes, corrected.timed, corrected.unused.sum(), corrected.unused.shape) == ((), (), 0, (2000,))
    assert np.ptp(corrected.loads[:1500], axis=0).tolist() == [0.0] * 3
    with_pieces(monkeypatch, as_steps((400.0, 1e-4)), {400.0: (0.4, 0.0)})
    corrected = annotated_times.correct_loads(RIG, dots, noisy)
    assert corrected is not None
    assert ([m.first for m in corrected.measured], [n.applied for n in corrected.notes]) == ([0, 1500], [0.4])


PLATE_RIG = load_rig(
    overrides={
        'psd_1.sensitivity': [4e-4, 6e-4],
        'psd_2.sensitivity': [5e-4, 8e-4],
        'psd_1.zero': [0.002, -0.01],
        'psd_2.zero': [0.01, 0.004],
    }
)
GAINS = np.array([4e-4, 6e-4, 5e-4, 8e-4])
PLATE = np.array([[-1.0, 0.0, 0.06], [0.0, -1.0, -0.002], [-1.0, 0.0, 0.004], [0.0, -1.0, 0.09]])
"""Rows x1 y1 x2 y2 of beams at (0 + 2, 70 - 10) and (-100 + 10, 0 + 4) mm: x_i = -X + ly θ, y_i = -Y - lx θ."""


def as_volts(dots: FloatArray) -> FloatArray:
    """(6, m) of dots (4, m), m."""
    volts = np.full((6, dots.shape[1]), 5.0)
    volts[[0, 1, 3, 4]] = dots / GAINS[:, None]
    return volts


def test_plate_motion_needs_every_reading() -> None:
    poses = np.array([[1e-4, 0.0, 3e-5, 1e-5], [0.0, -2e-4, 1e-5, 2e-5], [0.0, 1e-3, -2e-3, 3e-3]])
    volts, there = as_volts(PLATE @ poses), np.ones((6, 4))
    assert moved_plate(PLATE_RIG, volts, there) == pytest.approx(poses, abs=1e-12)
    there[[0, 4], [0, 2]] = 0.0
    there[1, 1] = 0.05
    there[5, 3] = 0.0
    lost = np.where([True, False, True, False], np.nan, poses)
    assert moved_plate(PLATE_RIG, volts, there) == pytest.approx(lost, abs=1e-12, nan_ok=True)


def test_part_across_plate_is_least_squares_residual() -> None:
    dots = np.random.default_rng(1).normal(size=(4, 5))
    residual = dots - PLATE @ np.linalg.lstsq(PLATE, dots, rcond=None)[0]
    (size,), (across,) = across_plate(PLATE_RIG, as_volts(dots)), across_of(PLATE_RIG)
    assert np.abs(size) == pytest.approx(np.linalg.norm(residual, axis=0))
    assert across[:, None] * size == pytest.approx(residual)
    assert PLATE.T @ across == pytest.approx(np.zeros(3), abs=1e-12)
