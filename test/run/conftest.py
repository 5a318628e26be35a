# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A device whose every byte the test writes, on a pseudo-terminal that the daemon opens."""

import contextlib
import os
import select
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from psd_deflection.devices.protocol import frames as protocol
from psd_deflection.devices.pseudo_terminal import PseudoTerminal
from psd_deflection.records import CHANNELS, DeflectionEstimate, Record
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run import acquisition
from test.heard import WAIT_S

HELLO = protocol.HelloFrame(
    1,
    {
        'serial': 'T-1',
        'firmware': 'test',
        'sample_rate_hz': 1000.0,
        'channels': list(CHANNELS),
        'volts_per_count': 10.0 / 32768,
    },
)


class ScriptedDevice:
    """Answers HELLO? with ``hello`` (or with nothing); everything else it sends is the test's."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.answer: bytes = protocol.encode(HELLO)
        self.greeted = threading.Event()
        self.plug()

    def plug(self) -> None:
        self.greeted.clear()
        self.terminal = PseudoTerminal(self.link)
        self._gone = threading.Event()
        self._thread = threading.Thread(target=self._listen, args=(self.terminal.master, self._gone), daemon=True)
        self._thread.start()

    def _listen(self, master: int, gone: threading.Event) -> None:
        decoder = protocol.FrameDecoder()
        poll = select.poll()
        poll.register(master, select.POLLIN)
        while not gone.is_set():
            events = poll.poll(10)
            if events and events[0][1] & select.POLLHUP:
                gone.wait(0.002)
            elif events:
                try:
                    received = os.read(master, 4096)
                except OSError:
                    continue
                for frame in decoder.feed(b'\x00' + received):
                    if isinstance(frame, protocol.HelloRequestFrame):
                        # Who asked may have left by now.
                        with contextlib.suppress(OSError):
                            self.send(self.answer)
                        self.greeted.set()

    def send(self, stream: bytes) -> None:
        while stream:
            try:
                stream = stream[os.write(self.terminal.master, stream) :]
            except BlockingIOError:
                select.select((), (self.terminal.master,), (), 1.0)

    def send_frames(self, *frames: protocol.GoodFrame) -> None:
        self.send(b''.join(protocol.encode(f) for f in frames))

    @property
    def plugged(self) -> bool:
        return not self._gone.is_set()

    def unplug(self) -> None:
        self._gone.set()
        self._thread.join()
        self.terminal.close()


class Estimates:
    """A sink that keeps what it gets; ``enough`` is set with the ``wanted``-th block that has an estimate."""

    def __init__(self, wanted: int = 0) -> None:
        self.records: list[Record] = []
        self.enough = threading.Event()
        self._wanted = wanted

    def put(self, record: Record) -> None:
        self.records.append(record)
        if isinstance(record, DeflectionEstimate) and record.primary:
            self._wanted -= 1
            if self._wanted == 0:
                self.enough.set()


@pytest.fixture(scope='session')
def sample() -> Callable[..., protocol.SampleFrame]:
    def make(seq: int, t_us: int | None = None, flags: int = 0) -> protocol.SampleFrame:
        return protocol.SampleFrame(
            flags, seq % 2**32, seq * 1000 if t_us is None else t_us, (0, 0, 16384, 0, 0, 16384)
        )

    return make


@pytest.fixture(scope='session')
def hello() -> protocol.HelloFrame:
    return HELLO


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that answers is heard, however late the machine lets it."""
    monkeypatch.setattr(acquisition, 'SILENCE_S', WAIT_S)


@pytest.fixture
def device(tmp_path: Path) -> Iterator[ScriptedDevice]:
    scripted = ScriptedDevice(tmp_path / 'port')
    yield scripted
    if scripted.plugged:
        scripted.unplug()


@pytest.fixture
def rig(device: ScriptedDevice) -> Rig:
    return load_rig(overrides={'port': str(device.link)})
