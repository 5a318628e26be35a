# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How dots answer to loads: least squares and means by hand."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.base.errors import RecordingError
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.check import responses as module
from psd_deflection.studies.check.responses import responses

RIG = load_rig()
GAINS = load_rig(overrides={'psd_1.sensitivity': [4e-4, 6e-4], 'psd_2.sensitivity': [5e-4, 8e-4]})
ZEROS = load_rig(overrides={'psd_1.zero': [0.001, -0.002], 'psd_2.zero': [0.002, 0.0015]})


def test_means_are_of_the_samples_that_are_there() -> None:
    samples = np.arange(16.0).reshape(8, 2)
    samples[1, 0] = samples[1:4, 1] = samples[4:8, 1] = np.nan
    wanted = np.array([[(0 + 4 + 6) / 3, 1.0], [11.0, np.nan]])
    with np.errstate(invalid='raise', divide='raise'):
        assert module.block_means(samples, 2) == pytest.approx(wanted, nan_ok=True)


def test_loads_that_always_came_together_are_one() -> None:
    steps = np.repeat([0.0, 1.0, 0.0, 2.0, 0.0, -1.0, 0.0], 10)
    other = np.roll(steps, 7)
    one = np.ones((4, 3))

    def groups(*columns: FloatArray, per: FloatArray = one) -> list[list[int]]:
        poses = np.column_stack(columns)
        return module.load_groups(poses, poses, per)

    none = np.zeros(70)
    assert groups(steps, other, none) == [[0], [1]]
    assert groups(none, none, steps) == [[2]]
    assert groups(none, steps, -2.0 * steps) == [[1, 2]]
    assert groups(steps, other, 3.0 * steps) == [[0, 2], [1]]
    assert groups(steps, 2.0 * steps, 3.0 * steps) == [[0, 1, 2]]
    # What has moved nothing yet counts for nothing.
    assert module.load_groups(np.column_stack((steps, other, none)), np.column_stack((steps, none, none)), one) == [[0]]
    # A correlation of 0.95 parts them.
    about = steps - steps.mean()
    beside = other - other.mean()
    beside -= about * (beside @ about) / (about @ about)
    beside *= np.linalg.norm(about) / np.linalg.norm(beside)
    for share, wanted in ((0.951, [[0, 1]]), (0.949, [[0], [1]]), (-0.951, [[0, 1]])):
        assert groups(about, share * about + (1.0 - share**2) ** 0.5 * beside, none) == wanted
    # The larger movement leads: what is like it joins it, and not what is like that.
    third = 0.96 * about + (1.0 - 0.96**2) ** 0.5 * beside
    fourth = 0.96 * about - (1.0 - 0.96**2) ** 0.5 * beside
    assert groups(third, about, fourth, per=np.array([[1.0, 9.0, 1.0]])) == [[0, 1, 2]]
    assert groups(third, about, fourth, per=np.array([[9.0, 1.0, 1.0]])) == [[0, 1], [2]]


def test_slopes_are_least_squares_and_memory_widens_them() -> None:
    chance = np.random.default_rng(1)
    design = np.column_stack((chance.normal(size=(200, 4)) * 1e-4, np.ones(200), np.arange(200.0) - 99.5))
    # Noise that remembers half of itself, and one that turns around.
    white = chance.normal(size=(201, 3))
    rest = np.column_stack((white[1:, 0], white[1:, 1] + 0.8 * white[:-1, 1], white[1:, 2] - 0.8 * white[:-1, 2]))
    values = design @ chance.normal(size=(6, 3)) + 1e-5 * rest
    slopes, covariance, variance = module.least_squares_fit(design, values)
    wanted, squares, _, _ = np.linalg.lstsq(design, values, rcond=None)
    assert slopes == pytest.approx(wanted, rel=1e-6)
    assert covariance == pytest.approx(np.linalg.inv(design.T @ design), rel=1e-6)
    residual = values - design @ wanted
    memory = [float(r[1:] @ r[:-1] / (r @ r)) for r in residual.T]
    widened = [(1.0 + max(m, 0.0)) / (1.0 - max(m, 0.0)) for m in memory]
    assert variance == pytest.approx(squares / (200 - 6) * widened, rel=1e-6)
    # Memory counts up to 0.98: that of a slow wave is more.
    wave = np.sin(np.arange(2000.0) / 300.0)[:, None]
    about = wave[:, 0] - wave.mean()
    assert (about[1:] @ about[:-1]) / (about @ about) > 0.99
    _, _, slow = module.least_squares_fit(np.column_stack((np.zeros((2000, 4)), np.ones(2000))), wave)
    assert slow == pytest.approx(about @ about / 1995 * 1.98 / 0.02, rel=1e-6)
    # One value more than numbers, and as many of which some count for nothing.
    for rows in (7, 4):
        some = design[:rows].copy()
        some[:, :4] *= rows > 6
        own = chance.normal(size=(rows, 1))
        r = own[:, 0] - some @ np.linalg.lstsq(some, own[:, 0], rcond=None)[0]
        colour = min(max(float(r[1:] @ r[:-1] / (r @ r)), 0.0), 0.98)
        assert module.least_squares_fit(some, own)[2] == pytest.approx(
            r @ r * (1 + colour) / (1 - colour), rel=1e-5, abs=1e-20
        )
    # What explains all leaves nothing, and no more numbers than values have a variance still.
    _, _, exact = module.least_squares_fit(np.eye(3)[:, :2], np.array([[1.0], [2.0], [0.0]]))
    assert exact == pytest.approx([0.0], abs=1e-25)
    few = np.column_stack((np.eye(2), np.zeros((2, 3))))
    assert module.least_squares_fit(few, np.ones((2, 1)))[2] == pytest.approx([0.0], abs=1e-25)


@pytest.mark.parametrize('other', [1, 2, 3])
@pytest.mark.parametrize('unit', [1e4, 1.0, 1e-4, 1e-8])
@pytest.mark.parametrize(('share', 'reported'), [(1e-5, True), (1e-7, False)])
def test_combinations_that_hardly_move_say_nothing_in_whatever_unit(
    other: int, unit: float, share: float, reported: bool
) -> None:
    chance = np.random.default_rng(2)
    along, beside = chance.normal(size=100), share * chance.normal(size=100)
    design = np.column_stack((np.zeros((100, 4)), np.ones(100), np.arange(100.0)))
    design[:, 0] = unit * along
    design[:, other] = unit * (along + beside)
    slopes, _, _ = module.least_squares_fit(design, unit * (3.0 * along + beside + 7.0)[:, None])
    # Of the difference alone that is 1; if it says nothing both have the same share.
    assert bool(abs(slopes[other, 0] - slopes[0, 0]) > 0.5) is reported
    assert slopes[4, 0] == pytest.approx(7.0 * unit, rel=1e-3)
    # Where only one dot moves a lot, the others are small beside it.
    for small, large in ((0, other), (other, 0)):
        design[:, :4] = 0.0
        design[:, small], design[:, large] = 1e-3 * unit * share * along, unit * np.cos(np.arange(100.0))
        slopes, _, _ = module.least_squares_fit(design, design[:, [small]] + 7.0 * unit)
        assert slopes[small, 0] == pytest.approx(0.0, abs=1e-3)
        assert slopes[4, 0] == pytest.approx(7.0 * unit, rel=1e-3)


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
def test_each_push_moves_the_channels_by_what_its_load_moves_at_rest(rig: Rig) -> None:
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
