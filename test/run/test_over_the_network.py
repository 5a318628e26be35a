# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reader on ports of the network: what it does on a serial line, it does over TCP; and over UDP with its faults."""

import select
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from psd_deflection.devices.protocol.frames import FrameDecoder, HelloFrame, HelloRequestFrame, PingFrame, encode
from psd_deflection.rig.config import Rig, load_rig
from test.heard import WAIT_S
from test.run.conftest import HELLO, ScriptedDevice
from test.run.test_acquisition import Run, numbers, take


class ScriptedHost(ScriptedDevice):
    """The same device behind a TCP port, which keeps its number while the host comes and goes."""

    def __init__(self) -> None:
        with socket.create_server(('127.0.0.1', 0)) as free:
            self._place = free.getsockname()
        super().__init__(Path())
        self.port = f'socket://127.0.0.1:{self._place[1]}'

    def plug(self) -> None:
        self.greeted.clear()
        self._listener = socket.create_server(self._place)
        self._host: socket.socket | None = None
        self._gone = threading.Event()
        self._thread = threading.Thread(target=self._answer, args=(self._listener, self._gone), daemon=True)
        self._thread.start()

    def _answer(self, listener: socket.socket, gone: threading.Event) -> None:
        decoder = FrameDecoder()
        while not gone.is_set():
            ready, _, _ = select.select([s for s in (listener, self._host) if s is not None], (), (), 0.01)
            if listener in ready:
                if self._host is not None:
                    self._host.close()
                self._host, _ = listener.accept()
            elif ready and self._host is not None:
                received = self._host.recv(4096)
                if not received:
                    self._host.close()
                    self._host = None
                for frame in decoder.feed(b'\x00' + received):
                    if isinstance(frame, HelloRequestFrame):
                        self.send(self.answer)
                        self.greeted.set()

    def send(self, stream: bytes) -> None:
        assert self._host is not None
        self._host.sendall(stream)

    def unplug(self) -> None:
        self._gone.set()
        self._thread.join()
        self._listener.close()
        if self._host is not None:
            self._host.close()


@pytest.fixture
def device() -> Iterator[ScriptedHost]:
    scripted = ScriptedHost()
    yield scripted
    scripted.unplug()


@pytest.fixture
def rig(device: ScriptedHost) -> Rig:
    return load_rig(overrides={'port': device.port})


@pytest.fixture
def run(device: ScriptedHost, rig: Rig) -> Iterator[Run]:
    started = Run(rig)
    yield started
    started.acquisition.stop()


def test_the_diagnostics_name_the_port_and_no_line_speed(run: Run, device: ScriptedHost) -> None:
    assert run.acquisition.source.describe()['source'] == f'binary frames on {device.port}'


class Sender:
    """A device that sends datagrams to the port of ``rig``; it answers HELLO? and keeps the pings."""

    def __init__(self, answer: bytes = encode(HELLO)) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(('127.0.0.1', 0))
            place = free.getsockname()
        self.answer = answer
        self.rig = load_rig(overrides={'port': f'udp://127.0.0.1:{place[1]}'})
        self.pinged = threading.Event()
        self.place = place
        self._ended = threading.Event()
        self.sockets: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self.start()

    def start(self) -> None:
        """From a socket of its own, as after a power-up."""
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.bind(('127.0.0.1', 0))
        self.sockets.append(made)
        self._threads.append(threading.Thread(target=self._answer, args=(made,), daemon=True))
        self._threads[-1].start()

    def _answer(self, made: socket.socket) -> None:
        decoder = FrameDecoder()
        while not self._ended.wait(0.01) and made is self.sockets[-1]:
            # As a device does once a second.
            made.sendto(self.answer, self.place)
            while select.select((made,), (), (), 0.0)[0]:
                for frame in decoder.feed(made.recv(4096)):
                    if isinstance(frame, PingFrame):
                        self.pinged.set()

    def send(self, *datagrams: bytes) -> None:
        for datagram in datagrams:
            self.sockets[-1].sendto(datagram, self.place)

    def hush(self) -> None:
        """From now on it sends what the test sends."""
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def end(self) -> None:
        self.hush()
        for made in self.sockets:
            made.close()


@pytest.fixture
def sender() -> Iterator[Sender]:
    made = Sender()
    yield made
    made.end()


@pytest.fixture
def over_udp(sender: Sender) -> Iterator[Run]:
    started = Run(sender.rig)
    yield started
    started.acquisition.stop()


def frames(sample: Any, *seqs: int) -> bytes:
    return b''.join(encode(sample(s)) for s in seqs)


def pieces_of(stream: bytes) -> list[bytes]:
    return [stream[at : at + 50] for at in range(0, len(stream), 50)]


def test_lost_doubled_or_swapped_datagrams_are_counted(sender: Sender, over_udp: Run, sample: Any) -> None:
    sent = [frames(sample, *range(n, n + 5)) for n in range(0, 60, 5)]
    # The third is lost, the fifth comes twice, of the seventh and the eighth the second comes first.
    sender.send(*sent[:2], *sent[3:5], sent[4], sent[5], sent[7], sent[6], *sent[8:])
    got = numbers(take(over_udp.acquisition, 50))
    assert got == [*range(10), *range(15, 30), *range(35, 60)]
    counters = over_udp.acquisition.counters
    assert dict(counters.lost_by) == {'on the wire, without a trace': 10}
    assert (counters.lost, counters.repeated, counters.bad) == (10, 10, 0)
    assert sender.pinged.wait(WAIT_S)


def test_split_frames_are_joined_or_damaged_if_cut(sender: Sender, over_udp: Run, sample: Any) -> None:
    # HELLO between two pieces would end a frame.
    sender.hush()
    sender.send(*pieces_of(frames(sample, *range(20))))
    assert numbers(take(over_udp.acquisition, 20)) == list(range(20))
    pieces = pieces_of(frames(sample, *range(20, 60)))
    sender.send(*pieces[:5], *pieces[6:])
    # The sixth has bytes 250 to 299 of frames of 32.
    assert numbers(take(over_udp.acquisition, 37)) == [*range(20, 27), *range(30, 60)]
    counters = over_udp.acquisition.counters
    assert (dict(counters.lost_by), counters.bad) == ({'damaged on the wire': 3}, 1)


def test_device_at_new_address_introduces_itself(
    sender: Sender, over_udp: Run, sample: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from psd_deflection.devices import udp_port

    sender.send(frames(sample, *range(20)))
    take(over_udp.acquisition, 20)
    monkeypatch.setattr(udp_port, 'SILENT_S', 0.0)
    sender.start()
    text = over_udp.heard('sends now')
    assert 'is silent, and 127.0.0.1:' in text
    assert text.endswith('waiting for it to come back')
    over_udp.heard('the device is back')
    sender.send(frames(sample, *range(40, 60)))
    assert numbers(take(over_udp.acquisition, 20)) == list(range(40, 60))
    assert over_udp.acquisition.counters.lost == 20


def test_strangers_are_reported_and_nothing_of_theirs_is_taken(sender: Sender, over_udp: Run, sample: Any) -> None:
    stranger = Sender(encode(HelloFrame(1, {**HELLO.info, 'serial': 'OTHER'})))
    stranger.place = sender.place
    try:
        text = over_udp.heard('are not taken')
        assert text.startswith(f'{sender.rig.acquisition.port}: datagrams of 127.0.0.1:')
        stranger.send(frames(sample, *range(500, 520)))
        sender.send(frames(sample, *range(20)))
        assert numbers(take(over_udp.acquisition, 20)) == list(range(20))
        assert over_udp.acquisition.hello is not None
        assert over_udp.acquisition.hello.info['serial'] == 'T-1'
    finally:
        stranger.end()


def test_text_lines_are_never_put_together_of_two_datagrams() -> None:
    """Half of one line and half of the next make a line, but no sample."""
    about = b'# {"serial": "W-1", "sample_rate_hz": 1000}\n'
    sender = Sender(about)
    rig = load_rig(overrides={'port': sender.rig.acquisition.port, 'source': 'lines'})
    run = Run(rig)
    try:
        lines = [b'%d,%d,0.1,0.2,5.0,0.3,0.4,5.0' % (n, 1000 * n) for n in range(40)]
        # A line without its end is one all the same.
        sender.send(*lines[:5], lines[5][:12], lines[6][12:], *lines[7:])
        assert numbers(take(run.acquisition, 38)) == [*range(5), *range(7, 40)]
        assert (run.acquisition.counters.lost, run.acquisition.counters.bad) == (2, 2)
        assert run.acquisition.source.describe()['sender'].startswith('127.0.0.1:')
    finally:
        run.acquisition.stop()
        sender.end()
