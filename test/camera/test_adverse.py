# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Short form of ``make campaign NAME=camera``: no answer is further off than five of its own standard deviations."""

from __future__ import annotations

import pytest

from bench.campaign.camera import SIGMAS, off_by, runs
from psd_deflection.camera.answer import Status

pytestmark = pytest.mark.slow


def test_a_bad_frame_is_rejected_or_right() -> None:
    found = [(hurt, off_by(answer, truth)) for hurt, answer, truth in runs(24, 3) if answer.status is Status.OK]
    assert len(found) >= 5
    assert [f for f in found if f[1] > SIGMAS] == []
