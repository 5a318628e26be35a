# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The whole test suite on other processors and on busy ones: ``make suites``; about an hour on two idle cores.

Each row is one run of every test, with another kernel of OpenBLAS, fewer of the instructions that numpy knows, fewer
cores, or busy loops beside it. A test whose answer depends on one of these is red in that row. Ends with status 1 if a
test is.

What each row printed is kept in ``build/suites``. A kernel that this processor cannot run is left out, and said.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bench.bits import ROOT, settings

OUT = ROOT / 'build' / 'suites'
BUSY_LOOP = (sys.executable, '-c', 'while True: pass')


@dataclass(frozen=True, slots=True)
class Row:
    """One run of the suite. ``settings``: names of ``bench.bits``, which change different libraries."""

    settings: tuple[str, ...] = ()
    cores: int = 2
    niceness: int = 0
    busy_loops: int = 0

    @property
    def name(self) -> str:
        """What is different, in words."""
        parts = [*self.settings, 'one core' if self.cores == 1 else f'{self.cores} cores']
        parts += [f'niceness {self.niceness}'] if self.niceness else []
        parts += [f'{self.busy_loops} busy loops'] if self.busy_loops else []
        return ', '.join(parts)


ROWS = (
    Row(),
    Row(('SkylakeX', 'libc without FMA')),
    Row(('Haswell', 'numpy without AVX-512')),
    Row(('Zen',), cores=1),
    Row(('Nehalem', 'numpy without AVX2'), niceness=19, busy_loops=2),
    Row(busy_loops=10),
)
"""Every setting and every load once."""


@dataclass(frozen=True, slots=True)
class Result:
    """Counts of tests, and the names of those that are red."""

    passed: int
    skipped: int
    red: tuple[str, ...]
    seconds: float


@contextlib.contextmanager
def busy(loops: int, niceness: int) -> Iterator[None]:
    """Processes that compute without end, as nice as the tests: beside others the tests would get no turn for hours."""
    processes = [subprocess.Popen(('nice', '-n', str(niceness), *BUSY_LOOP)) for _ in range(loops)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def run(row: Row, number: int, tests: Sequence[str]) -> Result:
    """Run the suite so."""
    environment = {**os.environ, 'OMP_NUM_THREADS': '1'}
    every, _ = settings()
    for setting in every:
        if setting.name in row.settings:
            environment |= setting.environment
    OUT.mkdir(parents=True, exist_ok=True)
    report, log = OUT / f'{number}.xml', OUT / f'{number}.log'
    report.unlink(missing_ok=True)
    cores = ','.join(map(str, sorted(os.sched_getaffinity(0))[: row.cores]))
    command = ['taskset', '--cpu-list', cores, 'nice', '-n', str(row.niceness), sys.executable, '-m', 'pytest']
    # Tests wait for ports, discs and DDS: one more than the cores keeps them busy.
    command += ['-n', str(row.cores + 1), f'--junit-xml={report}', *tests]
    began = time.monotonic()
    with busy(row.busy_loops, row.niceness), log.open('w') as out:
        status = subprocess.run(command, cwd=ROOT, env=environment, stdout=out, stderr=out, check=False).returncode
    seconds = time.monotonic() - began
    if not report.exists():
        return Result(0, 0, (f'no result, status {status}: {log}',), seconds)
    cases = list(ET.parse(report).iter('testcase'))
    red = [c for c in cases if c.find('failure') is not None or c.find('error') is not None]
    skipped = sum(c.find('skipped') is not None for c in cases)
    names = [f'{c.get("classname")}::{c.get("name")}' for c in red]
    if status and not names:
        names = [f'status {status}: {log}']
    return Result(len(cases) - skipped - len(red), skipped, tuple(names), seconds)


def main() -> int:
    """Run the rows and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    listed = '; '.join(f'{i} {row.name}' for i, row in enumerate(ROWS, 1))
    choices = range(1, len(ROWS) + 1)
    parser.add_argument('--rows', type=int, nargs='+', choices=choices, default=choices, help=listed)
    parser.add_argument('--tests', nargs='+', default=[], help='only these folders or files')
    args = parser.parse_args()
    _, left_out = settings()
    wide = max(len(row.name) for row in ROWS)
    print(f'{"row":<{wide + 2}}  passed  skipped  red  minutes', flush=True)
    any_red = False
    for number in args.rows:
        row = ROWS[number - 1]
        if missing := set(row.settings) & set(left_out):
            print(f'{number} {row.name:<{wide}}  not tried: this processor cannot run {", ".join(missing)}')
            continue
        result = run(row, number, args.tests)
        counts = f'{result.passed:>6}  {result.skipped:>7}  {len(result.red):>3}  {result.seconds / 60.0:>7.1f}'
        print(f'{number} {row.name:<{wide}}  {counts}', flush=True)
        for name in result.red:
            print(f'    {name}', flush=True)
        any_red |= bool(result.red)
    return 1 if any_red else 0


if __name__ == '__main__':
    sys.exit(main())
