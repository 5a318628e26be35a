# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How many rigs at 1 kHz one process on one core takes without a lost sample: the curve of its CPU time."""

import argparse
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

from bench.rows import BY_HAND, Row, figure, keep, piped
from psd_deflection.base.log import null_log

SETTLE_S, TICK_S, WANTED = 3.0, 0.005, 32


class Still:
    """A feed of one and the same reading."""

    def __init__(self) -> None:
        from psd_deflection.rig.config import load_rig

        self.rig = load_rig()
        self.taken = 0
        self._row = [0, -4000, 10000, 0, -8000, 10000]

    def next(self) -> list[int]:
        self.taken += 1
        return self._row


def devices(count: int) -> None:
    """Child process: prints the ports of ``count`` devices, and serves them until its standard input closes."""
    from bench.live import until_stdin_closes
    from psd_deflection.devices.contract_frames import SimulatedFrames
    from psd_deflection.devices.pseudo_terminal import PseudoTerminal

    ports = [PseudoTerminal() for _ in range(count)]
    served = [SimulatedFrames(Still()) for _ in ports]  # type: ignore[arg-type]
    print(json.dumps([port.name for port in ports]), flush=True)
    stop, start = until_stdin_closes(), time.monotonic_ns()
    while not stop.wait(TICK_S):
        for port, device in zip(ports, served, strict=True):
            now = time.monotonic_ns() - start
            try:
                asked = os.read(port.master, 4096)
            except OSError:
                asked = b''
            stream = device.take(now)
            try:
                os.write(port.master, device.receive(asked, now) + stream)
            except OSError:
                continue


def sessions(ports: list[str], seconds: float) -> None:
    """Child process, on one core: a session a port; prints samples, losses and the share of the core."""
    from psd_deflection.rig.config import load_rig
    from psd_deflection.run.realtime import settle
    from psd_deflection.run.session import Session

    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    running = [Session(load_rig(None, {'port': port, 'keep_zero': False}), null_log) for port in ports]
    settle()
    for session in running:
        session.start()
    time.sleep(SETTLE_S)

    def totals() -> tuple[int, int]:
        counters = [session.acquisition.counters for session in running]
        return sum(c.samples for c in counters), sum(c.lost + c.queue_dropped for c in counters)

    (samples, lost), used, began = totals(), time.process_time(), time.monotonic()
    time.sleep(seconds)
    took = time.monotonic() - began
    now, missing = totals()
    share = (time.process_time() - used) / took
    print(json.dumps({'samples': (now - samples) / took, 'lost': missing - lost, 'share': share}))
    for session in running:
        session.close()


def measure(count: int, seconds: float) -> dict[str, float]:
    feeder = piped('bench.rigs', '--role', 'devices', '--rigs', str(count))
    assert feeder.stdout is not None
    ports = feeder.stdout.readline().strip()
    words = ('--role', 'sessions', '--ports', ports, '--seconds', str(seconds))
    output, _ = piped('bench.rigs', *words).communicate()
    feeder.communicate()
    reported: dict[str, float] = json.loads(output.splitlines()[-1])
    return reported


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--most', type=int, default=64, help='rigs at most; 1, 2, 4 ... are tried')
    parser.add_argument('--seconds', type=float, default=10.0, help='of each measurement')
    parser.add_argument('--results', type=Path, default=BY_HAND / 'results.json')
    parser.add_argument('--role', choices=('devices', 'sessions'), help=argparse.SUPPRESS)
    parser.add_argument('--rigs', type=int, default=1, help=argparse.SUPPRESS)
    parser.add_argument('--ports', type=json.loads, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role:
        devices(args.rigs) if args.role == 'devices' else sessions(args.ports, args.seconds)
        return 0
    print('rigs in one process on one core, without recording')
    most, count = 0, 1
    curve = Row('CPU of one rig of several in one process', '% of a core')
    while count <= args.most:
        result = measure(count, args.seconds)
        complete = result['lost'] == 0 and result['samples'] > 990.0 * count
        share = np.array([100 * result['share'] / count])
        curve.figures.append(figure(f'{count} rigs, {"nothing" if complete else "samples"} lost', 'ours', share))
        if not complete:
            break
        most, count = count, 2 * count
    name = f'{most} tried without a loss' if count > args.most else f'{count} lose samples'
    rigs = Row('rigs in one process on one core', 'rigs', [figure(name, 'ours', [most], WANTED)])
    keep([rigs, curve], args.results)
    return 0


if __name__ == '__main__':
    sys.exit(main())
