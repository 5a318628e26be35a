# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How long a test waits for what will come."""

import threading
import time
from collections.abc import Callable

from tools.program import WAIT_S as WAIT_S


def until(true: Callable[[], bool]) -> None:
    """Wait for what another thread brings about, and nobody tells of."""
    deadline = time.monotonic() + WAIT_S
    while not true():
        assert time.monotonic() < deadline, true
        threading.Event().wait(0.001)
