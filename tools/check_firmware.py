# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make demo NAME=firmware``: runs the firmware in qemu, joins its UART to the daemon, and checks every sample."""

import argparse
import sys
import threading
import time
from pathlib import Path

from psd_deflection.base.log import texts
from psd_deflection.devices.ports import SerialPort
from psd_deflection.devices.protocol import frames as protocol
from psd_deflection.records import Record, SampleBlock
from psd_deflection.rig.config import load_rig
from psd_deflection.run.session import Session
from tools.program import Program

COMMAND = [
    *('qemu-system-arm', '-machine', 'mps2-an385', '-display', 'none', '-monitor', 'none', '-chardev', 'pty,id=uart')
]
PATIENCE_S = 60.0


def expected(number: int) -> tuple[int, ...]:
    """The counts that synthetic.c computes from a sample's number."""
    ramp = number % 2000 - 1000
    return (ramp, -ramp, 16384 + number % 7, number % 256, number % 5, 16384 - number % 11)


def dialogue(port: str) -> tuple[int, float]:
    """Request every answer in docs/protocol.md; return the bad frames and the median round trip of a PING, s."""
    line, decoder = SerialPort(port, 921_600), protocol.FrameDecoder()
    bad = 0

    def until(kind: type[protocol.Frame], record: list[protocol.Frame] | None = None) -> protocol.Frame:
        nonlocal bad
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            frames = decoder.feed(line.read(0.1))
            bad += sum(isinstance(f, protocol.BadFrame) for f in frames)
            if record is not None:
                record += frames
            for frame in frames:
                if isinstance(frame, kind):
                    return frame
        raise SystemExit(f'FAILED: no {kind.__name__} in {PATIENCE_S:g} s')

    line.write(b'\x00' + protocol.encode(protocol.HelloRequestFrame()))
    hello = until(protocol.HelloFrame)
    if not isinstance(hello, protocol.HelloFrame) or hello.version != 1:
        raise SystemExit(f'FAILED: HELLO is {hello!r}')
    until(protocol.StatusFrame)
    trips = []
    for cookie in range(100):
        asked = time.monotonic()
        line.write(protocol.encode(protocol.PingFrame(cookie)))
        pong = until(protocol.PongFrame)
        trips.append(time.monotonic() - asked)
        if not isinstance(pong, protocol.PongFrame) or pong.cookie != cookie:
            raise SystemExit(f'FAILED: {pong!r} answers PING {cookie}')
    line.write(protocol.encode(protocol.StopFrame()) + protocol.encode(protocol.PingFrame(0)))
    until(protocol.PongFrame)
    # Samples that were under way have arrived; from here on only HELLO and STATUS may come.
    quiet: list[protocol.Frame] = []
    line.write(protocol.encode(protocol.PingFrame(1)))
    until(protocol.PongFrame, quiet)
    quiet = []
    until(protocol.StatusFrame, quiet)
    if any(isinstance(f, protocol.SampleFrame) for f in quiet):
        raise SystemExit('FAILED: samples after STOP')
    line.write(protocol.encode(protocol.StartFrame()))
    until(protocol.SampleFrame)
    line.close()
    return bad, sorted(trips)[len(trips) // 2]


class Checked:
    """Counts samples and those whose counts are not what the firmware makes of their number. ``enough`` is set once
    their stamps span ``seconds``."""

    def __init__(self, seconds: float) -> None:
        self.samples = 0
        self.wrong = 0
        self.span_s = 0.0
        self.enough = threading.Event()
        self._seconds = seconds
        self._first_ns = 0

    def put(self, record: Record) -> None:
        if not isinstance(record, SampleBlock):
            return
        self._first_ns = self._first_ns or int(record.t_ns[0])
        self.span_s = (int(record.t_ns[-1]) - self._first_ns) / 1e9
        if self.span_s >= self._seconds:
            self.enough.set()
        for seq, volts in zip(record.seq.tolist(), record.volts.tolist(), strict=True):
            self.samples += 1
            self.wrong += tuple(round(v * 32768 / 10) for v in volts) != expected(seq)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('elf', type=Path)
    parser.add_argument('--seconds', type=float, default=20.0)
    args = parser.parse_args()
    qemu = Program([*COMMAND, '-serial', 'chardev:uart', '-kernel', str(args.elf.resolve())])
    try:
        port = qemu.until(r'redirected to (\S+)')[1]
        bad, trip = dialogue(port)
        session = Session(load_rig(overrides={'port': port}), texts(lambda text: print(f'  {text}', file=sys.stderr)))
        checked = Checked(args.seconds)
        session.processing.sinks.append(checked)
        session.start()
        checked.enough.wait(10.0 * args.seconds)
        clock = session.acquisition.clock_state()
        session.close()
    finally:
        qemu.end()
    counters = session.acquisition.counters
    lost = f'{counters.lost} lost ({counters.device_overruns} dropped by the device)'
    print(f'firmware in qemu: {checked.samples} samples in {checked.span_s:.1f} s, {lost},', end=' ')
    print(f'{checked.wrong} wrong, {bad + counters.bad} bad frames, {counters.restarts} restarts,', end=' ')
    print(f'skew {clock.skew_ppm:.1f} ppm, PING median {trip * 1e3:.2f} ms')
    # On a busy host the device in qemu drops samples: those sent and those reported as dropped must make up the time.
    enough = checked.enough.is_set() and checked.samples + counters.lost >= 0.95 * 1000 * checked.span_s
    enough = enough and checked.samples > 1000
    silent = counters.lost > counters.device_overruns or (counters.lost > 0 and counters.device_dropped == 0)
    good = enough and not (checked.wrong or bad or counters.bad or counters.restarts or silent)
    print('firmware: OK' if good else 'firmware: FAILED')
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
