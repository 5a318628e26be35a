# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Samples that were lost just as a load began to act."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.loads.annotated_times import correct_loads

RIG = load_rig()
LEVELS = np.array([(0, 0, 0), (0, -20, 0), (0, -50, -29), (30, 0, 0), (20, -40, 12), (0, 0, 0)], float)
DWELL = 5000
APPLIED = np.repeat(LEVELS, DWELL, axis=0)
READ = np.asarray(RigSimulator(RIG, 3).step(APPLIED).counts * RIG.converter.volts_per_count, dtype=np.float64)
DOTS = READ[:, [0, 1, 3, 4]] * RIG.sensitivities.ravel()
LATE = (2.3, 0.9, 3.1, 1.7, 2.6)


def annotated() -> FloatArray:
    out = np.zeros_like(APPLIED)
    for i, late in enumerate(LATE, start=1):
        out[i * DWELL + round(1000 * late) :] = LEVELS[i]
    return out


def reported(dots: FloatArray) -> list[float]:
    corrected = correct_loads(RIG, dots, annotated())
    assert corrected is not None
    return [note.delay for note in corrected.timed]


@pytest.mark.slow
@pytest.mark.parametrize(('lost', 'share'), [(80, 0.98), (150, 0.5), (450, 0.02), (1500, 0.5)])
def test_time_in_lost_samples_is_found_by_ringing(lost: int, share: float) -> None:
    dots = DOTS.copy()
    first = 2 * DWELL - round(share * lost)
    dots[first : first + lost] = np.nan
    assert reported(dots) == pytest.approx(LATE, abs=2e-3)


def test_samples_lost_between_the_steps_change_no_time() -> None:
    dots = DOTS.copy()
    for at in range(2000, 27_000, 5000):
        dots[at : at + 1200] = np.nan
    assert reported(dots) == pytest.approx(LATE, abs=1e-3)


@pytest.mark.slow
def test_equal_delays_after_lost_samples_are_corrected() -> None:
    """Rows of a CSV have the load: after a loss it seems to begin late."""
    dots, after = DOTS.copy(), APPLIED.copy()
    for at in range(DWELL, len(APPLIED), DWELL):
        dots[at - 100 : at + 200] = np.nan
        after[at : at + 200] = APPLIED[at - 1]
    corrected = correct_loads(RIG, dots, after)
    assert corrected is not None
    assert [note.delay for note in corrected.notes] == pytest.approx([0.2] * 5, abs=2e-3)
    assert correct_loads(RIG, dots, APPLIED) is None
