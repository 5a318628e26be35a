# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A million HELLOs of any words against the running daemon, between the samples: it measures on."""

import random
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.campaign.fuzz import Choices, hello_words
from bench.campaign.line import Line, hello_of, identities
from blind.campaign import conclude, options
from psd_deflection.devices.protocol.frames import HelloFrame, encode
from psd_deflection.recordings.read.readers import open_recording
from tools.program import PSD_DEFLECTION, Program

BACKLOG = 20_000  # Bytes: HELLOs wait while more than that is on its way.

OTHER_SERIAL = 10_000
AFTER_S = 3.0  # Samples of that long follow the last HELLO.


def hello(chance: random.Random, number: int) -> bytes:
    """One frame; b'' if the words do not fit into one."""
    good = hello_of().info
    info = hello_words(Choices(chance.randbytes(200)), good)
    if number % OTHER_SERIAL:
        info['serial'] = good['serial']
    try:
        return encode(HelloFrame(1, info))
    except (ValueError, OverflowError):
        return b''


def send(line: Line, daemon: Program, count: int, seed: int) -> None:
    """Put them between the samples as fast as the daemon reads. SystemExit if it ends."""
    chance = random.Random(seed)
    sent = 0
    while sent < count:
        if daemon.process.poll() is not None:
            raise SystemExit(f'after {sent} HELLOs the daemon ended:\n{daemon.text[-4000:]}')
        if line.backlog() > BACKLOG:
            time.sleep(0.001)
            continue
        batch = bytearray()
        while len(batch) < BACKLOG // 4 and sent < count:
            if frame := hello(chance, sent):
                batch += frame
                sent += 1
        line.inject(bytes(batch))
        if sent % 50_000 < 100:
            print(f'\r{sent} of {count}', end='', file=sys.stderr, flush=True)
    print(file=sys.stderr)


def main() -> int:
    """Exit status 0 if no sample was invented, and all that followed the HELLOs were measured."""
    parser = options(__doc__)
    parser.add_argument('count', type=int, nargs='?', default=1_000_000)
    parser.add_argument('--seed', type=int, default=1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        line = Line(folder)
        command = [*PSD_DEFLECTION, 'estimator', '--no-ros', '--port', str(folder / 'port'), '--record', str(folder)]
        daemon = Program(command)
        daemon.until(r'θ')
        began = time.monotonic()
        send(line, daemon, args.count, args.seed)
        took = time.monotonic() - began
        after = line.next_identity()
        time.sleep(AFTER_S)
        read = line.wait_until_read()
        status = daemon.end()
        line.close()
        (bag,) = folder.glob('*/*.mcap')
        found = np.concatenate([identities(b.volts) for b in open_recording(bag).blocks()])
        invented = int((np.diff(found) <= 0).sum()) + int((found >= line.sent).sum())
        # The last block may be cut by the end of the run.
        wanted = set(range(after, read - 20))
        missing = len(wanted - set(found.tolist()))
        share = len(found) / (int(found[-1]) - int(found[0]) + 1)
        text = (
            f'{args.count} HELLOs in {took:.0f} s: {len(found)} samples, {share:.4%} of those sent meanwhile, '
            f'{invented} invented; of {len(wanted)} sent after the HELLOs {missing} missing; exit status {status}'
        )
        return conclude(text, status == 0 and not invented and not missing and bool(wanted))


if __name__ == '__main__':
    sys.exit(main())
