# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is shown of the axes of the tip."""

from __future__ import annotations

import math
import re

import numpy as np

from psd_deflection.base.axes import ranges
from tools.program import ROOT


def test_the_range_of_poses_is_in_micrometres_and_thousandths_of_a_degree() -> None:
    poses = np.array([[1e-6, -2e-3, math.radians(0.5)], [3e-6, math.nan, math.radians(-0.25)], [2e-6, 1e-3, 0.0]])
    assert ranges(poses) == [
        ('ΔX', '+1.00 … +3.00 µm'),
        ('ΔY', '-2000.00 … +1000.00 µm'),
        ('θ', '-250.00 … +500.00 mdeg'),
    ]


def test_no_other_file_has_a_factor_of_its_own() -> None:
    own = re.compile(r'degrees\(1e3\)|180e3|1e3 \* 180|(rad2deg|degrees)\([\w.]+\) \* 1e3')
    files = (ROOT / 'psd_deflection').rglob('*.py')
    assert [p.name for p in files if own.search(p.read_text())] == ['axes.py']
