# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the parameter ``port`` may name; ports of the network against real sockets on this machine."""

import contextlib
import os
import select
import socket
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st
from serial import rfc2217

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.devices import PortClosedError, tcp_port, udp_port
from psd_deflection.devices.contract_frames import candidate_ports, is_pattern
from psd_deflection.devices.port import Address, OpenPort, has_baud, network_address
from psd_deflection.devices.ports import open_port
from psd_deflection.devices.pseudo_terminal import PseudoTerminal
from psd_deflection.devices.registry import make_source
from psd_deflection.devices.udp_port import KEPT, MOST_SENDERS, Datagrams, UdpPort
from psd_deflection.rig.config import load_rig
from test.heard import WAIT_S, until

BAUD = 115_200


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(('127.0.0.1', 0)) as made:
        yield made


def named(listener: socket.socket) -> str:
    return f'socket://127.0.0.1:{listener.getsockname()[1]}'


def all_of(port: OpenPort, count: int) -> bytes:
    """The next ``count`` bytes, or more."""
    received = b''
    while len(received) < count:
        received += port.read(WAIT_S)
    return received


class Connected:
    """A port and the other end of it."""

    def __init__(self, listener: socket.socket) -> None:
        self.port = open_port(named(listener), BAUD)
        self.peer, _ = listener.accept()


@pytest.fixture
def connected(listener: socket.socket) -> Iterator[Connected]:
    made = Connected(listener)
    yield made
    made.port.close()
    made.peer.close()


def test_bytes_go_both_ways(connected: Connected) -> None:
    connected.peer.sendall(b'\x00hello\x00')
    assert all_of(connected.port, 7) == b'\x00hello\x00'
    connected.port.write(b'question')
    assert (connected.peer.recv(100), connected.port.read(0.0)) == (b'question', b'')
    assert connected.port.notices() == []


def test_old_bytes_are_discarded(connected: Connected) -> None:
    connected.peer.sendall(b'old' * 1000)
    fd = connected.port.fileno()
    assert fd is not None
    select.select((fd,), (), (), WAIT_S)
    connected.port.discard_input()
    connected.peer.sendall(b'new')
    assert all_of(connected.port, 3).endswith(b'new')


def test_the_other_end_closes(connected: Connected) -> None:
    connected.peer.close()
    with pytest.raises(PortClosedError, match=r'socket://127.0.0.1:\d+: the device is gone \(the other end closed'):
        all_of(connected.port, 1)
    # To discard is no reason to fail: the next read tells.
    connected.port.discard_input()


def test_the_other_end_breaks_off(connected: Connected) -> None:
    connected.peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b'\x01\x00\x00\x00\x00\x00\x00\x00')
    connected.peer.close()
    with pytest.raises(PortClosedError, match='the device is gone'):
        all_of(connected.port, 1)
    with pytest.raises(PortClosedError, match='cannot be written to'):
        connected.port.write(b'question')


def test_the_other_end_takes_nothing(connected: Connected, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(1000))
    monkeypatch.setattr(tcp_port, 'time', SimpleNamespace(monotonic=lambda: next(clock)))
    with pytest.raises(PortClosedError, match=r'cannot be written to \(it takes nothing\)'):
        connected.port.write(bytes(1 << 25))


def test_a_host_that_is_cut_off_is_noticed_by_the_kernel(connected: Connected) -> None:
    with socket.socket(fileno=os.dup(connected.port.fileno() or 0)) as mine:
        assert mine.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert mine.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == 4
        # Also if a question of ours waits for its confirmation.
        assert mine.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 10_000
        assert mine.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_given_up_ends_a_read(connected: Connected) -> None:
    connected.port.give_up()
    with pytest.raises(PortClosedError, match='given up'):
        connected.port.read(WAIT_S)
    with pytest.raises(PortClosedError, match='given up'):
        connected.port.write(b'question')


@pytest.mark.parametrize(
    ('error', 'message'),
    [
        (socket.gaierror(-2, 'Name or service not known'), r'no host of the name rig is known; is it spelt right\?'),
        (ConnectionRefusedError(111, 'Connection refused'), 'the host is there, but nothing listens on its port 4000'),
        (TimeoutError('timed out'), r'no answer in 2 s; is the host switched on, and in this network\?'),
        (OSError(113, 'No route to host'), r'the host cannot be reached \(No route to host\); is its cable in'),
        (OSError(24, 'Too many open files'), r'cannot be opened \(.*Too many open files'),
    ],
)
@pytest.mark.parametrize('scheme', ['socket', 'rfc2217'])
def test_why_there_is_no_connection(scheme: str, error: OSError, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, 'create_connection', Mock(side_effect=error))
    with pytest.raises(DeviceError, match=rf'^{scheme}://rig:4000: {message}') as reported:
        open_port(f'{scheme}://rig:4000', BAUD)
    assert '\n' not in str(reported.value)


def not_opened(name: str, why: str) -> None:
    with pytest.raises(DeviceError, match=why):
        open_port(name, BAUD)


def test_a_real_rejection(listener: socket.socket) -> None:
    name = named(listener)
    listener.close()
    not_opened(name, 'nothing listens on its port')


def test_no_thread_is_left_for_a_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, 'Thread', Mock(side_effect=RuntimeError("can't start new thread")))
    not_opened('socket://rig:4000', r"socket://rig:4000: cannot be opened \(can't start new thread")


class Datagrammed:
    """A port for datagrams, and its name."""

    def __init__(self, datagrams: Datagrams | None = None) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(('127.0.0.1', 0))
            self.place = free.getsockname()
        self.name = f'udp://127.0.0.1:{self.place[1]}'
        port = open_port(self.name, BAUD, datagrams=datagrams)
        assert isinstance(port, UdpPort)
        self.port = port
        self.senders: list[socket.socket] = []

    def sender(self) -> socket.socket:
        self.senders.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        self.senders[-1].connect(self.place)
        self.senders[-1].settimeout(WAIT_S)
        return self.senders[-1]

    def close(self) -> None:
        self.port.close()
        for sender in self.senders:
            sender.close()


def of_device(start: bytes = b'device') -> Datagrams:
    """Whoever has sent ``start`` speaks the device's protocol."""

    def validator() -> Any:
        heard = bytearray()

        def takes(piece: bytes) -> bool:
            heard.extend(piece)
            return start in heard

        return takes

    return Datagrams(validator)


@pytest.fixture
def udp() -> Iterator[Datagrammed]:
    with contextlib.closing(Datagrammed(of_device())) as made:
        yield made


def shown(sender: socket.socket) -> str:
    return '{}:{}'.format(*sender.getsockname())


def test_the_first_that_speaks_the_protocol_is_the_sender(udp: Datagrammed) -> None:
    stranger, device = udp.sender(), udp.sender()
    assert udp.port.describe()['sender'] == 'none yet'
    # What is asked before anybody is there goes to the sender, once it is found.
    udp.port.write(b'question')
    stranger.send(b'junk')
    device.send(b'dev')
    device.send(b'ice 1')
    assert all_of(udp.port, 8) == b'device 1'
    assert device.recv(100) == b'question'
    udp.port.write(b'ping')
    assert device.recv(100) == b'ping'
    assert udp.port.describe()['sender'] == shown(device)


def test_others_are_counted_and_reported_once(udp: Datagrammed) -> None:
    device, stranger = udp.sender(), udp.sender()
    device.send(b'device 1')
    all_of(udp.port, 8)
    assert udp.port.notices() == []
    for _ in range(5):
        stranger.send(b'device too')
    device.send(b'2')
    assert all_of(udp.port, 1) == b'2'
    (notice,) = udp.port.notices()
    assert notice.text == f'datagrams of {shown(stranger)} are not taken: {shown(device)} sends already'
    stranger.send(b'device too')
    device.send(b'3')
    assert all_of(udp.port, 1) == b'3'
    assert (udp.port.notices(), udp.port.describe()['datagrams of other senders']) == ([], '6')


def test_silent_sender_yields_to_device_not_to_junk(udp: Datagrammed, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(udp_port, 'time', SimpleNamespace(monotonic=lambda: now))
    device, stranger = udp.sender(), udp.sender()
    device.send(b'device 1')
    all_of(udp.port, 8)
    now += 1.9
    stranger.send(b'device too')
    until(lambda: udp.port.read(WAIT_S) == b'' and udp.port.describe()['datagrams of other senders'] == '1')
    now += 0.2
    stranger.send(b'junk')
    until(lambda: udp.port.read(WAIT_S) == b'' and udp.port.describe()['datagrams of other senders'] == '2')
    stranger.send(b'device too')
    text = rf'{udp.name}: {shown(device)} is silent, and {shown(stranger)} sends now'
    with pytest.raises(PortClosedError, match=text):
        all_of(udp.port, 1)


def test_what_strangers_send_is_bounded(udp: Datagrammed) -> None:
    for n in range(2 * MOST_SENDERS):
        stranger = udp.sender()
        for _ in range(3):
            stranger.send(bytes([n]) * 1000)
        udp.port.read(WAIT_S)
    until(lambda: udp.port.read(0.0) == b'')
    # Memory is bounded, and nothing public says how much is kept of a stranger.
    candidates = udp.port._candidates
    assert len(candidates) == MOST_SENDERS
    assert all(len(candidate.last_bytes) <= KEPT for candidate in candidates.values())
    device = udp.sender()
    device.send(b'device')
    assert all_of(udp.port, 6) == b'device'
    assert not udp.port._candidates


def test_the_largest_datagram(udp: Datagrammed) -> None:
    device = udp.sender()
    largest = b'device' + bytes(65_507 - 6)
    device.send(largest)
    assert all_of(udp.port, len(largest)) == largest


def test_old_datagrams_are_discarded(udp: Datagrammed) -> None:
    device = udp.sender()
    device.send(b'device 1')
    all_of(udp.port, 8)
    device.send(b'old')
    select.select((udp.port.fileno(),), (), (), WAIT_S)
    udp.port.discard_input()
    device.send(b'new')
    assert all_of(udp.port, 3) == b'new'


def test_given_up_ends_a_read_of_datagrams(udp: Datagrammed) -> None:
    udp.port.give_up()
    with pytest.raises(PortClosedError, match='given up'):
        udp.port.read(WAIT_S)


def test_datagrams_of_another_program_or_machine_are_not_taken(udp: Datagrammed) -> None:
    not_opened(udp.name, rf'{udp.name}: another program takes what comes there')
    not_opened('udp://192.0.2.1:4000', r'192\.0\.2\.1 is no address of this machine')


class Terminal(serial.Serial):
    """A pseudo-terminal has no control lines."""

    def _update_dtr_state(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass

    cts = dsr = cd = True
    ri = False


class Remote:
    """A server as ser2net, before a pseudo-terminal whose other end is ``device``."""

    def __init__(self) -> None:
        self.device = PseudoTerminal()
        self.serial = Terminal(self.device.name, 9600, timeout=0)
        self.listener = socket.create_server(('127.0.0.1', 0))
        self.name = f'rfc2217://127.0.0.1:{self.listener.getsockname()[1]}'
        self._stop, self._lock = threading.Event(), threading.Lock()
        self._host: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """The manager's way to the host."""
        with self._lock:
            if self._host is not None:
                self._host.sendall(data)

    def _run(self) -> None:
        self._host, _ = self.listener.accept()
        manager: Any = rfc2217.PortManager(cast(Any, self.serial), cast(Any, self))
        asked: list[Any] = [self._host, self.serial]
        with contextlib.suppress(OSError):
            while not self._stop.is_set():
                ready, _, _ = select.select(asked, (), (), 0.01)
                if self._host in ready:
                    received = self._host.recv(4096)
                    if not received:
                        break
                    self.serial.write(b''.join(manager.filter(received)))
                if self.serial in ready:
                    self.write(b''.join(manager.escape(self.serial.read(4096))))

    def hang_up(self) -> None:
        self._stop.set()
        self._thread.join()
        if self._host is not None:
            self._host.close()

    def close(self) -> None:
        self.listener.close()
        if self._host is not None:
            self.hang_up()
        self.serial.close()
        self.device.close()


@pytest.fixture
def remote() -> Iterator[Remote]:
    with contextlib.closing(Remote()) as made:
        yield made


def await_input(port: OpenPort, size: int) -> None:
    # pyserial's thread receives; a read of ours would take the bytes away.
    until(lambda: port._serial.in_waiting == size)  # type: ignore[attr-defined]


def test_a_remote_serial_port_with_its_line_speed(remote: Remote) -> None:
    port = open_port(remote.name, 921_600)
    assert remote.serial.baudrate == 921_600
    every = bytes(range(256)) * 4
    assert remote.device.send(every) == len(every)
    assert all_of(port, len(every)) == every
    assert port.read(0.0) == b''
    port.write(every)
    received = b''
    while len(received) < len(every):
        received += remote.device.listen(WAIT_S) or b''
    assert received == every
    remote.device.send(b'old')
    await_input(port, 3)
    port.discard_input()
    assert port.read(0.0) == b''
    remote.hang_up()
    with pytest.raises(PortClosedError, match=r'rfc2217://.*: the device is gone'):
        all_of(port, 1)
    with pytest.raises(PortClosedError, match='cannot be written to'):
        until(lambda: port.write(b'question') is not None)
    port.close()
    port.give_up()
    with pytest.raises(PortClosedError, match='given up'):
        port.read(0.0)


def test_more_than_can_be_read_ends_the_port(remote: Remote, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp_port, 'MOST_WAITING', 100)
    port = open_port(remote.name, BAUD)
    remote.device.send(bytes(200))
    await_input(port, 200)
    with pytest.raises(PortClosedError, match=r'more comes than can be read \(200 bytes wait\)'):
        port.read(0.0)
    port.close()


def test_a_raw_port_is_no_remote_serial_port(listener: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp_port, 'OPEN_S', 0.2)
    name = named(listener).replace('socket://', 'rfc2217://')
    not_opened(name, r'not as RFC 2217 says; is it a raw port \(socket://\)')


@pytest.mark.parametrize(
    ('name', 'address'),
    [
        ('socket://rig-pi.local:4000', Address('socket', 'rig-pi.local', 4000)),
        ('SOCKET://192.168.1.20:65535', Address('socket', '192.168.1.20', 65535)),
        ('socket://[::1]:1', Address('socket', '::1', 1)),
        ('udp://0.0.0.0:4000', Address('udp', '0.0.0.0', 4000)),
        ('udp://[fe80::1%eth0]:4000', Address('udp', 'fe80::1%eth0', 4000)),
        ('rfc2217://rig:2217', Address('rfc2217', 'rig', 2217)),
        ('rfc2217://rig:2217?ign_set_control', Address('rfc2217', 'rig', 2217, 'ign_set_control')),
        ('/dev/ttyACM0', None),
        ('/dev/serial/by-id/usb-Arduino_[1]', None),
        ('rig_port', None),
        ('TCPIP0::192.168.1.20::INSTR', None),
    ],
)
def test_a_name(name: str, address: Address | None) -> None:
    assert network_address(name) == address
    assert has_baud(name) == (address is None or address.scheme == 'rfc2217')


@pytest.mark.parametrize(
    ('name', 'message'),
    [
        ('tcp://rig:4000', 'rfc2217://HOST:PORT or udp://HOST:PORT; did you mean socket://'),
        ('sockt://rig:4000', 'did you mean socket'),
        ('http://rig:80', 'must be a serial port, socket://HOST:PORT, rfc2217://HOST:PORT or udp://HOST:PORT'),
        ('socket://rig', 'must be socket://HOST:PORT'),
        ('socket://:4000', 'must be socket://HOST:PORT'),
        ('socket://::1:4000', r'IPv6 stands in brackets: \[::1\]'),
        ('socket://rig:0', 'the last number must be at least 1 and at most 65535'),
        ('udp://rig:65536', 'the last number must be at least 1 and at most 65535'),
        ('socket://rig:40 00', 'must be socket://HOST:PORT'),
        ('socket://rig:4000/path', 'must be socket://HOST:PORT'),
        ('socket://rig:4000?logging=debug', 'must be socket://HOST:PORT'),
        ('rfc2217://rig:4000?logging=debug', r'or rfc2217://HOST:PORT\?ign_set_control'),
        ('socket://' + 'x' * 5000, 'must be socket'),
    ],
)
def test_invalid_port_reports_key_value_and_bounds(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        make_source(load_rig(overrides={'port': name}))
    assert str(error.value).startswith(f'port = {name[:20]!r}'[:-1])
    assert len(str(error.value)) < 400
    assert '\n' not in str(error.value)


@given(st.text(max_size=60))
def test_no_name_is_a_crash(rest: str) -> None:
    for name in (rest, f'socket://{rest}', f'udp://{rest}:4000', f'rfc2217://rig:{rest}'):
        try:
            address = network_address(name)
        except ConfigError:
            continue
        else:
            assert address is None or 1 <= address.port <= 65535


def test_a_device_that_must_be_asked_is_not_looked_for_over_udp() -> None:
    ten_volts = {'converter.bits': 16, 'converter.full_scale': 10.0}
    for source, port in (('dataq', 'udp://0.0.0.0:4000'), ('thorlabs', 'socket://a:1,udp://0.0.0.0:4000')):
        words = rf'source = {source}: port = .udp://0\.0\.0\.0:4000.: the device sends only'
        with pytest.raises(ConfigError, match=words):
            make_source(load_rig(overrides={'source': source, 'port': port, **ten_volts}))


def test_network_port_is_no_pattern_without_candidates() -> None:
    assert not is_pattern('socket://[::1]:4000')
    assert is_pattern('/dev/ttyACM[01]')
    assert candidate_ports('socket://rig:4000', 'T-1') == []
