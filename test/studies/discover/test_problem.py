# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The steps of discover: given a problem, the next one has what was found, and the first stays as it was."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.problem import Problem
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.localise import NOWHERE, Cell, Localisation
from psd_deflection.studies.discover.search.screen import Screen
from psd_deflection.studies.discover.search.weighing import Unknown
from psd_deflection.studies.discover.setup.hidden import FIRST
from psd_deflection.studies.discover.steps import (
    alternatives,
    fields_of,
    predict,
    search,
    solve,
    weigh,
    where,
    without_effect,
)

from .test_rules import A, B, Lone, Plant, candidate, noise, nowhere, pictures, without_noise

STEPS = (search, weigh, alternatives, where)


class Library(Lone):
    """A lone machine whose library are the plant's pictures; mistakes are looked for only if the comparison says so."""

    def __init__(self, plant: Plant, left: Localisation = NOWHERE) -> None:
        super().__init__(plant, left)
        self.shown: Mapping[tuple[str, str], FloatArray] = plant.pictures

    def screen(self, comparison: Comparison, fit: Fit | None) -> Screen:
        names = [n for n in self.shown if n[0] not in FIRST or n[0] in comparison.first]
        return Screen(comparison, [(candidate(*n), [[1e-3 * self.shown[n]]]) for n in names])


def begun(machine: Library) -> Problem:
    return Problem.of(machine, 0, lambda _: None, np.random.default_rng(0))


def names(fit: Fit) -> list[str]:
    return sorted(a.effect.name for a in fit.effects)


def apart(shown: dict[tuple[str, str], FloatArray], first: tuple[str, str], other: tuple[str, str]) -> None:
    """Take what is in the picture of ``first`` out of that of ``other``."""
    a = shown[first] / np.linalg.norm(shown[first])
    shown[other] = shown[other] - a * np.sum(a * shown[other])


@pytest.mark.repeatable
def test_step_adds_results_and_changes_no_earlier_ones() -> None:
    shown = pictures(A, B, ('c', 'x'))
    plant = Plant(shown, without_noise((shown[A], 4000.0), (shown[B], 500.0)) + noise())
    first = begun(Library(plant))
    assert first.fit is first.null
    assert first.comparison is plant
    observed = [first]
    for step in STEPS:
        kept = {f.name: getattr(observed[-1], f.name) for f in dataclasses.fields(Problem)}
        observed.append(step(observed[-1]))
        assert all(getattr(observed[-2], name) is value for name, value in kept.items())
    assert first.comparison is plant
    _, searched, weighed, named, last = observed
    assert names(searched.fit) == names(searched.result.fit) == ['a', 'b']
    assert not searched.heldout
    assert len(weighed.heldout) == 2
    assert [n.active.effect.name for n in named.named] == [a.effect.name for a in weighed.fit.effects]
    assert (last.unknown, last.alternative_fits, last.unsettled) == ((), (), ())
    fields = fields_of(last)
    assert (fields['verdict'], fields['effects'], fields['fit']) == ('effects_found', last.named, last.fit)
    assert fields['gap_after'] < fields['gap_before']
    assert [name for name, _ in fields['waterfall']] == ['as described', '+ a', '+ b', 'noise alone']
    again = fields_of(solve(Library(Plant(shown, plant.measured[0])), STEPS, 0, lambda _: None))
    assert (again['gap_after'], again['simulations']) == (fields['gap_after'], fields['simulations'])


def test_nothing_is_missing_in_noise() -> None:
    shown = pictures(A, B)
    last = solve(Library(Plant(shown, noise())), STEPS, 0, lambda _: None)
    fields = fields_of(last)
    assert (fields['verdict'], last.named, last.fit) == ('nothing_missing', (), last.null)
    assert fields['gap_before'] == fields['gap_after'] == fields['gap_heldout_after']


@pytest.mark.parametrize(('level', 'asked'), [(1.3, False), (1.8, True)])
def test_predictions_are_asked_for_beyond_one_and_a_half_floors(level: float, asked: bool) -> None:
    words: list[str] = []
    first = Problem.of(Library(Plant(pictures(A, B), level * noise())), 0, words.append, np.random.default_rng(0))
    searched = search(first)
    assert first.comparison.gap(searched.fit.difference) == pytest.approx(level * first.comparison.floor(), rel=0.1)
    after = predict(searched)
    assert ('predicting' in words) is (after.predictive is not None) is asked
    # What is unknown is asked for, however little.
    unknown = dataclasses.replace(searched, unknown=(Unknown('x', (), 0.1),))
    assert predict(unknown).predictive is not None


def test_unexplained_remainder_drops_weak_effects() -> None:
    shown = pictures(A)
    plant = Plant(shown, without_noise((shown[A], 200.0)) + noise())
    # Faster than blocks, so that no gap has it.
    fast = Cell('x1', 0, (0.0, 1.0), (25.0, 60.0), (), 9.0, 0.0, 900.0)
    left = nowhere(p=0.0, excess=900.0, cells=(fast,))
    last = solve(Library(plant, left), STEPS, 0, lambda _: None)
    assert (fields_of(last)['verdict'], names(last.fit), last.residual) == ('unknown_effect', [], left)
    assert last.search.trace[-1].endswith('explains less than what remains unknown')
    strong = Plant(shown, without_noise((shown[A], 2000.0)) + noise())
    kept = solve(Library(strong, left), STEPS, 0, lambda _: None)
    assert (fields_of(kept)['verdict'], names(kept.fit)) == ('unknown_effect', ['a'])


@pytest.mark.parametrize(('of_effect', 'found'), [(0.0, ['link_length']), (0.3, ['b', 'c'])])
def test_mistake_with_effect_must_beat_effects_alone(of_effect: float, found: Sequence[str]) -> None:
    """Length and one effect explain as much as two effects do: then it is the effects."""
    length, b, c = ('link_length', 'x'), ('b', 'x'), ('c', 'x')
    shown = pictures(length, b, c)
    apart(shown, b, c)
    total = 1e5
    if of_effect:
        # What is there is b and c; the length shows as b does but for a little.
        shown[length] = shown[b] + 1e-3 * shown[length]
        plant = Plant(shown, without_noise((shown[b], total), (shown[c], 500.0)) + noise())
    else:
        plant = Plant(shown, without_noise((shown[length], total)) + noise())
    after = search(begun(Library(plant)))
    assert names(after.fit) == found
    assert after.comparison.first == (frozenset() if of_effect else FIRST)
    assert plant.first == FIRST


def test_others_are_refitted_without_removed_effect() -> None:
    shown = pictures(A, B)
    plant = Plant(shown, without_noise((shown[A], 4000.0), (shown[B], 500.0)) + noise())
    both = weigh(search(begun(Library(plant))))
    at = [a.effect.name for a in both.fit.effects].index('a')
    one = without_effect(both, at, 'is not wanted')
    assert names(one.fit) == ['b']
    assert one.heldout == (both.heldout[1 - at],)
    assert len(one.result.delta_chi2) == 1
    assert one.result.fit is both.fit
    assert one.search.trace[-1] == 'a is not wanted'
    none = without_effect(one, 0, 'neither')
    assert none.fit is one.result.null


def test_gap_before_is_that_of_original_recording() -> None:
    shown = pictures(A)
    last = solve(Library(Plant(shown, noise())), STEPS, 0, lambda _: None)
    assert dataclasses.replace(last, stated_gap=7.0).gap_before == 7.0
    assert last.gap_before == last.bare.gap(last.null.difference)
