# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The formulas behind a law, piece by piece: grids counted by hand, sums written out, states by brute force."""

import dataclasses
import itertools
import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_law

from psd_deflection.model.simulation.catalogue import make_active
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.laws import TARGETS, Law, LawTerm, effect_of, values_of, variables_of
from psd_deflection.records import CHANNELS
from psd_deflection.studies.discover import law_features, laws
from psd_deflection.studies.discover.law_features import responses, score, switchings, terms
from psd_deflection.studies.discover.search.fit import Fit, heldout_gap, refit
from psd_deflection.studies.discover.search.workspace import Workspace

from .test_formulas import RIG, make_observation
from .test_rules import FINE, SIGMA, A, Plant, active


@pytest.fixture(scope='module')
def observed() -> tuple[Workspace, Fit]:
    """1.2 s of noise, and a fit of one effect to it."""
    workspace = Workspace([make_observation(3)])
    return workspace, refit(workspace, [make_active('sensor_rotation', {'psd': 2, 'angle': 0.0}, 'test')], 2)


def term_names(terms: list[LawTerm]) -> dict[tuple[str, tuple[str, ...]], list[dict[str, float]]]:
    out: dict[tuple[str, tuple[str, ...]], list[dict[str, float]]] = {}
    for t in terms:
        out.setdefault((t.form, t.of), []).append(dict(t.shapes))
    return out


def test_two_dozen_values_are_few_and_one_more_is_many(observed: tuple[Workspace, Fit]) -> None:
    (r,) = responses(*observed)
    for count in (24, 25):
        values = np.arange(count) ** 2.0
        known = {n: np.zeros(1200) for n in variables_of(2)} | {'load_fy': np.resize(values, 1200)}
        got = term_names(list(terms([dataclasses.replace(r, known=known)])))
        # The play of a clamp is a width.
        assert all(s['half_width'] > 0.0 for s in got['play', ('load_fy',)])
        between = 0.5 * (values[1:] + values[:-1]) if count == 24 else values[-1] * (np.arange(24) + 0.5) / 24
        assert [s['threshold'] for s in got['over', ('load_fy',)]] == pytest.approx(between.tolist())


@pytest.mark.parametrize(
    ('target', 'of'),
    [
        *(('x1', 'load_fy'), ('y2', 'dx'), ('sum1', 'load_tz'), ('sum2', 'temperature'), ('dx', 'load_tz')),
        *(('theta', 'dy'), ('static_dy', 'load_fx'), ('static_theta', 'load_fx')),
    ],
)
def test_a_gain_is_that_of_the_simulated_picture(observed: tuple[Workspace, Fit], target: str, of: str) -> None:
    """The term is put into the simulation, and its picture, freed of what the fit explains, held to the residual."""
    workspace, fit = observed
    law = Law('one', TARGETS[target].stage, target, (LawTerm('product', (of,), 1.0),))
    size = {'load_fy': 1e-9, 'load_tz': 1e-9, 'dx': 1e-5, 'dy': 1e-5, 'load_fx': 1e-9, 'temperature': 1e-9}[of]
    size *= 1e3 if target.startswith('sum') else 1.0
    values = {**values_of(law), 'c1': size}
    base = [*workspace.base, *fit.effects]
    there = workspace.simulate([*base, ActiveEffect(effect_of(law), values)])
    picture = workspace.whiten([a - b for a, b in zip(there, workspace.simulate(base), strict=True)]) / size
    q, _ = np.linalg.qr(fit.jacobian)
    across = picture - q @ (q.T @ picture)
    want = float(across @ fit.residual) ** 2 / float(across @ across)
    answers = responses(workspace, fit)
    (got,) = score(answers, [LawTerm('product', (of,))], (target,))
    # A first-order answer: held over a fine block, and the optics at the middle of it.
    assert got.gain == pytest.approx(want, rel=0.1, abs=0.02)
    assert got.term.coefficient == pytest.approx(float(across @ fit.residual) / float(across @ across), rel=0.1)
    assert score(answers, [LawTerm('product', ('dx',))], ('static_dx', 'load_fx')) == []


def test_what_a_target_lacks_is_estimated_with_its_weight(observed: tuple[Workspace, Fit]) -> None:
    """Of a dot: the residual in volts times the sensitivity, weighted by the noise. It costs one simulation."""
    workspace, fit = observed
    before = workspace.simulations
    (r,) = responses(workspace, fit)
    assert workspace.simulations == before + 1
    noise, sensitivity = workspace.noise[0], RIG.sensitivities.ravel()
    (part,) = workspace.split(fit.residual)
    assert not any(noise.coloured)
    for i, channel in enumerate(('x1', 'y1', 'x2', 'y2')):
        c, t = CHANNELS.index(channel), law_features.SOUGHT.index(channel)
        np.testing.assert_allclose(r.error[t], part[c] * noise.innovation[c] * sensitivity[i], rtol=1e-9)
        np.testing.assert_allclose(r.power[t], 1.0 / (noise.innovation[c] * sensitivity[i]) ** 2, rtol=1e-9)
    for i, channel in enumerate(('sum1', 'sum2')):
        t = law_features.SOUGHT.index(channel)
        np.testing.assert_allclose(r.error[t], part[3 * i + 2] * noise.innovation[3 * i + 2], rtol=1e-9)
    assert (r.period, r.fine) == (1e-3, 4)
    dynamics = RIG.dynamics
    assert r.rings == (round(1.0 / dynamics.bending_frequency / 0.004), round(1.0 / dynamics.torsion_frequency / 0.004))


@pytest.mark.parametrize('seed', range(6))
def test_the_likeliest_states_are_those_of_all_that_gain_most(seed: int) -> None:
    """Of 2^10 sequences; each change costs 10 + 2 ln 10, and the state before the first is 0."""
    gain, cost = np.random.default_rng(seed).normal(3.0, 25.0, 10), 10.0 + 2.0 * math.log(10.0)
    best = max(
        itertools.product((0, 1), repeat=10),
        key=lambda s: (
            sum(g for g, on in zip(gain, s, strict=True) if on) - cost * int(np.abs(np.diff(s, prepend=0)).sum())
        ),
    )
    assert law_features.likeliest_states(gain).tolist() == list(best)


def test_two_levels_are_separated_from_a_stated_gain_on() -> None:
    """A box of the height A and n blocks of weight w gains n w A^2 in chi-square, for two changes of 20.6."""
    rng, n = np.random.default_rng(2), 200
    pulses = np.zeros(n)
    pulses[60:110] = 2.0
    pulses[150:170] = 2.0
    v = rng.uniform(0.5, 2.0, n) * rng.choice((-1.0, 1.0), n)
    v[5] = 0.0
    assert law_features.two_levels(pulses * v, np.full(n, 3.0), v) == [60, 110, 150, 170]
    ones, box = np.ones(n), np.zeros(n)
    box[60:110] = 1.0
    assert law_features.two_levels(box, ones * 1.2 * 41.2 / 50.0, ones) == [60, 110]
    assert law_features.two_levels(box, ones * 0.8 * 41.2 / 50.0, ones) == []
    assert law_features.two_levels(box, ones * 0.4 * 41.2 / 50.0, ones) == []
    assert law_features.two_levels(np.zeros(n), ones, ones) == []
    # However little each block weighs: 50 of 0.01, of a level of 6, gain 18, more than 10 + 2 ln 50.
    assert law_features.two_levels(np.full(50, 6.0), np.full(50, 0.01), np.ones(50)) == [0]
    assert law_features.two_levels(np.full(50, 5.9), np.full(50, 0.01), np.ones(50)) == []
    # To the end of the recording one change is enough.
    late = np.zeros(n)
    late[150:] = -1.0
    assert law_features.two_levels(late, ones, ones) == [150]


def test_times_that_show_are_terms_and_become_better(observed: tuple[Workspace, Fit]) -> None:
    law = Law('bump', 'psd', 'y1', (LawTerm('switched', (), 3e-5, times=(0.313, 0.871)),))
    workspace = Workspace([make_observation(4, (ActiveEffect(effect_of(law), values_of(law)),))])
    answers = responses(workspace, refit(workspace, ()))
    first, *_ = switchings(answers, ('y1',))
    assert (first.form, first.of) == ('switched', ())
    assert first.times == pytest.approx((0.313, 0.871), abs=0.0011)
    rough = law_features.with_better_times(answers, 'y1', LawTerm('switched', (), times=(0.25, 0.95)))
    assert rough.times == pytest.approx((0.313, 0.871), abs=0.0011)
    assert {t.of for t in switchings(answers, ('y1',))} <= {(), ('x1',), ('y1',)}


@pytest.mark.parametrize(('times', 'at'), [((4.9, 8.1, 12.0), True), ((4.9, 10.0, 12.0), False), ((5.0, 8.0), False)])
def test_times_are_those_of_loads_if_most_are(times: tuple[float, ...], at: bool) -> None:
    """The loads change after 5 s and 8 s; two times are too few."""
    loads = np.repeat([(0.0, 0.0, 0.0), (0.0, -10.0, 0.0), (5.0, -10.0, 0.0)], (500, 300, 1200), axis=0)
    o = SimpleNamespace(loads=loads, period=0.01, duration=20.0)
    law = Law('bump', 'psd', 'y1', (LawTerm('switched', (), times=times),))
    assert laws.at_load_changes(cast(Workspace, SimpleNamespace(observations=(o,))), [law]) is at


@pytest.mark.parametrize('form', ['over', 'under'])
def test_a_level_at_which_a_dot_jumps_becomes_better(form: str) -> None:
    (ringing,) = law_features.known_fine(Workspace([make_observation(4)]), (), 'y1')
    level = float(np.quantile(ringing[np.abs(ringing) > 1e-6], 0.6))
    law = Law('bump', 'psd', 'x1', (LawTerm(form, ('y1',), 3e-5, {'threshold': level}),))
    workspace = Workspace([make_observation(4, (ActiveEffect(effect_of(law), values_of(law)),))])
    answers = responses(workspace, refit(workspace, ()))
    pitch = float(np.ptp(ringing)) / 24
    for start in (level - 0.9 * pitch, level + 0.9 * pitch):
        rough = score(answers, [LawTerm(form, ('y1',), shapes={'threshold': start})], ('x1',))[0]
        better = law_features.with_better_level(answers, rough)
        assert better.gain > rough.gain
        assert better.term.shapes['threshold'] == pytest.approx(level, abs=0.04 * pitch)
        assert better.term.coefficient == pytest.approx(3e-5, rel=0.02)
        assert 0.0 < better.term.sd['threshold'] < 0.04 * pitch
    exact = score(answers, [LawTerm('above', ('y1',), shapes={'threshold': level})], ('x1',))[0]
    assert law_features.with_better_level(answers, exact) is exact


def test_between_two_loads_any_level_is_as_good(observed: tuple[Workspace, Fit]) -> None:
    """Its middle is told, and the width of what is between, as a standard deviation; the fit keeps both."""
    workspace, fit = observed
    answers = responses(workspace, fit)
    levels = np.unique(answers[0].known['load_fx'])
    low, high = levels[-2:].tolist()
    start = score(answers, [LawTerm('over', ('load_fx',), shapes={'threshold': low + 0.1 * (high - low)})], ('x2',))[0]
    better = law_features.with_better_level(answers, start)
    assert better.gain == pytest.approx(start.gain)
    assert better.term.shapes['threshold'] == pytest.approx(0.5 * (low + high))
    assert better.term.sd['threshold'] == pytest.approx((high - low) / math.sqrt(12.0))
    seeker = laws.LawSearch(workspace, fit, 3.0)
    (law,) = seeker.trial([laws.law_on('x2', better.term)], fit.effects, 2).laws
    assert law.terms[0].sd['threshold'] == better.term.sd['threshold']
    assert f'> ({0.5 * (low + high):.4g} ± ' in law.expression


def test_fitted_law_has_fit_numbers_and_deviations() -> None:
    law = Law(
        'law_y2', 'psd', 'y2', (LawTerm('above', ('load_fy',), shapes={'threshold': 4.0}), LawTerm('product', ('dx',)))
    )
    values = {'c1': 2.0, 'threshold1': 5.0, 'c2': -3.0}
    beside = make_active('sensor_gain', {'psd': 1, 'x': 0.1, 'y': 0.2}, 'test')
    jacobian = np.random.default_rng(0).standard_normal((30, 5)) * [1.0, 2.0, 3.0, 4.0, 0.005]
    free = ((0, 'x'), (0, 'y'), (1, 'c1'), (1, 'threshold1'), (1, 'c2'))
    fit = Fit((beside, ActiveEffect(effect_of(law), values)), 0.0, np.zeros(30), [], jacobian, free, ())
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(laws.term_covariance(fit), covariance, rtol=1e-6)
    sd = np.sqrt(np.diag(covariance))
    got = laws.fitted_law(law, fit, laws.term_covariance(fit), 1)
    first, second = got.terms
    assert (first.coefficient, first.shapes, second.coefficient) == (2.0, {'threshold': 5.0}, -3.0)
    assert first.sd == pytest.approx({'coefficient': sd[2], 'threshold': sd[3]})
    assert second.sd == pytest.approx({'coefficient': sd[4]})
    assert dataclasses.replace(got, terms=()) == dataclasses.replace(law, terms=())
    # A hundred times its value is no deviation: the recording does not determine the number.
    for factor, reported in ((99.0, True), (101.0, False)):
        wide = np.array(covariance, dtype=np.float64)
        wide[4, 4] = (factor * 3.0) ** 2
        assert ('coefficient' in laws.fitted_law(law, fit, wide, 1).terms[1].sd) == reported
    # Two pictures that are one: what cannot be distinguished has a large deviation, and stays finite.
    same = dataclasses.replace(fit, jacobian=np.column_stack((jacobian[:, :4], jacobian[:, 3])))
    assert laws.term_covariance(same)[3, 3] > 1e6 * covariance[3, 3]


def test_terms_join_law_of_quantity_and_leave_singly() -> None:
    a, b, c = (LawTerm('product', (v,)) for v in ('load_fx', 'load_fy', 'load_tz'))
    first = Law('law_y2', 'psd', 'y2', (a,))
    (both,) = laws.with_term([first], law_features.Scored('y2', b, 1.0))
    assert both == Law('law_y2', 'psd', 'y2', (a, b))
    two = laws.with_term([both], law_features.Scored('static_dx', c, 1.0))
    assert two == (both, Law('law_static_dx', 'link', 'static_dx', (c,)))
    x1 = Law('law_static_dx', 'link', 'static_dx', (c,))
    assert laws.subsets_without_a_term(two) == [
        (dataclasses.replace(both, terms=(b,)), x1),
        (dataclasses.replace(both, terms=(a,)), x1),
        (both,),
    ]


def trial(law: Law, cost: float, chi2: float, *beside: ActiveEffect) -> laws.LawTrial:
    fit = SimpleNamespace(chi2=chi2, effects=(*beside, ActiveEffect(effect_of(law), values_of(law))))
    return laws.LawTrial((law,), cast(Fit, fit), cost)


def test_of_laws_that_cannot_be_separated_the_simplest_is_taken() -> None:
    two = trial(Law('a', 'psd', 'y2', (LawTerm('product', ('load_fx', 'load_fy')),)), 10.0, 5.0)
    simple = Law('b', 'psd', 'y2', (LawTerm('product', ('x2',)),))
    assert laws.simplest(two, [trial(simple, 19.9, 26.5)]).laws == (simple,)
    assert laws.simplest(two, [trial(simple, 20.1, 6.0)]) is two
    assert laws.simplest(two, [trial(simple, 11.0, 26.7)]) is two
    # Beside other effects it is another answer; a dot goes before the pose; of equals the cheaper.
    assert laws.simplest(two, [trial(simple, 11.0, 6.0, make_active('creep', {'amplitude': 0.1}, 'test'))]) is two
    of_pose = trial(Law('c', 'psd', 'y2', (LawTerm('product', ('dx',)),)), 5.0, 5.0)
    assert laws.simplest(of_pose, [trial(simple, 6.0, 5.0)]).laws == (simple,)
    on_link = trial(Law('c', 'link', 'theta', (LawTerm('product', ('dx',)),)), 5.0, 5.0)
    assert laws.simplest(on_link, [trial(simple, 6.0, 5.0)]) is on_link
    assert laws.simplest(trial(simple, 6.0, 5.0), [on_link]) == on_link


def test_laws_that_the_recording_cannot_exclude_are_listed_once() -> None:
    best = Law('a', 'psd', 'y2', (LawTerm('product', ('load_fx',)),))
    beam, link = dataclasses.replace(best, stage='optics', acts_on='beam_y2'), Law('b', 'link', 'dy', best.terms)
    of_dx, of_theta = dataclasses.replace(link, acts_on='dx'), dataclasses.replace(link, acts_on='theta')
    trials = [
        trial(link, 31.5, 26.5),
        trial(beam, 12.0, 6.0),
        trial(dataclasses.replace(beam, name='again'), 14.0, 6.0),
        trial(of_dx, 11.0, 26.7),
        trial(of_theta, 31.7, 5.0),
        trial(best, 10.0, 5.0),
    ]
    assert laws.tied_laws(trial(best, 10.0, 5.0), trials) == (beam, link)


def test_variances_are_the_likeliest() -> None:
    """a and b of a + b v^2 against a scan of the likelihood of normal values, which is its sum of logarithms."""
    rng = np.random.default_rng(3)
    v2 = rng.uniform(0.0, 1.0, 4000)
    squares = (1.0 + 0.7 * v2) * rng.standard_normal(4000) ** 2
    a, b = law_features.variance(squares, v2)

    def likelihood(a: float, b: float) -> float:
        return float(sum(-math.log(a + b * v) - s / (a + b * v) for s, v in zip(squares, v2, strict=True)))

    assert law_features.likelihood(squares, a + b * v2) == pytest.approx(likelihood(a, b))
    assert law_features.likelihood(squares, 2.0) == pytest.approx(likelihood(2.0, 0.0))
    here = likelihood(a, b)
    for da, db in ((0.02, 0.0), (-0.02, 0.0), (0.0, 0.04), (0.0, -0.04)):
        assert likelihood(a + da, b + db) < here
    # Noise does not grow negative, nor vanish.
    assert law_features.variance(squares, 1.0 - v2)[1] == 0.0
    assert law_features.variance(np.full(10, 1e-6), np.linspace(0.0, 1.0, 10)) == pytest.approx((0.05, 0.0), abs=1e-9)


def test_noise_growing_with_load_has_size_and_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the likelihoods of the same squares, counted here."""
    rng, o = np.random.default_rng(5), make_observation(6)
    volts, full = o.volts.copy(), np.abs(o.loads[:, 1]).max()
    volts[:, 4] += 4e-3 * (o.loads[:, 1] / full) * rng.standard_normal(len(volts))
    workspace = Workspace([dataclasses.replace(o, volts=volts)])
    fit = refit(workspace, ())
    trial = laws.find_jitter(workspace, fit, 3.0)
    assert trial is not None
    (term,) = trial.law.terms
    assert (trial.law.acts_on, trial.law.stage, term.form, trial.channels) == ('y2', 'electronics', 'jitter', ('y2',))
    assert term.of in (('load_fy',), ('y1',), ('y2',), ('dy',))
    squares = workspace.split(fit.residual)[0][4] ** 2
    known = law_features.known_fine(workspace, (), term.of[0])[0]
    a, b = law_features.variance(squares, known**2 / (known**2).max())
    gain = law_features.likelihood(squares, a + b * known**2 / (known**2).max()) - law_features.likelihood(
        squares, squares.mean()
    )
    assert trial.delta_bic == pytest.approx(gain - 3.0, rel=1e-9)
    # Of block means: what is added to one sample, by the square root of four samples in a fine block.
    scale = workspace.noise[0].innovation[4] * math.sqrt(4.0) * float(RIG.sensitivities.ravel()[3])
    assert term.coefficient == pytest.approx(math.sqrt(b / (known**2).max()) * scale, rel=1e-9)
    assert term.sd == pytest.approx({'coefficient': term.coefficient / math.sqrt(gain)})
    assert trial.heldout.error == pytest.approx(math.sqrt(gain))
    # Each fold of load cases with the variances of the others.
    fold = np.concatenate([workspace.folds()[case] for case in workspace.case])
    v2, want = known**2 / (known**2).max(), 0.0
    for k in set(fold.tolist()):
        a, b = law_features.variance(squares[fold != k], v2[fold != k])
        held_out = squares[fold == k]
        want += law_features.likelihood(held_out, a + b * v2[fold == k]) - law_features.likelihood(
            held_out, squares[fold != k].mean()
        )
    assert trial.heldout.gain == pytest.approx(0.5 * want, rel=1e-9)
    assert (trial.laws, [law.stage for law in trial.equivalent]) == ((trial.law,), ['psd'])
    assert trial.adopted('mine') == dataclasses.replace(trial.law, name='mine')
    # One cause on two quantities is one law.
    other = dataclasses.replace(trial.law, acts_on='x1')
    twice = dataclasses.replace(trial, further=(other,))
    assert (twice.adopted('mine'), trial.beside) == (dataclasses.replace(trial.law, name='mine', further=(other,)), ())
    added = float(np.mean((term.coefficient * known) ** 2)) / 4.0 / 20.0
    assert trial.heldout_gap == pytest.approx(math.sqrt(max(heldout_gap(workspace, fit) ** 2 - added, 0.0)), rel=1e-9)
    assert laws.find_jitter(workspace, fit, gain) is None
    # Of a gap beyond the noise it explains half, or is no law; noise alone may leave 1.1 floors.
    half, more = Workspace([dataclasses.replace(o, volts=0.5 * (o.volts + volts))]), added / workspace.floor() ** 2
    for ws, floors, there in (
        (workspace, math.sqrt(1.0 + more / 0.55), True),
        (workspace, math.sqrt(1.0 + more / 0.45), False),
        (half, 1.09, True),
        (half, 1.11, False),
    ):
        fit = refit(ws, ())
        wider = [d * floors * ws.floor() / ws.gap(fit.difference) for d in fit.difference]
        assert (laws.find_jitter(ws, dataclasses.replace(fit, difference=wider), 3.0) is not None) is there
    # By chance at most once in a hundred times, of all that was tried.
    fit = refit(workspace, ())
    most, _ = law_features.most_jitter(workspace, fit, {term.of[0]: [known]})
    assert most is not None
    for p, there in ((0.0099, True), (0.0101, False)):
        monkeypatch.setattr(laws, 'most_jitter', lambda *_, p=p: ((60.0, *most[1:]), p / chi2_law.sf(60.0, 1)))
        assert (laws.find_jitter(workspace, fit, 3.0) is not None) is there


def test_a_law_shows_where_a_twentieth_of_its_energy_is(observed: tuple[Workspace, Fit]) -> None:
    workspace, _ = observed
    big = Law('big', 'psd', 'y2', (LawTerm('product', ('load_fy',), 1e-5),))
    for share, shown in ((0.06, ('x1', 'y2')), (0.04, ('y2',))):
        # The residuals' energies per volt are those of the channels' noise.
        sigma = workspace.noise[0].innovation
        ratio = math.sqrt(share / (1.0 - share)) * sigma[0] / sigma[4]
        small = Law('small', 'psd', 'x1', (LawTerm('product', ('load_fy',), 1e-5 * ratio),))
        effects = tuple(ActiveEffect(effect_of(law), values_of(law)) for law in (big, small))
        fit = refit(workspace, effects, 0)
        assert laws.dominant_channels(workspace, laws.LawTrial((big, small), fit, 0.0)) == shown


class Given(laws.LawSearch):
    """A search whose trials cost what ``costs`` says of (terms' variables, effects beside them); 1000 else."""

    def __init__(self, costs: dict[tuple[str, str], float], chi2: float = 1e9) -> None:
        self.costs, self.chi2, self.asked = costs, chi2, list[tuple[str, str, int]]()
        self.ws = cast(
            Workspace, SimpleNamespace(size=200, simulations=0, physics=Workspace([make_observation()]).physics)
        )
        self.start = cast(Fit, SimpleNamespace(effects=()))
        self.penalty, self.last, self.responses, self.listed = 3.0, 600, [], []

    def trial(self, tried: Any, beside: Any, iterations: int) -> laws.LawTrial:
        key = ' '.join(v for law in tried for t in law.terms for v in t.of), ' '.join(a.effect.name for a in beside)
        self.asked.append((*key, iterations))
        effects = (*beside, *(ActiveEffect(effect_of(law), values_of(law)) for law in tried))
        fit = cast(Fit, SimpleNamespace(chi2=self.chi2, effects=effects, parameters=1))
        return laws.LawTrial(tuple(tried), fit, self.costs.get(key, 1000.0))


def law_of(*variables: str, on: str = 'y2') -> Law:
    return Law(f'law_{on}', TARGETS[on].stage, on, tuple(LawTerm('product', (v,)) for v in variables))


BESIDE = (make_active('creep', {'amplitude': 0.1}, 't'), make_active('sensor_gain', {'psd': 1, 'x': 0.1}, 't'))


@pytest.mark.parametrize(
    ('more', 'remaining'), [(9.9, ('sensor_gain',)), (10.0, ('sensor_gain',)), (10.1, ('creep', 'sensor_gain'))]
)
def test_an_effect_that_stood_in_for_the_law_goes(more: float, remaining: tuple[str, ...]) -> None:
    """If that costs no more than an effect must gain."""
    seeker = Given({('dx', 'creep sensor_gain'): 50.0, ('dx', 'sensor_gain'): 50.0 + more, ('dx', 'creep'): 90.0})
    got = seeker.lean(seeker.trial([law_of('dx')], BESIDE, 1))
    assert tuple(a.effect.name for a in got.beside) == remaining


@pytest.mark.parametrize(('without', 'terms_left'), [(109.9, 'dx'), (110.0, 'dx'), (110.1, 'dx dy')])
def test_a_term_that_the_law_does_not_miss_goes(without: float, terms_left: str) -> None:
    seeker = Given({('dx dy', ''): 100.0, ('dx', ''): without, ('dy', ''): 300.0}, chi2=0.0)
    got = seeker.grown(seeker.trial([law_of('dx', 'dy')], (), 1))
    assert (' '.join(got.variables), got.terms) == (terms_left, len(terms_left.split()))


@pytest.mark.parametrize(('second', 'grown'), [(89.9, 'dx dy'), (90.0, 'dx'), (90.1, 'dx')])
def test_a_further_term_must_gain_as_an_effect_must(monkeypatch: pytest.MonkeyPatch, second: float, grown: str) -> None:
    offered = [
        law_features.Scored('y2', LawTerm('product', (v,)), g) for v, g in (('theta', 9.0), ('dy', 8.0), ('x1', 7.0))
    ]
    monkeypatch.setattr(laws, 'responses', lambda *_: [])
    monkeypatch.setattr(laws, 'score', lambda *_: offered)
    seeker = Given({('dx', ''): 100.0, ('dx dy', ''): second})
    assert ' '.join(seeker.grown(seeker.trial([law_of('dx')], (), 1)).variables) == grown
    # The two that explain most are refitted, no third.
    assert ('dx theta', '', 4) in seeker.asked
    assert ('dx x1', '', 4) not in seeker.asked
    # No more than four terms, however good.
    ever = Given({})
    ever.costs = cast(Any, SimpleNamespace(get=lambda key, _: 1000.0 - 50.0 * len(key[0].split())))
    assert ever.grown(ever.trial([law_of('dx')], (), 1)).terms == 4


def test_a_search_is_done_when_noise_is_left_or_enough_was_tried() -> None:
    """Of 200 values four deviations of their chi-square, 4 sqrt(400) = 80."""
    seeker = Given({})
    for chi2, simulations, done in ((279.0, 0, True), (281.0, 0, False), (281.0, 600, False), (281.0, 601, True)):
        seeker.chi2, seeker.ws = chi2, cast(Workspace, SimpleNamespace(size=200, simulations=simulations))
        assert seeker.done(seeker.trial([law_of('dx')], (), 1)) == done


def test_whatever_was_looked_for_counts_as_a_parameter() -> None:
    seeker = Given({})
    fit = cast(Fit, SimpleNamespace(chi2=50.0, parameters=2))
    assert seeker.cost([law_of('dx')], fit) == 56.0
    switched = Law('s', 'psd', 'y2', (LawTerm('switched', (), times=(1.0, 2.0, 3.0)),))
    assert seeker.cost([switched, law_of('dx')], fit) == 65.0


def test_the_best_of_each_kind_is_refitted_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Down to three tenths of the best gain, a dozen at most; the cheapest three once more in full."""
    names = list(variables_of(2))
    scored = [law_features.Scored('y2', LawTerm('product', (v,)), 100.0 - i) for i, v in enumerate(names)]
    scored.insert(1, dataclasses.replace(scored[0], gain=99.5))
    scored.append(dataclasses.replace(scored[0], target='y1', gain=80.0))
    monkeypatch.setattr(laws, 'score', lambda *_: scored)
    seeker = Given({(v, ''): 100.0 - i for i, v in enumerate(names)})
    got = seeker.first()
    assert [a[0] for a in seeker.asked if a[2] == 3] == names[:12]
    assert [a[0] for a in seeker.asked if a[2] == 8] == names[::-1][:3]
    assert ([t.cost for t in got], len(got)) == (sorted(t.cost for t in got), 12)
    weak = [scored[0], law_features.Scored('y2', LawTerm('product', ('dy',)), 29.9)]
    monkeypatch.setattr(laws, 'score', lambda *_: weak)
    seeker = Given({})
    assert len(seeker.first()) == 1


def test_a_law_shows_where_it_has_a_twentieth_of_its_energy() -> None:
    shown = {A: np.zeros((6, FINE))}
    shown[A][[0, 1, 4]] = SIGMA * np.array([[0.5], [3.0], [1.0]])
    plant = Plant(shown, shown[A])
    fit = refit(plant, [active('a', x=0.5)])
    best = cast(laws.LawTrial, SimpleNamespace(fit=fit, beside=()))
    # Of 10.25 parts they have 0.25, 9 and 1.
    assert laws.dominant_channels(plant, best) == ('y1', 'y2')


def test_a_law_shows_alike_at_other_stages() -> None:
    """A dot as a beam and as a voltage; a static pose as the load that bends or twists the link so far."""
    seeker = Given({('load_fx', ''): 5.0})
    beam, volts = seeker.same_elsewhere(seeker.trial([law_of('load_fx')], (), 1))
    assert (beam.laws[0].acts_on, beam.laws[0].stage) == ('beam_y2', 'optics')
    assert (volts.laws[0].acts_on, volts.laws[0].stage, volts.cost) == ('y2', 'electronics', 5.0)
    link = RIG.link
    for on, load, per in (
        ('static_dx', 'load_fx', link.length**3 / (3.0 * link.bending_stiffness)),
        ('static_dy', 'load_fy', link.length**3 / (3.0 * link.bending_stiffness)),
        ('static_theta', 'load_tz', link.length / link.torsional_stiffness),
    ):
        law = dataclasses.replace(law_of('load_fx', on=on), terms=(LawTerm('product', ('load_fx',), 3e-6),))
        (moved,) = seeker.same_elsewhere(seeker.trial([law, law_of('dx')], (), 1))
        assert (moved.laws[0].acts_on, moved.laws[0].stage) == (load, 'load')
        assert moved.laws[0].terms[0].coefficient == pytest.approx(3e-6 / per)
        assert moved.laws[1] == law_of('dx')
    assert seeker.same_elsewhere(seeker.trial([law_of('load_fx', on='dx')], (), 1)) == []


@pytest.mark.parametrize('form', ['over', 'under'])
def test_a_threshold_that_no_refit_moves_is_not_at_its_bound(observed: tuple[Workspace, Fit], form: str) -> None:
    workspace, fit = observed
    seeker = laws.LawSearch(workspace, fit, 3.0)
    level = Law('b', 'psd', 'y2', (LawTerm(form, ('x1',), shapes={'threshold': 1e-4}),))
    got = seeker.trial([law_of('load_fy'), level], fit.effects, 2)
    assert math.isfinite(got.cost)
    assert got.fit.effects[-1].values['threshold1'] == 1e-4


@pytest.mark.parametrize('recordings', [1, 2])
def test_events_are_looked_for_in_one_recording_only(monkeypatch: pytest.MonkeyPatch, recordings: int) -> None:
    """In another one they have other times."""
    term, event = LawTerm('product', ('dx',)), LawTerm('switched', (), times=(1.0,))
    monkeypatch.setattr(laws, 'responses', lambda *_: [])
    monkeypatch.setattr(laws, 'terms', lambda _: iter([term]))
    monkeypatch.setattr(laws, 'switchings', lambda _: [event])
    ws = cast(Workspace, SimpleNamespace(observations=[None] * recordings, simulations=7, psds=2))
    seeker = laws.LawSearch(ws, cast(Fit, None), 3.0)
    assert seeker.listed == [term, event][: 3 - recordings]
    assert (seeker.last, seeker.tried) == (707, len(seeker.listed) * 12)
