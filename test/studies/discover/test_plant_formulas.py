# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A plant's cases as vectors of one likelihood, and its answer: against sums, loops and least squares written here."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2 as chi2_law
from scipy.stats import norm
from scipy.stats import t as student

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover import plant_search
from psd_deflection.studies.discover.plant_search import PlantComparison, discover_in
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect
from psd_deflection.studies.discover.rehearsal import UNKNOWN, Named, Rehearsal, RehearsalOutcome
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.screen import Score
from psd_deflection.studies.discover.search.search import Search

LENGTHS = (10, 7, 13)


def size_of(name: str, nominal: float = 0.0) -> Effect:
    return plant_effect(name, EffectParameter('size', '', -90.0, 90.0, 0.1, '', nominal=nominal))


def on(name: str, size: float) -> ActiveEffect:
    return ActiveEffect(size_of(name), {'size': size})


class Pictures(Plant):
    """Shows the sum of its effects' pictures, each times its size."""

    channels: tuple[str, ...] = ('force', 'turn')
    units: tuple[str, ...] = ('N', 'rad')
    cases: tuple[str, ...] = ('a', 'b', 'c')

    def __init__(self, observed: Sequence[FloatArray], shown: Mapping[str, Sequence[FloatArray]], **given: Any) -> None:
        self.observed, self.shown, self.asked = list(observed), shown, list[dict[str, dict[str, float]]]()
        self.library = tuple(size_of(name) for name in shown)
        self.done: dict[str, list[FloatArray]] = {}
        for name, value in given.items():
            setattr(self, name, value)

    def measured(self) -> Sequence[FloatArray]:
        return self.observed

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        return self.done

    def simulate(self, model: Model) -> Sequence[FloatArray]:
        self.asked.append({name: dict(values) for name, values in model.items()})
        out = [np.zeros(np.shape(rows)) for rows in self.observed]
        for name, values in model.items():
            for total, picture in zip(out, self.shown[name], strict=True):
                total += values['size'] * picture
        return out


def tables(seed: int, channels: int = 2, lengths: Sequence[int] = LENGTHS) -> list[FloatArray]:
    rng = np.random.default_rng(seed)
    return [rng.standard_normal((channels, n)) * [[3.0], [0.2]][:channels] for n in lengths]


def holed(seed: int = 0) -> list[FloatArray]:
    """With lost values; of the second case all of the second channel."""
    out = tables(seed)
    out[0][0, [2, 3]] = math.nan
    out[1][1] = math.nan
    out[2][1, -1] = math.nan
    return out


def full(values: Sequence[FloatArray], channel: int) -> FloatArray:
    """The values of a channel in all cases that are there."""
    row = np.concatenate([v[channel] for v in values])
    return np.asarray(row[np.isfinite(row)])


def rms(values: FloatArray) -> float:
    return math.sqrt(sum(float(v) ** 2 for v in values) / len(values))


def test_the_gap_of_a_plant_is_in_its_unit_or_a_share() -> None:
    observed = holed()
    residual = [0.5 * rows for rows in observed]
    forces, angles = full(observed, 0), full(observed, 1)
    ws = PlantComparison(Pictures(observed, {}))
    assert ws.gap_per_channel(residual) == pytest.approx([0.5 * rms(forces), 0.5 * rms(angles)])
    assert math.isnan(ws.floor())
    ws = ws.begun(refit(ws, ()))
    # Newtons and radians have no sum: each is a share of its gap before.
    assert (ws.gap(observed), ws.gap(residual)) == pytest.approx((1.0, 0.5))
    mixed = [rows * [[1.0], [0.5]] for rows in observed]
    assert ws.gap(mixed) == pytest.approx(math.sqrt((1.0 + 0.25) / 2.0))
    assert (ws.unit, ws.display_scale, ws.display_units) == (
        'share of the gap before',
        (100.0, '% of the gap before'),
        ('N', 'rad'),
    )
    assert (ws.worded(0.1234), ws.worded(0.1234, '.1f')) == ('12.3 % of the gap before', '12.3 % of the gap before')
    assert ws.worded(math.nan) == 'not known'
    # A radian that moves something by 0.1 of the first unit.
    with_lever = Pictures(observed, {})
    with_lever.levers = (1.0, 0.1)
    ws = PlantComparison(with_lever)
    ws = ws.begun(refit(ws, ()))
    count = [np.isfinite(full(observed, k)).sum() for k in (0, 1)]
    squares = count[0] * rms(forces) ** 2 + count[1] * (0.1 * rms(angles)) ** 2
    assert ws.gap(observed) == pytest.approx(math.sqrt(squares / sum(count)))
    assert ws.gap_per_channel(observed) == pytest.approx([rms(forces), rms(angles)])
    assert (ws.unit, ws.worded(0.1234)) == ('N', '0.123 N')
    with_lever.levers = (1.0,)
    with pytest.raises(ConfigError, match=r'levers = \(1\.0,\): must be one number above 0 for each channel'):
        PlantComparison(with_lever)
    same = PlantComparison(Pictures(observed, {}, units=('N', 'N'), noise=(0.3, 0.1)))
    assert same.gap(observed) == pytest.approx(rms(np.concatenate((forces, angles))))
    assert same.floor() == pytest.approx(math.sqrt((28 * 0.3**2 + 22 * 0.1**2) / 50))
    assert (same.unit, same.display_scale, same.worded(0.1234)) == ('N', (1.0, 'N'), '0.123 N')
    # A number without a unit has none behind it.
    assert PlantComparison(Pictures(observed, {}, units=('', ''))).worded(0.5) == '0.5'


def fitted(values: Sequence[FloatArray], picture: Sequence[FloatArray], **given: Any) -> tuple[PlantComparison, Any]:
    workspace = PlantComparison(Pictures(values, {'size': picture}, **given))
    fit = refit(workspace, [on('size', 0.0)])
    while (renoised := workspace.renoised(fit.effects)) is not workspace:
        workspace = renoised
        fit = refit(workspace, fit.effects)
    return workspace, fit


def sized(values: Sequence[FloatArray], picture: Sequence[FloatArray]) -> float:
    return float(fitted(values, picture)[1].effects[0].values['size'])


def sd_of_size(values: Sequence[FloatArray], picture: Sequence[FloatArray], **given: Any) -> float:
    workspace, fit = fitted(values, picture, **given)
    return float(workspace.sd(fit.jacobian, fit.covariance())[0])


def test_few_values_make_the_interval_of_student() -> None:
    # Of one channel: the textbook's line through the origin. Of two: Welch (1947).
    values, reported = tables(3), [np.linspace(1.0, 2.0, n) for n in LENGTHS]
    x, y = np.concatenate(reported), np.concatenate([rows[0] for rows in values])
    picture = [np.stack([part, 0.0 * part]) for part in reported]
    size = float(x @ y / (x @ x))
    variance = float(np.sum((y - size * x) ** 2)) / (len(x) - 1)
    wanted = math.sqrt(variance / float(x @ x)) * student.ppf(0.975, len(x) - 1) / norm.ppf(0.975)
    assert sd_of_size(values, picture) == pytest.approx(wanted, rel=1e-3)
    both = [np.stack([part, 0.1 * part]) for part in reported]
    parts, freedom = [], []
    for scale, row in ((1.0, 0), (0.1, 1)):
        y = np.concatenate([rows[row] for rows in values])
        level = float(np.mean((y - sized(values, both) * scale * x) ** 2))
        parts.append(scale**2 * float(x @ x) / level)
    for part in parts:
        freedom.append(len(x) - part / sum(parts))
    variances = [part / sum(parts) ** 2 * len(x) / nu for part, nu in zip(parts, freedom, strict=True)]
    nu = sum(variances) ** 2 / sum(v * v / n for v, n in zip(variances, freedom, strict=True))
    wanted = math.sqrt(sum(variances)) * student.ppf(0.975, nu) / norm.ppf(0.975)
    assert sd_of_size(values, both) == pytest.approx(wanted, rel=1e-3)
    # As many sizes as values leave one degree of freedom, not none.
    each = PlantComparison(Pictures(values, {})).sd(np.eye(2 * len(x)), np.eye(2 * len(x)))
    assert each == pytest.approx(math.sqrt(len(x)) * student.ppf(0.975, 1) / norm.ppf(0.975), rel=1e-3)
    # A stated noise is not told by the values: it is the normal law's.
    assert sd_of_size(values, picture, noise=(9.0, 9.0)) == pytest.approx(9.0 / math.sqrt(float(x @ x)), rel=1e-3)


def test_the_likelihood_of_a_plant_has_the_level_that_fits_best() -> None:
    """n ln s^2 + n for each channel, s its rms over the level before; never below a stated noise."""
    observed = holed()
    other = [rows * [[0.4], [2.5]] for rows in observed]
    for noise in ((), (2.0, 1e-3)):
        ws = PlantComparison(Pictures(observed, {}, noise=noise))
        want = 0.0
        for c in range(2):
            level = max(rms(full(observed, c)), noise[c] if noise else 0.0)
            square = (rms(full(other, c)) / level) ** 2
            least = (noise[c] / level) ** 2 if noise else 0.0
            want += len(full(observed, c)) * (math.log(max(square, least)) + square / max(square, least))
        assert ws.loss(ws.whiten(other)) == pytest.approx(want)
    assert ws.loss(ws.whiten(other)) != pytest.approx(28 * (math.log(0.16) + 1.0) + 22 * (math.log(6.25) + 1.0))
    # A level below the noise is the noise.
    assert PlantComparison(Pictures(observed, {}, noise=(9.0, 9.0))).level.tolist() == [9.0, 9.0]


@pytest.mark.parametrize('stated', [0.5, 1.2])
@pytest.mark.parametrize('period', [0.0, 0.01])
def test_what_is_gained_on_a_fold_has_a_level_of_its_own(period: float, stated: float) -> None:
    """Half of what the likelihood of each fold and channel differs by, its values weighed as independent ones."""
    observed, first, second = holed(), holed(1), [0.7 * rows for rows in holed(2)]
    ws = PlantComparison(Pictures(observed, {}, period=period, noise=(stated, 1e-3)))
    # Two pieces of each of three cases, four being wanted.
    cases = [i * 2 + np.arange(n) * 2 // n for i, n in enumerate(LENGTHS)]
    assert ([c.tolist() for c in ws.case], ws.folds().tolist()) == ([c.tolist() for c in cases], list(range(6)))
    np.testing.assert_array_equal(ws.row_cases(), np.concatenate([np.tile(c, 2) for c in cases]))
    want = np.zeros(6)
    least = (np.array([stated, 1e-3]) / ws.level) ** 2
    for fold, channel in itertools.product(range(6), range(2)):
        sides = []
        for tables_of in (first, second):
            x = [v[channel][np.isfinite(v[channel]) & (c == fold)] for v, c in zip(tables_of, cases, strict=True)]
            x = [float(v) / float(ws.level[channel]) for v in np.concatenate(x)]
            if x:
                square = sum(v * v for v in x) / len(x)
                level = max(square, float(least[channel]))
                weight = len(x) * float(ws.independent[channel]) / len(full(observed, channel))
                sides.append(0.5 * weight * (math.log(level) + square / level))
        want[fold] += sides[0] - sides[1] if sides else 0.0
    np.testing.assert_allclose(ws.pieces(ws.whiten(first), ws.whiten(second)), want, rtol=1e-9)
    if period:
        assert (ws.independent < ws.total).any()


def test_neighbours_that_follow_each_other_are_fewer_values() -> None:
    """n / (1 + 2 sum of correlations up to the first that is negative), case by case, two at least."""
    n = 60
    slow = [np.vstack((np.sin(np.arange(n) / (4.0 + i)), np.cos(np.arange(n) ** 1.5))) for i in range(3)]
    slow[1][0, 5:9] = math.nan
    slow[2][0] = math.nan
    ws = PlantComparison(Pictures(slow, {}, period=0.5))
    want = []
    for c in range(2):
        count = 0.0
        for rows in slow:
            there = np.isfinite(rows[c])
            if there.any():
                x = np.where(there, rows[c] - rows[c][there].mean(), 0.0)
                total = 1.0
                for lag in range(1, n):
                    correlation = float(x[lag:] @ x[: n - lag]) / float(x @ x)
                    if correlation < 0.0:
                        break
                    total += 2.0 * correlation
                count += there.sum() / total
        want.append(max(count, 2.0))
    assert ws.independent == pytest.approx(want)
    assert want[0] < 0.3 * ws.total[0]
    assert ws.effective_size() == pytest.approx(sum(want))
    # The squares of a residual add up to these.
    vector = ws.whiten(slow)
    assert float(vector @ vector) == pytest.approx(sum(want))
    np.testing.assert_allclose(ws.scale, ws.level * np.sqrt(ws.total / np.array(want)))
    assert ws.periods == [0.5] * 3
    ever = [np.ones((2, n)) * np.linspace(0.0, 1.0, n) for _ in range(3)]
    assert (PlantComparison(Pictures(ever, {}, period=0.5)).independent >= 2.0).all()
    # One value is like the next, which is no noise unless somebody says so.
    for observed, stated, alike in ((ever, (), True), (ever, (1.0, 1.0), False), (tables(0), (), False)):
        assert PlantComparison(Pictures(observed, {}, period=0.5, noise=stated)).correlated is alike
    still = [np.ones((2, 2)) for _ in range(3)]
    assert PlantComparison(Pictures(still, {}, period=0.5)).independent.tolist() == [6.0, 6.0]
    pair = Pictures([np.array([[1.0, 2.0], [5.0, 3.0]])], {}, cases=('a',), period=0.5)
    assert PlantComparison(pair).independent.tolist() == [2.0, 2.0]
    alone = [np.full((2, 3), math.nan) for _ in range(3)]
    for rows in alone:
        rows[:, 0] = 1.0
    assert PlantComparison(Pictures(alone, {}, period=0.5)).independent.tolist() == [3.0, 3.0]
    # Each column a reading by itself: every one counts, however alike they are.
    assert PlantComparison(Pictures(slow, {})).independent.tolist() == [116.0, 180.0]


def test_what_a_plant_simulates_is_what_the_model_says(monkeypatch: pytest.MonkeyPatch) -> None:
    observed = holed()
    plant = Pictures(observed, {'a': tables(4), 'b': tables(5)}, nuisance=(size_of('b', nominal=2.0),))
    plant.library = (size_of('a'),)
    ws = PlantComparison(plant)
    assert [(a.effect.name, dict(a.values)) for a in ws.nuisance] == [('b', {'size': 2.0})]
    # The first level is that beside the nuisance as it is declared.
    assert plant.asked == [{'b': {'size': 2.0}}]
    assert ws.level == pytest.approx(
        [rms(full([m - 2.0 * b for m, b in zip(observed, tables(5), strict=True)], c)) for c in range(2)]
    )
    got = ws.simulate([on('a', 3.0), *ws.nuisance])
    for rows, a, b in zip(got, tables(4), tables(5), strict=True):
        np.testing.assert_allclose(rows, 3.0 * a + 2.0 * b)
    assert ws.simulations == len(plant.asked) == 2
    # Where nothing was measured it may be anything.
    plant.shown = {'a': [np.where(np.isfinite(rows), 1.0, math.inf) for rows in observed], 'b': tables(5)}
    ws.simulate([on('a', 1.0)])
    plant.shown = {'a': [np.where(np.isfinite(rows), math.inf, 1.0) for rows in observed], 'b': tables(5)}
    with pytest.raises(ConfigError, match=r'simulate, a: not finite with .*narrow the bounds'):
        ws.simulate([on('a', 1.0)])
    plant.observed = observed[:2]
    plant.shown = {'a': tables(4)[:2]}
    with pytest.raises(ConfigError, match='simulate: 2 tables for 3 cases'):
        ws.simulate([on('a', 1.0)])
    # Even if a channel may be exact.
    plant.observed = [np.where([[True], [False]], 1.0, rows) for rows in observed]
    monkeypatch.setattr(plant, 'simulate', lambda model: [np.ones((2, n)) for n in LENGTHS[:2]])
    with pytest.raises(ConfigError, match='simulate: 2 tables for 3 cases'):
        PlantComparison(plant)


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'observed': [np.zeros((2, 3, 1))] * 3}, r'measured, a: has the shape \(2, 3, 1\): must be \(2, n\)'),
        ({'observed': [np.zeros((2, 0))] * 3}, r'measured, a: has the shape \(2, 0\)'),
        ({'observed': [[['x']]] * 3}, r'measured, a: must be numbers, \(channels, n\)'),
        ({'observed': [[[1.0], [2.0, 3.0]]] * 3}, r'measured, a: must be numbers'),
        ({'observed': [np.zeros((2, 1)), *[np.full((2, 1), math.nan)] * 2]}, 'force has 1 values in all'),
        ({'noise': (1.0,)}, 'one number above 0 for each channel'),
        ({'noise': (1.0, 0.0)}, 'one number above 0 for each channel'),
        ({'units': ('N',)}, 'units: 1 of them for 2 channels'),
        ({'library': (size_of('a'), size_of('b'), size_of('b'), size_of('a'))}, 'library: a, b is there twice'),
    ],
)
def test_tables_that_do_not_fit_are_rejected(change: Mapping[str, object], words: str) -> None:
    plant = Pictures(tables(0), {})
    for name, value in change.items():
        setattr(plant, name, value)
    with pytest.raises(ConfigError, match=words):
        PlantComparison(plant)
    # Two values of each channel are enough, one column is a case.
    assert PlantComparison(Pictures([np.ones((2, 1))] * 3, {}, noise=(1e-9, 1e-9))).total.tolist() == [3, 3]
    assert PlantComparison(Pictures([np.ones((2, 1))] * 2, {}, cases=('a', 'b'))).total.tolist() == [2, 2]


@pytest.mark.parametrize('cases', [1, 2, 3, 4, 5])
def test_there_are_four_folds_at_least(cases: int) -> None:
    plant = Pictures([np.ones((2, 20))] * cases, {}, cases=tuple('abcde'[:cases]))
    ws = PlantComparison(plant)
    pieces = {1: 4, 2: 2, 3: 2, 4: 1, 5: 1}[cases]
    assert ws.folds().tolist() == list(range(cases * pieces))
    for i, case in enumerate(ws.case):
        assert np.bincount(case - i * pieces).tolist() == [20 // pieces] * pieces


def test_an_effect_of_a_plant_is_declared_without_a_rig() -> None:
    size = EffectParameter('size', 'N', 0.0, 9.0, 1.0, '', grid=(1.0, 2.0))
    limit = plant_effect('limit', size, summary='s', equation='e', source='o', finite=True)
    assert (limit.summary, limit.equation, limit.source, limit.finite, limit.needs) == ('s', 'e', 'o', True, '')
    assert not plant_effect('limit', size).finite
    assert limit.configure is not None
    with pytest.raises(TypeError, match='simulated by its plant'):
        limit.configure(cast(Physics, None), {})
    changes: list[dict[str, Any]] = [{'of_rig': 'x'}, {'within': 'half_area'}, {'propose': 'line'}]
    for change in changes:
        with pytest.raises(ConfigError, match='limit: size: of_rig, within and propose'):
            plant_effect('limit', dataclasses.replace(size, **change))


@pytest.mark.parametrize('period', [0.0, 0.25])
def test_what_remains_of_a_plant_is_held_against_its_inputs(period: float) -> None:
    observed = holed()
    given = [np.arange(n, dtype=np.float64) for n in LENGTHS]
    plant = Pictures(observed, {'a': tables(4)}, period=period)
    plant.done = {'u': given}
    ws = PlantComparison(plant)
    axis, alongs = ws.along()
    beside = ws.against()
    times = [(start + np.arange(n)) * (period or 1.0) for start, n in zip((0, 10, 17), LENGTHS, strict=True)]
    assert str(axis) == ('time / s (cases one after another)' if period else 'number of the reading')
    assert list(beside) == ['u', 'force / N', 'turn / rad']
    for got, along in zip(alongs, times, strict=True):
        np.testing.assert_allclose(got, along)
    assert all(np.array_equal(a, b) for a, b in zip(beside['u'], given, strict=True))
    assert all(np.array_equal(a, b[1], equal_nan=True) for a, b in zip(beside['turn / rad'], observed, strict=True))
    plant.units = ('', '')
    assert list(ws.against())[1:] == ['force', 'turn']
    named = plant_search.regressors(ws, refit(ws, [on('a', 0.5)], iterations=0))
    assert [channel for channel, _ in named] == ['force', 'turn']
    for c, (channel, of) in enumerate(named):
        for i, n in enumerate(LENGTHS):
            data = 0.5 * tables(4)[i][c] * np.isfinite(observed[i][c])
            want = {'constant': np.ones(n), 'u': given[i], 'u^2': given[i] ** 2, 'u^3': given[i] ** 3}
            want.update({channel: data, f'{channel}^2': data**2, f'{channel}^3': data**3, f'|{channel}|': abs(data)})
            if period:
                t, rate = 2.0 * np.arange(n) / (n - 1) - 1.0, np.gradient(data)
                want.update({'time': t, 'time^2': t * t})
                want.update({f'rate of {channel}': rate, f'sign of rate of {channel}': np.sign(rate)})
            assert set(of) == set(want)
            for name, values in want.items():
                np.testing.assert_allclose(of[name][i], values, atol=1e-12, err_msg=name)
    short = PlantComparison(Pictures([rows[:, :1] for rows in tables(0)], {}, period=1.0))
    assert not any('rate' in name for name in plant_search.regressors(short, refit(short, ()))[0][1])
    two = PlantComparison(Pictures([rows[:, :2] for rows in tables(0)], {}, period=1.0))
    assert 'rate of force' in plant_search.regressors(two, refit(two, ()))[0][1]


@pytest.mark.parametrize('period', [0.0, 0.25])
def test_a_case_is_a_cell_of_each_channel(period: float) -> None:
    """Energy beyond its share of independent values, as a normal deviate; by the chi-square law itself."""
    observed = holed()
    observed[1][0] *= 3.0
    observed[2][1] += 0.3 * np.arange(13) / 13
    plant = Pictures(observed, {}, period=period)
    plant.done = {'u': [np.arange(n) / n for n in LENGTHS]}
    ws = PlantComparison(plant)
    located = plant_search.localise_cases(ws, refit(ws, ()), None)
    cells = {(c.channel, c.recording): c for c in located.cells}
    assert set(cells) == {('force', 0), ('force', 1), ('force', 2), ('turn', 0), ('turn', 2)}
    for (channel, case), cell in cells.items():
        c = ws.channels.index(channel)
        dof = float(ws.independent[c]) * int(np.isfinite(observed[case][c]).sum()) / float(ws.total[c])
        energy = float(np.nansum((observed[case][c] / ws.scale[c]) ** 2))
        assert cell.energy == pytest.approx(energy - dof)
        p = float(chi2_law.sf(energy, dof))
        # Six cells were tried, one of which is empty.
        assert cell.p == pytest.approx(1.0 - (1.0 - p) ** 6, abs=1e-12)
        assert cell.statistic == pytest.approx(float(norm.isf(p)), abs=0.35)
        # Wilson and Hilferty: the cube root of a chi-square over its mean is normal.
        deviation = 2.0 / (9.0 * dof)
        assert cell.statistic == pytest.approx(((energy / dof) ** (1 / 3) - 1.0 + deviation) / math.sqrt(deviation))
        assert (located.map[case, c, 0], cell.when) == (cell.statistic, (0.0, LENGTHS[case] * period))
        assert cell.band == (0.0, 0.5 / period if period else 0.0)
        names = [d.regressor for d in located.dependences if d.channel == channel and d.p < 0.01]
        assert cell.depends_on == tuple(names[:2])
    assert (located.map.shape, located.map[1, 1, 0]) == ((3, 2, 1), 0.0)
    assert [c.statistic for c in located.cells] == sorted((c.statistic for c in located.cells), reverse=True)
    assert located.spans == tuple((i, 0.0, n * period) for i, n in enumerate(LENGTHS))
    assert (located.excess, located.p) == (located.dependences[0].gain, located.dependences[0].p)


def steel(size: float, seed: int = 0, **given: Any) -> Pictures:
    """Two pictures, of which the second has ``size``, in noise of 0.02; a third is the nuisance's, of size 1.5."""
    rng = np.random.default_rng(seed)
    shown = {name: [rng.standard_normal((2, 30)) for _ in range(4)] for name in 'abc'}
    noise = [0.02 * rng.standard_normal((2, 30)) for _ in range(4)]
    observed = [size * b + 1.5 * c + e for b, c, e in zip(shown['b'], shown['c'], noise, strict=True)]
    plant = Pictures(observed, shown, cases=tuple('abcd'), units=('N', 'N'), nuisance=(size_of('c'),), **given)
    plant.library = (size_of('a'), size_of('b'))
    return plant


def least_squares(plant: Pictures, *names: str) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Sizes of the pictures, what they leave, and the inverse of their products."""
    matrix = np.stack([np.concatenate([p.ravel() for p in plant.shown[n]]) for n in names], axis=1)
    data = np.concatenate([s.ravel() for s in plant.observed])
    sizes = np.linalg.lstsq(matrix, data, rcond=None)[0]
    residual = (data - matrix @ sizes).reshape(4, 2, 30)
    return sizes, list(residual), np.linalg.inv(matrix.T @ matrix)


def test_the_answer_for_a_plant_is_that_of_least_squares() -> None:
    message: list[str] = []
    plant = steel(0.4, noise=(0.02, 0.02))
    study = discover_in(plant, seed=5, progress=message.append)
    (named,) = study.effects
    (size, other), residual, inverse = least_squares(plant, 'b', 'c')
    _, before, _ = least_squares(plant, 'c')
    assert (study.verdict, study.unknown, study.seed) == ('effects_found', (), 5)
    assert named.active.effect.name == 'b'
    assert named.active.values['size'] == pytest.approx(size, abs=1e-3)
    ((nuisance, sd),) = study.nuisance
    assert nuisance.values['size'] == pytest.approx(other, abs=1e-3)
    # From the noise, or from the scatter over the folds, whichever is greater.
    assert named.sd['size'] >= 0.9 * 0.02 * math.sqrt(inverse[0, 0])
    assert sd['size'] >= 0.9 * 0.02 * math.sqrt(inverse[1, 1])
    assert max(named.sd['size'], sd['size']) < 3.0 * 0.02 * math.sqrt(inverse.max())
    gaps = [rms(np.concatenate([rows.ravel() for rows in tables_of])) for tables_of in (before, residual)]
    assert (study.gap_before, study.gap_after) == pytest.approx(tuple(gaps), rel=1e-3)
    assert study.gap_floor == pytest.approx(0.02)
    assert study.floors == pytest.approx(gaps[1] / 0.02, rel=1e-3)
    assert gaps[1] < study.gap_heldout_after < 1.1 * gaps[1]
    assert gaps[0] < study.gap_heldout_before < 1.1 * gaps[0]
    for i, channel in enumerate(('force', 'turn')):
        pair = tuple(rms(np.concatenate([rows[i] for rows in tables_of])) for tables_of in (before, residual))
        assert study.per_channel[channel] == pytest.approx(pair, rel=1e-3)
        assert study.heldout_per_channel[channel] == pytest.approx(pair[1], rel=0.1)
    assert study.waterfall == (('as described', study.gap_before), ('+ b', study.gap_after), ('noise alone', 0.02))
    assert (study.simulations, message[0]) == (len(plant.asked), 'simulating the plant as it is described')
    assert [s for s in message if s in ('signatures of every effect', 'weighing', 'alternatives', 'where')] == [
        'signatures of every effect',
        'weighing',
        'alternatives',
        'where',
    ]
    # Where it was before the effect, and where nothing is left after it.
    assert max(c.statistic for c in study.where.cells) > 8.0 > max(c.statistic for c in study.residual.cells)
    assert study.residual.p > 1e-4
    assert study.sentence.startswith('b is missing from the model; adding it closes the gap from')
    assert repr(study) == (
        f'<PlantDiscovery effects_found: b; gap {study.gap_before:.3g} N → {study.gap_after:.3g} N '
        '(noise alone: 0.02 N)>'
    )


def test_noise_of_a_plant_is_nothing_missing() -> None:
    discovery = discover_in(steel(0.0))
    assert (discovery.verdict, discovery.effects, discovery.unknown) == ('nothing_missing', (), ())
    assert discovery.gap_before == discovery.gap_after
    # Nobody said how much noise there is.
    assert math.isnan(discovery.gap_floor)
    assert discovery.floors == 0.0
    assert '(noise alone: not known)' in repr(discovery)
    assert 'no effect' in repr(discovery)
    search = Search(PlantComparison(steel(0.0)), lambda *_: cast(Any, None))
    for p, passes in ((0.0099, True), (0.0101, False)):
        assert search.may_pass(Score(cast(Any, None), 1e3, 1, p, np.zeros(1))) is passes


@pytest.mark.parametrize('third', [0.0, 0.05, 0.15])
def test_second_resonance_is_named_and_no_cubic(third: float) -> None:
    """Of a machine that responds at 1.3 Hz as it is described, and at 4.1 and 7.9 Hz, in parts of 6 s."""
    rng = np.random.default_rng(7)
    pushes = [np.repeat(rng.standard_normal(60), 5) for _ in range(4)]
    poles = [np.exp(0.02 * 2.0 * np.pi * f * complex(-z, 1.0)) for f, z in ((1.3, 0.03), (4.1, 0.02), (7.9, 0.02))]
    modes = [[lfilter([0.0, abs(1.0 - p) ** 2], np.poly([p, p.conj()]).real, u)[None] for u in pushes] for p in poles]
    noise = [0.01 * rng.standard_normal((1, 300)) for _ in pushes]
    observed = [0.3 * b + third * c + n for b, c, n in zip(modes[1], modes[2], noise, strict=True)]
    shown = {'second': modes[1], 'cubic': [a**3 for a in modes[0]], 'square': [a**2 for a in modes[0]]}
    given: dict[str, Any] = {'channels': ('tip',), 'units': ('mm',), 'period': 0.02, 'cases': tuple('abcd')}
    answer = discover_in(Pictures(observed, shown, done={'push': pushes}, **given))
    assert [e.name for e in answer.effects] == ['second']
    assert bool(answer.unknown) is (third > 0.0)


@pytest.mark.parametrize('size', [0.4, 0.0])
def test_rehearsed_plant_gets_its_own_answer_again(size: float) -> None:
    answer = discover_in(steel(size, noise=(0.02, 0.02))).rehearse(2)
    tree = answer.tree()['rehearsal']
    assert (tree['times'], tree['again'], tree['sizes'], tree['failed']) == (2, 2, 2 if size else 0, 0)
    words = (
        'with the found effects: found again in 2' if size else 'without a missing effect: nothing missing in 2 of 2'
    )
    assert f'Rehearsed 2 times on simulated recordings {words}.' in answer.sentence
    assert words in answer.report()
    with pytest.raises(ConfigError, match='times = 0: must be at least 1'):
        answer.rehearse(0)


def test_rehearsal_of_alike_effects_near_noise_differs() -> None:
    rng = np.random.default_rng(4)
    b = [rng.standard_normal((1, 12)) for _ in range(4)]
    a = [rows + 0.3 * rng.standard_normal((1, 12)) for rows in b]
    observed = [0.014 * rows + 0.02 * rng.standard_normal((1, 12)) for rows in b]
    given: dict[str, Any] = {'channels': ('force',), 'units': ('N',), 'noise': (0.02,)}
    answer = discover_in(Pictures(observed, {'a': a, 'b': b}, cases=tuple('abcd'), **given)).rehearse(3)
    assert [(e.name, e.equivalent) for e in answer.effects] == [('a', ('b',))]
    tree = answer.tree()['rehearsal']
    assert (tree['again'], tree['by_equivalent'], tree['otherwise']) == (2, {'b': 1}, [{'effects': [], 'times': 1}])
    assert 'found again in 2 (in 1 its equivalent b); once nothing instead.' in answer.sentence


def test_rehearsal_counts_what_is_named_and_sizes_inside() -> None:
    gain, skew = (Named(n, f'{n} (psd 1)', e, {'x': 1.0}, {'x': 0.1}) for n, e in (('gain', ('lag',)), ('skew', ())))
    inside, outside = gain._replace(values={'x': 1.19}), skew._replace(values={'x': 0.8})
    lag = inside._replace(name='lag', label='lag (psd 2)')
    named = [(outside, inside), (skew, lag), (lag, gain), (gain, skew, UNKNOWN), (gain,), (gain,)]
    outcomes = (*map(RehearsalOutcome, named), RehearsalOutcome(error='ValueError: late'))
    rehearsal = Rehearsal((gain, skew), outcomes)
    tree = rehearsal.tree()
    assert (tree['again'], tree['by_equivalent']) == (2, {'lag (psd 2)': 1})
    assert (tree['sizes'], tree['sizes_in_interval'], tree['failed']) == (3, 2, 1)
    assert tree['otherwise'][0] == {'effects': ['gain (psd 1)'], 'times': 2}
    assert sum(o['times'] for o in tree['otherwise']) == 4
    sentence, sizes = rehearsal.sentences()
    assert '; 2 times gain (psd 1) instead; once gain (psd 1) and lag (psd 2) instead;' in sentence
    assert sentence.endswith('; once failed (ValueError: late).')
    assert sizes == '2 of 3 sizes were within their 95 % intervals.'
    # What is unknown is not simulated.
    unknown = dataclasses.replace(rehearsal, expected=(gain, skew, UNKNOWN))
    assert (unknown.tree()['again'], unknown.sentences()[-1]) == (3, 'The simulated recordings lack what is unknown.')
