# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Input shapers, against a mode that is simulated by scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from psd_deflection.arms.shapers import KINDS, TOLERATED, recommended, shaper

RATE = 1000.0


def ringing(command: np.ndarray, hertz: float, zeta: float, after: float) -> float:
    """Largest deviation of a mode from where it comes to rest, later than ``after``, s."""
    w = 2.0 * np.pi * hertz
    t = np.arange(len(command)) / RATE
    _, moved, _ = lsim(([w * w], [1.0, 2.0 * zeta * w, w * w]), command, t, interp=False)
    return float(np.abs(moved[t > after] - command[-1]).max())


@pytest.mark.parametrize(('kind', 'left'), [('zv', 0.01), ('mzv', 0.01), ('zvd', 0.01), ('ei', 1.3 * TOLERATED)])
def test_the_mode_comes_to_rest(kind: str, left: float) -> None:
    found = shaper(kind, 14.0, 0.02)
    step = np.where(np.arange(2000) >= 100, 1.0, 0.0)
    shaped = found.shaped(step, RATE)
    assert shaped[-1] == pytest.approx(1.0)
    end = 0.101 + found.duration
    assert ringing(shaped, 14.0, 0.02, end) < left
    assert ringing(step, 14.0, 0.02, end) > 0.7


@pytest.mark.parametrize('kind', KINDS)
def test_the_residual_is_what_a_simulation_leaves(kind: str) -> None:
    found = shaper(kind, 14.0, 0.0)
    step = np.where(np.arange(3000) >= 100, 1.0, 0.0)
    for hertz in (11.0, 13.0, 15.5):
        simulated = ringing(found.shaped(step, RATE), hertz, 1e-6, 0.101 + found.duration)
        assert found.residual(hertz, 0.0)[0] == pytest.approx(simulated, abs=0.01)


def test_a_wrong_frequency_is_forgiven_in_this_order() -> None:
    left = {kind: float(shaper(kind, 14.0, 0.01).residual(15.4, 0.01)[0]) for kind in KINDS}
    assert left['zv'] > left['mzv'] > left['zvd'] > left['ei']


def test_the_recommended_one_is_the_shortest_that_suffices() -> None:
    found = recommended(14.0, 0.001, 0.02)
    band = np.linspace(0.95 * 14.0, 1.05 * 14.0, 21)
    assert found.residual(band, 0.02).max() <= TOLERATED
    shorter = [shaper(k, 14.0, 0.02) for k in KINDS if shaper(k, 14.0, 0.02).duration < found.duration]
    assert shorter
    assert all(s.residual(band, 0.02).max() > TOLERATED for s in shorter)
    assert recommended(14.0, 0.7, 0.02).duration > found.duration


def test_each_column_is_shaped() -> None:
    command = np.column_stack([np.arange(50.0), np.zeros(50)])
    shaped = shaper('zv', 100.0, 0.0).shaped(command, RATE)
    # Half now, half 5 ms later: 2.5 samples behind.
    assert shaped[20:, 0] == pytest.approx(command[20:, 0] - 2.5)
    assert (shaped[:, 1] == 0.0).all()


def test_an_unknown_kind_is_named() -> None:
    with pytest.raises(ValueError, match="'zvddd' is no shaper; there are zv, mzv, zvd, ei"):
        shaper('zvddd', 14.0, 0.0)
