# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a calibration has determined so far, and what would determine the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import psd_deflection
from psd_deflection.studies.calibrate.calibrate import OPEN, ROTATED
from psd_deflection.studies.calibrate.fit import REPORTED
from psd_deflection.studies.calibrate.progress import CalibrationProgress, ParameterProgress, progress_of
from psd_deflection.studies.calibrate.result import result
from tools.program import ROOT


def calibrated(*loads: tuple[float, float, float]) -> CalibrationProgress:
    """By loads of a second each and a reference."""
    made = psd_deflection.simulate(None, [(0, 0, 0), *loads], seconds=1, seed=3)
    return progress_of(psd_deflection.calibrate(made, ROOT / 'config' / 'thesis_rig.yaml').found)


@pytest.mark.slow
def test_a_force_along_x_leaves_open_what_only_others_determine() -> None:
    along_x, all_round = calibrated((40, 0, 0)), calibrated((40, 0, 0), (0, -50, -29), (-40, 40, 20))
    assert len(along_x.parameters) == len(REPORTED)
    assert along_x.determined < all_round.determined
    for progress in (along_x, all_round):
        assert ROTATED not in [need.motion for need in progress.needs]
        for p in progress.parameters:
            assert p.determined == (p.left <= OPEN)
    of_motion = {need.motion: need.names for need in along_x.needs}
    gains = 'a motion of the dot along that axis, by forces along X and Y and a torque'
    assert 'psd_1.gain_y' in of_motion[gains]
    assert 'psd_1.gain_x' not in of_motion.get(gains, ())
    # What needs a better reference than most have comes last.
    motions = [need.motion for need in along_x.needs]
    assert motions[0] == gains
    assert 'a reference of a micrometre' in motions[-3]
    assert all(len(set(need.names)) == len(need.names) for need in along_x.needs)


@pytest.mark.parametrize(
    ('left', 'determined', 'filled'),
    [(1.0, True, 0.0), (0.1, True, 0.5), (0.01, True, 1.0), (1e-5, True, 1.0), (0.1, False, 0.0), (np.nan, True, 0.0)],
)
def test_the_bar_is_full_at_a_hundredth_of_the_tolerance(left: float, determined: bool, filled: float) -> None:
    parameter = ParameterProgress(name='n', words='', value='', left=left, determined=determined)
    assert parameter.filled == pytest.approx(filled)


def test_a_rejection_is_in_the_file_and_none_is_null() -> None:
    made = psd_deflection.simulate(None, [(0, 0, 0), (40, 0, 0)], seconds=1, seed=3)
    found = psd_deflection.calibrate(made, ROOT / 'config' / 'thesis_rig.yaml').found
    assert result(replace(found, rejected=''), '2026-11-26')['rejected'] is None
    assert result(replace(found, rejected='worse than before'), '2026-11-26')['rejected'] == 'worse than before'
