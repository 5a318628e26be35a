# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""discover on machines of one's own, and what no effect explains as a law; nothing is adopted without the word."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError
from psd_deflection.cli.main import main
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import FOLDERS, effect_names, effects_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter
from psd_deflection.model.simulation.law_files import read_law
from psd_deflection.model.simulation.laws import Law, LawTerm, effect_of, law_text, values_of
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.discover.laws import find_jitter, find_law
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.workspace import Workspace

from .test_formulas import make_observation

RIG = load_rig()
HISTORY = loads.identification().loads
WARM = 21.0 + 2.0 * np.sin(np.linspace(0.0, 5.0, len(HISTORY)))
SCHEMA = json.loads((Path(__file__).parents[2] / 'data' / 'result.schema.json').read_text())


def workspace(law: Law | None, seed: int = 0, count: int = len(HISTORY)) -> Workspace:
    active = [] if law is None else [ActiveEffect(effect_of(law), values_of(law))]
    model = ForwardModel(RIG, active)
    history, warm = HISTORY[:count], WARM[:count]
    samples = model.run(history, warm)
    samples.volts += RIG.noises.ravel()[:, None] * np.random.default_rng(seed).standard_normal(samples.volts.shape)
    model.finish(samples)
    return Workspace([Observation('test', RIG, samples.volts.T.copy(), history, warm)])


def test_there_is_no_law_in_noise() -> None:
    ws = Workspace([make_observation(3)])
    null = refit(ws, ())
    assert find_law(ws, null, null, float(np.log(ws.effective_size())), 0.0, np.random.default_rng(0), print) is None
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
    assert (reported['verdict'], law['stage'], law['variables'], law['kind']) == (
        'unknown_effect',
        'psd',
        ['load_fx'],
        'static',
    )
    assert law['channels'] == ['y2']
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
    shaky = Law('shaky', 'electronics', 'y2', (LawTerm('jitter', ('load_fy',), 5e-8),))
    ws = workspace(shaky)
    null = refit(ws, ())
    penalty = float(np.log(ws.effective_size()))
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
    found = find_law(ws, null, null, float(np.log(ws.effective_size())), 0.0, np.random.default_rng(0), print)
    assert found is not None
    nothing: dict[str, Any] = dict.fromkeys(f.name for f in dataclasses.fields(Discovery))
    without = Discovery(**{**nothing, 'gap_floor': ws.floor(), 'adopted': ''})
    assert without.adopt('none') is without
    for floors, written in ((1.9, True), (2.1, False)):
        concluded = dataclasses.replace(without, law=dataclasses.replace(found, heldout_gap=floors * ws.floor()))
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
    found = psd_deflection.discover_in(plant)
    tree = found.tree()
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
