"""What hung on the link instead of what was noted: every study says so alike."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.calibrate.from_recordings import as_acted
from psd_deflection.studies.calibrate.observation import CalibrationRun
from psd_deflection.studies.check.checkup import check, of_recording
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.loads.noted_times import mend_loads, unnoted_steps
from psd_deflection.studies.loads.plateaus import Plateau, PlateauLoads, all_free, as_hung, wrong_notes

RIG = load_rig()
DWELL = 4000
LEVELS = np.array(
    [(0, 0, 0), (0, -20, 0), (0, -50, 0), (0, -50, -29), (30, 0, 0), (40, -40, 20), (0, -30, 0), (0, 0, 0)], float
)
HUNG = np.repeat(LEVELS, DWELL, axis=0)


def read(acting: FloatArray, **true: object) -> FloatArray:
    """What the device reads (n, 6), V, under ``acting`` loads, of a rig that differs by ``true``."""
    rig = replace_values(RIG, {name.replace('__', '.'): value for name, value in true.items()})
    return np.asarray(RigSimulator(rig, 3).step(acting).counts * RIG.converter.volts_per_count, dtype=np.float64)


def noted_as(number: int, load: tuple[float, float, float]) -> FloatArray:
    """The loads with another one in plateau ``number``."""
    out = HUNG.copy()
    out[number * DWELL : (number + 1) * DWELL] = load
    return out


QUIET = read(HUNG)
TWICE = noted_as(5, (80, -80, 40))
NEVER = noted_as(2, (0, -20, 0))
WORDS = {
    'load_value': 'the 5th load of x was noted wrong: from 20.000 s to 24.000 s (40 N, -40 N, 20 N m) hung, not '
    '(80 N, -80 N, 40 N m): note that',
    'missing_load': 'something was hung or taken off after the 1st noted load of x and not noted: from 8.000 s to '
    '12.000 s (0 N, -50 N, 0 N m) hung, not (0 N, -20 N, 0 N m): note that',
}


@pytest.mark.parametrize(
    ('noted', 'name', 'where'), [(TWICE, 'load_value', 'load 5'), (NEVER, 'missing_load', '8.000 s')]
)
def test_check_calibrate_and_discover_say_what_hung_in_the_same_words(noted: FloatArray, name: str, where: str) -> None:
    checked = check(of_recording(RIG, QUIET, noted, 'x'))
    assert [(f.name, f.where) for f in checked.findings] == [(name, where)]
    assert _rounded(checked.findings[0].fix) == WORDS[name]
    assert checked.verdict == 'wrong'
    assert checked.sizes == pytest.approx([1.0] * 3, abs=0.01)
    told: list[str] = []
    t = np.arange(len(HUNG)) / 1000.0
    run = as_acted(CalibrationRun('x', t, QUIET, np.zeros(0), np.zeros((0, 3)), noted), RIG, told.append)
    assert [_rounded(words) for words in told] == [WORDS[name]]
    assert run.loads is not None
    assert np.abs(run.loads - HUNG).max(axis=0) == pytest.approx([0.0] * 3, abs=0.1)
    found = discover([Observation('x', RIG, QUIET, noted)])
    assert [_rounded(f.fix) for f in found.setup] == [WORDS[name]]


def _rounded(words: str) -> str:
    """With whole numbers of N and N m, as noise moves their decimals."""
    before, after = words.split('(', 1)
    hung, rest = after.split(')', 1)
    numbers = [cell.split(' ', 1) for cell in hung.split(', ')]
    return f'{before}({", ".join(f"{round(float(n)) + 0} {unit}" for n, unit in numbers)}){rest}'


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
    assert wrong_notes(RIG, read(HUNG, **true), HUNG) == []


def test_two_wrong_notes_are_found_if_enough_others_are_right() -> None:
    both = noted_as(5, (80, -80, 40))
    both[DWELL : 2 * DWELL] = (0, -30, 0)
    found = wrong_notes(RIG, QUIET, both)
    assert [n.where for n in found] == ['load 1', 'load 5']
    assert as_hung(both, found) == pytest.approx(HUNG, abs=0.1)
    assert as_hung(both, found) is not both
    assert len(wrong_notes(RIG, QUIET[: 7 * DWELL], both[: 7 * DWELL])) == 2
    assert wrong_notes(RIG, QUIET[: 6 * DWELL], both[: 6 * DWELL]) == []
    assert len(wrong_notes(RIG, QUIET[: 6 * DWELL], TWICE[: 6 * DWELL])) == 1
    assert wrong_notes(RIG, QUIET[: 4 * DWELL], NEVER[: 4 * DWELL]) == []


@pytest.mark.parametrize(
    ('number', 'load'),
    [
        pytest.param(5, (40, -80, 20), id='one axis'),
        pytest.param(5, (-40, -40, 20), id='a sign'),
        pytest.param(7, (0, -50, 0), id='the last'),
        pytest.param(1, (0, -200, 0), id='ten times as much, beyond the detectors'),
        pytest.param(3, (0, -50, -290), id='a torque ten times as large'),
        pytest.param(2, (0, -5.1, 0), id='kilograms'),
    ],
)
def test_a_note_that_is_far_off_is_wrong_however_far(number: int, load: tuple[float, float, float]) -> None:
    (note,) = wrong_notes(RIG, QUIET, noted_as(number, load))
    assert note.where == f'load {number}'
    assert note.hung == pytest.approx(LEVELS[number], abs=0.1)
    assert note.size == pytest.approx(np.abs(LEVELS[number] - load).max(), abs=0.1)


LONG = np.concatenate((LEVELS[:-1], LEVELS[1:]))
"""Each load twice."""
LONG_QUIET = read(np.repeat(LONG, DWELL, axis=0))


def long_as(**noted: tuple[float, float, float]) -> FloatArray:
    """The long row of loads with others noted: ``p5`` for that after the fifth change."""
    levels = LONG.copy()
    for name, load in noted.items():
        levels[int(name[1:])] = load
    return np.repeat(levels, DWELL, axis=0)


def test_of_loads_that_follow_each_other_both_are_found() -> None:
    found = wrong_notes(RIG, LONG_QUIET, long_as(p4=(0, 0, 0), p5=(40, -80, 20)))
    assert [n.where for n in found] == ['load 4', 'load 5']


def test_three_that_are_wrong_and_one_that_is_off_by_a_newton_are_found_if_all_others_are_exact() -> None:
    found = wrong_notes(RIG, LONG_QUIET, long_as(p5=(40, -80, 20), p4=(60, 0, 0), p6=(0, 0, 0)))
    assert [n.where for n in found] == ['load 4', 'load 5', 'load 6']
    (note,) = wrong_notes(RIG, QUIET, noted_as(4, (29, 0, 0)))
    assert note.words('x').endswith('(30 N, 0 N, 0 N m) hung, not (29 N, 0 N, 0 N m): note that')


def test_a_load_that_no_other_is_like_may_be_a_sign_a_unit_or_an_effect() -> None:
    # The only loads along X: both other ways.
    both = noted_as(4, (-30, 0, 0))
    both[5 * DWELL : 6 * DWELL] = (-40, -40, 20)
    assert wrong_notes(RIG, QUIET, both) == []
    # The only torque.
    only = np.array([(0, 0, 0), (0, -20, 0), (30, 0, 0), (0, -50, 0), (20, -30, 0), (0, 0, 15), (0, 0, 0)], float)
    soft = read(np.repeat(only, DWELL, axis=0), effects__e__name='torsional_stiffness', effects__e__scale=-0.1)
    assert wrong_notes(RIG, soft, np.repeat(only, DWELL, axis=0)) == []


def test_nobody_is_accused_if_another_load_may_be_the_wrong_one() -> None:
    # Without the third load a link that is soft by chance would explain the fourth.
    soft = read(HUNG, link__youngs_modulus=0.97 * RIG.link.youngs_modulus)
    assert wrong_notes(RIG, soft, noted_as(4, (28.5, 0, 0))) == []
    # A fault of one reading under one load is none of the load.
    reading = QUIET.copy()
    reading[4 * DWELL : 5 * DWELL, 0] += 0.1
    assert wrong_notes(RIG, reading, HUNG) == []


def test_beside_an_effect_what_hung_is_told_as_if_there_were_none() -> None:
    soft = read(np.repeat(LONG, DWELL, axis=0), link__youngs_modulus=0.95 * RIG.link.youngs_modulus)
    (note,) = wrong_notes(RIG, soft, long_as(p5=(40, -80, 20)))
    assert note.where == 'load 5'
    assert note.hung == pytest.approx((40.0, -40.0, 20.0), abs=0.3)


def test_lost_samples_are_no_load() -> None:
    lost = QUIET.copy()
    lost[5 * DWELL + 1000 : 5 * DWELL + 1500] = np.nan
    (note,) = wrong_notes(RIG, lost, TWICE)
    assert note.hung == pytest.approx((40.0, -40.0, 20.0), abs=0.2)
    assert note.size == pytest.approx(40.0, abs=0.2)


ROUNDED = np.array(
    [(0, 0, 0), (0, -50, 0), (5, -10, 0), (0, -35, 0), (20, -30, 18), (0, -25, -14), (30, -50, 0), (0, 0, 0)], float
)
"""As noted; what hung is nearly in proportion."""
OFF = np.zeros((8, 3))
OFF[1:7] = [(0, -0.36, 0), (0.48, 0.86, 0), (0, -0.21, 0), (1.3, -1.4, -0.1), (0, -0.16, -0.72), (1.03, -1.71, 0)]


def asked(off: FloatArray, noted: FloatArray = ROUNDED, acting: FloatArray | None = None) -> bool:
    """Whether ``noted`` loads are asked for, if the movement says that they are ``off``; all (8, 3).

    ``acting`` (n, 3): with what is simulated, if it is something else.
    """
    listed = tuple(Plateau(0, i * DWELL, (i + 1) * DWELL, i, False, noted[i]) for i in range(len(noted)))
    moved = np.repeat(off.T * 1e-6, 10, axis=1)
    found = PlateauLoads(listed, off, np.zeros_like(moved), moved, np.zeros(8), np.ones(3))
    return all_free(found, np.repeat(noted, DWELL, axis=0) if acting is None else acting)


def test_loads_are_asked_for_if_what_hung_rounds_to_the_notes_and_not_if_it_is_far_nearer_or_farther() -> None:
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
    dots = read(HUNG)[:, [0, 1, 3, 4]] * RIG.amplifier.sensitivity
    assert unnoted_steps(RIG, dots, noted_as(2, (0, -20, 0))) == pytest.approx([8.0], abs=2e-3)
    assert unnoted_steps(RIG, dots, HUNG) == []
    assert mend_loads(RIG, dots, noted_as(2, (0, -20, 0))) is None
