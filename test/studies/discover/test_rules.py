# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rules and the statistics of discover, against least squares of numpy on a plant that is linear.

The plant shows the sum of its effects, each a fixed picture times its size, in noise of known level.
So each answer is that of a textbook: least squares, its covariance, its loss of chi-square.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, Self, cast

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_law

from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.catalogue import make_active
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.discover import experiment, planning
from psd_deflection.studies.discover.noise import NoiseModel, estimate_noise
from psd_deflection.studies.discover.problem import Machine, Problem
from psd_deflection.studies.discover.search.comparison import Comparison, SimulationCount
from psd_deflection.studies.discover.search.fit import Fit, HeldOut, heldout_gain, heldout_gap, heldout_residual, refit
from psd_deflection.studies.discover.search.localise import NOWHERE, Cell, Localisation, dependences, regressors
from psd_deflection.studies.discover.search.screen import Candidate, Score, Screen
from psd_deflection.studies.discover.search.search import Search, SearchResult
from psd_deflection.studies.discover.search.smooth import Table
from psd_deflection.studies.discover.search.trials import wald_chi_square
from psd_deflection.studies.discover.search.weighing import coincidences, covariance_of, unknown_of
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.steps import accepted, alternatives, credible
from psd_deflection.studies.loads.plate_motion import fine_means

RIG, SIGMA = load_rig(), 1e-3
FINE, CASES = 400, 8
N = 6 * FINE
Pictures = Mapping[tuple[str, str], FloatArray]


def effect(name: str, *parameters: str, least: float = -1.0, most: float = 1.0) -> Effect:
    return Effect(
        name=name,
        stage='electronics',
        summary='',
        equation='',
        source='',
        needs='',
        parameters=tuple(EffectParameter(p, 'V', least, most, 1e-3, '') for p in parameters),
        point='output',
        apply=lambda chunk, values, state: None,
    )


def active(name: str, least: float = -1.0, most: float = 1.0, **values: float) -> ActiveEffect:
    return ActiveEffect(effect(name, *values, least=least, most=most), values)


class Plant(Workspace):
    """``measured`` (6, FINE) V: sizes times ``pictures``, and noise of ``SIGMA``; eight load cases of equal length."""

    def __init__(self, pictures: Pictures, measured: FloatArray) -> None:
        size = 4
        nothing = np.zeros((FINE * size, 6))
        self.pictures = pictures
        self.observations = (Observation('plant', RIG, nothing, nothing[:, :3]),)
        self.physics = Physics.of(RIG)
        self.tally = SimulationCount()
        self.base = ()
        self.fine = [size]
        self.measured = [measured]
        self.count = [np.ones((6, FINE))]
        self.case = [np.arange(FINE) * CASES // FINE]
        level = np.full(6, SIGMA)
        self.noise = (NoiseModel(2 * level, np.zeros((6, 2)), level, level / math.sqrt(5.0), 1.0, (False,) * 6),)

    def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        self.tally.count += 1
        total = np.zeros((6, FINE))
        for a in effects:
            for name, value in a.values.items():
                total += value * self.pictures[a.effect.name, name]
        return [total]

    def renoised(self, effects: Sequence[ActiveEffect]) -> Self:
        return self


class Lone(Machine):
    """A machine with nothing but a comparison. ``left``: where every fit leaves structure."""

    def __init__(self, plant: Workspace, residual: Localisation = NOWHERE) -> None:
        self.plant, self.residual = plant, residual

    def compared(self) -> Workspace:
        return self.plant

    def screen(self, comparison: Comparison, fit: Fit | None) -> Screen:
        return Screen(comparison, [])

    def regressors(self, comparison: Comparison, fit: Fit) -> Table:
        return [(c, {}) for c in comparison.channels]

    def look(self, comparison: Comparison, fit: Fit, null: Fit | None, rng: np.random.Generator) -> Localisation:
        return self.residual

    def suggest(self, comparison: Comparison, fit: Fit, equal: Sequence[Fit]) -> planning.Suggestion | None:
        return planning.Suggestion(f'try {len(equal)}', 1.0)


def problem_of(
    search: Search, result: SearchResult, heldout: Sequence[HeldOut] = (), residual: Localisation = NOWHERE
) -> Problem:
    """What the search of a lone machine found, before it is weighed."""
    return Problem(
        machine=Lone(cast(Workspace, search.workspace), residual),
        search=search,
        result=result,
        fit=result.fit,
        null=result.null,
        rng=np.random.default_rng(0),
        seed=0,
        progress=lambda _: None,
        heldout=tuple(heldout),
    )


def ran(search: Search) -> SearchResult:
    """What a search finds."""
    return search.run(refit(search.workspace, ()))[1]


def pictures(*names: tuple[str, str], seed: int = 1) -> dict[tuple[str, str], FloatArray]:
    rng = np.random.default_rng(seed)
    return {n: rng.standard_normal((6, FINE)) for n in names}


def noise(seed: int = 2) -> FloatArray:
    return SIGMA * np.random.default_rng(seed).standard_normal((6, FINE))


def columns(shown: Pictures, *names: tuple[str, str]) -> FloatArray:
    """(D, p): whitened pictures, one a column."""
    return np.stack([shown[n].ravel() / SIGMA for n in names], axis=1)


def without_noise(*at: tuple[FloatArray, float]) -> FloatArray:
    """Each picture at the size that explains this much chi-square, and nothing else."""
    return cast(FloatArray, sum(p * SIGMA * math.sqrt(gain) / np.linalg.norm(p) for p, gain in at))


def search_of(plant: Plant, library: int = 1, penalty: float = 3.0) -> Search:
    screen = SimpleNamespace(candidates=[None] * library)
    search = Search(plant, lambda *_: cast(Screen, screen))
    search.penalty = penalty
    return search


def result_of(search: Search, effects: Sequence[ActiveEffect], tied_fits: Sequence[Sequence[Fit]] = ()) -> SearchResult:
    null, fit = refit(search.workspace, ()), refit(search.workspace, effects)
    p, bic, gains = search.weigh(null, fit)
    return SearchResult(null, fit, p, bic, gains, alternatives=[list(o) for o in tied_fits])


A, B = ('a', 'x'), ('b', 'x')


def test_a_refit_is_least_squares_with_its_covariance() -> None:
    shown = pictures(A, ('a', 'y'), B)
    shown['b', 'x'] += shown['a', 'x']
    truth = 2e-3 * shown['a', 'x'] - 5e-3 * shown['a', 'y'] + 1e-3 * shown['b', 'x']
    plant = Plant(shown, truth + noise())
    fit = refit(plant, [active('a', x=0.0, y=0.0), active('b', x=0.0)])
    matrix, data = columns(shown, A, ('a', 'y'), B), plant.measured[0].ravel() / SIGMA
    want, (rss,), _, _ = np.linalg.lstsq(matrix, data, rcond=None)
    got = [fit.effects[0].values['x'], fit.effects[0].values['y'], fit.effects[1].values['x']]
    np.testing.assert_allclose(got, want, atol=1e-9)
    assert fit.chi2 == pytest.approx(rss, rel=1e-9)
    assert fit.residual == pytest.approx(data - matrix @ want, abs=1e-5)
    np.testing.assert_allclose(fit.jacobian, matrix, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(fit.covariance(), np.linalg.inv(matrix.T @ matrix), rtol=1e-6)
    assert (fit.free, [fit.columns_of(i) for i in (0, 1)]) == (((0, 'x'), (0, 'y'), (1, 'x')), [[0, 1], [2]])
    assert (fit.parameters, fit.at_bound) == (3, ())
    # The start, one pass of three differences, a step; then one more, which gains nothing.
    assert plant.simulations <= 12


def test_a_step_that_makes_it_worse_is_damped_twenty_times_more() -> None:
    """Of a unit in its own scale the step is 1/(1 + damping): 1e-4, 2e-3, 0.04, 0.8, 16."""
    shown, tried = pictures(A), list[float]()

    class Worse(Plant):
        def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
            (x,) = (a.values['x'] for a in effects)
            tried.append(x)
            # A step of the finite difference is 5e-5.
            return [shown[A] * (x if x < 1e-4 else -1.0)]

    refit(Worse(shown, 1e-2 * shown[A]), [active('a', x=0.0)], iterations=1)
    assert tried == pytest.approx([0.0, 5e-5, *(1e-2 / (1.0 + d) for d in (1e-4, 2e-3, 0.04, 0.8, 16.0))])


def test_a_refit_stops_at_a_bound_and_the_rest_adapts() -> None:
    shown = pictures(A, B)
    shown['b', 'x'] += shown['a', 'x']
    plant = Plant(shown, 5e-3 * shown['a', 'x'] + 1e-3 * shown['b', 'x'] + noise())
    for most, least, end in ((2e-3, -1.0, 2e-3), (1.0, 7e-3, 7e-3)):
        fit = refit(
            plant, [active('a', least, most, x=0.5 * (max(least, -0.01) + min(most, 0.01))), active('b', x=0.0)]
        )
        assert (fit.at_bound, fit.effects[0].values['x']) == (((0, 'x'),), end)
        residual = (plant.measured[0] - end * shown['a', 'x']).ravel()
        want = residual @ shown['b', 'x'].ravel() / np.sum(shown['b', 'x'] ** 2)
        assert fit.effects[1].values['x'] == pytest.approx(want, abs=1e-8)
    # A bound that the start lies beyond is where it begins.
    assert refit(plant, [active('a', -1.0, 2e-3, x=0.9)], iterations=0).effects[0].values['x'] == 2e-3


def test_inexact_model_has_sd_of_load_case_scatter() -> None:
    """Each fold has an effect of another size: the jackknife of least squares tells how sure it is."""
    shown = pictures(A)
    plant = Plant(shown, noise())
    fold = np.tile(plant.case[0] % 4, 6).reshape(6, FINE)
    plant.measured[0] += np.array([3e-3, 5e-3, 9e-3, 4e-3])[fold] * shown[A]
    result = result_of(search_of(plant), [active('a', x=0.0)], [[]])
    sizes = []
    for k in range(4):
        rest = fold != k
        sizes.append(np.sum(plant.measured[0][rest] * shown[A][rest]) / np.sum(shown[A][rest] ** 2))
    want = math.sqrt(3 / 4 * np.sum((np.array(sizes) - np.mean(sizes)) ** 2))
    (named,) = alternatives(problem_of(search_of(plant), result, [HeldOut(9.0, 1.0)])).named
    assert named.sd['x'] == pytest.approx(want, rel=1e-3)
    # Nothing but noise: the sd of least squares.
    exact = Plant(shown, 5e-3 * shown[A] + noise())
    result = result_of(search_of(exact), [active('a', x=0.0)], [[]])
    (named,) = alternatives(problem_of(search_of(exact), result, [HeldOut(9.0, 1.0)])).named
    assert named.sd['x'] == pytest.approx(SIGMA / np.linalg.norm(shown[A]), rel=1e-6)


def test_covariance_has_the_stated_sd_and_the_fits_correlation() -> None:
    """The scatter over load cases widens what is stated beyond the fit: the covariance is as wide."""
    shown = pictures(A, B)
    shown['b', 'x'] += 0.5 * shown['a', 'x']
    search = search_of(Plant(shown, 3e-3 * shown['a', 'x'] - 2e-3 * shown['b', 'x'] + noise()))
    result = result_of(search, [active('a', x=0.0), active('b', x=0.0)], [[], []])
    named = alternatives(problem_of(search, result, [HeldOut(9.0, 1.0)] * 2)).named
    wide = [dataclasses.replace(n, sd={'x': factor * n.sd['x']}) for n, factor in zip(named, (3.0, 7.0), strict=True)]
    names, covariance = covariance_of(result.fit, wide)
    matrix = columns(shown, A, B)
    want = np.linalg.inv(matrix.T @ matrix) * np.outer([3.0, 7.0], [3.0, 7.0])
    assert names == ('a.x', 'b.x')
    np.testing.assert_allclose(covariance, want, rtol=1e-6)


def test_four_recordings_are_left_out_one_by_one() -> None:
    plant = Plant(pictures(A), noise())
    assert plant.folds().tolist() == [0, 1, 2, 3, 0, 1, 2, 3]
    plant.case = [np.repeat([2 * i, 2 * i + 1], FINE // 2) for i in range(4)]
    assert plant.folds().tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_effect_weight_is_chi_square_lost_without_it() -> None:
    shown = pictures(A, ('b', 'x'), ('b', 'y'))
    shown['b', 'x'] += 0.5 * shown['a', 'x']
    plant = Plant(shown, 1e-4 * shown['a', 'x'] - 2e-4 * shown['b', 'x'] + noise())
    result = result_of(search_of(plant, library=50, penalty=4.0), [active('a', x=0.0), active('b', x=0.0, y=0.0)])
    data = plant.measured[0].ravel() / SIGMA

    def rss(*names: tuple[str, str]) -> float:
        return float(np.linalg.lstsq(columns(shown, *names), data, rcond=None)[1][0])

    full = rss(A, B, ('b', 'y'))
    lost = [rss(B, ('b', 'y')) - full, rss(A) - full]
    assert result.delta_chi2 == pytest.approx(lost, rel=1e-5)
    assert result.delta_bic == pytest.approx([lost[0] - 4.0, lost[1] - 8.0], rel=1e-5)
    # Sidak: the chance that the best of 50 does as well.
    want = [1.0 - (1.0 - chi2_law.sf(g, k)) ** 50 for g, k in zip(lost, (1, 2), strict=True)]
    assert result.p == pytest.approx(want, rel=1e-3)


class Basins(Plant):
    """Its only size moves the picture by ``x**3 - 0.75 x``: from below 0 a fit ends at the top at -0.5."""

    def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        self.tally.count += 1
        return [
            sum((a.values['x'] ** 3 - 0.75 * a.values['x']) * self.pictures[A] for a in effects) + np.zeros((6, FINE))
        ]


@pytest.mark.parametrize(
    ('starts', 'size', 'fitted'),
    # Of no use are a start that leaves more, and any if little is left.
    [((), 1.0, -0.5), ((1.05,), 1.0, 1.1), ((0.6, 1.05, 0.9), 1.0, 1.1), ((0.6,), 1.0, -0.5), ((1.05,), 0.01, -0.5)],
)
def test_a_fit_that_is_far_off_is_tried_from_elsewhere(starts: tuple[float, ...], size: float, fitted: float) -> None:
    shown = {A: size * pictures(A)[A]}
    search = search_of(Basins(shown, (1.1**3 - 0.75 * 1.1) * shown[A]))
    parameter = EffectParameter('x', 'V', -2.0, 2.0, 1e-2, '', starts=starts)
    start = ActiveEffect(dataclasses.replace(effect('a', 'x'), parameters=(parameter,)), {'x': -0.6})
    best = search.best_of([[start]], 1, 30)
    assert best is not None
    assert best.effects[0].values['x'] == pytest.approx(fitted, abs=0.01)


@pytest.mark.parametrize(
    ('gain', 'penalty', 'library', 'named'),
    [
        # BIC better by more than 10.
        (16.1, 6.0, 1, True),
        (15.9, 6.0, 1, False),
        (14.9, 5.0, 1, False),
        # p of the whole library at most 1e-4: chi-square of 28.4 has p 1e-7, and there are 1000.
        (28.6, 3.0, 1000, True),
        (28.2, 3.0, 1000, False),
        # As in one of 640 recordings without fault: 75 candidates, BIC better by 10.4, p 0.001.
        (19.3, 8.9, 75, False),
    ],
)
def test_an_effect_is_named_from_stated_limits_on(gain: float, penalty: float, library: int, named: bool) -> None:
    shown = pictures(A)
    search = search_of(Plant(shown, without_noise((shown[A], gain))), library, penalty)
    result = result_of(search, [active('a', x=0.0)])
    assert result.delta_chi2 == pytest.approx([gain], rel=1e-6)
    after = accepted(problem_of(search, result))
    assert [a.effect.name for a in after.fit.effects] == (['a'] if named else [])
    weighed = after.result
    assert len(after.heldout) == len(weighed.p) == len(weighed.delta_bic) == len(weighed.delta_chi2) == named
    assert bool(search.trace) == (not named)


@pytest.mark.parametrize(
    ('weaker', 'open_level', 'named'), [(1.0, False, True), (0.1, False, False), (1.0, True, True), (0.1, True, False)]
)
def test_an_effect_whose_size_may_be_zero_is_not_named(
    monkeypatch: pytest.MonkeyPatch, weaker: float, open_level: bool, named: bool
) -> None:
    """As if something that is free beside it could take nearly all of its place."""
    shown = pictures(A, ('a', 'y'))
    plant = Plant(shown, without_noise((shown[A], 200.0), (shown['a', 'y'], 100.0)))
    monkeypatch.setattr(plant, 'open_level', open_level)
    search = search_of(plant)
    result = result_of(search, [active('a', x=0.0, y=0.0)])
    fit = dataclasses.replace(result.fit, jacobian=weaker * result.fit.jacobian)
    lost = result.null.chi2 - fit.chi2
    assert wald_chi_square(plant, fit, 0) == pytest.approx(weaker**2 * lost, rel=1e-3)
    assert bool(accepted(problem_of(search, dataclasses.replace(result, fit=fit))).fit.effects) is named


def test_infinite_nominal_has_infinite_wald_value() -> None:
    endless = EffectParameter('x', 'V', -1.0, 1.0, 1e-3, '', nominal=math.inf)
    plant = Plant(pictures(A), noise())
    active = ActiveEffect(dataclasses.replace(effect('a', 'x'), parameters=(endless,)), {'x': 0.0})
    assert wald_chi_square(plant, refit(plant, [active]), 0) == math.inf


@pytest.mark.parametrize(('cases', 'named'), [(range(8), True), ((0, 4), False)])
def test_what_does_not_hold_on_unseen_load_cases_is_not_named(cases: Sequence[int], named: bool) -> None:
    """Its picture should show in every load case. If it shows in two of one fold, the others speak against it."""
    shown = pictures(A)
    inside = np.isin(np.arange(FINE) * CASES // FINE, list(cases))
    share = np.sum(shown[A][:, inside] ** 2) / np.sum(shown[A] ** 2)
    search = search_of(Plant(shown, without_noise((shown[A], 60.0)) * inside / share))
    result = result_of(search, [active('a', x=0.0)])
    assert result.delta_chi2 == pytest.approx([60.0], rel=1e-3)
    assert bool(accepted(problem_of(search, result)).fit.effects) == named


def test_an_amplitude_at_its_bound_is_named_only_if_off_there() -> None:
    shown = pictures(('a', 'x'), ('a', 'y'))
    truth = 5e-3 * shown['a', 'x'] + 1e-3 * shown['a', 'y']
    search = search_of(Plant(shown, truth + noise()))
    for least, most, named in ((-1.0, 8e-3, True), (-1.0, 3e-3, False), (-1.0, 5e-4, False), (0.0, 1.0, True)):
        if least == 0.0:
            search = search_of(Plant(shown, 5e-3 * shown['a', 'x'] - 1e-3 * shown['a', 'y'] + noise()))
        start = active('a', least, most, x=0.0, y=0.0)
        assert bool(accepted(problem_of(search, result_of(search, [start]))).fit.effects) == named


@pytest.mark.parametrize(('apart', 'open_level', 'named'), [(0.11, False, 2), (0.09, False, 1), (0.09, True, 2)])
def test_two_that_take_each_other_back_are_not_both_named(
    apart: float, open_level: bool, named: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By more than ten times what there is to explain, whatever the effects are."""
    shown = pictures(A, B)
    shown[B] = shown[A] + apart * shown[B]
    plant = Plant(shown, without_noise((shown[B] - shown[A], 1e6)))
    monkeypatch.setattr(plant, 'open_level', open_level)
    result = result_of(search := search_of(plant), [active('a', x=0.0), active('b', x=0.0)])
    assert len(accepted(problem_of(search, result)).fit.effects) == named


def test_weakest_effect_goes_first_then_reweighed() -> None:
    shown = pictures(A, B)
    # Two pictures nearly the same: with the other present, each seems to explain nothing.
    shown['b', 'x'] = shown['a', 'x'] + 0.1 * shown['b', 'x']
    search = search_of(Plant(shown, without_noise((shown[A], 300.0)) + noise()))
    result = result_of(search, [active('b', x=0.0), active('a', x=0.0)])
    assert max(result.delta_bic) < 10.0
    after = accepted(problem_of(search, result))
    weakest = int(
        np.argmin([result_of(search, [active('a', x=0.0)]).fit.chi2, result_of(search, [active('b', x=0.0)]).fit.chi2])
    )
    assert ([a.effect.name for a in after.fit.effects], len(after.heldout)) == (['ab'[weakest]], 1)


@pytest.mark.parametrize(('gain', 'stays'), [(13.5, True), (12.5, False)])
def test_a_step_of_the_search_passes_from_the_same_limit_on(gain: float, stays: bool) -> None:
    shown = pictures(A)
    search = search_of(Plant(shown, without_noise((shown[A], gain))))
    null, fit = refit(search.workspace, ()), refit(search.workspace, [active('a', x=0.0)])
    assert search.passes(null, fit, null) == stays


def test_one_more_may_pass_by_its_chance_and_by_bic() -> None:
    search = search_of(Plant(pictures(A), noise()), penalty=3.0)
    for p, gain, passes in ((1e-4, 13.1, True), (1.1e-4, 13.1, False), (1e-4, 13.0, False)):
        assert search.may_pass(Score(candidate('a', 'x'), gain, 1, p, np.zeros(1))) is passes


@pytest.mark.parametrize(('gain', 'channel', 'stays'), [(480.0, 0, True), (320.0, 0, False), (20.0, 1, True)])
def test_simulation_error_counts_only_where_it_explains(gain: float, channel: int, stays: bool) -> None:
    """Two thousandths of the movement that the first effect explains, on its own channel and in its own band: 400."""
    at = np.arange(FINE)
    shown = {A: np.zeros((6, FINE)), B: np.zeros((6, FINE))}
    shown[A][0] = np.sin(2.0 * np.pi * at / 40.0)
    shown[B][channel] = np.cos(2.0 * np.pi * at / 40.0)
    search = search_of(Plant(shown, without_noise((shown[A], 1e8), (shown[B], gain))))
    null, single = refit(search.workspace, ()), refit(search.workspace, [active('a', x=0.0)])
    both = refit(search.workspace, [active('a', x=0.0), active('b', x=0.0)])
    assert single.chi2 - both.chi2 == pytest.approx(gain, rel=1e-3)
    assert search.passes(single, both, null) == stays


@pytest.mark.parametrize(
    ('loss', 'names', 'equal'),
    [
        # Sizes of one more parameter must be as close in BIC too: 6, with a penalty of 3 for each.
        (21.5, ('x',), True),
        (21.7, ('x',), False),
        (2.9, ('x', 'y'), True),
        (3.1, ('x', 'y'), False),
    ],
)
def test_an_alternative_is_equivalent_up_to_a_stated_loss(loss: float, names: tuple[str, ...], equal: bool) -> None:
    shown = pictures(A, ('c', 'x'))
    search = search_of(Plant(shown, without_noise((shown[A], 500.0), (shown['c', 'x'], 500.0))))
    both = [active('a', x=0.0), active('c', x=0.0)]
    fit = refit(search.workspace, both)
    other = dataclasses.replace(
        fit,
        effects=(fit.effects[1], active('b', **dict.fromkeys(names, 0.0))),
        chi2=fit.chi2 + loss,
        free=((0, 'x'), *((1, n) for n in names)),
        jacobian=np.zeros((N, 1 + len(names))),
    )
    result = dataclasses.replace(result_of(search, both, [[other], []]), fit=fit)
    named, beside = alternatives(problem_of(search, result, [HeldOut(9.0, 1.0)] * 2)).named
    assert (beside.equivalent, beside.alternatives, beside.suggestion) == ((), (), None)
    assert named.equivalent == (('b',) if equal else ())
    assert (named.suggestion is not None) == equal
    ((name, lost, bic),) = named.alternatives
    assert name == 'b'
    assert lost == pytest.approx(loss)
    assert bic == pytest.approx(loss + 3.0 * (len(names) - 1))


@pytest.mark.parametrize(('remains', 'names'), [(200.0, ['a', 'c']), (420.0, ['a', 'c']), (1000.0, ['c'])])
def test_weak_effects_are_dropped_before_alternatives(remains: float, names: list[str]) -> None:
    shown = pictures(A, B, ('c', 'x'))
    plant = Plant(shown, without_noise((shown[A], 500.0), (shown['c', 'x'], 4000.0), (shown[B], remains)) + noise())
    rows = [(candidate(n, 'x'), [[shown[n, 'x']]]) for n in ('a', 'c')]
    search = Search(plant, lambda workspace, _: Screen(workspace, rows))
    _, result = search.run(refit(plant, ()), refit(plant, [active('c', x=0.0), active('a', x=0.0)]))
    assert sorted(a.effect.name for a in result.fit.effects) == names


def test_held_out_residual_is_of_fit_without_its_cases() -> None:
    shown = pictures(A, B)
    plant = Plant(shown, 1e-4 * shown[A] - 1e-4 * shown[B] + noise())
    fit = refit(plant, [active('a', x=0.0), active('b', x=0.0)])
    matrix, data = columns(shown, A, B), plant.measured[0].ravel() / SIGMA
    # Cases 0 and 4, 1 and 5, ... are one fold.
    fold, want = np.tile(plant.case[0] % 4, 6), np.empty(N)
    for k in range(4):
        rest = np.linalg.lstsq(matrix[fold != k], data[fold != k], rcond=None)[0]
        want[fold == k] = data[fold == k] - matrix[fold == k] @ rest
    got = heldout_residual(plant, fit)
    assert np.abs(got - want).max() < 1e-4 * np.abs(want - fit.residual).max() + 1e-6
    null = refit(plant, ())
    np.testing.assert_array_equal(heldout_residual(plant, null), null.residual)
    gain = heldout_gain(plant, null, fit)
    assert gain.gain == pytest.approx(0.5 * float(data @ data - want @ want), rel=1e-3)
    # The gap: rms over the four dots of means over 20 samples (5 fine blocks), in metres.
    volts = SIGMA * want.reshape(6, FINE)[[0, 1, 3, 4]].reshape(4, -1, 5).mean(axis=2)
    dots = volts * RIG.sensitivities.reshape(4, 1)
    assert heldout_gap(plant, fit) == pytest.approx(float(np.sqrt(np.mean(dots**2))), rel=1e-4)
    assert heldout_gap(plant, null) == plant.gap(null.difference)
    # What one case alone shows is off for the others if it is a size; a shape stays.
    once, late = np.eye(FINE)[0] * np.ones((6, 1)), np.eye(FINE)[-1] * np.ones((6, 1))
    plant = Plant({A: late, ('a', 'y'): once}, without_noise((once, 400.0)))
    x, y = effect('a', 'x', 'y').parameters
    for kind in ('amplitude', 'shape'):
        of_kind = dataclasses.replace(effect('a', 'x'), parameters=(x, dataclasses.replace(y, kind=kind)))
        fit = refit(plant, [ActiveEffect(of_kind, {'x': 0.0, 'y': 0.0})])
        want = fit.residual if kind == 'shape' else refit(plant, ()).residual
        np.testing.assert_allclose(heldout_residual(plant, fit), want, atol=1e-3)


def test_the_error_of_an_unseen_gain_is_the_smaller_of_two() -> None:
    """sqrt(2 gain), of the likelihood ratio; or the scatter of half seconds drawn again."""
    shown = pictures(A)
    plant = Plant(shown, without_noise((shown[A], 400.0)))
    # Every half second (125 fine blocks) gains the same: the scatter of 4 pieces is that of their sizes alone.
    null, fit = refit(plant, ()), refit(plant, [active('a', x=0.0)])
    gain = heldout_gain(plant, null, fit)
    data = (null.residual**2 - heldout_residual(plant, fit) ** 2).reshape(6, FINE).sum(axis=0) / 2.0
    piece = np.array([data[a : a + 125].sum() for a in range(0, FINE, 125)])
    bootstrap = math.sqrt(len(piece)) * float(np.std(piece))
    assert gain.gain == pytest.approx(piece.sum())
    assert gain.error == pytest.approx(min(bootstrap, math.sqrt(2.0 * gain.gain)))
    spike = np.zeros((6, FINE))
    spike[:, 0] = 1.0
    plant = Plant({A: spike}, without_noise((spike, 400.0)))
    null, fit = refit(plant, ()), refit(plant, [active('a', x=0.0)])
    gain = heldout_gain(plant, null, dataclasses.replace(fit, jacobian=np.zeros_like(fit.jacobian)))
    assert gain.error == pytest.approx(math.sqrt(2.0 * 200.0), rel=1e-3)
    assert gain.significant
    assert not HeldOut(2.0, 1.0).significant
    assert HeldOut(2.1, 1.0).significant


def candidate(name: str, *parameters: str, least: float = -1.0) -> Candidate:
    e = effect(name, *parameters, least=least)
    off = dict.fromkeys(parameters, 0.0)
    return Candidate(e, off, parameters, off)


def test_a_score_is_the_chi_square_that_a_candidate_would_gain() -> None:
    shown = pictures(A, ('b', 'x'), ('b', 'y'), ('c', 'x'), ('d', 'x'))
    shown['d', 'x'] = 1e-6 * SIGMA * shown['d', 'x']
    plant = Plant(shown, 2e-4 * shown[A] - 1e-4 * shown['b', 'y'] - 1e-4 * shown['c', 'x'] + noise())
    rows = [
        (candidate('a', 'x'), [[shown[A]]]),
        (candidate('b', 'x', 'y'), [[shown['b', 'x']], [shown['b', 'y']]]),
        (candidate('c', 'x', least=0.0), [[shown['c', 'x']]]),
        (candidate('d', 'x'), [[shown['d', 'x']]]),
    ]
    screen = Screen(plant, rows)
    # d changes the readings by less than a thousandth of sigma in all.
    assert [c.effect.name for c in screen.candidates] == ['a', 'b', 'c']
    data = plant.measured[0].ravel() / SIGMA

    def rss(*names: tuple[str, str]) -> float:
        return float(np.linalg.lstsq(columns(shown, *names), data, rcond=None)[1][0]) if names else float(data @ data)

    for known in ((), (('c', 'x'),)):
        scores = {s.candidate.effect.name: s for s in screen.score(data, columns(shown, *known) if known else None)}
        residual = data
        if known:
            matrix = columns(shown, *known)
            residual = data - matrix @ np.linalg.lstsq(matrix, data, rcond=None)[0]
            scores = {s.candidate.effect.name: s for s in screen.score(residual, matrix)}
        for name, keys in (('a', [A]), ('b', [('b', 'x'), ('b', 'y')])):
            gain = rss(*known) - rss(*known, *keys)
            assert scores[name].gain == pytest.approx(gain, rel=1e-3)
            assert scores[name].dof == len(keys)
            assert scores[name].p == pytest.approx(1.0 - (1.0 - chi2_law.sf(gain, len(keys))) ** 3, rel=1e-2)
    # The size of c is negative, which its bounds do not allow.
    assert {s.candidate.effect.name: s.gain for s in screen.score(data)}['c'] == 0.0
    order = [s.gain for s in screen.score(data)]
    assert order == sorted(order, reverse=True)
    assert screen.score(data)[0].coefficients == pytest.approx([2e-4], rel=0.1)


def test_a_pair_is_scored_jointly() -> None:
    """Two pictures that are nearly opposite: alone neither explains much, together all."""
    shown = pictures(A, B, ('c', 'x'), ('c', 'y'))
    shown[B] = -shown[A] + 0.05 * shown[B]
    plant = Plant(shown, 2e-3 * (shown[A] + shown[B]) + noise())
    rows = [
        (candidate('c', 'x', 'y'), [[shown['c', 'x']], [shown['c', 'y']]]),
        (candidate('a', 'x'), [[shown[A]]]),
        (candidate('b', 'x', least=0.0), [[shown[B]]]),
    ]
    screen = Screen(plant, rows)
    data = plant.measured[0].ravel() / SIGMA
    (first, second, gain), *rest = screen.pairs(data, 3.0, 3)
    assert [first.candidate.effect.name, second.candidate.effect.name] in (['a', 'b'], ['b', 'a'])
    c, (rss,), _, _ = np.linalg.lstsq(columns(shown, A, B), data, rcond=None)
    assert gain == pytest.approx(float(data @ data) - rss, rel=1e-2)
    both = {s.candidate.effect.name: float(s.coefficients[0]) for s in (first, second)}
    assert [both['a'], both['b']] == pytest.approx(c.tolist(), rel=1e-2)
    assert {s.candidate.effect.name: len(s.coefficients) for s in rest[0][:2]}['c'] == 2
    # The opposite sign of b is not allowed, whoever stands first.
    for order in (rows, rows[::-1]):
        names = [
            {a.candidate.effect.name, b.candidate.effect.name} for a, b, _ in Screen(plant, order).pairs(-data, 3.0, 3)
        ]
        assert {'a', 'b'} not in names


def test_sizes_come_from_coefficients_of_pictures() -> None:
    kinds = (
        EffectParameter('x', 'V', -1.0, 1.0, 0.1, '', nominal=0.2),
        EffectParameter('place', 'm', -1.0, 1.0, 0.5, '', kind='coupled'),
        EffectParameter('angle', 'rad', -4.0, 4.0, 1.0, '', kind='phase', partner='x'),
    )
    e = dataclasses.replace(effect('a', 'x'), parameters=kinds[:2])
    off = {'x': 0.2, 'place': 0.0}
    values = Candidate(e, off, ('x', 'place'), off).from_coefficients(np.array([2.0, 0.5])).values
    # 0.2 + 2 probes of 0.1; a place is in proportion to the amplitude: 0.5/2 of 0.5 m.
    assert values == pytest.approx({'x': 0.4, 'place': 0.125})
    assert Candidate(e, off, ('x', 'place'), off).from_coefficients(np.array([20.0, 0.0])).values['x'] == 1.0
    e = dataclasses.replace(effect('a', 'x'), parameters=(dataclasses.replace(kinds[0], nominal=0.0), kinds[2]))
    off = {'x': 0.0, 'angle': 0.0}
    values = Candidate(e, off, ('x', 'angle'), off).from_coefficients(np.array([3.0, 4.0])).values
    assert values == pytest.approx({'x': 0.5, 'angle': math.atan2(4.0, 3.0)})


@pytest.mark.parametrize(('ratio', 'tied'), [(1.0, True), (1.02, True), (1.1, False), (2.0, False), (-1.0, True)])
def test_two_sizes_are_tied_if_their_ratio_is_one_within_the_fit(ratio: float, tied: bool) -> None:
    shown = pictures(A, B)
    shown[B] -= shown[A] * np.sum(shown[A] * shown[B]) / np.sum(shown[A] ** 2)
    size = 50 * SIGMA / np.linalg.norm(shown[A]) / (0.01 / 0.02)
    plant = Plant(shown, size * shown[A] + ratio * size * shown[B])
    fit = refit(plant, [active('a', x=0.0), active('b', x=0.0)])
    got = coincidences(fit, plant.physics)
    assert bool(got) == tied
    if tied:
        k = fit.covariance()
        a, b = (e.values['x'] for e in fit.effects)
        # The spread of ln(a/b), with a floor of 0.2 %; against a flat law over two decades.
        deviation = math.sqrt(k[0, 0] / a**2 + k[1, 1] / b**2 - 2.0 * k[0, 1] / (a * b) + 0.002**2)
        density = math.exp(-0.5 * (math.log(abs(a / b)) / deviation) ** 2) / (deviation * math.sqrt(2.0 * math.pi))
        assert got[0].odds == pytest.approx(density * 2.0 * math.log(10.0), rel=1e-6)
        assert (got[0].members, got[0].unit) == (((0, 'x'), (1, 'x')), 'V')


def nowhere(**changes: Any) -> Localisation:
    return dataclasses.replace(Localisation((), (), 0.0, 1.0, np.zeros((1, 6, 6)), ()), **changes)


@pytest.mark.parametrize(
    ('p', 'excess', 'explained', 'unknown'),
    [
        (0.9e-4, 61.0, 0.0, True),
        (1.1e-4, 61.0, 0.0, False),
        (0.9e-4, 59.0, 0.0, False),
        # However much is explained.
        (0.9e-4, 61.0, 1e9, True),
    ],
)
def test_a_remainder_is_unknown_from_stated_limits_on(p: float, excess: float, explained: float, unknown: bool) -> None:
    got = unknown_of(nowhere(p=p, excess=excess), explained)
    assert bool(got) == unknown
    if unknown:
        assert got[0].explains == pytest.approx(excess / (excess + explained))
        assert got[0].unexplained


@pytest.mark.parametrize(('gap', 'unknown'), [(0.5, False), (2.0, False), (2.01, True)])
def test_nothing_is_unknown_that_noise_alone_would_leave(gap: float, unknown: bool) -> None:
    """In micrometres, of which noise leaves two."""
    assert bool(unknown_of(nowhere(p=0.0, excess=100.0), 0.0, 1e-6 * gap, 2e-6)) is unknown
    # Of a machine whose noise nobody knows.
    assert unknown_of(nowhere(p=0.0, excess=100.0), 0.0, 1e-6 * gap, math.inf)
    # Hum is in no mean of a block, and no gap has it.
    for low, p, reported in ((25.0, 0.009, True), (25.0, 0.011, unknown), (17.0, 0.009, unknown)):
        hum = Cell('x1', 0, (0.0, 1.0), (low, 60.0), (), 9.0, p, 50.0)
        assert bool(unknown_of(nowhere(p=0.0, excess=100.0, cells=(hum,)), 0.0, 1e-6 * gap, 2e-6)) is reported
    # The noise of one recording may be a little more than that of most.
    assert not unknown_of(nowhere(p=0.0, excess=100.0), 0.0, 1e-6 * gap, 2e-6, 2.01e-6)
    assert unknown_of(nowhere(p=0.0, excess=100.0), 0.0, 2.02e-6, 2e-6, 2.01e-6)


@pytest.mark.slow
def test_noise_exceeds_gap_limit_once_in_a_thousand() -> None:
    rng = np.random.default_rng(7)
    plant = Plant({}, noise())
    above = [plant.gap([SIGMA * rng.standard_normal((6, FINE))]) > plant.noise_limit() for _ in range(4000)]
    assert 1 <= sum(above) <= 10


class Valleys(Plant):
    """It gives way and hums for a moment: over the frequency its loss has side valleys, in which a fit ends."""

    def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        self.tally.count += 1
        t = np.arange(FINE) / FINE
        out = np.zeros((6, FINE))
        for a in effects:
            out += a.values['x'] * (1.0 + (t < 0.1) * np.sin(2.0 * np.pi * a.values['f'] * t))
        return [out]


@pytest.mark.parametrize(
    ('size', 'excess', 'open_level', 'expected'),
    # It stays if nothing is unknown, if nobody knows the noise, and if much remains.
    [(2e-3, 100.0, False, 40.0), (2e-3, 0.0, False, 52.0), (2e-3, 100.0, True, 52.0), (4e-3, 100.0, False, 52.0)],
)
def test_a_fit_in_a_side_valley_is_restarted(size: float, excess: float, open_level: bool, expected: float) -> None:
    shape = EffectParameter('f', 'Hz', 2.0, 190.0, 0.2, '', kind='shape')
    hums = effect('a', 'x')
    hums = dataclasses.replace(hums, parameters=(*hums.parameters, shape))
    plant = Valleys({}, noise())
    plant.measured[0] += plant.simulate([ActiveEffect(hums, {'x': size, 'f': 40.0})])[0]
    search = search_of(plant.replaced(open_level=open_level))
    result = result_of(search, [ActiveEffect(hums, {'x': 1e-3, 'f': 52.0})])
    assert result.fit.effects[0].values['f'] == pytest.approx(52.0, abs=1.0)
    after = credible(problem_of(search, result, [HeldOut(1.0, 1.0)], nowhere(p=0.0, excess=excess)))
    assert [a.values['f'] for a in after.fit.effects] == pytest.approx([expected], abs=1.0)


def test_dependence_is_chi_square_of_regressor() -> None:
    history = loads.steps([(0, 0, 0), (5, -20, -9), (-10, 10, 12)], 0.6).loads
    volts = ForwardModel(RIG, []).expect(history, None).volts.T + noise(8)[0, 0]
    rng = np.random.default_rng(4)
    observed = Observation('seen', RIG, volts + 2e-3 * rng.standard_normal(volts.shape), history)
    workspace = Workspace([observed])
    residual = rng.standard_normal(sum(m.size for m in workspace.measured))
    chunk = ForwardModel(RIG, []).run(history, None)
    size = workspace.fine[0]
    dot = fine_means(chunk.dots, size)
    load = fine_means(chunk.loads, size)
    part = workspace.split(residual)
    table = regressors(workspace)
    gains = {(d.channel, d.regressor): d.gain for d in dependences(workspace, table, residual, None)}
    cases = [
        (0, 'x1', 'dot_x^2', dot[0] ** 2),
        (1, 'y1', 'dot_y', dot[1]),
        (2, 'sum1', '|dot_y|', np.abs(dot[1])),
        (3, 'x2', 'dot_x dot_y', dot[2] * dot[3]),
        (4, 'y2', 'dot_y r^2', dot[3] * (dot[2] ** 2 + dot[3] ** 2)),
        (4, 'y2', 'load_fy^2', load[1] ** 2),
        (5, 'sum2', 'rate of dot_x', np.gradient(dot[2])),
    ]
    for c, channel, name, regressor in cases:
        e = part[0][c]
        assert gains[channel, name] == pytest.approx((e @ regressor) ** 2 / (regressor @ regressor), rel=1e-6)
    # What a known column explains is taken off both.
    known = rng.standard_normal((len(residual), 1))
    known[: 2 * dot.shape[1], 0] += np.tile(1e4 * dot[0] ** 2, 2)
    e = residual - known[:, 0] * (known[:, 0] @ residual) / (known[:, 0] @ known[:, 0])
    row = np.zeros((6, dot.shape[1]))
    row[0] = dot[0] ** 2
    column = row.ravel()
    column = column - known[:, 0] * (known[:, 0] @ column) / (known[:, 0] @ known[:, 0])
    gains = {(d.channel, d.regressor): d.gain for d in dependences(workspace, table, residual, known)}
    assert gains['x1', 'dot_x^2'] == pytest.approx((e @ column) ** 2 / (column @ column), rel=1e-6)
    best = max(dependences(workspace, table, residual, None), key=lambda d: d.gain)
    assert best.p == pytest.approx(1.0 - (1.0 - chi2_law.sf(best.gain, 1)) ** len(gains), rel=0.05)


def test_counts_gaps_and_floor_of_a_workspace() -> None:
    volts = 2e-3 * np.random.default_rng(0).standard_normal((2000, 6))
    volts[[3, 99, 1001]] = np.nan
    volts[4:8, 1] = np.nan
    volts[40:51, 4] = np.nan
    workspace = Workspace([Observation('seen', RIG, volts, np.zeros((2000, 3)))])
    assert workspace.fine == [4]
    # One fine block has no sample of y1, two have none of y2.
    assert workspace.size == 6 * 500 - 3
    assert workspace.effective_size() == pytest.approx(np.isfinite(volts).sum() / 20)
    rows = volts[:, [0, 1, 3, 4]] * RIG.sensitivities.reshape(4)
    blocks = np.nanmean(rows.reshape(100, 20, 4), axis=1)
    # Eleven of twenty samples are missing: this block of y2 does not count.
    blocks[2, 3] = np.nan
    each = workspace.gap_per_channel(workspace.measured)
    assert each == pytest.approx(np.sqrt(np.nanmean(blocks**2, axis=0)), rel=1e-9)
    assert workspace.gap(workspace.measured) == pytest.approx(float(np.sqrt(np.nanmean(blocks**2))), rel=1e-9)
    sigma = workspace.noise[0].block_sigma[[0, 1, 3, 4]] * RIG.sensitivities.reshape(4)
    there = np.isfinite(rows).reshape(100, 20, 4).mean(axis=1)
    variance = np.where(np.isfinite(blocks), sigma**2 / there, np.nan)
    assert workspace.floor() == pytest.approx(float(np.sqrt(np.nanmean(variance))), rel=1e-9)


@pytest.mark.parametrize('share', [0.1, 0.3, 0.6])
def test_noise_of_recording_with_gaps_equals_full_one(share: float) -> None:
    """Behind a slow movement of a hundred times the noise, which zeros in the gaps would take for noise."""
    rng = np.random.default_rng(5)
    volts = 2e-3 * rng.standard_normal((8000, 6))
    volts[2000:] += 0.2 * np.sin(np.arange(6000) / 300.0)[:, None]
    volts[rng.random(8000) < share] = np.nan
    loads_of = np.zeros((8000, 3))
    loads_of[2000:, 1] = np.repeat([1.0, 2.0, 1.0], 2000)
    model = estimate_noise(Observation('gaps', RIG, volts, loads_of), volts, 4, np.full(6, 5e-4))
    assert model.sigma == pytest.approx(np.full(6, 2e-3), rel=0.08)
    assert not any(model.coloured)


def test_experiment_separates_what_no_size_explains(monkeypatch: pytest.MonkeyPatch) -> None:
    """The least chi-square between two effects over the other's size, old and new data together; by a scan."""
    history = loads.steps([(0, 0, 0), (0, -50, -10)], 0.4)
    given = make_active('bending_stiffness', {'scale': -0.02, 'moves_frequency': 0}, 'test')
    other = make_active('clamp_bending_compliance', {'compliance': 1e-7}, 'test')
    volts = ForwardModel(RIG, [given]).expect(history.loads, None).volts.T
    volts = volts + 2e-3 * np.random.default_rng(0).standard_normal(volts.shape)
    workspace = Workspace([Observation('seen', RIG, volts, history.loads)])
    named, alternative = refit(workspace, [given]), refit(workspace, [other])
    new = loads.steps([(0, 0, 0), (30, 0, 0)], 0.4)
    shorter = experiment.Setting('', {'link.length': 0.4})
    offered = experiment.Proposal(shorter, experiment.Piece('pull', ('steps:0,0,0;30,0,0:0.4',)))
    idle = experiment.Proposal(experiment.Setting(), experiment.Piece('wait', ('constant:0,0,0:0.4',)))
    monkeypatch.setattr(planning, 'proposals', lambda *_: [idle, offered])
    plan = planning.plan_next(workspace, named, [alternative], experiment.Limits(seconds=0.8))
    suggestion = planning.suggest(workspace, named, [alternative], experiment.Limits(seconds=0.8))
    assert plan is not None
    assert suggestion is not None
    assert suggestion.words == 'pull'
    short = load_rig(overrides={'link.length': 0.4})
    sigma = workspace.noise[0].innovation[:, None]

    def there(a: ActiveEffect) -> FloatArray:
        return fine_means(ForwardModel(short, [a]).expect(new.loads, None).volts, 4) / sigma

    (name,) = [n for _, n in alternative.free]
    size = alternative.effects[0].values[name]

    def apart(change: float) -> float:
        moved = ActiveEffect(alternative.effects[0].effect, {**alternative.effects[0].values, name: size + change})
        old = change**2 * float(np.sum(alternative.jacobian**2))
        return float(np.sum((there(named.effects[0]) - there(moved)) ** 2)) + old

    reach = 0.5 * abs(size)
    trials = np.linspace(-reach, reach, 5)
    # A parabola, to first order.
    curve = np.polynomial.Polynomial.fit(trials, [apart(float(c)) for c in trials], 2)
    low = float(curve(curve.deriv().roots()[0].real))
    (reported,) = plan.discriminations
    assert reported.separation == pytest.approx(low, rel=0.05)
    assert suggestion.separation == pytest.approx(max(reported.separation, reported.reverse), rel=1e-9)
    assert planning.suggest(workspace, named, []) is None
