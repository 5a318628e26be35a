# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Laws in YAML: read, written, simulated in pieces, corrected, rejected with file and key."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import psd_deflection
from psd_deflection.base.errors import ConfigError
from psd_deflection.cli.main import main
from psd_deflection.measure.correction import Correction
from psd_deflection.model.simulation.catalogue import FOLDERS, catalogue, effects_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.law_files import read_law
from psd_deflection.model.simulation.laws import FORMS, TARGETS, Law, LawTerm, effect_of, law_text, unit_of, values_of
from psd_deflection.model.simulation.simulator import ForwardModel, RigSimulator
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.study import described

RIG = load_rig()
SIX = load_rig(overrides={f'psd_{n}.center': [0.02 * n, -0.01 * n] for n in range(3, 7)})
LOADS = np.repeat([[0.0, 0.0, 0.0], [20.0, -30.0, 10.0], [5.0, 10.0, -20.0], [0.0, 0.0, 0.0]], 150, axis=0)
WARM = 20.0 + np.linspace(0.0, 3.0, len(LOADS))
SHAPES = {
    'threshold': 1.2e-4,
    'period': 3e-4,
    'phase': 0.3,
    'half_width': 1e-5,
    'tau': 0.1,
    'natural_frequency': 33.0,
    'zeta': 0.05,
}


def law_of(form: str, target: str = 'y2', variable: str = 'y1') -> Law:
    shapes = {k: SHAPES[k] for k in (*FORMS[form].fitted, *FORMS[form].fixed)}
    times = (0.1, 0.25) if form == 'switched' else ()
    return Law('odd', TARGETS[target].stage, target, (LawTerm(form, (variable,), 1e-6, shapes, times),))


def active(law: Law) -> list[ActiveEffect]:
    return [ActiveEffect(effect_of(law), values_of(law))]


@pytest.mark.parametrize('form', [f for f in FORMS if f != 'jitter'])
def test_a_law_is_simulated_alike_in_pieces_of_any_size(form: str) -> None:
    law = law_of(form)
    full = ForwardModel(RIG, active(law)).run(LOADS, WARM)
    nominal = ForwardModel(RIG, []).run(LOADS, WARM)
    pieces, model = [], ForwardModel(RIG, active(law))
    for a, b in ((0, 1), (1, 2), (2, 7), (7, 300), (300, 300), (300, len(LOADS))):
        pieces.append(model.run(LOADS[a:b], WARM[a:b]).volts)
    np.testing.assert_array_equal(np.concatenate(pieces, axis=1), full.volts)
    changed = np.any(full.volts != nominal.volts, axis=1)
    assert changed.tolist() == [False] * 4 + [True, False]


@pytest.mark.parametrize('target', TARGETS)
def test_a_law_acts_on_what_it_names(target: str) -> None:
    law = law_of('product', target, 'load_fy')
    samples = ForwardModel(SIX, active(law)).run(LOADS, WARM)
    nominal = ForwardModel(SIX, []).run(LOADS, WARM)
    moved = np.any(samples.volts != nominal.volts, axis=1)
    if target[-1].isdigit():
        rest = np.ones(18, dtype=bool)
        rest[3 * int(target[-1]) - 3 : 3 * int(target[-1])] = False
        assert moved.any()
        assert not moved[rest].any()
    else:
        assert moved.reshape(6, 3)[:, :2].any(axis=1).all()


def test_a_jitter_is_noise_that_grows_and_has_no_mean() -> None:
    law = Law('shaky', 'electronics', 'x1', (LawTerm('jitter', ('temperature',), 1e-5),))
    samples = ForwardModel(RIG, active(law)).expect(LOADS, WARM)
    np.testing.assert_array_equal(samples.volts, ForwardModel(RIG, []).expect(LOADS, WARM).volts)
    model = ForwardModel(RIG, active(law))
    run = model.run(LOADS, WARM)
    before = run.volts.copy()
    model.finish(run)
    added = run.volts - before
    early, late = added[0, :150].std(), added[0, -150:].std()
    assert late == pytest.approx(2.6 / 0.4 * early, rel=0.4)
    assert not added[1:].any()


def test_a_lag_and_a_rate_are_those_of_their_equations() -> None:
    t = np.arange(400) * 1e-3
    u = np.sin(2.0 * np.pi * 5.0 * t)
    lag = LawTerm('relaxed', ('y1',), 1.0, {'tau': 0.05}).evaluate(lambda _: u, len(t), 1e-3, {})
    want = solve_ivp(lambda s, y: (np.sin(10.0 * np.pi * s) - y) / 0.05, (0.0, t[-1]), [0.0], t_eval=t, rtol=1e-9)
    np.testing.assert_allclose(lag, want.y[0], atol=3e-4)
    rate = LawTerm('rate', ('y1',)).evaluate(lambda _: u, len(t), 1e-3, {})
    np.testing.assert_allclose(rate[3:], 10.0 * np.pi * np.cos(10.0 * np.pi * t[3:]), atol=0.02)


def test_a_law_of_what_a_reading_knows_is_corrected() -> None:
    terms = (LawTerm('product', ('y1', 'temperature'), 2e-3), LawTerm('excess', ('y1',), 0.05, {'threshold': 5e-5}))
    law = Law('odd', 'psd', 'y1', terms)
    observed = ForwardModel(RIG, active(law)).run(LOADS, WARM)
    true = ForwardModel(RIG, []).run(LOADS, WARM)
    assert np.abs(observed.dots - true.dots).max() > 5e-6
    fixed = Correction(RIG, active(law)).apply(observed.dots.T, observed.sums.T, WARM - WARM[0])
    np.testing.assert_allclose(fixed, true.dots.T, atol=1e-11)


def test_a_file_is_read_as_it_was_written_and_switched_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    terms = (
        LawTerm('above', ('load_fx',), 2.5e-7, {'threshold': 10.0}, sd={'coefficient': 1e-9, 'threshold': 0.1}),
        LawTerm('switched', (), 1e-6, times=(0.1, 0.3)),
    )
    law = Law('yielding', 'psd', 'y2', terms, 'the mount yields')
    file = tmp_path / 'yielding.yaml'
    file.write_text(law_text(law, ['found somewhere']))
    assert read_law(file) == law
    monkeypatch.setenv(FOLDERS, str(tmp_path))
    effect = catalogue()['yielding']
    assert [(p.name, p.unit) for p in effect.parameters] == [('c1', 'm/N'), ('threshold1', 'N'), ('c2', 'm')]
    rig = load_rig(overrides={'effects.e.name': 'yielding', 'effects.e.c1': 2.5e-7})
    volts = RigSimulator(rig, 1).step(LOADS).counts
    assert effects_of_rig(rig)[0].values['threshold1'] == 10.0
    assert np.any(volts != RigSimulator(RIG, 1).step(LOADS).counts)


def test_a_law_travels_with_the_recording_and_the_rig_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ours, elsewhere = tmp_path / 'ours', tmp_path / 'elsewhere'
    ours.mkdir()
    elsewhere.mkdir()
    law = Law(
        'yielding', 'psd', 'y2', (LawTerm('product', ('y2', 'x2'), 3.0, sd={'coefficient': 0.1}),), 'the mount yields'
    )
    (ours / 'yielding.yaml').write_text(law_text(law))
    monkeypatch.setenv(FOLDERS, str(ours))
    by_hand = tmp_path / 'rig.yaml'
    by_hand.write_text('/**:\n  ros__parameters:\n    effects:\n      e: {name: yielding, c1: 4.0}\n')
    words = ['simulate', '--params-file', str(by_hand), '--loads', 'steps:0,0,0;9,-20,5:0.5']
    for name in ('a', 'a.mcap'):
        assert main([*words, '--out', str(tmp_path / name)]) == 0
    observed = psd_deflection.replay(tmp_path / 'a')
    (active,) = effects_of_rig(load_rig(by_hand))
    model = tmp_path / 'model.yaml'
    model.write_text(described(load_rig(by_hand), [active]))
    monkeypatch.setenv(FOLDERS, str(elsewhere))
    assert main(['replay', str(tmp_path / 'a'), '--compare']) == 0
    assert 'no bit differs' in capsys.readouterr().out
    for rig in (None, model):
        again = psd_deflection.replay(tmp_path / 'a', rig)
        np.testing.assert_array_equal(again.dy, observed.dy)
    assert len(psd_deflection.replay(tmp_path / 'a.mcap').dy) == len(observed.dy)
    assert np.any(psd_deflection.replay(tmp_path / 'a', RIG).dy != observed.dy)
    (carried,) = effects_of_rig(load_rig(model))
    assert (carried.values, carried.effect.law) == ({'c1': 4.0}, active.effect.law)
    # A rig file that names it alone does not have it, and is told where it would be.
    assert main(['replay', str(tmp_path / 'a'), '--params-file', str(by_hand)]) == 3
    assert f'(one of your own is yielding.py or yielding.yaml in {elsewhere}, see {FOLDERS})' in capsys.readouterr().err


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (
            '{name: other, acts_on: y2, terms: [{form: product, of: [x2], coefficient: 1}]}',
            "law: name = 'other': must be",
        ),
        ('{name: e, acts_on: y7, terms: []}', "law: acts_on = 'y7': unknown"),
        ('[', 'law:2:1: malformed YAML'),
        ('7', 'law: must be a map'),
    ],
)
def test_a_malformed_law_in_a_rig_file_is_rejected_with_its_key(text: str, message: str) -> None:
    rig = load_rig(overrides={'effects.e.name': 'e', 'effects.e.c1': 1.0, 'effects.e.law': text})
    with pytest.raises(ConfigError) as error:
        effects_of_rig(rig)
    assert str(error.value).startswith(f'effects.e.{message}')


def test_units_and_words_are_those_of_the_variables() -> None:
    term = LawTerm('product', ('load_tz', 'load_tz', 'temperature'), 2.0)
    assert unit_of(term.of) == '(N m)^2 K'
    assert term.unit('y2') == 'm/((N m)^2 K)'
    assert Law('a', 'psd', 'y2', (term,)).expression == 'y2 += 2 m/((N m)^2 K) · load_tz^2 temperature'
    assert LawTerm('rate', ('x1',)).unit('y1') == 'm s/m'


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'acts_on: y2': 'acts_on: y7'}, "acts_on = 'y7': unknown"),
        ({'form: above': 'form: abov'}, "terms[0].form = 'abov': unknown; did you mean above?"),
        ({'load_fx': 'load_fz'}, "terms[0].of = 'load_fz': unknown"),
        ({'coefficient: 2.5e-07': 'coefficient: many'}, "terms[0].coefficient = 'many': must be a number"),
        ({'  threshold: 10.0\n': ''}, 'terms[0].threshold = None: must be a number'),
        ({'name: yielding\n': ''}, 'name is missing'),
        ({'form: above': 'form: switched'}, 'terms[0].times = []: a switched term, and no other, has times'),
        ({'acts_on: y2': 'acts_on: load_fx', '- load_fx': '- y1'}, "terms[0].of = 'y1': unknown"),
    ],
)
def test_a_malformed_law_is_rejected_with_file_and_key(tmp_path: Path, change: dict[str, str], message: str) -> None:
    text = law_text(Law('yielding', 'psd', 'y2', (LawTerm('above', ('load_fx',), 2.5e-7, {'threshold': 10.0}),)))
    for old, new in change.items():
        assert old in text
        text = text.replace(old, new)
    file = tmp_path / 'yielding.yaml'
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        read_law(file)
    assert str(error.value).startswith(f'{file}: {message}')


LOAD = Law('both', 'load', 'load_fx', (LawTerm('product', ('load_fy',), 0.02), LawTerm('product', ('load_tz',), 0.01)))
DOT = Law('both', 'psd', 'y2', (LawTerm('above', ('y1',), 0.1, {'threshold': 1.2e-4}),))
JOINT = Law('both', 'load', 'load_fx', LOAD.terms, 'a base that yields', (DOT,))


def test_a_joint_law_is_one_file(tmp_path: Path) -> None:
    path = tmp_path / 'both.yaml'
    path.write_text(law_text(JOINT, ['found']))
    assert read_law(path) == JOINT
    rig = load_rig(
        overrides={'effects.both.law': effect_of(JOINT).law, 'effects.both.c1': 0.02, 'effects.both.c3': 0.2}
    )
    (active,) = effects_of_rig(rig)
    assert (len(active.parts), active.values['c1'], active.values['c3']) == (2, 0.02, 0.2)


@pytest.mark.parametrize(
    ('further', 'words'),
    [
        ('7', r'further = 7: must be a list of maps with acts_on and terms'),
        ('[7]', r'further\[0\] = 7: must be a map with acts_on and terms'),
        ('[{terms: []}]', r'further\[0\]\.acts_on is missing'),
        ('[{acts_on: y3x, terms: []}]', r"further\[0\]\.acts_on = 'y3x': unknown"),
        ('[{acts_on: y1, terms: 3}]', r'further\[0\]\.terms = 3: must be a list of at least one term'),
        (
            '[{acts_on: y1, terms: [{form: product, of: [dx], coefficient: x}]}]',
            r'further\[0\]\.terms\[0\]\.coefficient',
        ),
        ('[{acts_on: load_fx, terms: [{form: product, of: [load_fy], coefficient: 1}]}]', 'load_fx is there twice'),
    ],
)
def test_a_wrong_further_part_is_named(tmp_path: Path, further: str, words: str) -> None:
    path = tmp_path / 'both.yaml'
    path.write_text(law_text(LOAD) + f'further: {further}\n')
    with pytest.raises(ConfigError, match=words):
        read_law(path)
