# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""discover describes what no effect explains as a law; nothing is adopted without the word."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest

from psd_deflection.cli.main import main
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import FOLDERS, effect_names, effects_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.law_files import read_law
from psd_deflection.model.simulation.laws import Law, LawTerm, effect_of, law_text, values_of
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.discover.conclusion import RigConclusion
from psd_deflection.studies.discover.laws.laws import find_jitter, find_law
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.workspace import Workspace

from .test_formulas import make_observation

RIG = load_rig()
HISTORY = loads.identification().loads
STEPS = 20_000
"""Samples of it in which the load is stepped."""
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
    # It is an effect of the user's now, and the model has it.
    assert 'yielding' in effect_names()
    adopted = read_law(ours / 'yielding.yaml')
    assert adopted.terms[0].coefficient == pytest.approx(3e-9, rel=0.05)
    (active,) = effects_of_rig(load_rig(out / 'model.yaml'))
    assert active.effect.name == 'yielding'
    # A name that is taken, and one that is none, are rejected before the search.
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


@pytest.mark.slow
def test_what_switches_with_the_loads_is_no_law_of_times() -> None:
    # Without the sweep, in which the load changes all the time.
    changes = np.flatnonzero(np.any(np.diff(HISTORY[:STEPS], axis=0) != 0.0, axis=1)) * 1e-3
    for times, reported in ((changes[1:4] + 0.1, False), (changes[1:4] + 0.7, True)):
        term = LawTerm('switched', (), 3e-6, times=tuple(times.tolist()))
        ws = workspace(Law('bump', 'psd', 'x1', (term,)), count=STEPS)
        null = refit(ws, ())
        found = find_law(ws, null, null, float(np.log(ws.effective_size())), 0.0, np.random.default_rng(0), print)
        switched = found is not None and any(t.times for law in found.laws for t in law.terms)
        assert switched is reported


def test_law_with_large_held_out_gap_is_not_written() -> None:
    ws = workspace(Law('odd', 'psd', 'y2', (LawTerm('product', ('load_fx', 'load_fx'), 3e-9),)))
    null = refit(ws, ())
    found = find_law(ws, null, null, float(np.log(ws.effective_size())), 0.0, np.random.default_rng(0), print)
    assert found is not None
    for floors, written in ((1.9, True), (2.1, False)):
        law = dataclasses.replace(found, heldout_gap=floors * ws.floor())
        concluded = SimpleNamespace(law=law, gap_floor=ws.floor(), adopted='')
        assert (RigConclusion.model_of_law.fget(concluded) is not None) == written  # type: ignore[attr-defined]
