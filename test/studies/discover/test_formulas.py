# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The formulas of discover, piece by piece, against the same thing written in another way."""

import dataclasses
import itertools
import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from psd_deflection.base.errors import RecordingError
from psd_deflection.model.simulation import loads
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import Observation, load_cases
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.discover import experiment
from psd_deflection.studies.discover.cleaning import clean, stuck
from psd_deflection.studies.discover.experiment import Limits, ModelSums, nothing_of, pieces, settings
from psd_deflection.studies.discover.noise import NoiseModel, rest_windows, strip_lines
from psd_deflection.studies.discover.search.comparison import energies, gain_beyond
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.workspace import Workspace

RIG = load_rig()
PUSHES = [(0.0, 0.0, 0.0), (5.0, -20.0, -9.0), (-10.0, 10.0, 12.0), (0.0, 0.0, 0.0)]
HISTORY = loads.steps(PUSHES, 0.3).loads
WARM = 21.0 + np.linspace(0.0, 2.0, len(HISTORY)) ** 2


def make_observation(
    seed: int = 0, effects: tuple[ActiveEffect, ...] = (), name: str = 'seen', **given: Any
) -> Observation:
    """1.2 s of the rig with white noise of its own level."""
    history, warm = given.pop('history', HISTORY), given.pop('warm', WARM)
    volts = ForwardModel(RIG, list(effects)).run(history, warm).volts
    volts += RIG.noises.ravel()[:, None] * np.random.default_rng(seed).standard_normal(volts.shape)
    return Observation(name, RIG, volts.T.copy(), history, warm, **given)


@pytest.fixture(scope='module')
def workspace() -> Workspace:
    """Two recordings, the second without temperature."""
    return Workspace([make_observation(), make_observation(1, name='second', warm=None)])


def script(levels: list[tuple[float, float, float]], dwell: float) -> tuple[str, ...]:
    """Steps in the notation of ``simulate --loads``, three decimals."""

    def number(v: float) -> str:
        return f'{round(v, 3) + 0.0:g}'

    return ('steps:' + ';'.join(','.join(map(number, level)) for level in levels) + f':{dwell:g}',)


@pytest.mark.parametrize(
    ('limits', 'ends'),
    [
        (Limits(sweep=45.0), ['2,40:15']),
        (Limits(sweep=46.0), ['2,40:15', '40,46:12']),
        (Limits(sweep=30.0), ['2,30:15']),
        (Limits(sweep=2.0), []),
        (Limits(sweep=900.0), ['2,40:15', '40,400:12']),
    ],
)
def test_sweeps_reach_limit_of_exciter_and_samples(limits: Limits, ends: list[str]) -> None:
    """Up to four tenths of the sample rate."""
    chirps = [p.script[0] for p in pieces(RIG, limits) if p.script[0].startswith('chirp')]
    assert [c.split(':', 2)[2] for c in chirps] == ends


@pytest.mark.parametrize('zero', [0.0, 5e-4])
def test_loads_move_the_dots_by_four_fifths_of_their_room(zero: float) -> None:
    """A force bends by L^3/(3 EI), a torque twists by L/GJ."""
    rig = replace_values(RIG, {'psd_2.zero': [0.0, -zero], 'link.youngs_modulus': 7e9})
    link = rig.link
    bends, twists = link.length**3 / (3.0 * link.bending_stiffness), link.length / link.torsional_stiffness
    half = 0.5 * min(min(p.active_area) for p in rig.psds)
    room = 0.8 * (min(half, rig.converter.full_scale * float(rig.sensitivities.min())) - zero)
    reach = max(math.hypot(*c) for c in rig.centers.tolist())
    f, t, arm = room / bends, room / (twists * reach), 0.2
    bar = room / (bends + arm * twists * reach)
    o, h = (0.0, 0.0, 0.0), (0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0)
    signs = [(1, 1, 1), (-1, 1, -1), (-1, -1, 1), (1, -1, -1), (1, 1, -1), (-1, -1, -1)]
    corners = [(0.5 * f * a, 0.5 * f * b, 0.6 * t * c) for a, b, c in signs]
    got = [p.script for p in pieces(rig, Limits(force=1e6, torque=1e6, sidebar=arm))]
    assert got[:7] == [
        script([o, (0, -f, 0), o, (0, f, 0), o, (f, 0, 0), o, (-f, 0, 0), o], 1.5),
        script([o, (0, 0, t), o, (0, 0, -t), o], 2.0),
        script([o, *corners, o], 1.5),
        script([o, (0, -bar, -bar * arm), o, (0, -bar, bar * arm), o], 2.0),
        *(script([(s * x, s * y, s * z) for s in h], 1.5) for x, y, z in ((0, -f, 0), (f, 0, 0), (0, 0, t))),
    ]
    held = f'constant:0,{round(-0.8 * f, 3):g},{round(-0.3 * t, 3):g}:24'
    assert got[7:9] == [('constant:0,0,0:1', held, 'constant:0,0,0:14.4'), ('constant:0,0,0:30',)]
    weights = pieces(rig, Limits(force=1e6, sideways=False))[0].script
    assert weights == script([o, (0, -f, 0), o, (0, -0.5 * f, 0), o], 2.0)


def test_lesser_forces_torques_and_times_are_kept() -> None:
    limits = Limits(force=3.0, torque=0.5, sidebar=0.1, seconds=20.0)
    got = [p.script for p in pieces(RIG, limits)]
    assert got[0] == script(
        [(0, 0, 0), (0, -3, 0), (0, 0, 0), (0, 3, 0), (0, 0, 0), (3, 0, 0), (0, 0, 0), (-3, 0, 0), (0, 0, 0)], 1.5
    )
    assert script([(0, 0, 0), (0, 0, 0.5), (0, 0, 0), (0, 0, -0.5), (0, 0, 0)], 2.0) in got
    assert script([(0, 0, 0), (0, -3, -0.3), (0, 0, 0), (0, -3, 0.3), (0, 0, 0)], 2.0) in got
    assert ('constant:0,0,0:1', 'constant:0,-2.4,-0.15:12', 'constant:0,0,0:7.2') in got
    assert ('constant:0,0,0:20',) in got
    without = pieces(RIG, Limits(force=3.0, torque=0.0, sidebar=0.0, sweep=0.0))
    assert not any('N m' in p.words or 'sidebar' in p.words for p in without)
    assert len(without) == 5
    only_torque = pieces(RIG, Limits(force=0.0, torque=0.5, sweep=0.0))
    assert [p.words for p in only_torque] == [
        'pure torque of +-0.5 N m',
        '0 N along both axes with 0.3 N m, in all corners',
        'up to 0.5 N m in four steps and down again',
        '30 s unloaded',
    ] or only_torque[2].words.startswith('0 N on the sidebar')


def test_settings_are_lengths_rates_and_temperatures() -> None:
    limits = Limits(swing=4.0, lengths=(0.4, RIG.link.length, 0.9), rates=(500.0, 1000.0))
    got = settings(RIG, limits)
    assert [(s.words, dict(s.changes), s.swing) for s in got] == [
        ('', {}, 0.0),
        ('while the temperature swings by +-4 K', {}, 4.0),
        ('on a link of 0.40 m', {'link.length': 0.4}, 0.0),
        ('on a link of 0.90 m', {'link.length': 0.9}, 0.0),
        ('at 500 samples/s', {'converter.sample_rate_hz': 500.0}, 0.0),
    ]
    assert [s.effort for s in got] == [0.0, 0.03, 0.05, 0.05, 0.02]
    assert settings(RIG, Limits(swing=0.0))[1].changes == {'link.length': 0.409 if RIG.link.length == 0.585 else None}
    assert got[0].knots == [20.0]
    assert got[0].temperature(5) is None
    assert got[1].knots == [20.0, 22.0, 24.0, 22.0, 20.0, 18.0, 16.0, 18.0, 20.0]
    warm = got[1].temperature(801)
    assert warm is not None
    assert warm[[0, 100, 150, 200, 600]] == pytest.approx([20.0, 22.0, 23.0, 24.0, 16.0], abs=0.02)
    tree = experiment.limits_to_tree(limits)
    assert tree == {
        'force_n': 50.0,
        'torque_nm': 29.25,
        'sidebar_m': loads.SIDEBAR_ARM,
        'sideways': True,
        'sweep_hz': 150.0,
        'swing_k': 4.0,
        'lengths_m': [0.4, RIG.link.length, 0.9],
        'rates_hz': [500.0, 1000.0],
        'seconds': 60.0,
    }
    assert experiment.limits_to_tree(Limits())['lengths_m'] is None


def some_shown(rng: np.random.Generator, seconds: float = 2.0) -> tuple[ModelSums, list[FloatArray], list[FloatArray]]:
    """What random pictures of two models show: with no parameter, and with three."""
    rows = [rng.standard_normal(40) for _ in range(2)]
    slopes = [rng.standard_normal((40, k)) for k in (0, 3)]
    apart = np.array([[float((a - b) @ (a - b)) for b in rows] for a in rows])
    pull = [[c.T @ (a - b) for b, c in zip(rows, slopes, strict=True)] for a in rows]
    return ModelSums(apart, pull, [c.T @ c for c in slopes], seconds), rows, slopes


def test_separation_is_residual_of_both_recordings() -> None:
    """The other model adapts to the new data and to the old, whose curvature is known."""
    rng = np.random.default_rng(3)
    observed, rows, slopes = some_shown(rng)
    old = rng.standard_normal((15, 3))
    both = np.vstack((slopes[1], old))
    target = np.concatenate((rows[0] - rows[1], np.zeros(15)))
    residual = target - both @ np.linalg.lstsq(both, target, rcond=None)[0]
    assert observed.separation(0, 1, old.T @ old) == pytest.approx(float(residual @ residual), rel=1e-9)
    assert observed.separation(1, 0, np.zeros((0, 0))) == pytest.approx(observed.apart[0, 1])
    again, _, _ = some_shown(rng, 3.0)
    total = observed + again * 2.0
    assert total.seconds == 8.0
    np.testing.assert_allclose(total.apart, observed.apart + 2.0 * again.apart)
    np.testing.assert_allclose(total.fisher[1], observed.fisher[1] + 2.0 * again.fisher[1])
    np.testing.assert_allclose(total.pull[0][1], observed.pull[0][1] + 2.0 * again.pull[0][1])
    models = cast(list[Fit], [SimpleNamespace(free=()), SimpleNamespace(free=((0, 'a'), (0, 'b'), (1, 'c')))])
    nothing = nothing_of(models)
    assert nothing.seconds == 0.0
    for a, b in ((nothing + observed, observed), (observed + nothing, observed)):
        np.testing.assert_array_equal(a.apart, b.apart)
        np.testing.assert_array_equal(a.fisher[1], b.fisher[1])
        np.testing.assert_array_equal(a.pull[0][1], b.pull[0][1])


def test_energies_are_those_of_band_passed_rows(workspace: Workspace) -> None:
    """By masks on the full spectrum (Parseval); the gain in a band counts if it is beyond what may be wrong there."""
    rng = np.random.default_rng(2)
    first, other, explained = (rng.standard_normal(sum(m.size for m in workspace.measured)) for _ in range(3))
    edges = (0.0, 2.0, 9.0, 17.0, 25.0, 60.0, math.inf)

    def bands(vector: FloatArray) -> FloatArray:
        out = np.zeros((2, 6, 6))
        for r, part in enumerate(workspace.split(vector)):
            spectrum = np.abs(np.fft.fft(part, axis=1)) ** 2 / part.shape[1]
            f = np.abs(np.fft.fftfreq(part.shape[1], 0.004))
            for b, (low, high) in enumerate(itertools.pairwise(edges)):
                out[r, :, b] = spectrum[:, (f >= low) & (f < high)].sum(axis=1)
        return out

    np.testing.assert_allclose(energies(workspace, first), bands(first), rtol=1e-9, atol=1e-9)
    assert energies(workspace, first).sum() == pytest.approx(float(first @ first))
    for size in (0.0, 1.0, 300.0, 3000.0):
        gain = bands(first) - bands(other)
        allowed = 0.002**2 * size**2 * bands(explained)
        want = sum(g for g, a in zip(gain.ravel(), allowed.ravel(), strict=True) if g < 0.0 or g > a)
        assert gain_beyond(workspace, first, other, size * explained) == pytest.approx(want, rel=1e-6)


def test_folds_are_dealt_out_in_turn(workspace: Workspace) -> None:
    cases = max(int(c.max()) for c in workspace.case) + 1
    assert workspace.folds().tolist() == [i % 4 for i in range(cases)]
    assert workspace.case[1].min() == workspace.case[0].max() + 1
    single = Workspace([make_observation(history=np.zeros((400, 3)), warm=None)])
    assert single.folds().tolist() == [0, 1, 2, 3]


def test_a_load_case_begins_after_a_quarter_of_a_second_of_rest() -> None:
    rows = np.zeros((2000, 3))
    rows[100:, 0] = 1.0
    rows[349:, 1] = 2.0
    rows[599:, 2] = 3.0
    rows[1700:, 2] = 4.0
    # The second change comes 249 samples after the first, the third 250 after the second.
    assert [int(np.argmax(load_cases(rows, 1e-3) == k)) for k in range(4)] == [0, 100, 599, 1700]
    assert np.bincount(load_cases(rows[:700], 1e-3)).tolist() == [100, 499, 101]
    assert np.bincount(load_cases(np.zeros((10, 3)), 1e-3)).tolist() == [3, 2, 3, 2]


@pytest.mark.parametrize(
    ('change', 'description_of_it'),
    [
        ({'loads': np.zeros((5, 3))}, 'do not match'),
        ({'volts': np.zeros((len(HISTORY), 5))}, 'do not match'),
        ({'loads': np.full((len(HISTORY), 3), np.nan)}, 'a load is not a finite number'),
        ({'temperature': np.full(len(HISTORY), np.inf)}, 'a temperature is not a finite number'),
        ({'volts': np.zeros((79, 6)), 'loads': np.zeros((79, 3))}, '79 samples: discover needs at least 4 blocks'),
    ],
)
def test_what_is_no_recording_is_rejected(change: dict[str, Any], description_of_it: str) -> None:
    with pytest.raises(RecordingError, match=description_of_it):
        dataclasses.replace(make_observation(), **change)


def test_a_recording_knows_its_length_and_its_digest() -> None:
    o = make_observation()
    assert o.period == 1e-3
    assert o.duration == pytest.approx(1.2)
    Observation('least', RIG, np.zeros((80, 6)), np.zeros((80, 3)))
    assert o.temperature is not None
    for other in (
        dataclasses.replace(o, volts=o.volts + 1e-3),
        dataclasses.replace(o, loads=o.loads + 1.0),
        dataclasses.replace(o, temperature=o.temperature + 1.0),
        dataclasses.replace(o, temperature=None),
    ):
        assert other.hashed() != o.hashed()
    assert dataclasses.replace(o, name='other').hashed() == o.hashed()


def test_whitening_predicts_each_block_from_those_before_it() -> None:
    """By a loop; a block counts if all that its prediction needs is there, by the square root of its share."""
    rng = np.random.default_rng(4)
    fine, count = rng.standard_normal((6, 30)), rng.choice([0.0, 0.5, 1.0], (6, 30), p=[0.1, 0.2, 0.7])
    ar = np.array([[0.5, -0.2], [0.3, 0.0], [0.0, 0.4], [0.0, 0.0], [-0.6, 0.1], [0.2, 0.2]])
    innovation = rng.uniform(1.0, 2.0, 6)
    model = NoiseModel(innovation, ar, innovation, innovation, 0.0, (False,) * 6)
    want = np.zeros((6, 30))
    for c in range(6):
        for k in range(30):
            needed = [j for j in (1, 2) if ar[c, j - 1] and k >= j]
            if count[c, k] > 0.0 and all(count[c, k - j] > 0.0 for j in needed):
                rest = fine[c, k] - sum(ar[c, j - 1] * fine[c, k - j] for j in needed)
                want[c, k] = rest * math.sqrt(count[c, k]) / innovation[c]
    np.testing.assert_allclose(model.whiten(fine, count), want, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(('dwell', 'observed'), [(4.29, 2), (4.27, 1)])
def test_rest_needs_three_tenths_of_a_second_after_the_ringing(dwell: float, observed: int) -> None:
    """7/(2 pi 14 Hz 0.02) = 3.979 s after a change; nothing before it if the recording begins under load."""
    slow = min(
        RIG.dynamics.bending_frequency * RIG.dynamics.bending_damping_ratio,
        RIG.dynamics.torsion_frequency * RIG.dynamics.torsion_damping_ratio,
    )
    assert 7.0 / (2.0 * math.pi * slow) == pytest.approx(3.979, abs=1e-3)
    history = loads.steps([(0, 0, 0), (0, -10, 0)], dwell).loads
    windows = rest_windows(
        dataclasses.replace(make_observation(), volts=np.zeros((len(history), 6)), loads=history, temperature=None)
    )
    assert len(windows) == observed
    first = round(1000 * dwell)
    assert windows[0] == slice(0, first)
    if observed == 2:
        assert windows[1] == slice(first + 3978, 2 * first)
    loaded = dataclasses.replace(
        make_observation(), volts=np.zeros((5000, 6)), loads=np.ones((5000, 3)), temperature=None
    )
    assert rest_windows(loaded) == [slice(3978, 5000)]


def test_of_many_lines_the_strongest_four_are_stripped() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(4000) * 1e-3
    lines = [np.sin(2 * np.pi * f * t + f) * s for f, s in ((50, 9.0), (100, 8.0), (150, 7.0), (200, 6.0), (250, 5.0))]
    noise = rng.standard_normal(4000)
    residual = strip_lines(noise + sum(lines[:4]) + 3.0)
    assert residual.std() == pytest.approx(1.0, abs=0.05)
    assert residual.mean() == pytest.approx(0.0, abs=1e-9)
    # A line leaves nothing at its frequency and the next three on either side.
    spectrum = np.abs(np.fft.rfft(strip_lines(noise + lines[0], 1)))
    assert spectrum[[*range(1, 197), *range(204, 2000)]].min() > 1e-6
    assert spectrum[197:204].max() < 1e-9
    assert not strip_lines(np.zeros(1000)).any()
    # The fifth, 5 sin, stays: variance 12.5 more.
    assert strip_lines(noise + sum(lines)).var() == pytest.approx(1.0 + 12.5, rel=0.1)
    assert strip_lines(noise + sum(lines), 5).std() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(('count', 'is_stuck'), [(29, False), (30, True)])
def test_a_channel_is_stuck_from_three_hundredths_of_a_second_on(count: int, is_stuck: bool) -> None:
    rng = np.random.default_rng(6)
    volts = rng.standard_normal((500, 2))
    volts[100 : 100 + count, 1] = 0.1
    mask = stuck(volts, 1e-3, np.full(2, 0.01), 1e-3)
    assert not mask[:, 0].any()
    assert np.flatnonzero(mask[:, 1]).tolist() == (list(range(100, 100 + count)) if is_stuck else [])
    # At its highest and lowest it may be limited; a channel quieter than the converter's step may rest.
    for limit in (9.0, -9.0):
        high = volts.copy()
        high[100 : 100 + count, 1] = limit
        assert not stuck(high, 1e-3, np.full(2, 0.01), 1e-3).any()
    assert not stuck(volts, 1e-3, np.full(2, 1e-3), 1e-3).any()
    dead = np.full((500, 2), 0.7)
    assert stuck(dead, 1e-3, np.full(2, 0.01), 1e-3).all()
    # Eight samples at least, however slow they are taken.
    slow = rng.standard_normal((100, 1))
    slow[20:27, 0] = 0.1
    assert not stuck(slow, 1.0, np.full(1, 0.01), 1e-3).any()
    slow[20:28, 0] = 0.1
    assert stuck(slow, 1.0, np.full(1, 0.01), 1e-3).any()


def test_what_is_known_of_a_recording_is_reported() -> None:
    o = make_observation()
    reported = dataclasses.replace(o, unknown_load=(100, 50), stated_rate_hz=500.0)
    cleaned, (rate, coverage) = clean(reported, ())
    assert (rate.name, rate.where, rate.value) == ('sample_rate', 'converter.sample_rate_hz', 2.0)
    assert rate.fix == 'converter.sample_rate_hz: 1000.0'
    assert rate.evidence == pytest.approx(math.log(2.0))
    assert (coverage.name, coverage.value, coverage.evidence) == ('load_coverage', 150 / 1200, 150 / 1200)
    assert 'its first 0.10 s and its last 0.05 s' in coverage.fix
    gone = np.isnan(cleaned.volts).all(axis=1)
    assert (np.flatnonzero(gone).tolist(), cleaned.digest) == ([*range(100), *range(1150, 1200)], reported.hashed())
    for unknown, gone_samples in (((100, 0), range(100)), ((0, 100), range(1100, 1200))):
        half, (finding,) = clean(dataclasses.replace(o, unknown_load=unknown), ())
        assert finding.value == pytest.approx(100 / 1200)
        assert np.flatnonzero(np.isnan(half.volts).all(axis=1)).tolist() == list(gone_samples)
    # Up to a twentieth is left out and not told; and what is whole stays as it is.
    quiet, findings = clean(dataclasses.replace(o, unknown_load=(30, 30)), ())
    assert (findings, np.isnan(quiet.volts).all(axis=1).sum()) == ([], 60)
    assert clean(o, ())[0] is o
