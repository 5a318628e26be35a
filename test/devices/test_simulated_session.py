# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``source:`` without a port starts the rig behind the simulated device of that name, as a process."""

from __future__ import annotations

import pytest

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.base.log import null_log, texts
from psd_deflection.rig.config import load_rig
from psd_deflection.run.session import Session
from test.heard import WAIT_S
from test.run.conftest import Estimates

SLOW: dict[str, object] = {'converter.sample_rate_hz': 25.0, 'block_size': 2, 'min_samples': 1}


@pytest.mark.slow
@pytest.mark.parametrize(
    ('source', 'overrides', 'described'),
    [
        ('dataq', {}, 'DATAQ DI-2108'),
        ('lines', {}, 'text lines'),
        ('thorlabs', SLOW, 'Thorlabs KPA101 and KPA101'),
    ],
)
def test_estimates_come_of_every_device(source: str, overrides: dict[str, object], described: str) -> None:
    logged: list[str] = []
    estimates = Estimates(4)
    session = Session(load_rig(overrides={'source': source, **overrides}), texts(logged.append))
    try:
        session.processing.sinks.append(estimates)
        session.start()
        assert estimates.enough.wait(WAIT_S)
    finally:
        session.close()
    assert session.failed is None
    assert session.pipeline.counters.estimates >= 4
    assert any(described in s for s in logged)
    # An answer may come too late on a busy machine; nothing else may be amiss.
    assert set(session.acquisition.counters.bad_frames) <= {'answered too late for its slot', 'no answer in time'}


def test_a_rate_that_the_pair_cannot_do_ends_before_it_begins() -> None:
    with pytest.raises(DeviceError, match=r'converter\.sample_rate_hz = 1000 is out of reach'):
        Session(load_rig(overrides={'source': 'thorlabs'}), null_log)


def test_a_device_without_a_twin_needs_a_port() -> None:
    with pytest.raises(ConfigError, match='name the recording'):
        Session(load_rig(overrides={'source': 'replay'}), null_log)
