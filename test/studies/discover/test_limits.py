# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Comparisons at their limits, guards and constants of discover: each from one side and from the other."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from psd_deflection.model.simulation.declaration import Effect, EffectParameter
from psd_deflection.model.simulation.laws import LawTerm
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import replace_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.wirings import WIRINGS, differences
from psd_deflection.studies.discover import conclusion, experiment, readings
from psd_deflection.studies.discover.experiment import ModelSums
from psd_deflection.studies.discover.laws import law_features, laws, variance
from psd_deflection.studies.discover.laws.law_features import Response
from psd_deflection.studies.discover.search import coincidence, localise, proposals, weighing
from psd_deflection.studies.discover.search import hold_out as validate
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.localise import dependences
from psd_deflection.studies.discover.search.screen import Screen
from psd_deflection.studies.discover.search.search import SearchResult
from psd_deflection.studies.discover.search.signatures import Candidate
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import cleaning, setup

from .test_formulas import RIG, make_observation
from .test_rules import FINE, SIGMA, A, N, Plant, active, candidate, noise, pictures

# Wiring and units.


def test_a_load_with_the_other_sign_has_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """It pulled the other way, half as much as annotated: that is no unit, but the sign is wrong."""
    o = make_observation(warm=None)
    observed = dataclasses.replace(o, loads=o.loads * [1.0, -2.0, 1.0])
    corrected, findings, lines = setup.correct_wiring([observed], ())
    assert [(f.name, f.where) for f in findings] == [('load_sign', 'fy')]
    np.testing.assert_allclose(corrected[0].loads, o.loads * [1.0, 2.0, 1.0])
    assert lines == {}


# Starting values.


@pytest.mark.parametrize(('of_simulation', 'taken'), [(2, 2), (3, 1)])
def test_a_simulation_is_rougher_if_it_has_more_than_twice_the_outliers(
    monkeypatch: pytest.MonkeyPatch, of_simulation: int, taken: int
) -> None:
    o = make_observation(warm=None)

    def outliers(residual: FloatArray, least: float) -> cleaning.BoolArray:
        out = np.zeros(residual.shape, dtype=bool)
        out[: 1 if np.array_equal(residual, o.volts) else of_simulation, 0] = True
        return out

    monkeypatch.setattr(cleaning, 'outliers', outliers)
    assert np.isnan(cleaning.clean(o, ())[0].volts).sum() == taken


# Candidates.


@pytest.mark.parametrize(('main', 'coupled'), [(1e-6, 0.0), (1.01e-6, 0.5), (-1e-6, 0.0), (-1.01e-6, -0.5)])
def test_what_is_coupled_to_nothing_is_none(main: float, coupled: float) -> None:
    size = EffectParameter('size', 'V', -1.0, 1.0, 1.0, '')
    with_it = EffectParameter('with_it', '', -9.0, 9.0, 1.0, '', kind='coupled')
    effect = Effect('made_up', 'psd', '', '', '', '', (size, with_it), 'dots', apply=lambda *_: None)
    off = {'size': 0.0, 'with_it': 0.0}
    found = Candidate(effect, off, ('size', 'with_it'), off).from_coefficients(np.array([main, 0.5 * 1.01e-6]))
    assert found.values['with_it'] == pytest.approx(coupled)


def test_a_size_that_shows_nothing_stays_where_it_is() -> None:
    shown = pictures(A)
    shown['b', 'x'] = np.zeros_like(shown[A])
    plant = Plant(shown, 5e-3 * shown[A] + noise())
    fit = refit(plant, [active('a', x=0.0), active('b', x=0.1)])
    assert fit.effects[1].values['x'] == 0.1
    # Two fits end a rounding apart; 1e-9 of a standard deviation is far more.
    alone = refit(plant, [active('a', x=0.0)])
    assert fit.effects[0].values['x'] == pytest.approx(alone.effects[0].values['x'], rel=1e-9)
    for known in (None, np.empty((N, 0))):
        # No columns are as good as none at all.
        screen = Screen(plant, [(candidate('a', 'x'), [[shown[A]]])])
        (score,) = screen.score(fit.residual, known)
        assert score.gain < 9.0
    table = [('x1', {'constant': [np.ones(FINE)]})]
    (wanted,) = dependences(plant, table, fit.residual, None)
    (got,) = dependences(plant, table, fit.residual, np.empty((N, 0)))
    assert got.gain == pytest.approx(wanted.gain)


# Plans.


def test_two_models_are_separated_by_what_no_sizes_of_one_explain() -> None:
    """Of two parameters that go nearly the same way too."""
    rng = np.random.default_rng(1)
    slopes = rng.standard_normal((30, 2))
    slopes[:, 1] = slopes[:, 0] + 1e-3 * slopes[:, 1]
    apart = slopes @ [3.0, 50.0] + rng.standard_normal(30)
    residual = apart - slopes @ np.linalg.lstsq(slopes, apart, rcond=None)[0]
    pull = [[np.empty(0), slopes.T @ apart], [np.empty(0), np.zeros(2)]]
    shown = ModelSums(np.full((2, 2), apart @ apart), pull, [np.empty((0, 0)), slopes.T @ slopes], 1.0)
    assert shown.separation(0, 1, np.zeros((2, 2))) == pytest.approx(residual @ residual, rel=1e-6)


# Laws.


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
    _, b = variance.variance(squares, known**2 / (known**2).max())
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


def test_loads_keep_the_dots_within_what_the_converter_can_read() -> None:
    """Here 0.1 mm a volt: the ends of the converter's range come before the edge of the sensor."""
    rig = replace_values(RIG, {'amplifier.sensitivity': 1e-4, 'link.youngs_modulus': 7e9})
    link = rig.link
    room = 0.8 * 1e-4 * rig.converter.full_scale
    assert room < 0.4 * min(min(p.active_area) for p in rig.psds)
    f = room / (link.length**3 / (3.0 * link.bending_stiffness))
    assert experiment.pieces(rig, experiment.Limits())[0].words.startswith(f'{f:.3g} N along')


@pytest.mark.parametrize(
    ('changes', 'there'),
    [
        # Forces below a newton too: of a soft link they are large.
        ({'force': 0.5, 'torque': 0.0, 'sidebar': 0.0, 'sweep': 0.0}, {'-Y, +Y', 'four steps', '0.4 N held'}),
        ({'force': 0.0, 'torque': 0.5, 'sweep': 0.0}, {'pure torque', 'all corners', 'N m in four steps'}),
        (
            {'force': 0.5, 'torque': 0.5, 'sideways': False, 'sidebar': 0.5, 'sweep': 0.0},
            {'weights', 'four steps', 'sidebar', 'held'},
        ),
    ],
)
def test_small_loads_are_loads(changes: dict[str, Any], there: set[str]) -> None:
    words = [p.words for p in experiment.pieces(RIG, experiment.Limits(**changes))]
    assert all(any(t in w for w in words) for t in there), words
    steps_of = [w for w in words if 'four steps' in w]
    sideways = changes.get('sideways', True)
    assert len(steps_of) == (changes['force'] > 0.0) * (1 + sideways) + (changes['torque'] > 0.0) * sideways


def test_a_step_that_makes_it_worse_is_damped_twenty_times_more() -> None:
    """Of a unit in its own scale the step is 1/(1 + damping): 1e-4, 2e-3, 0.04, 0.8, 16."""
    shown = pictures(A)
    tried: list[float] = []

    class Worse(Plant):
        def simulate(self, effects: Any) -> Any:
            (x,) = (a.values['x'] for a in effects)
            tried.append(x)
            # A step of the finite difference is 5e-5.
            return [shown[A] * (x if x < 1e-4 else -1.0)]

    refit(Worse(shown, 1e-2 * shown[A]), [active('a', x=0.0)], iterations=1)
    want = [1e-2 / (1.0 + d) for d in (1e-4, 2e-3, 0.04, 0.8, 16.0)]
    assert tried == pytest.approx([0.0, 5e-5, *want])


# The screen.


def test_a_candidate_counts_from_a_thousandth_of_sigma() -> None:
    shown = pictures(A)
    unit = shown[A] / np.linalg.norm(shown[A]) * SIGMA
    plant = Plant(shown, 5.0 * unit)
    for size, observed in ((0.5, True), (1.01e-3, True), (0.99e-3, False)):
        screen = Screen(plant, [(candidate('a', 'x'), [[size * unit]])])
        got = screen.score(plant.whiten(plant.measured))
        assert [s.gain for s in got] == ([pytest.approx(25.0, rel=1e-4)] if observed else [])
    for size, least, gain in ((1.0, 0.0, 25.0), (10.0, 0.0, 25.0), (-1.0, 0.0, 0.0), (-1.0, -1.0, 25.0)):
        screen = Screen(plant, [(candidate('a', 'x', least=least), [[size * unit]])])
        assert screen.score(plant.whiten(plant.measured))[0].gain == pytest.approx(gain, rel=1e-4)


# Wiring, jumps and places.


def test_other_wirings_that_are_as_good_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    o = make_observation(warm=None)
    file = Wiring.from_rig(o.rig)
    good = [w for w in WIRINGS if len(differences(w, file)) == 1][:4]
    monkeypatch.setattr(setup, 'load_sizes', lambda m, w: (0.0 if w in good else m.squared, np.ones(3)))
    _, (finding,), _ = setup.correct_wiring([o], ())
    assert len(finding.equivalent) == 2


@pytest.mark.parametrize(
    ('n', 'height', 'observed'), [(100, 2.03**0.5, True), (100, 1.97**0.5, False), (50, 9.0, True), (49, 9.0, False)]
)
def test_a_jump_is_a_step_that_gains_fifty(n: int, height: float, observed: bool) -> None:
    """In the middle of n values it gains h^2 n/4."""
    for psd in (1, 2):
        part = np.zeros((6, n))
        part[3 * psd - 2, n // 2 :] = height
        ws = SimpleNamespace(split=lambda _, part=part: [part], fine=[4], observations=[SimpleNamespace(period=1e-3)])
        found = setup.likely_jumps(cast(Workspace, ws), np.empty(0))
        assert [(r, p) for r, p, _ in found] == [(1, psd)] * observed
        assert [t for *_, t in found] == pytest.approx([n // 2 * 4e-3] * observed)


# The words of the answer.


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
    got = readings.with_first_dose(effect, {p.name: p.nominal for p in parameters})
    want = {'plain': 0.6, 'near': 0.55, 'listed': 0.4, 'far': 1.0, 'shape': 2.0, 'alone': 5.0, 'with_it': 1.0}
    assert got == pytest.approx(want)


def test_where_something_is_left_does_not_depend_on_the_units_of_what_is_fitted() -> None:
    workspace = Workspace([make_observation(warm=None)])
    known = np.random.default_rng(3).standard_normal((len(workspace.whiten(workspace.measured)), 2))
    residual = workspace.residual([])[0]
    one, other = (
        localise.localise(workspace, residual, k, np.random.default_rng(0)) for k in (known, known * [1e6, 1e-6])
    )
    assert one.p == pytest.approx(other.p)
    assert [d.gain for d in one.dependences] == pytest.approx([d.gain for d in other.dependences])
    # A column that is all of what noise draws leaves less of it.
    assert [c.p for c in one.cells] == pytest.approx([c.p for c in other.cells])


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_a_time_moves_by_up_to_168_ms(monkeypatch: pytest.MonkeyPatch, sign: float) -> None:
    """Twice by up to 80 ms, and then by eight samples: the ends are tried too."""
    wanted = 1.0 + sign * 0.168

    def score(found: object, tries: list[LawTerm], targets: object) -> list[law_features.Scored]:
        best = min(tries, key=lambda t: abs(t.times[0] - wanted))
        return [law_features.Scored('y1', best, 1.0)]

    monkeypatch.setattr(law_features, 'score', score)
    found = cast(list[Response], [SimpleNamespace(period=1e-3)])
    got = law_features.with_better_times(found, 'y1', LawTerm('switched', (), times=(1.0,)))
    assert got.times == pytest.approx((wanted,), abs=1e-9)


def test_a_law_of_the_noise_passes_at_the_p_of_its_limit_and_not_at_the_bic(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    o = make_observation(6)
    volts = o.volts.copy()
    volts[:, 4] += 2e-3 * (o.loads[:, 1] / np.abs(o.loads[:, 1]).max()) * rng.standard_normal(len(volts))
    workspace = Workspace([dataclasses.replace(o, volts=volts)])
    fit = refit(workspace, ())
    found = laws.find_jitter(workspace, fit, 3.0)
    assert found is not None
    assert found.p > 0.0
    # A part in 10^9 beside the limit: the second search rounds otherwise.
    monkeypatch.setattr(laws, 'P_ACCEPT', found.p * (1.0 + 1e-9))
    assert laws.find_jitter(workspace, fit, 3.0) is not None
    monkeypatch.setattr(laws, 'BIC_ACCEPT', found.delta_bic + 1e-9 * abs(found.delta_bic))
    assert laws.find_jitter(workspace, fit, 3.0) is None


@pytest.mark.parametrize(('gains', 'share'), [((-5.0, 1.0), 0.0), ((3.0, 2.0), 0.5), ((30.0, 2.0), 1.0)])
def test_tied_effects_explain_none_to_all_of_the_gap(gains: tuple[float, float], share: float) -> None:
    tie = coincidence.Coincidence(((0, 'x'), (1, 'x')), (1.0, 1.0), 'V', 50.0)
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


@pytest.mark.parametrize('together', [0.9, -0.9])
def test_two_sizes_agree_as_their_ratio_is_known(together: float) -> None:
    """The variance of log a/b is that of a/a0 - b/b0: small if both go together."""
    rng = np.random.default_rng(0)
    jacobian = rng.standard_normal((200, 2)) * 1e3
    jacobian[:, 1] = -together * jacobian[:, 0] + math.sqrt(1.0 - together**2) * jacobian[:, 1]
    sizes, free = (1.0, 1.002), ((0, 'x'), (1, 'x'))
    effects = (active('a', -9.0, 9.0, x=sizes[0]), active('b', -9.0, 9.0, x=sizes[1]))
    fit = Fit(effects, 0.0, np.zeros(200), [], jacobian, free, ())
    (tie,) = coincidence.coincidences(fit, Physics.of(RIG))
    slope = np.array([1.0, -1.0]) / sizes
    sd = math.hypot(math.sqrt(slope @ np.linalg.inv(jacobian.T @ jacobian) @ slope), 0.003)
    z = math.log(sizes[0] / sizes[1]) / sd
    want = 2.0 * math.log(10.0) * math.exp(-0.5 * z * z) / (sd * math.sqrt(2.0 * math.pi))
    assert tie.odds == pytest.approx(want, rel=1e-6)
    assert (tie.members, tie.sizes, tie.unit) == (free, sizes, 'V')


@pytest.mark.parametrize(('rest', 'listed'), [(1e-8, False), (1e-5, True)])
def test_what_the_model_has_already_is_followed_by_nothing(rest: float, listed: bool) -> None:
    plant = Plant(pictures(A), noise())
    values = np.sin(np.arange(FINE))
    row = np.zeros((6, FINE))
    row[0] = values
    aside = np.zeros((6, FINE))
    aside[1] = values
    known = (math.sqrt(1.0 - rest) * row + math.sqrt(rest) * aside).reshape(-1, 1)
    found = dependences(plant, [('x1', {'wave': [values]})], plant.whiten(plant.measured), known)
    assert bool(found) == listed


def test_of_two_that_are_one_the_sum_is_known() -> None:
    fit = refit(Plant(pictures(A), noise()), [active('a', x=0.0)])
    twice = dataclasses.replace(
        fit, jacobian=np.repeat(fit.jacobian, 2, axis=1), free=((0, 'x'), (1, 'x')), effects=fit.effects * 2
    )
    np.testing.assert_allclose(twice.covariance(), 0.25 * fit.covariance()[0, 0] * np.ones((2, 2)), rtol=1e-6)


def test_a_variable_is_known_as_means_of_the_blocks_of_an_estimate() -> None:
    workspace = Workspace([make_observation(warm=None), make_observation(1, name='second', warm=None)])
    for o, got in zip(workspace.observations, law_features.known_values(workspace, (), 'load_fy'), strict=True):
        np.testing.assert_allclose(got, o.loads[:, 1].reshape(-1, 20).mean(axis=1), atol=1e-12)


@pytest.mark.parametrize(('nominal', 'choices', 'kept'), [(1.0, (0, 1), 1), (0.0, (0, 1), 0), (5.0, (2, 3), 2)])
def test_a_choice_that_makes_no_difference_stays_as_it_is(nominal: float, choices: tuple[int, ...], kept: int) -> None:
    way = EffectParameter('way', '', 0, 9, 1, '', nominal=nominal, kind='choice', choices=choices)
    assert readings.fixed_choice(way).choices == (kept,)
    psd = dataclasses.replace(way, each=True)
    size = EffectParameter('size', 'V', -1.0, 1.0, 0.1, '')
    assert readings.fixed_choice(psd) is psd
    assert readings.fixed_choice(size) is size


def test_the_nuisance_takes_part_in_no_tie() -> None:
    rng = np.random.default_rng(0)
    jacobian = rng.standard_normal((200, 3)) * 1e4
    effects = (active('a', -9.0, 9.0, x=1.0), active('b', -9.0, 9.0, x=1.0))
    beside = active('n', -9.0, 9.0, x=1.0)
    for free in (((-1, 'x'), (0, 'x'), (1, 'x')), ((0, 'x'), (-1, 'x'), (1, 'x'))):
        fit = Fit(effects, 0.0, np.zeros(200), [], jacobian, free, (), (beside,))
        (tie,) = coincidence.coincidences(fit, Physics.of(RIG))
        assert tie.members == ((0, 'x'), (1, 'x'))


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_what_is_pushed_against_its_bound_leaves_the_others_alone(sign: float) -> None:
    """However little it is pushed: the first step of the rest is that of least squares without it."""
    shown = pictures(A)
    a = shown[A] / np.linalg.norm(shown[A]) * SIGMA
    rest = np.random.default_rng(3).standard_normal(a.shape)
    across = rest - a * np.sum(a * rest) / np.sum(a * a)
    b = 0.6 * a + 0.8 * across / np.linalg.norm(across) * SIGMA
    plant = Plant({A: a * 1e3, ('b', 'x'): b * 1e3}, -0.5 * sign * a + 3.0 * across / np.linalg.norm(across) * SIGMA)
    least, most = (0.0, 1.0) if sign > 0.0 else (-1.0, 0.0)
    fit = refit(plant, [active('a', least, most, x=0.0), active('b', x=0.0)], iterations=1)
    want = np.sum(plant.measured[0] * b) / np.sum(b * b) / 1e3
    assert fit.effects[1].values['x'] == pytest.approx(want, rel=1e-3)
