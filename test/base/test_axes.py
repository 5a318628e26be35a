# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is shown of the axes of the tip."""

from __future__ import annotations

import math

import numpy as np

from psd_deflection.base.axes import ranges


def test_pose_ranges_are_in_um_and_millidegrees() -> None:
    poses = np.array([[1e-6, -2e-3, math.radians(0.5)], [3e-6, math.nan, math.radians(-0.25)], [2e-6, 1e-3, 0.0]])
    assert ranges(poses) == [
        ('ΔX', '+1.00 … +3.00 µm'),
        ('ΔY', '-2000.00 … +1000.00 µm'),
        ('θ', '-250.00 … +500.00 mdeg'),
    ]
