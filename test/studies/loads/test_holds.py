# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What hung on the link instead of what was noted: every study says so alike."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from psd_deflection.records import FloatArray
from psd_deflection.rig.config import replace_values
from psd_deflection.studies.loads import holds
from psd_deflection.studies.loads.annotated_times import correct_loads, unannotated_steps
from psd_deflection.studies.loads.holds import Hold, ImpliedLoads, all_free, as_applied, wrong_notes
from test.studies.held_loads import DWELL, HELD, LEVELS, RIG, annotated_as, answers, read

QUIET = read(HELD)
TWICE = annotated_as(5, (80, -80, 40))
NEVER = annotated_as(2, (0, -20, 0))
WORDS = {
    'load_value': 'the 5th load of x was noted wrong: from 20.000 s to 24.000 s (40 N, -40 N, 20 N m) hung, not '
    '(80 N, -80 N, 40 N m): note that',
    'missing_load': 'something was hung or taken off after the 1st annotated load of x and not noted: from 8.000 s to '
    '12.000 s (0 N, -50 N, 0 N m) hung, not (0 N, -20 N, 0 N m): note that',
}


@pytest.mark.parametrize(
    ('annotated', 'name', 'where'), [(TWICE, 'load_value', 'load 5'), (NEVER, 'missing_load', '8.000 s')]
)
def test_check_calibrate_and_discover_name_load_alike(annotated: FloatArray, name: str, where: str) -> None:
    checked, run, log, discovery = answers(QUIET, annotated)
    assert [(f.name, f.where) for f in checked.findings] == [(name, where)]
    assert (_rounded(checked.findings[0].fix), checked.verdict) == (WORDS[name], 'wrong')
    assert checked.sizes == pytest.approx([1.0] * 3, abs=0.01)
    assert [_rounded(words) for words in log] == [WORDS[name]]
    assert run.loads is not None
    assert np.abs(run.loads - HELD).max(axis=0) == pytest.approx([0.0] * 3, abs=0.1)
    assert [_rounded(f.fix) for f in discovery.setup] == [WORDS[name]]


def _rounded(words: str) -> str:
    """With whole numbers of N and N m, as noise moves their decimals."""
    before, after = words.split('(', 1)
    applied, rest = after.split(')', 1)
    numbers = [cell.split(' ', 1) for cell in applied.split(', ')]
    return f'{before}({", ".join(f"{round(float(n)) + 0} {unit}" for n, unit in numbers)}){rest}'


@pytest.mark.slow
@pytest.mark.parametrize(
    'true',
    [
        {},
        {'link__youngs_modulus': 0.95 * RIG.link.youngs_modulus},
        {'effects__e__name': 'sensor_rotation', 'effects__e__psd': 1, 'effects__e__angle': 0.02},
        {'effects__e__name': 'creep', 'effects__e__amplitude': 0.03},
        {'amplifier__sensitivity': 1.03 * RIG.amplifier.sensitivity},
    ],
)
def test_no_note_is_called_wrong_for_what_the_rig_does(true: dict[str, object]) -> None:
    assert wrong_notes(RIG, read(HELD, **true), HELD) == []


@pytest.mark.slow
def test_two_wrong_notes_are_found_if_enough_others_are_right() -> None:
    both = annotated_as(5, (80, -80, 40))
    both[DWELL : 2 * DWELL] = (0, -30, 0)
    notes = wrong_notes(RIG, QUIET, both)
    assert [n.where for n in notes] == ['load 1', 'load 5']
    assert as_applied(both, notes) == pytest.approx(HELD, abs=0.1)
    assert as_applied(both, notes) is not both
    assert len(wrong_notes(RIG, QUIET[: 7 * DWELL], both[: 7 * DWELL])) == 2
    assert wrong_notes(RIG, QUIET[: 6 * DWELL], both[: 6 * DWELL]) == []
    assert len(wrong_notes(RIG, QUIET[: 6 * DWELL], TWICE[: 6 * DWELL])) == 1
    assert wrong_notes(RIG, QUIET[: 4 * DWELL], NEVER[: 4 * DWELL]) == []


LONG = np.concatenate((LEVELS[:-1], LEVELS[1:]))
"""Each load twice."""
LONG_QUIET = read(np.repeat(LONG, DWELL, axis=0))


def long_as(**annotated: tuple[float, float, float]) -> FloatArray:
    """The long row of loads with others noted: ``p5`` for that after the fifth change."""
    levels = LONG.copy()
    for name, load in annotated.items():
        levels[int(name[1:])] = load
    return np.repeat(levels, DWELL, axis=0)


@pytest.mark.slow
def test_three_wrong_notes_and_one_off_by_1_n_are_reported() -> None:
    notes = wrong_notes(RIG, LONG_QUIET, long_as(p5=(40, -80, 20), p4=(60, 0, 0), p6=(0, 0, 0)))
    assert [n.where for n in notes] == ['load 4', 'load 5', 'load 6']
    (note,) = wrong_notes(RIG, QUIET, annotated_as(4, (29, 0, 0)))
    assert note.words('x').endswith('(30 N, 0 N, 0 N m) hung, not (29 N, 0 N, 0 N m): note that')


@pytest.mark.slow
def test_unlike_load_may_be_sign_unit_or_effect() -> None:
    # The only loads along X: both other ways.
    both = annotated_as(4, (-30, 0, 0))
    both[5 * DWELL : 6 * DWELL] = (-40, -40, 20)
    assert wrong_notes(RIG, QUIET, both) == []
    # The only torque.
    only = np.array([(0, 0, 0), (0, -20, 0), (30, 0, 0), (0, -50, 0), (20, -30, 0), (0, 0, 15), (0, 0, 0)], float)
    soft = read(np.repeat(only, DWELL, axis=0), effects__e__name='torsional_stiffness', effects__e__scale=-0.1)
    assert wrong_notes(RIG, soft, np.repeat(only, DWELL, axis=0)) == []


@pytest.mark.slow
def test_nobody_is_accused_if_another_load_may_be_the_wrong_one() -> None:
    # Without the third load a link that is soft by chance would explain the fourth.
    soft = read(HELD, link__youngs_modulus=0.97 * RIG.link.youngs_modulus)
    assert wrong_notes(RIG, soft, annotated_as(4, (28.5, 0, 0))) == []
    # A fault of one reading under one load is none of the load.
    reading = QUIET.copy()
    reading[4 * DWELL : 5 * DWELL, 0] += 0.1
    assert wrong_notes(RIG, reading, HELD) == []


@pytest.mark.slow
def test_lost_samples_are_no_load() -> None:
    lost = QUIET.copy()
    lost[5 * DWELL + 1000 : 5 * DWELL + 1500] = np.nan
    (note,) = wrong_notes(RIG, lost, TWICE)
    assert note.applied == pytest.approx((40.0, -40.0, 20.0), abs=0.2)
    assert note.size == pytest.approx(40.0, abs=0.2)


ROUNDED = np.array(
    [(0, 0, 0), (0, -50, 0), (5, -10, 0), (0, -35, 0), (20, -30, 18), (0, -25, -14), (30, -50, 0), (0, 0, 0)], float
)
"""As annotated; what hung is nearly in proportion."""
OFF = np.zeros((8, 3))
OFF[1:7] = [(0, -0.36, 0), (0.48, 0.86, 0), (0, -0.21, 0), (1.3, -1.4, -0.1), (0, -0.16, -0.72), (1.03, -1.71, 0)]


def asked(off: FloatArray, annotated: FloatArray = ROUNDED, acting: FloatArray | None = None) -> bool:
    """Whether ``annotated`` loads are asked for, if the movement says that they are ``off``; all (8, 3).

    ``acting`` (n, 3): with what is simulated, if it is something else.
    """
    listed = tuple(Hold(0, i * DWELL, (i + 1) * DWELL, i, False, annotated[i]) for i in range(len(annotated)))
    moved = np.repeat(off.T * 1e-6, 10, axis=1)
    implied = ImpliedLoads(listed, off, np.zeros_like(moved), moved, moved[0], np.zeros(8), np.ones(3), 400)
    return all_free(implied, np.repeat(annotated, DWELL, axis=0) if acting is None else acting)


def test_rounded_notes_free_the_loads_exact_ones_do_not() -> None:
    assert asked(OFF)
    # What hung would be noted as another number, or the step is too coarse for so small an error.
    assert not asked(ROUNDED * 0.06)
    assert not asked(0.1 * OFF)
    # Half of it was put right before: what is left counts with that.
    half = 0.5 * OFF
    assert asked(half, ROUNDED, np.repeat(ROUNDED + half, DWELL, axis=0))
    # Numbers of no step, however small the error.
    assert not asked(0.3 * OFF, ROUNDED + 0.37 * (ROUNDED != 0.0))


def test_a_step_without_a_note_has_its_time() -> None:
    dots = read(HELD)[:, [0, 1, 3, 4]] * RIG.amplifier.sensitivity
    assert unannotated_steps(RIG, dots, annotated_as(2, (0, -20, 0))) == pytest.approx([8.0], abs=2e-3)
    assert unannotated_steps(RIG, dots, HELD) == []
    assert correct_loads(RIG, dots, annotated_as(2, (0, -20, 0))) is None


def test_an_unnoted_time_has_the_number_of_the_note_before() -> None:
    acting = np.repeat([(0.0, 0.0, 0.0), (0.0, -20.0, 0.0), (0.0, -50.0, 0.0), (0.0, 0.0, 0.0)], 2000, axis=0)
    annotated = acting.copy()
    annotated[4000:6000] = (0.0, -20.0, 0.0)
    listed = holds.find_holds(RIG, read(acting), annotated)
    assert [(p.number, p.unannotated) for p in listed] == [(0, False), (1, False), (1, True), (2, False)]
    assert [p.first for p in listed] == pytest.approx([0, 2000, 4000, 6000], abs=2)
    assert [p.last for p in listed] == pytest.approx([2000, 4000, 6000, 8000], abs=2)


def test_steps_without_a_note_are_looked_for_in_metres() -> None:
    """A volt of noise on a detector of 10 µm/V hides no step of 1 mm on one of 1 mm/V."""
    rig = replace_values(RIG, {'psd_1.sensitivity': [1e-3, 1e-3], 'psd_2.sensitivity': [1e-5, 1e-5]})
    volts, loads = np.zeros((9000, 6)), np.zeros((9000, 3))
    volts[:, 3] = np.random.default_rng(1).standard_normal(9000)
    volts[2000:, 0] += 1.0
    volts[4000:, 1] += 1.0
    loads[4000:] = 1.0
    listed = holds.find_holds(rig, volts, loads)
    assert [p.first for p in listed] == pytest.approx([0, 2000, 4000], abs=50)
    assert [(p.number, p.unannotated, p.end_unannotated) for p in listed] == [
        (0, False, True),
        (0, True, False),
        (1, False, False),
    ]
    assert len(holds.find_holds(rig, volts, loads, annotated_only=True)) == 2


VARIED = np.array(
    [(0, 0, 0), (0, -20, 0), (0, -50, 0), (0, -50, -29), (30, 0, 0), (40, -40, 20), (0, -30, 0), (20, 10, 5)], float
)
"""Annotated loads; each is like the others."""


def observed(
    more: dict[int, tuple[float, float, float]],
    annotated: FloatArray = VARIED,
    *,
    across: dict[int, float] | None = None,
    unexplained: float = 0.0,
    everywhere: FloatArray | float = 0.0,
) -> ImpliedLoads:
    """What readings say if loads are off by ``more``; ``unexplained``: share of the movement that no load explains."""
    off = np.zeros(annotated.shape) + everywhere
    for k, load in more.items():
        off[k] += load
    listed = tuple(Hold(0, i * DWELL, (i + 1) * DWELL, i, False, annotated[i]) for i in range(len(annotated)))
    moved = np.repeat((off * (1e-5, 1e-5, 1e-4)).T, 10, axis=1)
    beside = np.zeros(len(annotated))
    for k, distance in (across or {}).items():
        beside[k] = distance
    return ImpliedLoads(listed, off, unexplained * moved, moved, moved[0], beside, np.array([1e-5, 1e-5, 1e-4]), 400)


def test_load_size_is_plate_movement_at_0_1_m() -> None:
    implied = observed({1: (3.0, 4.0, 0.0), 2: (0.0, 0.0, 5.0), 3: (6.0, 0.0, 8.0)})
    assert implied.sizes[:4] == pytest.approx([0.0, 5e-5, 5e-5, 1e-4])
    assert implied.annotated.tolist() == VARIED.tolist()


@pytest.mark.parametrize(
    ('count', 'more', 'gone'),
    [
        # The others are exact: 0.6 of the tolerance, 0.3 N and a hundredth of the load, are enough.
        (8, {6: (0.0, 0.37, 0.0)}, (6,)),
        (8, {6: (0.0, 0.35, 0.0)}, ()),
        (8, {6: (0.0, 0.0, 0.37)}, (6,)),
        (8, {4: (-0.37, 0.0, 0.0), 2: (0.0, 0.5, 0.0), 6: (0.0, 1.0, 0.0)}, (2, 4, 6)),
        # Five must be right.
        (6, {2: (0.0, 1.0, 0.0)}, (2,)),
        (5, {2: (0.0, 1.0, 0.0)}, ()),
        (7, {2: (0.0, 1.0, 0.0), 1: (0.0, -2.0, 0.0)}, (1, 2)),
        (6, {2: (0.0, 1.0, 0.0), 1: (0.0, -2.0, 0.0)}, ()),
        (8, {2: (0.0, 1.0, 0.0), 1: (0.0, -2.0, 0.0), 6: (0.0, 1.0, 0.0), 4: (1.0, 0.0, 0.0)}, ()),
    ],
)
def test_wrong_loads_need_five_right_ones_beside_them(
    count: int, more: dict[int, tuple[float, float, float]], gone: tuple[int, ...]
) -> None:
    outliers = holds.outliers(observed(more, VARIED[:count]))
    assert (outliers.gone, outliers.softer) == (gone, 0.0)


def test_beside_loads_within_their_tolerance_six_must_be_right() -> None:
    for count, gone in ((7, (2,)), (6, ())):
        outliers = holds.outliers(observed({2: (0.0, 10.0, 0.0)}, VARIED[:count], everywhere=0.2))
        assert (outliers.gone, outliers.softer) == (gone, 0.0)


@pytest.mark.parametrize(('torque', 'gone'), [(2.4, (2,)), (2.6, ())])
def test_load_is_known_if_others_leave_a_twentieth_of_it(torque: float, gone: tuple[int, ...]) -> None:
    # The only torque, beside a force of 50 N: a twentieth of both is 2.503.
    annotated = VARIED * (1.0, 1.0, 0.0)
    annotated[2, 2] = torque
    assert holds.outliers(observed({2: (0.0, 1.0, 0.0)}, annotated)).gone == gone


def test_a_faulty_detector_is_no_wrong_note() -> None:
    wrong = {6: (0.0, 1.0, 0.0)}
    # A load of 1 N moves the plate by 10 um: a twentieth of that and 0.2 um are 0.7 um.
    for distance, gone in ((6.9e-7, (6,)), (-6.9e-7, (6,)), (7.1e-7, ()), (-7.1e-7, ())):
        assert holds.outliers(observed(wrong, across={6: distance})).gone == gone
    assert holds.outliers(observed(wrong, across={1: 1e-3})).gone == (6,)
    # Far beyond the tolerance no plate is asked for.
    far_off = holds.outliers(observed({6: (0.0, 10.0, 0.0)}, across={6: 1e-3}))
    assert (far_off.gone, far_off.softer) == ((6,), 0.0)
    assert not holds.closes(observed({}))
    assert holds.closes(replace(observed(wrong), rest=np.ones((3, 80)) * [[1e-3], [0.0], [2e-3]]))
    for unexplained, bent, gone in ((0.19, 0.0, (6,)), (0.21, 0.0, ()), (0.21, 0.02, (6,))):
        assert holds.outliers(observed(wrong, unexplained=unexplained), bent).gone == gone


def test_loads_are_free_if_explained_and_two_are_off() -> None:
    off = {4: (9.0, 0.0, 0.0), 5: (-9.0, 9.0, 4.0), 6: (7.0, -8.0, 0.0)}
    loads = np.repeat(VARIED, DWELL, axis=0)
    for unexplained, free in ((0.19, True), (0.21, False)):
        assert holds.all_free(observed(off, unexplained=unexplained), loads) is free
    assert holds.all_free(observed({2: (9.0, 5.0, 0.0), 3: (-9.0, 9.0, 4.0)}, VARIED[:4]), loads)
    assert not holds.all_free(observed({1: (9.0, 5.0, 0.0), 2: (-9.0, 9.0, 4.0)}, VARIED[:3]), loads)
    # Two that are off by more than the tolerance are enough.
    two = observed({5: (0.0, 0.0, 0.9), 1: (0.0, 0.0, -0.9)})
    apart = holds.deviation_in_tolerances(two, (), 0.1)
    assert sorted(apart)[-3] < 1.0 < sorted(apart)[-2]
    assert max(apart) < 2.0
    assert holds.all_free(two, loads)
    # One alone is a wrong note, and others are needed to say so.
    implied = observed({0: (0.0, 0.0, 0.6)})
    assert int((holds.deviation_in_tolerances(implied, (), 0.1) > 1.0).sum()) == 1
    assert not holds.all_free(implied, loads)


def test_rounded_loads_are_off_by_half_a_step_at_most() -> None:
    annotated = np.array(
        [(10.0, -10.0, 0.0), (0.0, -35.0, 2.0), (20.0, -30.0, 18.0), (0.0, -25.0, -14.0), (0.0, 0.0, 0.0)]
    )
    loads = np.repeat(annotated, DWELL, axis=0)

    def rounded(*off: tuple[float, float, float], count: int = 5) -> bool:
        more = np.zeros((5, 3))
        more[: len(off)] = off
        return holds.are_rounded(observed({}, annotated[:count], everywhere=more[:count]), loads)

    # Forces in steps of 5 N, torques in steps of 2 N m.
    assert rounded((2.5, 0.0, 0.0), (0.0, -2.5, 0.0), (0.0, 0.0, 1.0))
    assert not rounded((2.5, 0.0, 0.0), (0.0, -2.6, 0.0), (0.0, 0.0, 1.0))
    assert not rounded((2.5, 0.0, 0.0), (0.0, -2.5, 0.0), (0.0, 0.0, -1.1))
    assert not rounded((2.6, 0.0, 0.0), (0.0, -2.5, 0.0), (0.0, 0.0, 1.0))
    # Half a step and a hundredth.
    assert rounded((2.54, 0.0, 0.0), (0.0, -2.54, 0.0), (0.0, 0.0, 1.01))
    # What has no load is not rounded, and four must have one.
    assert rounded((2.5, 0.0, 0.0), (0.0, -2.5, 0.0), (0.0,) * 3, (0.0,) * 3, (0.0, 9.0, 0.0))
    assert rounded((2.5, 0.0, 0.0), (0.0, -2.5, 0.0), count=4)
    assert not rounded((2.5, 0.0, 0.0), (0.0, -2.5, 0.0), count=3)
    # Off by 0.5 N rms, a tenth of the step, counted by the larger of two forces: two of four by the root of a half.
    assert rounded((0.72, 0.5, 0.0), (0.5, -0.72, 0.0))
    assert not rounded((0.70, 0.5, 0.9), (0.5, -0.70, 0.9))


@pytest.mark.parametrize(('annotated', 'step'), [(VARIED, 10.0), (VARIED[:5], 10.0), (VARIED / 10.0, 1.0)])
def test_forces_may_be_rounded_if_off_by_less_than_a_step(annotated: FloatArray, step: float) -> None:
    for off, may in ((0.999, True), (-0.999, True), (1.0, False), (-1.0, False)):
        assert holds.may_be_rounded(observed({2: (0.0, off * step, 2.0 * step)}, annotated)) is may
    assert not holds.may_be_rounded(observed({}, annotated[:4]))
    # Multiples of no step, and torques alone.
    assert not holds.may_be_rounded(observed({}, annotated + 0.3))
    assert not holds.may_be_rounded(observed({}, annotated * (0.0, 0.0, 1.0) + (0.0, 0.0, step)))


def test_loads_of_which_none_held_were_not_rounded() -> None:
    """As those of a sweep."""
    none = np.zeros((0, 3))
    implied = holds.ImpliedLoads((), none, none.T, none.T, none[:, 0], none[:, 0], np.ones(3), 4)
    assert implied.annotated.shape == (0, 3)
    assert not holds.may_be_rounded(implied)
    assert not holds.all_free(implied, none)


def world(
    applied: FloatArray, annotated: FloatArray, share: FloatArray, offset: float = 0.0, bend: float = 0.0
) -> Callable[[FloatArray], ImpliedLoads]:
    """Readings under loads that ``applied``, which effects change by a ``share`` and an ``offset``; what is simulated
    more than 5 N or N m off is told ``bend`` of what is beyond it too small.
    """
    effective = applied + applied @ share + offset

    def asked(acting: FloatArray) -> ImpliedLoads:
        off = effective - acting[DWELL // 2 :: DWELL]
        off -= bend * np.sign(off) * np.maximum(np.abs(off) - 5.0, 0.0)
        return observed({}, annotated, everywhere=off)

    return asked


@pytest.mark.parametrize(
    ('wrong', 'share', 'offset', 'bend'),
    [
        ({5: (80.0, -80.0, 40.0)}, 0.0, 0.0, 0.0),
        ({5: (80.0, -80.0, 40.0)}, 0.0, 0.0, 0.1),
        ({5: (38.0, -40.0, 20.0)}, 0.0, 0.0, 0.0),
        ({2: (0.0, -5.1, 0.0), 4: (-30.0, 0.0, 0.0)}, 0.0, 0.0, 0.05),
        ({5: (60.0, -70.0, 30.0)}, 0.08, 0.2, 0.0),
    ],
)
def test_what_hung_is_what_readings_say_without_what_effects_do(
    wrong: dict[int, tuple[float, float, float]], share: float, offset: float, bend: float
) -> None:
    annotated = VARIED.copy()
    for k, load in wrong.items():
        annotated[k] = load
    slopes = share * np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.2], [0.0, 0.0, 1.0]])
    asked = world(VARIED, annotated, slopes, offset, bend)
    notes = holds.wrong_notes_against(np.repeat(annotated, DWELL, axis=0), 1e-3, asked)
    assert [n.hold.number for n in notes] == sorted(wrong)
    for note in notes:
        assert note.applied == pytest.approx(VARIED[note.hold.number], abs=0.05)
        assert note.period == 1e-3


def test_right_notes_are_right_however_nonlinear_the_simulation() -> None:
    annotated = np.clip(VARIED, -5.0, 5.0)
    annotated[2] = (0.0, -80.0, 0.0)
    asked = world(annotated, annotated, np.zeros((3, 3)), offset=0.01, bend=0.8)
    assert holds.wrong_notes_against(np.repeat(annotated, DWELL, axis=0), 1e-3, asked) == []


ONE_TORQUE = np.array(
    [(0, 0, 0), (0, -20, 0), (15, 0, 0), (24, -40, 0), (16, -20, 35), (-15, 0, 0), (0, -35, 0), (0, 0, 0)], float
)
"""The fifth is the only torque, and its change from the fourth was noted twice: (20, -30, 17.5) hung."""
APPLIED_ONCE = np.array((20.0, -30.0, 17.5))


def test_doubled_only_torque_is_the_outlier() -> None:
    more = APPLIED_ONCE - ONE_TORQUE[4]
    for allowed in ((0.0, 0.0, 0.0), (1.0, -1.5, 1.5)):
        off = tuple((more + allowed).tolist())
        assert holds.outliers(observed({4: (off[0], off[1], off[2])}, ONE_TORQUE)).gone == (4,)
    # Another torque, and half of the torque alone: another unit or stiffness may make that.
    assert holds.outliers(observed({4: (4.0, -10.0, -10.0)}, ONE_TORQUE)).gone == ()
    assert holds.outliers(observed({4: (0.0, 0.0, -17.5)}, ONE_TORQUE)).gone == ()
    # The first load that was hung: half of it may be another unit, too.
    first = ONE_TORQUE.copy()
    first[3] = 0.0
    assert holds.outliers(observed({4: (-8.0, 10.0, -17.5)}, first)).gone == ()


def test_applied_load_is_single_change_of_doubled_note() -> None:
    more = APPLIED_ONCE - ONE_TORQUE[4] + (0.2, -0.01, 0.4)
    listed = observed({4: (float(more[0]), float(more[1]), float(more[2]))}, ONE_TORQUE)
    annotated = np.repeat(ONE_TORQUE, DWELL, axis=0)

    def asked(acting: FloatArray) -> ImpliedLoads:
        held = acting[DWELL // 2 :: DWELL]
        applied = ONE_TORQUE + listed.more
        return replace(listed, more=applied - held)

    (note,) = holds.wrong_notes_against(annotated, 1e-3, asked)
    assert note.exact
    assert (note.applied.tolist(), note.where) == (APPLIED_ONCE.tolist(), 'load 4')
    words = replace(note, applied=np.array((20.126, -0.001, 17.5))).words('x')
    assert words.endswith('(20.13 N, 0 N, 17.5 N m) hung, not (16 N, -20 N, 35 N m): note that')
    # One that others are like is what the readings say.
    other = observed({3: (0.0, 5.0, 0.0)}, ONE_TORQUE)
    (free,) = holds.wrong_notes_against(
        annotated, 1e-3, lambda acting: replace(other, more=ONE_TORQUE + other.more - acting[DWELL // 2 :: DWELL])
    )
    assert not free.exact
    assert free.applied == pytest.approx((24.0, -35.0, 0.0))
