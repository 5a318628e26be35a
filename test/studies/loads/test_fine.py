# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Means of a few samples: by hand."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.rig.config import load_rig
from psd_deflection.studies.loads.fine import FINE_SECONDS, fine_means

ROWS = np.array([[1.0, 2.0, 6.0, 4.0, 5.0, 9.0, 100.0], [0.0, 3.0, 0.0, -1.0, -2.0, -3.0, 7.0]])


def test_a_mean_is_over_so_many_samples_and_what_is_left_at_the_end_has_none() -> None:
    assert fine_means(ROWS, 3) == pytest.approx(np.array([[3.0, 6.0], [1.0, -2.0]]))
    assert fine_means(ROWS, 1) == pytest.approx(ROWS)


def test_only_samples_that_are_there_count_and_a_mean_of_none_is_0() -> None:
    present = np.array([[1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], [1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0]])
    assert fine_means(ROWS, 3, present) == pytest.approx(np.array([[3.5, 0.0], [1.0, -3.0]]))


def test_a_fine_mean_is_several_samples_and_a_small_part_of_the_fastest_period() -> None:
    rig = load_rig()
    assert FINE_SECONDS * rig.converter.sample_rate_hz >= 2.0
    assert FINE_SECONDS * rig.dynamics.torsion_frequency <= 0.1
