# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Comparisons at their limits, guards and constants of discover: each from one side and from the other."""

import dataclasses
import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from psd_deflection.model.simulation.catalogue import make_active
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.wirings import WIRINGS, differences
from psd_deflection.studies.discover import conclusion, law_features, laws, plants, setup
from psd_deflection.studies.discover.search import fit as validate
from psd_deflection.studies.discover.search import localise, proposals, weighing
from psd_deflection.studies.discover.search.fit import Fit, HeldOut, refit
from psd_deflection.studies.discover.search.screen import Candidate
from psd_deflection.studies.discover.search.search import SearchResult
from psd_deflection.studies.discover.search.weighing import (
    Alternative,
    CommonCause,
    NamedEffect,
    Tie,
    coincidences,
    ties,
)
from psd_deflection.studies.discover.search.workspace import Workspace

from .test_formulas import RIG, make_observation
from .test_rules import A, Plant, active, noise, pictures


def test_a_load_with_the_other_sign_has_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """It pulled the other way, half as much as annotated: that is no unit, but the sign is wrong."""
    o = make_observation(warm=None)
    observed = dataclasses.replace(o, loads=o.loads * [1.0, -2.0, 1.0])
    corrected, findings, lines = setup.correct_wiring([observed], ())
    assert [(f.name, f.where) for f in findings] == [('load_sign', 'fy')]
    np.testing.assert_allclose(corrected[0].loads, o.loads * [1.0, 2.0, 1.0])
    assert lines == {}


@pytest.mark.parametrize(('main', 'coupled'), [(1e-6, 0.0), (1.01e-6, 0.5), (-1e-6, 0.0), (-1.01e-6, -0.5)])
def test_what_is_coupled_to_nothing_is_none(main: float, coupled: float) -> None:
    size = EffectParameter('size', 'V', -1.0, 1.0, 1.0, '')
    with_it = EffectParameter('with_it', '', -9.0, 9.0, 1.0, '', kind='coupled')
    effect = Effect('made_up', 'psd', '', '', '', '', (size, with_it), 'dots', apply=lambda *_: None)
    off = {'size': 0.0, 'with_it': 0.0}
    found = Candidate(effect, off, ('size', 'with_it'), off).from_coefficients(np.array([main, 0.5 * 1.01e-6]))
    assert found.values['with_it'] == pytest.approx(coupled)


def test_noise_of_a_sum_is_no_gap() -> None:
    """What grows with a load in the light of a PSD: the gap of the dots is as it was."""
    rng = np.random.default_rng(5)
    o = make_observation(6)
    volts = o.volts.copy()
    volts[:, 5] += 4e-3 * (o.loads[:, 1] / np.abs(o.loads[:, 1]).max()) * rng.standard_normal(len(volts))
    workspace = Workspace([dataclasses.replace(o, volts=volts)])
    fit = refit(workspace, ())
    found = laws.find_jitter(workspace, fit, 3.0)
    assert found is not None
    assert found.channels == ('sum2',)
    assert found.heldout_gap == validate.heldout_gap(workspace, fit)
    (term,) = found.law.terms
    squares = workspace.split(fit.residual)[0][5] ** 2
    known = law_features.known_fine(workspace, (), term.of[0])[0]
    _, b = law_features.variance(squares, known**2 / (known**2).max())
    # Volts: no sensitivity is in it.
    scale = workspace.noise[0].innovation[5] * 2.0
    assert term.coefficient == pytest.approx(math.sqrt(b / (known**2).max()) * scale, rel=1e-9)


def test_where_a_block_is_lost_a_law_is_not_looked_for() -> None:
    o = make_observation(warm=None)
    volts = o.volts.copy()
    volts[200:240] = np.nan
    workspace = Workspace([dataclasses.replace(o, volts=volts)])
    (r,) = law_features.responses(workspace, refit(workspace, ()))
    lost = ~(workspace.count[0] > 0.0).any(axis=0)
    assert lost.sum() == 10
    assert (r.error[:, lost] == 0.0).all()
    assert (r.power[:, lost] == 0.0).all()
    assert np.isfinite(r.error).all()


def test_other_wirings_that_are_as_good_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    o = make_observation(warm=None)
    file = Wiring.from_rig(o.rig)
    good = [w for w in WIRINGS if len(differences(w, file)) == 1][:4]
    monkeypatch.setattr(setup, 'load_sizes', lambda m, w: (0.0 if w in good else m.squared, np.ones(3)))
    _, (finding,), _ = setup.correct_wiring([o], ())
    assert len(finding.equivalent) == 2
    # One change more each, a sign of a load.
    sizes = np.array([1.0, 1.0, -1.0])
    monkeypatch.setattr(setup, 'load_sizes', lambda m, w: (0.0, sizes if w in good else np.ones(3)))
    assert setup.correct_wiring([o], ())[1:] == ([], {})
    monkeypatch.setattr(setup, 'load_sizes', lambda m, w: (0.0 if w in good else m.squared, sizes))
    _, (wiring, sign), _ = setup.correct_wiring([o], ())
    assert (sign.name, sign.where) == ('load_sign', 'tz')
    assert all(words.endswith(' and load_sign of tz') for words in wiring.equivalent)


def test_what_a_law_leaves_is_reported_in_micrometres() -> None:
    law = SimpleNamespace(expression='y2 += 1', stage='psd', kind='straight')
    found = SimpleNamespace(law=law, laws=[law], beside=[], heldout_gap=1.0)
    answer = SimpleNamespace(law=found, effects=())
    assert conclusion.law_sentence(cast(Any, answer)).endswith('on unseen load cases it leaves 1000000.000 µm.')
    creep = SimpleNamespace(effect=SimpleNamespace(name='creep'))
    found.beside = [creep]
    for named, words in (([], ', beside creep; on'), ([SimpleNamespace(active=creep)], 'y2 += 1; on')):
        answer.effects = named
        assert words in conclusion.law_sentence(cast(Any, answer))


def test_a_table_is_tried_with_a_small_size_and_the_first_shape() -> None:
    parameters = (
        EffectParameter('plain', 'V', -1.0, 1.0, 0.1, '', nominal=0.5),
        EffectParameter('near', 'V', -1.0, 0.55, 0.1, '', nominal=0.5),
        EffectParameter('listed', 'V', -1.0, 1.0, 0.1, '', grid=(0.2, 0.4)),
        EffectParameter('far', 'V', -1.0, 1.0, 0.1, '', grid=(0.2, 4.0)),
        EffectParameter('shape', 'Hz', 1.0, 60.0, 1.0, '', nominal=5.0, kind='shape', grid=(2.0, 50.0)),
        EffectParameter('alone', 'Hz', 1.0, 60.0, 1.0, '', nominal=5.0, kind='shape'),
        EffectParameter('with_it', '', -9.0, 9.0, 1.0, '', kind='coupled'),
    )
    effect = Effect('made_up', 'psd', '', '', '', '', parameters, 'dots', apply=lambda *_: None)
    got = plants.with_first_dose(effect, {p.name: p.nominal for p in parameters})
    want = {'plain': 0.6, 'near': 0.55, 'listed': 0.4, 'far': 1.0, 'shape': 2.0, 'alone': 5.0, 'with_it': 1.0}
    assert got == pytest.approx(want)


def test_localisation_is_independent_of_fit_units() -> None:
    workspace = Workspace([make_observation(warm=None)])
    known = np.random.default_rng(3).standard_normal((len(workspace.whiten(workspace.measured)), 2))
    residual = workspace.residual([])[0]
    one, other = (
        localise.localise(workspace, residual, k, np.random.default_rng(0)) for k in (known, known * [1e6, 1e-6])
    )
    assert one.p == pytest.approx(other.p)
    assert [d.gain for d in one.dependences] == pytest.approx([d.gain for d in other.dependences])
    strong = {d.channel for d in one.dependences if d.p < 0.01}
    assert {c.channel for c in one.cells if c.depends_on} <= strong < {c.channel for c in one.cells}
    # A column that is all of what noise draws leaves less of it.
    assert [c.p for c in one.cells] == pytest.approx([c.p for c in other.cells])


@pytest.mark.parametrize(('gains', 'share'), [((-5.0, 1.0), 0.0), ((3.0, 2.0), 0.5), ((30.0, 2.0), 1.0)])
def test_tied_effects_explain_none_to_all_of_the_gap(gains: tuple[float, float], share: float) -> None:
    tie = weighing.Coincidence(((0, 'x'), (1, 'x')), (1.0, 1.0), 'V', 50.0)
    fit = SimpleNamespace(effects=(active('a', x=1.0), active('b', x=1.0)), chi2=90.0)
    found = SimpleNamespace(delta_chi2=list(gains), null=SimpleNamespace(chi2=100.0))
    (unknown,) = weighing.tied(
        [tie], cast(Fit, fit), cast(SearchResult, found), cast(Any, SimpleNamespace(dependences=()))
    )
    assert unknown.explains == pytest.approx(share)
    assert not unknown.unexplained


@pytest.mark.parametrize('channel', range(6))
def test_a_limit_is_looked_for_on_every_channel(channel: int) -> None:
    o = make_observation(warm=None)
    volts = np.zeros_like(o.volts)
    volts[7, channel] = -3.0
    observed = dataclasses.replace(o, volts=volts)
    limits = pytest.approx([2.8, 2.6, 1.8, 2.94])
    assert proposals.highest_voltages([observed], True, 0.1) == limits
    assert proposals.highest_voltages([observed], False, 0.1) == ([] if channel in (2, 5) else limits)


def test_of_two_that_are_one_the_sum_is_known() -> None:
    fit = refit(Plant(pictures(A), noise()), [active('a', x=0.0)])
    twice = dataclasses.replace(
        fit, jacobian=np.repeat(fit.jacobian, 2, axis=1), free=((0, 'x'), (1, 'x')), effects=fit.effects * 2
    )
    np.testing.assert_allclose(twice.covariance(), 0.25 * fit.covariance()[0, 0] * np.ones((2, 2)), rtol=1e-6)


def test_variable_is_known_as_means_of_estimate_blocks() -> None:
    workspace = Workspace([make_observation(warm=None), make_observation(1, name='second', warm=None)])
    for o, got in zip(workspace.observations, law_features.known_values(workspace, (), 'load_fy'), strict=True):
        np.testing.assert_allclose(got, o.loads[:, 1].reshape(-1, 20).mean(axis=1), atol=1e-12)


@pytest.mark.parametrize(('nominal', 'choices', 'kept'), [(1.0, (0, 1), 1), (0.0, (0, 1), 0), (5.0, (2, 3), 2)])
def test_a_choice_that_makes_no_difference_stays_as_it_is(nominal: float, choices: tuple[int, ...], kept: int) -> None:
    way = EffectParameter('way', '', 0, 9, 1, '', nominal=nominal, kind='choice', choices=choices)
    assert plants.fixed_choice(way).choices == (kept,)
    psd = dataclasses.replace(way, each=True)
    size = EffectParameter('size', 'V', -1.0, 1.0, 0.1, '')
    assert plants.fixed_choice(psd) is psd
    assert plants.fixed_choice(size) is size


def test_the_nuisance_takes_part_in_no_tie() -> None:
    rng = np.random.default_rng(0)
    jacobian = rng.standard_normal((200, 3)) * 1e4
    effects = (active('a', -9.0, 9.0, x=1.0), active('b', -9.0, 9.0, x=1.0))
    beside = active('n', -9.0, 9.0, x=1.0)
    for free in (((-1, 'x'), (0, 'x'), (1, 'x')), ((0, 'x'), (-1, 'x'), (1, 'x'))):
        fit = Fit(effects, 0.0, np.zeros(200), [], jacobian, free, (), (beside,))
        (tie,) = weighing.coincidences(fit, Physics.of(RIG))
        assert tie.members == ((0, 'x'), (1, 'x'))


FIT = Fit((), 0.0, np.zeros(1), [], np.zeros((1, 0)), (), ())


def stiffness(name: str, scale: float, moves: int = 0) -> ActiveEffect:
    return make_active(f'{name}_stiffness', {'scale': scale, 'moves_frequency': moves}, 'test')


def named(active: ActiveEffect, sd: float, *alternatives: Alternative) -> NamedEffect:
    amplitude = next(p.name for p in active.effect.parameters if p.kind == 'amplitude')
    return NamedEffect(active, {amplitude: sd}, 1e-9, 50.0, HeldOut(9.0, 1.0), (), alternatives, (), None)


def test_radius_material_or_loads_explain_stiffnesses() -> None:
    (tie,) = ties([named(stiffness('bending', -0.04), 1e-4), named(stiffness('torsional', -0.0401), 1e-4)])
    assert tie.share == pytest.approx(-0.04005)
    radius, loads = tie.causes
    assert (radius.name, loads.name) == ('link_radius', 'load_unit')
    # A tube whose radii are multiplied by this has both stiffnesses multiplied by its fourth power.
    assert radius.factor**4 == pytest.approx(1.0 + tie.share)
    assert loads.factor * (1.0 + tie.share) == pytest.approx(1.0)
    for cause, power in ((radius, 0.25), (loads, -1.0)):
        low, high = ((1.0 + share) ** power for share in (tie.share - tie.sd, tie.share + tie.sd))
        assert cause.sd == pytest.approx(abs(high - low) / 2.0, rel=1e-3)
    assert tie.sd == pytest.approx(1e-4 / np.sqrt(2.0))
    for part in ('same share (-4 ± 0.007 %)', 'radii times 0.98983', 'loads times 1.0417', 'weigh the loads'):
        assert part in tie.sentence


def test_if_the_modes_moved_it_is_not_the_loads() -> None:
    (tie,) = ties([named(stiffness('torsional', 0.02, 1), 1e-5), named(stiffness('bending', 0.02, 1), 1e-5)])
    assert [c.name for c in tie.causes] == ['link_radius']
    assert 'Not the loads' in tie.sentence
    assert ties([named(stiffness('torsional', 0.02, 0), 1e-5), named(stiffness('bending', 0.02, 1), 1e-5)]) == ()


def test_a_rival_may_be_the_half_of_a_tie() -> None:
    clamp = make_active('clamp_torsional_compliance', {'compliance': 2e-5}, 'test')
    alternative = Alternative(stiffness('torsional', -0.04), {'scale': 1e-5}, 0.0, FIT)
    (tie,) = ties([named(stiffness('bending', -0.04), 1e-5), named(clamp, 1e-8, alternative)])
    assert tie.share == pytest.approx(-0.04)
    assert ties([named(stiffness('bending', -0.04), 1e-5), named(clamp, 1e-8)]) == ()


@pytest.mark.parametrize(
    ('other', 'sd'), [(-0.041, 1e-5), (0.04, 1e-5), (-0.04, 0.01), (-0.04, 0.0)], ids=('off', 'sign', 'vague', 'fixed')
)
def test_shares_that_differ_or_are_vague_are_no_tie(other: float, sd: float) -> None:
    assert ties([named(stiffness('bending', -0.04), 1e-5), named(stiffness('torsional', other), sd)]) == ()


@pytest.mark.parametrize(('second', 'count'), [('torsional_stiffness', 0), ('axis_crosstalk', 1)])
def test_a_tie_of_known_cause_is_not_called_unknown(second: str, count: int) -> None:
    values = {'scale': -0.04} if count == 0 else {'psd': 1, 'xy': -0.04}
    effects = (stiffness('bending', -0.04), make_active(second, values, 'test'))
    free = ((0, 'scale'), (1, 'scale' if count == 0 else 'xy'))
    fit = Fit(effects, 0.0, np.zeros(2), [], 1e4 * np.eye(2), free, ())
    assert len(coincidences(fit, None)) == count


def test_the_deviation_of_a_tie_is_reported_in_per_cent() -> None:
    cause = CommonCause('link_radius', 1.0, 1e-3)
    assert '(2 ± 1 %)' in Tie(0.02, 0.0149, True, (cause,)).sentence


def test_a_stiffness_without_a_deviation_is_the_half_of_no_tie() -> None:
    without = dataclasses.replace(named(stiffness('torsional', -0.04), 1e-5), sd={})
    assert ties([named(stiffness('bending', -0.04), 1e-5), without]) == ()
