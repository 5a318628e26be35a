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


def test_the_plate_reaches_to_detectors_on_every_side_of_the_axis() -> None:
    places = {'psd_1.center': [-0.02, -0.05], 'psd_2.center': [0.06, 0.03], 'psd_3.center': [0.01, -0.08]}
    plate, *detectors = tip_boxes(load_rig(overrides=places))
    # From -20 to 60 and from -80 to 30 mm, and 15 mm around.
    assert plate[0] == pytest.approx((0.02, -0.025, 0.003))
    assert plate[1] == pytest.approx((0.11, 0.14, 0.004))
    assert [d[0][:2] for d in detectors] == [(-0.02, -0.05), (0.06, 0.03), (0.01, -0.08)]
