# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The live page left open on a live daemon: its heap every minute (``make campaign NAME=page-soak``)."""

import csv
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TextIO

from blind.campaign import conclude, options
from tools.browser import heap_bytes, open_browser

SETTLED_MINUTES = 5
ALLOWED_BYTES = 200_000
HEAD = ('minute', 'heap_bytes', 'nodes', 'rows')


def daemon(folder: Path, rate: float) -> tuple[subprocess.Popen[str], str]:
    """A daemon on the simulated rig, and the address of its page."""
    rig = folder / 'rig.yaml'
    values = f'monitor_port: 0\n    converter:\n      sample_rate_hz: {1000.0 * rate}\n'
    rig.write_text(f'/**:\n  ros__parameters:\n    {values}')
    words = ['estimator', '--no-ros', '--monitor', '--params-file', str(rig)]
    command = [str(Path(sys.executable).with_name('psd-deflection')), *words]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        if found := re.search(r'http://\S+', line):
            return process, found.group()
    raise RuntimeError(f'the daemon ended with {process.wait()} and served no page')


def soak(minutes: int, rate: float, out: TextIO) -> list[dict[str, int]]:
    """One row a minute, written to ``out`` as it is read."""
    rows: list[dict[str, int]] = []
    with tempfile.TemporaryDirectory() as name:
        process, url = daemon(Path(name), rate)
        # The daemon's live line must not fill the pipe.
        drain = subprocess.Popen(['cat'], stdin=process.stderr, stdout=subprocess.DEVNULL)
        driver = open_browser(Path(name) / 'profile', '--window-size=1440,900')
        table = csv.DictWriter(out, HEAD)
        table.writeheader()
        try:
            driver.get(url)
            began = time.monotonic()
            for minute in range(1, minutes + 1):
                time.sleep(max(began + 60.0 * minute - time.monotonic(), 0.0))
                heap = heap_bytes(driver)
                nodes, observed = driver.execute_script(
                    'return [document.querySelectorAll("*").length, Number(document.body.dataset.rows ?? 0)]'
                )
                rows.append(dict(zip(HEAD, (minute, heap, nodes, observed), strict=True)))
                table.writerow(rows[-1])
                out.flush()
        finally:
            driver.quit()
            process.terminate()
            process.wait(30)
            drain.terminate()
    return rows


def main() -> int:
    parser = options(__doc__)
    parser.add_argument('--hours', type=float, default=4.0, help='how long (default: 4)')
    parser.add_argument('--rate', type=float, default=1.0, help='times 1000 samples a second (default: 1)')
    parser.add_argument('--out', type=Path, default=Path('build/page_soak.csv'), help='the table')
    args = parser.parse_args()
    # A run that is told to end takes its daemon and its browser along.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with args.out.open('w', newline='') as out:
        rows = soak(round(60.0 * args.hours), args.rate, out)
    settled = [row['heap_bytes'] for row in rows if row['minute'] >= SETTLED_MINUTES]
    if not settled:
        return conclude(f'{len(rows)} minutes: too short to tell, the heap settles in {SETTLED_MINUTES}', False)
    span = max(settled) - min(settled)
    text = (
        f'{len(rows)} minutes, {rows[-1]["rows"]} blocks: heap {min(settled) / 1e6:.2f} to {max(settled) / 1e6:.2f} MB '
        f'from minute {SETTLED_MINUTES} on, {span / 1e3:.0f} kB apart ({ALLOWED_BYTES / 1e3:.0f} allowed)'
    )
    return conclude(text, span <= ALLOWED_BYTES)


if __name__ == '__main__':
    sys.exit(main())
