# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Cleaning, workspace, noise, starting values, plans: each function against sums, loops and limits written here."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from psd_deflection.model.simulation.catalogue import make_active
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import replace_values
from psd_deflection.studies.discover import experiment, planning
from psd_deflection.studies.discover.experiment import Limits, ModelSums, Piece, Proposal, Setting
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.search import hold_out as validate
from psd_deflection.studies.discover.search import localise, proposals, weighing
from psd_deflection.studies.discover.search import workspace as whitened
from psd_deflection.studies.discover.search.coincidence import Coincidence
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.localise import Dependence
from psd_deflection.studies.discover.search.screen import Screen
from psd_deflection.studies.discover.search.search import SearchResult
from psd_deflection.studies.discover.search.signatures import Candidate, SignatureBank, signatures_beside
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import cleaning
from psd_deflection.studies.discover.setup.hidden import beginning, mistakes
from psd_deflection.studies.discover.setup.noise import estimate_noise

from .test_formulas import HISTORY, RIG, make_observation
from .test_rules import CASES, FINE, SIGMA, Plant, active, columns, noise, nowhere, pictures

A, B = ('a', 'x'), ('b', 'x')
DOTS = [0, 1, 3, 4]


# What of a recording is no measurement.


@pytest.mark.parametrize(('size', 'found'), [(8.1e-3, True), (7.9e-3, False), (-8.1e-3, True)])
def test_an_outlier_is_eight_deviations_off(size: float, found: bool) -> None:
    """Of the least that is assumed, or of what the neighbours' distances show: 1.4826 times their median."""
    x = np.zeros((60, 1))
    x[30] = size
    assert cleaning.outliers(x, 1e-3).any() == found
    # A zigzag of +-d is 8/3 d from its cubics, which predict -5/3 d where it is d.
    d = 1e-3 / 1.4826 * 3 / 8
    zigzag = np.tile(np.array([d, -d], np.float64), 100)[:, None]
    zigzag[100] = size - 5 / 3 * d
    got = np.flatnonzero(cleaning.outliers(zigzag, 1e-9)[:, 0])
    assert got.tolist() == ([100] if found else [])


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
    assert finding.value == pytest.approx(0.4)
    assert finding.evidence == pytest.approx(100 / 1200)
    assert finding.fix.startswith('y2 of seen keeps one value from 0.400 s on, 0.100 s in all')
    gone = np.isnan(cleaned.volts[:, 4])
    assert gone[400:440].all()
    assert gone[500:560].all()
    assert gone.sum() <= 102
    # Coarse steps keep their value for long.
    step = 64 * RIG.converter.volts_per_count
    coarse = dataclasses.replace(o, volts=np.rint(o.volts / step) * step)
    assert cleaning.clean(coarse, ())[1] == []


# The workspace.


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


def test_fine_blocks_are_parts_of_the_blocks_of_an_estimate(gappy: Workspace) -> None:
    """Of 4 ms or the next shorter that divides 20 samples; longer in long recordings."""
    assert gappy.fine == [4, 2]
    assert gappy.periods == [0.004, 0.004]
    assert [m.shape for m in gappy.measured] == [(6, 300), (6, 400)]
    assert (gappy.names, gappy.channels) == (('seen', 'second'), ('x1', 'y1', 'x2', 'y2'))
    o = gappy.observations[0]
    there = np.isfinite(o.volts).reshape(300, 4, 6)
    want = np.nan_to_num(np.where(there, o.volts.reshape(300, 4, 6), 0.0)).sum(axis=1) / np.maximum(
        there.sum(axis=1), 1
    )
    np.testing.assert_allclose(gappy.measured[0], want.T, atol=1e-15)
    np.testing.assert_allclose(gappy.count[0], there.mean(axis=1).T)
    assert (gappy.count[1] == 1.0).all()
    assert gappy.case[1].min() == gappy.case[0].max() + 1
    assert gappy.simulations == 1
    # What is simulated is averaged over the same samples.
    (simulated, _) = gappy.simulate([])
    volts = ForwardModel(RIG, []).expect(o.loads, None).volts.T.reshape(300, 4, 6)
    want = np.where(there, volts, 0.0).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    np.testing.assert_allclose(simulated, want.T, atol=1e-12)
    raw = gappy.raw_residual([])
    full = o.volts - ForwardModel(RIG, []).expect(o.loads, None).volts.T
    np.testing.assert_allclose(raw[0], np.nan_to_num(full), atol=1e-15)
    assert gappy.simulations == 3


@pytest.mark.parametrize(
    ('rate', 'size'), [(100.0, 1), (250.0, 1), (1000.0, 4), (1500.0, 5), (1600.0, 5), (5000.0, 20)]
)
def test_a_fine_block_divides_a_block(rate: float, size: int) -> None:
    rig = replace_values(RIG, {'converter.sample_rate_hz': rate})
    o = Observation('x', rig, np.zeros((100, 6)), np.zeros((100, 3)))
    assert Workspace([o]).fine == [size]


def test_long_recordings_have_longer_fine_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many in all as a stated number."""
    assert whitened.MAX_FINE == 60_000
    monkeypatch.setattr(whitened, 'MAX_FINE', 120)
    o = make_observation(warm=None)
    # 1.2 s in 120 blocks: 10 ms; two of these recordings: 20 ms.
    assert Workspace([o]).fine == [10]
    assert Workspace([o, o]).fine == [20, 20]


def test_noise_has_a_floor_of_its_file() -> None:
    """A twentieth of the file's; a quarter where coarse steps hide it."""
    loud = replace_values(RIG, {'amplifier.noise': 0.1})
    ws = Workspace([dataclasses.replace(make_observation(warm=None), rig=loud)])
    np.testing.assert_allclose(ws.noise[0].sigma, 0.05 * loud.noises.ravel())
    coarse = ws.renoised([make_active('quantisation', {'step': 0.01}, 't')])
    np.testing.assert_allclose(coarse.noise[0].sigma, 0.25 * loud.noises.ravel())
    assert ws.renoised([make_active('creep', {'amplitude': 0.01}, 't')]) is ws


def test_pieces_of_a_recording_are_half_seconds(gappy: Workspace) -> None:
    rng = np.random.default_rng(0)
    a, b = (rng.standard_normal(sum(m.size for m in gappy.measured)) for _ in range(2))
    want: list[float] = []
    for x, y in zip(gappy.split(a), gappy.split(b), strict=True):
        gain = 0.5 * (x**2 - y**2).sum(axis=0)
        want += [float(gain[k : k + 125].sum()) for k in range(0, len(gain), 125)]
    np.testing.assert_allclose(gappy.pieces(a, b), want)
    assert len(want) == 3 + 4


def test_a_slow_change_is_unwhitened_by_what_is_left_of_a_constant() -> None:
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
    (one, two) = gappy.provenance()
    assert (one['name'], one['seconds'], two['seconds']) == ('seen', pytest.approx(1.2), pytest.approx(1.602))
    assert one['rest_seconds'] == gappy.noise[0].rest_seconds
    lost = dataclasses.replace(gappy.observations[0], volts=np.full((1200, 6), np.nan))
    assert Workspace([lost]).gap(Workspace([lost]).measured) == 0.0


def test_a_row_of_a_channel_is_whitened_as_the_readings_are(gappy: Workspace) -> None:
    values: list[FloatArray] = [
        np.asarray(np.random.default_rng(k).standard_normal(m.shape[1])) for k, m in enumerate(gappy.measured)
    ]
    tables = [np.zeros_like(m) for m in gappy.measured]
    for table, v in zip(tables, values, strict=True):
        table[3] = v
    want = np.concatenate([part[3] for part in gappy.split(gappy.whiten(tables))])
    np.testing.assert_array_equal(gappy.row(3, values), want)
    assert want.shape == (700,)
    np.testing.assert_array_equal(gappy.row_cases(), np.concatenate([np.tile(c, 6) for c in gappy.case]))
    vector = np.arange(float(sum(m.size for m in gappy.measured)))
    first, second = gappy.split(vector)
    np.testing.assert_array_equal(first, np.arange(1800.0).reshape(6, 300))
    np.testing.assert_array_equal(second, 1800.0 + np.arange(2400.0).reshape(6, 400))
    assert gappy.loss(vector[:4]) == 0.0 + 1.0 + 4.0 + 9.0
    difference = [m - s for m, s in zip(gappy.measured, gappy.simulate([]), strict=True)]
    residual, got = gappy.residual([])
    np.testing.assert_array_equal(residual, gappy.whiten(difference))
    np.testing.assert_array_equal(got[1], difference[1])


# Noise.


def resting(n: int, level: float, memory: float = 0.0, seed: int = 0) -> FloatArray:
    e = level * np.random.default_rng(seed).standard_normal((n, 6))
    for i in range(1, n):
        e[i] += memory * e[i - 1]
    return e


def test_noise_without_a_memory_is_its_level() -> None:
    """Of a fine block the level over the square root of its samples; never below the floor."""
    o = Observation('x', RIG, np.zeros((6000, 6)), np.zeros((6000, 3)))
    rows = resting(6000, 2e-3)
    floors = np.array([1e-5, 1e-5, 5e-3, 1e-5, 1e-5, 1e-5])
    model = estimate_noise(o, rows, 4, floors)
    assert model.coloured == (False,) * 6
    assert model.sigma[[0, 1, 3, 4, 5]] == pytest.approx(np.full(5, 2e-3), rel=0.05)
    assert model.sigma[2] == 5e-3
    np.testing.assert_allclose(model.innovation, model.sigma / 2.0)
    np.testing.assert_allclose(model.block_sigma, model.sigma / math.sqrt(20.0))
    assert not model.ar.any()
    assert model.ar.shape == (6, 2)
    assert model.rest_seconds == pytest.approx(6.0)


@pytest.mark.parametrize(('n', 'known'), [(400, False), (420, True)])
def test_a_memory_is_observed_in_more_than_400_samples_at_rest(n: int, known: bool) -> None:
    o = Observation('x', RIG, np.zeros((n, 6)), np.zeros((n, 3)))
    model = estimate_noise(o, resting(n, 1e-3, 0.8), 4, np.full(6, 1e-6))
    assert all(model.coloured) == any(model.coloured) == known


@pytest.mark.parametrize(('clear', 'others'), [(3, False), (4, True)])
def test_a_weak_memory_counts_if_most_of_the_channels_have_a_clear_one(clear: int, others: bool) -> None:
    """Amplifiers are alike. The weak one is 3.1 standard errors, a clear one 23; without any it is less than 2."""
    n = 6000
    o = Observation('x', RIG, np.zeros((n, 6)), np.zeros((n, 3)))
    rows = resting(n, 1e-3, 0.04, 5)
    rows[:, :clear] = resting(n, 1e-3, 0.3)[:, :clear]
    rows[:, 5] = resting(n, 1e-3)[:, 5]
    for c in range(6):
        correlation = float(rows[1:, c] @ rows[:-1, c] / (rows[:, c] @ rows[:, c])) * math.sqrt(n)
        assert correlation > 5.0 if c < clear else abs(correlation) < 2.0 if c == 5 else 2.0 < correlation < 5.0
    model = estimate_noise(o, rows, 4, np.full(6, 1e-6))
    assert model.coloured == tuple(c < clear or (others and c < 5) for c in range(6))


def test_a_memory_of_noise_is_that_of_its_process() -> None:
    """x = 0.7 x- + e: the deviation of means over 4 and over 20 samples, and how well one block tells the next."""
    n, memory = 30_000, 0.7
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
    # A level below the floor has no memory.
    floor = np.full(6, 2.0 * sigma)
    assert estimate_noise(o, rows, 4, floor).coloured == (False,) * 6


# Starting values.


def test_a_line_is_refined_to_a_thousandth_of_its_bin() -> None:
    n = 8192
    t = np.arange(n) * 1e-3
    rows = 1e-6 * np.random.default_rng(0).standard_normal((n, 6))
    for f in (57.3171, 12.0461, 201.9):
        tone = rows.copy()
        tone[:, 2] += np.sin(2 * np.pi * f * t + 1.0)
        (peak, *_) = proposals.spectral_peaks([tone], [np.ones(6)], [1e-3])
        assert peak == pytest.approx(f, abs=2e-3 / (n * 1e-3))
    # The same in a recording of another rate.
    (peak, *_) = proposals.spectral_peaks([tone], [np.ones(6)], [2e-3])
    assert peak == pytest.approx(201.9 / 2.0, abs=1e-3 / (n * 1e-3))


@pytest.mark.parametrize(
    ('n', 'f', 'size', 'observed'),
    [
        (8192, 1.5, 1.0, False),
        (8192, 2.3, 1.0, True),
        # Of a short recording the first four bins are none: a tone in the third spreads into the next, too.
        (256, 2.0 / 0.256, 10.0, False),
        (256, 4.0 / 0.256, 3.0, True),
    ],
)
def test_below_two_hertz_is_no_line(n: int, f: float, size: float, observed: bool) -> None:
    rows = np.random.default_rng(0).standard_normal((n, 6))
    rows[:, 1] += size * np.sin(2 * np.pi * f * np.arange(n) * 1e-3)
    found = proposals.spectral_peaks([rows], [np.ones(6)], [1e-3])
    assert any(abs(p - f) < 1.0 / (n * 1e-3) for p in found) == observed


def test_a_line_stands_forty_times_above_the_median() -> None:
    """White noise of one level in all bins but one: so many times their power."""
    n = 1024
    for times, observed in ((41.0, 1), (39.0, 0)):
        phases = np.exp(2j * np.pi * np.random.default_rng(0).random(n // 2 + 1))
        spectrum = phases.copy()
        rows = np.fft.irfft(spectrum, n)
        window = np.hanning(n)
        power = np.abs(np.fft.rfft(rows * window)) ** 2
        power[:4] = 0.0
        tone = np.cos(2 * np.pi * 200.0 * np.arange(n) / n + np.angle(np.fft.rfft(rows * window)[200]))
        own = np.abs(np.fft.rfft(tone * window)[200])
        need = math.sqrt(times * float(np.median(power[4:]))) - math.sqrt(power[200])
        full = (rows + need / own * tone)[:, None]
        found = proposals.spectral_peaks([full], [np.ones(1)], [1e-3])
        assert len(found) == observed


def test_a_line_persists_if_its_quarters_are_alike() -> None:
    """Their sum is more than 0.7 of their sizes' sum, and each more than 0.4 of the mean."""
    t = np.arange(4000) * 1e-3

    def steady(*quarters: complex) -> bool:
        rows = np.zeros((4000, 2))
        size = np.repeat(np.array(quarters), 1000)
        rows[:, 0] = np.real(size * np.exp(2j * np.pi * 50.0 * t))
        return proposals.persistent([50.0], [rows], [np.ones(2)], [1e-3]) == [50.0]

    assert steady(1, 1, 1, 1)
    assert steady(1, 1, 1, 0.35)
    assert not steady(1, 1, 1, 0.32)
    for angle, there in ((0.78, True), (0.81, False)):
        # Two quarters turned either way: the cosine of the angle is left.
        rotated = complex(math.cos(angle), math.sin(angle))
        assert steady(rotated, rotated.conjugate(), rotated, rotated.conjugate()) == there
    # A constant is no line, and every recording must have it.
    rows = np.full((4000, 2), 3.0)
    rows[:, 0] += np.sin(2 * np.pi * 50.0 * t)
    assert proposals.persistent([50.0], [rows, np.zeros((4000, 2))], [np.ones(2)] * 2, [1e-3] * 2) == []
    rows[:, 1] += 5.0 * np.where(t < 2.0, np.sin(2 * np.pi * 50.0 * t), 0.0)
    assert proposals.persistent([50.0], [rows], [np.ones(2)], [1e-3]) == []
    # By the noise of each channel the first one has the stronger line.
    assert proposals.persistent([50.0], [rows], [np.array([0.1, 10.0])], [1e-3]) == [50.0]


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


# What the set-up may be wrong by.


def test_mistakes_and_beginnings_have_room_enough() -> None:
    """Bounds and probes: a factor up to 21, delays of 2 s, dots of 20 mm; probes far below what is seen."""
    declared = {e.name: e for e in mistakes(2, [0.04], [(1, 2, 0.5)])}
    for name in ('sensitivity', 'link_length', 'sample_rate'):
        (error,) = declared[name].parameters
        assert (error.minimum, error.maximum, error.scale, error.kind) == (-0.95, 20.0, 1e-3, 'amplitude')
        assert (declared[name].order, declared[name].point) == (98, 'configure')
    (late,) = declared['load_delay'].parameters
    assert (late.minimum, late.maximum, late.scale, late.unit) == (-2.0, 2.0, 1e-3, 's')
    # It looks at later loads too.
    assert declared['load_delay'].full
    # Before everything else that a load passes.
    assert (declared['load_delay'].order, declared['load_delay'].finite, declared['load_delay'].point) == (
        -1,
        True,
        'load',
    )
    for name, scale in (('zero', 1e-5), ('jump', 1e-6)):
        sizes = [p for p in declared[name].parameters if p.kind == 'amplitude']
        assert [(p.minimum, p.maximum, p.scale, p.unit) for p in sizes] == [(-0.02, 0.02, scale, 'm')] * len(sizes)
        assert declared[name].order == 98
        assert not declared[name].finite
    recording = declared['zero'].parameter('recording')
    assert (recording.choices, recording.minimum, recording.maximum, recording.nominal) == ((1, 2), 1, 2, 1)
    rings = beginning([0.0, 0.0, 0.0])
    assert rings.parameter('recording').choices == (1, 2, 3)
    sizes = [p for p in rings.parameters if p.kind == 'amplitude']
    assert [(p.minimum, p.maximum, p.scale, p.unit) for p in sizes] == [
        (-1.0, 1.0, 1e-6, unit) for unit in ('m', 'm', 'm', 'm', 'rad', 'rad')
    ]
    assert (rings.order, rings.point, rings.stage) == (99, 'pose', 'link')


# Signatures.


def test_signatures_of_a_design_are_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = pictures(A, B)
    plant = Plant(shown, noise())
    plant.base = (active('b', x=0.5),)
    one = Candidate(active('a', x=0.0).effect, {'x': 0.0}, ('x',), {'x': 0.0})
    bank = SignatureBank()
    (((column,),)) = bank.get(one, plant)
    np.testing.assert_allclose(column, 1e-3 * shown[A])
    asked = plant.simulations
    assert asked == 2
    # The base is that of the first call.
    plant.base = ()
    assert bank.get(one, plant)[0][0] is column
    other = Candidate(active('b', x=0.0).effect, {'x': 0.0}, ('x',), {'x': 0.0})
    np.testing.assert_allclose(bank.get(other, plant)[0][0], 1e-3 * shown[B])
    assert plant.simulations == asked + 1
    fit = refit(plant, [active('a', x=0.2)], iterations=0)
    ((listed, (((beside,),))),) = signatures_beside(plant, [other], fit)
    assert listed is other
    np.testing.assert_allclose(beside, 1e-3 * shown[B])
    keys = {Candidate(one.effect, {'x': v}, ('x',), {'x': 0.0}).key for v in (0.0, 1e-8, math.inf, math.nan, 2e-10)}
    # To nine digits; what the rig gives is one.
    assert keys == {('a', 0.0), ('a', 1e-8), ('a', 'rig')}


# Held-out load cases.


def test_a_parameter_at_its_bound_stays_there_and_a_blind_fold_moves_nothing() -> None:
    shown = pictures(A, B)
    plant = Plant(shown, 2e-4 * shown[A] + 1e-4 * shown[B] + noise())
    fit = refit(plant, [active('a', x=0.0), active('b', x=0.0)])
    stopped = dataclasses.replace(fit, at_bound=((1, 'x'),))
    fold = np.tile(plant.case[0] % 4, 6)
    matrix = columns(shown, A, B)
    for (test, step), k in zip(validate.fold_steps(plant, stopped), range(4), strict=True):
        assert test.tolist() == (fold == k).tolist()
        assert step[1] == 0.0
        rest = matrix[fold != k, 0]
        want = float(rest @ fit.residual[fold != k]) / float(rest @ rest)
        assert step[0] == pytest.approx(want, rel=1e-4)
    # The picture shows in one fold alone: without that fold there is nothing to move it by.
    only = {A: shown[A] * (np.arange(FINE) * CASES // FINE % 4 == 2)}
    plant = Plant(only, 2e-3 * only[A] + noise())
    steps = [float(s[0]) for _, s in validate.fold_steps(plant, refit(plant, [active('a', x=0.0)]))]
    assert np.abs(steps).max() < 1e-3
    tables = validate.heldout_tables(plant, refit(plant, [active('a', x=0.0)]))
    assert tables[0].shape == (6, FINE)
    fit = refit(plant, ())
    assert validate.heldout_tables(plant, fit) is fit.difference


# The verdict.


def test_standard_deviations_are_those_of_the_noise_unless_more_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    """From a gap of one and a half floors on the scatter counts if it is more."""
    shown = pictures(A, B)
    plant = Plant(shown, 2e-4 * shown[A] + noise())
    fit = refit(plant, [active('a', x=0.0), active('b', x=0.0)])
    fit = dataclasses.replace(fit, free=((-1, 'x'), (0, 'x')))
    sd = np.sqrt(np.diag(fit.covariance()))
    monkeypatch.setattr(weighing, 'scatter', lambda *_: np.array([2.0 * sd[0], 0.5 * sd[1]]))
    monkeypatch.setattr(plant, 'floor', lambda: 1.0)
    for gap, factor in ((1.49, 1.0), (1.51, 2.0)):
        monkeypatch.setattr(plant, 'gap', lambda _, gap=gap: gap)
        assert weighing.sd_of(plant, fit, -1) == {'x': pytest.approx(factor * sd[0])}
        assert weighing.sd_of(plant, fit, 0) == {'x': pytest.approx(sd[1])}
    monkeypatch.setattr(plant, 'gap', lambda _: 0.0)
    monkeypatch.setattr(plant, 'open_level', True)
    assert weighing.sd_of(plant, fit, -1) == {'x': pytest.approx(2.0 * sd[0])}


def test_what_is_tied_is_reported_in_words() -> None:
    effects = (active('a', x=0.5), active('b', x=0.5), active('c', y=0.5))
    fit = cast(Fit, SimpleNamespace(effects=effects, chi2=100.0))
    result = cast(SearchResult, SimpleNamespace(delta_chi2=[50.0, 999.0, 30.0], null=SimpleNamespace(chi2=300.0)))
    ties = [
        Coincidence(((0, 'x'), (2, 'y')), (0.12345, 0.12346), 'V', 123.4),
        Coincidence(((0, 'x'), (1, 'x')), (0.5, 0.5), '', 22.0),
    ]
    depends = tuple(
        Dependence('x2', name, 9.0, p)
        for name, p in [('u', 1e-9), ('v', 1.1e-3), ('w', 0.9e-3), ('u', 1e-9), ('p', 1e-9), ('q', 1e-9), ('r', 1e-9)]
    )
    (u,) = weighing.tied(ties, fit, result, nowhere(dependences=depends))
    assert u.signature == (
        'a and c agree in size (x 0.1235, y 0.1235 V) as independent effects hardly would (odds 123 to 1): '
        'one cause that is not in the catalogue'
    )
    assert (u.depends_on, u.unexplained, u.rms) == (('u', 'w', 'p', 'q'), False, 0.0)
    assert u.explains == pytest.approx(80.0 / 200.0)
    (u,) = weighing.tied(ties[1:], fit, result, nowhere())
    assert 'a and b agree in size (x 0.5, x 0.5) as' in u.signature
    assert u.explains == 1.0
    three = Coincidence(((0, 'x'), (1, 'x'), (2, 'y')), (0.5, 0.5, -0.5), '', 22.0)
    (u,) = weighing.tied([three], fit, result, nowhere())
    assert u.signature.startswith('a, b and c agree in size (x 0.5, x 0.5, y -0.5) as')


def test_gaps_of_channels_are_before_and_after() -> None:
    fake = cast(
        Comparison,
        SimpleNamespace(channels=('p', 'q'), gap_per_channel=lambda t: np.array([t[0], 2.0 * t[0]])),
    )
    before, after = cast(Any, ([3.0], [1.0]))
    assert weighing.per_channel_of(fake, before, after) == {'p': (3.0, 1.0), 'q': (6.0, 2.0)}
    assert weighing.heldout_per_channel_of(fake, after) == {'p': 1.0, 'q': 2.0}


# Where.


# Plans.


def test_a_recording_shows_the_distance_of_its_models_in_units_of_the_noise() -> None:
    """At another rate, in a swinging temperature, and without the effects of one recording alone."""
    ws = Workspace([make_observation(warm=None)])
    other = next(e for e in mistakes(2, [], []) if e.name == 'zero')
    base = make_active('sensor_gain', {'psd': 1, 'x': 0.01}, 't')
    ws.base = (
        base,
        ActiveEffect(other, {'recording': 1, 'of_reading': 0, 'x1': 1e-3, 'y1': 0.0, 'x2': 0.0, 'y2': 0.0}),
    )
    warm = make_active('sensor_rotation', {'psd': 2, 'angle': 0.01}, 't')
    gain = make_active('sensor_gain', {'psd': 2, 'x': 0.02}, 't')
    models = [refit(ws, [warm], iterations=0), refit(ws, [gain], iterations=0)]
    setting = Setting('', {'converter.sample_rate_hz': 500.0}, swing=3.0)
    loads = HISTORY[:400]
    before = ws.simulations
    got = experiment.expected_sums(ws, models, setting, loads)
    assert ws.simulations - before == sum(1 + len(m.free) for m in models)
    rig = replace_values(RIG, setting.changes)
    # Two samples are 4 ms here, and were four.
    sigma = ws.noise[0].innovation[:, None] * math.sqrt(4 / 2)

    def there(*effects: ActiveEffect) -> FloatArray:
        volts = ForwardModel(rig, [base, *effects]).expect(loads, setting.temperature(400)).volts
        return np.asarray((volts.reshape(6, 200, 2).mean(axis=2) / sigma).ravel())

    a, b = there(warm), there(gain)
    assert got.apart[0, 1] == got.apart[1, 0] == pytest.approx(float(((a - b) ** 2).sum()), rel=1e-9)
    assert got.apart[0, 0] == 0.0
    assert got.seconds == pytest.approx(0.8)
    slope = (there(ActiveEffect(warm.effect, {**warm.values, 'angle': 0.01 + 1e-6})) - a) / 1e-6
    assert got.fisher[0][0, 0] == pytest.approx(float(slope @ slope), rel=1e-2)
    assert got.pull[1][0][0] == pytest.approx(float(slope @ (b - a)), rel=1e-2)
    assert got.pull[0][0].tolist() == [0.0]
    # At its greatest value a parameter is moved downward, which gives the same slope.
    top = warm.effect.parameter('angle').maximum
    high = refit(ws, [ActiveEffect(warm.effect, {**warm.values, 'angle': top})], iterations=0)
    assert np.isfinite(experiment.expected_sums(ws, [high], setting, loads, rig).fisher[0]).all()


@pytest.mark.parametrize('seconds', [3.0, 6.1, 30.0])
def test_what_is_possible_is_what_the_longest_recording_shows(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """Of each setting, of whole pieces as often as they fit; and every pair of models counts."""
    offered = [Proposal(Setting('s'), Piece('push', ('constant:0,-5,0:3',)))]
    apart = np.array([[0.0, 4.0, 1.0], [3.0, 0.0, 9.0], [0.5, 9.0, 0.0]])
    none = [[np.zeros(0)] * 3] * 3
    shows: list[FloatArray] = []

    def shown(ws: object, models: object, setting: object, loads: FloatArray) -> ModelSums:
        shows.append(loads)
        return ModelSums(apart * len(loads) / 3000.0, none, [np.zeros((0, 0))] * 3, len(loads) / 1000.0)

    monkeypatch.setattr(planning, 'proposals', lambda *_: offered)
    monkeypatch.setattr(planning, 'expected_sums', shown)
    fits = [
        cast(Fit, SimpleNamespace(jacobian=np.zeros((5, 0)), free=(), effects=(active(name, x=0.1),))) for name in 'abc'
    ]
    ws = cast(Workspace, SimpleNamespace(observations=[make_observation(warm=None)]))
    plan = planning.plan_next(ws, fits[0], fits[1:], Limits(seconds=seconds))
    assert plan is not None
    times = int(seconds // 3.0)
    first, second = plan.discriminations
    assert (first.alternative, first.separation, first.reverse) == ('b', 4.0 * len(plan.pieces), 3.0 * len(plan.pieces))
    assert (second.alternative, second.separation, second.reverse) == (
        'c',
        1.0 * len(plan.pieces),
        0.5 * len(plan.pieces),
    )
    assert [first.possible, second.possible] == pytest.approx([4.0 * times, 1.0 * times])
    assert 1 <= len(plan.pieces) <= times
    found = planning.suggest(ws, fits[0], fits[1:], Limits(seconds=seconds))
    assert found is not None
    assert found.separation == min(4.0, 1.0) * len(plan.pieces)
    assert plan.limits.seconds == seconds


# Coarse steps.


@pytest.mark.parametrize(('gap', 'observed'), [(255, False), (300, True)])
def test_four_values_lie_on_a_step_by_chance_unless_it_is_very_coarse(gap: int, observed: bool) -> None:
    """Each with the chance of 2 counts in a step: their logarithms must add up to 20."""
    lsb = RIG.converter.volts_per_count
    volts = np.resize(np.arange(4.0) * gap * lsb, (1200, 6))
    assert (
        proposals.coarse_step(dataclasses.replace(make_observation(warm=None), volts=volts)) is not None
    ) == observed


def test_half_a_per_cent_of_readings_may_be_off_the_steps() -> None:
    lsb = RIG.converter.volts_per_count
    for off, observed in ((4, True), (6, False)):
        # Of a thousand values.
        counts = np.arange(1000.0) * 50.0
        counts[100 : 100 + 10 * off : 10] += 20.0
        volts = np.tile(counts[:, None] * lsb, (2, 6))
        o = dataclasses.replace(make_observation(warm=None), volts=volts, loads=np.zeros((2000, 3)), temperature=None)
        assert (proposals.coarse_step(o) is not None) == observed


# Noise that grows.


def test_wild_values_count_as_six_deviations() -> None:
    """Their energy is that of a flat spectrum, 36, of which each band has its part; nothing else is there."""
    residual = np.zeros((6, FINE))
    residual[0, 10] = 60.0
    found = localise.localise(Plant({}, noise()), residual.ravel(), None, np.random.default_rng(0), limit=6)
    for cell in found.cells:
        low, high = cell.band
        f = np.abs(np.fft.fftfreq(50, 0.004))
        dof = int(((f >= low) & (f < (high if high < 125.0 else math.inf))).sum())
        deviation = 2.0 / (9.0 * dof)
        assert (cell.channel, cell.when[0]) == ('x1', 0.0)
        assert cell.statistic == pytest.approx(((36.0 / 50.0) ** (1 / 3) - 1.0 + deviation) / math.sqrt(deviation))
        assert cell.energy == pytest.approx(3600.0 * dof / 50.0 - dof)


def test_long_recordings_are_looked_at_in_part() -> None:
    """For coarse steps, 20 000 readings: of 40 000 every second one."""
    lsb = RIG.converter.volts_per_count
    counts = np.resize(np.arange(-50.0, 50.0) * 40.0, 40_000)
    for off, observed in ((1, True), (0, False)):
        wrong = counts.copy()
        wrong[off::2] += np.resize(np.arange(1.0, 40.0), 20_000)
        o = Observation('long', RIG, np.tile(wrong[:, None] * lsb, (1, 6)), np.zeros((40_000, 3)))
        assert (proposals.coarse_step(o) is not None) == observed


def test_a_candidate_that_is_in_the_model_already_has_nothing_to_explain() -> None:
    shown = pictures(A, B)
    plant = Plant(shown, noise())
    found = [
        (Candidate(active(n, x=0.0).effect, {'x': 0.0}, ('x',), {'x': 0.0}), [[1e-3 * shown[n, 'x']]]) for n in 'ab'
    ]
    data = plant.measured[0].ravel() / SIGMA
    second, first = sorted(Screen(plant, found).score(data, columns(shown, A)), key=lambda s: s.candidate.effect.name)
    assert (second.gain, second.dof, second.p) == (0.0, 0, 1.0)
    assert first.dof == 1
