"""``make bench``, several rigs in one process: CPU of one core for each, and lost samples.

Each simulated rig is a process of its own, as a device would be; its CPU is not counted, but on a machine of few cores
it is in the way. A sample counts as lost if a number is missing from what the reader took, or if the queue to the
pipeline was full.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def run(rigs: int, settle: float, seconds: float) -> None:
    """Child process: runs the chain and prints what it cost as JSON."""
    from psd_deflection.chains.chain_file import read_chain
    from psd_deflection.runner.chain import ChainSession

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'chain.yaml'
        path.write_text('links:\n' + ''.join(f'  - {{name: link_{n}}}\n' for n in range(rigs)))
        chain = ChainSession(read_chain(path, {'realtime': True}), lambda line: None)
    try:
        chain.start()
        time.sleep(settle)
        counters = [session.acquisition.counters for session in chain.sessions]

        def count() -> list[float]:
            return [
                time.process_time(),
                time.monotonic(),
                sum(c.samples for c in counters),
                sum(c.lost + c.queue_dropped for c in counters),
                chain.composed,
                sum(chain.missing.values()),
            ]

        before = count()
        time.sleep(seconds)
        used, passed, samples, lost, composed, missing = (now - then for now, then in zip(count(), before, strict=True))
    finally:
        chain.close()
    print(
        json.dumps(
            {
                'share': used / passed,
                'rate': samples / passed,
                'lost': lost,
                'composed': composed / passed,
                'missing': missing,
            }
        )
    )


def main() -> int:
    """Measure, print one line for each number of rigs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rigs', type=int, nargs='+', default=[1, 2, 4, 8])
    parser.add_argument('--seconds', type=float, default=20.0)
    parser.add_argument('--settle', type=float, default=3.0)
    parser.add_argument('--child', action='store_true', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        run(args.rigs[0], args.settle, args.seconds)
        return 0
    print(f'rigs in one process, {args.seconds:g} s each, without ROS and recording')
    for rigs in args.rigs:
        command = [sys.executable, __file__, '--child', '--rigs', str(rigs)]
        command += ['--seconds', str(args.seconds), '--settle', str(args.settle)]
        said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
        got = json.loads(said.splitlines()[-1])
        print(
            f'  {rigs} rigs: {100 * got["share"]:5.1f} % of a core, {100 * got["share"] / rigs:4.1f} % a rig; '
            f'{got["rate"]:.0f} samples/s, {got["lost"]:.0f} lost; {got["composed"]:.1f} composed/s, '
            f'{got["missing"]:.0f} not composed'
        )
    return 0


if __name__ == '__main__':
    sys.exit(main())
