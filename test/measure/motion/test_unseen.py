# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a load did unseen, against the miss computed here."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.measure.motion.modal import Oscillator
from psd_deflection.measure.motion.unseen import LARGER, UnseenLoads

MODES = (Oscillator(14.0, 0.02), Oscillator(21.0, 0.05))
SECONDS = 0.02
NO_NOISE = np.zeros((2, 2))
SURE = np.zeros((2, 4, 4))


def at_rest(at: float) -> np.ndarray:
    """The state of two axes that rest under a load."""
    return np.array([[at, 0.0, at, 0.0], [0.0] * 4])


def unseen() -> UnseenLoads:
    return UnseenLoads(MODES, SECONDS, 0.5)


def test_a_switched_load_is_held_for_each_span_that_missed_it() -> None:
    held = unseen()
    for _ in range(3):
        held.add(at_rest(0.0), SURE, NO_NOISE)
    assert not held.variances.any()
    held.add(at_rest(1e-3), SURE, NO_NOISE)
    # Spans of 1, 2 and 3 blocks end there and predicted rest; longer ones have not begun.
    expected = LARGER**2 * 1e-6 / 9.0
    np.testing.assert_allclose(held.variances[0, :3], expected * np.array([1.0, 0.0, 1.0, 0.0]) * np.ones((3, 1)))
    assert not held.variances[:, 3:].any()
    assert not held.variances[1].any()


def test_what_the_process_noise_foresaw_is_not_added() -> None:
    held = unseen()
    wide = np.tile(np.diag([4e-8, 0.0, 1e-8, 0.0]), (2, 1, 1))
    rate = np.full((2, 2), 1e-9)
    held.add(at_rest(0.0), wide, rate)
    held.add(at_rest(1e-3), wide, rate)
    mode = MODES[0]
    phi = mode.step(SECONDS)
    foreseen = phi @ wide[0] @ phi.T + 1e-9 * mode.added_covariance(np.array([SECONDS]))[0].sum(axis=0)
    expected = LARGER**2 * np.maximum(np.array([1e-6, 0.0, 1e-6, 0.0]) / 9.0 - foreseen.diagonal(), 0.0)
    assert 0.0 < expected[0] < 0.9 * LARGER**2 * 1e-6 / 9.0
    np.testing.assert_allclose(held.variances[0, 0], expected, rtol=1e-12)


def test_it_grows_evenly_from_span_to_span() -> None:
    held = unseen()
    count = held.variances.shape[1]
    # Spans of 1, 2, 3, 4, 6, 9, 13, 19 and 28 blocks.
    assert count == 9
    held.variances[:] = np.arange(1.0, count + 1.0)[:, None]
    assert held.after(0.005)[0, 0] == pytest.approx(0.25)
    assert held.after(SECONDS)[0, 0] == pytest.approx(1.0)
    assert held.after(5 * SECONDS)[1, 2] == pytest.approx(4.5)
    assert held.after(28 * SECONDS)[0, 0] == pytest.approx(9.0)
    assert held.after(10.0)[0, 3] == pytest.approx(9.0)
