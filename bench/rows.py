# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks find: rows of ours, peers and limits, measured in turns. ``bench/results.json``: of the page."""

import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / 'bench' / 'results.json'
BY_HAND = ROOT / 'build' / 'bench'  # Where a bench leaves what it finds, unless --results names a file.
PACKAGES = ('numpy', 'scipy', 'mcap', 'cobs', 'rclpy', 'pandas')
STEADY = 0.25  # Quartiles that are further apart than this share of their median: load from outside shows in them.


@dataclass
class Figure:
    """One thing measured several times. ``kind``: ours, peer or limit. The ratio of a peer is how many times as fast
    ours is (``bound``: at least), of a limit how many times as much ours takes (at most). ``bound`` of ours is what it
    must reach itself. None: there is none."""

    name: str
    kind: str
    median: float
    low: float
    high: float
    runs: int
    bound: float | None = None

    @property
    def quartile_range(self) -> float:
        """How far the quartiles are apart, as a share of the median; 0 of one run."""
        return (self.high - self.low) / self.median if self.median else 0.0


@dataclass
class Row:
    """One line of the table: ``figures`` begins with ours, all in ``unit``, less is better."""

    work: str
    unit: str
    figures: list[Figure] = field(default_factory=list)

    def ratio(self, figure: Figure) -> float:
        ours = self.figures[0].median
        return figure.median / ours if figure.kind == 'peer' else ours / figure.median

    def met(self, figure: Figure) -> bool:
        """Whether the bound holds; True if there is none."""
        if figure.bound is None:
            return True
        if figure.kind == 'ours':
            return figure.median >= figure.bound
        return self.ratio(figure) >= figure.bound if figure.kind == 'peer' else self.ratio(figure) <= figure.bound

    def verdict(self, figure: Figure) -> str:
        """met, not met, or that the quartiles of what is compared are too far apart to tell; '' without a bound."""
        if figure.bound is None:
            return ''
        quartile_range = max(figure.quartile_range, self.figures[0].quartile_range)
        if quartile_range > STEADY:
            return f'not judged: quartiles {100 * quartile_range:.0f} % apart, load from outside'
        return 'met' if self.met(figure) else 'not met'


def figure(name: str, kind: str, values: npt.ArrayLike, bound: float | None = None) -> Figure:
    """Of ``values``: their median, their quartiles, their number."""
    low, middle, high = (float(v) for v in np.percentile(np.asarray(values, np.float64), (25, 50, 75)))
    return Figure(name, kind, middle, low, high, np.size(values), bound)


Job = tuple[str, str, Callable[[], object], float | None]  # Name, kind, what to time, bound.


def in_turns(work: str, unit: str, scale: float, times: int, *jobs: Job) -> Row:
    """Time each of ``jobs`` ``times`` times, one after the other and again, so that a busy moment meets all. ``scale``:
    from s to ``unit``."""
    seconds: list[list[float]] = [[] for _ in jobs]
    for _ in range(times):
        for (_, _, job, _), taken in zip(jobs, seconds, strict=True):
            began = time.perf_counter()
            job()
            taken.append((time.perf_counter() - began) * scale)
    both = zip(jobs, seconds, strict=True)
    return Row(work, unit, [figure(name, kind, taken, bound) for (name, kind, _, bound), taken in both])


def piped(module: str, *words: str) -> subprocess.Popen[str]:
    """A child of ours, whose standard input and output are pipes."""
    command = [sys.executable, '-m', module, *words]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)


def notify(row: Row) -> None:
    print(row.work)
    for f in row.figures:
        words = f'  {f.name:52}{f.median:10.4g} {row.unit}  ({f.low:.4g} to {f.high:.4g}, {f.runs} runs)'
        if f.kind != 'ours':
            way = 'ours is so many times as fast' if f.kind == 'peer' else 'ours takes so many times as much'
            words += f'  {row.ratio(f):.2f} {way}'
        if f.bound is not None:
            words += f' (bound {f.bound:g}, {row.verdict(f)})'
        print(words, flush=True)


def keep(rows: Sequence[Row], path: Path, *, notified: bool = True) -> None:
    """Into the file of results, and printed unless not ``notified``."""
    for row in rows if notified else ():
        notify(row)
    by_work = {row.work: row for row in (read(path)[0] if path.is_file() else [])}
    by_work.update((row.work, row) for row in rows)
    tree = {'machine': machine(), 'rows': [asdict(row) for row in by_work.values()]}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(tree, indent=1) + '\n', encoding='utf-8')


def read(path: Path = RESULTS) -> tuple[list[Row], Mapping[str, Any]]:
    """The rows, and the machine they were measured on."""
    tree = json.loads(path.read_text(encoding='utf-8'))
    rows = [Row(r['work'], r['unit'], [Figure(**f) for f in r['figures']]) for r in tree['rows']]
    return rows, tree['machine']


def machine() -> dict[str, object]:
    """Where and of what the figures are; the load of the machine by others, of which the spread comes."""
    processor = re.search(r'model name\s*: (.+)', Path('/proc/cpuinfo').read_text(encoding='utf-8'))
    done = subprocess.run(['git', 'rev-parse', '--short=10', 'HEAD'], cwd=ROOT, capture_output=True, text=True)
    out: dict[str, object] = {'date': datetime.now(UTC).date().isoformat(), 'commit': done.stdout.strip()}
    out |= {'processor': processor[1] if processor else platform.machine(), 'cores': os.cpu_count()}
    out |= {'load': round(os.getloadavg()[0], 1), 'python': platform.python_version()}
    return out | {'versions': {name: importlib.metadata.version(name) for name in PACKAGES}}
