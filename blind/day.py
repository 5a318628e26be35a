# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A newcomer's day, by commands alone, on a device that is not ours: ``python -m blind.day [--turn 0.02]``.

The device is a pseudo-terminal with frames made here and the physics of the second generator (:mod:`blind.generator`):
one of its detectors is turned. A person takes the zero, hangs five weights in turn, and notes each some seconds late
(``psd-deflection load``). Then ``discover`` is asked once. Printed is what it said; the exit status is 1 if it did not
name the detector with the true angle within three standard deviations, or a load that it says was late was not.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import struct
import subprocess
import sys
import tempfile
import threading
import time
import tty
import zlib
from pathlib import Path

import numpy as np
from cobs import cobs

from blind.campaign import options
from blind.generator import LSB, RATE, Array, Generator

LOADS_IN_TURN = ((0, -20, 0), (0, -50, 0), (0, -50, -29.25), (30, 0, 0), (20, -40, 12), (0, 0, 0))
"""N, N, N m: five weights, then none."""
FIRST_S, EACH_S = 16.0, 12.0
"""On a slow machine a command takes seconds: the zero must be taken before the first weight hangs."""
NEAR_S = 0.05
"""By that a time may be determined otherwise."""
HELLO = {'serial': 'BLIND-1', 'firmware': 'day', 'sample_rate_hz': RATE, 'volts_per_count': LSB}


def frame(kind: int, body: bytes) -> bytes:
    """Return one frame of the contract."""
    plain = bytes([kind]) + body
    return bytes(cobs.encode(plain + struct.pack('<I', zlib.crc32(plain)))) + b'\0'


def hello() -> bytes:
    """Who the device is."""
    reported = {**HELLO, 'channels': ['x1', 'y1', 'sum1', 'x2', 'y2', 'sum2']}
    return frame(0x10, b'\x01' + json.dumps(reported).encode())


class Device:
    """Sends ``counts`` (n, 6) by the clock, from when it is first listened to, and answers."""

    def __init__(self, counts: Array) -> None:
        self._counts = counts.astype(np.int16)
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self.began = time.monotonic()
        self.lost = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        sent, message, asked = 0, -1.0, b''
        while sent < len(self._counts):
            time.sleep(0.004)
            now = time.monotonic() - self.began
            out = []
            if now - message >= 1.0:
                out.append(hello())
                message = now
            with contextlib.suppress(OSError):
                asked += os.read(self._master, 4096)
            *lines, asked = asked.split(b'\0')
            out += [self._answer(f, now) for f in lines]
            due = min(round(now * RATE), len(self._counts))
            for i in range(sent, due):
                row = struct.pack('<BIQ6h', 0, i, round(i * 1e6 / RATE), *self._counts[i].tolist())
                out.append(frame(0x01, row))
            try:
                os.write(self._master, b''.join(out))
            except OSError:
                self.lost += due - sent
            sent = due

    @staticmethod
    def _answer(encoded: bytes, now: float) -> bytes:
        try:
            asked = cobs.decode(encoded)
        except cobs.DecodeError:
            return b''
        if asked[:1] == b'\x12':
            return frame(0x13, asked[1:9] + struct.pack('<Q', round(1e6 * now)))
        return hello() if asked[:1] == b'\x11' else b''


def measured(turn: float, seed: int) -> tuple[Array, list[float]]:
    """Counts (n, 6) of the day, and when each of the loads began to act, s."""
    times = [FIRST_S + EACH_S * i for i in range(len(LOADS_IN_TURN))]
    n = round((times[-1] + EACH_S) * RATE)
    loads = np.zeros((n, 3))
    for at, load in zip(times, LOADS_IN_TURN, strict=True):
        loads[round(at * RATE) :] = load
    rotated = {'name': 'sensor_rotation', 'psd': 1, 'angle': turn}
    volts = Generator(loads, np.full(n, 21.0), 0.585).record([rotated], 'white', seed)
    return np.rint(volts / LSB), times


def command(*words: str) -> str:
    """What a command of ours prints; it must succeed."""
    line = [sys.executable, '-m', 'psd_deflection', *words]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300.0)
    if done.returncode:
        raise SystemExit(f'{" ".join(words)}: exit status {done.returncode}: {done.stderr}')
    return done.stdout


def recorded(turn: float, seed: int, folder: Path) -> tuple[Path, list[tuple[float, float]]]:
    """Return the recording of the day below ``folder``, and how late each load was noted, s, at least and at most."""
    counts, times = measured(turn, seed)
    late = np.random.default_rng(seed).uniform(1.0, 5.0, len(times)).round(1).tolist()
    device = Device(counts)
    line = ['estimator', '--no-ros', '--port', device.port, '--monitor', '--monitor-port', '0', '--record', str(folder)]
    daemon = subprocess.Popen([sys.executable, '-m', 'psd_deflection', *line], stderr=subprocess.PIPE, text=True)
    if daemon.stderr is None:
        raise SystemExit('the daemon says nothing')
    url = next(words.split()[1] for words in daemon.stderr if words.startswith('monitor: '))
    threading.Thread(target=daemon.stderr.read, daemon=True).start()

    def until(seconds: float) -> None:
        time.sleep(max(device.began + seconds - time.monotonic(), 0.0))

    until(4.0)
    print(command('zero', '--url', url).strip())
    print(command('load', '--url', url, '0', '0', '0').strip())
    annotated = []
    for at, load, seconds in zip(times, LOADS_IN_TURN, late, strict=True):
        until(at + seconds)
        words = [f'{v:g}' for v in load]
        print(f'hung at {at:g} s, noted {seconds:g} s later: load {" ".join(words)}: ', end='')
        asked = time.monotonic() - device.began
        print(command('load', '--url', url, *words).strip())
        annotated.append((asked - at, time.monotonic() - device.began - at))
    until(times[-1] + EACH_S)
    daemon.terminate()
    daemon.wait(60.0)
    print(f'{device.lost} samples were lost by the device')
    (found,) = folder.iterdir()
    return found, annotated


def evaluated(out: Path, turn: float, late: list[tuple[float, float]]) -> list[str]:
    """What is wrong with the answer in ``out``; nothing if it is right."""
    message = json.loads((out / 'result.json').read_text())
    wrong = []
    sizes = [e['parameters'] for e in message['effects'] if e['name'] == 'sensor_rotation']
    if len(message['effects']) != 1 or not sizes or sizes[0]['psd'] != 1:
        wrong.append(f'effects: {[e["name"] for e in message["effects"]]}')
    elif abs(sizes[0]['angle']['value'] - turn) > 3.0 * sizes[0]['angle']['sd'] + 1e-3 * abs(turn):
        wrong.append(f'angle {sizes[0]["angle"]}, true {turn}')
    reported = {int(re.sub(r'\D', '', s['where'])): s['value'] for s in message['setup'] if s['name'] == 'load_time'}
    for i, (least, most) in enumerate(late, start=1):
        if not least - NEAR_S < reported.get(i, 0.0) < most + NEAR_S:
            wrong.append(f'load {i}: said {reported.get(i)} s late, was {least:.2f} to {most:.2f} s')
    return wrong + [f'{message["verdict"]}, unknown: {u["signature"]}' for u in message['unknown']]


def main() -> int:
    """Return the day, and what was said."""
    parser = options(__doc__)
    parser.add_argument('--turn', type=float, default=0.02, help='of the first detector, rad (default: 0.02)')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--out', type=Path, help='folder for the answer')
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recording, late = recorded(args.turn, args.seed, Path(folder) / 'recordings')
        out = args.out or Path(folder) / 'found'
        print(command('discover', str(recording), '--out', str(out), '--quiet'))
        wrong = evaluated(out, args.turn, late)
    print('\n'.join(wrong) or 'named, with its size')
    return int(bool(wrong))


if __name__ == '__main__':
    sys.exit(main())
