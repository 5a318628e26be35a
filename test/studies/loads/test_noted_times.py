"""Loads that a person noted some seconds late: the motion says when they were hung, and every study says so alike."""

from __future__ import annotations

import itertools
import math
from typing import cast

import numpy as np
import pytest

from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import DOT_CHANNELS, FloatArray, IntArray
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.studies.calibrate.from_recordings import as_acted
from psd_deflection.studies.calibrate.observation import CalibrationRun
from psd_deflection.studies.check.checkup import check, of_recording
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.loads import noted_times
from psd_deflection.studies.loads.noted_times import (
    ALIKE_S,
    LEAST_SHARE,
    MendedLoads,
    MendedNote,
    last_step,
    mend_loads,
    ordinal,
    shifts,
    unnoted_steps,
)

RIG = load_rig()
LEVELS = np.array([(0, 0, 0), (0, -20, 0), (0, -50, 0), (0, -50, -29), (30, 0, 0), (40, -40, 20), (0, 0, 0)], float)
DWELL = 5000
COUNT = DWELL * len(LEVELS)
LATE = (1.3, 1.7, 3.4, 2.7, 0.3, 2.3)
JITTER = (0.012, -0.02, 0.004, 0.028, -0.009, 0.017)


def hung(took: float = 0.0) -> FloatArray:
    """Loads as they act: the next level every 5 s, in ``took`` s."""
    out = np.empty((COUNT, 3))
    for i, level in enumerate(LEVELS):
        before = LEVELS[max(i - 1, 0)]
        share = np.ones(DWELL) if took == 0.0 else np.clip(np.arange(DWELL) / (1000.0 * took), 0.0, 1.0)
        out[i * DWELL : (i + 1) * DWELL] = before + (level - before) * share[:, None]
    return out


def noted(late: tuple[float, ...]) -> FloatArray:
    """Loads as a person notes them, each so many seconds late."""
    out = np.tile(LEVELS[0], (COUNT, 1))
    for i, seconds in enumerate(late, start=1):
        out[i * DWELL + round(1000 * seconds) :] = LEVELS[i]
    return out


def volts(loads: FloatArray, seed: int = 0, **true: object) -> FloatArray:
    """What the device reads (n, 6), V, of a rig that differs by ``true`` from the rig file."""
    rig = replace_values(RIG, {name.replace('__', '.'): value for name, value in true.items()})
    counts = RigSimulator(rig, seed).step(loads).counts
    return np.asarray(counts * RIG.converter.volts_per_count, dtype=np.float64)


QUIET = volts(hung())
TURNED = volts(hung(), effects__e__name='sensor_rotation', effects__e__psd=1, effects__e__angle=0.02)


def mended(read: FloatArray, loads: FloatArray, rig: Rig = RIG) -> MendedLoads | None:
    return mend_loads(rig, read[:, list(DOT_CHANNELS)] * RIG.amplifier.sensitivity, loads)


@pytest.mark.parametrize(
    'late',
    [LATE, (0, 0, 3, 0, 0, 0), (2.0,) * 6, (-1.5, 0.4, -2.0, 0.2, -0.3, 1.0), (4.5, 3.0, 4.8, 4.0, 2.0, 4.0), JITTER],
)
@pytest.mark.parametrize('read', [QUIET, TURNED], ids=['quiet', 'turned'])
def test_each_late_or_early_load_gets_the_time_of_its_motion(late: tuple[float, ...], read: FloatArray) -> None:
    found = mended(read, noted(late))
    assert found is not None
    wrong = {i: seconds for i, seconds in enumerate(late, start=1) if abs(seconds) > ALIKE_S}
    assert {n.number: n.late for n in found.notes} == pytest.approx(wrong, abs=0.002)
    assert not found.unused.any()
    assert np.count_nonzero(np.abs(found.loads - hung()).max(axis=1) > 0.1) <= 2 * len(LEVELS)


@pytest.mark.parametrize(
    'loads',
    [noted((0.0,) * 6), noted((0.3,) * 6), noted((0.001, 0, 0.002, 0, 0.001, 0)), hung(1.2)],
    ids=['right', 'alike', 'a sample', 'a noted ramp'],
)
def test_right_times_and_one_small_delay_of_all_are_left_as_they_are(loads: FloatArray) -> None:
    assert mended(QUIET, loads) is None
    assert mended(TURNED, loads) is None


def test_other_natural_frequencies_than_the_rig_file_says_change_no_time() -> None:
    read = volts(hung(), dynamics__bending_frequency=14.7, dynamics__torsion_frequency=20.4)
    assert mended(read, noted((0.0,) * 6)) is None


def test_a_faultless_rig_whose_loads_were_noted_some_ms_off_lacks_nothing() -> None:
    observed = Observation('hung', RIG, QUIET, noted(JITTER), None)
    found = discover([observed], RIG)
    assert found.verdict == 'nothing_missing'
    assert found.floors < 1.1
    assert {(f.name, f.where) for f in found.setup} == {('load_time', f'load {i}') for i in range(1, 7)}
    assert [f.value for f in found.setup] == pytest.approx(JITTER, abs=2e-3)


def test_a_load_that_no_motion_tells_of_is_left_as_it_is() -> None:
    still = volts(np.zeros((COUNT, 3)))
    assert mended(still, noted(LATE)) is None
    assert mended(QUIET, np.zeros((COUNT, 3))) is None
    assert mended(QUIET[:50], noted((0,) * 6)[:50]) is None


def test_wiring_signs_and_units_change_no_time() -> None:
    other = QUIET[:, [1, 0, 2, 4, 3, 5]] * np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    found = mended(other, noted(LATE) * np.array([-0.102, 0.102, 0.102]))
    assert found is not None
    assert [n.late for n in found.notes] == pytest.approx(LATE, abs=0.002)


def test_lost_samples_change_no_time() -> None:
    read = QUIET.copy()
    read[np.random.default_rng(1).random(COUNT) < 0.3] = np.nan
    read[2 * DWELL - 20 : 2 * DWELL + 20] = np.nan
    found = mended(read, noted(LATE))
    assert found is not None
    assert [n.late for n in found.notes] == pytest.approx(LATE, abs=0.003)


def test_a_load_applied_over_a_second_and_noted_as_a_step_is_a_ramp() -> None:
    found = mended(volts(hung(0.8)), noted((0.0, 2.0, 0.0, 0.0, 0.0, 0.0)))
    assert found is not None
    assert [n.took for n in found.notes] == pytest.approx([0.8] * 6, abs=0.01)
    assert [n.name for n in found.notes] == ['load_ramp', 'load_time', *['load_ramp'] * 4]
    assert [round(n.value, 2) for n in found.notes[:2]] == [0.8, 2.0]
    assert 'as a ramp until 5.80' in found.notes[0].words('x.csv')
    assert not found.unused.any()


def test_motion_that_no_ramp_describes_is_left_out() -> None:
    smooth = hung(0.8)
    for i in range(1, len(LEVELS)):
        share = np.clip(np.arange(DWELL) / 800.0, 0.0, 1.0)
        part = slice(i * DWELL, (i + 1) * DWELL)
        smooth[part] = LEVELS[i - 1] + (LEVELS[i] - LEVELS[i - 1]) * (share**2 * (3.0 - 2.0 * share))[:, None]
    found = mended(volts(smooth), noted((1.0, 2.0, 1.5, 1.0, 0.5, 2.0)))
    assert found is not None
    assert found.notes[0].settled_only
    assert found.unused[DWELL + 300]
    assert not found.unused[DWELL - 500]
    assert 'at rest' in found.notes[0].words('x.csv')


def test_the_words_say_what_to_do() -> None:
    found = mended(QUIET, noted(LATE))
    assert found is not None
    third = found.notes[2]
    assert (third.name, third.where) == ('load_time', 'load 3')
    assert third.value == pytest.approx(3.4, abs=2e-3)
    assert third.words('x.csv') == (
        'the 3rd load of x.csv (0 N, -50 N, -29 N m) was noted 3.400 s late: note it 15.000 s after the first sample, '
        'not 18.400 s'
    )
    assert [ordinal(i) for i in (1, 2, 3, 4, 11, 12, 13, 21, 111)] == (
        ['1st', '2nd', '3rd', '4th', '11th', '12th', '13th', '21st', '111th']
    )


def test_check_and_calibrate_say_the_same() -> None:
    expected = mended(QUIET, noted(LATE))
    assert expected is not None
    words = [n.words('x') for n in expected.notes]
    checked = check(of_recording(RIG, QUIET, noted(LATE), 'x'))
    assert [f.fix for f in checked.findings if f.name == 'load_time'] == words
    assert {f.name for f in checked.findings} == {'load_time'}
    assert checked.sizes == pytest.approx([1.0] * 3, abs=0.01)
    told: list[str] = []
    t = np.arange(COUNT) / 1000.0
    run = CalibrationRun('x', t, QUIET, np.zeros(0), np.zeros((0, 3)), noted(LATE))
    again = as_acted(run, RIG, told.append)
    assert told == words
    assert again.loads is not None
    # The correction gives dots in 32 bits: a time differs by some microseconds.
    assert np.abs(again.loads - expected.loads).max() < 0.5
    right = CalibrationRun('x', t, QUIET, np.zeros(0), np.zeros((0, 3)), hung())
    assert as_acted(right, RIG, told.append) is right


def test_discover_mends_the_times_and_names_the_hidden_effect() -> None:
    found = discover([Observation('x', RIG, TURNED, noted(LATE))])
    assert [e.active.label for e in found.effects] == ['sensor_rotation (psd 1)']
    assert found.effects[0].active.values['angle'] == pytest.approx(0.02, abs=1e-4)
    assert found.verdict == 'effects_found'
    assert found.floors < 1.05
    assert {f.name for f in found.setup} == {'load_time'}
    assert not found.values
    assert '; load 3, 3.4 s late; load 4, ' in found.sentence
    assert found.gap_before > 100.0 * found.gap_after


@pytest.mark.parametrize('moments', [0.0, 1.0, 2.0, 3.0, 4.0, 5.4, -1.0, -2.6])
def test_a_load_between_two_samples_moves_the_link_as_one_at_that_time(moments: float) -> None:
    frequency, ratio, first = 14.0, 0.02, 100
    loads = np.zeros((1000, 3))
    loads[first:, 1] = -50.0
    note = MendedNote(1, (0.0, -50.0, 0.0), 0.1, 0.1, 0.0)
    (later,) = shifts(note, loads, 1e-3)
    moved = Filter(mode_coefficients(frequency, ratio, 1e-3))((loads + later(moments))[:, 1] / -50.0)
    # The step response of an oscillator, from the time of the step on.
    w = 2.0 * math.pi * frequency
    damped = w * math.sqrt(1.0 - ratio**2)
    since = np.maximum(np.arange(1000) * 1e-3 - 0.1 - moments * 0.25e-3, 0.0)
    ringing = np.cos(damped * since) + ratio * w / damped * np.sin(damped * since)
    exact = 1.0 - np.exp(-ratio * w * since) * ringing
    away = np.abs(np.arange(1000) - first) > 4
    # The mean of that sample alone is off by 1e-3.
    assert np.abs(moved - exact)[away].max() < 5e-5


def test_a_late_note_beside_channels_that_are_read_after_one_another() -> None:
    read = volts(hung(), effects__e__name='channel_skew', effects__e__psd=2, effects__e__delay=2e-4)
    found = discover([Observation('x', RIG, read, noted((0.0, 0.0, 3.4, 0.0, 0.0, 0.0)))])
    assert [e.active.label for e in found.effects] == ['channel_skew (psd 2)']
    assert found.effects[0].active.values['delay'] == pytest.approx(2e-4, abs=2e-6)
    assert found.verdict == 'effects_found'
    assert found.floors < 1.05
    assert [(f.name, f.where) for f in found.setup] == [('load_time', 'load 3')]


def test_a_load_that_acts_from_the_second_sample_on_is_shifted_whole() -> None:
    loads = np.tile([0.0, -20.0, 0.0], (100, 1))
    loads[0] = 0.0
    note = MendedNote(1, (0.0, -20.0, 0.0), 0.001, 0.001, 0.0)
    (later,) = shifts(note, loads, 0.001)
    # Four quarters of a sample later nothing acts in the second sample.
    assert later(4.0)[1] == pytest.approx([0.0, 20.0, 0.0])
    assert later(4.0)[2:] == pytest.approx(0.0)


def test_a_step_between_two_samples_has_its_time_and_turns_back_before_it_not_behind() -> None:
    """Half a sample later than sample 10: the sum over the samples is -1/2, the moment about sample 10 is 1/8."""
    loads = np.where(np.arange(20)[:, None] < 10, 0.0, [[4.0, -8.0, 2.0]])
    (later,) = shifts(MendedNote(1, (4.0, -8.0, 2.0), 0.01, 0.01, 0.0), loads, 1e-3)
    for more in (2.0, -2.0):
        changed = later(more) / [4.0, -8.0, 2.0]
        assert changed.sum(axis=0) == pytest.approx(-0.25 * more)
        about = np.arange(20) - 10.0 if more > 0.0 else np.arange(20) - 9.0
        assert about @ changed == pytest.approx(0.125)
        assert not changed[11:].any()
        assert (loads + later(more))[11:] == pytest.approx(np.tile([4.0, -8.0, 2.0], (9, 1)))


# ---- the pieces, by hand


def note(noted: float, hung: float, took: float = 0.0, *, settled_only: bool = False, number: int = 3) -> MendedNote:
    return MendedNote(number, (1.5, -2.0, 0.25), noted, hung, took, settled_only)


@pytest.mark.parametrize(
    ('one', 'name', 'value', 'size', 'wrong'),
    [
        (note(3.0, 1.0), 'load_time', 2.0, 2.0, True),
        (note(1.0, 3.0), 'load_time', -2.0, 2.0, True),
        (note(3.0, 1.0, 1.75), 'load_time', 2.0, 2.0, True),
        # As late as it took: noted when it was done.
        (note(3.0, 1.0, 2.0), 'load_ramp', 2.0, 2.0, True),
        (note(1.0, 3.0, 2.0), 'load_ramp', 2.0, 2.0, True),
        (note(1.0, 3.0, 2.5), 'load_ramp', 2.5, 2.0, True),
        (note(1.0, 1.0, 0.5), 'load_ramp', 0.5, 0.0, True),
        # Two milliseconds are no delay.
        (note(ALIKE_S, 0.0), 'load_ramp', 0.0, ALIKE_S, False),
        (note(0.0, ALIKE_S), 'load_ramp', 0.0, ALIKE_S, False),
        (note(0.0021, 0.0), 'load_time', 0.0021, 0.0021, True),
    ],
)
def test_a_note_is_late_by_more_than_two_milliseconds_and_by_more_than_the_load_took(
    one: MendedNote, name: str, value: float, size: float, wrong: bool
) -> None:
    assert (one.name, one.value, one.size, one.wrong) == (name, value, size, wrong)
    assert one.where == 'load 3'
    assert MendedNote(3, one.load, one.noted, one.hung, one.took) == one


@pytest.mark.parametrize(
    ('one', 'words'),
    [
        (
            note(3.0, 1.0, 1.75),
            'was noted 2.000 s late and applied over 1.8 s: note it 1.000 s after the first sample, '
            'as a ramp until 2.750 s, not 3.000 s',
        ),
        (note(1.125, 1.0), 'was noted 0.125 s late: note it 1.000 s after the first sample, not 1.125 s'),
        (note(1.0, 1.125), 'was noted 0.125 s early: note it 1.125 s after the first sample, not 1.000 s'),
        (
            note(1.0, 1.0, 0.5, settled_only=True),
            'was applied over 0.5 s: note it 1.000 s after the first sample, as a ramp until 1.500 s, not 1.000 s; '
            'here only the link at rest under it is used',
        ),
    ],
)
def test_a_wrong_time_is_told_in_words_and_so_is_what_to_do(one: MendedNote, words: str) -> None:
    assert one.words('x') == f'the 3rd load of x (1.5 N, -2 N, 0.25 N m) {words}'


def test_numbers_up_to_a_thousand_have_the_ending_of_their_last_word() -> None:
    def ending(number: int) -> str:
        # eleventh, twelfth, thirteenth ... nineteenth
        teens = 10 < number % 100 < 20
        return 'th' if teens else ['th', 'st', 'nd', 'rd', *['th'] * 6][int(str(number)[-1])]

    assert [ordinal(n) for n in range(1, 1001)] == [f'{n}{ending(n)}' for n in range(1, 1001)]


@pytest.mark.parametrize(
    ('late', 'alike'),
    [
        ([0.25, 0.25, 0.25], True),
        ([0.25, 0.375, 0.125], True),
        ([0.25, 0.376, 0.125], False),
        ([0.25, 0.374, 0.124], False),
        ([-0.25, -0.375, -0.125], True),
        ([0.9, 0.9, 0.9], True),
        ([0.901, 0.901, 0.9], False),
        ([-0.901, -0.901, -0.9], False),
        # The middle one counts, not the mean.
        ([0.25, 0.25, 0.0, 0.25], False),
    ],
)
def test_delays_are_alike_within_so_much_of_the_middle_one_and_up_to_0_9_seconds(
    late: list[float], alike: bool
) -> None:
    assert noted_times._alike(np.array(late), 0.125) is alike


def test_the_dots_move_by_what_a_cantilever_and_a_shaft_do() -> None:
    rig = load_rig(overrides={'psd_1.zero': [0.002, -0.01], 'psd_2.zero': [0.01, 0.004]})
    link = rig.link
    fourth = link.outer_radius**4 - link.inner_radius**4
    bend = link.length**3 / (3.0 * link.youngs_modulus * math.pi / 4.0 * fourth)
    twist = link.length / (link.shear_modulus * math.pi / 2.0 * fourth)
    beams = ((0.002, 0.06), (-0.09, 0.004))
    loads = [(2.0, 0.0, 0.0), (0.0, -3.0, 0.0), (1.0, 2.0, -4.0)]
    wanted = []
    for fx, fy, tz in loads:
        x, y, turn = bend * fx, bend * fy, twist * tz
        moved = [(-x + turn * ly, -y - turn * lx) for lx, ly in beams]
        wanted.append(math.sqrt(sum(a * a + b * b for a, b in moved)))
    assert noted_times._expected(rig, np.array(loads)) == pytest.approx(wanted, rel=1e-9)


# ---- steps of the dots


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


def test_a_step_is_where_the_mean_after_differs_from_the_mean_before() -> None:
    # The difference is a triangle from 90 to 110: above 3 % of it from 91 to 109.
    (step,) = noted_times._steps(stepped(200, {100: 2.0}), 10)
    assert (step.at, step.size) == pytest.approx((100.0, 2.0))
    assert (step.first, step.last) == (91, 110)
    # Of two rows of three the middle is between them.
    (slow,) = noted_times._steps(stepped(200, {100: 1.0, 101: 1.0}), 10)
    assert slow.at == pytest.approx(100.5)
    # So it is wherever the dots are, from the first width of them on.
    early = stepped(200, {14: 1.0})
    (first,), (shifted,) = noted_times._steps(early, 10), noted_times._steps(early + 5.0, 10)
    assert (shifted.at, shifted.size) == pytest.approx((first.at, first.size))
    assert (shifted.first, shifted.last) == (first.first, first.last) == (10, 24)
    # Four widths are the least, even if most of them is lost: more than two of ten must be there.
    for n, told in ((40, 1), (39, 0)):
        short = stepped(n, {20: 1.0})
        short[:15] = short[26:] = np.nan
        assert len(noted_times._steps(short, 10)) == told
    assert noted_times._steps(np.zeros((200, 4)), 10) == []


@pytest.mark.parametrize(('times', 'seen'), [(13.5, 1), (13.0, 0)])
def test_a_step_stands_out_ten_times_of_what_is_there_without_one(times: float, seen: int) -> None:
    # A drift of 0.01 a sample is 1 between two means of 100, everywhere. Half of the stretch, 51 samples, must be above
    # 10: three quarters of the step, and the drift across it.
    dots = stepped(2000, {900: times})
    dots[:, 3] = 0.01 * np.arange(2000.0)
    assert (0.75 * times) ** 2 + 1.0 != pytest.approx(100.0, abs=2.0)
    assert len(noted_times._steps(dots, 100)) == seen


def test_places_without_a_mean_have_no_step() -> None:
    # Fifty of a hundred places have none: their middle one is half of the least that the drift makes of the others,
    # 0.55, as three samples after the last are left. Ten times of that are more than the step.
    dots = stepped(120, {30: 2.0})
    dots[:, 3] = 0.1 * np.arange(120.0)
    dots[62:] = np.nan
    assert list(sizes_of(dots, 10).values()).count(0.0) == 50
    assert noted_times._steps(dots, 10) == []
    assert len(noted_times._steps(dots + 3.0 * stepped(120, {30: 2.0}), 10)) == 1


def test_a_step_is_more_than_three_per_cent_of_the_largest() -> None:
    for size, seen in ((2.9, 1), (4.0, 2)):
        assert len(noted_times._steps(stepped(100, {30: 100.0, 70: size}), 2)) == seen


@pytest.mark.parametrize(('share', 'seen'), [(0.0395, 1), (0.0400, 2)])
def test_a_stretch_above_three_per_cent_of_the_largest_is_half_a_width_long(share: float, seen: int) -> None:
    # A triangle of 102 to either side: 25 on either side of the middle one are half of it, 51, and 24 are less.
    assert len(noted_times._steps(stepped(2000, {500: 1.0, 1200: share}), 102)) == seen
    assert len(noted_times._steps(stepped(2000, {500: share, 1200: 1.0}), 102)) == seen


@pytest.mark.parametrize(
    ('width', 'lost', 'unit'), [(16, 0.3, 1.0), (16, 0.6, 1e-4), (16, 0.7, 1e-4), (16, 0.75, 1.0), (3, 0.4, 1e-4)]
)
@pytest.mark.parametrize('seed', range(4))
def test_the_place_and_size_of_a_step_are_those_of_an_account_sample_by_sample(
    width: int, lost: float, unit: float, seed: int
) -> None:
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
        found = [(s.at, s.size, s.first, s.last) for s in noted_times._steps(dots, width)]
    assert len(found) == len(wanted)
    assert np.array(found) == pytest.approx(np.array(wanted), rel=1e-7)


def test_a_difference_is_of_the_means_of_whole_samples_and_nothing_has_the_mean_0() -> None:
    dots = np.arange(24.0).reshape(6, 4)
    dots[4, 2] = np.nan
    assert noted_times._difference(dots, slice(3, 6), slice(0, 2)) == pytest.approx([14.0] * 4)
    assert noted_times._difference(dots, slice(4, 5), slice(0, 2)) == pytest.approx([-2.0, -3.0, -4.0, -5.0])


# ---- which note belongs to which step


def as_steps(*places: tuple[float, float]) -> list[noted_times._Step]:
    return [noted_times._Step(at, size, round(at) - 5, round(at) + 5) for at, size in places]


def cheapest(
    changes: IntArray, sizes: FloatArray, steps: list[noted_times._Step], period: float
) -> list[tuple[int, int]]:
    """Of all ways to pair notes and steps in their order that of the least cost, one by one."""
    seen = [i for i in range(len(changes)) if sizes[i] > 0.03 * max(sizes)]
    factor = sum(s.size for s in steps) / sum(sizes[i] for i in seen)
    best: tuple[float, list[tuple[int, int]]] = (math.inf, [])
    for count in range(min(len(seen), len(steps)) + 1):
        for some in itertools.combinations(seen, count):
            for others in itertools.combinations(range(len(steps)), count):
                pairs = list(zip(some, others, strict=True))
                cost = 9.0 * (len(seen) - count) + 4.0 * (len(steps) - count)
                for i, j in pairs:
                    away = abs(steps[j].at - changes[i]) * period
                    unlike = 2.0 * math.log(max(steps[j].size, 1e-12) / factor / sizes[i])
                    cost += away / 5.0 + min(unlike**2, 8.0) if away <= 30.0 else math.inf
                if cost < best[0]:
                    best = cost, pairs
    return best[1]


@pytest.mark.parametrize('seed', range(40))
def test_notes_and_steps_are_paired_at_the_least_cost_of_all_ways(seed: int) -> None:
    chance = np.random.default_rng(seed)
    changes = np.sort(chance.choice(6000, 5, replace=False))
    sizes = 1e-4 * np.exp(chance.normal(size=5))
    sizes[chance.integers(5)] *= 0.01
    places = np.sort(changes[:4] + chance.normal(size=4) * chance.choice([20.0, 300.0, 1500.0]))
    steps = as_steps(*zip(places.tolist(), (2e-4 * np.exp(chance.normal(size=4))).tolist(), strict=True))
    assert noted_times._matched(changes, sizes, steps, 0.01) == cheapest(changes, sizes, steps, 0.01)


def test_a_note_without_a_step_near_it_has_none() -> None:
    changes = np.array([1000, 9000])
    # Thirty seconds away is the farthest.
    for away, pairs in ((2999.0, [(0, 0)]), (3000.0, [(0, 0)]), (3001.0, [])):
        assert noted_times._matched(changes[:1], np.array([1e-4]), as_steps((1000.0 + away, 1e-4)), 0.01) == pairs
    # What moves the dots by no more than 3 % of the largest does not count.
    sizes = np.array([1.0, LEAST_SHARE])
    assert noted_times._matched(changes, sizes, as_steps((1000.0, 1.0), (9000.0, 0.04)), 0.01) == [(0, 0)]
    sizes[1] = 0.04
    assert noted_times._matched(changes, sizes, as_steps((1000.0, 1.0), (9000.0, 0.04)), 0.01) == [(0, 0), (1, 1)]
    assert noted_times._matched(changes, np.zeros(2), as_steps((1000.0, 1.0)), 0.01) == []
    assert noted_times._matched(changes, sizes, [], 0.01) == []
    # A step of no size is paired with the one that it is nearest to.
    assert noted_times._matched(changes, sizes, as_steps((1000.0, 1.0), (9000.0, 0.0)), 0.01) == [(0, 0), (1, 1)]


# ---- loads between samples


def test_a_step_between_samples_keeps_its_time_and_a_ramp_its_share() -> None:
    t = np.arange(8.0)
    assert noted_times._profile(t, 3.0, 0.0, 1.0) == pytest.approx([0, 0, 0, 1, 1, 1, 1, 1])
    # A quarter after 3: three quarters of that sample, and 0.5 * 3/4 * 1/4 that the one before lacks.
    more = 0.5 * 0.75 * 0.25
    assert noted_times._profile(t, 3.25, 0.0, 1.0) == pytest.approx([0, 0, -more, 0.75 + more, 1, 1, 1, 1])
    assert noted_times._profile(t, 3.25, 1.0, 1.0) == pytest.approx([0, 0, -more, 0.75 + more, 1, 1, 1, 1])
    # A ramp from 2 to 4.5, at the end of each sample.
    assert noted_times._profile(t, 2.0, 2.5, 1.0) == pytest.approx([0, 0, 0.4, 0.8, 1, 1, 1, 1])
    # A millionth of a sample is none.
    assert noted_times._profile(t, 3.0000004, 0.0, 1.0).tolist() == [0, 0, 0, 1, 1, 1, 1, 1]
    assert noted_times._profile(t, 3.000001, 0.0, 1.0)[3] < 1.0
    assert noted_times._profile(t, 3.00001, 0.0, 1.0)[3] == pytest.approx(1 - 0.5e-5, abs=1e-8)


def test_later_and_slower_shift_what_the_load_changed_by() -> None:
    t = 0.5 * np.arange(40.0)
    loads = np.column_stack((t, -2.0 * t, t**2))
    # Applied from sample 20 to 28: before is the sample before 19, after is the second one beyond 28.
    step = loads[30] - loads[18]
    ramp = note(12.0, 10.0, 4.0)
    later, slower = shifts(ramp, loads, 0.5)

    def share(start: float, took: float) -> FloatArray:
        return np.asarray(np.clip((t + 0.5 - start) / took, 0.0, 1.0))

    # A moment is an eighth of a second here.
    assert later(4.0) == pytest.approx(np.outer(share(10.5, 4.0) - share(10.0, 4.0), step), abs=1e-3)
    assert slower(8.0) == pytest.approx(np.outer(share(10.0, 5.0) - share(10.0, 4.0), step), abs=1e-3)
    # Faster than at once it cannot be.
    assert slower(-100.0) == pytest.approx(np.outer((t >= 10.0) - share(10.0, 4.0), step), abs=1e-3)
    assert later(0.0) == pytest.approx(0.0)
    assert len(shifts(note(12.0, 10.0, 0.9), loads, 0.5)) == 2
    assert len(shifts(note(12.0, 10.0), loads, 0.5)) == 1
    # At the begin and at the end of a recording there is no more.
    first, _ = shifts(note(0.0, 0.0, 1.0), loads, 0.5)
    assert first(4.0)[0] == pytest.approx(-(loads[4] - loads[0]) / 2.0, rel=1e-5)
    last, _ = shifts(note(19.0, 19.0, 1.0), loads, 0.5)
    assert last(4.0)[38] == pytest.approx(-(loads[39] - loads[36]) / 2.0, rel=1e-5)


def test_loads_as_they_acted_have_each_change_at_its_time_and_only_fitted_ones_are_told() -> None:
    loads = np.zeros((30, 3))
    loads[5:] = (1.0, 0.0, 0.0)
    loads[12:] = (1.0, -2.0, 0.0)
    loads[20:] = (0.0, 0.0, 3.0)
    acted, notes = noted_times._as_acted(loads, np.array([5, 12, 20]), {0: (0.3, 0.0), 2: (1.8, 0.2)}, 0.1)
    wanted = np.zeros((30, 3))
    wanted[3:] += (1.0, 0.0, 0.0)
    wanted[12:] += (0.0, -2.0, 0.0)
    wanted[18:] += 0.5 * np.array((-1.0, 2.0, 3.0))
    wanted[19:] += 0.5 * np.array((-1.0, 2.0, 3.0))
    assert acted == pytest.approx(wanted, abs=1e-5)
    assert [(n.number, n.load) for n in notes] == [(1, (1.0, 0.0, 0.0)), (3, (0.0, 0.0, 3.0))]
    assert [(n.noted, n.hung, n.took) for n in notes] == [
        pytest.approx((0.5, 0.3, 0.0)),
        pytest.approx((2.0, 1.8, 0.2)),
    ]
    # What took a tenth of a second was no ramp.
    (one,) = noted_times._as_acted(loads, np.array([5]), {0: (0.3, 0.1)}, 0.1)[1]
    assert one.took == 0.0
    # From the second sample on, and one right after the other.
    loads = np.zeros((6, 3))
    loads[1:], loads[2:] = (1.0, 0.0, 0.0), (5.0, 2.0, 0.0)
    assert noted_times._as_acted(loads, np.array([1, 2]), {}, 0.1)[0] == pytest.approx(loads)
    loads = np.zeros((30, 3))
    loads[5:], loads[12:], loads[20:] = (1.0, 0.0, 0.0), (1.0, -2.0, 0.0), (0.0, 0.0, 3.0)
    begun = np.add(loads, (7.0, 8.0, 9.0))
    assert noted_times._as_acted(begun, np.array([5, 12, 20]), {}, 0.1)[0] == pytest.approx(begun)


# ---- the fit of one time


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
    ('start', 'took', 'middle'),
    [(3.0, 0.0, 3.0), (3.0, 0.0, 3.14), (3.0, 0.0, 2.86), (3.0, 0.2, 3.1), (3.0, 2.0, 4.0)],
)
def test_one_time_is_fitted_beside_drift_and_the_ringing_of_before(start: float, took: float, middle: float) -> None:
    step = noted_times._Step(1000.0 * middle, 1e-4, round(1000.0 * start) - 200, round(1000.0 * (start + took)) + 200)
    found = noted_times._fitted(RIG, moved_by(start, took), step, (2000.0, 6000.0), 1e-3)
    assert found == pytest.approx((start, took), abs=1e-3 if took else 2e-5)


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
def test_a_time_is_fitted_to_a_second_before_and_two_after_without_the_neighbours(
    between: tuple[float, float], window: tuple[int, int]
) -> None:
    looked = Looked(moved_by(5.0, 0.0, 9000))
    step = noted_times._Step(5000.0, 1e-4, 4900, 5100)
    noted_times._fitted(RIG, cast(FloatArray, looked), step, between, 1e-3)
    assert {(part.start, part.stop) for part in looked.parts} == {window}


def test_a_time_is_fitted_to_no_more_than_there_is() -> None:
    looked = Looked(moved_by(0.5, 0.0, 1500))
    step = noted_times._Step(500.0, 1e-4, 400, 600)
    found = noted_times._fitted(RIG, cast(FloatArray, looked), step, (-2000.0, 9000.0), 1e-3)
    assert {(part.start, part.stop) for part in looked.parts} == {(0, 1500)}
    assert found[0] == pytest.approx(0.5, abs=1e-4)


def test_a_time_late_in_a_long_recording_is_fitted_as_well() -> None:
    class Later(Looked):
        def __len__(self) -> int:
            return 1_006_000

        def __getitem__(self, part: slice) -> FloatArray:
            return self.dots[part.start - 1_000_000 : part.stop - 1_000_000]

    step = noted_times._Step(1_003_000.0, 1e-4, 1_002_800, 1_003_200)
    found = noted_times._fitted(RIG, cast(FloatArray, Later(moved_by(3.0, 0.0, rung=100.0))), step, (0.0, 2e6), 1e-3)
    assert found == pytest.approx((1003.0, 0.0), abs=3e-4)


def test_a_step_is_looked_for_every_six_milliseconds_and_a_ramp_is_believed_if_it_leaves_less_than_half(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[list[tuple[float, float]], float]] = []
    slowly = [0.49]

    def least(left: object, starts: list[tuple[float, float]], reach: float) -> tuple[float, tuple[float, float]]:
        asked.append((starts, reach))
        return (1.0, (3.01, 0.0)) if len(asked) % 2 else (slowly[0], (2.5, -1.1))

    monkeypatch.setattr(noted_times, '_least', least)
    step = noted_times._Step(3000.0, 1e-4, 2800, 3200)
    for left, found in ((0.49, (2.5, 1.1)), (0.5, (3.01, 0.0)), (1.2, (3.01, 0.0))):
        slowly[0] = left
        assert noted_times._fitted(RIG, moved_by(3.0, 0.0), step, (0.0, 6000.0), 1e-3) == found
    (sudden, by), (ramps, seconds) = asked[:2]
    assert [at for at, _ in sudden] == pytest.approx([2.85 + 0.006 * i for i in range(51)])
    assert {took for _, took in sudden} == {0.0}
    # About the middle, of a tenth of a second and more up to some seconds.
    assert [at + 0.5 * took for at, took in ramps] == pytest.approx([3.0] * 6)
    assert [took for _, took in ramps] == [0.15, 0.3, 0.6, 1.0, 1.5, 2.5]
    assert (by, seconds) == (1e-3, 0.05)


def test_the_search_begins_with_a_reach_to_either_side_and_ends_after_120_looks() -> None:
    looks: list[tuple[float, float]] = []

    def down(x: FloatArray) -> float:
        looks.append((float(x[0]), float(x[1])))
        return float(-x[0] - 2.0 * x[1])

    noted_times._least(down, [(1.0, 0.5), (2.0, 1.0)], 0.25)
    assert looks[2:5] == [(2.0, 1.0), (2.25, 1.0), (2.0, 1.25)]
    assert len(looks) == 2 + 120


def test_the_least_of_a_valley_is_found_from_the_best_start() -> None:
    def valley(x: FloatArray) -> float:
        return float((x[0] - 1.23) ** 2 + 4.0 * (x[1] - 0.61) ** 2 + 2.0)

    least, (at, took) = noted_times._least(valley, [(0.0, 0.3), (1.2, 0.6), (5.0, 1.0)], 0.05)
    assert (least, at, took) == pytest.approx((2.0, 1.23, 0.61), abs=1e-3)
    # Without a duration it keeps none, and looks six reaches about.
    least, (at, took) = noted_times._least(valley, [(0.0, 0.0), (1.2, 0.0), (5.0, 0.0)], 0.01)
    assert at == pytest.approx(1.23, abs=2e-5)
    assert took == 0.0
    assert least == pytest.approx(2.0 + 4.0 * 0.61**2)
    for begun, end in ((1.1, 1.16), (1.4, 1.34)):
        assert noted_times._least(valley, [(begun, 0.0)], 0.01)[1][0] == pytest.approx(end, abs=5e-5)


# ---- what is left


def test_what_is_left_of_the_dots_is_what_least_squares_leave() -> None:
    chance = np.random.default_rng(5)
    loads = np.zeros((1010, 3))
    loads[200:, 0], loads[500:, 1], loads[700:, 2] = 3.0, -20.0, 8.0
    columns = [np.ones(1010), np.arange(1010.0)]
    for k, frequency in enumerate((14.0, 14.0, 21.0)):
        columns.append(Filter(mode_coefficients(frequency, 0.02, 1e-3))(loads[:, k]))
    design = np.column_stack(columns)
    dots = 1e-4 * design @ chance.normal(size=(5, 4)) * (1.0, 1e-3, 1.0, 1.0) + 1e-6 * chance.normal(size=(1010, 4))
    dots[chance.random(1010) < 0.1] = np.nan
    dots[400:420] = np.nan
    # One of a block.
    dots[600:619] = np.nan
    there = np.asarray(np.isfinite(dots).all(axis=1))
    rest = np.where(there[:, None], dots - design @ np.linalg.lstsq(design[there], dots[there], rcond=None)[0], np.nan)
    with np.errstate(invalid='raise', divide='raise'):
        left, means = noted_times._left(RIG, dots, loads)
    assert left == pytest.approx(float(np.nansum(rest**2)), rel=1e-6)
    assert means.shape == dots.shape
    for first in range(0, 1010, 20):
        part = rest[first : first + 20]
        wanted = np.nanmean(part, axis=0) if np.isfinite(part).any() else np.full(4, np.nan)
        assert means[first : first + 20] == pytest.approx(np.tile(wanted, (len(part), 1)), rel=1e-4, nan_ok=True)
    # A millionth of the loads moves the dots alike.
    assert noted_times._left(RIG, dots, 1e-6 * loads)[0] == pytest.approx(left, rel=1e-6)
    # And one axis that is never loaded does nothing.
    loads[:, 1] = 0.0
    design[:, 3] = 0.0
    rest = dots[there] - design[there] @ np.linalg.lstsq(design[there], dots[there], rcond=None)[0]
    assert noted_times._left(RIG, dots, loads)[0] == pytest.approx(float((rest**2).sum()), rel=1e-6)


def test_a_link_moves_for_five_time_constants_of_its_slower_mode() -> None:
    t = times(8000)
    rig = load_rig(overrides={'dynamics.torsion_frequency': 10.0, 'dynamics.torsion_damping_ratio': 0.05})
    # 1 / (2 pi f ratio): 0.568 s of 14 Hz at 0.02, 0.318 s of 10 Hz at 0.05.
    wanted = 5.0 / (2.0 * math.pi * 14.0 * 0.02)
    for took in (0.0, 0.7):
        moving = np.flatnonzero(noted_times._moving(rig, note(3.0, 2.0, took), t))
        assert moving[0] == 1980
        assert moving[-1] == math.floor(1000.0 * (2.0 + took + wanted))
        assert len(moving) == moving[-1] - moving[0] + 1
    # Without damping of a thousandth or more it would never end.
    free = load_rig(overrides={'dynamics.torsion_frequency': 200.0, 'dynamics.torsion_damping_ratio': 0.0})
    assert np.flatnonzero(noted_times._moving(free, note(3.0, 2.0), t))[-1] == math.floor(
        2000.0 + 5e6 / (400.0 * math.pi)
    )


def rest_of(sizes: list[float], block: int = 4) -> FloatArray:
    """Blocks whose four dots are each of these sizes."""
    return np.repeat(np.outer(sizes, np.ones(4)), block, axis=0)


def test_ringing_is_rough_beyond_three_times_the_noise() -> None:
    # Neighbours of quiet blocks differ by 1 of each of four dots: half of the square, of four, is the noise, 2.
    quiet = [0.0, 1.0] * 20
    rings = np.zeros(4 * 46, dtype=bool)
    rings[-24:] = True
    # Six that are s off their mean, of four dots: 4 s^2, above 9 * 2 if s is above 2.1.
    for size, rough in ((2.1, False), (2.14, True)):
        rest = rest_of([*quiet, *[size, -size] * 3])
        assert noted_times._rough(rest, rings, 4) is rough
        # About their own mean.
        rest[-24:] += 50.0
        assert noted_times._rough(rest, rings, 4) is rough
    # Exactly three times is not beyond: 1.5 of two dots, beside quiet ones of which one differs by 1.
    rest = rest_of([*quiet, *[1.5, -1.5] * 3]) * (1.0, 0.0, 0.0, 0.0)
    rest[-24:, 1] = rest[-24:, 0]
    assert not noted_times._rough(rest, rings, 4)
    assert noted_times._rough(1.01 * rest - 0.01 * rest * ~rings[:, None], rings, 4)
    # A lost block counts as none, and of three nothing is told.
    rest = rest_of([*quiet, *[5.0, -5.0] * 3])
    rest[-8:] = np.nan
    assert noted_times._rough(rest, rings, 4)
    rest[-12:, 2] = np.nan
    assert not noted_times._rough(rest, rings, 4)


def test_only_motion_under_a_load_that_was_applied_slowly_is_left_out_if_it_is_rough() -> None:
    loads, count = np.zeros((6000, 3)), 6000
    quiet = np.repeat(np.random.default_rng(1).normal(size=(300, 4)), 20, axis=0)
    rest = quiet.copy()
    rest[2500:4000] += 20.0 * np.sin(np.arange(1500) / 40.0)[:, None]
    slow, sudden = note(2.0, 2.0, 0.5), note(2.5, 2.5)
    rough = note(2.0, 2.0, 0.5, settled_only=True)
    assert noted_times._without_rough_motion(RIG, loads, [slow, sudden], rest).notes == (rough, sudden)
    found = noted_times._without_rough_motion(RIG, loads, [sudden, slow], rest)
    assert found.loads is loads
    assert found.notes == (sudden, rough)
    ends = 2.5 + 5.0 / (2.0 * math.pi * 14.0 * 0.02)
    assert np.flatnonzero(found.unused).tolist() == list(range(1980, math.floor(1000.0 * ends) + 1))
    # While it was applied it counts as nothing.
    rest = quiet.copy()
    rest[1000:2520] += 100.0 * np.sin(np.arange(1520) / 40.0)[:, None]
    rest[2500:2520] = 1000.0
    found = noted_times._without_rough_motion(RIG, loads, [slow], rest)
    assert (found.notes, found.unused.sum(), len(found.unused)) == ((slow,), 0, count)


# ---- all of it, with what it is made of told


@pytest.mark.parametrize(('rate', 'width'), [(1000.0, 286), (200.0, 57), (10.0, 3), (5.0, 2)])
def test_means_take_four_periods_of_bending_and_two_samples_at_least(
    rate: float, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    widths: list[int] = []

    def none(dots: FloatArray, width: int) -> list[noted_times._Step]:
        widths.append(width)
        return []

    monkeypatch.setattr(noted_times, '_steps', none)
    rig = load_rig(overrides={'converter.sample_rate_hz': rate, 'dynamics.bending_frequency': 14.0})
    loads = np.zeros((100, 3))
    loads[50:] = 1.0
    assert unnoted_steps(rig, np.zeros((100, 4)), loads) == []
    assert last_step(rig, np.zeros((100, 4)), 1.0 / rate) is None
    assert mend_loads(rig, np.zeros((100, 4)), loads) is None
    assert widths == [width] * 3


def with_pieces(
    monkeypatch: pytest.MonkeyPatch,
    steps: list[noted_times._Step],
    fitted: dict[float, tuple[float, float]],
    left: tuple[float, float] = (1.0, 100.0),
) -> list[tuple[float, float]]:
    """Steps, their fitted times and what mended and noted loads leave; between which samples a time was fitted."""
    between: list[tuple[float, float]] = []

    def fit(
        rig: Rig, dots: FloatArray, step: noted_times._Step, edges: tuple[float, float], period: float
    ) -> tuple[float, float]:
        between.append(edges)
        return fitted[step.at]

    leaves = iter([left[0], left[1]] * 9)
    monkeypatch.setattr(noted_times, '_steps', lambda dots, width: steps)
    monkeypatch.setattr(noted_times, '_fitted', fit)
    monkeypatch.setattr(noted_times, '_left', lambda rig, dots, loads: (next(leaves), 1e-7 * np.ones((len(dots), 4))))
    return between


def noted_at(*places: int, count: int = 20_000) -> FloatArray:
    """Loads (n, 3) that change along X, along Y and by a torque in turn."""
    loads = np.zeros((count, 3))
    for k, at in enumerate(places):
        loads[at:, k % 3] += (10.0, 10.0, 3.0)[k % 3]
    return loads


def test_last_step_is_the_last_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    with_pieces(monkeypatch, as_steps((100.0, 1.0), (250.0, 1.0), (900.5, 1.0)), {})
    assert last_step(RIG, np.zeros((1000, 4)), 0.02) == pytest.approx(18.01)


def test_steps_without_a_note_near_them_are_told_by_their_fitted_time(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [noted_times._Step(at, 1.0, int(at) - 200, int(at) + 200) for at in (3000.0, 8000.0, 15000.0)]
    fitted = {3000.0: (3.01, 0.5), 8000.0: (8.02, 0.7), 15000.0: (15.03, 0.9)}
    between = with_pieces(monkeypatch, steps, fitted)
    dots = np.zeros((20_000, 4))
    assert unnoted_steps(RIG, dots, np.zeros((20_000, 3))) == [3.01, 8.02, 15.03]
    assert between == [(0.0, 8000.0), (3000.0, 15000.0), (8000.0, 20000.0)]
    # Near: two widths of 286 before the step's first sample, or after its last.
    for at, near in ((7228, True), (7227, False), (8772, True), (8773, False)):
        told = unnoted_steps(RIG, dots, noted_at(3000, at, 15000))
        assert told == ([] if near else [8.02])
    # One axis is enough for a note, and two samples may be one change after the other.
    for axis in range(3):
        loads = np.zeros((20_000, 3))
        for at in (3000, 8000, 15000):
            loads[at:, axis] += 1.0
        assert unnoted_steps(RIG, dots, loads) == []
        assert unnoted_steps(RIG, dots, loads[:, [axis, axis, axis]]) == []


def test_changes_within_a_quarter_of_a_second_are_a_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [noted_times._Step(at, 1.0, int(at) - 200, int(at) + 200) for at in (3000.0, 8000.0)]
    with_pieces(monkeypatch, steps, {3000.0: (3.01, 0.0), 8000.0: (8.0, 0.0)})
    dots = np.zeros((20_000, 4))
    for apart, told in ((249, []), (250, [3.01])):
        assert unnoted_steps(RIG, dots, noted_at(8000, 8000 + apart)) == told
        assert (mend_loads(RIG, dots, noted_at(3000, 9000, 9000 + apart)) is None) == (not told)
    # A ramp is one change, which ends once; one that comes two samples later is another.
    ramp = noted_at(*range(8000, 8100))
    assert unnoted_steps(RIG, dots, ramp) == [3.01]
    assert unnoted_steps(RIG, dots, noted_at(8000, 8002)) == []
    # Its end may come with a note of the next one within a quarter of a second.
    assert unnoted_steps(RIG, dots, noted_at(*range(8000, 8100), 8200)) == []
    assert unnoted_steps(RIG, dots, noted_at(*range(8000, 8100), 8400)) == [3.01]


def test_times_are_mended_if_they_differ_and_leave_a_quarter_of_the_movement(monkeypatch: pytest.MonkeyPatch) -> None:
    places = (3000.0, 8000.0, 15000.0)
    sizes = noted_times._expected(RIG, np.array([(10.0, 0, 0), (0, 10.0, 0), (0, 0, 3.0)])).tolist()
    steps = [noted_times._Step(at, size, int(at) - 200, int(at) + 200) for at, size in zip(places, sizes, strict=True)]
    fitted = {3000.0: (3.0, 0.0), 8000.0: (8.0, 0.0), 15000.0: (15.0, 0.0)}
    dots = np.zeros((20_000, 4))
    between = with_pieces(monkeypatch, steps, fitted)
    late = noted_at(3000, 9500, 15000)
    found = mend_loads(RIG, dots, late)
    assert found is not None
    assert [(n.number, n.noted, n.hung, n.took) for n in found.notes] == [(2, 9.5, 8.0, 0.0)]
    assert [n.number for n in found.timed] == [1, 2, 3]
    assert found.loads == pytest.approx(noted_at(3000, 8000, 15000))
    assert between == [(0.0, 8000.0), (3000.0, 15000.0), (8000.0, 20000.0)]
    assert not found.unused.any()
    assert found.measured == ()
    # Right as noted, all late alike, or two milliseconds off: nothing is fitted.
    for noted_so in (noted_at(3000, 8000, 15000), noted_at(3500, 8500, 15500), noted_at(3002, 8000, 14998)):
        between.clear()
        assert mend_loads(RIG, dots, noted_so) is None
        assert between == []
    # A step that is longer than two widths and a tenth of a second is looked at: 2 * 286 + 100 samples.
    for long, looks in ((672, 0), (673, 3)):
        between.clear()
        some = [steps[0], noted_times._Step(8000.0, sizes[1], 7700, 7700 + long), steps[2]]
        monkeypatch.setattr(noted_times, '_steps', lambda dots, width, some=some: some)
        assert mend_loads(RIG, dots, noted_at(3000, 8000, 15000)) is None
        assert len(between) == looks
    # Applied over a tenth of a second is a step.
    for took, told in ((0.1, None), (0.101, [0.101])):
        fitted[8000.0] = (8.0, took)
        ramp = mend_loads(RIG, dots, noted_at(3000, 8000, 15000))
        assert (None if ramp is None else [n.took for n in ramp.notes]) == told
    fitted[8000.0] = (8.0, 0.0)
    monkeypatch.setattr(noted_times, '_steps', lambda dots, width: steps)
    # Alike by the fitted times, though not by the middles of the steps.
    fitted.update({3000.0: (2.999, 0.0), 8000.0: (9.498, 0.0), 15000.0: (15.0, 0.0)})
    assert mend_loads(RIG, dots, late) is None
    fitted.update({3000.0: (3.0, 0.0), 8000.0: (8.0, 0.0)})
    for left, told_late in (((1.0, 3.9), False), ((1.0, 4.0), True), ((1.0, 4.1), True), ((0.1, 0.41), True)):
        with_pieces(monkeypatch, steps, fitted, left)
        assert (mend_loads(RIG, dots, late) is not None) == told_late


def test_the_size_of_a_change_is_what_came_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[FloatArray] = []

    def expected(rig: Rig, changes: FloatArray) -> FloatArray:
        asked.append(changes)
        return np.zeros(len(changes))

    monkeypatch.setattr(noted_times, '_expected', expected)
    with_pieces(monkeypatch, as_steps((3000.0, 1.0)), {})
    # From the second sample on, and the last with the last.
    loads = np.zeros((1000, 3))
    loads[1:], loads[500:], loads[999:] = (1.0, 0.0, 0.0), (1.0, 2.0, 0.0), (0.0, 2.0, -5.0)
    assert mend_loads(RIG, np.zeros((1000, 4)), loads) is None
    assert asked[0].tolist() == [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-1.0, 0.0, -5.0]]


def test_loads_of_a_cell_lose_their_noise_whether_times_are_mended_or_not(monkeypatch: pytest.MonkeyPatch) -> None:
    dots, chance = np.zeros((2000, 4)), np.random.default_rng(1)
    noisy = np.where(np.arange(2000)[:, None] < 1500, 0.0, 50.0) + chance.normal(size=(2000, 3))
    with_pieces(monkeypatch, [], {})
    found = mend_loads(RIG, dots, noisy)
    assert found is not None
    assert [m.first for m in found.measured] == [0, 1500]
    assert (found.notes, found.timed, found.unused.sum(), found.unused.shape) == ((), (), 0, (2000,))
    assert np.ptp(found.loads[:1500], axis=0).tolist() == [0.0] * 3
    with_pieces(monkeypatch, as_steps((400.0, 1e-4)), {400.0: (0.4, 0.0)})
    found = mend_loads(RIG, dots, noisy)
    assert found is not None
    assert [m.first for m in found.measured] == [0, 1500]
    assert [n.hung for n in found.notes] == [0.4]
