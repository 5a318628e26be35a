# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The faults: what each does to the line, when it is over, and which counter must have seen it."""

import contextlib
import os
import select
import signal
import threading
import time
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import serial
from cobs import cobs

from bench.campaign.line import Line, hello_of
from psd_deflection.devices.protocol.frames import encode

Act = Callable[[Line, int], None]  # What a fault does to the line, or to the node with that process id.


@dataclass(frozen=True, slots=True)
class Fault:
    """``act(line, pid)`` returns when the fault is over. ``observed``: diagnostics of which one must have risen.
    ``estimates``: what must come back is the estimate, not the sample. ``back``: the port was away, so the time to
    recover counts against the second that is allowed."""

    name: str
    act: Act
    observed: tuple[str, ...]
    estimates: bool = False
    back: bool = False


BAD = ('bad frames',)
AWAY = ('disconnects',)

STOLEN = 512  # Bytes: some of them were samples.


def pause(seconds: float) -> None:
    time.sleep(seconds)


def _while(seconds: float, **attributes: object) -> Act:
    """The line has these attributes for that long."""

    def act(line: Line, pid: int) -> None:
        with line.lock:
            before = {name: getattr(line, name) for name in attributes}
            _set(line, attributes)
        pause(seconds)
        with line.lock:
            _set(line, before)

    return act


def _set(line: Line, attributes: Mapping[str, object]) -> None:
    for name, value in attributes.items():
        setattr(line, name, value)


def _changed(change: Callable[[Line, bytes], bytes | None], seconds: float) -> Act:
    """Each frame goes through ``change``; None leaves it as it is."""
    return lambda line, pid: _while(seconds, tamper=lambda identity, frame: change(line, frame))(line, pid)


def _once(change: Callable[[Line, bytes], bytes]) -> Act:
    def act(line: Line, pid: int) -> None:
        first = iter((change,))

        def tamper(line: Line, frame: bytes) -> bytes | None:
            todo = next(first, None)
            return todo(line, frame) if todo is not None else None

        _changed(tamper, 0.03)(line, pid)

    return act


def _injected(make: Callable[[Line], bytes], seconds: float = 0.03) -> Act:
    def act(line: Line, pid: int) -> None:
        line.inject(make(line))
        pause(seconds)

    return act


def _merged(line: Line, frame: bytes) -> bytes:
    # The next frame is this one's tail: it is taken as well.
    line.taken_by_fault.add(line.sent)
    return frame[:-1]


def _flip(line: Line, frame: bytes) -> bytes:
    out = bytearray(frame)
    # Any bit but those of the closing zero; one that makes a new zero is welcome too.
    bit = line.random.randrange(8 * (len(out) - 1))
    out[bit // 8] ^= 1 << bit % 8
    return bytes(out)


def _flip_a_tenth(line: Line, frame: bytes) -> bytes | None:
    return _flip(line, frame) if line.random.random() < 0.1 else None


def _noise(line: Line) -> bytes:
    return b'\x00' + bytes(line.random.getrandbits(8) for _ in range(64)) + b'\x00'


def _sealed(payload: bytes) -> bytes:
    """A frame of any content, with the right CRC."""
    sealed: bytes = cobs.encode(payload + zlib.crc32(payload).to_bytes(4, 'little')) + b'\x00'
    return sealed


def _replugged(after_s: float = 0.1, names: tuple[str, str] | None = None, restart: bool = False) -> Act:
    """Unplugged for ``after_s``; then under its name, or under that of ``names`` which it had not."""

    def act(line: Line, pid: int) -> None:
        line.unplug()
        if restart:
            line.restart()
        pause(after_s)
        line.plug(line.name if names is None else names[line.name == names[0]])

    return act


def _replugged_beside_another(line: Line, pid: int) -> None:
    old = line.name
    line.unplug()
    other = Line(line.folder, old)
    other.serial = 'SOMEBODY-ELSE'
    pause(0.3)
    line.plug('port_c' if old != 'port_c' else 'port')

    def leave() -> None:
        line.greeted.wait(5.0)
        other.close()

    # The time to recover counts from here, with the other one still there.
    threading.Thread(target=leave, daemon=True).start()


def _held_by_another(line: Line, pid: int) -> None:
    line.unplug()
    line.plug(line.name)
    try:
        holder = serial.Serial(line.device_name, 921600, exclusive=True)
    except serial.SerialException:
        # The node was quicker: then nobody else can have it, which is the point.
        return
    pause(0.4)
    holder.close()


def _stolen_bytes(line: Line, pid: int) -> None:
    first = line.wait_until_read()
    descriptor = os.open(line.device_name, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    start, stolen = time.monotonic(), 0
    # On an idle machine the node is quicker, time and again: a thief that got nothing is no fault.
    while (passed := time.monotonic() - start) < 0.1 or (stolen < STOLEN and passed < 5.0):
        select.select((descriptor,), (), (), 0.01)
        with contextlib.suppress(BlockingIOError):
            stolen += len(os.read(descriptor, 64))
    os.close(descriptor)
    with line.lock:
        # Which of them it took only it knows: all that were sent meanwhile, and what was on its way.
        line.taken_by_fault.update(range(first, line.sent + 1))


def _wrong_baud(line: Line, pid: int) -> None:
    _changed(lambda line, frame: bytes(line.random.getrandbits(8) or 1 for _ in frame), 0.3)(line, pid)
    line.inject(b'\x00')


def _duplicates(line: Line, pid: int) -> None:
    kept: list[bytes] = []
    # append() returns None: the frames go on as they are.
    _changed(lambda line, frame: kept.append(frame), 0.03)(line, pid)
    line.inject(b''.join(kept[-30:]))
    pause(0.02)


def _swapped(line: Line, pid: int) -> None:
    waiting: list[bytes] = []
    done: list[bool] = []

    def tamper(identity: int, frame: bytes) -> bytes | None:
        if done:
            return None
        if not waiting:
            waiting.append(frame)
            return b''
        done.append(True)
        with line.lock:
            line.taken_by_fault.discard(identity)
        return None

    _while(0.02, tamper=tamper)(line, pid)
    line.inject(waiting[0] if waiting else b'')
    pause(0.01)


def _jump(samples: int, us: int) -> Act:
    """The device's numbers and its clock go on elsewhere."""

    def act(line: Line, pid: int) -> None:
        line.jump(samples, us)
        pause(0.05)

    return act


def _restart(seq: int = 0) -> Act:
    def act(line: Line, pid: int) -> None:
        line.restart(seq, 0)
        line.inject(encode(hello_of()))
        pause(0.08)

    return act


def _overrun(line: Line, pid: int) -> None:
    with line.lock:
        # The first sample after the silence carries the flag.
        line.mute, line.flags = True, 2
    pause(0.03)
    with line.lock:
        line.mute = False


def _stopped(line: Line, pid: int) -> None:
    with line.lock:
        line.mute = line.obedient = True
    deadline = time.monotonic() + 8.0
    while line.mute and time.monotonic() < deadline:
        pause(0.01)


def _frozen_node(line: Line, pid: int) -> None:
    os.kill(pid, signal.SIGSTOP)
    pause(0.3)
    os.kill(pid, signal.SIGCONT)


def _dark(channel: int, counts: int) -> Act:
    return _while(0.15, optics={channel: counts})


FAULTS: tuple[Fault, ...] = (
    Fault('unplugged, back under its name', _replugged(), AWAY, back=True),
    Fault('unplugged, back under another name', _replugged(names=('port', 'port_b')), AWAY, back=True),
    Fault('unplugged, another device on its port, back elsewhere', _replugged_beside_another, AWAY, back=True),
    Fault('unplugged for 1.5 s', _replugged(1.5), AWAY, back=True),
    Fault('unplugged and restarted', _replugged(restart=True), AWAY, back=True),
    Fault('back while another program has the port', _held_by_another, AWAY, back=True),
    Fault('another program reads from the port', _stolen_bytes, ('lost', 'bad frames')),
    Fault('wrong baud rate for 0.3 s', _wrong_baud, BAD),
    Fault('64 bytes of garbage', _injected(_noise), BAD),
    Fault('2000 bytes without an end', _injected(lambda line: b'\x55' * 2000 + b'\x00'), BAD),
    Fault('zeros and garbage', _injected(lambda line: b'\x00' * 200 + _noise(line)), BAD),
    Fault('frame truncated', _once(lambda line, f: f[: line.random.randrange(2, len(f) - 1)] + b'\x00'), BAD),
    Fault('frame without its closing zero', _once(_merged), BAD),
    Fault('frame split by a zero', _once(lambda line, f: f[:9] + b'\x00' + f[9:]), BAD),
    Fault('one bit flipped', _once(_flip), BAD),
    Fault('a tenth of the frames flipped for 0.2 s', _changed(_flip_a_tenth, 0.2), BAD),
    Fault('frame duplicated', _once(lambda line, f: f * 2), ('repeated',)),
    Fault('30 frames duplicated', _duplicates, ('repeated',)),
    Fault('frame late, out of order', _swapped, ('repeated', 'lost')),
    Fault('frame lost without a trace', _once(lambda line, f: b''), ('lost',)),
    Fault('numbers jump by 7', _jump(7, 7_000), ('lost',)),
    Fault('numbers jump by 100,000', _jump(100_000, 100_000_000), ('lost',)),
    Fault('device restarts', _restart(), ('device restarts',)),
    Fault('device restarts 50 before 2^32', _restart(2**32 - 50), ('device restarts',)),
    Fault('device clock jumps ahead 10 s', _jump(0, 10_000_000), ('device clock jumps',)),
    Fault('device clock jumps back 10 s', _jump(0, -10_000_000), ('device clock jumps', 'device restarts')),
    Fault('device overrun of 30 samples', _overrun, ('lost: dropped by the device',)),
    Fault('port stalled for 0.3 s', _while(0.3, hold=True), ()),
    Fault('port stalled for 1 s', _while(1.0, hold=True), ()),
    Fault('device silent for 2.4 s', _while(2.4, mute=True), ('silences',)),
    Fault('device stopped until it is woken', _stopped, ('silences',)),
    Fault('node stopped for 0.3 s (SIGSTOP)', _frozen_node, ()),
    Fault('unknown frame type', _injected(lambda line: _sealed(b'\x7fhello')), BAD),
    Fault('sample of a wrong length, right CRC', _injected(lambda line: _sealed(b'\x01' + b'\x00' * 11)), BAD),
    Fault('HELLO that is no JSON', _injected(lambda line: _sealed(b'\x10\x01{not json')), BAD),
    Fault('HELLO of another rate', lambda line, pid: line.inject(encode(hello_of(rate=500.0))), ()),
    Fault('laser 1 off', _dark(2, 3), ('rejected: laser_lost',), estimates=True),
    Fault('laser 2 off', _dark(5, -2), ('rejected: laser_lost',), estimates=True),
    Fault('y1 saturated', _while(0.15, optics={1: 32767}), ('rejected: saturated',), estimates=True),
    Fault(
        'psd_2 stands still',
        _while(0.25, freeze=True),
        ('rejected: frozen', 'found: psd_2 stands still'),
        estimates=True,
    ),
)
