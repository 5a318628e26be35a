# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What remains without a name as one smooth function, found by discover_in on a table of readings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

import psd_deflection
from psd_deflection.model.simulation.declaration import ActiveEffect, EffectParameter
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.studies.discover.plant_search import PlantComparison
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect
from psd_deflection.studies.discover.search import smooth as smoothing
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.smooth import Remainders, Smooth, smooth_of, unseen_residual

NOISE = 0.1
SLOPE = plant_effect('slope', EffectParameter('size', 'mm', -9.0, 9.0, 0.1, 'per turn'))


class Table(Plant):
    """Thirty readings at places ``along`` and ``across``: a slope, waves along, noise; each is left out by itself."""

    channels, units, cases = ('height',), ('mm',), ('table',)
    library = (SLOPE,)
    nuisance = (plant_effect('offset', EffectParameter('size', 'mm', -9.0, 9.0, 0.1, 'of all')),)

    def __init__(self, seed: int, waves: float, noise: float = NOISE) -> None:
        rng = np.random.default_rng(seed)
        self.along, self.across = rng.uniform(0.0, 1.0, (2, 30))
        self.error = noise * rng.standard_normal(30)
        self.observed = 2.0 * self.along + waves * np.sin(9.0 * self.along) + self.error

    def measured(self) -> list[FloatArray]:
        return [self.observed[None, :]]

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        return {'along': [self.along], 'across': [self.across]}

    def parts(self) -> list[IntArray]:
        return [np.arange(30)]

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
    found = psd_deflection.discover_in(plant)
    remainder = found.tree()['remainder']
    assert remainder['depends_on'] == ['along']
    # Little but the noise remains of readings that the function has not seen; those at the ends are the worst.
    assert remainder['heldout'] < 2.5 * NOISE < 0.5 * found.gap_heldout_after
    assert found.verdict == 'unknown_effect'
    assert 'a smooth function of along that has no name' in found.unknown[-1].signature
    assert found.remainder is not None
    assert found.remainder.function is not None
    # It is the waves, but for what offset and slope take.
    free = np.column_stack([np.ones(30), plant.along, np.sin(9.0 * plant.along)])
    residual = found.remainder.function.tables[0][0]
    assert np.std(residual - free @ np.linalg.lstsq(free, residual, rcond=None)[0]) < NOISE
    assert 'a smooth function of along' in found.report()


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(6))
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


@pytest.mark.slow
def test_the_gap_with_given_shapes_is_reported_beside_the_other() -> None:
    """It is smaller, for the shapes have seen the readings, and not below the noise."""
    found = smooth(Table(1, 1.0))
    assert found is not None
    assert 0.8 * NOISE < found.heldout_as_shaped < found.heldout


def test_few_readings_report_no_function() -> None:
    plant = Table(1, 1.0)
    plant.observed[19:] = np.nan
    assert smooth(plant) is None
    assert smooth(Table(1, 1.0), {}) is None


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
    (one, _), (other, gradient) = (
        smoothing.negative_log_likelihood(s.ravel(), parts, ('place',)) for s in (first, second)
    )
    assert other - one == pytest.approx(exact(second) - exact(first))
    steps = 1e-5 * np.eye(6).reshape(6, 2, 3)
    numeric = [(exact(second + h) - exact(second - h)) / 2e-5 for h in steps]
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-6)
