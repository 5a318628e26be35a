# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Each function against sums, loops and limits written here; guards and constants from one side and the other."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.signal import lfilter
from scipy.sparse import csc_array

from psd_deflection.model.simulation.catalogue import make_active
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import replace_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.wirings import WIRINGS, differences
from psd_deflection.studies.discover import cleaning, conclusion, law_features, laws, plants, setup, steps
from psd_deflection.studies.discover.hidden import FIRST, LoadDirection, ZeroDirection
from psd_deflection.studies.discover.noise import SlowNoise, estimate_noise
from psd_deflection.studies.discover.problem import Problem
from psd_deflection.studies.discover.search import fit as validate
from psd_deflection.studies.discover.search import localise, proposals, weighing
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, HeldOut, refit
from psd_deflection.studies.discover.search.localise import NOWHERE, Cell, Localisation
from psd_deflection.studies.discover.search.screen import Candidate, Screen
from psd_deflection.studies.discover.search.search import SearchResult
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.loads.plate_motion import fine_means

from .test_formulas import RIG, make_observation
from .test_rules import FINE, A, B, Lone, Plant, active, candidate, noise, nowhere, pictures, without_noise

DOTS = [0, 1, 3, 4]


@pytest.mark.parametrize('there', [7, 8])
def test_of_eight_samples_one_may_be_an_outlier(there: int) -> None:
    x = np.full((40, 1), np.nan)
    x[:there] = 0.0
    x[3] = 5.0
    assert cleaning.outliers(x, 1e-3).any() == (there == 8)
    assert not cleaning.outliers(x, 1e-3)[there:].any()


def test_what_is_stuck_is_reported_with_its_place_and_share() -> None:
    o = make_observation(warm=None)
    volts = o.volts.copy()
    volts[400:440, 4] = volts[400, 4]
    volts[500:560, 4] = volts[500, 4]
    cleaned, (finding,) = cleaning.clean(dataclasses.replace(o, volts=volts), ())
    assert (finding.name, finding.where) == ('stuck_channel', 'y2')
    assert (finding.value, finding.evidence) == pytest.approx((0.4, 100 / 1200))
    assert finding.fix.startswith('y2 of seen keeps one value from 0.400 s on, 0.100 s in all')
    gone = np.isnan(cleaned.volts[:, 4])
    assert gone[400:440].all()
    assert gone[500:560].all()
    assert gone.sum() <= 102
    # Coarse steps keep their value for long.
    step = 64 * RIG.converter.volts_per_count
    coarse = dataclasses.replace(o, volts=np.rint(o.volts / step) * step)
    assert cleaning.clean(coarse, ())[1] == []


@pytest.fixture(scope='module')
def gappy() -> Workspace:
    """Two recordings of different lengths and sample rates, with lost samples, on temperature and not."""
    slow = replace_values(RIG, {'converter.sample_rate_hz': 500.0})
    first = make_observation(1, warm=None)
    volts = first.volts.copy()
    volts[np.random.default_rng(4).random(1200) < 0.3] = np.nan
    volts[400:440] = np.nan
    second = make_observation(2, name='second')
    return Workspace(
        [
            dataclasses.replace(first, volts=volts),
            dataclasses.replace(second, rig=slow, volts=second.volts[:801], loads=second.loads[:801], temperature=None),
        ]
    )


@pytest.mark.parametrize(
    ('rate', 'size'), [(100.0, 1), (250.0, 1), (1000.0, 4), (1500.0, 5), (1600.0, 5), (5000.0, 20)]
)
def test_a_fine_block_divides_a_block(rate: float, size: int) -> None:
    rig = replace_values(RIG, {'converter.sample_rate_hz': rate})
    assert Workspace([Observation('x', rig, np.zeros((100, 6)), np.zeros((100, 3)))]).fine == [size]


def test_noise_has_a_floor_of_its_file() -> None:
    """A twentieth of the file's; a quarter where coarse steps hide it."""
    loud = replace_values(RIG, {'amplifier.noise': 0.1})
    ws = Workspace([dataclasses.replace(make_observation(warm=None), rig=loud)])
    np.testing.assert_allclose(ws.noise[0].sigma, 0.05 * loud.noises.ravel())
    coarse = ws.renoised([make_active('quantisation', {'step': 0.01}, 't')])
    np.testing.assert_allclose(coarse.noise[0].sigma, 0.25 * loud.noises.ravel())
    assert ws.renoised([make_active('creep', {'amplitude': 0.01}, 't')]) is ws


def test_slow_change_is_unwhitened_as_a_constant() -> None:
    ws = Workspace([make_observation(warm=None)])
    ar = np.array([[0.5, -0.2], [0.3, 0.0], [0.97, 0.0], [0.0, 0.0], [-0.6, 0.1], [0.2, 0.2]])
    ws = ws.replaced(noise=(dataclasses.replace(ws.noise[0], ar=ar),))
    constant = np.ones((6, 300)) * np.arange(1.0, 7.0)[:, None]
    (back,) = ws.unwhitened(ws.whiten([constant]))
    # But for the first blocks, which have no past; a memory of more than 0.95 is taken as 0.95.
    want = constant * np.where(np.arange(6) == 2, 0.03 / 0.05, 1.0)[:, None]
    np.testing.assert_allclose(back[:, 2:], want[:, 2:], rtol=1e-9)


def test_what_is_shown_of_a_workspace_is_in_micrometres(gappy: Workspace) -> None:
    dots = gappy.block_dots(gappy.measured)
    assert [d.shape for d in dots] == [(4, 60), (4, 40)]
    for (row, shown), o in zip(
        zip(dots, gappy.displayed(gappy.measured), strict=True), gappy.observations, strict=True
    ):
        np.testing.assert_array_equal(shown, 1e6 * row)
        n = row.shape[1]
        blocks = o.volts[: 20 * n, DOTS].reshape(n, 20, 4)
        count = np.isfinite(blocks).sum(axis=1)
        mean = np.nansum(blocks, axis=1) / np.maximum(count, 1)
        want = np.where(count >= 10, mean * RIG.sensitivities.ravel(), np.nan).T
        np.testing.assert_allclose(row, want, rtol=1e-9)
    # Two blocks of the first have none of their samples.
    assert np.isnan(dots[0]).all(axis=0).sum() == 2
    assert (gappy.unit, gappy.display_scale, gappy.display_units) == ('m', (1e6, 'µm'), ('µm',) * 4)
    assert gappy.worded(1.2345e-6) == '1.23 µm'
    beside = gappy.against()
    assert list(beside) == [
        *('load_fx / N', 'load_fy / N', 'load_tz / N m'),
        *('x1 / mm', 'y1 / mm', 'x2 / mm', 'y2 / mm'),
    ]
    axis, (first, second) = gappy.along()
    assert str(axis) == 'time / s (recordings one after another)'
    np.testing.assert_allclose(first, 0.01 + 0.02 * np.arange(60))
    # The second begins where the first ended, and has 500 samples a second.
    np.testing.assert_allclose(second, 1.2 + 0.02 + 0.04 * np.arange(40))
    np.testing.assert_allclose(beside['load_fy / N'][0], gappy.observations[0].loads[:, 1].reshape(60, 20).mean(axis=1))
    np.testing.assert_array_equal(beside['y2 / mm'][1], 1e3 * dots[1][3])
    (entry, two) = gappy.provenance()
    assert (entry['name'], entry['seconds'], two['seconds']) == ('seen', pytest.approx(1.2), pytest.approx(1.602))
    assert entry['rest_seconds'] == gappy.noise[0].rest_seconds
    lost = dataclasses.replace(gappy.observations[0], volts=np.full((1200, 6), np.nan))
    assert Workspace([lost]).gap(Workspace([lost]).measured) == 0.0


def test_pieces_of_a_recording_are_half_seconds(gappy: Workspace) -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.standard_normal(sum(m.size for m in gappy.measured)) for _ in range(2))
    want: list[float] = []
    for x, y in zip(gappy.split(a), gappy.split(b), strict=True):
        gain = 0.5 * (x**2 - y**2).sum(axis=0)
        want += [float(gain[k : k + 125].sum()) for k in range(0, len(gain), 125)]
    np.testing.assert_allclose(gappy.pieces(a, b), want)
    assert len(want) == 3 + 4


def test_free_loads_are_those_of_bayesian_least_squares() -> None:
    """Two loads that overlap, 2 mN and 5 mN uncertain: noise of covariance I + A S^2 A', sizes by their priors."""
    o = make_observation()
    ws = Workspace([o])
    changes, sd = np.zeros((2, len(o.loads), 3)), np.array([2e-3, 5e-3])
    changes[0, 300:700, 1] = changes[1, 500:, 0] = 1.0
    changes[1, 500:, 1] = 0.7
    free = tuple(LoadDirection(0, csc_array(changes[k]), float(sd[k]), 'hung', k) for k in range(2))
    wider = ws.with_free(free)

    def shown(loads: FloatArray) -> list[FloatArray]:
        return [fine_means(ForwardModel(o.rig).expect(loads, o.temperature).volts, 4)]

    (still,) = shown(o.loads)
    a = np.stack([ws.whiten([moved - still for moved in shown(o.loads + c)]) for c in changes], axis=1)
    inverse, rng = np.linalg.inv(a.T @ a + np.diag(1.0 / sd**2)), np.random.default_rng(0)
    p, q = (o.rig.noises.ravel()[:, None] * rng.standard_normal(still.shape) for _ in range(2))
    r, s = ws.whiten([p]), ws.whiten([q])
    assert wider.whiten([p]) @ wider.whiten([q]) == pytest.approx(r @ s - (a.T @ r) @ inverse @ (a.T @ s), rel=1e-6)
    sds = np.sqrt(np.diag(inverse))
    assert wider.direction_sd() == pytest.approx({(id(free[0].of), k): v for k, v in enumerate(sds.tolist())}, rel=1e-6)
    # Beside what another 3 N and 1 N leave, and only then is it worth a simulation more.
    off = [p + moved - still for moved in shown(o.loads + 3.0 * changes[0] - changes[1])]
    sizes = inverse @ a.T @ ws.whiten(off)
    loads = o.loads + np.tensordot(sizes, changes, 1)
    for again in (wider.refitted(off), wider.refitted_beside(off, ())):
        np.testing.assert_allclose(again.observations[0].loads, loads, atol=1e-6)
        assert len(again.directions) == 2
    assert wider.refitted_beside([np.zeros_like(p)], ()) is wider
    assert (ws.direction_sd(), ws.refitted(off), ws.refitted_beside(off, ())) == ({}, ws, ws)
    assert ws.with_free((ZeroDirection(0, 1, 1e-6),)).refitted_beside(off, ()).observations[0] is o
    # Five, of which two make the others: of least norm.
    sums = np.array([[1.0, 0.0], [0.7, 0.0], [0.0, 1.0], [1.0, 1.0], [-0.7, 1.0]])
    five = [LoadDirection(0, csc_array(np.tensordot(s, changes, 1)), 1e4, 'hung', k) for k, s in enumerate(sums)]
    got, sds = ws.with_free(five).direction_sd(), np.linalg.norm(np.linalg.pinv(a @ sums.T, rcond=1e-9), axis=1)
    assert list(got.values()) == pytest.approx(sds.tolist(), rel=1e-6)


def resting(n: int, level: float, memory: float = 0.0, seed: int = 0) -> FloatArray:
    e = level * np.random.default_rng(seed).standard_normal((n, 6))
    return np.asarray(lfilter([1.0], [1.0, -memory], e, axis=0))


@pytest.mark.parametrize(('n', 'known'), [(400, False), (420, True)])
def test_a_memory_is_observed_in_more_than_400_samples_at_rest(n: int, known: bool) -> None:
    o = Observation('x', RIG, np.zeros((n, 6)), np.zeros((n, 3)))
    model = estimate_noise(o, resting(n, 1e-3, 0.8), 4, np.full(6, 1e-6))
    assert all(model.coloured) == any(model.coloured) == known


@pytest.mark.parametrize(
    ('errors', 'coloured'), [((4.6, 3, 0, 0, 0, 0), 0), ((5.4, 3, 0, 0, 0, 0), 1), ((5.4, 5.4, 5.4, 5.4, 3.4, 2.6), 5)]
)
def test_a_weak_memory_counts_beside_clear_ones(errors: tuple[float, ...], coloured: int) -> None:
    """A correlation of neighbours of five of its standard errors; of three, if most channels have that."""
    n, rows = 4000, np.random.default_rng(1).standard_normal((4000, 6))
    for c, wanted in enumerate(errors):
        white = rows[:, c].copy()

        def mixed(share: float, x: FloatArray = white) -> FloatArray:
            return x + share * np.roll(x, 1)

        def excess(share: float, wanted: float = wanted) -> float:
            x = mixed(share)
            return float(x[1:] @ x[:-1] / (x @ x) * math.sqrt(n)) - wanted

        rows[:, c] = mixed(brentq(excess, -0.5, 0.5))
    o = Observation('x', RIG, np.zeros((n, 6)), np.zeros((n, 3)))
    model = estimate_noise(o, 1e-3 * rows, 4, np.full(6, 1e-6))
    assert model.coloured == (True,) * coloured + (False,) * (6 - coloured)


def test_a_memory_of_noise_is_that_of_its_process() -> None:
    """x = 0.7 x- + e: the deviation of means over 4 and over 20 samples, and how well one block tells the next."""
    n, memory = 15_000, 0.7
    o = Observation('x', RIG, np.zeros((n, 6)), np.zeros((n, 3)))
    rows = resting(n, 1e-3, memory, 3)
    model = estimate_noise(o, rows, 4, np.full(6, 1e-6))
    assert model.coloured == (True,) * 6
    sigma = 1e-3 / math.sqrt(1.0 - memory**2)

    def covariance(size: int, apart: int) -> float:
        i = np.arange(size)
        return float(np.mean(sigma**2 * memory ** np.abs(i[:, None] - i[None, :] - size * apart)))

    assert model.sigma == pytest.approx(np.full(6, sigma), rel=0.05)
    assert model.block_sigma == pytest.approx(np.full(6, math.sqrt(covariance(20, 0))), rel=0.05)
    c = [covariance(4, k) for k in range(3)]
    phi = np.linalg.solve([[c[0], c[1]], [c[1], c[0]]], c[1:])
    np.testing.assert_allclose(model.ar, np.tile(phi, (6, 1)), atol=0.05)
    assert model.innovation == pytest.approx(np.full(6, math.sqrt(c[0] - phi @ c[1:])), rel=0.05)
    drawn = model.draw(n, 1e-3, np.random.default_rng(0))
    again = estimate_noise(o, drawn, 4, np.full(6, 1e-6))
    assert again.sigma == pytest.approx(model.sigma, rel=0.05)
    np.testing.assert_allclose(again.innovation, model.innovation, rtol=0.05)
    slow = dataclasses.replace(model, slow=SlowNoise.of(np.full(6, 3.0), 10, 4e-3))
    white = SlowNoise.of(slow.corners, n, 1e-3).whiten(slow.draw(n, 1e-3, np.random.default_rng(0)).T)
    np.testing.assert_allclose(white.T, drawn, atol=1e-12)
    # A level below the floor has no memory.
    assert estimate_noise(o, rows, 4, np.full(6, 2.0 * sigma)).coloured == (False,) * 6


def test_a_line_persists_though_most_of_a_quarter_was_left_out() -> None:
    """As the time in which a weight swayed: what is not there is 0."""
    hum = np.sin(2 * np.pi * 50.0 * 1e-3 * np.arange(4000.0))[:, None]
    for first, there in ((1150, True), (1000, True), (0, False)):
        rows = hum.copy()
        # A quarter without samples tells nothing, two of them are too many.
        rows[first:2000] = 0.0
        assert (proposals.persistent([50.0], [rows], [np.ones(1)], [1e-3]) == [50.0]) is there
    # A line that begins later is none, though the samples of before are there.
    rows = hum.copy()
    rows[:1000] = 0.01
    assert proposals.persistent([50.0], [rows], [np.ones(1)], [1e-3]) == []


def test_wild_values_count_as_five_deviations() -> None:
    """Their energy is that of a flat spectrum, 25, of which each band has its part."""
    residual = np.zeros((6, FINE))
    residual[0, 10] = 60.0
    located = localise.localise(Plant({}, noise()), residual.ravel(), None, np.random.default_rng(0), limit=999)
    cells = [cell for cell in located.cells if (cell.channel, cell.when[0]) == ('x1', 0.0)]
    assert len(cells) == 6
    for cell in cells:
        low, high = cell.band
        f = np.abs(np.fft.fftfreq(50, 0.004))
        dof = int(((f >= low) & (f < (high if high < 125.0 else math.inf))).sum())
        deviation = 2.0 / (9.0 * dof)
        assert cell.statistic == pytest.approx(((25.0 / 50.0) ** (1 / 3) - 1.0 + deviation) / math.sqrt(deviation))
        assert cell.energy == pytest.approx(3600.0 * dof / 50.0 - dof)


STEPS = (steps.search, steps.weigh, steps.alternatives, steps.where)


class Library(Lone):
    """A lone machine whose library are the plant's pictures; mistakes are looked for only if the comparison says so."""

    def __init__(self, plant: Plant, residual: Localisation = NOWHERE) -> None:
        super().__init__(plant, residual)
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
        earlier = {f.name: getattr(observed[-1], f.name) for f in dataclasses.fields(Problem)}
        observed.append(step(observed[-1]))
        assert all(getattr(observed[-2], name) is value for name, value in earlier.items())
    assert first.comparison is plant
    _, searched, weighed, named, last = observed
    assert names(searched.fit) == names(searched.result.fit) == ['a', 'b']
    assert not searched.heldout
    assert len(weighed.heldout) == 2
    assert [n.active.effect.name for n in named.named] == [a.effect.name for a in weighed.fit.effects]
    assert (last.unknown, last.alternative_fits, last.unsettled) == ((), (), ())
    fields = steps.fields_of(last)
    assert (fields['verdict'], fields['effects'], fields['fit']) == ('effects_found', last.named, last.fit)
    assert fields['gap_after'] < fields['gap_before']
    assert [name for name, _ in fields['waterfall']] == ['as described', '+ a', '+ b', 'noise alone']
    again = steps.fields_of(steps.solve(Library(Plant(shown, plant.measured[0])), STEPS, 0, lambda _: None))
    assert (again['gap_after'], again['simulations']) == (fields['gap_after'], fields['simulations'])


def test_nothing_is_missing_in_noise() -> None:
    shown = pictures(A, B)
    last = steps.solve(Library(Plant(shown, noise())), STEPS, 0, lambda _: None)
    fields = steps.fields_of(last)
    assert (fields['verdict'], last.named, last.fit) == ('nothing_missing', (), last.null)
    assert fields['gap_before'] == fields['gap_after'] == fields['gap_heldout_after']


@pytest.mark.parametrize(('level', 'asked'), [(1.3, False), (1.8, True)])
def test_predictions_are_asked_for_beyond_one_and_a_half_floors(level: float, asked: bool) -> None:
    words: list[str] = []
    first = Problem.of(Library(Plant(pictures(A, B), level * noise())), 0, words.append, np.random.default_rng(0))
    searched = steps.search(first)
    assert first.comparison.gap(searched.fit.difference) == pytest.approx(level * first.comparison.floor(), rel=0.1)
    after = steps.predict(searched)
    assert ('predicting' in words) is (after.predictive is not None) is asked
    # What is unknown is asked for, however little.
    unknown = dataclasses.replace(searched, unknown=(weighing.Unknown('x', (), 0.1),))
    assert steps.predict(unknown).predictive is not None


def test_unexplained_remainder_drops_weak_effects() -> None:
    shown = pictures(A)
    plant = Plant(shown, without_noise((shown[A], 200.0)) + noise())
    # Faster than blocks, so that no gap has it.
    residual = nowhere(p=0.0, excess=900.0, cells=(Cell('x1', 0, (0.0, 1.0), (25.0, 60.0), (), 9.0, 0.0, 900.0),))
    last = steps.solve(Library(plant, residual), STEPS, 0, lambda _: None)
    assert (steps.fields_of(last)['verdict'], names(last.fit), last.residual) == ('unknown_effect', [], residual)
    assert last.search.trace[-1].endswith('explains less than what remains unknown')
    strong = Plant(shown, without_noise((shown[A], 2000.0)) + noise())
    strong_last = steps.solve(Library(strong, residual), STEPS, 0, lambda _: None)
    assert (steps.fields_of(strong_last)['verdict'], names(strong_last.fit)) == ('unknown_effect', ['a'])


@pytest.mark.parametrize(('of_effect', 'expected'), [(0.0, ['link_length']), (0.3, ['b', 'c'])])
def test_mistake_with_effect_must_beat_effects_alone(of_effect: float, expected: Sequence[str]) -> None:
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
    after = steps.search(begun(Library(plant)))
    assert (names(after.fit), after.comparison.first) == (expected, frozenset() if of_effect else FIRST)
    assert plant.first == FIRST


def test_others_are_refitted_without_removed_effect() -> None:
    shown = pictures(A, B)
    plant = Plant(shown, without_noise((shown[A], 4000.0), (shown[B], 500.0)) + noise())
    both = steps.weigh(steps.search(begun(Library(plant))))
    at = [a.effect.name for a in both.fit.effects].index('a')
    reduced = steps.without_effect(both, at, 'is not wanted')
    assert (names(reduced.fit), reduced.heldout) == (['b'], (both.heldout[1 - at],))
    assert len(reduced.result.delta_chi2) == 1
    assert reduced.result.fit is both.fit
    assert reduced.search.trace[-1] == 'a is not wanted'
    assert steps.without_effect(reduced, 0, 'neither').fit is reduced.result.null


def test_gap_before_is_that_of_original_recording() -> None:
    shown = pictures(A)
    last = steps.solve(Library(Plant(shown, noise())), STEPS, 0, lambda _: None)
    assert dataclasses.replace(last, stated_gap=7.0).gap_before == 7.0
    assert last.gap_before == last.bare.gap(last.null.difference)


def test_a_load_with_the_other_sign_has_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """It pulled the other way, half as much as annotated: that is no unit, but the sign is wrong."""
    o = make_observation(warm=None)
    observed = dataclasses.replace(o, loads=o.loads * [1.0, -2.0, 1.0])
    corrected, findings, lines = setup.correct_wiring([observed], ())
    assert [(f.name, f.where) for f in findings] == [('load_sign', 'fy')]
    np.testing.assert_allclose(corrected[0].loads, o.loads * [1.0, 2.0, 1.0])
    assert lines == {}


@pytest.mark.parametrize(('main', 'coupled'), [(1e-6, 0.0), (1.01e-6, 0.5), (-1e-6, 0.0), (-1.01e-6, -0.5)])
def test_what_is_coupled_to_nothing_is_none(main: float, coupled: float) -> None:
    size = EffectParameter('size', 'V', -1.0, 1.0, 1.0, '')
    with_it = EffectParameter('with_it', '', -9.0, 9.0, 1.0, '', kind='coupled')
    effect = Effect('made_up', 'psd', '', '', '', '', (size, with_it), 'dots', apply=lambda *_: None)
    off = {'size': 0.0, 'with_it': 0.0}
    active = Candidate(effect, off, ('size', 'with_it'), off).from_coefficients(np.array([main, 0.5 * 1.01e-6]))
    assert active.values['with_it'] == pytest.approx(coupled)


def test_noise_of_a_sum_is_no_gap() -> None:
    """What grows with a load in the light of a PSD: the gap of the dots is as it was."""
    rng, o = np.random.default_rng(5), make_observation(6)
    volts = o.volts.copy()
    volts[:, 5] += 4e-3 * (o.loads[:, 1] / np.abs(o.loads[:, 1]).max()) * rng.standard_normal(len(volts))
    workspace = Workspace([dataclasses.replace(o, volts=volts)])
    fit = refit(workspace, ())
    jitter = laws.find_jitter(workspace, fit, 3.0)
    assert jitter is not None
    assert (jitter.channels, jitter.heldout_gap) == (('sum2',), validate.heldout_gap(workspace, fit))
    (term,) = jitter.law.terms
    squares = workspace.split(fit.residual)[0][5] ** 2
    known = law_features.known_fine(workspace, (), term.of[0])[0]
    _, b = law_features.variance(squares, known**2 / (known**2).max())
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


def test_other_wirings_that_are_as_good_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    o = make_observation(warm=None)
    file = Wiring.from_rig(o.rig)
    good = [w for w in WIRINGS if len(differences(w, file)) == 1][:4]
    monkeypatch.setattr(setup, 'load_sizes', lambda m, w: (0.0 if w in good else m.squared, np.ones(3)))
    _, (finding,), _ = setup.correct_wiring([o], ())
    assert len(finding.equivalent) == 2
    # One change more each, a sign of a load.
    sizes = np.array([1.0, 1.0, -1.0])
    monkeypatch.setattr(setup, 'load_sizes', lambda m, w: (0.0, sizes if w in good else np.ones(3)))
    assert setup.correct_wiring([o], ())[1:] == ([], {})
    monkeypatch.setattr(setup, 'load_sizes', lambda m, w: (0.0 if w in good else m.squared, sizes))
    _, (wiring, sign), _ = setup.correct_wiring([o], ())
    assert (sign.name, sign.where) == ('load_sign', 'tz')
    assert all(words.endswith(' and load_sign of tz') for words in wiring.equivalent)


def test_what_a_law_leaves_is_reported_in_micrometres() -> None:
    law = SimpleNamespace(expression='y2 += 1', stage='psd', kind='straight')
    trial = SimpleNamespace(law=law, laws=[law], beside=[], heldout_gap=1.0)
    answer = SimpleNamespace(law=trial, effects=())
    assert conclusion.law_sentence(cast(Any, answer)).endswith('on unseen load cases it leaves 1000000.000 µm.')
    creep = SimpleNamespace(effect=SimpleNamespace(name='creep'))
    trial.beside = [creep]
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
    got = plants.with_first_dose(effect, {p.name: p.nominal for p in parameters})
    want = {'plain': 0.6, 'near': 0.55, 'listed': 0.4, 'far': 1.0, 'shape': 2.0, 'alone': 5.0, 'with_it': 1.0}
    assert got == pytest.approx(want)


def test_localisation_is_independent_of_fit_units() -> None:
    workspace = Workspace([make_observation(warm=None)])
    known = np.random.default_rng(3).standard_normal((len(workspace.whiten(workspace.measured)), 2))
    residual = workspace.residual([])[0]
    first, other = (
        localise.localise(workspace, residual, k, np.random.default_rng(0)) for k in (known, known * [1e6, 1e-6])
    )
    assert first.p == pytest.approx(other.p)
    assert [d.gain for d in first.dependences] == pytest.approx([d.gain for d in other.dependences])
    strong = {d.channel for d in first.dependences if d.p < 0.01}
    assert {c.channel for c in first.cells if c.depends_on} <= strong < {c.channel for c in first.cells}
    # A column that is all of what noise draws leaves less of it.
    assert [c.p for c in first.cells] == pytest.approx([c.p for c in other.cells])


@pytest.mark.parametrize(('gains', 'share'), [((-5.0, 1.0), 0.0), ((3.0, 2.0), 0.5), ((30.0, 2.0), 1.0)])
def test_tied_effects_explain_none_to_all_of_the_gap(gains: tuple[float, float], share: float) -> None:
    tie = weighing.Coincidence(((0, 'x'), (1, 'x')), (1.0, 1.0), 'V', 50.0)
    fit = SimpleNamespace(effects=(active('a', x=1.0), active('b', x=1.0)), chi2=90.0)
    result = SimpleNamespace(delta_chi2=list(gains), null=SimpleNamespace(chi2=100.0))
    (unknown,) = weighing.tied(
        [tie], cast(Fit, fit), cast(SearchResult, result), cast(Any, SimpleNamespace(dependences=()))
    )
    assert unknown.explains == pytest.approx(share)
    assert not unknown.unexplained


@pytest.mark.parametrize('channel', range(6))
def test_a_limit_is_looked_for_on_every_channel(channel: int) -> None:
    o = make_observation(warm=None)
    volts = np.zeros_like(o.volts)
    volts[7, channel] = -3.0
    observed, limits = dataclasses.replace(o, volts=volts), pytest.approx([2.8, 2.6, 1.8, 2.94])
    assert proposals.highest_voltages([observed], True, 0.1) == limits
    assert proposals.highest_voltages([observed], False, 0.1) == ([] if channel in (2, 5) else limits)


def test_of_two_that_are_one_the_sum_is_known() -> None:
    fit = refit(Plant(pictures(A), noise()), [active('a', x=0.0)])
    twice = dataclasses.replace(
        fit, jacobian=np.repeat(fit.jacobian, 2, axis=1), free=((0, 'x'), (1, 'x')), effects=fit.effects * 2
    )
    np.testing.assert_allclose(twice.covariance(), 0.25 * fit.covariance()[0, 0] * np.ones((2, 2)), rtol=1e-6)


def test_variable_is_known_as_means_of_estimate_blocks() -> None:
    workspace = Workspace([make_observation(warm=None), make_observation(1, name='second', warm=None)])
    for o, got in zip(workspace.observations, law_features.known_values(workspace, (), 'load_fy'), strict=True):
        np.testing.assert_allclose(got, o.loads[:, 1].reshape(-1, 20).mean(axis=1), atol=1e-12)


@pytest.mark.parametrize(('nominal', 'choices', 'fixed'), [(1.0, (0, 1), 1), (0.0, (0, 1), 0), (5.0, (2, 3), 2)])
def test_a_choice_that_makes_no_difference_stays_as_it_is(nominal: float, choices: tuple[int, ...], fixed: int) -> None:
    way = EffectParameter('way', '', 0, 9, 1, '', nominal=nominal, kind='choice', choices=choices)
    assert plants.fixed_choice(way).choices == (fixed,)
    psd, size = dataclasses.replace(way, each=True), EffectParameter('size', 'V', -1.0, 1.0, 0.1, '')
    assert plants.fixed_choice(psd) is psd
    assert plants.fixed_choice(size) is size


def test_the_nuisance_takes_part_in_no_tie() -> None:
    rng = np.random.default_rng(0)
    jacobian = rng.standard_normal((200, 3)) * 1e4
    effects = (active('a', -9.0, 9.0, x=1.0), active('b', -9.0, 9.0, x=1.0))
    beside = active('n', -9.0, 9.0, x=1.0)
    for free in (((-1, 'x'), (0, 'x'), (1, 'x')), ((0, 'x'), (-1, 'x'), (1, 'x'))):
        fit = Fit(effects, 0.0, np.zeros(200), [], jacobian, free, (), (beside,))
        (tie,) = weighing.coincidences(fit, Physics.of(RIG))
        assert tie.members == ((0, 'x'), (1, 'x'))


FIT = Fit((), 0.0, np.zeros(1), [], np.zeros((1, 0)), (), ())


def stiffness(name: str, scale: float, moves: int = 0) -> ActiveEffect:
    return make_active(f'{name}_stiffness', {'scale': scale, 'moves_frequency': moves}, 'test')


def named(active: ActiveEffect, sd: float, *alternatives: weighing.Alternative) -> weighing.NamedEffect:
    amplitude = next(p.name for p in active.effect.parameters if p.kind == 'amplitude')
    return weighing.NamedEffect(active, {amplitude: sd}, 1e-9, 50.0, HeldOut(9.0, 1.0), (), alternatives, (), None)


def test_radius_material_or_loads_explain_stiffnesses() -> None:
    (tie,) = weighing.ties([named(stiffness('bending', -0.04), 1e-4), named(stiffness('torsional', -0.0401), 1e-4)])
    assert tie.share == pytest.approx(-0.04005)
    radius, loads = tie.causes
    assert (radius.name, loads.name) == ('link_radius', 'load_unit')
    # A tube whose radii are multiplied by this has both stiffnesses multiplied by its fourth power.
    assert (radius.factor**4, loads.factor * (1.0 + tie.share)) == pytest.approx((1.0 + tie.share, 1.0))
    for cause, power in ((radius, 0.25), (loads, -1.0)):
        low, high = ((1.0 + share) ** power for share in (tie.share - tie.sd, tie.share + tie.sd))
        assert cause.sd == pytest.approx(abs(high - low) / 2.0, rel=1e-3)
    assert tie.sd == pytest.approx(1e-4 / np.sqrt(2.0))
    for part in ('same share (-4 ± 0.007 %)', 'radii times 0.98983', 'loads times 1.0417', 'weigh the loads'):
        assert part in tie.sentence


def test_if_the_modes_moved_it_is_not_the_loads() -> None:
    (tie,) = weighing.ties([named(stiffness('torsional', 0.02, 1), 1e-5), named(stiffness('bending', 0.02, 1), 1e-5)])
    assert [c.name for c in tie.causes] == ['link_radius']
    assert 'Not the loads' in tie.sentence
    assert (
        weighing.ties([named(stiffness('torsional', 0.02, 0), 1e-5), named(stiffness('bending', 0.02, 1), 1e-5)]) == ()
    )


def test_a_rival_may_be_the_half_of_a_tie() -> None:
    clamp = make_active('clamp_torsional_compliance', {'compliance': 2e-5}, 'test')
    alternative = weighing.Alternative(stiffness('torsional', -0.04), {'scale': 1e-5}, 0.0, FIT)
    (tie,) = weighing.ties([named(stiffness('bending', -0.04), 1e-5), named(clamp, 1e-8, alternative)])
    assert tie.share == pytest.approx(-0.04)
    assert weighing.ties([named(stiffness('bending', -0.04), 1e-5), named(clamp, 1e-8)]) == ()


@pytest.mark.parametrize(
    ('other', 'sd'), [(-0.041, 1e-5), (0.04, 1e-5), (-0.04, 0.01), (-0.04, 0.0)], ids=('off', 'sign', 'vague', 'fixed')
)
def test_shares_that_differ_or_are_vague_are_no_tie(other: float, sd: float) -> None:
    assert weighing.ties([named(stiffness('bending', -0.04), 1e-5), named(stiffness('torsional', other), sd)]) == ()


@pytest.mark.parametrize(('second', 'count'), [('torsional_stiffness', 0), ('axis_crosstalk', 1)])
def test_a_tie_of_known_cause_is_not_called_unknown(second: str, count: int) -> None:
    values = {'scale': -0.04} if count == 0 else {'psd': 1, 'xy': -0.04}
    effects = (stiffness('bending', -0.04), make_active(second, values, 'test'))
    free = ((0, 'scale'), (1, 'scale' if count == 0 else 'xy'))
    fit = Fit(effects, 0.0, np.zeros(2), [], 1e4 * np.eye(2), free, ())
    assert len(weighing.coincidences(fit, None)) == count


def test_the_deviation_of_a_tie_is_reported_in_per_cent() -> None:
    cause = weighing.CommonCause('link_radius', 1.0, 1e-3)
    assert '(2 ± 1 %)' in weighing.Tie(0.02, 0.0149, True, (cause,)).sentence


def test_a_stiffness_without_a_deviation_is_the_half_of_no_tie() -> None:
    without = dataclasses.replace(named(stiffness('torsional', -0.04), 1e-5), sd={})
    assert weighing.ties([named(stiffness('bending', -0.04), 1e-5), without]) == ()
