# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The bounds that the camera's campaign prints."""

from __future__ import annotations

import numpy as np
import pytest

from bench.campaign.camera import discs_picture, pose_bounds
from blind.render import Scene

pytestmark = pytest.mark.slow


def test_a_bound_of_all_pixels_is_that_of_a_mask_of_all_and_half_of_them_know_less() -> None:
    scene = Scene(width=320, height=240, focal=900.0, centre=(160.0, 120.0))
    full = np.ones((240, 320), dtype=bool)
    upper = full.copy()
    upper[120:] = False
    everything, masked, half = pose_bounds(scene, discs_picture, slice(None), full, upper)
    np.testing.assert_allclose(everything, masked)
    assert (half > everything).all()
