# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The simulated rig rests until a load is noted, which it hangs."""

import threading
from collections import deque
from collections.abc import Callable

import pytest

from psd_deflection.base.log import null_log
from psd_deflection.model.link import LinkStatics
from psd_deflection.records import DeflectionEstimate, Record
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
