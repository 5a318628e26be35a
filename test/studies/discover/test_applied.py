# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What hung instead of what was noted, found by a search, and what the fourth reading says."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.sparse import csc_array

from psd_deflection.model.simulation.catalogue import effect_names, make_active
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.parameter_files import flat_parameters
from psd_deflection.studies.discover import recorded_rig
from psd_deflection.studies.discover.applied import directions, ringing_on, unseen
from psd_deflection.studies.discover.discover import discover, effective_loads, noise_level, refitted
from psd_deflection.studies.discover.discover import searched as doubted
from psd_deflection.studies.discover.hidden import LoadDirection, ZeroDirection, moved
from psd_deflection.studies.discover.problem import Problem
from psd_deflection.studies.discover.recorded import Recorded, compared
from psd_deflection.studies.discover.recorded_rig import RecordedRig, rig_of
from psd_deflection.studies.discover.redundant import FourthReading, excess, visible
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.screen import Candidate, Screen, SignatureBank
from psd_deflection.studies.discover.search.search import SearchResult
from psd_deflection.studies.discover.search.weighing import Unknown
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.loads.annotated_times import CorrectedNote
from psd_deflection.studies.loads.holds import Hold
from test.studies.discover.test_formulas import make_observation
from test.studies.held_loads import DWELL, HELD, LEVELS, RIG, read

ROTATED = {'effects__e__name': 'sensor_rotation', 'effects__e__psd': 1, 'effects__e__angle': 0.004}


def searched(volts: FloatArray, annotated: FloatArray) -> Discovery:
    return discover([Observation('x', RIG, volts, annotated)])


OFF = np.zeros((8, 3))
OFF[1:7] = [(0, -0.36, 0), (0.48, 0.86, 0), (0, -0.21, 0), (1.3, -1.4, -0.1), (0, -0.16, -0.72), (1.03, -1.71, 0)]


@pytest.mark.slow
def test_link_effect_blames_no_detector_or_estimate() -> None:
    discovery = searched(read(HELD, effects__e__name='bending_stiffness', effects__e__scale=-0.06), HELD)
    (effect,) = discovery.effects
    assert effect.active.effect.stage == 'link'
    assert not any('sensor' in name or 'gain' in name for name in effect.equivalent)
    assert discovery.moves == (0.0, 0.0, 0.0)
    assert 'The estimates of the pose are right without' in discovery.sentence
    assert 'is wrong by up to' not in discovery.sentence


@pytest.mark.slow
@pytest.mark.parametrize(('bending', 'torsion'), [(1.05, 1.03), (1.0, 0.97)])
def test_other_natural_frequencies_are_rig_file_lines(bending: float, torsion: float) -> None:
    true = {'dynamics__bending_frequency': 14.0 * bending, 'dynamics__torsion_frequency': 21.0 * torsion}
    discovery = searched(read(HELD, **true), HELD)
    wrong = {key: f for key, f in (('bending', bending), ('torsion', torsion)) if f != 1.0}
    assert [e.name for e in discovery.effects] == [f'{key}_frequency' for key in wrong]
    assert [e.values['error'] for e in discovery.effects] == pytest.approx([f - 1.0 for f in wrong.values()], abs=1e-5)
    assert discovery.verdict == 'effects_found'
    assert discovery.floors < 1.05
    assert discovery.setup == ()
    corrected = {f'dynamics.{key}_frequency': (14.0 if key == 'bending' else 21.0) * f for key, f in wrong.items()}
    assert discovery.values == pytest.approx(corrected, rel=1e-5)
    lines = [f'rig file: {key}: {discovery.values[key]}' for key in corrected]
    assert [words for words in discovery.lines() if words.startswith('rig file')] == lines
    again = flat_parameters(discovery.model_yaml(), Path('model.yaml'))
    assert {key: again[key] for key in corrected} == discovery.values
    assert not any(key.startswith('effects.') for key in again)
    assert 'The estimates of the pose are right without' in discovery.sentence


@pytest.mark.slow
@pytest.mark.parametrize(('late', 'angle'), [(1, 0.02), (5, 0.06)])
def test_small_delays_beside_a_rotated_detector_are_found(late: int, angle: float) -> None:
    """Neither leaves next to nothing without the other, and stiffnesses would stand in for the delay."""
    annotated = np.vstack((np.zeros((late, 3)), HELD[:-late]))
    discovery = searched(read(HELD, **{**ROTATED, 'effects__e__angle': angle}), annotated)
    assert [f.name for f in discovery.setup] == ['load_delay']
    assert discovery.setup[0].value == pytest.approx(1e-3 * late, abs=1e-5)
    assert [e.active.label for e in discovery.effects] == ['sensor_rotation (psd 1)']
    assert discovery.effects[0].active.values['angle'] == pytest.approx(angle, abs=2e-5)
    assert (discovery.verdict, discovery.unknown, discovery.law) == ('effects_found', (), None)
    assert discovery.floors < 1.05


def test_a_dot_off_for_moments_is_unseen_by_the_fourth_reading() -> None:
    """Five values of 1000 sd among 4000 of dots: 5 (25 - 1) / 4000 of what an outlier counts; sums do not count."""
    table = np.zeros((6, 1000))
    comparison = cast(Workspace, SimpleNamespace(count=[np.ones((6, 1000))], split=lambda _: [table]))
    table[0, :5] = 1000.0
    table[2] = 1e6
    excess_chi2, throughout = excess(comparison, table)
    assert (excess_chi2, throughout) == pytest.approx((5e6 - 4000.0, 5 * 25.0 / 4000.0 - 1.0))
    table[[0, 1, 3, 4]] = 5.0
    assert excess(comparison, table) == pytest.approx((24.0 * 4000.0, 24.0))
    # What is not there is no value.
    comparison.count[0][:, 500:] = 0.0
    assert excess(comparison, table) == pytest.approx((24.0 * 2000.0, 24.0))


def test_free_times_are_settled_again_if_an_effect_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    annotated = np.tile(LEVELS[0], (len(HELD), 1))
    for number, late in enumerate((0.4, 1.2, 2.1, 0.9, 1.7, 0.6, 2.6), start=1):
        annotated[number * DWELL + round(1000 * late) :] = LEVELS[number]
    machine = RecordedRig.of([Observation('x', RIG, read(HELD), annotated)], RIG, (), None, lambda _: None)
    problem = Problem.of(machine, 0, lambda _: None, np.random.default_rng(0))
    ws = machine.workspace
    assert ws.free is not None
    # As beside a lag of 0.25 ms.
    more = [(d, 1.0) for d in ws.free.directions]
    off = ws.with_loads(more).replaced(free=replace(ws.free, directions=moved(more)))
    fit = refit(off, ())
    assert off.gap(fit.difference) > 3.0 * off.floor()
    dropped = replace(problem, search=problem.search.at(off), fit=fit)
    again = refitted(dropped)
    assert again.comparison.gap(again.fit.difference) < 1.05 * off.floor()
    assert again.fit is again.null
    # If all effects hold, they were settled beside these.
    same = replace(dropped, result=SearchResult(fit, fit))
    assert refitted(same) is same
    # In three turns; if these close nothing of a gap, there are no more.
    asked = Mock(return_value=ws)
    monkeypatch.setattr(Workspace, 'refitted_beside', asked)
    monkeypatch.setattr(Workspace, 'gap', lambda self, _: 3.0 * off.floor())
    effective_loads(again)
    assert asked.call_count == 3


def test_what_rings_on_is_free_after_excluded_samples() -> None:
    volts = np.zeros((2000, 6))
    volts[500:900] = np.nan
    volts[1990:] = np.nan
    volts[100:1900, 0] = np.nan
    o = Observation('x', RIG, volts, np.zeros((2000, 3)))

    def pulses(bending: float, torsion: float) -> list[tuple[int, int]]:
        lighter = make_active('damping', {'bending_ratio': bending, 'torsion_ratio': torsion}, 'test')
        free = ringing_on(o, 0, [lighter])
        assert all(d.swings and float(d.change.sum()) == 1.0 for d in free)
        return [tuple(np.argwhere(d.change.toarray())[0].tolist()) for d in free]

    stated = RIG.dynamics.bending_damping_ratio, RIG.dynamics.torsion_damping_ratio
    assert pulses(0.51 * stated[0], 0.51 * stated[1]) == []
    # A quarter of a period of 21 Hz apart, and of 14 Hz.
    assert pulses(stated[0], 0.49 * stated[1]) == [(899, 2), (887, 2)]
    assert pulses(0.49 * stated[0], stated[1]) == [(899, 0), (881, 0), (899, 1), (881, 1)]


def test_a_motion_that_nobody_noted_changes_no_load_that_was() -> None:
    ws = Workspace([Observation('x', RIG, read(HELD), HELD)])
    change = np.zeros_like(HELD)
    change[7000, 0] = 1.0
    swings = LoadDirection(0, csc_array(change), 1.0, 'x', 0, swings=True)
    (o,) = ws.with_loads([(swings, 2.0), (swings, 1.0)]).observations
    np.testing.assert_array_equal(o.loads, HELD)
    np.testing.assert_array_equal(o.acting - o.loads, 3.0 * change)
    assert ws.with_loads([(replace(swings, swings=False), 2.0)]).observations[0].loads[7000, 0] == HELD[7000, 0] + 2.0


def test_load_time_is_unseen_in_excluded_samples() -> None:
    volts = read(HELD)
    volts[7900:9000] = np.nan
    volts[3900:4100, 0] = np.nan
    ws, nothing = Workspace([Observation('x', RIG, volts, HELD)]), csc_array(HELD.shape)
    notes = [CorrectedNote(i, (0.0, 0.0, 0.0), t, t, 0.0) for i, t in enumerate((4.0, 8.0, 12.0, 40.0), start=1)]
    assert [unseen(ws, LoadDirection(0, nothing, 1.0, n, 0)) for n in notes] == [False, True, False, False]
    assert not unseen(ws, LoadDirection(0, nothing, 1.0, 'x', 0))
    assert not unseen(ws, ZeroDirection(0, 0, 1e-6))


@pytest.mark.parametrize(('began', 'ended'), [(False, False), (True, False), (False, True), (True, True)])
def test_the_times_that_nobody_noted_are_free(began: bool, ended: bool) -> None:
    """Beside three numbers of what hung, each in a change about its own sample."""
    o = Observation('x', RIG, np.zeros((4000, 6)), np.zeros((4000, 3)))
    o.loads[1000:2500] = (3.0, -4.0, 2.0)
    ws = Workspace([o])
    free = directions(ws, [Hold(0, 1000, 2500, 1, began, o.loads[1000], ended)])
    assert [d.axis for d in free[:3]] == [0, 1, 2]
    applied = np.zeros((3, 4000, 3))
    applied[[0, 1, 2], 1000:2500, [0, 1, 2]] = 1.0
    assert [np.sign(d.change.toarray()).tolist() for d in free[:3]] == applied.tolist()
    wanted = [at for at, there in ((1000, began), (2500, ended)) if there]
    assert [int(np.abs(d.change.toarray()).sum(axis=1).argmax()) for d in free[3:]] == pytest.approx(wanted, abs=2)


def test_signatures_with_a_gap_are_not_kept() -> None:
    bank = SignatureBank()
    for lost in (0, 30):
        o = make_observation(warm=None)
        o.volts[1000 : 1000 + lost] = np.nan
        assert (RecordedRig.of([o], RIG, (), bank, lambda _: None).bank is bank) is (lost == 0)


@pytest.mark.parametrize(('share', 'there'), [(1.1, True), (0.9, False)])
def test_a_detector_is_acquitted_by_what_it_would_show(
    share: float, there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If it made a fifth of what is left, it would show twice as much as the fourth reading allows."""
    without = [name for name in effect_names() if name != 'sensor_rotation']
    machine = RecordedRig.of([make_observation(warm=None)], RIG, without, None, lambda _: None)
    ws = machine.compared()

    def rotation(screen: Screen) -> list[Candidate]:
        return [c for c in screen.candidates if c.effect.name == 'sensor_rotation' and c.start['psd'] == 1]

    (candidate,) = rotation(machine.screen(ws, None))
    least = visible(ws, machine.bank.get(candidate, ws))
    reading = cast(FourthReading, SimpleNamespace(acquits=True, allowed=3.0))
    machine = replace(machine, recorded=replace(machine.recorded, fourth=reading))
    monkeypatch.setattr(recorded_rig, 'excess', lambda ws, residual: (2.0 * 3.0 / (0.2 * share * least), 99.0))
    assert bool(rotation(machine.screen(ws, None))) is there
    # The link and the mistakes of the set-up, which touch every channel, are never acquitted.
    monkeypatch.setattr(recorded_rig, 'excess', lambda ws, residual: (1e9, 99.0))
    assert ws.first == {c.effect.name for c in machine.screen(ws, None).candidates} | {'load_delay'}


def held_for_a_second(annotated: FloatArray, more: float) -> Problem:
    """``annotated`` loads (8, 3), with ``more`` noise, of that of the rig file; no effect is looked for."""
    volts = read(np.repeat(LEVELS, 1000, axis=0))
    volts += more * RIG.noises.ravel() * np.random.default_rng(1).standard_normal(volts.shape)
    o = Observation('x', RIG, volts, np.repeat(annotated, 1000, axis=0))
    machine = RecordedRig.of([o], RIG, effect_names(), None, lambda _: None)
    return Problem.of(machine, 0, lambda _: None, np.random.default_rng(0))


def test_a_wrong_load_is_found_beside_unannotated_ones() -> None:
    """Too many loads are off to find the wrong one before the unannotated ones are excluded."""
    applied = np.concatenate([LEVELS, LEVELS[1:4]])
    annotated = applied + 5.0 * ((np.arange(11) == 3)[:, None] & (np.arange(3) == 1))
    annotated[6:] = annotated[5]
    o = Observation('x', RIG, read(np.repeat(applied, 1000, axis=0)), np.repeat(annotated, 1000, axis=0))
    recorded, _ = compared(Recorded((o,), RIG, ()))
    assert ([f.name for f in recorded.findings], [p.number for p in recorded.wrong]) == (['load_coverage'], [3])


@pytest.mark.parametrize(('floors', 'other'), [(9.5, False), (10.5, True)])
def test_all_loads_are_doubted_from_ten_floors_on(floors: float, other: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = held_for_a_second(LEVELS + OFF, 0.0)
    gap = problem.comparison.gap(problem.fit.difference)
    monkeypatch.setattr(Workspace, 'floor', lambda _: gap / floors)
    monkeypatch.setattr('psd_deflection.studies.discover.discover.SEARCH', ())
    assert bool(rig_of(doubted(problem)).recorded.wrong) is other


def test_noise_is_the_rig_files_unless_steps_or_the_unknown_make_it() -> None:
    problem = held_for_a_second(LEVELS, 2.0)
    ((finding),) = noise_level(problem).setup
    assert finding.name == 'noise_level'
    assert finding.value == pytest.approx(math.sqrt(5.0), rel=0.05)
    recorded = replace(rig_of(problem).recorded, value_grid=make_active('quantisation', {'step': 0.01}, 'test'))
    stepped = replace(rig_of(problem), recorded=recorded)
    for other in (replace(problem, machine=stepped), replace(problem, unknown=(Unknown('drifts', (), 0.5),))):
        assert noise_level(other) is other
