# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What remains without a name: one smooth function, or many small terms that predict."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.optimize import lsq_linear
from scipy.stats import multivariate_normal, ttest_1samp

import psd_deflection
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.plants import EffectParameter, Model, Plant, plant_effect
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.studies.discover.plant_search import PlantComparison, PlantDiscovery
from psd_deflection.studies.discover.search import predictive, subsets
from psd_deflection.studies.discover.search import smooth as smoothing
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.screen import Screen
from psd_deflection.studies.discover.search.smooth import Remainders, Smooth, smooth_of, unseen_residual

from .test_rules import FINE, SIGMA, active, candidate, columns, noise, pictures
from .test_rules import Plant as LinearPlant

NOISE = 0.1
SLOPE = plant_effect('slope', EffectParameter('size', 'mm', -9.0, 9.0, 0.1, 'per turn'))


class Table(Plant):
    """Thirty readings at places ``along`` and ``across``: a slope, waves along, noise; each is left out by itself."""

    channels, units, cases = ('height',), ('mm',), ('table',)
    library = (SLOPE,)
    nuisance = (plant_effect('offset', EffectParameter('size', 'mm', -9.0, 9.0, 0.1, 'of all')),)
    groups = 30

    def __init__(self, seed: int, waves: float, noise: float = NOISE, count: int = 30) -> None:
        rng = np.random.default_rng(seed)
        self.along, self.across = rng.uniform(0.0, 1.0, (2, count))
        self.error = noise * rng.standard_normal(count)
        self.observed = 2.0 * self.along + waves * np.sin(9.0 * self.along) + self.error

    def measured(self) -> list[FloatArray]:
        return [self.observed[None, :]]

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        return {'along': [self.along], 'across': [self.across]}

    def parts(self) -> list[IntArray]:
        return [np.arange(len(self.along)) % self.groups]

    def simulate(self, model: Model) -> list[FloatArray]:
        slope = model.get('slope', {'size': 0.0})['size']
        return [(model['offset']['size'] + slope * self.along)[None, :]]


def smooth(plant: Table, variables: Mapping[str, Sequence[FloatArray]] | None = None) -> Smooth | None:
    """What remains beside offset and slope."""
    ws = PlantComparison(plant)
    fit = refit(ws, [ActiveEffect(SLOPE, {'size': 0.0})])
    return smooth_of(ws, fit, plant.variables() if variables is None else variables)


def test_smooth_remainder_is_function_of_its_variable() -> None:
    plant = Table(1, 1.0)
    discovery = psd_deflection.discover_in(plant)
    remainder = discovery.tree()['remainder']
    assert remainder['depends_on'] == ['along']
    # Little but the noise remains of readings that the function has not seen; those at the ends are the worst.
    assert remainder['heldout'] < 2.5 * NOISE < 0.5 * discovery.gap_heldout_after
    assert discovery.verdict == 'unknown_effect'
    assert 'a smooth function of along that has no name' in discovery.unknown[-1].signature
    assert discovery.remainder is not None
    function = discovery.remainder.function
    assert function is not None
    assert discovery.remainder.rms == pytest.approx(math.sqrt(function.before**2 - function.heldout**2))
    # It is the waves, but for what offset and slope take.
    free = np.column_stack([np.ones(30), plant.along, np.sin(9.0 * plant.along)])
    residual = function.tables[0][0]
    assert np.std(residual - free @ np.linalg.lstsq(free, residual, rcond=None)[0]) < NOISE
    assert 'a smooth function of along' in discovery.report()


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(2))
def test_noise_alone_is_no_function(seed: int) -> None:
    assert smooth(Table(seed, 0.0)) is None


@pytest.mark.slow
def test_library_effects_and_stated_noise_are_no_remainder() -> None:
    assert psd_deflection.discover_in(Table(1, 0.0)).tree()['remainder'] is None
    quiet = Table(1, 1.0)
    quiet.noise = (1.0,)
    assert psd_deflection.discover_in(quiet).tree()['remainder'] is None


@pytest.mark.slow
def test_a_reading_is_predicted_without_itself() -> None:
    rng = np.random.default_rng(2)
    x = np.sort(rng.uniform(0.0, 1.0, 24))
    values = np.sin(9.0 * x) + 0.1 * rng.standard_normal(24)
    apart = {'x': (x[:, None] - x) ** 2 / np.var(x)}
    there = np.ones(24, dtype=bool)

    def residual(readings: FloatArray) -> FloatArray:
        remains = Remainders(readings, np.zeros(24, dtype=np.int64), np.ones((24, 1)), np.arange(24), apart)
        return unseen_residual(remains, ('x',), np.log([[0.1, 1.0, 0.5]]), there)

    moved = values.copy()
    moved[7] += 0.5
    assert residual(moved)[7] - residual(values)[7] == pytest.approx(0.5, abs=1e-6)
    assert float(np.std(residual(values))) < 0.3


def test_predictions_with_all_shapes_agree_with_a_closed_form() -> None:
    """Left out one by one, with size, length and noise given: the residual of reading i is (P y)_i / P_ii, where P is
    the inverse covariance without what the free sizes can do (Dubrule 1983).
    """
    rng = np.random.default_rng(3)
    n, size, length, noise = 24, 1.3, 0.6, 0.4
    x = rng.uniform(0.0, 1.0, n)
    values = np.sin(9.0 * x) + 0.1 * rng.standard_normal(n)
    free = np.column_stack([np.ones(n), x])
    apart = {'x': (x[:, None] - x) ** 2 / np.var(x)}
    remains = Remainders(values, np.zeros(n, dtype=np.int64), free, np.arange(n), apart)
    residual = unseen_residual(remains, ('x',), np.log([[noise, size, length]]), np.ones(n, dtype=bool), shaped=True)
    inverse = np.linalg.inv(size**2 * np.exp(-0.5 * apart['x'] / length**2) + noise**2 * np.eye(n))
    p = inverse - inverse @ free @ np.linalg.inv(free.T @ inverse @ free) @ free.T @ inverse
    np.testing.assert_allclose(residual, (p @ values) / np.diag(p), rtol=1e-6, atol=1e-9)
    # What an effect cannot do here has no size.
    idle = dataclasses.replace(remains, sizes=np.column_stack([free, np.zeros(n)]))
    shapes = np.log([[noise, size, length]])
    again = unseen_residual(idle, ('x',), shapes, np.ones(n, dtype=bool), shaped=True)
    np.testing.assert_allclose(again, residual, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ('count', 'groups', 'there'),
    [(30, 8, True), (30, 7, False), (20, 30, True), (19, 30, False), (150, 8, True), (151, 8, False)],
)
def test_few_or_many_readings_report_no_function(count: int, groups: int, there: bool) -> None:
    plant = Table(1, 1.0, count=max(count, 30))
    plant.observed[count:], plant.groups = np.nan, groups
    assert ((smooth(plant) is not None), smooth(plant, {})) == (there, None)


def test_shared_sizes_leave_the_likelihood_once() -> None:
    """Up to a constant it is the density of what is left of the values across all that the effects can do."""
    rng = np.random.default_rng(5)
    channel = np.repeat([0, 1, 0, 1], [7, 5, 4, 6])
    values, sizes, place = rng.standard_normal(22), rng.standard_normal((22, 3)), rng.uniform(0.0, 3.0, 22)
    apart = {'place': (place[:, None] - place[None, :]) ** 2}
    remains = Remainders(values, channel, sizes, np.arange(22), apart)
    basis = smoothing.orthonormal_basis(sizes)
    parts = [(remains.part(channel == c), basis[channel == c]) for c in (0, 1)]
    across = null_space(sizes.T)

    def exact(shapes: FloatArray) -> float:
        same = channel[:, None] == channel[None, :]
        noise, size, length = np.exp(shapes)[channel].T
        full = same * size[:, None] ** 2 * np.exp(-0.5 * apart['place'] / length[:, None] ** 2) + np.diag(noise**2)
        return -float(multivariate_normal(cov=across.T @ full @ across).logpdf(across.T @ values))

    first, second = np.log([[0.5, 1.0, 0.7], [0.3, 2.0, 1.5]]), np.log([[0.2, 1.5, 0.4], [0.9, 0.7, 0.9]])
    (value, _), (other, gradient) = (
        smoothing.negative_log_likelihood(s.ravel(), parts, ('place',)) for s in (first, second)
    )
    assert other - value == pytest.approx(exact(second) - exact(first))
    steps = 1e-5 * np.eye(6).reshape(6, 2, 3)
    numeric = [(exact(second + h) - exact(second - h)) / 2e-5 for h in steps]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_sixty_parts_and_eight_inputs_take_few_evaluations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng, asked, names = np.random.default_rng(1), itertools.count(), [f'u{i}' for i in range(8)]
    u, likelihood = rng.uniform(-1.0, 1.0, (60, 8)), smoothing.negative_log_likelihood
    y = np.column_stack([2.0 * u[:, 0] - u[:, 1] + np.sin(6.0 * u[:, 2]), u @ rng.standard_normal(8)])
    rows = np.column_stack([u, y + 0.05 * rng.standard_normal((60, 2)), np.arange(60)])
    np.savetxt(tmp_path / 'a.csv', rows, delimiter=',', header=','.join([*names, 'y', 'z', 'part']), comments='')
    monkeypatch.setattr(smoothing, 'negative_log_likelihood', lambda *a, **k: (next(asked), likelihood(*a, **k))[1])
    answer = psd_deflection.discover_in(tmp_path / 'a.csv', inputs=names, outputs=['y', 'z'], parts='part')
    assert (answer.simulations < 20_000, 0 < next(asked) < 6000) == (True, True)


TERMS = 30


class Small(Plant):
    """Two channels, points that count by themselves; each term is a random picture, ``sizes`` the true ones."""

    channels, units, cases = ('a', 'b'), ('m', 'm'), ('all',)

    def __init__(self, sizes: FloatArray, points: int = 40, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.library = tuple(
            plant_effect(f't{i}', EffectParameter('size', 'm', -50.0, 50.0, 0.3, '')) for i in range(len(sizes))
        )
        # Neighbours are alike, as harmonics of few stars are.
        raw = rng.standard_normal((len(sizes), 2, points))
        self.pictures = raw + 0.7 * np.roll(raw, 1, axis=0)
        self.truth = np.tensordot(sizes, self.pictures, 1)
        self.observed = self.truth + rng.standard_normal(self.truth.shape)

    def measured(self) -> list[FloatArray]:
        return [self.observed]

    def simulate(self, model: Model) -> list[FloatArray]:
        terms = [v['size'] * self.pictures[int(name[1:])] for name, v in model.items()]
        return [np.sum([np.zeros_like(self.observed), *terms], axis=0)]

    def parts(self) -> Sequence[IntArray]:
        return [np.arange(self.observed.shape[1])]

    def cut(self, at: slice) -> Small:
        out = Small(np.zeros(len(self.pictures)), 1)
        out.pictures, out.truth, out.observed = self.pictures[..., at], self.truth[:, at], self.observed[:, at]
        return out


def forward_backward(plant: Small) -> Model:
    """Terms by the smallest N log RSS + k log N, one added or dropped at a time."""
    table, y = plant.pictures.reshape(TERMS, -1).T, plant.observed.ravel()
    chosen: frozenset[int] = frozenset()

    def sizes(terms: frozenset[int]) -> FloatArray:
        return np.asarray(np.linalg.lstsq(table[:, sorted(terms)], y, rcond=None)[0])

    def bic(terms: frozenset[int]) -> float:
        residual = y - table[:, sorted(terms)] @ sizes(terms)
        return float(len(y) * np.log(residual @ residual) + len(terms) * np.log(len(y)))

    while (best := min((chosen ^ {j} for j in range(TERMS)), key=bic)) and bic(best) < bic(chosen):
        chosen = best
    return {f't{j}': {'size': float(v)} for j, v in zip(sorted(chosen), sizes(chosen), strict=True)}


@pytest.mark.parametrize('seed', range(2))
def test_twelve_small_terms_are_predicted_as_by_bic_or_better(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    sizes = np.zeros(TERMS)
    sizes[rng.permutation(TERMS)[:12]] = rng.uniform(1.5, 3.0, 12) * rng.choice([-1, 1], 12) / np.sqrt(80 * 1.5)
    full = Small(sizes, 440, seed)
    observed, new = full.cut(slice(0, 40)), full.cut(slice(40, 440))
    discovery = psd_deflection.discover_in(observed)

    def wrong(model: Model) -> float:
        return float(np.sqrt(np.mean((new.simulate(model)[0] - new.truth) ** 2)))

    assert np.hypot(1.0, wrong(discovery.predictive)) <= 1.1 * np.hypot(1.0, wrong(forward_backward(observed)))
    assert wrong(discovery.predictive) < wrong({e.name: e.values for e in discovery.effects})
    np.testing.assert_array_equal(discovery.predict(new)[0], new.simulate(discovery.predictive)[0])


def test_what_small_terms_do_together_is_reported_everywhere() -> None:
    rng = np.random.default_rng(5)
    discovery = psd_deflection.discover_in(Small(0.22 * rng.standard_normal(TERMS), 60, 5))
    tree = json.loads(discovery.json())
    assert (discovery.verdict, tree['remains']) == ('unknown_effect', True)
    message = tree['predictive']
    assert message['nested']
    assert message['unseen'] < message['unseen_named']
    assert f'{len(message["terms"])} small terms together lower the unseen error' in discovery.sentence
    assert 'small terms together' in discovery.files()['report.html']


def test_one_case_that_gains_much_proves_nothing() -> None:
    for gained in np.array([[38.65, 1.29, -1.87, 0.1, -0.18, -1.54], [3.0, 2.5, 1.0, 2.0, 4.0, 2.2]]):
        want = ttest_1samp(gained, 0.0, alternative='greater').pvalue
        assert predictive.by_chance(gained) == pytest.approx(want)
        assert (want > predictive.CHANCE) == (gained[0] > 38.0)


class Zeros(Plant):
    """Four runs, each of which was zeroed anew; what one run's zero is, no other tells."""

    channels, units = ('force',), ('N',)
    cases = ('1', '2', '3', '4')
    library = tuple(plant_effect(f'zero_{i}', EffectParameter('shift', 'N', -9.0, 9.0, 0.5, '')) for i in range(1, 5))
    shifts = (1.0, -0.7, 0.4, -1.2)

    def measured(self) -> list[FloatArray]:
        rng = np.random.default_rng(0)
        return [s + 0.05 * rng.standard_normal((1, 20)) for s in self.shifts]

    def simulate(self, model: Model) -> list[FloatArray]:
        of: Mapping[str, float] = {name: values['shift'] for name, values in model.items()}
        return [np.full((1, 20), of.get(f'zero_{c}', 0.0)) for c in self.cases]


@pytest.fixture(scope='module')
def zeros() -> PlantDiscovery:
    return psd_deflection.discover_in(Zeros())


def test_the_zero_of_a_run_left_out_is_not_known(zeros: PlantDiscovery) -> None:
    assert sorted(e.name for e in zeros.effects) == ['zero_1', 'zero_2', 'zero_3', 'zero_4']
    assert zeros.gap_after < 0.06
    assert zeros.gap_heldout_after == pytest.approx(zeros.gap_before, rel=0.01)


def all_subsets(f: FloatArray, g: FloatArray, energy: float, size: float) -> tuple[FloatArray, FloatArray]:
    """Mean sizes of the terms, and how likely each takes part, over all subsets and precisions of the sizes."""
    count = len(g)
    rows = []
    for inside in itertools.product((False, True), repeat=count):
        n, at = sum(inside), np.flatnonzero(inside)
        for slab in subsets.SLABS:
            room = f[np.ix_(at, at)] + slab * np.eye(n)
            mean = np.linalg.solve(room, g[at])
            log = 0.5 * (n * np.log(slab) - np.linalg.slogdet(room)[1]) - np.log(math.comb(count, n))
            rows.append((log - 0.5 * size * np.log(energy - mean @ g[at]), at, mean))
    most = max(log for log, _, _ in rows)
    sizes, weights, total = np.zeros(count), np.zeros(count), 0.0
    for log, at, mean in rows:
        p = np.exp(log - most)
        sizes[at] += p * mean
        weights[at] += p
        total += p
    return sizes / total, weights / total


@pytest.mark.parametrize(('slabs', 'atol'), [(subsets.SLABS, 0.06), (np.array([1.0]), 0.02)])
def test_averages_are_those_over_all_subsets(slabs: FloatArray, atol: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subsets, 'WALK', (1000, 8, 1000))
    monkeypatch.setattr(subsets, 'SLABS', slabs)
    rng = np.random.default_rng(3)
    x = rng.standard_normal((80, 4))
    x[:, 1] += 0.8 * x[:, 0]
    y = 0.4 * x[:, 0] + 0.25 * x[:, 2] + 0.9 * rng.standard_normal(80)
    given = (x.T @ x, x.T @ y, float(y @ y), 80.0)
    sizes, weights = subsets.averaged(*given, rng)
    want, likely = all_subsets(*given)
    np.testing.assert_allclose(weights, likely, atol=atol)
    np.testing.assert_allclose(sizes, want, atol=0.3 * atol)
    # What is explained already, and nothing to explain.
    f = np.diag([80.0, 80.0 * 1e-7])
    sizes, weights = subsets.averaged(f, np.array([40.0, 1e-9]), 80.0, 80.0, rng)
    assert sizes == pytest.approx([40.0 / 81.0, 0.0], rel=0.05, abs=1e-6)
    for nothing in (subsets.averaged(1e-7 * f, f[0], 80.0, 80.0, rng), subsets.averaged(f, f[0], 0.0, 80.0, rng)):
        np.testing.assert_array_equal(nothing, np.zeros((2, 2)))


class Bounded(LinearPlant):
    """No effect is simulated with a number that it may not have."""

    def simulate(self, effects: Sequence[ActiveEffect]) -> list[FloatArray]:
        for a in effects:
            assert all(p.minimum <= a.values[p.name] <= p.maximum for p in a.effect.parameters)
        return super().simulate(effects)


# Of 0.44 and 0.4 the error falls by 8 % and by 4.5 %.
@pytest.mark.parametrize(
    ('size', 'remains', 'open_level'),
    [(0.5, True, False), (0.44, True, False), (0.4, False, False), (0.0, False, False), (0.0, False, True)],
)
def test_terms_are_least_squares_and_judged_unseen(size: float, remains: bool, open_level: bool) -> None:
    """Small terms beside a named effect ten times the noise, of which one number is no amplitude."""
    names = ('a', 'x'), ('a', 'shape'), ('b', 'x'), ('b', 'y'), ('c', 'x'), ('d', 'x')
    truth = (10.0 * SIGMA, 0.9, size * SIGMA, -0.8 * size * SIGMA, 0.6 * size * SIGMA, 0.06 * SIGMA)
    shown = pictures(*names)
    plant = Bounded(shown, sum((v * shown[n] for n, v in zip(names, truth, strict=True)), noise()))
    plant.open_level = open_level
    a = active('a', x=0.5, shape=0.1)
    x, shape = a.effect.parameters
    both = (x, dataclasses.replace(shape, kind='shape'))
    fit = refit(plant, [ActiveEffect(dataclasses.replace(a.effect, parameters=both), a.values)])
    rows = [
        (candidate('b', 'x', 'y'), [[1e-3 * shown['b', 'x']], [1e-3 * shown['b', 'y']]]),
        (candidate('c', 'x', least=0.0), [[1e-3 * shown['c', 'x']]]),
        (candidate('d', 'x'), [[1e-3 * shown['d', 'x']]]),
    ]
    got = predictive.predictive_of(plant, fit, Screen(plant, rows), np.random.default_rng(0))
    assert got is not None
    table, y = columns(shown, *names) * SIGMA, plant.measured[0].ravel()
    fold = np.tile(plant.case[0] % 4, 6)

    def unseen(columns: FloatArray) -> float:
        rest = np.empty_like(y)
        for k in range(4):
            sizes = np.linalg.lstsq(columns[fold != k], y[fold != k], rcond=None)[0]
            rest[fold == k] = y[fold == k] - columns[fold == k] @ sizes
        return plant.gap([rest.reshape(6, FINE)])

    assert got.unseen_named == pytest.approx(unseen(table[:, :2]), rel=1e-6)
    assert got.unexplained is remains
    assert (got.tree() is None) is not remains
    if remains:
        assert got.unseen == pytest.approx(unseen(table[:, :5]), rel=0.08)
        *clear, weak = got.terms
        assert [t.name for t in got.terms] == ['b x', 'b y', 'c', 'd']
        want = np.linalg.lstsq(table, y, rcond=None)[0]
        assert [t.value for t in clear] == pytest.approx(want[2:5].tolist(), rel=0.05)
        assert [t.weight for t in clear] == pytest.approx([1.0] * 3, abs=0.05)
        # What may be there by chance takes part by how likely it is.
        assert weak.value / want[5] == pytest.approx(weak.weight, abs=0.1)
        assert 0.01 < weak.weight < 0.9
        values = [v for a in got.effects for v in a.values.values()]
        assert values[:5] == pytest.approx(want[:5].tolist(), rel=0.05)


def test_a_size_at_its_bound_leaves_the_others_to_fit_beside_it() -> None:
    """A term that would be less than it may be, beside one alike: least squares within the bounds, not cut off."""
    names = ('a', 'x'), ('b', 'x'), ('c', 'x')
    shown = pictures(*names)
    shown['c', 'x'] = 0.8 * shown['b', 'x'] + 0.6 * shown['c', 'x']
    truth = (10.0 * SIGMA, 2.0 * SIGMA, -1.5 * SIGMA)
    plant = Bounded(shown, sum((v * shown[n] for n, v in zip(names, truth, strict=True)), noise()))
    rows = [
        (candidate('b', 'x'), [[1e-3 * shown['b', 'x']]]),
        (candidate('c', 'x', least=0.0), [[1e-3 * shown['c', 'x']]]),
    ]
    got = predictive.predictive_of(
        plant, refit(plant, [active('a', x=0.5)]), Screen(plant, rows), np.random.default_rng(0)
    )
    assert got is not None
    table, y = columns(shown, *names) * SIGMA, plant.measured[0].ravel()
    want = lsq_linear(table, y, ([-np.inf, -np.inf, 0.0], np.inf)).x
    (b,) = got.terms  # Not c.
    assert [b.value / want[1], b.weight] == pytest.approx([1.0, 1.0], abs=0.05)
    assert np.linalg.lstsq(table, y, rcond=None)[0][1] > 1.5 * want[1]
