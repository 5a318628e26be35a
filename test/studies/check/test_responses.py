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
from psd_deflection.studies.check.responses import responses

RIG = load_rig()
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
