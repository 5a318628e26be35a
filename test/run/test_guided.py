# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The guided check on a live rig: the simulated one on its pseudo-terminal, and a port where nothing is."""

from __future__ import annotations

from typing import Any

import pytest

from psd_deflection.base.errors import DeviceError
from psd_deflection.base.log import null_log, texts
from psd_deflection.rig.config import load_rig
from psd_deflection.run.guided import run_guided
from psd_deflection.studies.check.result import WRONG

pytestmark = pytest.mark.slow


def test_the_simulated_rig_and_hand_show_a_wrong_wiring() -> None:
    logged: list[str] = []
    shown: list[float] = []
    world = load_rig(overrides={'psd_1.axes': ['-y', 'x'], 'psds_exchanged': True})
    found = run_guided(load_rig(), world, texts(logged.append), lambda guide: shown.append(guide.progress))
    assert found.verdict == WRONG
    assert dict(found.values) == {'psds_exchanged': True, 'psd_1.axes': ['-y', 'x']}
    prompts = [text[:12] for text in logged if text.startswith(('Leave', '1 of', '2 of', '3 of', 'Let go'))]
    assert prompts == ['Leave the li', '1 of 3: Push', 'Let go.', '2 of 3: Push', 'Let go.', '3 of 3: Turn', 'Let go.']
    assert max(shown) > 0.9


def test_a_port_where_nothing_is_is_rejected(tmp_path: Any) -> None:
    rig = load_rig(overrides={'port': str(tmp_path / 'nothing')})
    with pytest.raises(DeviceError, match='no such port'):
        run_guided(rig, rig, null_log, lambda guide: None)
