# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make campaign NAME=faults``: a scripted campaign against the real node over a pseudo-terminal."""

import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2

from bench.campaign.kinds import FAULTS, Fault
from bench.campaign.line import DIGIT, VOLTS_PER_COUNT, Line, identities
from blind.campaign import options
from psd_deflection.recordings.read.readers import open_recording
from tools.program import PSD_DEFLECTION, Program

START_S = 300.0
RECOVER_S = 5.0
BACK_S = 1.0  # A device that is back is read again within this.


@dataclass(slots=True)
class Row:
    """One fault's figures."""

    fault: Fault
    injected: int = 0
    detected: int = 0
    recovered: int = 0
    times: list[float] = field(default_factory=list)
    windows: list[tuple[int, int]] = field(default_factory=list)


class Witness:
    """Another participant: newest identity and estimate, and the counters of the last report."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node('campaign')
        self.newest = -1
        self.estimates = 0
        self.reports = 0
        self.counters: dict[str, float] = {}
        self.node.create_subscription(PointCloud2, '/psd/samples', self._cloud, 50)
        self.node.create_subscription(PoseStamped, '/link_tip/deflection', self._pose, 50)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._report, 10)

    def _cloud(self, cloud: PointCloud2) -> None:
        names = [f.name for f in cloud.fields]
        points = np.frombuffer(bytes(cloud.data), np.dtype('<u4')).reshape(-1, len(names))[-1]
        low = np.rint(points[names.index('x1')].view('<f4') / VOLTS_PER_COUNT) + DIGIT // 2
        high = np.rint(points[names.index('x2')].view('<f4') / VOLTS_PER_COUNT) + DIGIT // 2
        self.newest = max(self.newest, int(low + high * DIGIT))

    def _pose(self, pose: PoseStamped) -> None:
        self.estimates += 1

    def _report(self, report: DiagnosticArray) -> None:
        counters = {}
        for status in report.status:
            for value in status.values:
                if value.value.lstrip('-').isdigit():
                    counters[value.key] = float(value.value)
        self.counters = counters
        self.reports += 1

    def spin_until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Serve the subscriptions until ``condition()``; whether it came true in time."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            rclpy.spin_once(self.node, timeout_sec=0.01)
        return True

    def next_report(self) -> dict[str, float]:
        """The counters of the next report."""
        observed = self.reports
        self.spin_until(lambda: self.reports > observed, 5.0)
        return self.counters


def inject(row: Row, line: Line, witness: Witness, pid: int) -> None:
    fault = row.fault
    before = witness.counters
    first = line.next_identity()
    row.injected += 1
    fault.act(line, pid)
    over, target, estimates = time.monotonic(), line.next_identity(), witness.estimates
    if fault.estimates:
        # What was under way when the fault ended is no sign of recovery: a whole block later is.
        witness.spin_until(lambda: witness.newest >= target + 20, RECOVER_S)
        estimates = witness.estimates
        recovered = witness.spin_until(lambda: witness.estimates > estimates, RECOVER_S)
    else:
        recovered = witness.spin_until(lambda: witness.newest >= target, RECOVER_S)
    took = time.monotonic() - over
    row.recovered += recovered
    row.times.append(took)
    row.windows.append((first, line.next_identity()))
    after = witness.next_report()
    row.detected += not fault.observed or any(after.get(k, 0.0) > before.get(k, 0.0) for k in fault.observed)


def lost_samples(rows: list[Row], line: Line, recording: Path, start: int, end: int) -> dict[str, tuple[int, int]]:
    """Fault name -> (samples that arrived whole and are not in the recording, samples the fault took)."""
    present: set[int] = set()
    for block in open_recording(recording).blocks():
        present.update(identities(block.volts).tolist())
    out = {}
    accounted: set[int] = set()
    for row in rows:
        numbers = {i for a, b in row.windows for i in range(a, b)}
        accounted |= numbers
        taken = numbers & line.taken_by_fault
        # The optics change the digits themselves.
        out[row.fault.name] = (0 if row.fault.estimates else len(numbers - taken - present), len(taken))
    rest = set(range(start, end)) - accounted - line.taken_by_fault - present
    out['between the faults'] = (len(rest), 0)
    for first in sorted(i for i in rest if i - 1 not in rest):
        last = next(i for i in range(first, end + 1) if i + 1 not in rest)
        before = max(((b, row.fault.name) for row in rows for _, b in row.windows if b <= first), default=(0, 'start'))
        print(f'missing: {first} to {last}, {first - before[0]} samples after "{before[1]}" was over', file=sys.stderr)
    return out


def report(rows: list[Row], lost: dict[str, tuple[int, int]]) -> bool:
    """Print the table; whether all is as it must be."""
    print(
        f'{"fault":52} {"times":>5} {"detected":>8} {"recovered":>9} {"median s":>8} {"worst s":>8} '
        f'{"taken":>7} {"lost":>5}'
    )
    good = True
    for row in rows:
        missing, taken = lost[row.fault.name]
        worst = max(row.times)
        detected = str(row.detected) if row.fault.observed else '-'
        fine = row.recovered == row.injected == row.detected and missing == 0
        fine = fine and (not row.fault.back or worst <= BACK_S)
        good = good and fine
        print(
            f'{row.fault.name:52} {row.injected:5d} {detected:>8} {row.recovered:9d} {np.median(row.times):8.3f} '
            f'{worst:8.3f} {taken:7d} {missing:5d}{"" if fine else "  <-- NOT AS IT MUST BE"}'
        )
    between = lost['between the faults'][0]
    print(f'{"between the faults":52} {"":40} {"":7} {between:5d}')
    return good and between == 0


def main() -> int:
    """Run the campaign; exit status 0 where every fault was survived."""
    parser = options(__doc__)
    parser.add_argument('--times', type=int, default=20, help='injections of each fault')
    parser.add_argument('--only', default='', help='only faults whose name holds this')
    args = parser.parse_args()
    chosen = [f for f in FAULTS if args.only in f.name]
    os.environ.setdefault('ROS_DOMAIN_ID', '77')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ['XDG_STATE_HOME'] = os.environ['ROS_LOG_DIR'] = str(folder)
        line = Line(folder)
        arguments = ['--port', f'{folder}/port*', '--record', str(folder / 'bags')]
        node = Program([*PSD_DEFLECTION, 'estimator', *arguments])
        witness = Witness()
        rows = [Row(f) for f in chosen]
        try:
            if not witness.spin_until(lambda: witness.newest > 2000 and witness.reports > 2, START_S):
                raise SystemExit(node.text)
            start = line.next_identity()
            for number in range(args.times):
                for row in rows:
                    inject(row, line, witness, node.process.pid)
                print(f'round {number + 1} of {args.times}', file=sys.stderr, flush=True)
            end = line.next_identity()
            witness.spin_until(lambda: witness.newest > end + 100, 10.0)
            counters = witness.next_report()
            print({k: v for k, v in counters.items() if 'drop' in k or 'lost' in k or k == 'disconnects'})
        finally:
            node.end()
            line.close()
        (recording,) = (folder / 'bags').iterdir()
        good = report(rows, lost_samples(rows, line, recording, start, end))
        if not good:
            print(node.text[-6000:], file=sys.stderr)
    rclpy.shutdown()
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
