# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whole searches: discover names what was hidden, mistakes of the set-up and laws; nothing where nothing was."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import jsonschema
import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.cli.main import main
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import FOLDERS, effect_names, effects_of_rig, make_active, with_effects
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.law_files import read_law
from psd_deflection.model.simulation.laws import Law, LawTerm, effect_of, law_text, values_of
from psd_deflection.model.simulation.simulator import ForwardModel, RigSimulator
from psd_deflection.plants import Effect, EffectParameter, Model, Plant, plant_effect
from psd_deflection.recordings.observation import Observation, read_observation
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import rig_at_end
from psd_deflection.records import FloatArray, ParameterChange
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.rig.declarations import DESCRIPTION
from psd_deflection.rig.parameter_files import read_parameter_file
from psd_deflection.studies.check.result import NAMES, Finding
from psd_deflection.studies.discover.cleaning import clean, outliers
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.hidden import RIG_NUMBERS
from psd_deflection.studies.discover.laws import find_jitter, find_law
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.screen import SignatureBank, solve_observable
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import correct_wiring, likely_delays, likely_jumps
from psd_deflection.studies.study import described

from .test_formulas import make_observation

SCHEMA = json.loads((Path(__file__).parents[2] / 'data' / 'result.schema.json').read_text())
SHARED_SCHEMA = Path(__file__).parents[4] / 'shared' / 'checks' / 'result.schema.json'
RIG, HISTORY = load_rig(), loads.identification()
WARM = 21.0 + 2.0 * np.sin(np.linspace(0.0, 5.0, len(HISTORY)))
BANK = SignatureBank()
NEAR = (
    *('bending_stiffness', 'clamp_bending_compliance', 'load_direction', 'tip_mass', 'damping', 'sensor_rotation'),
    *('axis_crosstalk', 'sensor_gain', 'plane_tilt', 'mains_interference', 'amplifier_lag', 'channel_skew'),
)
"""What might stand in for a turned sensor, a softer link or hum."""


def observe(rig: Rig, seed: int = 0, known: Rig = RIG, history: FloatArray = HISTORY.loads) -> Observation:
    counts = RigSimulator(rig, seed).step(history, WARM[: len(history)]).counts
    volts = counts.astype(np.float64) * rig.converter.volts_per_count
    return Observation('test', known, volts, history, WARM[: len(history)])


def with_effect(name: str, **values: object) -> Rig:
    return replace_values(RIG, {'effects.e.name': name, **{f'effects.e.{k}': v for k, v in values.items()}})


@pytest.fixture(scope='module')
def rotated() -> Discovery:
    return discover([observe(with_effect('sensor_rotation', psd=2, angle=0.002))], RIG, bank=BANK)


@pytest.mark.slow
def test_nothing_missing_is_the_answer_to_noise() -> None:
    discovery = discover([observe(RIG, seed=7)], RIG, bank=BANK)
    assert (discovery.verdict, discovery.effects) == ('nothing_missing', ())
    assert discovery.gap_after == pytest.approx(discovery.gap_floor, rel=0.05)
    assert discovery.sentence.startswith('Nothing is missing')


@pytest.mark.slow
def test_the_hidden_effect_is_named_with_its_size(rotated: Discovery) -> None:
    assert rotated.verdict == 'effects_found'
    (effect,) = rotated.effects
    assert (effect.active.effect.name, effect.active.values['psd']) == ('sensor_rotation', 2)
    assert abs(effect.active.values['angle'] - 0.002) < 4 * effect.sd['angle']
    assert effect.sd['angle'] < 2e-5
    assert rotated.gap_before > 4 * rotated.gap_after
    assert rotated.gap_heldout_after < 1.05 * rotated.gap_floor
    assert rotated.simulations < 2000


def test_where_is_the_turned_sensor(rotated: Discovery) -> None:
    assert {c.channel for c in rotated.where.cells[:5]} <= {'x2', 'y2'}
    assert rotated.where.cells[0].p < 1e-6
    assert 'dot_position' in rotated.where.cells[0].depends_on


def test_the_model_closes_the_gap_on_new_data(rotated: Discovery, tmp_path: Path) -> None:
    path = tmp_path / 'model.yaml'
    path.write_text(described(RIG, rotated.active_effects))
    model = load_rig(path)
    assert (model.values, [a.effect.name for a in effects_of_rig(model)]) == (RIG.values, ['sensor_rotation'])
    observed = observe(with_effect('sensor_rotation', psd=2, angle=0.002), seed=9, known=model)
    again = discover([observed], model, without=[n for n in effect_names() if n not in NEAR])
    assert again.verdict == 'nothing_missing'


def check_schema(tree: dict[str, Any]) -> None:
    """The conditions on result.json; and that it is JSON without NaN."""
    jsonschema.validate(json.loads(json.dumps(tree, allow_nan=False)), SCHEMA)


@pytest.mark.slow
def test_result_keeps_to_the_contract_and_to_json(rotated: Discovery) -> None:
    tree = rotated.rehearse(2).tree()
    assert (tree['rehearsal']['again'], tree['rehearsal']['failed']) == (2, 0)
    check_schema(tree)
    assert json.loads(json.dumps(tree, allow_nan=False)) == tree


@pytest.mark.slow
def test_what_one_load_shows_is_unknown_on_unseen_loads() -> None:
    study = discover([observe(with_effect('amplifier_saturation', limit=8.48, sums=0))], RIG, bank=BANK)
    assert (study.gap_heldout_after, study.gap_after) == pytest.approx((study.gap_before, study.gap_floor), rel=0.02)


@pytest.mark.slow
def test_a_parameter_stays_where_the_rig_lets_it() -> None:
    workspace = Workspace([observe(RIG)])
    ambient = make_active('ambient_light', {'psd': 2, 'level': 0.01, 'x': 0.4, 'y': 0.0}, 'test')
    fit = refit(workspace, [ambient], iterations=1)
    assert fit.effects[0].values['x'] <= 0.5 * RIG.psds[1].active_area[0]


@pytest.mark.slow
def test_directions_that_cannot_be_observed_are_left_alone() -> None:
    fisher = np.array([[1.0, 1.0], [1.0, 1.0]])
    gain, rank, c = solve_observable(fisher, np.array([2.0, 2.0]), np.diag(fisher))
    assert rank == 1
    assert gain == pytest.approx(4.0)
    np.testing.assert_allclose(c, [1.0, 1.0])


def simulate(tmp_path: Path, *words: str) -> Path:
    out = tmp_path / 'seen.csv'
    assert main(['simulate', '--out', str(out), *words]) == 0
    return out


def test_from_simulate_to_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded = simulate(
        tmp_path, '--loads', 'thesis:1.5', '--effect', 'sensor_gain,psd=1,x=0.004,y=0.003', '--reference'
    )
    out = tmp_path / 'out'
    assert main(['discover', str(recorded), '--out', str(out), '--quiet']) == 0
    assert 'sensor_gain (psd 1) is missing' in capsys.readouterr().out
    tree = json.loads((out / 'result.json').read_text())
    check_schema(tree)
    assert tree['provenance']['forward_simulations'] <= 2000
    page = (out / 'report.html').read_text()
    assert (page.count('<figure class="chart"'), page.count('<svg class="matrix"')) == (3, 1)
    model = out / 'model.yaml'
    # Without a file of the user it describes the rig, and not the machine that recorded.
    assert set(read_parameter_file(model)) == {*DESCRIPTION, *(k for k in load_rig(model).flat() if 'effects.' in k)}
    model.write_text('# The rig as of Monday.\n' + model.read_text())
    assert main(['discover', str(recorded), '--params-file', str(model), '--out', str(out), '--quiet']) == 0
    assert 'Nothing is missing' in capsys.readouterr().out
    assert model.read_text().startswith('# The rig as of Monday.\n')
    assert [a.effect.name for a in effects_of_rig(load_rig(model))] == ['sensor_gain']


@pytest.mark.slow
@pytest.mark.parametrize(
    ('effect', 'wrong'), [('sensor_rotation,psd=1,angle=0.02', True), ('amplifier_lag,time_constant=2e-4', False)]
)
def test_estimate_error_is_change_by_model_in_replay(effect: str, wrong: bool, tmp_path: Path) -> None:
    assert main(['simulate', '--out', str(tmp_path / 'a'), '--loads', 'thesis:1', '--effect', effect]) == 0
    discovery = psd_deflection.discover([tmp_path / 'a'])
    (tmp_path / 'model.yaml').write_text(discovery.model_yaml())
    without, corrected = (psd_deflection.replay(tmp_path / 'a', rig) for rig in (None, tmp_path / 'model.yaml'))
    changed = [float(np.abs(getattr(corrected, axis) - getattr(without, axis)).max()) for axis in ('dx', 'dy', 'theta')]
    # An estimate is of a moment; this is of the mean of a block, in which the link may swing.
    assert discovery.moves == pytest.approx(changed, rel=0.2, abs=1e-12)
    assert ('Without it an estimate is wrong by up to' in discovery.sentence) is wrong
    assert ('An estimate is not corrected for amplifier_lag.' in discovery.sentence) is not wrong


@pytest.mark.slow
def test_a_bag_reports_its_own_rig_but_not_what_was_hidden(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = tmp_path / 'short.yaml'
    short.write_text(described(replace_values(RIG, {'link.length': 0.4}), ()))
    words = ['--params-file', str(short), '--loads', 'thesis:1', '--effect', 'sensor_rotation,psd=1,angle=0.003']
    assert main(['simulate', '--out', str(tmp_path / 'run'), *words]) == 0
    assert main(['discover', str(tmp_path / 'run'), '--out', str(tmp_path / 'found'), '--quiet']) == 0
    assert 'sensor_rotation (psd 1) is missing' in capsys.readouterr().out
    assert load_rig(tmp_path / 'found' / 'model.yaml').link.length == 0.4
    discovery = psd_deflection.discover([tmp_path / 'run'], tmp_path / 'found' / 'model.yaml')
    assert discovery.verdict == 'nothing_missing'


@pytest.mark.slow
def test_a_zero_taken_while_it_ran_is_part_of_the_rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert main(['simulate', '--out', str(tmp_path / 'run'), '--loads', 'thesis:0.5']) == 0
    recording = open_recording(tmp_path / 'run')
    later = ParameterChange(0, 3, (('psd_2.zero', (1e-4, -2e-4)), ('environment.temperature', 22.0)))
    monkeypatch.setattr(recording, 'changes', [later])
    assert rig_at_end(recording).zeros.tolist() == [[0.0, 0.0], [1e-4, -2e-4]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ('listed', 'message'),
    [
        ('{}', 'must be a list'),
        ('- {rec: a.csv}', 'must have "recording: FILE"'),
        ('- {recording: seen.csv, overrides: 3}', 'must be a map'),
        ('- {recording: seen.csv, length: 3}', 'only recording and overrides'),
        ('- {recording: seen.csv, overrides: {link.lenght: 0.4}}', 'did you mean link.length'),
        ('- {recording: gone.csv}', 'no such recording'),
        ('- [', 'malformed YAML'),
    ],
)
def test_a_bad_list_is_rejected_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], listed: str, message: str
) -> None:
    simulate(tmp_path, '--loads', 'constant:0,0,0:1')
    path = tmp_path / 'list.yaml'
    path.write_text(listed)
    assert main(['discover', str(path), '--out', str(tmp_path / 'out'), '--quiet']) in (3, 4)
    assert message in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        *((['--loads', 'thesis:0'], 'above 0'), (['--loads', 'constant:1,2:3'], 'must be 3 numbers')),
        *((['--loads', 'chirp:1,0,0:1,900:3'], 'below 500 Hz'), (['--loads', 'up and down'], 'not a load history')),
        (['--effect', 'sensor_gain,psd'], 'not KEY=VALUE'),
        (['--effect', 'sensor_gian,psd=1'], 'did you mean sensor_gain'),
        (['--temperature', 'warm'], 'not a list of numbers'),
    ],
)
def test_bad_words_of_simulate_are_rejected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(['simulate', '--out', str(tmp_path / 'x.csv'), *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_finding_has_a_name_that_other_programs_know() -> None:
    assert set(NAMES) <= set(SCHEMA['properties']['setup']['items']['properties']['name']['enum'])
    with pytest.raises(ValueError, match='load_size: must be one of channel_sign'):
        Finding('load_size', 'load 3', None, '')


@pytest.mark.slow
@pytest.mark.skipif(not SHARED_SCHEMA.is_file(), reason='the schema is not beside the checkout')
def test_the_schema_is_that_of_other_programs() -> None:
    assert json.loads(SHARED_SCHEMA.read_text()) == SCHEMA


LAW_HISTORY = loads.identification().loads
LAW_WARM = 21.0 + 2.0 * np.sin(np.linspace(0.0, 5.0, len(LAW_HISTORY)))


def workspace(law: Law | None, seed: int = 0, count: int = len(LAW_HISTORY)) -> Workspace:
    active = [] if law is None else [ActiveEffect(effect_of(law), values_of(law))]
    model = ForwardModel(RIG, active)
    history, warm = LAW_HISTORY[:count], LAW_WARM[:count]
    samples = model.run(history, warm)
    samples.volts += RIG.noises.ravel()[:, None] * np.random.default_rng(seed).standard_normal(samples.volts.shape)
    model.finish(samples)
    return Workspace([Observation('test', RIG, samples.volts.T.copy(), history, warm)])


def test_there_is_no_law_in_noise() -> None:
    ws = Workspace([make_observation(3)])
    null = refit(ws, ())
    assert find_law(ws, null, null, float(np.log(ws.effective_size())), 0.0, print) is None
    assert find_jitter(ws, null, float(np.log(ws.effective_size()))) is None


@pytest.mark.slow
def test_law_is_adopted_and_explains_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs, ours = tmp_path / 'theirs', tmp_path / 'ours'
    theirs.mkdir()
    ours.mkdir()
    hidden = Law('base_moves', 'psd', 'y2', (LawTerm('product', ('load_fx', 'load_fx'), 3e-9),))
    (theirs / 'base_moves.yaml').write_text(law_text(hidden))
    monkeypatch.setenv(FOLDERS, str(theirs))
    run, out = str(tmp_path / 'run'), tmp_path / 'found'
    steps = 'steps:0,0,0;10,0,5;-20,10,0;30,-20,-5;-10,-30,10;20,0,-10;0,0,0:1'
    assert main(['simulate', '--out', run, '--loads', steps, '--effect', 'base_moves,c1=3e-9']) == 0
    monkeypatch.setenv(FOLDERS, str(ours))
    # The whole catalogue takes its time, and the blind suite has it.
    few = [name for name in effect_names() if name not in ('sensor_gain', 'sensor_rotation', 'bending_stiffness')]
    without = [word for name in few for word in ('--without', name)]
    assert main(['discover', run, '--out', str(out), '--adopt', 'yielding', '--quiet', *without]) == 0
    reported = json.loads((out / 'result.json').read_text())
    jsonschema.validate(reported, SCHEMA)
    law = reported['unknown'][0]['law']
    assert (reported['verdict'], law['stage'], law['kind']) == ('unknown_effect', 'psd', 'static')
    assert (law['variables'], law['channels']) == (['load_fx'], ['y2'])
    assert law['heldout_after'] < 1.05 * reported['gap']['floor']
    assert 'A law for it' in (out / 'report.html').read_text()
    assert 'yielding' in effect_names()
    adopted = read_law(ours / 'yielding.yaml')
    assert adopted.terms[0].coefficient == pytest.approx(3e-9, rel=0.05)
    (active,) = effects_of_rig(load_rig(out / 'model.yaml'))
    assert active.effect.name == 'yielding'
    assert main(['discover', run, '--out', str(out), '--adopt', 'yielding', '--quiet']) == 2
    assert main(['discover', run, '--out', str(out), '--adopt', 'a b', '--quiet']) == 2


def test_noise_beside_a_movement_is_no_law() -> None:
    ws = workspace(Law('shaky', 'electronics', 'y2', (LawTerm('jitter', ('load_fy',), 5e-8),)))
    null, penalty = refit(ws, ()), float(np.log(ws.effective_size()))
    assert find_jitter(ws, null, penalty) is not None
    moved = workspace(Law('odd', 'psd', 'x1', (LawTerm('product', ('load_fy', 'load_fy'), 1e-8),)))
    # The same noise, with means of blocks that no noise explains, or of which this one makes a small part.
    odd = refit(moved, ()).difference
    for floors in (10.0, 1.8):
        share = floors * ws.floor() / ws.gap(odd)
        difference = [a + share * b for a, b in zip(null.difference, odd, strict=True)]
        assert find_jitter(ws, dataclasses.replace(null, difference=difference), penalty) is None


def test_law_with_large_held_out_gap_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDERS, str(tmp_path))
    ws = workspace(Law('odd', 'psd', 'y2', (LawTerm('product', ('load_fx', 'load_fx'), 3e-9),)))
    null = refit(ws, ())
    law = find_law(ws, null, null, float(np.log(ws.effective_size())), 0.0, print)
    assert law is not None
    nothing: dict[str, Any] = dict.fromkeys(f.name for f in dataclasses.fields(Discovery))
    without = Discovery(**{**nothing, 'gap_floor': ws.floor(), 'adopted': ''})
    assert without.adopt('none') is without
    for floors, written in ((1.9, True), (2.1, False)):
        concluded = dataclasses.replace(without, law=dataclasses.replace(law, heldout_gap=floors * ws.floor()))
        assert (concluded.model_of_law is not None) == written
        assert concluded.adopt(name := f'odd{written}').adopted == name
        assert (tmp_path / f'{name}.yaml').exists() == written


STIFFNESS = plant_effect('stiffness', EffectParameter('scale', '', -0.9, 9.0, 0.1, 'of k'))
CUBIC = plant_effect('cubic', EffectParameter('c', 'N/mm^3', -9.0, 9.0, 0.1, 'of u^3'), equation='F += c u^3')
SQUARE = plant_effect('square', EffectParameter('c', 'N/mm^2', -9.0, 9.0, 0.1, 'of u^2'))
LIMIT = plant_effect(
    'limit', EffectParameter('force', 'N', 0.1, 99.0, 0.5, 'greatest', nominal=99.0, grid=(0.5, 1.0)), finite=True
)
NOISE = 0.01


class Spring(Plant):
    """F = k u + c u^3, of which the model has no c, and a temperature that rises with F; six pulls."""

    channels: tuple[str, ...] = ('force',)
    units: tuple[str, ...] = ('N',)
    cases = tuple('abcdef')
    library: tuple[Effect, ...] = (STIFFNESS, CUBIC, SQUARE, LIMIT)

    def __init__(self, c: float, k: float = 1.0, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.u = [np.linspace(-1, 1, 50) * (1 + 0.2 * i) for i in range(6)]
        self.observed = [(k * u + c * u**3 + NOISE * rng.standard_normal(50))[None, :] for u in self.u]

    def measured(self) -> list[FloatArray]:
        return self.observed

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        return {'u': self.u}

    def simulate(self, model: Model) -> list[FloatArray]:
        k = 1.0 + model.get('stiffness', {'scale': 0.0})['scale']
        c = model.get('cubic', {'c': 0.0})['c']
        square = model.get('square', {'c': 0.0})['c']
        limit = model.get('limit', {'force': 99.0})['force']
        return [np.clip(k * u + c * u**3 + square * u**2, -limit, limit)[None, :] for u in self.u]


@pytest.mark.slow
def test_a_limit_that_is_not_reached_at_first_is_found() -> None:
    plant = Spring(0.0)
    plant.observed = [np.clip(rows, -1.3, 1.3) for rows in plant.observed]
    (limit,) = psd_deflection.discover_in(plant).effects
    assert limit.active.values['force'] == pytest.approx(1.3, abs=0.01)


@pytest.mark.slow
def test_the_covariance_of_the_sizes_is_that_of_least_squares() -> None:
    plant = Spring(0.3, k=1.05)
    tree = psd_deflection.discover_in(plant).tree()
    names, matrix = tree['covariance']['names'], np.array(tree['covariance']['matrix'])
    terms = {'stiffness.scale': np.concatenate(plant.u), 'cubic.c': np.concatenate(plant.u) ** 3}
    assert sorted(names) == sorted(terms)
    design = np.stack([terms[name] for name in names], axis=1)
    expected = NOISE**2 * np.linalg.inv(design.T @ design)
    # The level of what remains is fitted, from few cases: the same matrix, and no smaller.
    scale = float(matrix[0, 0] / expected[0, 0])
    assert 1.0 < scale < 3.0
    np.testing.assert_allclose(matrix, scale * expected, rtol=0.02)
    reported = [e['parameters'][p]['sd'] for e in tree['effects'] for p in e['parameters']]
    assert np.sqrt(np.diag(matrix)).tolist() == pytest.approx(reported)


@pytest.mark.slow
@pytest.mark.repeatable
def test_the_answer_is_the_same_again() -> None:
    first, second = (psd_deflection.discover_in(Spring(0.1), seed=3).tree() for _ in range(2))
    assert first == second


@pytest.mark.slow
@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'cases': ()}, 'cases: there is none'),
        ({'units': ()}, 'units: 0 of them for 1 channels'),
        ({'noise': (0.0,)}, r'noise = \(0.0,\): must be one number above 0'),
        ({'library': (CUBIC, CUBIC)}, 'cubic is there twice'),
        ({'nuisance': (CUBIC,)}, 'cubic is there twice'),
        ({'observed': [np.zeros((2, 5))] * 6}, r'measured, a: has the shape \(2, 5\): must be \(1, n\)'),
        ({'observed': [np.full((1, 5), math.nan)] * 6}, 'force has 0 values in all'),
        ({'observed': [np.zeros((1, 5))] * 6}, r'simulate, a: has the shape \(1, 50\): must be that of measured'),
        ({'u': [np.full(50, math.nan)] * 6}, 'simulate, a: not finite with'),
        ({'observed': [np.zeros((1, 50))] * 5}, 'measured: 5 tables for 6 cases'),
    ],
)
def test_a_plant_that_contradicts_itself_is_rejected(change: Mapping[str, object], words: str) -> None:
    plant = Spring(0.3)
    for name, value in change.items():
        setattr(plant, name, value)
    if change.get('cases') == ():
        plant.observed = []
    with pytest.raises(ConfigError, match=words):
        psd_deflection.discover_in(plant)


PUSHES = [(0.0, -40.0, -15.0), (0.0, -40.0, 0.0), (25.0, 0.0, 0.0), (0.0, 15.0, 20.0)]
SET_UP = loads.steps([(0.0, 0.0, 0.0), *PUSHES, (0.0, 0.0, 0.0)], 1.0).loads


def recorded(seed: int = 0, **true: object) -> Observation:
    """A recording of a rig that differs by ``true`` from the rig file, which stays the nominal one."""
    rig = replace_values(RIG, {name.replace('__', '.'): value for name, value in true.items()})
    counts = RigSimulator(rig, seed).step(SET_UP).counts
    return Observation('seen', RIG, counts.astype(np.float64) * RIG.converter.volts_per_count, SET_UP.copy())


def changed(o: Observation, change: Callable[[FloatArray], FloatArray]) -> Observation:
    return dataclasses.replace(o, volts=change(o.volts.copy()))


def loaded(o: Observation, *factors: float) -> Observation:
    return dataclasses.replace(o, loads=o.loads * np.array(factors))


def reversed_signs(*channels: int) -> Callable[[FloatArray], FloatArray]:
    signs = np.ones(6)
    signs[list(channels)] = -1.0
    return lambda volts: volts * signs


def ordered(*columns: int) -> Callable[[FloatArray], FloatArray]:
    return lambda volts: volts[:, list(columns)]


def in_unit(loads: str, factor: float, units: str) -> list[tuple[str, str, float, str]]:
    columns = ' '.join(f'load_{name}' for name in loads.split())
    words = f'multiply {columns} in the recording by {factor:g}: it is noted in {units}'
    return [('load_unit', loads, factor, words)]


@pytest.mark.parametrize(
    ('mistake', 'named'),
    [
        (lambda o: o, []),
        (lambda o: changed(o, reversed_signs(1)), [('channel_sign', 'y1', -1.0, 'psd_1.axes: [x, -y]')]),
        (lambda o: changed(o, reversed_signs(3)), [('channel_sign', 'x2', -1.0, "psd_2.axes: [-x, 'y']")]),
        (lambda o: changed(o, ordered(1, 0, 2, 3, 4, 5)), [('axis_swap', 'psd_1', None, "psd_1.axes: ['y', x]")]),
        (lambda o: changed(o, ordered(3, 4, 5, 0, 1, 2)), [('psd_swap', 'psd_1 psd_2', None, 'psds_exchanged: true')]),
        (lambda o: loaded(o, 1.0, -1.0, 1.0), [('load_sign', 'fy', -1.0, 'turn the sign of load_fy in the recording')]),
        (lambda o: loaded(o, 1.0, 1.0, -1.0), [('load_sign', 'tz', -1.0, 'turn the sign of load_tz in the recording')]),
        (lambda o: loaded(o, 1 / 9.80665, 1 / 9.80665, 1.0), in_unit('fx fy', 9.80665, 'kg instead of N')),
        (lambda o: loaded(o, 1.0, 1.0, 1e3), in_unit('tz', 1e-3, 'N mm instead of N m')),
    ],
)
def test_wiring_signs_and_units_are_put_right(
    mistake: Callable[[Observation], Observation], named: list[tuple[str, str, float | None, str]]
) -> None:
    o = recorded()
    wrong = mistake(o)
    (corrected,), findings, lines = correct_wiring([wrong], ())
    assert [(f.name, f.where, f.value, f.fix) for f in findings] == named
    np.testing.assert_array_equal(corrected.volts, o.volts)
    np.testing.assert_allclose(corrected.loads, o.loads, rtol=1e-9)
    # The lines alone wire the rig file right.
    assert replace_values(RIG, lines).values == corrected.rig.values


@pytest.mark.slow
def test_alike_units_differ_where_movement_is_nonlinear() -> None:
    """50 N at the end of a bar: what moves in proportion to the load is 1 % off, and the units are 2 % apart."""
    loads = np.repeat([(0, 0, 0), (0, -50, -29.25), (0, 0, 0)], 2000, axis=0).astype(np.float64)
    volts = np.asarray(RigSimulator(RIG, 1).step(loads).counts * RIG.converter.volts_per_count, dtype=np.float64)
    for factor in (9.80665e-3, 1e-2):
        annotated = np.asarray(loads / (1.0, 1.0, factor), dtype=np.float64)
        _, findings, _ = correct_wiring([Observation('x', RIG, volts, annotated)], ())
        assert [(f.where, f.value) for f in findings] == [('tz', factor)]


def test_a_soft_or_stiff_link_is_no_other_unit() -> None:
    for modulus in (6.9e11, 6.9e9, 7.2e10, 5e10):
        _, findings, _ = correct_wiring([recorded(link__youngs_modulus=modulus)], ())
        assert findings == []


SET_UP_NEAR = (
    *('load_direction', 'bending_stiffness', 'torsional_stiffness', 'damping', 'creep', 'sensor_rotation'),
    *('sensor_gain', 'sensor_position', 'amplifier_lag', 'channel_skew'),
)
"""What might stand in for a mistake of the set-up. The rest of the catalogue takes time and tells nothing more."""


def found_in(*observations: Observation, full: bool = False) -> Discovery:
    discovery = discover(observations, RIG, without=() if full else [n for n in effect_names() if n not in SET_UP_NEAR])
    tree = discovery.tree()
    assert json.loads(json.dumps(tree, allow_nan=False)) == tree
    return discovery


@pytest.mark.slow
@pytest.mark.parametrize(
    ('seed', 'words'),
    [
        (111, ['sensor_rotation,psd=2,angle=0.004', 'creep,amplitude=0.004,time_constant=5']),
        (112, ['sensor_rotation,psd=2,angle=0.01', 'sensor_gain,psd=1,x=0.01']),
    ],
)
def test_like_numbers_of_unlike_quantities_are_two_effects(seed: int, words: list[str]) -> None:
    discovery = found_in(observe(with_effects(RIG, words, 'test'), seed))
    assert sorted(e.name for e in discovery.effects) == sorted(word.split(',')[0] for word in words)
    assert (discovery.verdict, 'tied' in discovery.sentence) == ('effects_found', False)


@pytest.mark.slow
@pytest.mark.parametrize('hertz', [5.0, 33.0, 60.0, 180.0])
def test_ringing_that_nothing_explains_is_no_noise(hertz: float) -> None:
    o, since = recorded(4), np.maximum(np.arange(len(SET_UP)) - 1000, 0) % 1000 / 1000.0
    ringing = 2e-5 * np.exp(-1.5 * since) * np.sin(2.0 * np.pi * hertz * since) / RIG.amplifier.sensitivity
    o.volts[:, [0, 1, 3, 4]] += ringing[:, None] * [1.0, 0.5, -0.7, 0.3]
    discovery = found_in(o)
    assert (discovery.verdict, discovery.floors > 1.5) == ('unknown_effect', True)
    assert discovery.gap_floor == pytest.approx(Workspace([recorded(4)]).floor(), rel=0.05)


@pytest.mark.slow
def test_another_geometry_is_told_in_no_absurd_sizes() -> None:
    """Of small angles: two PSDs 30 cm away and a link five times as stiff would do the same, nearly."""
    held = [(0, 0, 0), (0, -10, 0), (0, -10, -5.85), (12, 0, 0), (0, 0, 4), (0, -20, -11.7), (0, 0, 0)]
    history = np.repeat(np.array(held, dtype=np.float64), 3000, axis=0)
    exact, linear = (ForwardModel(RIG, []).run(share * history).dots.T / share for share in (1.0, 1e-3))
    o = observe(RIG, 17, history=history)
    o.volts[:, [0, 1, 3, 4]] += (linear - exact) / RIG.amplifier.sensitivity
    discovery = found_in(o)
    assert (discovery.verdict, discovery.effects) == ('unknown_effect', ())


GAIN, ROTATED = ['sensor_gain,psd=1,x=0.01'], ['sensor_rotation,psd=2,angle=0.01']


@pytest.mark.slow
@pytest.mark.parametrize(
    ('wrong', 'beside'),
    [
        *(({'link.length': v}, beside) for v, beside in ((1.02, []), (1.02, GAIN), (0.575 / 0.585, GAIN))),
        ({'amplifier.sensitivity': 1.02}, GAIN),
        ({'converter.sample_rate_hz': 0.98}, ROTATED),
        ({'dynamics.bending_frequency': 1.04}, GAIN),
    ],
)
def test_a_wrong_number_is_named_alone_and_beside_an_effect(wrong: dict[str, float], beside: list[str]) -> None:
    """A longer link makes EI and GJ look wrong by a cube and by itself: one length explains both."""
    true = {key: factor * cast(float, RIG.values[key]) for key, factor in wrong.items()}
    discovery = found_in(observe(with_effects(replace_values(RIG, true), beside, 'test'), 3), full=True)
    assert [e.name for e in discovery.effects if e.name not in RIG_NUMBERS] == [words.split(',')[0] for words in beside]
    assert discovery.values == {key: pytest.approx(value, rel=1e-4) for key, value in true.items()}
    assert discovery.floors < 1.05
    of_setup = [f'{key}: ' for key in wrong if key not in RIG_NUMBERS.values()]
    assert all(f.fix.startswith(key) for f, key in zip(discovery.setup, of_setup, strict=True))
    assert ('The set-up is not as' in discovery.sentence) is bool(of_setup)


@pytest.mark.slow
@pytest.mark.parametrize(('psd', 'rows', 'beside'), [(2, 8, 0.0003), (2, -8, 0.0003), (1, 40, 0.0), (2, -1000, 0.0)])
def test_a_psd_on_another_clock_is_named_late_or_early(psd: int, rows: int, beside: float) -> None:
    rig = with_effects(RIG, [f'channel_skew,psd={psd},delay={beside}'] if beside else [], 'test')
    o, late, n = observe(rig, 5), slice(3 * psd - 3, 3 * psd), len(HISTORY.loads) - abs(rows)
    volts = o.volts[max(rows, 0) :][:n].copy()
    volts[:, late] = o.volts[max(-rows, 0) :][:n, late]
    recorded = Observation('test', RIG, volts, o.loads[max(rows, 0) :][:n])
    discovery = found_in(recorded)
    (effect,) = discovery.effects
    assert (effect.name, effect.values['psd'], discovery.setup) == ('channel_skew', psd, ())
    assert effect.values['delay'] == pytest.approx(1e-3 * rows + beside, abs=4.0 * effect.sd['delay'])
    assert f'{abs(rows)} rows {"up" if rows > 0 else "down"}' in discovery.lines()[1]
    assert discovery.floors < 1.05
    with pytest.raises(RecordingError, match='the clocks are not alike'):
        found_in(recorded, o)


def test_a_jump_is_found_at_its_sample() -> None:
    o = recorded()
    o.volts[2600:, 0] += 0.02
    workspace = Workspace([o])
    (recording, psd, time), *_ = likely_jumps(workspace, workspace.residual(())[0])
    assert (recording, psd) == (1, 1)
    assert time == pytest.approx(2.6, abs=0.004)
    assert likely_delays(workspace) == []


@pytest.mark.parametrize('share', [0.001, 0.05])
def test_outliers_are_excluded_and_movement_is_kept(share: float) -> None:
    o, rng = recorded(), np.random.default_rng(3)
    bad = rng.random(o.volts.shape) < share
    volts = o.volts + np.where(bad, rng.choice((-1.0, 1.0), bad.shape) * rng.uniform(0.1, 5.0, bad.shape), 0.0)
    cleaned, findings = clean(dataclasses.replace(o, volts=volts), ())
    gone = np.isnan(cleaned.volts)
    assert findings == []
    assert np.mean(gone[bad]) > 0.999
    assert np.mean(gone[~bad]) < 1e-3
    # Neither a step of the load nor hum of a hundred times the noise.
    t = np.arange(len(o.volts))[:, None] / 1000.0
    assert not outliers(o.volts + 0.2 * np.sin(2.0 * np.pi * 50.0 * t), 5e-4).any()


def csv_of(o: Observation, path: Path, step: float, rows: Sequence[int] | None = None) -> Path:
    lines = ['t,x1,y1,sum1,x2,y2,sum2,load_fx,load_fy,load_tz']
    for i in range(len(o.volts)) if rows is None else rows:
        numbers = [i * step, *o.volts[i].tolist(), *o.loads[i].tolist()]
        lines.append(','.join(f'{v:.9g}' for v in numbers))
    path.write_text('\n'.join(lines) + '\n')
    return path


@pytest.mark.slow
def test_command_prints_lines_and_puts_them_in_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Y of PSD 1 turned, and times of 800 samples a second against the 1000 of the rig file."""
    counts = RigSimulator(replace_values(RIG, {'converter.sample_rate_hz': 800.0}), 0).step(SET_UP).counts
    volts = counts.astype(np.float64) * RIG.converter.volts_per_count * np.array([1, -1, 1, 1, 1, 1])
    path = csv_of(Observation('seen', RIG, volts, SET_UP), tmp_path / 'seen.csv', 1.0 / 800.0)
    out = tmp_path / 'out'
    assert main(['discover', str(path), '--out', str(out), '--quiet']) == 0
    message = capsys.readouterr().out
    assert 'set-up: channel_sign y1: psd_1.axes: [x, -y]' in message
    assert 'set-up: sample_rate converter.sample_rate_hz: converter.sample_rate_hz: 800' in message
    model: Rig = load_rig(out / 'model.yaml')
    assert (model.psds[0].axes, model.converter.sample_rate_hz) == (('x', '-y'), 800.0)
    tree = json.loads((out / 'result.json').read_text())
    assert (tree['verdict'], [s['name'] for s in tree['setup']]) == ('nothing_missing', ['sample_rate', 'channel_sign'])
    assert clean(read_observation(path, model), ())[1] == []
    assert correct_wiring([read_observation(path, model)], ())[1] == []
