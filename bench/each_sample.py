# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""An estimate of every sample, with other programs beside it: what is lost, what it costs, when it is there.

    python -m bench.each_sample [--seconds 600] [--busy 2] [--block 1] [--decimation 20]

The node records. A loop that does nothing else runs beside it on each core (``--busy``). The latency of an estimate is
from the last byte of its sample written to the port to the callback in another process, beside a bare publisher's, 50
times a second, in the same process and the same minutes. The samples that are lost are those that its recording lacks.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import psd_deflection
from bench.live import Device, Node, child, cpu_seconds
from bench.rows import RESULTS, ROOT, Row, figure, keep, notify
from blind.campaign import options

BUSY_LOOP = (sys.executable, '-c', 'while True: pass')
SETTLE_S = 5.0
PARTS = 10
"""Parts of the run whose figures make the quartiles."""
LATENCY, CPU = 1.5, 35.0
"""At most: times a bare publisher's; % of a core."""


def measured(node_of: Node, seconds: float, block: int, busy: int) -> list[Row]:
    """One run of the node. Raises SystemExit if nothing was heard."""
    device = Device(block)
    device.thread.start()
    with tempfile.TemporaryDirectory() as folder:
        node = node_of.begin(device.port.name, '--record', folder)
        assert node.stderr is not None
        threading.Thread(target=node.stderr.read, daemon=True).start()
        subscriber, bare = child('subscriber'), child('bare')
        for one in (subscriber, bare):
            assert one.stdout is not None
            one.stdout.readline()
        loops = [subprocess.Popen(BUSY_LOOP) for _ in range(busy)]
        time.sleep(SETTLE_S)
        began, shares = time.monotonic(), []
        for _ in range(PARTS):
            used, since = cpu_seconds(node.pid), time.monotonic()
            time.sleep(seconds / PARTS)
            shares.append(100.0 * (cpu_seconds(node.pid) - used) / (time.monotonic() - since))
        for loop in loops:
            loop.kill()
            loop.wait()
        published, heard = bare.communicate()[0], subscriber.communicate()[0]
        node.terminate()
        node.wait(60.0)
        (recording,) = Path(folder).iterdir()
        seq = np.concatenate([b.seq for b in psd_deflection.open(recording).blocks()])
    device.stop.set()
    device.thread.join()
    sent = dict(json.loads(published))
    rows = [row for row in json.loads(heard) if row[2] > began * 1e9]
    theirs = [(t - sent[s]) / 1e6 for topic, s, t in rows if topic == '/bare' and s in sent]
    stamps, at = np.array([(s, t) for topic, s, t in rows if topic == '/link_tip/deflection']).T
    ours = latencies(stamps, at, np.array(device.written), 1_000_000 * block)
    what = f'an estimate of every {"sample" if block == 1 else f"{block} samples"}, {busy} busy loops beside it'
    lost = int(seq[-1] - seq[0] + 1 - len(seq))
    return [
        Row(
            f'{what}: latency, median',
            'ms',
            [
                figure('psd_deflection', 'ours', [np.median(part) for part in np.array_split(ours, PARTS)]),
                figure(
                    'bare rclpy publish to callback',
                    'limit',
                    [np.median(part) for part in np.array_split(theirs, PARTS)],
                    LATENCY,
                ),
            ],
        ),
        Row(
            f'{what}: CPU of the node, recording',
            '% of a core',
            [figure('node', 'ours', shares), figure('wanted at most', 'limit', [CPU], 1.0)],
        ),
        Row(f'{what}: samples that the recording lacks', f'of {len(seq)}', [figure('node', 'ours', [float(lost)])]),
    ]


def latencies(
    stamps: np.ndarray[tuple[int], np.dtype[np.int64]],
    at: np.ndarray[tuple[int], np.dtype[np.int64]],
    written: np.ndarray[tuple[int], np.dtype[np.int64]],
    period_ns: int,
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """ms from the time at which a block was written (ns, one after the other) to that at which it was heard.

    ``stamps`` say which blocks those are, from an unknown first one: that for which no estimate is heard before it was
    written, and the quickest is as quick as can be.
    """
    number = np.rint((stamps - stamps[0]) / period_ns).astype(np.int64)
    first = int(np.searchsorted(written, at[0])) - 1
    while first > 0 and float((at - written[np.minimum(first + number, len(written) - 1)]).min()) < 0.0:
        first -= 1
    return np.asarray((at - written[np.minimum(first + number, len(written) - 1)]) / 1e6, dtype=np.float64)


def main() -> int:
    parser = options(__doc__)
    parser.add_argument('--seconds', type=float, default=600.0)
    parser.add_argument('--busy', type=int, default=2, help='loops that do nothing, beside the node')
    parser.add_argument('--block', type=int, default=1, help='samples of an estimate')
    parser.add_argument('--decimation', type=int, default=20)
    parser.add_argument('--checkout', type=Path, default=ROOT, help='another version of this repository')
    parser.add_argument('--results', type=Path, default=RESULTS)
    args = parser.parse_args()
    more = [f'block_size:={args.block}', f'decimation:={args.decimation}']
    if args.checkout.resolve() != ROOT:
        more[1] = f'min_samples:={args.block}'
    rows = measured(Node(args.checkout.resolve(), more), args.seconds, args.block, args.busy)
    for row in rows:
        notify(row)
    if args.checkout.resolve() == ROOT:
        keep(rows, args.results)
    return 0


if __name__ == '__main__':
    sys.exit(main())
