# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the viewers draw: by hand for the thesis rig."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.model.plate.scene import bend, tip_boxes
from psd_deflection.rig.config import load_rig


def test_the_link_bends_as_under_a_force_at_its_tip() -> None:
    """EI y'' = F (L - z), y(0) = y'(0) = 0: integrated twice, over the deflection of the tip."""
    z = np.linspace(0.0, 1.0, 2001)
    slope = np.concatenate([[0.0], np.cumsum((1.0 - (z[1:] + z[:-1]) / 2.0) * np.diff(z))])
    y = np.concatenate([[0.0], np.cumsum((slope[1:] + slope[:-1]) / 2.0 * np.diff(z))])
    np.testing.assert_allclose(bend(z), y / y[-1], atol=1e-6)


def test_the_plate_holds_the_detectors() -> None:
    plate, first, second = tip_boxes(load_rig(overrides={'psd_2.height': 0.02, 'psd_1.active_area': [0.008, 0.009]}))
    # Detectors at (0, 70) and (-100, 0) mm, 15 mm of plate around them and the axis.
    assert plate[0] == pytest.approx((-0.05, 0.035, 0.003))
    assert plate[1] == pytest.approx((0.13, 0.10, 0.004))
    assert first[0] == pytest.approx((0.0, 0.07, 0.0))
    assert first[1] == pytest.approx((0.008, 0.009, 0.002))
    assert second[0] == pytest.approx((-0.1, 0.0, 0.02))
