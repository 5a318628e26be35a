# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The steps of a search and of its localisation, on the plant of ``test_rules``, whose answers are least squares."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Self, cast

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_law
from scipy.stats import norm

from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import ActiveEffect, EffectParameter
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import CHANNELS, FloatArray
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.discover.search import search as steps
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, HeldOut, refit
from psd_deflection.studies.discover.search.localise import dependences, localise, regressors
from psd_deflection.studies.discover.search.screen import Candidate, Screen
from psd_deflection.studies.discover.search.search import Search, mistake
from psd_deflection.studies.discover.search.trials import is_far_off
from psd_deflection.studies.discover.search.weighing import coincidences
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import correct_wiring, load_sizes, movement_sums, noise_energy
from psd_deflection.studies.discover.steps import alternatives

from .test_formulas import RIG, make_observation
from .test_rules import (
    CASES,
    FINE,
    SIGMA,
    Pictures,
    Plant,
    active,
    candidate,
    columns,
    noise,
    pictures,
    problem_of,
    ran,
    without_noise,
)

A, B, C = ('a', 'x'), ('b', 'x'), ('c', 'x')


def searching(plant: Plant, shown: Pictures, names: Sequence[str], message: list[str] | None = None) -> Search:
    """A search among effects of one size each, with the pictures that the plant shows."""
    rows: list[tuple[Candidate, list[list[FloatArray]]]] = [
        (candidate(n, 'x'), [[1e-3 * shown[n, 'x']]]) for n in names
    ]
    return Search(plant, lambda ws, _: Screen(ws, rows), (message if message is not None else []).append)


def across(picture: FloatArray, *pictures: FloatArray) -> FloatArray:
    """What of a picture is not in the others, at the first one's length."""
    matrix = np.stack([o.ravel() for o in pictures], axis=1)
    rest = picture.ravel() - matrix @ np.linalg.lstsq(matrix, picture.ravel(), rcond=None)[0]
    return np.asarray(rest.reshape(picture.shape) * np.linalg.norm(picture) / np.linalg.norm(rest))


def named(fit: Fit) -> list[str]:
    return sorted(a.effect.name for a in fit.effects)


def test_a_stand_in_is_dropped_once_the_causes_are_there() -> None:
    """The sum of two pictures is explained best by a third that is near to both; in the end the two are left."""
    shown = pictures(A, B, C)
    shown[B] = across(shown[B], shown[A])
    shown[C] = shown[A] + shown[B] + 0.6 * across(shown[C], shown[A], shown[B])
    plant = Plant(shown, without_noise((shown[A], 3000.0), (shown[B], 3000.0)) + noise())
    message: list[str] = []
    result = ran(searching(plant, shown, 'abc', message))
    assert (message[0], named(result.fit)) == ('adding c', ['a', 'b'])
    assert len(result.p) == len(result.delta_bic) == len(result.delta_chi2) == len(result.alternatives) == 2
    assert result.null.effects == ()
    assert all(line.endswith(']') for line in result.trace)


def test_two_that_hide_each_other_are_found_as_a_pair() -> None:
    """Alone neither explains much: their pictures are nearly opposite."""
    shown = pictures(A, B, C, ('d', 'x'))
    b = across(shown[B], shown[A])
    shown[B] = -shown[A] + 0.1 * b
    # Two others explain a part of the difference, one after the other.
    d, e = across(shown[C], shown[A], b), across(shown['d', 'x'], shown[A], b, shown[C])
    shown[C], shown['d', 'x'] = 0.5 * b + d, 0.5 * b + e
    plant = Plant(shown, without_noise((b, 5000.0)) + noise())
    message: list[str] = []
    result = ran(searching(plant, shown, 'abcd', message))
    assert 'a better pair: ' in ''.join(message)
    assert named(result.fit) == ['a', 'b']


@pytest.mark.parametrize('names', [('s',), ('s', 't')])
def test_other_shapes_are_24_over_their_whole_ranges(names: tuple[str, ...]) -> None:
    tried: list[tuple[float, ...]] = []

    class Noting(Plant):
        def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
            first, beside = effects
            assert beside.effect.name == 'b'
            tried.append(tuple(first.values[n] for n in names))
            return super().simulate(effects)

    plant = Noting(pictures(A, ('a', 's'), ('a', 't'), B), noise())
    a = active('a', x=0.1, **dict.fromkeys(names, 0.2))
    kinds = tuple(dataclasses.replace(p, kind='shape' if p.name in names else p.kind) for p in a.effect.parameters)
    shaped = ActiveEffect(dataclasses.replace(a.effect, parameters=kinds), a.values)
    fit = refit(plant, [shaped, active('b', x=0.0)], iterations=0)
    tried.clear()
    searching(plant, plant.pictures, 'a').of_another_shape(fit)
    inside = np.linspace(-1.0, 1.0, {1: 26, 2: 7}[len(names)])[1:-1].tolist()
    wanted = list(itertools.product(inside, repeat=len(names)))
    np.testing.assert_allclose(tried[: len(wanted)], wanted, atol=1e-12)


@pytest.mark.parametrize(('late', 'again'), [(1.2, True), (0.8, False)])
def test_effects_beside_late_loads_are_simulated_anew(late: float, again: bool) -> None:
    """If the delay closes more than half of a large chi-square, and no effect as it was simulated the rest."""
    shown = pictures(('load_delay', 'x'), B, C)
    rest = 20.0 * 6 * FINE
    plant = Plant(shown, without_noise((shown['load_delay', 'x'], late * rest), (shown[C], rest)) + noise())
    rows = [(candidate(n, 'x'), [[1e-3 * shown[n, 'x']]]) for n in ('load_delay', 'b')]
    beside: list[Fit | None] = []

    def screen(ws: Comparison, fit: Fit | None) -> Screen:
        beside.append(fit)
        return Screen(ws, rows)

    search = Search(plant, screen)
    null = refit(plant, ())
    assert mistake(search, null, search.screen.score(null.residual)) is null
    assert [named(fit) for fit in beside if fit] == [['load_delay']] * again


def test_a_fit_is_far_beyond_ten_a_value() -> None:
    fit = refit(Plant(pictures(A), noise()), ())
    for more, is_far in ((0.0, False), (0.1, True)):
        assert is_far_off(dataclasses.replace(fit, chi2=10.0 * 6 * FINE + more)) is is_far


def test_another_sample_rate_is_tried_from_afar() -> None:
    """A linear step does not reach it; the rates of the list are starts of their own."""
    tried: list[float] = []
    shown = {('sample_rate', 'error'): pictures(A)[A]}

    class Far(Plant):
        def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
            tried.extend(a.values['error'] for a in effects)
            return super().simulate(effects)

    plant = Far(shown, without_noise((shown['sample_rate', 'error'], 50.0 * 6 * FINE)))
    rows = [(candidate('sample_rate', 'error'), [[1e-3 * shown['sample_rate', 'error']]])]
    search = Search(plant, lambda ws, _: Screen(ws, rows))
    null = refit(plant, ())
    assert named(mistake(search, null, search.screen.score(null.residual))) == ['sample_rate']
    assert {-0.2, -0.1, -0.05, 0.05, 0.1, 0.25} <= set(tried)


def test_effects_are_added_until_budget_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    names = 'abcdef'
    shown = pictures(*((n, 'x') for n in names))
    plant = Plant(shown, without_noise(*((shown[n, 'x'], 900.0) for n in names)) + noise())
    full = ran(searching(plant, shown, names))
    assert (named(full.fit), full.limits) == (list(names), ())
    # The fit of no effect was before the search; after the first effect there is more than one simulation.
    for budget, effects in ((0, 0), (1, 1)):
        monkeypatch.setattr(plant, 'budget', budget)
        result = ran(searching(plant, shown, names))
        assert len(result.fit.effects) == effects
        (limit,) = result.limits
        assert limit.limit == f'{budget * max(effects, 1)} simulations for {effects} effect{"s" * (effects != 1)}'
        missing = sorted(set(names) - set(named(result.fit)))
        assert limit.further.startswith(f'{len(missing)} more term')
        assert all(name in limit.further.split('(')[1].split(')')[0] for name in missing)
        remaining, of = (float(words.split()[0]) for words in limit.further.split('be ')[-1].split(' instead of '))
        # Six effects of 900 in 14400 values.
        assert remaining < 0.9 * of


@pytest.mark.parametrize(
    ('gain', 'share', 'tried'),
    [(gain, *row) for gain in (900.0, 9e4) for row in ((0.47, []), (0.53, [['b']]))]
    + [(99.5, 0.45, []), (99.5, 0.55, [['b']])],
)
def test_what_explains_half_is_tried_instead(gain: float, share: float, tried: list[list[str]]) -> None:
    shown = pictures(A, B)
    shown[B] = math.sqrt(share) * shown[A] + math.sqrt(1.0 - share) * across(shown[B], shown[A])
    plant = Plant(shown, without_noise((shown[A], gain)))
    null, fit = refit(plant, ()), refit(plant, [active('a', x=0.0)])
    fits = searching(plant, shown, 'ab').alternatives(null, fit, 0, null.chi2 - fit.chi2)
    assert [named(f) for f in fits] == tried


def test_a_small_share_counts_beside_many_effects() -> None:
    names = 'abcdefghijkl'
    sizes = [9e5, 3e5, 1e5, 4e4, *[3000.0] * 8]
    shown = pictures(*((n, 'x') for n in names))
    measured = without_noise(*((shown[n, 'x'], size) for n, size in zip(names, sizes, strict=True))) + noise()
    result = ran(searching(Plant(shown, measured), shown, names))
    assert (named(result.fit), result.limits) == (list(names), ())
    # The library lacks so much that the rest does not leave next to nothing.
    few = ran(searching(Plant(shown, measured), shown, names[:7]))
    assert named(few.fit) == list('abcd')
    assert 'beside 4 effects explains less than 20% of what remains' in few.limits[0].limit


def test_stand_in_effect_is_reported_and_not_added() -> None:
    shown = pictures(A, B, C)
    # The library lacks c, which explains much more than b.
    plant = Plant(shown, without_noise((shown[A], 9e5), (shown[B], 4000.0), (shown[C], 60000.0)) + noise())
    result = ran(searching(plant, shown, 'ab'))
    assert named(result.fit) == ['a']
    (limit,) = result.limits
    assert limit.limit.startswith('b beside 1 effect explains less than 20% of what remains')
    assert limit.further.startswith('1 more term (b) would pass')
    full = ran(searching(plant, shown, 'abc'))
    assert (named(full.fit), full.limits) == (['a', 'b', 'c'], ())


def test_noise_beside_large_effect_hides_no_small_one() -> None:
    shown = pictures(A, B)
    shown[B] = across(shown[B], shown[A])

    class Rough(Plant):
        estimates = 0

        def renoised(self, effects: Sequence[ActiveEffect]) -> Self:
            # The first estimate takes what is left for noise, the next ones are right.
            level = np.full(6, SIGMA * (1.0 if self.estimates else 30.0))
            noise = (dataclasses.replace(self.noise[0], innovation=level),)
            return self.replaced(noise=noise, estimates=self.estimates + 1)

    plant = Rough(shown, without_noise((shown[A], 9e6), (shown[B], 900.0)) + noise())
    search, result = searching(plant, shown, 'ab').run(refit(plant, ()))
    assert named(result.fit) == ['a', 'b']
    assert cast(Rough, search.workspace).estimates >= 2


def test_the_better_of_two_alike_stays_the_other_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = pictures(A, B)
    shown[B] = shown[A] + 0.3 * across(shown[B], shown[A])
    plant = Plant(shown, without_noise((shown[A], 900.0)) + noise())
    search = searching(plant, shown, 'ab')
    result = ran(search)
    assert named(result.fit) == ['a']
    ((other,),) = result.alternatives
    assert named(other) == ['b']
    data, size = plant.measured[0].ravel() / SIGMA, 6 * FINE
    want = float(np.linalg.lstsq(columns(shown, B), data, rcond=None)[1][0])
    assert other.chi2 == pytest.approx(want, rel=1e-6)
    # From the worse one it swaps to the better.
    null, worse = refit(plant, ()), refit(plant, [active('b', x=0.0)])
    better, fits = search.swap(null, worse)
    assert (named(better), [named(f) for f in fits[0]]) == (['a'], [['b']])
    assert search.library_p(9.0, 1) == pytest.approx(1.0 - (1.0 - chi2_law.sf(9.0, 1)) ** 2)
    assert search.library_p(-1.0, 1) == 1.0
    assert search.penalty == pytest.approx(math.log(size * 4 / 20))
    # However much is spent.
    monkeypatch.setattr(plant, 'budget', 0)
    assert [named(f) for f in search.alternatives(null, worse, 0, null.chi2 - worse.chi2)] == [['a']]


EDGES = (0.0, 2.0, 9.0, 17.0, 25.0, 60.0, math.inf)


def energy_of(residual: FloatArray, explained: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """z (case, channel, band) as a normal deviate of the chi-square, and the energy beyond noise."""
    length = FINE // CASES
    f = np.abs(np.fft.fftfreq(length, 0.004))
    z, excess = np.zeros((CASES, 6, 6)), np.zeros((CASES, 6, 6))
    for case in range(CASES):
        span = slice(case * length, (case + 1) * length)
        spectrum = np.abs(np.fft.fft(residual.reshape(6, FINE)[:, span], axis=1)) ** 2 / length
        for b in range(6):
            at = (f >= EDGES[b]) & (f < EDGES[b + 1])
            dof, energy = int(at.sum()), spectrum[:, at].sum(axis=1)
            if explained is not None:
                wrong = np.abs(np.fft.fft(explained.reshape(6, FINE)[:, span], axis=1)) ** 2 / length
                energy = energy / (1.0 + 0.002**2 * wrong[:, at].sum(axis=1) / dof)
            p = chi2_law.sf(energy, dof)
            z[case, :, b], excess[case, :, b] = norm.isf(np.maximum(p, 1e-300)), energy - dof
    return z, excess


@pytest.mark.parametrize('explains', [False, True])
def test_cells_are_normal_deviates_of_their_energy(explains: bool) -> None:
    """By the chi-square law itself; two thousandths of what is explained may be the simulation's own error."""
    residual = noise(6) / SIGMA
    t = np.arange(50) * 0.004
    residual[3, 150:200] += 1.2 * np.sin(2 * np.pi * 20.0 * t)
    residual[1, 350:400] += 1.2
    explained = 400.0 * noise(11).ravel() / SIGMA if explains else None
    plant = Plant({}, noise())
    located = localise(plant, residual.ravel(), None, np.random.default_rng(1), explained=explained)
    z, excess = energy_of(residual.ravel(), explained)
    # The cube root of a chi-square is normal but for its lowest values.
    inside = (z > -1.0) & (z < 5.0)
    assert np.abs(located.map - z)[inside].max() < 0.25
    order = np.argsort(-z, axis=None)
    first = [np.unravel_index(int(i), z.shape) for i in order[:2]]
    for cell, (case, c, b) in zip(located.cells[:2], first, strict=True):
        assert (cell.channel, cell.recording) == (CHANNELS[int(c)], 0)
        assert cell.when == pytest.approx((0.2 * case, 0.2 * (case + 1)))
        assert cell.band == (EDGES[int(b)], min(EDGES[int(b) + 1], 125.0))
        assert cell.energy == pytest.approx(excess[case, c, b], rel=1e-6)
        assert cell.statistic == located.map[case, c, b]
        assert cell.p < 0.01
    assert len(located.cells) == 12
    assert all(a.statistic >= b.statistic for a, b in zip(located.cells, located.cells[1:], strict=False))
    np.testing.assert_allclose(located.spans, [(0, 0.2 * k, 0.2 * (k + 1)) for k in range(8)])
    significant = [c for c in located.cells if c.p < 0.01]
    assert located.excess == pytest.approx(sum(c.energy for c in significant), rel=1e-6)
    assert len(localise(plant, residual.ravel(), None, np.random.default_rng(1), limit=3).cells) == 3


def test_the_chance_of_the_greatest_cell_is_that_of_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of noise alone it is anything between 0 and 1; what the model has fitted is taken off the noise too."""
    monkeypatch.setattr('psd_deflection.studies.discover.search.localise.dependences', lambda *_: [])
    plant = Plant({}, noise())
    chances = [
        localise(plant, noise(20 + k).ravel() / SIGMA, None, np.random.default_rng(k)).cells[0].p for k in range(6)
    ]
    assert 0.1 < float(np.mean(chances)) < 0.9
    assert min(chances) > 1e-3
    # A fitted column that holds most of one cell: noise is expected to be smaller there.
    known = np.zeros((6 * FINE, 1))
    known[:50, 0] = 1.0
    residual = noise(3).ravel() / SIGMA
    taken = residual - known[:, 0] * (known[:, 0] @ residual) / 50.0
    assert localise(plant, taken, known, np.random.default_rng(0)).p > 0.01


def test_what_the_simulation_may_be_wrong_by_is_no_dependence() -> None:
    """A five-hundredth of the length of what is explained on that channel is taken off each product."""
    workspace = Workspace([make_observation()])
    rng = np.random.default_rng(2)
    residual, explained = (
        rng.standard_normal(sum(m.size for m in workspace.measured)),
        rng.standard_normal(sum(m.size for m in workspace.measured)),
    )
    table = regressors(workspace)
    plain = {(d.channel, d.regressor): d.gain for d in dependences(workspace, table, residual, None)}
    assert len(plain) == 6 * 27
    for size in (100.0, 1000.0):
        gains = {
            (d.channel, d.regressor): d.gain for d in dependences(workspace, table, residual, None, size * explained)
        }
        for (channel, name), gain in plain.items():
            rows = workspace.split(size * explained)[0][CHANNELS.index(channel)]
            root = max(math.sqrt(gain) - 0.002 * float(np.linalg.norm(rows)), 0.0)
            assert gains[channel, name] == pytest.approx(root**2, rel=1e-6, abs=1e-9)


def amplitudes(*kinds: tuple[str, str, float], same: bool = False, finite: bool = False) -> Fit:
    """A fit of sizes with these units and values, each known to a thousandth of 1; of one effect or of each its own."""
    effects: list[ActiveEffect] = []
    for i, (name, unit, value) in enumerate(kinds):
        parameter = EffectParameter(name, unit, -9.0, 9.0, 1e-3, '')
        full = dataclasses.replace(
            active('e', **{name: 0.0}).effect, name=f'e{i}', parameters=(parameter,), finite=finite
        )
        effects.append(ActiveEffect(full, {name: value}))
    free = [(i, name) for i, (name, _, _) in enumerate(kinds)]
    if same:
        parameters = tuple(p for a in effects for p in a.effect.parameters)
        values = {n: v for a in effects for n, v in a.values.items()}
        effects = [ActiveEffect(dataclasses.replace(effects[0].effect, parameters=parameters), values)]
        free = [(0, name) for name, _, _ in kinds]
    return Fit(tuple(effects), 0.0, np.zeros(9), [], 1e3 * np.eye(9)[:, : len(kinds)], tuple(free), ())


def test_only_like_sizes_of_two_effects_are_compared() -> None:
    physics = Physics.of(RIG)
    two = [('x', 'V', 0.5), ('y', 'V', 0.5)]
    ((tie),) = coincidences(amplitudes(*two), physics)
    assert (tie.members, tie.sizes, tie.unit) == (((0, 'x'), (1, 'y')), (0.5, 0.5), 'V')
    assert coincidences(amplitudes(*two, same=True), physics) == []
    # Of unlike quantities, an angle and a share among them, the numbers may be alike.
    for a, b in itertools.combinations({p.unit for e in catalogue().values() for p in e.parameters}, 2):
        assert coincidences(amplitudes(('x', a, 0.5), ('y', b, 0.5)), physics) == []
    # Five deviations from nothing, or it has no size; and what a step does at once has none.
    for size, pairs in ((0.0049, 1), (0.0051, 3)):
        (first,) = coincidences(amplitudes(*two, ('z', 'V', size)), physics)
        assert first.odds == pytest.approx(tie.odds / pairs)
    assert coincidences(amplitudes(*two, finite=True), physics) == []
    # Odds of 21 and of 18 to 1.
    tied, apart = (coincidences(amplitudes(two[0], ('y', 'V', size)), physics) for size in (0.5044, 0.5046))
    assert (len(tied), apart) == (1, [])
    # The more pairs there are, the likelier one of them agrees.
    three = coincidences(amplitudes(*two, ('z', 'V', 0.1)), physics)
    assert [t.odds for t in three] == pytest.approx([tie.odds / 3.0])
    several = coincidences(amplitudes(*two, ('z', 'V', 0.501)), physics)
    assert [t.odds for t in several] == sorted((t.odds for t in several), reverse=True)
    assert [len(t.members) for t in several] == [3, 2, 2, 2]


def test_three_sizes_are_tied_where_no_two_are() -> None:
    physics = Physics.of(RIG)
    two = [('x', '', 0.03), ('y', '', 0.0303)]
    assert coincidences(amplitudes(*two), physics)[0].odds < 40.0
    more = [('u', '', 0.4), ('v', '', 2.0), ('w', '', 8.0)]
    assert coincidences(amplitudes(*two, *more), physics) == []
    (tie,) = coincidences(amplitudes(*two, ('z', '', -0.0297), *more), physics)
    assert [name for _, name in tie.members] == ['x', 'y', 'z']
    assert 20.0 < tie.odds < 200.0


@pytest.mark.parametrize(('least', 'most', 'sign'), [(0.0, 1.0, 1.0), (-1.0, 0.0, -1.0)])
def test_a_size_leaves_its_bound_for_however_little_it_gains(least: float, most: float, sign: float) -> None:
    """Half a standard deviation inside; outside it stays."""
    shown = pictures(A)
    for inside in (1.0, -1.0):
        plant = Plant(shown, sign * inside * without_noise((shown[A], 0.25)))
        fit = refit(plant, [active('a', least, most, x=0.0)])
        want = sign * 0.5 * SIGMA / np.linalg.norm(shown[A]) if inside > 0.0 else 0.0
        assert fit.effects[0].values['x'] == pytest.approx(want, rel=1e-3, abs=1e-12)
        assert fit.at_bound == (() if inside > 0.0 else ((0, 'x'),))


@pytest.mark.parametrize(('length', 'size'), [(0.49, 0.0), (0.51, 0.25), (0.0, 0.3)])
def test_a_size_that_nothing_determines_is_off(length: float, size: float) -> None:
    """Over its whole range, 2, it moves the residual by less than a deviation; of nothing it stays where it began."""
    shown = pictures(A)
    shown[A] *= length * SIGMA / np.linalg.norm(shown[A])
    fit = refit(Plant(shown, 0.25 * shown[A]), [active('a', x=0.3)])
    assert fit.effects[0].values['x'] == pytest.approx(size, abs=1e-4)


def test_recording_of_few_samples_is_excluded_alone() -> None:
    full = make_observation(warm=None)
    volts = full.volts.copy()
    volts[60:] = np.nan
    poor = dataclasses.replace(full, volts=volts)
    (sums, both) = (movement_sums(o, ()) for o in ([full], [poor, full]))
    assert both.squared == sums.squared > 0.0
    np.testing.assert_array_equal(both.cross, sums.cross)
    np.testing.assert_array_equal(both.load_products, sums.load_products)
    volts[60:80] = full.volts[60:80]
    assert movement_sums([dataclasses.replace(full, volts=volts), full], ()).squared > sums.squared
    # Sums over the blocks of what the dots moved about their mean, m^2.
    dots = full.volts[:, [0, 1, 3, 4]] * RIG.amplifier.sensitivity
    blocks = dots.reshape(60, 20, 4).mean(axis=1)
    assert sums.squared == pytest.approx(float(((blocks - blocks.mean(axis=0)) ** 2).sum()))
    noise_of_dots = float(np.mean(RIG.noises[:, :2] ** 2)) * RIG.amplifier.sensitivity**2
    assert sums.noise == pytest.approx(noise_of_dots / 20.0)
    # A load moves as much as it does alone, in proportion.
    for k in range(3):
        only = np.zeros_like(full.loads)
        only[:, k] = full.loads[:, k]
        moved = ForwardModel(RIG, []).run(only).dots.T.reshape(60, 20, 4).mean(axis=1)
        moved -= moved.mean(axis=0)
        assert sums.load_products[k, k] == pytest.approx(float((moved**2).sum()), rel=1e-2)
        np.testing.assert_allclose(
            np.diag(sums.cross[k]).sum(), float((moved * (blocks - blocks.mean(axis=0))).sum()), rtol=2e-2
        )
    residual, sizes = load_sizes(sums, Wiring.from_rig(RIG))
    assert sizes == pytest.approx([1.0, 1.0, 1.0], abs=0.02)
    assert residual < 1e-3 * sums.squared
    assert noise_energy([full, full]) == pytest.approx(2 * noise_of_dots * 4 * 1200 / 400)


@pytest.mark.parametrize(('loss', 'is_alternative'), [(6.9, True), (7.1, False)])
def test_what_comes_close_in_bic_is_a_rival(loss: float, is_alternative: bool) -> None:
    """By up to 10, with 3 for its further parameter; an equivalent one would have to be as close as 6."""
    shown = pictures(A)
    search = searching(Plant(shown, without_noise((shown[A], 500.0))), shown, 'a')
    search.penalty = 3.0
    fit = refit(search.workspace, [active('a', x=0.0)])
    jacobian = np.eye(fit.residual.size)[:, :2]
    other = dataclasses.replace(
        fit, effects=(active('b', x=0.1, y=0.1),), chi2=fit.chi2 + loss, free=((0, 'x'), (0, 'y')), jacobian=jacobian
    )
    result = steps.SearchResult(refit(search.workspace, ()), fit, [0.0], [99.0], [500.0], alternatives=[[other]])
    (named,) = alternatives(problem_of(search, result, [HeldOut(9.0, 1.0)])).named
    assert named.equivalent == ()
    assert [(r.active.effect.name, r.delta_bic, r.fit) for r in named.fitted_alternatives] == [
        ('b', loss + 3.0, other)
    ] * is_alternative
    if is_alternative:
        assert named.fitted_alternatives[0].sd == pytest.approx({'x': 1.0, 'y': 1.0})
    # One that ran into its bound is none.
    stopped = dataclasses.replace(other, at_bound=((0, 'x'), (0, 'y')))
    without = dataclasses.replace(result, alternatives=[[stopped]])
    (named,) = alternatives(problem_of(search, without, [HeldOut(9.0, 1.0)])).named
    assert named.fitted_alternatives == ()


def test_evidence_is_what_the_file_leaves_over_what_is_left() -> None:
    o = make_observation(warm=None)
    _, (unit,), _ = correct_wiring([dataclasses.replace(o, loads=o.loads / [9.80665, 9.80665, 1.0])], ())
    # The wiring is right: a unit leaves no more of the movement than another size does.
    assert (unit.name, unit.where) == ('load_unit', 'fx fy')
    assert unit.evidence == pytest.approx(1.0)
    rotated = dataclasses.replace(o, volts=o.volts * [1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    _, (sign,), _ = correct_wiring([rotated], ())
    m, file = movement_sums([rotated], ()), Wiring.from_rig(RIG)
    right = dataclasses.replace(file, axes=(('x', '-y'), file.axes[1]))
    energy = noise_energy([rotated])
    reported, sizes = load_sizes(m, file)
    # With the file's wiring a load seems to pull the wrong way: then it explains nothing.
    assert (sizes < 0.0).any()
    assert reported < m.squared
    assert sign.evidence == pytest.approx((m.squared + energy) / (load_sizes(m, right)[0] + energy))
