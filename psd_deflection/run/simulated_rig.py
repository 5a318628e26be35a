# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Starts the simulated rig as a separate process, like a real device."""

import contextlib
import json
import select
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.pseudo_terminal import PORT_LINE
from psd_deflection.devices.registry import SIMULATED
from psd_deflection.rig.config import Rig

START_S = 60.0

_waiting: list[subprocess.Popen[bytes]] = []


def simulates(values: Mapping[str, object]) -> bool:
    """Whether a session with these parameters starts a simulated rig: no port is named and the device has a twin."""
    return not values.get('port') and values.get('source', 'serial') in SIMULATED


@contextlib.contextmanager
def started_early(wanted: bool) -> Iterator[None]:
    """Start the process of the next rig now, if it is ``wanted``; end it if no session took it.

    The process imports its modules while the daemon imports its own, then waits for parameters. So the user
    sees the dots sooner.
    """
    if wanted:
        _waiting.append(_start())
    try:
        yield
    finally:
        while _waiting:
            process = _waiting.pop()
            process.kill()
            process.communicate()


def _start() -> subprocess.Popen[bytes]:
    # A session of its own: Ctrl-C in the terminal is for the daemon, which ends the rig itself.
    return subprocess.Popen(
        [sys.executable, '-m', 'psd_deflection.devices.serve'],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )


class SimulatedRigProcess:
    """The process behind ``port``. It ends when this process closes its standard input, or dies."""

    def __init__(self, rig: Rig) -> None:
        self._process = _waiting.pop() if _waiting else _start()
        if self._process.stdin is None or self._process.stdout is None:
            raise DeviceError('the simulated rig has no pipes')
        self._process.stdin.write(json.dumps(rig.flat()).encode() + b'\n')
        self._process.stdin.flush()
        try:
            ready, _, _ = select.select((self._process.stdout,), (), (), START_S)
        except BaseException:
            self.close()
            raise
        line = self._process.stdout.readline().decode() if ready else ''
        if not line.startswith(PORT_LINE):
            self.close()
            raise DeviceError('the simulated rig did not start; `python -m psd_deflection.devices.serve` says why')
        self.port = line[len(PORT_LINE) :].strip()

    def push(self, load: Sequence[float]) -> None:
        """Hold ``load`` (Fx, Fy N, Tz N m) from now on. A process that has ended holds nothing."""
        # It may end, or be told to, at any moment.
        with contextlib.suppress(OSError, ValueError):
            if self._process.stdin is not None:
                self._process.stdin.write(json.dumps(list(load)).encode() + b'\n')
                self._process.stdin.flush()

    def hang_up(self) -> None:
        """Tell the process to end; does not wait."""
        if self._process.stdin is not None:
            self._process.stdin.close()

    def close(self) -> None:
        """End the process."""
        self.hang_up()
        try:
            self._process.wait(0.3)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
