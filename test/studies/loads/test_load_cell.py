"""Loads that a load cell measured: noise goes, motion stays."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.studies.loads.load_cell import without_cell_noise

DWELL = 4000
LEVELS = np.array(
    [(0, 0, 0), (0, -20, 0), (0, -50, 0), (0, -50, -29), (30, 0, 0), (40, -40, 20), (0, -30, 0), (0, 0, 0)], float
)
HUNG = np.repeat(LEVELS, DWELL, axis=0)
NUMBER = np.arange(len(HUNG))


def test_a_load_cell_is_averaged_between_steps_and_motion_is_not() -> None:
    noise = np.random.default_rng(1).normal(size=HUNG.shape) * (0.05, 0.05, 0.0)
    calm, measured = without_cell_noise(HUNG + noise)
    assert np.abs(calm - HUNG).max() < 5.0 * 0.05 / np.sqrt(DWELL)
    # The first two have no step between them that stands out of nothing.
    assert [m.first for m in measured] == [i * DWELL for i in range(len(LEVELS))]
    assert measured[0].sd == pytest.approx([0.05 / np.sqrt(DWELL)] * 2 + [0.0], rel=0.1)
    swept = HUNG + np.sin(NUMBER / 30.0)[:, None]
    still, none = without_cell_noise(swept)
    assert np.array_equal(still, swept)
    assert none == ()
    assert without_cell_noise(HUNG)[1] == ()
