# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Levels, drift, answers to loads, wirings, and the verdict and findings on them: of volts that are made by hand."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check import result as module
from psd_deflection.studies.check import wirings
from psd_deflection.studies.check.checkup import CheckProblem, check, responses
from psd_deflection.studies.check.result import CANNOT_TELL, RIGHT, WRONG, Checkup, Levels, levels
from psd_deflection.studies.loads.annotated_times import CorrectedNote

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
    measured = levels(RIG, volts)
    for channel in range(6):
        v = volts[:, channel]
        rough = [v[i + 3] - 3.0 * v[i + 2] + 3.0 * v[i + 1] - v[i] for i in range(797)]
        rough = [r for r in rough if math.isfinite(r)]
        # A deviation is 1.4826 medians; four of them, and of the converter's step at least.
        most = 4.0 * max(1.4826 * float(np.median(np.abs(rough))), STEP)
        clipped = [min(max(r, -most), most) for r in rough]
        # The variance of 1, 3, 3, 1 times white noise is 20.
        wanted = math.sqrt(sum(c * c for c in clipped) / len(clipped) / 20.0)
        assert measured.noise[channel] == pytest.approx(wanted)
    assert measured.sums == pytest.approx(np.nanmean(volts[:, [2, 5]], axis=0))
    assert measured.stuck == ()
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
        assert levels(load_rig(overrides={'amplifier.noise': noise}), volts).stuck == stuck


def test_one_sample_has_no_noise() -> None:
    measured = levels(RIG, noisy(1))
    assert measured.noise.tolist() == [0.0] * 6
    assert measured.sums == pytest.approx(noisy(1)[0, [2, 5]])


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
    # Nor is what is below a quarter of the noise.
    for level, observed in ((0.0195, True), (0.0205, False)):
        hum = module.mains_hum(waves(4000, 1000.0, {50.0: 5e-3}), 1000.0, np.full(6, level))[1]
        assert bool(hum.any()) is observed


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
    before, after = ForwardModel(rig, steady=True).run(np.array([(0.0, 0.0, 0.0), load])).true_dots.T
    return np.asarray(after - before)


@pytest.mark.parametrize('rig', [RIG, GAINS, ZEROS], ids=['alike', 'other sensitivities', 'dots beside the centre'])
def test_push_moves_channels_as_its_load_does_at_rest(rig: Rig) -> None:
    loads = held((0, 0, 0), (5, 0, 0), (0, 0, 0), (0, 8, 0), (0, -10, 0), (0, 0, 3), (0, 0, 0))
    volts = of_loads(rig, loads)
    # A drift of 1 um/s on x2.
    volts[:, 3] += 1e-6 / 5e-4 * np.arange(len(loads)) * 1e-3
    volts[1000:1100] = np.nan
    volts[:, [0, 1, 3, 4]] += np.random.default_rng(1).normal(0.0, 1e-4, (len(loads), 4))
    response = responses(rig, volts, loads)
    assert [p.loads for p in response.pushes] == [('fx',), ('fy',), ('tz',)]
    # The largest of each is told, with the sign of the way that the push is named.
    for push, load in zip(response.pushes, ((5.0, 0.0, 0.0), (0.0, -10.0, 0.0), (0.0, 0.0, 3.0)), strict=True):
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
    assert response.drift == pytest.approx([0.0, 0.0, 1e-6, 0.0], abs=2e-8)
    assert (np.abs(response.drift - (0.0, 0.0, 1e-6, 0.0)) < 5.0 * response.drift_sd).all()
    assert (response.drift_sd < 2e-8).all()


def test_loads_that_came_together_are_reported_at_their_largest() -> None:
    for most, more, way in (((0, -4, -2), (0, -3.9, -2.2), -1.0), ((0, -4, 2), (0, -3.9, 2.2), -1.0)):
        loads = held((0, 0, 0), more, most, (0, -2, 0.5 * most[2]), (0, 0, 0))
        (push,) = responses(RIG, of_loads(RIG, loads), loads).pushes
        assert (push.loads, push.name) == (('fy', 'tz'), '+Y with +θ')
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
) -> wirings.PushResponse:
    values = np.array(channels), np.array(sd or [1e-3] * 4), np.array(expected or channels)
    return wirings.PushResponse(loads, *values, only_twist=only_twist, scales=scales)


def test_a_pattern_is_unknown_for_psds_at_the_base() -> None:
    rig = load_rig(overrides={'psd_1.zero': [0.002, -0.01], 'psd_2.zero': [0.01, 0.004]})
    # x_i = -X + ly θ, y_i = -Y - lx θ, of beams at (0 + 2, 70 - 10) and (-100 + 10, 0 + 4) mm.
    wanted = np.array([[-1, 0, 0.06], [0, -1, -0.002], [-1, 0, 0.004], [0, -1, 0.09]])
    assert wirings.pattern(rig) == pytest.approx(wanted)
    base = load_rig(overrides={'solver': 'base_pair', 'psd_1.height': -0.5, 'psd_2.height': -0.4})
    with pytest.raises(ConfigError, match='PSDs at the base'):
        wirings.pattern(base)
    gains = load_rig(overrides={'psd_1.sensitivity': [4e-4, 6e-4], 'psd_2.sensitivity': [5e-4, 8e-4]})
    assert wirings.scales_of(gains) == pytest.approx((0.8, 1.2, 1.0, 1.6))


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
    assert push([3.0, 4.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0]).match(PLAIN) == pytest.approx((0.64, 1.5))
    assert push([-3.0, 0.0, 0.0, 4.0], [2.0, 0.0, 0.0, 0.0]).match(PLAIN) == pytest.approx((0.64, -1.5))
    # In metres of the PSD first: twice x1 and half y1 are (6, 2).
    scaled = push([3.0, 4.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], scales=(2.0, 0.5, 1.0, 1.0))
    assert scaled.match(PLAIN) == pytest.approx((4.0 / 40.0, 3.0))
    # Of a turn the difference of the dots: (3 - 1, 4 - 0) along (2 - 0, 0).
    twist = push([3.0, 4.0, 1.0, 0.0], [2.0, 0.0, 0.0, 0.0], only_twist=True)
    assert twist.match(PLAIN) == pytest.approx((16.0 / 20.0, 1.0))
    # With the wiring turned the PSDs see x1 = -y2, y1 = x2, x2 = x1, y2 = y1.
    assert push([7.0, 8.0, 3.0, 4.0], [-4.0, 3.0, 7.0, 8.0]).match(ROTATED) == pytest.approx((0.0, 1.0), abs=1e-12)


def of_plate(*rows: tuple[str, float], lean: float = 0.0) -> list[wirings.PushResponse]:
    """Pushes of so many m or rad that a plate answers to; ``lean``: share of a right angle's other axis."""
    plate = {'fx': [-1.0, 0.0, -1.0, 0.0], 'fy': [0.0, -1.0, 0.0, -1.0], 'tz': [0.07, 0.0, 0.0, 0.1]}
    other = {'fx': 'fy', 'fy': 'fx', 'tz': 'fx'}
    out = []
    for load, size in rows:
        moved = size * (np.array(plate[load]) + lean * np.array(plate[other[load]]))
        out.append(wirings.PushResponse((load,), moved, np.full(4, 1e-6), np.array(plate[load])))
    return out


def test_three_pushes_leave_one_wiring_and_two_leave_several() -> None:
    fits = wirings.fitting_wirings(of_plate(('fx', 1.0), ('fy', 1.0), ('tz', 10.0)))
    assert [(f.wiring, f.reversed_loads) for f in fits] == [(PLAIN, ())]
    assert fits[0].residual == pytest.approx(0.0, abs=1e-12)
    # Along X and Y both PSDs move alike: they may be exchanged.
    both = wirings.fitting_wirings(of_plate(('fx', 1.0), ('fy', 1.0)))
    assert [f.wiring for f in both] == [PLAIN, Wiring(exchanged=True)]
    assert wirings.fitting_wirings([]) != []
    # The one load that went the other way, of two and of three.
    for rows in ([('fx', 1.0), ('tz', -10.0)], [('fx', 1.0), ('fy', 1.0), ('tz', -10.0)]):
        assert {f.reversed_loads for f in wirings.fitting_wirings(of_plate(*rows))} <= {('tz',), ('fx',), ('fx', 'fy')}


def test_wirings_have_two_wrong_psds_or_all_alike() -> None:
    nominal = Wiring(axes=(('x', 'y'),) * 3)
    each = [wiring.axes[0] for wiring in wirings.WIRINGS[:64:8]]
    all_of_three = set(itertools.product(each, repeat=3))
    few = {a for a in all_of_three if sum(axes != ('x', 'y') for axes in a) <= 2 or len(set(a)) == 1}
    tried = wirings.wirings_of(nominal)
    assert len(tried) == len(set(tried)) == 4 * len(few)
    for swap in ((False, ()), (True, ()), (False, (1, 3)), (False, (2, 3))):
        assert {w.axes for w in tried if (w.exchanged, w.crossed) == swap} == few
    assert tried[0] == nominal
    assert wirings.wirings_of(Wiring()) is wirings.WIRINGS


def test_each_difference_has_the_line_that_puts_it_right() -> None:
    right = wirings.parameters(ROTATED, PLAIN)
    assert [wirings.fix_of(d, ROTATED, right) for d in wirings.differences(ROTATED, PLAIN)] == [
        'psds_exchanged: true',
        'psd_1.axes: [-y, x]',
        'psd_1.axes: [-y, x]',
    ]
    # The file has x1 turned for PSD 1, and PSDs are exchanged: PSD 2, which is on input 1, is right as it is.
    now, file = Wiring(exchanged=True), Wiring(False, (('-x', 'y'), ('x', 'y')))
    assert wirings.differences(now, file) == [
        wirings.Difference('psd_swap', 'psd_1 psd_2'),
        wirings.Difference('channel_sign', 'x1'),
    ]
    assert (
        wirings.fix_of(wirings.Difference('channel_sign', 'x1'), now, wirings.parameters(now, file))
        == "psd_2.axes: [x, 'y']"
    )
    assert wirings.fix_of(wirings.Difference('channel_sign', 'y2'), now, {}) == "psd_1.axes: [x, 'y']"
    other = Wiring(True, (('x', '-y'), ('y', 'x')))
    assert wirings.fix_of(wirings.Difference('channel_sign', 'x1'), other, {}) == "psd_2.axes: ['y', x]"
    assert wirings.fix_of(wirings.Difference('channel_sign', 'x2'), other, {}) == 'psd_1.axes: [x, -y]'
    assert (wirings.line('a', 0.5), wirings.line('a', False)) == ('a: 0.5', 'a: false')


STATED = math.hypot(2e-3, 20.0 / 2**16 / math.sqrt(12.0))
PLATE = {'fx': [-1.0, 0.0, -1.0, 0.0], 'fy': [0.0, -1.0, 0.0, -1.0], 'tz': [0.07, 0.0, 0.0, 0.1]}
"""How x1 y1 x2 y2 of PSDs at (0, 70) and (-100, 0) mm move by a metre along X, along Y and by a radian."""


def push_of(
    load: str, size: float = 1.0, wiring: Wiring | None = None, *, sized: bool = True, sd: float = 1e-6
) -> wirings.PushResponse:
    """A movement of ``size`` times the expected one, some tenths of a millimetre, on the channels of ``wiring``."""
    expected = (1e-4 if load != 'tz' else 1e-3) * np.array(PLATE[load])
    moved = wirings.on_channels(wiring or Wiring(), size * expected)
    return wirings.PushResponse((load,), moved, np.full(4, sd), expected, sized=sized)


THREE = [push_of('fx'), push_of('fy'), push_of('tz')]


def of_levels(
    noise: float | FloatArray = STATED,
    sums: tuple[float, float] = (5.0, 5.0),
    hum: Sequence[float] = (0.0,) * 6,
    stuck: tuple[str, ...] = (),
    steps: Sequence[float] = (0.0,) * 6,
    hum_hz: float = 50.0,
) -> Levels:
    return Levels(np.zeros(6) + noise, STATED, np.array(hum), hum_hz, np.array(sums), stuck, np.array(steps))


def checked(
    pushes: Sequence[wirings.PushResponse] = THREE,
    levels: Levels | None = None,
    drift: Sequence[float] = (0.0,) * 4,
    drift_sd: float = 1e-9,
    rig: Rig = RIG,
    notes: Sequence[CorrectedNote] = (),
) -> Checkup:
    drifting = np.array(drift), np.full(4, drift_sd)
    return check(CheckProblem(rig, pushes, levels or of_levels(), *drifting, source='x', notes=notes))


def of(checkup: Checkup) -> list[tuple[str, str]]:
    return [(f.name, f.where) for f in checkup.findings]


def test_channel_below_a_tenth_of_every_push_is_dead() -> None:
    def with_share(share: float, only_twist: bool = False) -> Checkup:
        fx = replace(push_of('fx'), channels=np.array([share, 0.0, math.sqrt(1.0 - share**2), 0.0]) * -1e-4)
        tz = replace(push_of('tz'), channels=np.array([0.0, 0.0, 0.0, 1e-4]), only_twist=only_twist)
        return checked([fx, push_of('fy'), tz])

    assert of(with_share(0.099)) == [('stuck_channel', 'x1')]
    assert with_share(0.099).findings[0].fix == 'x1 does not answer: look at its cable'
    assert ('stuck_channel', 'x1') not in of(with_share(0.101))
    # Of 1, 3, 9 and 3 the first is a tenth of the whole: that is an answer.
    tenth = replace(push_of('fx'), channels=np.array([1.0, 3.0, 9.0, 3.0]) * -1e-4)
    assert ('stuck_channel', 'x1') not in of(checked([tenth, push_of('fy')]))
    # A turn by hand says nothing of it, and without pushes along both axes nobody knows.
    rotated = replace(push_of('tz'), only_twist=True)
    dead = replace(push_of('fx'), channels=np.array([0.0, 0.0, -1e-4, 0.0]))
    assert of(checked([dead, push_of('fy'), rotated])) == [('stuck_channel', 'x1')]
    assert ('stuck_channel', 'x1') not in of(checked([dead, push_of('fy'), push_of('tz')]))
    assert ('stuck_channel', 'x1') not in of(checked([dead, rotated]))


def test_stuck_channel_is_reported_once_without_wiring() -> None:
    dead = replace(push_of('fx'), channels=np.array([0.0, 0.0, -1e-4, 0.0]))
    checkup = checked([dead, push_of('fy')], of_levels(stuck=('x1', 'sum2')))
    assert (of(checkup), checkup.verdict) == ([('stuck_channel', 'x1'), ('stuck_channel', 'sum2')], WRONG)
    rotated = Wiring(False, (('-x', 'y'), ('x', 'y')))
    three = [push_of(load, 9.80665, rotated) for load in ('fx', 'fy', 'tz')]
    assert of(checked(three, of_levels(stuck=('sum2',)))) == [('stuck_channel', 'sum2')]


def test_a_wrong_wiring_has_its_lines_only_if_it_is_the_only_one() -> None:
    wiring = Wiring(False, (('-x', 'y'), ('x', 'y')))
    three = [push_of(load, 1.0, wiring) for load in ('fx', 'fy', 'tz')]
    checkup = checked(three)
    assert (of(checkup), dict(checkup.values)) == ([('channel_sign', 'x1')], {'psd_1.axes': ['-x', 'y']})
    # By the file a push along X is opposite on x1, which leaves all of it; one turn is opposite, too.
    assert checkup.findings[0].evidence == pytest.approx(1.0 + 1.0 - 0.0, abs=0.7)
    assert checkup.findings[0].evidence > 1.0
    assert checkup.findings[0].equivalent == ()
    two = checked(three[:2])
    assert (two.verdict, dict(two.values), len(two.wirings)) == (WRONG, {}, 2)
    assert two.findings[0].equivalent == ('1 other wiring, which these pushes cannot tell apart',)
    single = checked(three[:1])
    count = len(single.wirings) - 1
    assert count > 1
    assert single.findings[0].equivalent == (f'{count} other wirings, which these pushes cannot tell apart',)


def test_all_signs_turned_may_be_the_loads_as_well() -> None:
    wiring = Wiring(False, (('-x', '-y'), ('-x', '-y')))
    checkup = checked([push_of(load, 1.0, wiring) for load in ('fx', 'fy', 'tz')])
    assert {f.equivalent for f in checkup.findings} == {('load_sign of fx fy tz',)}
    # By the file each push goes the other way and leaves nothing of its own: three that are not explained at all.
    assert [f.evidence for f in checkup.findings] == pytest.approx([3.0] * 4)
    # If one of the loads went the other way too, only the others are turned: half as far as expected.
    other = checked([push_of('fx', 1.0, wiring), push_of('fy', 1.0, wiring), push_of('tz', -0.5, wiring)])
    assert ('load_sign of fx fy',) in {f.equivalent for f in other.findings}
    # A push that leans leaves 0.04 of 1.04 of the best one as well.
    lean = replace(push_of('fx', 1.0, wiring), channels=np.array([1.0, 0.2, 1.0, 0.2]) * 1e-4)
    checkup = checked([lean, *(push_of(load, 1.0, wiring) for load in ('fy', 'tz'))])
    assert [f.evidence for f in checkup.findings] == pytest.approx([3.0 - 0.04 / 1.04] * 4)
    # A push that leans leaves 0.36 of it, beyond the limit: then the loads are no other explanation.
    lean = replace(push_of('fx', 1.0, wiring), channels=np.array([1.0, 0.75, 1.0, 0.75]) * 1e-4)
    checkup = checked([lean, *(push_of(load, 1.0, wiring) for load in ('fy', 'tz'))])
    assert not any('load_sign' in text for f in checkup.findings for text in f.equivalent)


def test_a_load_of_the_other_sign_is_reported() -> None:
    checkup = checked([push_of('fx'), push_of('fy'), push_of('tz', -1.0)])
    assert [(f.name, f.where, f.value, f.fix) for f in checkup.findings] == [
        ('load_sign', 'tz', -1.0, 'load_tz in the recording has the wrong sign')
    ]
    assert checkup.sizes == pytest.approx([1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ('size', 'reported'),
    [
        *((1.09, ''), (1.11, '1.11'), (0.92, ''), (0.9, '0.90'), (2.05, '2.05'), (0.48, '0.48'), (-1.2, '1.20')),
        (-1.05, ''),
    ],
)
def test_a_push_a_tenth_too_large_is_noted(size: float, reported: str) -> None:
    checkup = checked([push_of('fx'), push_of('fy'), push_of('tz', size)])
    words = (
        f'+θ: the dots move {reported} times what the rig file expects; see its link and amplifier.sensitivity '
        '(`psd-deflection discover` names the cause)'
    )
    assert checkup.notes == ((words,) if reported else ())
    # By hand nobody knows how far.
    assert checked([push_of('fx'), push_of('fy'), push_of('tz', size, sized=False)]).notes == ()


@pytest.mark.parametrize(
    ('pushes', 'where', 'fix'),
    [
        ([push_of('fx'), push_of('fy')], 'tz', 'record again with a torque about Z alone too'),
        ([push_of('fy'), push_of('tz')], 'fx', 'record again with a load along X alone too'),
        ([push_of('fx')], 'fy tz', 'record again, one after the other: a load along Y alone, a torque about Z alone'),
        (
            [],
            'fx fy tz',
            'record again, one after the other: a load along X alone, a load along Y alone, a torque about Z alone',
        ),
        (
            [push_of('fx'), push_of('fy'), push_of('tz', sd=1.0)],
            'tz',
            '+θ does not stand out of the noise: push harder',
        ),
        (
            [push_of('fx', sd=1.0), push_of('fy', sd=1.0), push_of('tz')],
            'fx fy',
            '+X and +Y do not stand out of the noise: push harder',
        ),
    ],
)
def test_what_is_missing_is_asked_for(pushes: list[wirings.PushResponse], where: str, fix: str) -> None:
    checkup = checked(pushes)
    assert checkup.verdict == CANNOT_TELL
    assert [(f.name, f.where, f.value, f.fix) for f in checkup.findings] == [('load_coverage', where, None, fix)]
    assert [math.isnan(s) for s in checkup.sizes] == [not p.observed for p in pushes]


def test_pushes_that_no_wiring_explains_are_asked_for_again() -> None:
    odd = [replace(push_of('fx'), channels=np.array([-1.0, 1.0, 1.0, 1.0]) * 1e-4), push_of('fy'), push_of('tz')]
    odd[0] = replace(odd[0], channels=np.array([-1.0, 1.0, -1.0, 1.0]) * 1e-4)
    checkup = checked(odd)
    assert (checkup.wirings, checkup.verdict) == ((), CANNOT_TELL)
    assert [(f.where, f.fix) for f in checkup.findings] == [
        ('fx fy tz', 'no wiring explains these pushes: push one way at a time, along +X, along +Y, then turn about +θ')
    ]
    # Of a wrong wiring several are left: that is wrong, and more is asked for too.
    wiring = Wiring(False, (('-x', 'y'), ('x', 'y')))
    assert of(checked([push_of('fx', 1.0, wiring), push_of('fy', 1.0, wiring)]))[-1] == ('load_coverage', 'tz')


def test_noise_is_that_of_the_psds_whatever_inputs_they_are_on() -> None:
    rig = load_rig(
        overrides={
            'psd_1.noise': [1e-3, 2e-3],
            'psd_2.noise': [4e-3, 3e-3],
            'psds_exchanged': True,
            'psd_1.axes': ['y', 'x'],
        }
    )
    wiring = Wiring.from_rig(rig)
    # PSD 1 is on input 2 with its axes exchanged: its x is y2. PSD 2 is on input 1.
    noise = np.array([4e-3, 3e-3, 1.0, 2e-3, 1e-3, 1.0])
    pushes = [push_of(load, 1.0, wiring) for load in ('fx', 'fy', 'tz')]
    assert checked(pushes, of_levels(noise), rig=rig).findings == ()
    noise[4] = 9e-3
    checkup = checked(pushes, of_levels(noise), rig=rig)
    assert (of(checkup), dict(checkup.values)) == ([('noise_level', 'x1')], {'psd_1.noise': [9e-3, 2e-3]})


@pytest.mark.parametrize(
    ('sums', 'light'),
    [
        ((5.0, 2.5), {}),
        ((7.5, 5.0), {}),
        ((5.0, 2.49), {'psd_2': 'too little: sum 2.49 V, below sum_min 2.5 V'}),
        ((7.51, 5.0), {'psd_1': 'too much: sum 7.51 V, above sum_max 7.5 V'}),
        ((1.0, 9.0), {'psd_1': 'too little: sum 1.00 V', 'psd_2': 'too much: sum 9.00 V'}),
    ],
)
def test_a_sum_between_its_limits_is_light_enough(sums: tuple[float, float], light: dict[str, str]) -> None:
    checkup = checked(levels=of_levels(sums=sums))
    assert list(checkup.light) == list(light)
    assert all(checkup.light[psd].startswith(words) for psd, words in light.items())
    assert checkup.verdict == (WRONG if light else RIGHT)
    # Exchanged PSDs have the light of the other input.
    rig = load_rig(overrides={'psds_exchanged': True})
    other = [push_of(load, 1.0, Wiring(exchanged=True)) for load in ('fx', 'fy', 'tz')]
    assert {f'psd_{3 - int(psd[-1])}' for psd in checked(other, of_levels(sums=sums), rig=rig).light} == {*light}
    # One that is stuck is told already.
    assert not checked(levels=of_levels(sums=sums, stuck=('sum1', 'sum2'))).light


@pytest.mark.parametrize(
    ('level', 'reported'), [(5.74, False), (5.76, True), (4.35, False), (4.34, True), (7.5, True), (7.6, False)]
)
def test_a_sum_that_is_off_by_fifteen_per_cent_is_worth_a_look(level: float, reported: bool) -> None:
    checkup = checked(levels=of_levels(sums=(5.0, level)))
    words = f'psd_2: sum {level:.2f} V, the rig file says 5 V; see amplifier.sum_nominal'
    assert checkup.notes == ((words,) if reported else ())


@pytest.mark.parametrize(
    ('drift', 'sd', 'note'),
    [
        ((0.0, 5.1, 0.0, 0.0), 0.06, '+5.1 µm a minute on y1'),
        ((0.0, 4.9, 0.0, 0.0), 0.06, ''),
        # The farthest of those that stand out.
        ((6.0, 0.0, -7.0, 0.0), 0.06, '-7.0 µm a minute on x2'),
        # Beyond five deviations, and of a short recording nothing.
        ((0.0, 0.0, 0.0, 7.1), 1.4, '+7.1 µm a minute on y2'),
        ((0.0, 0.0, 0.0, 7.1), 1.5, ''),
        ((0.0, 0.0, 0.0, 26.0), 4.99, '+26.0 µm a minute on y2'),
        ((0.0, 0.0, 0.0, 26.0), 5.01, ''),
    ],
)
def test_drift_beyond_5_um_a_minute_and_5_sd_is_noted(drift: tuple[float, ...], sd: float, note: str) -> None:
    minute = 1e-6 / 60.0
    notes = checked(drift=[minute * d for d in drift], drift_sd=minute * sd).notes
    assert notes == ((f'drift: {note}; let lasers and amplifier warm up',) if note else ())


def test_hum_is_noted_where_it_is_largest() -> None:
    hum = (0.0, 1e-3, 0.0, 4e-3, 0.0, 2e-3)
    words = 'hum: 4.0 mV at 60 Hz on x2; look at shielding and ground'
    assert checked(levels=of_levels(hum=hum, hum_hz=60.0)).notes == (words,)
