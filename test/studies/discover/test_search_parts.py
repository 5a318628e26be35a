"""What a search refits, how often and how far; and when a law is told: with pieces that are given."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_law

from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter
from psd_deflection.model.simulation.laws import Law, LawTerm, effect_of, values_of
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.discover.laws import law_features, laws
from psd_deflection.studies.discover.laws.law_features import Response, Scored
from psd_deflection.studies.discover.search import search as steps
from psd_deflection.studies.discover.search.coincidence import coincidences
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.hold_out import HeldOut
from psd_deflection.studies.discover.search.screen import Score, Screen
from psd_deflection.studies.discover.search.search import Search
from psd_deflection.studies.discover.search.signatures import Candidate
from psd_deflection.studies.discover.search.weighing import accept, named_effects
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import setup

from .test_formulas import RIG, observed
from .test_rules import SIGMA, N, Plant, active, candidate, effect, noise, pictures, result_of, search_of, without_noise
from .test_steps import A, B, across, amplitudes, named, searching


def scored(name: str, gain: float, p: float = 0.0, **given: Any) -> Score:
    return Score(candidate(name, 'x'), gain, 1, p, np.array([gain * 1e-3]), **given)


class Asked:
    """Refits that are noted with the names of their effects and their iterations; their chi-square is given by name."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, module: Any, search: Search, **chi2: float) -> None:
        self.search, self.chi2, self.seen = search, chi2, list[tuple[str, int]]()
        self.plain = refit(search.workspace, ())
        monkeypatch.setattr(module, 'refit', self)

    def __call__(self, ws: object, effects: Sequence[ActiveEffect], iterations: int = 99, **_: object) -> Fit:
        names = ''.join(a.effect.name for a in effects)
        self.seen.append((names, iterations))
        return self.fit(*effects)

    def fit(self, *effects: ActiveEffect) -> Fit:
        names = ''.join(a.effect.name for a in effects)
        free = tuple((i, n) for i, a in enumerate(effects) for n in a.values)
        return dataclasses.replace(
            self.plain, effects=effects, chi2=self.chi2.get(names, 1e6), free=free, jacobian=np.zeros((N, len(free)))
        )


def nothing_found(penalty: float = 3.0) -> Search:
    return search_of(Plant(pictures(A), noise()), 1, penalty)


def test_the_best_few_starts_are_refitted_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each a little first; by BIC, in which a further parameter costs the penalty."""
    search = nothing_found()
    asked = Asked(monkeypatch, steps, search, a=50.0, b=40.0, c=46.0, d=45.0)
    starts = [[active(n, x=0.1)] for n in 'abc'] + [[active('d', x=0.1, y=0.1)]]
    best = search._best_of(starts, 2, 17)
    assert asked.seen == [('a', 3), ('b', 3), ('c', 3), ('d', 3), ('b', 17), ('c', 17)]
    assert best is not None
    assert named(best) == ['b']
    assert search._bic(best) == 43.0
    assert search._best_of([], 2, 17) is None


def test_the_first_effect_has_more_trials_than_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    search = nothing_found()
    asked: list[tuple[list[str], int, int]] = []
    monkeypatch.setattr(
        search,
        '_best_of',
        lambda starts, keep, n: asked.append((['+'.join(a.effect.name for a in s) for s in starts], keep, n)),
    )
    scores = [scored(n, 100.0 - i) for i, n in enumerate('abcdefghi')] + [scored('j', 29.0)]
    none = refit(search.workspace, ())
    one = dataclasses.replace(none, effects=(active('z', x=0.0),))
    search._further(none, scores)
    search._further(one, scores)
    assert asked == [(list('abcdefg'), 4, 12), (['z+a', 'z+b', 'z+c', 'z+d'], 2, 6)]
    # Three tenths of the best, and one in a hundred by chance.
    search._further(none, [scored('a', 100.0), scored('b', 30.1), scored('c', 29.9)])
    assert asked[-1][0] == ['a', 'b']
    assert search._further(none, [scored('a', 100.0, 0.011), scored('b', 90.0, 0.5)]) is None
    assert len(asked) == 3
    search._further(none, [scored('a', 90.0, 0.5), scored('b', 100.0, 0.009)])
    assert len(asked) == 4
    assert search._further(none, []) is None


@pytest.mark.parametrize(('open_level', 'limit'), [(False, 5), (True, 15)])
def test_pairs_are_of_different_places_and_not_those_there_are(
    monkeypatch: pytest.MonkeyPatch, open_level: bool, limit: int
) -> None:
    shown = pictures(A, B)
    plant = Plant(shown, noise())
    search = searching(plant, shown, 'ab')
    monkeypatch.setattr(plant, 'open_level', open_level)
    null, current = (refit(plant, [active(n, x=0.0) for n in names], iterations=0) for names in ('', 'ab'))
    pairs = [('a', 'b'), ('b', 'c'), ('c', 'c'), ('sensitivity', 'c'), ('c', 'link_length'), ('c', 'd')]
    limits: list[tuple[float, int]] = []

    def given(residual: FloatArray, penalty: float, most: int, known: FloatArray) -> Any:
        assert residual is null.residual
        assert known.shape == (N, 0)
        limits.append((penalty, most))
        return [(scored(p, 1.0), scored(q, 2.0), 3.0) for p, q in pairs]

    monkeypatch.setattr(search.screen, 'pairs', given)
    tried: list[Any] = []
    said: list[str] = []
    search._progress = said.append
    for better, taken in ((2.1, True), (1.9, False)):
        other = dataclasses.replace(current, chi2=current.chi2 - better)

        def best_of(starts: Any, keep: int, iterations: int, other: Fit = other) -> Fit:
            tried.append(([''.join(a.effect.name for a in s) for s in starts], keep, iterations))
            return other

        monkeypatch.setattr(search, '_best_of', best_of)
        got = search._try_pairs(null, current)
        assert got is (other if taken else current)
    assert tried == [(['bc', 'cd'], 2, 8)] * 2
    assert limits == [(search.penalty, limit)] * 2
    assert said == ['a better pair: a, b']
    monkeypatch.setattr(search, '_best_of', lambda *_: None)
    assert search._try_pairs(null, current) is current


def test_without_each_is_refitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    search = nothing_found()
    asked = Asked(monkeypatch, steps, search, ab=10.0, a=30.0, b=20.0)
    null, both, one = asked.plain, asked.fit(active('a', x=0.1), active('b', x=0.1)), asked.fit(active('a', x=0.1))
    first = search.without_each(both, null)
    assert [named(f) for f in first] == [['b'], ['a']]
    assert asked.seen == [('b', 6), ('a', 6)]
    assert search.without_each(both, null) is first
    assert search.without_each(one, null)[0] is null
    assert len(asked.seen) == 2
    p, bic, gain = search.weigh(null, both)
    assert gain == [10.0, 20.0]
    assert bic == [7.0, 17.0]
    assert p == pytest.approx([float(chi2_law.sf(g, 1)) for g in gain])
    assert search._drop(null, one) is one


@pytest.mark.parametrize(('second', 'left'), [(12.9, ['b']), (13.1, ['a', 'b'])])
def test_what_is_not_missed_is_dropped(monkeypatch: pytest.MonkeyPatch, second: float, left: list[str]) -> None:
    """The one that is missed least, if that is by less than ten in BIC."""
    search = nothing_found()
    asked = Asked(monkeypatch, steps, search, ab=100.0, a=900.0, b=100.0 + second)
    monkeypatch.setattr(steps, 'gain_beyond', lambda *_: math.inf)
    search._progress = (said := list[str]()).append
    both = asked.fit(active('a', x=0.1), active('b', x=0.1))
    assert named(search._drop(asked.plain, both)) == left
    assert said == ['dropping to b'] * (left == ['b'])


def test_a_gain_must_be_more_than_the_simulation_may_be_wrong_by(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the level is open there is no such thing."""
    search = nothing_found()
    null = refit(search.workspace, ())
    smaller, larger = dataclasses.replace(null, chi2=100.0), dataclasses.replace(null, chi2=80.0, free=((0, 'x'),))
    for beyond, level, passes in ((13.1, False, True), (12.9, False, False), (12.9, True, True), (99.0, False, True)):
        monkeypatch.setattr(steps, 'gain_beyond', lambda *_, beyond=beyond: beyond)
        monkeypatch.setattr(search.workspace, 'open_level', level)
        assert search._passes(smaller, larger, null) == passes
    assert not search._passes(smaller, dataclasses.replace(larger, chi2=87.5), null)


@pytest.mark.parametrize('open_level', [False, True])
def test_new_noise_begins_anew(monkeypatch: pytest.MonkeyPatch, open_level: bool) -> None:
    search = nothing_found()
    plant = search.workspace
    monkeypatch.setattr(plant, 'open_level', open_level)
    monkeypatch.setattr(plant, 'effective_size', lambda: 1000.0)
    asked = Asked(monkeypatch, steps, search, a=10.0)
    fit = asked.fit(active('a', x=0.1))
    search.without_each(fit, asked.plain)
    told: list[list[str]] = []

    def renoise(effects: Sequence[ActiveEffect], changed: bool) -> bool:
        told.append([a.effect.name for a in effects])
        return changed

    plant.base = (active('base', x=0.0),)
    monkeypatch.setattr(plant, 'renoise', lambda effects: renoise(effects, False))
    assert search.renoise(fit) is fit
    assert (search._without != {}, asked.seen) == (True, [])
    monkeypatch.setattr(plant, 'renoise', lambda effects: renoise(effects, True))
    again = search.renoise(fit)
    assert again is not fit
    assert asked.seen == [('a', 6)]
    assert told == [['base', 'a']] * 2
    assert search._without == {}
    # Only where the level is open does the number of independent values change with it.
    assert search.penalty == pytest.approx(math.log(1000.0) if open_level else 3.0)


@pytest.mark.parametrize(('lead', 'rounds'), [(1.9, 0), (2.1, 2)])
def test_a_swap_must_be_better_by_two(monkeypatch: pytest.MonkeyPatch, lead: float, rounds: int) -> None:
    """At most twice, and not once half as much again as the budget is spent."""
    search = nothing_found()
    asked = Asked(monkeypatch, steps, search, a=100.0, b=100.0 - lead, c=100.0 - 2 * lead)
    order = {'a': 'b', 'b': 'c', 'c': 'a'}
    chi2 = {'a': 100.0, 'b': 100.0 - lead, 'c': 100.0 - 2 * lead}

    def alternatives(null: Fit, current: Fit, index: int, gain: float) -> list[Fit]:
        (name,) = named(current)
        assert (index, gain) == (0, asked.plain.chi2 - current.chi2)
        other = dataclasses.replace(asked.fit(active(order[name], x=0.1)), chi2=chi2[name] - lead)
        return [other]

    monkeypatch.setattr(search, 'alternatives', alternatives)
    fit, others = search.swap(asked.plain, asked.fit(active('a', x=0.1)))
    assert named(fit) == [['a'], ['b'], ['c']][rounds]
    assert asked.seen == [('b', 8), ('c', 8)][:rounds]
    assert [named(f) for f in others[0]] == [[order[named(fit)[0]]]]
    search._begun = search.workspace.simulations - 1050
    asked.seen.clear()
    search.swap(asked.plain, asked.fit(active('a', x=0.1)))
    assert len(asked.seen) == rounds
    search._begun -= 1
    asked.seen.clear()
    assert named(search.swap(asked.plain, asked.fit(active('a', x=0.1)))[0]) == ['a']
    assert asked.seen == []


def given_scores(search: Search, *scores: Score) -> None:
    search.screen = cast(Screen, SimpleNamespace(candidates=[], score=lambda *_: list(scores)))


def test_alternatives_are_the_best_of_each_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight of them, or two once the budget is spent; a mistake of all channels only beside other mistakes."""
    search = nothing_found()
    asked = Asked(monkeypatch, steps, search, a=0.0, za=500.0)
    one = asked.fit(active('a', x=0.1))
    names = 'bcdefghij'
    given_scores(search, scored('a', 99.0), *(scored(n, 90.0 - i) for i, n in enumerate(names)), scored('b', 60.0))
    assert [named(f) for f in search.alternatives(asked.plain, one, 0, 50.0)] == [[n] for n in 'bcdefghi']
    assert asked.seen == [(n, 3) for n in 'bcdefghi']
    search._begun = search.workspace.simulations - 700
    asked.seen.clear()
    search.alternatives(asked.plain, one, 0, 50.0)
    assert [n for n, _ in asked.seen] == ['b', 'c']
    search._begun = search.workspace.simulations - 1400
    assert len(search.alternatives(asked.plain, one, 0, 50.0)) == 2
    search._begun -= 1
    assert search.alternatives(asked.plain, one, 0, 50.0) == []
    search._begun = search.workspace.simulations
    # The closest first; those that come close are refitted in full, beside the rest.
    two = asked.fit(active('z', x=0.1), active('a', x=0.1))
    asked.chi2.update(zb=559.0, zc=510.0, zd=561.0)
    asked.seen.clear()
    given_scores(search, scored('z', 99.0), scored('b', 30.0), scored('c', 26.0), scored('d', 25.1), scored('e', 24.9))
    fits = search.alternatives(asked.plain, two, 1, 50.0)
    assert [named(f) for f in fits] == [['c', 'z'], ['b', 'z'], ['d', 'z']]
    assert asked.seen == [('a', 6), ('z', 6), ('zb', 3), ('zb', 8), ('zc', 3), ('zc', 8), ('zd', 3)]
    # On a rough machine all are tried, from afar.
    monkeypatch.setattr(search.workspace, 'open_level', True)
    asked.seen.clear()
    given_scores(search, scored('c', 0.1), scored('d', 0.0))
    search.alternatives(asked.plain, two, 1, 50.0)
    assert asked.seen == [('zc', 10), ('zc', 8), ('zd', 10)]
    monkeypatch.setattr(search.workspace, 'open_level', False)
    given_scores(search, scored('link_length', 90.0))
    for other, tried in (('z', 0), ('jump', 1)):
        beside = asked.fit(active(other, x=0.1), active('a', x=0.1))
        assert len(search.alternatives(asked.plain, beside, 1, 50.0)) == tried


def test_a_mistake_is_refitted_from_where_it_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    search = nothing_found()
    null = refit(search.workspace, ())
    asked: list[tuple[list[dict[str, float]], int, int]] = []
    monkeypatch.setattr(
        search, '_best_of', lambda starts, keep, n: asked.append(([dict(s[0].values) for s in starts], keep, n))
    )
    rate = Candidate(effect('sample_rate', 'error'), {'error': 0.0}, ('error',), {'error': 0.0})
    scores = [
        scored('a', 100.0),
        dataclasses.replace(scored('sample_rate', 30.0), candidate=rate),
        scored('link_length', 30.1),
    ]
    assert search._mistake(null, scores) is null
    assert [a[1:] for a in asked] == [(2, 12)]
    assert asked[0][0] == [pytest.approx({'x': 30.1e-6})]
    # From afar other rates are starts of their own.
    far = dataclasses.replace(null, chi2=10.1 * null.residual.size)
    search._mistake(far, scores)
    assert [s.get('error') for s in asked[1][0]] == [-0.2, -0.1, -0.04, 0.04, 0.1, 0.25, None]
    # Where a linear step ends beyond its reach, readings of twice the size are.
    gain = dataclasses.replace(rate, effect=effect('sensitivity', 'error'))
    for linear, begun in ((-0.69, -0.69), (-0.71, -0.5)):
        steps = np.array([linear / gain.effect.parameters[0].scale])
        search._mistake(null, [dataclasses.replace(scored('sensitivity', 30.1), candidate=gain, coefficients=steps)])
        assert asked[-1][0] == [{'error': pytest.approx(begun)}]


# Laws.


def trial(law: Law, chi2: float, cost: float, parameters: int = 1, *beside: ActiveEffect) -> laws._Trial:
    effects = (*beside, ActiveEffect(effect_of(law), values_of(law)))
    fit = SimpleNamespace(chi2=chi2, effects=effects, parameters=parameters)
    return laws._Trial((law,), cast(Fit, fit), cost)


BUMP = Law('law_y2', 'psd', 'y2', (LawTerm('switched', (), 1e-6, times=(1.0, 2.0)),))
STRAIGHT = Law('law_y2', 'psd', 'y2', (LawTerm('product', ('load_fx',), 1e-6),))


@pytest.mark.parametrize(
    ('change', 'told'),
    [
        ({}, True),
        # Half of what is left must be explained: 200 of 399.
        ({'excess': 401.0}, False),
        ({'excess': 399.0}, True),
        # Its BIC must be better by ten than without it, 300, and than that of the effects alone.
        ({'cost': 290.1}, False),
        ({'cost': 289.9}, True),
        ({'cost': 286.1, 'alone': (293.0, 1)}, False),
        ({'cost': 285.9, 'alone': (293.0, 1)}, True),
        ({'gain': 0.0, 'error': 0.0}, False),
        ({'gain': 2.1, 'error': 1.0}, True),
        ({'gain': 1.9, 'error': 1.0}, False),
        # One in a hundred, of all terms that might have been taken.
        ({'tried': 10**45}, False),
        ({'beside': True}, True),
    ],
)
@pytest.mark.parametrize('law', [STRAIGHT, BUMP])
def test_a_law_is_told_by_the_rule_for_effects(
    monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], told: bool, law: Law
) -> None:
    """Of chi-square 300 with nothing and 100 with the law; p over all terms, and blocks for times."""
    creep = (active('creep', x=0.1),) if 'beside' in change else ()
    best = trial(law, 100.0, change.get('cost', 105.0), 1 + len(creep), *creep)
    tried = change.get('tried', 1000)

    class Seeker:
        def __init__(self, *_: object) -> None:
            self.tried = tried

        def first(self) -> list[laws._Trial]:
            return [best]

        def done(self, _: object) -> bool:
            return True

        def lean(self, t: laws._Trial) -> laws._Trial:
            return t

        def same_elsewhere(self, _: object) -> list[laws._Trial]:
            return []

    asked: list[tuple[Any, int]] = []
    without = cast(Fit, SimpleNamespace(chi2=300.0, parameters=len(creep)))

    def refitted(ws: object, effects: Any, iterations: int) -> Fit:
        asked.append((effects, iterations))
        return without

    monkeypatch.setattr(laws, '_Seeker', Seeker)
    monkeypatch.setattr(laws, 'refit', refitted)
    monkeypatch.setattr(laws, 'heldout_gain', lambda *_: HeldOut(change.get('gain', 50.0), change.get('error', 1.0)))
    monkeypatch.setattr(laws, 'heldout_gap', lambda *_: 1e-6)
    monkeypatch.setattr(laws, '_channels', lambda *_: ('y2',))
    ws = cast(Workspace, SimpleNamespace(size=6000))
    chi2, parameters = change.get('alone', (300.0, 1))
    fit = cast(Fit, SimpleNamespace(effects=(), chi2=chi2, parameters=parameters))
    null = without if not creep else cast(Fit, SimpleNamespace(chi2=900.0, parameters=0))
    rng = np.random.default_rng(0)
    found = laws._law_of_the_mean(ws, null, fit, 3.0, change.get('excess', 300.0), rng)
    assert (found is not None) == told
    assert asked == ([(creep, 6)] if creep else [])
    if found is not None:
        assert (found.law, found.further, found.without) == (law, (), without)
        times = 2 * math.log(1000.0) if law is BUMP else 0.0
        p = math.log(tried) + times + float(chi2_law.logsf(200.0, 1))
        assert math.log(found.p) == pytest.approx(p)
        cost = change.get('cost', 105.0) - 100.0 - 3.0 * len(creep)
        assert found.delta_bic == pytest.approx(200.0 - cost)
        assert (found.channels, found.heldout_gap, found.equivalent) == (('y2',), 1e-6, ())


def test_where_no_law_is_for_the_mean_one_of_the_noise_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(laws, 'find_jitter', lambda ws, fit, penalty: ('jitter', ws, fit, penalty))
    asked = cast(Any, ('ws', 'null', 'fit', 3.0, 9.0, 'rng'))
    for mean, got in (('law', 'law'), (None, ('jitter', 'ws', 'fit', 3.0))):
        monkeypatch.setattr(laws, '_law_of_the_mean', lambda *a, mean=mean: mean if a == asked else None)
        assert cast(Any, laws.find_law)(*asked, said.append) == got
    assert said == ['a law for what remains'] * 2


def test_both_starts_are_tried_if_there_are_effects(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[object] = []

    class Seeker:
        def __init__(self, ws: object, start: object, penalty: float) -> None:
            started.append((start, penalty))

        def first(self) -> list[laws._Trial]:
            return [trial(STRAIGHT, 1.0, math.inf)]

    monkeypatch.setattr(laws, '_Seeker', Seeker)
    null = cast(Fit, SimpleNamespace(effects=()))
    fit = cast(Fit, SimpleNamespace(effects=(active('creep', x=0.1),)))
    rng = np.random.default_rng(0)
    assert laws._law_of_the_mean(cast(Workspace, None), null, fit, 3.0, 9.0, rng) is None
    assert laws._law_of_the_mean(cast(Workspace, None), null, null, 3.0, 9.0, rng) is None
    assert started == [(fit, 3.0), (null, 3.0), (null, 3.0)]


def test_a_switched_law_gets_the_times_that_show_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of both, without those of both at once; of the same dependence; the cheapest of all."""
    asked: list[tuple[Law, int]] = []

    class Seeker(laws._Seeker):
        def __init__(self) -> None:
            self.found = cast(Any, 'found')

        def trial(self, listed: Sequence[Law], beside: object, iterations: int) -> laws._Trial:
            asked.append((listed[0], iterations))
            return trial(listed[0], 1.0, 10.0 * len(listed[0].terms[0].times))

    offered = [
        LawTerm('switched', (), times=(2.0, 3.0, 4.0)),
        LawTerm('switched', ('y1',), times=(5.0,)),
        LawTerm('switched', (), times=(1.0, 2.0)),
        LawTerm('switched', (), times=(7.0,)),
    ]
    targets: list[tuple[str, ...]] = []

    def switchings(left: object, on: tuple[str, ...]) -> list[LawTerm]:
        targets.append(on)
        return offered

    def better(found: object, on: str, term: LawTerm) -> LawTerm:
        assert (found, on) == ('found', law.acts_on)
        return dataclasses.replace(term, times=tuple(t + 0.5 for t in term.times))

    monkeypatch.setattr(laws, 'switchings', switchings)
    monkeypatch.setattr(laws, 'with_better_times', better)
    second = LawTerm('product', ('dx',), 1e-6)
    law = Law('law_static_dx', 'link', 'static_dx', (LawTerm('switched', (), 1e-6, times=(1.0, 2.0)), second))
    got = Seeker()._switched_again(trial(law, 1.0, 35.0), [])
    times = [(1.5, 3.5, 4.5), (1.5, 2.5, 7.5)]
    assert [(a.terms[0].times, n) for a, n in asked] == [(t, 4) for t in times]
    assert [a.terms[1:] for a, _ in asked] == [(second,)] * 2
    assert targets == [('dx',)]
    assert got.laws[0].terms[0].times == times[0]
    asked.clear()
    assert Seeker()._switched_again(trial(law, 1.0, 29.0), []).cost == 29.0


@pytest.mark.parametrize(('cost', 'kept'), [(89.9, True), (90.1, False)])
def test_further_times_must_gain_as_an_effect_must(monkeypatch: pytest.MonkeyPatch, cost: float, kept: bool) -> None:
    again = trial(dataclasses.replace(BUMP, name='again'), 0.0, cost)
    asked: list[object] = []

    class Seeker(laws._Seeker):
        def __init__(self) -> None:
            self.listed, self.start = [], cast(Any, None)
            self.ws = cast(Any, None)

        def done(self, t: laws._Trial) -> bool:
            return t.laws[0].name == 'again'

        def _switched_again(self, t: laws._Trial, left: Sequence[Response]) -> laws._Trial:
            asked.append(t)
            return again

    monkeypatch.setattr(laws, 'responses', lambda *_: [])
    monkeypatch.setattr(laws, 'score', lambda *_: [])
    start = trial(BUMP, 100.0, 100.0)
    assert (Seeker().grown(start) is again) == kept
    assert asked == [start]
    # Of a law that is not switched, or of two, none are looked for.
    for other in (trial(STRAIGHT, 100.0, 100.0), dataclasses.replace(start, laws=(BUMP, STRAIGHT))):
        monkeypatch.setattr(Seeker, 'trial', lambda *_: trial(STRAIGHT, 0.0, 1e9), raising=False)
        Seeker().grown(other)
    assert asked == [start]


def test_of_terms_with_times_the_best_four_are_improved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of at most a dozen times; on the link at rest or in motion, of a dot or not."""
    n = 60
    rows = len(law_features.SOUGHT)
    known = {name: np.full(4 * n, 2.0) for name in ('x1', 'y1', 'x2', 'y2')}
    r = Response(
        known, 1e-3, 4, np.zeros((n, rows)), np.zeros((n, rows)), np.zeros((rows, n)), np.ones((rows, n)), (), (3, 5)
    )
    asked: list[tuple[str, tuple[str, ...], tuple[float, ...], tuple[str, ...]]] = []
    counts = iter([2, 12, 13, 0, 1, 3, 4, 5, 6, 7] + [0] * 99)

    def two_levels(error: FloatArray, weight: FloatArray, v: FloatArray) -> list[int]:
        assert (weight == v * v).all()
        return list(range(1, next(counts) + 1))

    def score(found: object, listed: Sequence[LawTerm], targets: Sequence[str]) -> list[Scored]:
        (term,) = listed
        asked.append((term.form, term.of, term.times, tuple(targets)))
        return [Scored(targets[0], term, float(len(term.times)))]

    better: list[int] = []

    def with_better(found: object, target: str, term: LawTerm) -> LawTerm:
        better.append(len(term.times))
        return term

    monkeypatch.setattr(law_features, '_two_levels', two_levels)
    monkeypatch.setattr(law_features, 'score', score)
    monkeypatch.setattr(law_features, 'with_better_times', with_better)
    got = law_features.switchings([r])
    # Two of dx, twelve of dy; thirteen of theta are too many, and none of x1 is none. A dot may follow those of
    # its own PSD.
    assert asked == [
        ('switched', (), (0.004, 0.008), ('dx', 'static_dx')),
        ('switched', (), tuple(0.004 * (k + 1) for k in range(12)), ('dy', 'static_dy')),
        ('switched', ('x1',), (0.004,), ('x1',)),
        ('switched', ('y1',), tuple(0.004 * k for k in (1, 2, 3)), ('x1',)),
        ('switched', (), tuple(0.004 * (k + 1) for k in range(4)), ('y1',)),
        ('switched', ('x1',), tuple(0.004 * (k + 1) for k in range(5)), ('y1',)),
        ('switched', ('y1',), tuple(0.004 * (k + 1) for k in range(6)), ('y1',)),
        ('switched', (), tuple(0.004 * (k + 1) for k in range(7)), ('x2',)),
    ]
    assert better == [12, 7, 6, 5]
    assert [len(t.times) for t in got] == better


# Wiring.


def test_a_load_has_a_size_if_it_moved_what_stands_out() -> None:
    """A hundred times the noise of a block, and a thousandth of what is left; a millionth of another's is none."""
    file = Wiring.from_rig(RIG)
    cross = np.zeros((3, 4, 4))
    own = np.diag([4.0, 4.0, 0.0])
    cross[0, 0, 0], cross[1, 1, 1] = 4.0 * 0.5, 4.0 * 2.0
    squared = 4.0 * 0.25 + 4.0 * 4.0

    def sizes(noise_of: float, left: float = 0.0, **given: Any) -> tuple[float, list[float]]:
        m = setup._Movement(squared + left, given.get('cross', cross), given.get('own', own), noise_of)
        rest, found = setup._sizes(m, file)
        return rest, found.tolist()

    rest, found = sizes(0.0)
    assert rest == pytest.approx(0.0, abs=1e-12)
    assert found[:2] == pytest.approx([0.5, 2.0])
    assert math.isnan(found[2])
    # 0.5^2 4 = 1 against 100 noise.
    assert [math.isnan(v) for v in sizes(0.0101)[1]] == [True, False, True]
    assert [math.isnan(v) for v in sizes(0.0099)[1]] == [False, False, True]
    # And against a thousandth of what is left.
    assert [math.isnan(v) for v in sizes(0.0, 1001.0)[1]] == [True, False, True]
    assert [math.isnan(v) for v in sizes(0.0, 999.0)[1]] == [False, False, True]
    assert sizes(0.0, 999.0)[0] == pytest.approx(999.0)
    faint = np.diag([4.0, 4.0, 3.9e-18])
    assert math.isnan(sizes(0.0, own=faint)[1][2])
    none = sizes(0.0, own=np.zeros((3, 3)))
    assert none[0] == squared
    assert all(math.isnan(v) for v in none[1])
    # Signs and columns of a wiring.
    turned = dataclasses.replace(file, axes=(('-x', 'y'), *file.axes[1:]))
    m = setup._Movement(squared, cross, own, 0.0)
    assert setup._sizes(m, turned)[1][:2].tolist() == pytest.approx([-0.5, 2.0])


def test_a_recording_without_movement_says_nothing_of_its_wiring() -> None:
    o = observed(warm=None)
    still = dataclasses.replace(o, volts=np.full_like(o.volts, 0.5))
    for seen in (still, dataclasses.replace(o, loads=np.zeros_like(o.loads))):
        assert setup.wire([seen], ()) == ([seen], [], {})
    wrong = dataclasses.replace(o, volts=o.volts * [1.0, 1.0, 1.0, -1.0, 1.0, 1.0])
    mended, findings, _ = setup.wire([wrong], ())
    assert [f.where for f in findings] == ['x2']
    assert findings[0].evidence > 10.0
    np.testing.assert_array_equal(mended[0].volts, o.volts)
    assert mended[0].digest == wrong.hashed()


def test_a_size_of_an_effect_is_linear_and_its_noise_its_own() -> None:
    """The covariance of two that are one is large, and finite."""
    shown = pictures(A, B)
    shown[B] = shown[A] + 1e-9 * across(shown[B], shown[A])
    plant = Plant(shown, noise())
    fit = refit(plant, [active('a', x=0.0), active('b', x=0.0)], iterations=1)
    assert np.isfinite(fit.covariance()).all()
    assert refit(plant, ()).covariance().shape == (0, 0)
    blind = dataclasses.replace(fit, jacobian=np.zeros_like(fit.jacobian))
    assert np.isfinite(blind.covariance()).all()
    # A refit ends with the iteration that gains less than a twentieth.
    quick = Plant(pictures(A), without_noise((pictures(A)[A], 0.04)))
    before = quick.simulations
    refit(quick, [active('a', x=0.0)])
    assert quick.simulations - before == 3
    long = Plant(pictures(A), without_noise((pictures(A)[A], 0.06)))
    refit(long, [active('a', x=0.0)])
    assert long.simulations == 5


def test_a_parameter_at_its_greatest_value_is_probed_downward() -> None:
    shown = pictures(A)
    probed: list[float] = []

    class Noting(Plant):
        def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
            probed.extend(a.values['x'] for a in effects)
            return super().simulate(effects)

    plant = Noting(shown, -1e-3 * shown[A])
    for most, first in ((0.5, 0.5 - 5e-5), (1.0, 0.5 + 5e-5)):
        probed.clear()
        fit = refit(plant, [active('a', -1.0, most, x=0.5)])
        assert probed[:2] == pytest.approx([0.5, first], abs=1e-12)
        assert fit.effects[0].values['x'] == pytest.approx(-1e-3, abs=1e-9)
        np.testing.assert_allclose(fit.jacobian[:, 0], shown[A].ravel() / SIGMA, rtol=1e-6, atol=1e-4)


def test_choices_are_not_fitted_and_the_nuisance_is() -> None:
    shown = pictures(A, B)
    shown['a', 'way'] = np.zeros_like(shown[A])
    choice = EffectParameter('way', '', 0, 1, 1, '', kind='choice', choices=(0, 1))
    sized: Effect = active('a', x=0.0).effect
    with_choice = dataclasses.replace(sized, parameters=(choice, *sized.parameters))
    plant = Plant(shown, 2e-3 * shown[A] - 3e-3 * shown[B])
    plant.nuisance = (active('b', x=0.1),)
    fit = refit(plant, [ActiveEffect(with_choice, {'way': 1.0, 'x': 0.0})])
    assert fit.free == ((-1, 'x'), (0, 'x'))
    assert [a.effect.name for a in fit.whole] == ['b', 'a']
    assert fit.nuisance[0].values['x'] == pytest.approx(-3e-3, abs=1e-8)
    assert fit.effects[0].values == pytest.approx({'way': 1.0, 'x': 2e-3}, abs=1e-8)
    assert (fit.columns_of(-1), fit.columns_of(0)) == ([0], [1])
    given = refit(plant, (), iterations=0, nuisance=(active('b', x=0.25),))
    assert given.nuisance[0].values['x'] == 0.25
    at_bound = refit(plant, (), nuisance=(active('b', -1e-3, 1.0, x=0.0),))
    assert at_bound.at_bound == ((-1, 'x'),)


# The way of a whole search.


class Steps:
    """A search whose steps are given: names of effects that are added, and of pairs, '' for none better."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        further: Sequence[str],
        pairs: Sequence[str],
        refused: str = '',
        stand_in: str = '',
        **ws: Any,
    ) -> None:
        self.search, self.done = nothing_found(), list[str]()
        self.said: list[str] = []
        for name, value in ws.items():
            monkeypatch.setattr(self.search.workspace, name, value)
        adding, pairing, asked = iter(further), iter(pairs), Asked(monkeypatch, steps, self.search)
        search, done = self.search, self.done

        def fit_of(names: str) -> Fit:
            return asked.fit(*(active(n, x=0.1) for n in names))

        def further_of(current: Fit, scores: Sequence[Score]) -> Fit | None:
            done.append('further ' + ','.join(s.candidate.effect.name for s in scores))
            names = next(adding, '')
            return fit_of(names) if names else None

        def pair(null: Fit, current: Fit) -> Fit:
            done.append('pairs')
            names = next(pairing, '')
            return fit_of(names) if names else current

        def renoise(fit: Fit) -> Fit:
            done.append('renoise ' + ''.join(named(fit)))
            return fit

        def screen(ws: object, current: Fit | None) -> Any:
            done.append('screen ' + ''.join(named(cast(Fit, current))))
            return search.screen

        given_scores(search, *(scored(n, 9.0) for n in 'abcd'), scored('link_length', 9.0))
        search._make_screen, search._progress = screen, self.said.append
        for name, step in (
            ('_further', further_of),
            ('_try_pairs', pair),
            ('renoise', renoise),
            ('_mistake', lambda null, scores: null),
            ('_drop', lambda null, fit: fit),
            ('swap', lambda null, fit: (fit, [])),
            ('weigh', lambda null, fit: ([], [], [])),
            ('_passes', lambda smaller, larger, null: ''.join(named(larger)) != refused),
            ('_stands_in', lambda smaller, larger: ''.join(named(larger)) == stand_in),
        ):
            monkeypatch.setattr(search, name, step)
        self.found = ''.join(named(search.run().fit))


def test_effects_are_added_one_by_one_and_noise_estimated_after_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """And at the end; none is added twice, nor a mistake of all channels; from the second on pairs are tried."""
    way = Steps(monkeypatch, ['a', 'ab', ''], [])
    assert way.found == 'ab'
    assert way.said == ['adding a', 'adding b']
    assert way.done == [
        'further a,b,c,d',
        'renoise a',
        'screen a',
        'further b,c,d',
        'screen ab',
        'pairs',
        'further c,d',
        'renoise ab',
    ]
    # Another pair takes its place; what does not pass is not added.
    assert Steps(monkeypatch, ['a', 'ab', ''], ['cd']).found == 'cd'
    assert Steps(monkeypatch, ['a', 'ab'], [], 'ab').found == 'a'
    nothing = Steps(monkeypatch, [''], ['ab'])
    assert (nothing.found, nothing.done) == ('', ['further a,b,c,d'])
    four = Steps(monkeypatch, ['a', 'ab', 'abc', 'abcd', 'abcde'], [])
    assert four.found == 'abcd'
    # Close enough to noise the signatures stay as they were.
    monkeypatch.setattr(steps, 'far', lambda _: False)
    assert Steps(monkeypatch, ['a', ''], []).done == ['further a,b,c,d', 'renoise a', 'further b,c,d', 'renoise a']


def test_of_two_causes_of_a_rough_machine_neither_may_help_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    way = Steps(monkeypatch, ['', ''], ['ab'], open_level=True)
    assert way.found == 'ab'
    assert way.said == []
    assert way.done == [
        'further a,b,c,d',
        'pairs',
        'renoise ab',
        'screen ab',
        'pairs',
        'further c,d',
        'renoise ab',
    ]
    # Noise is estimated after each step there.
    again = Steps(monkeypatch, ['a', 'ab', ''], [], open_level=True)
    assert [d for d in again.done if d.startswith('renoise')] == ['renoise a', 'renoise ab', 'renoise ab']
    for pairs, refused in (([''], ''), (['ab'], 'ab')):
        none = Steps(monkeypatch, [''], pairs, refused, open_level=True)
        assert (none.found, none.done) == ('', ['further a,b,c,d', 'pairs'])
    # A pair instead of the one that is there; one that does not pass is not taken.
    assert Steps(monkeypatch, ['a', ''], ['bc'], open_level=True).found == 'bc'
    assert Steps(monkeypatch, ['a', 'ab', ''], ['', 'cd'], 'ab', open_level=True).found == 'a'


def test_what_stands_in_is_not_added_and_a_pair_is_looked_for_instead(monkeypatch: pytest.MonkeyPatch) -> None:
    way = Steps(monkeypatch, ['a', 'ab'], [''], stand_in='ab')
    assert way.found == 'a'
    assert way.said == ['adding a']
    assert way.done == ['further a,b,c,d', 'renoise a', 'screen a', 'further b,c,d', 'pairs', 'renoise a']
    # A wrong first effect hides the pair; one that stands in as well is not taken.
    assert Steps(monkeypatch, ['a', 'ab', ''], ['cd'], stand_in='ab').found == 'cd'
    both = Steps(monkeypatch, ['a', 'cd'], ['cd'], stand_in='cd')
    assert (both.found, both.done[-2:]) == ('a', ['pairs', 'renoise a'])
    # Beside two effects there is none to look for.
    three = Steps(monkeypatch, ['a', 'ab', 'abc'], ['', 'cd'], stand_in='abc')
    assert (three.found, three.done.count('pairs')) == ('ab', 1)


def test_an_effect_stands_in_if_it_explains_little_of_much(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fifth of what is beyond noise, while more than a tenth of the noise is left."""
    search = nothing_found()
    size = float(search.workspace.size)
    asked = Asked(monkeypatch, steps, search, a=3.0 * size)
    one, both = asked.fit(active('a', x=0.1)), (active('a', x=0.1), active('b', x=0.1))

    def left(chi2: float, smaller: Fit) -> bool:
        return search._stands_in(smaller, dataclasses.replace(asked.fit(*both), chi2=chi2))

    assert left(2.61 * size, one)
    assert not left(2.59 * size, one)
    near = dataclasses.replace(one, chi2=1.12 * size)
    assert left(1.101 * size, near)
    assert not left(1.099 * size, near)
    # The first effect is beside none, and nobody knows the noise of a rough machine.
    assert not left(2.9 * size, dataclasses.replace(asked.fit(), chi2=3.0 * size))
    monkeypatch.setattr(search.workspace, 'open_level', True)
    assert not left(2.9 * size, one)


def test_beyond_the_budget_nothing_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Steps(monkeypatch, ['a', 'ab'], [], budget=0).found == ''


@pytest.mark.parametrize(('odds', 'told'), [(20.2, True), (19.8, False)])
def test_sizes_are_tied_from_odds_of_twenty_on(odds: float, told: bool) -> None:
    """Of the ratio's density at what it is, against a flat one over two decades."""
    a = b = 0.5
    for _ in range(20):
        spread = math.sqrt(1e-6 / a**2 + 1e-6 / b**2 + 0.003**2)
        height = 2.0 * math.log(10.0) / (spread * math.sqrt(2.0 * math.pi))
        b = a * math.exp(spread * math.sqrt(2.0 * math.log(height / odds)))
    ties = coincidences(amplitudes(('x', 'V', a), ('y', 'V', b)), Physics.of(RIG))
    assert [t.odds for t in ties] == ([pytest.approx(odds, rel=1e-6)] if told else [])


def test_at_its_limit_an_alternative_is_not_equivalent() -> None:
    shown = pictures(A)
    search = search_of(Plant(shown, without_noise((shown[A], 500.0))))
    fit = dataclasses.replace(refit(search.workspace, [active('a', x=0.0)]), chi2=0.0)
    null = refit(search.workspace, ())
    for loss, equal in ((21.6, False), (math.nextafter(21.6, 0.0), True)):
        other = dataclasses.replace(fit, effects=(active('b', x=0.1),), chi2=loss)
        result = steps.SearchResult(null, fit, [0.0], [99.0], [500.0], [], [[other]])
        (found,) = named_effects(search, result, fit, [HeldOut(9.0, 1.0)])
        assert found.equivalent == ('b',) * equal
        # What cannot be excluded is a rival, however much worse it is in BIC.
        assert len(found.rivals) == equal


def test_limits_themselves_do_not_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gain in BIC of just ten; a gain of just two errors; a chi-square of just ten a value."""
    search = nothing_found()
    null = refit(search.workspace, ())
    smaller, larger = dataclasses.replace(null, chi2=100.0), dataclasses.replace(null, chi2=87.0, free=((0, 'x'),))
    monkeypatch.setattr(search.workspace, 'open_level', True)
    assert not search._passes(smaller, larger, null)
    assert search._passes(smaller, dataclasses.replace(larger, chi2=86.9), null)
    assert not HeldOut(2.0, 1.0).holds
    assert not steps.far(dataclasses.replace(null, chi2=10.0 * null.residual.size))
    assert [steps.far(dataclasses.replace(null, chi2=10.0 * null.residual.size + d)) for d in (-1.0, 1.0)] == [
        False,
        True,
    ]


def test_further_terms_are_those_without_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """The times that show beside a law are looked for anew."""
    offered: list[Sequence[LawTerm]] = []
    straight, bump = STRAIGHT.terms[0], BUMP.terms[0]

    class Seeker(laws._Seeker):
        def __init__(self) -> None:
            self.ws, self.listed = cast(Any, None), [bump, straight, bump]

        def done(self, _: laws._Trial) -> bool:
            return False

    monkeypatch.setattr(laws, 'responses', lambda ws, fit: fit)

    def score(more: object, listed: Sequence[LawTerm]) -> list[Scored]:
        offered.append(listed)
        return []

    monkeypatch.setattr(laws, 'score', score)
    start = trial(STRAIGHT, 100.0, 100.0)
    assert Seeker().grown(start) is start
    assert offered == [[straight]]


@pytest.mark.parametrize(('gain', 'is_named'), [(18.2, True), (17.8, False)])
def test_every_size_of_an_effect_costs_the_penalty(gain: float, is_named: bool) -> None:
    """Two of 4 each, and ten to be better by."""
    shown = pictures(A, ('a', 'y'))
    search = search_of(Plant(shown, without_noise((shown[A], gain))), penalty=4.0)
    heldout, fit = accept(search, result_of(search, [active('a', x=0.0, y=0.0)]), np.random.default_rng(0))
    assert bool(fit.effects) == is_named
    assert len(heldout) == is_named
