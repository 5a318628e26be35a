# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What predicts beside what is named: many small terms against a selection by BIC; honest unseen errors."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

import psd_deflection
from psd_deflection.model.simulation.declaration import EffectParameter
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.studies.discover.plant_search import PlantDiscovery
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

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
    found = psd_deflection.discover_in(observed)

    def wrong(model: Model) -> float:
        return float(np.sqrt(np.mean((new.simulate(model)[0] - new.truth) ** 2)))

    assert np.hypot(1.0, wrong(found.predictive)) <= 1.1 * np.hypot(1.0, wrong(forward_backward(observed)))
    assert wrong(found.predictive) < wrong({e.name: e.values for e in found.effects})
    np.testing.assert_array_equal(found.predict(new)[0], new.simulate(found.predictive)[0])


def test_what_small_terms_do_together_is_reported_everywhere() -> None:
    rng = np.random.default_rng(5)
    found = psd_deflection.discover_in(Small(0.22 * rng.standard_normal(TERMS), 60, 5))
    tree = json.loads(found.json())
    assert (found.verdict, tree['remains']) == ('unknown_effect', True)
    message = tree['predictive']
    assert message['nested']
    assert message['unseen'] < message['unseen_named']
    assert f'{len(message["terms"])} small terms together lower the unseen error' in found.sentence
    assert 'small terms together' in found.files()['report.html']


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(2))
def test_nothing_is_reported_to_remain_where_nothing_does(seed: int) -> None:
    found = psd_deflection.discover_in(Small(np.zeros(TERMS), 40, seed))
    tree = json.loads(found.json())
    assert (found.verdict, tree['remains'], tree['predictive']) == ('nothing_missing', False, None)


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
