# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The search on a machine of one's own: a spring that is not straight."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.declaration import Effect, EffectParameter
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

pytestmark = pytest.mark.slow

STIFFNESS = plant_effect('stiffness', EffectParameter('scale', '', -0.9, 9.0, 0.1, 'of k'))
CUBIC = plant_effect('cubic', EffectParameter('c', 'N/mm^3', -9.0, 9.0, 0.1, 'of u^3'), equation='F += c u^3')
SQUARE = plant_effect('square', EffectParameter('c', 'N/mm^2', -9.0, 9.0, 0.1, 'of u^2'))
LIMIT = plant_effect(
    'limit', EffectParameter('force', 'N', 0.1, 99.0, 0.5, 'greatest', nominal=99.0, grid=(0.5, 1.0)), finite=True
)
NOISE = 0.01


class Spring(Plant):
    """F = k u + c u^3, of which the model has no c, and a temperature that rises with F; six pulls."""

    channels: tuple[str, ...] = ('force',)
    units: tuple[str, ...] = ('N',)
    cases = tuple('abcdef')
    library: tuple[Effect, ...] = (STIFFNESS, CUBIC, SQUARE, LIMIT)

    def __init__(self, c: float, k: float = 1.0, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.u = [np.linspace(-1, 1, 50) * (1 + 0.2 * i) for i in range(6)]
        self.observed = [(k * u + c * u**3 + NOISE * rng.standard_normal(50))[None, :] for u in self.u]

    def measured(self) -> list[FloatArray]:
        return self.observed

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        return {'u': self.u}

    def simulate(self, model: Model) -> list[FloatArray]:
        k = 1.0 + model.get('stiffness', {'scale': 0.0})['scale']
        c = model.get('cubic', {'c': 0.0})['c']
        square = model.get('square', {'c': 0.0})['c']
        limit = model.get('limit', {'force': 99.0})['force']
        return [np.clip(k * u + c * u**3 + square * u**2, -limit, limit)[None, :] for u in self.u]


def test_a_limit_that_is_not_reached_at_first_is_found() -> None:
    plant = Spring(0.0)
    plant.observed = [np.clip(rows, -1.3, 1.3) for rows in plant.observed]
    (limit,) = psd_deflection.discover_in(plant).effects
    assert limit.active.values['force'] == pytest.approx(1.3, abs=0.01)


def test_the_covariance_of_the_sizes_is_that_of_least_squares() -> None:
    plant = Spring(0.3, k=1.05)
    found = psd_deflection.discover_in(plant)
    tree = found.tree()
    names, matrix = tree['covariance']['names'], np.array(tree['covariance']['matrix'])
    terms = {'stiffness.scale': np.concatenate(plant.u), 'cubic.c': np.concatenate(plant.u) ** 3}
    assert sorted(names) == sorted(terms)
    design = np.stack([terms[name] for name in names], axis=1)
    expected = NOISE**2 * np.linalg.inv(design.T @ design)
    # The level of what remains is fitted, from few cases: the same matrix, and no smaller.
    scale = float(matrix[0, 0] / expected[0, 0])
    assert 1.0 < scale < 3.0
    np.testing.assert_allclose(matrix, scale * expected, rtol=0.02)
    reported = [e['parameters'][p]['sd'] for e in tree['effects'] for p in e['parameters']]
    assert np.sqrt(np.diag(matrix)).tolist() == pytest.approx(reported)


@pytest.mark.repeatable
def test_the_answer_is_the_same_again() -> None:
    first, second = (psd_deflection.discover_in(Spring(0.1), seed=3).tree() for _ in range(2))
    assert first == second


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'cases': ()}, 'cases: there is none'),
        ({'units': ()}, 'units: 0 of them for 1 channels'),
        ({'noise': (0.0,)}, r'noise = \(0.0,\): must be one number above 0'),
        ({'library': (CUBIC, CUBIC)}, 'cubic is there twice'),
        ({'nuisance': (CUBIC,)}, 'cubic is there twice'),
        ({'observed': [np.zeros((2, 5))] * 6}, r'measured, a: has the shape \(2, 5\): must be \(1, n\)'),
        ({'observed': [np.full((1, 5), math.nan)] * 6}, 'force has 0 values in all'),
        ({'observed': [np.zeros((1, 5))] * 6}, r'simulate, a: has the shape \(1, 50\): must be that of measured'),
        ({'u': [np.full(50, math.nan)] * 6}, 'simulate, a: not finite with'),
        ({'observed': [np.zeros((1, 50))] * 5}, 'measured: 5 tables for 6 cases'),
    ],
)
def test_a_plant_that_contradicts_itself_is_rejected(change: Mapping[str, object], words: str) -> None:
    plant = Spring(0.3)
    for name, value in change.items():
        setattr(plant, name, value)
    if change.get('cases') == ():
        plant.observed = []
    with pytest.raises(ConfigError, match=words):
        psd_deflection.discover_in(plant)


def test_what_swings_on_is_no_noise_though_none_is_stated() -> None:
    """The verdict says what the sentence says."""
    plant = Spring(0.0)
    plant.period = 0.01
    plant.library = (LIMIT,)
    plant.observed = [rows + 0.05 * np.sin(np.linspace(0.0, 9.0, 50)) for rows in plant.observed]
    found = psd_deflection.discover_in(plant)
    assert (found.verdict, found.effects) == ('unknown_effect', ())
    assert 'remain, which is no noise' in found.unknown[0].signature or 'follows' in found.unknown[0].signature
