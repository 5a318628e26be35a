# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Noise, hum, light, answers to loads and what each wiring explains: of volts and pushes that are made by hand."""

import math

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check import result as module
from psd_deflection.studies.check.checkup import responses
from psd_deflection.studies.check.result import levels
from psd_deflection.studies.check.wirings import (
    Difference,
    PushResponse,
    differences,
    fitting_wirings,
    fix_of,
    line,
    parameters,
    pattern,
    scales_of,
)

RIG = load_rig()
STEP = 20.0 / 2**16


def noisy(n: int, sd: float = 2e-3, seed: int = 1) -> FloatArray:
    return np.array([1.0, 2.0, 5.0, -1.0, 0.5, 4.0]) + np.random.default_rng(seed).normal(0.0, sd, (n, 6))


def test_stated_noise_has_four_channels_and_the_converter() -> None:
    assert levels(RIG, noisy(100)).stated == pytest.approx(math.hypot(2e-3, STEP / math.sqrt(12.0)))
    each = load_rig(overrides={'psd_1.noise': [1e-3, 2e-3], 'psd_2.noise': [4e-3, 3e-3]})
    mean = math.sqrt((1.0 + 4.0 + 16.0 + 9.0) / 4.0) * 1e-3
    assert levels(each, noisy(100)).stated == pytest.approx(math.hypot(mean, STEP / math.sqrt(12.0)))


def test_noise_is_that_of_third_differences() -> None:
    volts = noisy(800)
    volts[400:] += 0.3
    volts[::90] -= 0.5
    volts += 1e-6 * np.arange(800.0)[:, None] ** 2
    volts[[100, 333]] = np.nan
    found = levels(RIG, volts)
    for channel in range(6):
        v = volts[:, channel]
        rough = [v[i + 3] - 3.0 * v[i + 2] + 3.0 * v[i + 1] - v[i] for i in range(797)]
        rough = [r for r in rough if math.isfinite(r)]
        # A deviation is 1.4826 medians; four of them, and of the converter's step at least.
        most = 4.0 * max(1.4826 * float(np.median(np.abs(rough))), STEP)
        clipped = [min(max(r, -most), most) for r in rough]
        # The variance of 1, 3, 3, 1 times white noise is 20.
        wanted = math.sqrt(sum(c * c for c in clipped) / len(clipped) / 20.0)
        assert found.noise[channel] == pytest.approx(wanted)
    assert found.sums == pytest.approx(np.nanmean(volts[:, [2, 5]], axis=0))
    assert found.stuck == ()
    # Of samples between lost ones nothing is told, and the least is the converter's step.
    alone = np.where(np.arange(30)[:, None] % 3 == 0, noisy(30), np.nan)
    assert levels(RIG, alone).noise.tolist() == [0.0] * 6
    still = np.zeros((900, 6))
    still[450:] = 1.0
    assert levels(RIG, still).noise == pytest.approx(math.sqrt((1 + 4 + 1) * 16 / 897 / 20) * STEP, rel=0.5)


def test_constant_channel_is_stuck_if_noise_moves_bits() -> None:
    volts = noisy(200)
    volts[:, [1, 5]] = 0.25
    assert levels(RIG, volts).stuck == ('y1', 'sum2')
    # Noise of one step of the converter moves none for sure.
    for noise, stuck in ((STEP, ()), (1.01 * STEP, ('y1', 'sum2'))):
        quiet = load_rig(overrides={'amplifier.noise': noise})
        assert levels(quiet, volts).stuck == stuck


def test_one_sample_has_no_noise() -> None:
    found = levels(RIG, noisy(1))
    assert found.noise.tolist() == [0.0] * 6
    assert found.sums == pytest.approx(noisy(1)[0, [2, 5]])


def waves(n: int, rate: float, amplitudes: dict[float, float]) -> FloatArray:
    """Volts (n, 6); the mains only on y1."""
    t = np.arange(n) / rate
    out = np.random.default_rng(3).normal(0.0, 1e-3, (n, 6)) + 2.0
    for hz, size in amplitudes.items():
        out[:, 1] += size * np.sin(2.0 * math.pi * hz * t + 0.7)
    return out


def test_hum_is_the_amplitude_of_the_mains_that_stands_out_more() -> None:
    noise = np.full(6, 1e-3)
    hz, hum = module.mains_hum(waves(4000, 1000.0, {50.0: 2e-3, 60.0: 5e-3}), 1000.0, noise)
    assert hz == 60.0
    assert hum[1] == pytest.approx(5e-3, rel=0.03)
    assert hum[[0, 2, 3, 4, 5]].tolist() == [0.0] * 5
    hz, hum = module.mains_hum(waves(4000, 1000.0, {50.0: 5e-3, 60.0: 2e-3}), 1000.0, noise)
    assert (hz, hum[1]) == (50.0, pytest.approx(5e-3, rel=0.03))
    # Without any it is that of the first.
    hz, hum = module.mains_hum(waves(4000, 1000.0, {}), 1000.0, noise)
    assert (hz, hum.tolist()) == (50.0, [0.0] * 6)


@pytest.mark.parametrize(('noise', 'observed'), [(0.0195, True), (0.0205, False)])
def test_hum_below_a_quarter_of_the_noise_is_none(noise: float, observed: bool) -> None:
    volts = waves(4000, 1000.0, {50.0: 5e-3})
    assert bool(module.mains_hum(volts, 1000.0, np.full(6, noise))[1].any()) is observed


@pytest.mark.parametrize(
    ('n', 'rate', 'observed'), [(1000, 1000.0, True), (999, 1000.0, False), (600, 150.0, True), (600, 149.0, False)]
)
def test_hum_needs_a_second_and_2_5_samples_a_period(n: int, rate: float, observed: bool) -> None:
    hz, hum = module.mains_hum(waves(n, rate, {50.0: 0.1}), rate, np.full(6, 1e-3))
    assert hz == 50.0
    assert bool(hum[1] > 0.0) is observed
    assert len(hum) == 6


GAINS = load_rig(overrides={'psd_1.sensitivity': [4e-4, 6e-4], 'psd_2.sensitivity': [5e-4, 8e-4]})
ZEROS = load_rig(overrides={'psd_1.zero': [0.001, -0.002], 'psd_2.zero': [0.002, 0.0015]})


def of_loads(rig: Rig, loads: FloatArray) -> FloatArray:
    """What the device reads (n, 6), V, without noise."""
    return np.asarray(ForwardModel(rig).expect(loads).volts.T, dtype=np.float64)


def held(*levels: tuple[float, float, float], count: int = 800) -> FloatArray:
    return np.repeat(np.array(levels, float), count, axis=0)


def at_rest(rig: Rig, load: tuple[float, float, float]) -> FloatArray:
    """How far a load moves the dots (4,), m."""
    before, after = ForwardModel(rig, settled=True).run(np.array([(0.0, 0.0, 0.0), load])).true_dots.T
    return np.asarray(after - before)


@pytest.mark.parametrize('rig', [RIG, GAINS, ZEROS], ids=['alike', 'other sensitivities', 'dots beside the centre'])
def test_push_moves_channels_as_its_load_does_at_rest(rig: Rig) -> None:
    loads = held((0, 0, 0), (5, 0, 0), (0, 0, 0), (0, 8, 0), (0, -10, 0), (0, 0, 3), (0, 0, 0))
    volts = of_loads(rig, loads)
    # A drift of 1 um/s on x2.
    volts[:, 3] += 1e-6 / 5e-4 * np.arange(len(loads)) * 1e-3
    volts[1000:1100] = np.nan
    volts[:, [0, 1, 3, 4]] += np.random.default_rng(1).normal(0.0, 1e-4, (len(loads), 4))
    found = responses(rig, volts, loads)
    assert [p.loads for p in found.pushes] == [('fx',), ('fy',), ('tz',)]
    # The largest of each is told, with the sign of the way that the push is named.
    for push, load in zip(found.pushes, ((5.0, 0.0, 0.0), (0.0, -10.0, 0.0), (0.0, 0.0, 3.0)), strict=True):
        moved = np.sign(sum(load)) * at_rest(rig, load)
        assert push.expected == pytest.approx(moved, abs=1e-9)
        observed = push.channels * np.array(push.scales)
        assert observed == pytest.approx(moved, abs=1e-7)
        assert (np.abs(observed - moved) < 5.0 * push.sd).all()
        # 1e-4 V of noise are 50 nm a sample, of some hundred samples a few.
        assert (push.sd < 2e-8).all()
        assert (push.sd > 5e-10).all()
        assert push.sized
        assert push.scales == pytest.approx((rig.sensitivities.ravel() / 5e-4).tolist())
    assert found.drift == pytest.approx([0.0, 0.0, 1e-6, 0.0], abs=2e-8)
    assert (np.abs(found.drift - (0.0, 0.0, 1e-6, 0.0)) < 5.0 * found.drift_sd).all()
    assert (found.drift_sd < 2e-8).all()


def test_loads_that_came_together_are_reported_at_their_largest() -> None:
    for most, more, way in (((0, -4, -2), (0, -3.9, -2.2), -1.0), ((0, -4, 2), (0, -3.9, 2.2), -1.0)):
        loads = held((0, 0, 0), more, most, (0, -2, 0.5 * most[2]), (0, 0, 0))
        (push,) = responses(RIG, of_loads(RIG, loads), loads).pushes
        assert push.loads == ('fy', 'tz')
        assert push.name == '+Y with +θ'
        # The first that is named says where it is largest, and its way.
        assert push.expected == pytest.approx(way * at_rest(RIG, most), abs=1e-9)
        assert push.channels == pytest.approx(push.expected, abs=1e-7)


def test_eight_blocks_are_the_fewest() -> None:
    loads = np.zeros((179, 3))
    volts = np.random.default_rng(1).normal(size=(179, 6))
    assert responses(RIG, volts, loads).pushes == ()
    lost = volts.copy()
    lost[:20, 1] = np.nan
    with pytest.raises(RecordingError, match=r'^7 blocks of samples: at least 8 are needed'):
        responses(RIG, lost, loads)
    with pytest.raises(RecordingError, match='7 blocks'):
        responses(RIG, volts[:159], loads[:159])
    # Eight of nine are enough, and of a block one sample is.
    lost = np.vstack((volts, volts))[:180]
    lost[:20] = np.nan
    assert responses(RIG, lost, np.zeros((180, 3))).pushes == ()
    lost[:19] = np.nan
    lost[19] = 1.0
    assert responses(RIG, lost[:160], np.zeros((160, 3))).pushes == ()


PLAIN = Wiring()
ROTATED = Wiring(True, (('-y', 'x'), ('x', 'y')))
"""PSD 1 is on input 2: its x is y2 turned, its y is x2. PSD 2 is on input 1 as it should be."""


def push(
    channels: list[float],
    expected: list[float] | None = None,
    loads: tuple[str, ...] = ('fx',),
    *,
    sd: list[float] | None = None,
    only_twist: bool = False,
    scales: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0),
) -> PushResponse:
    return PushResponse(
        loads,
        np.array(channels),
        np.array(sd or [1e-3] * 4),
        np.array(expected or channels),
        only_twist=only_twist,
        scales=scales,
    )


def test_a_pattern_is_unknown_for_psds_at_the_base() -> None:
    rig = load_rig(overrides={'psd_1.zero': [0.002, -0.01], 'psd_2.zero': [0.01, 0.004]})
    # x_i = -X + ly θ, y_i = -Y - lx θ, of beams at (0 + 2, 70 - 10) and (-100 + 10, 0 + 4) mm.
    wanted = np.array([[-1, 0, 0.06], [0, -1, -0.002], [-1, 0, 0.004], [0, -1, 0.09]])
    assert pattern(rig) == pytest.approx(wanted)
    base = load_rig(overrides={'solver': 'base_pair', 'psd_1.height': -0.5, 'psd_2.height': -0.4})
    with pytest.raises(ConfigError, match='PSDs at the base'):
        pattern(base)
    gains = load_rig(overrides={'psd_1.sensitivity': [4e-4, 6e-4], 'psd_2.sensitivity': [5e-4, 8e-4]})
    assert scales_of(gains) == pytest.approx((0.8, 1.2, 1.0, 1.6))


@pytest.mark.parametrize(
    ('channels', 'sd', 'only_twist', 'observed'),
    [
        # Six deviations; exactly six are not beyond. Of four channels their mean square counts: 4/4 = 1.
        ([6.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], False, False),
        ([6.01, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], False, True),
        ([0.0, 5.0, 0.0, 3.4], [1.0, 1.0, 1.0, 1.0], False, True),
        ([0.0, 5.0, 0.0, 3.3], [1.0, 1.0, 1.0, 1.0], False, False),
        # A difference of two has twice the variance: 36 + 36 is not beyond 36 * 2.
        ([6.0, 0.0, 0.0, 6.0], [1.0, 1.0, 1.0, 1.0], True, False),
        ([6.01, 0.0, 0.0, 6.0], [1.0, 1.0, 1.0, 1.0], True, True),
        # What both dots share does not count.
        ([100.0, 50.0, 100.0, 50.0], [1.0, 1.0, 1.0, 1.0], True, False),
    ],
)
def test_a_push_is_observed_beyond_six_deviations(
    channels: list[float], sd: list[float], only_twist: bool, observed: bool
) -> None:
    assert push(channels, sd=sd, only_twist=only_twist).observed is observed


def test_unexplained_share_is_square_outside_pattern() -> None:
    # (3, 4) along (2, 0): 1.5 times as large, and 16 of 25 are left.
    assert push([3.0, 4.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]).misfit(PLAIN) == pytest.approx((0.64, 1.5))
    assert push([-3.0, 0.0, 0.0, 4.0], [2.0, 0.0, 0.0, 0.0]).misfit(PLAIN) == pytest.approx((0.64, -1.5))
    # In metres of the PSD first: twice x1 and half y1 are (6, 2).
    scaled = push([3.0, 4.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], scales=(2.0, 0.5, 1.0, 1.0))
    assert scaled.misfit(PLAIN) == pytest.approx((4.0 / 40.0, 3.0))
    # Of a turn the difference of the dots: (3 - 1, 4 - 0) along (2 - 0, 0).
    turn = push([3.0, 4.0, 1.0, 0.0], [2.0, 0.0, 0.0, 0.0], only_twist=True)
    assert turn.misfit(PLAIN) == pytest.approx((16.0 / 20.0, 1.0))
    # With the wiring turned the PSDs see x1 = -y2, y1 = x2, x2 = x1, y2 = y1.
    assert push([7.0, 8.0, 3.0, 4.0], [-4.0, 3.0, 7.0, 8.0]).misfit(ROTATED) == pytest.approx((0.0, 1.0), abs=1e-12)


def of_plate(*rows: tuple[str, float], lean: float = 0.0) -> list[PushResponse]:
    """Pushes of so many m or rad that a plate answers to; ``lean``: share of a right angle's other axis."""
    plate = {'fx': [-1.0, 0.0, -1.0, 0.0], 'fy': [0.0, -1.0, 0.0, -1.0], 'tz': [0.07, 0.0, 0.0, 0.1]}
    other = {'fx': 'fy', 'fy': 'fx', 'tz': 'fx'}
    out = []
    for load, size in rows:
        moved = size * (np.array(plate[load]) + lean * np.array(plate[other[load]]))
        out.append(PushResponse((load,), moved, np.full(4, 1e-6), np.array(plate[load])))
    return out


def test_three_pushes_leave_one_wiring_and_two_leave_several() -> None:
    found = fitting_wirings(of_plate(('fx', 1.0), ('fy', 1.0), ('tz', 10.0)))
    assert [(f.wiring, f.reversed_loads) for f in found] == [(PLAIN, ())]
    assert found[0].misfit == pytest.approx(0.0, abs=1e-12)
    # Along X and Y both PSDs move alike: they may be exchanged.
    both = fitting_wirings(of_plate(('fx', 1.0), ('fy', 1.0)))
    assert [f.wiring for f in both] == [PLAIN, Wiring(exchanged=True)]
    assert fitting_wirings([]) != []
    # The one load that went the other way, of two and of three.
    for rows in ([('fx', 1.0), ('tz', -10.0)], [('fx', 1.0), ('fy', 1.0), ('tz', -10.0)]):
        assert {f.reversed_loads for f in fitting_wirings(of_plate(*rows))} <= {('tz',), ('fx',), ('fx', 'fy')}


def test_each_difference_has_the_line_that_puts_it_right() -> None:
    right = parameters(ROTATED, PLAIN)
    assert [fix_of(d, ROTATED, right) for d in differences(ROTATED, PLAIN)] == [
        'psds_exchanged: true',
        'psd_1.axes: [-y, x]',
        'psd_1.axes: [-y, x]',
    ]
    # The file has x1 turned for PSD 1, and PSDs are exchanged: PSD 2, which is on input 1, is right as it is.
    now, file = Wiring(exchanged=True), Wiring(False, (('-x', 'y'), ('x', 'y')))
    assert differences(now, file) == [Difference('psd_swap', 'psd_1 psd_2'), Difference('channel_sign', 'x1')]
    assert fix_of(Difference('channel_sign', 'x1'), now, parameters(now, file)) == "psd_2.axes: [x, 'y']"
    assert fix_of(Difference('channel_sign', 'y2'), now, {}) == "psd_1.axes: [x, 'y']"
    other = Wiring(True, (('x', '-y'), ('y', 'x')))
    assert fix_of(Difference('channel_sign', 'x1'), other, {}) == "psd_2.axes: ['y', x]"
    assert fix_of(Difference('channel_sign', 'x2'), other, {}) == 'psd_1.axes: [x, -y]'
    assert line('a', 0.5) == 'a: 0.5'
    assert line('a', False) == 'a: false'
