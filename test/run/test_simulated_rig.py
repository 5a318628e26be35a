# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The simulated rig rests until a load is noted, which it hangs."""

import threading
from collections import deque
from collections.abc import Callable

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import null_log
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.steps import RecentDots
from psd_deflection.model.link import LinkStatics
from psd_deflection.recordings.replay.engine import replayed
from psd_deflection.records import BlockStatus, DeflectionEstimate, Record, SpotMeans
from psd_deflection.rig.config import load_rig
from psd_deflection.run.session import Session
from test.heard import WAIT_S

BLOCKS = 20


class Observed:
    """A sink; ``until`` waits for the last ``BLOCKS`` values of dY, m, to be as wanted."""

    def __init__(self) -> None:
        self._last: deque[float] = deque(maxlen=BLOCKS)
        self._changed = threading.Condition()

    def put(self, record: Record) -> None:
        if isinstance(record, DeflectionEstimate) and record.primary:
            with self._changed:
                self._last.append(record.dy)
                self._changed.notify_all()

    def until(self, wanted: Callable[[list[float]], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self._last) == BLOCKS and wanted(list(self._last)), WAIT_S)


def running(**parameters: object) -> tuple[Session, Observed]:
    session, observed = (
        Session(load_rig(overrides={'keep_zero': False, 'realtime': False, **parameters}), null_log),
        Observed(),
    )
    session.processing.sinks.append(observed)
    session.start()
    return session, observed


def test_it_hangs_what_is_noted() -> None:
    session, observed = running()
    try:
        assert session.applies_loads
        observed.until(lambda dy: max(map(abs, dy)) < 2e-6)
        # Zero gives zero: no weight hangs there when it is taken.
        assert session.zero() is not None
        assert all(abs(value) < 1e-6 for psd in session.rig.psds for value in psd.zero)
        _, sag, _ = LinkStatics.from_rig(session.rig).compliance @ [0.0, -10.0, 0.0]
        assert sag == pytest.approx(-445.43e-6, abs=0.01e-6)
        session.note_load(0.0, -10.0, 0.0)
        observed.until(lambda dy: max(abs(value - sag) for value in dy) < 3e-6)
        with pytest.raises(ValueError, match='the simulated rig applies a load when it is noted'):
            session.note_load(0.0, -20.0, 0.0, ago_s=1.0)
        session.note_load(0.0, 0.0, 0.0)
        observed.until(lambda dy: max(map(abs, dy)) < 3e-6)
    finally:
        session.close()
    session.note_load(0.0, -10.0, 0.0)


@pytest.mark.slow
def test_on_the_demo_weights_hang_in_turn() -> None:
    session, observed = running(demo=True)
    try:
        assert not session.applies_loads
        observed.until(lambda dy: min(dy) < -200e-6)
    finally:
        session.close()


RIG = load_rig()


def observed(loads: list[tuple[float, float, float]], seconds: float, lost: range = range(0)) -> RecentDots:
    """The dots under ``loads``, each held for so many s; some blocks ``lost``."""
    recent = RecentDots(RIG)
    for records in replayed(psd_deflection.simulate(RIG, loads, seconds=seconds), Pipeline(RIG)):
        for record in records:
            if isinstance(record, SpotMeans) and record.index not in lost:
                recent.put(record)
    return recent


@pytest.mark.parametrize('lost', [range(0), range(60, 80)])
def test_the_last_step_is_found_to_a_tenth_of_a_block(lost: range) -> None:
    step_ns = observed([(0, 0, 0), (0, -10, 0), (5, -10, 0)], 4.0, lost).step_ns()
    assert step_ns is not None
    assert step_ns * 1e-9 == pytest.approx(8.0, abs=0.002)


def test_a_link_at_rest_has_no_step() -> None:
    assert observed([(0, -10, 0)], 5.0).step_ns() is None
    assert RecentDots(RIG).step_ns() is None


def test_only_the_last_minute_is_kept() -> None:
    recent = RecentDots(RIG)
    noise = np.random.default_rng(0)
    period_ns = 20_000_000
    for index in range(10_000):
        dots = tuple((1e-3 * (index > 6_000) + 2e-7 * noise.standard_normal(4)).tolist())
        recent.put(SpotMeans(index * period_ns, index, dots, (5.0, 5.0), np.zeros((4, 4)), 20, 0, BlockStatus.OK, ''))
        if index == 8_500:
            assert recent.step_ns() == pytest.approx(6_000.5 * period_ns, abs=0.1 * period_ns)
    assert recent.step_ns() is None


def test_a_service_without_a_port_does_not_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('NOTIFY_SOCKET', '/nowhere/notify')
    with pytest.raises(ConfigError, match=r'^port: names no device.* set port in the rig file'):
        running()
