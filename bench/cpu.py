# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where the CPU time of the live node goes: by thread and part of the program."""

import gc
import importlib
import json
import os
import re
import signal
import sys
import tempfile
import threading
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.live import BLOCKS_PER_S, Device
from bench.rows import BY_HAND, ROOT, Row, figure, keep, piped
from blind.campaign import conclude, options

RESULTS = ROOT / 'bench' / 'cpu.json'
SETTLE_BLOCKS = 250  # Five seconds of blocks: what is imported and made at the start is over.
PATIENCE_S = 300.0  # Longest time until the node runs, s.
ENOUGH = 0.98  # Least share of the blocks that a node gets through which is not held up by others.
PARTS: dict[str, list[str]] = tomllib.loads((ROOT / 'bench' / 'cpu_parts.toml').read_text(encoding='utf-8'))
COLLECTION, REST = 'garbage collection', 'rest: waking up, waiting, loops'


def resolve(place: str) -> tuple[Any, str, Callable[..., Any]]:
    module, _, path = place.partition(':')
    *owners, name = path.split('.')
    owner: Any = importlib.import_module(f'psd_deflection.{module}')
    for part in owners:
        owner = getattr(owner, part)
    return owner, name, getattr(owner, name)


class Clocks:
    """CPU time (ns) and calls of each part in each thread, by the thread's native id. ``clock``: of this thread, ns."""

    def __init__(self, clock: Callable[[], int] = time.thread_time_ns) -> None:
        self.clock = clock
        self.spent: dict[int, Counter[str]] = defaultdict(Counter)
        self.calls: dict[int, Counter[str]] = defaultdict(Counter)
        self._inside = threading.local()

    def enter(self) -> None:
        stack = self._inside.__dict__.setdefault('stack', [])
        # Its clock, and the time in parts inside it.
        stack.append([self.clock(), 0])

    def leave(self, part: str) -> None:
        stack = self._inside.stack
        began, within = stack.pop()
        took = self.clock() - began
        if stack:
            stack[-1][1] += took
        thread = threading.get_native_id()
        self.spent[thread][part] += took - within
        self.calls[thread][part] += 1

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:

        def measured(*args: Any, **options: Any) -> Any:
            self.enter()
            try:
                return function(*args, **options)
            finally:
                self.leave(part)

        return measured

    def collects(self, phase: str, _: object) -> None:
        if phase == 'start':
            self.enter()
        else:
            self.leave(COLLECTION)

    def cost_ns(self) -> float:
        """What one call of a measured function costs more, ns."""
        nothing = Clocks(self.clock).timed('', lambda: None)
        before = time.thread_time_ns()
        for _ in range(2000):
            nothing()
        return (time.thread_time_ns() - before) / 2000

    def state(self) -> dict[str, Any]:
        """What is known now: of each thread its name, its CPU time and that of its parts, ns."""
        names = {thread.native_id: thread.name for thread in threading.enumerate()}
        out = {}
        for task in Path('/proc/self/task').iterdir():
            used = int((task / 'schedstat').read_text().split()[0])
            number = int(task.name)
            name = names.get(number) or (task / 'comm').read_text().strip()
            shown = re.sub(r'[.0-9]+$|_?\d+$', '', name) or name
            spent, calls = dict(self.spent[number]), sum(self.calls[number].values())
            out[task.name] = {'name': shown, 'used': used, 'spent': spent, 'calls': calls}
        return out


def node(port: str, folder: str, seconds: float) -> int:
    """Child process: the node with clocks in it; prints what a window of ``seconds`` took, then waits for a signal."""
    from psd_deflection.cli.main import main as command_line

    clocks = Clocks()
    for part, places in PARTS.items():
        for place in places:
            owner, name, function = resolve(place)
            setattr(owner, name, clocks.timed(part, function))
    gc.callbacks.append(clocks.collects)
    out = os.fdopen(os.dup(1), 'w')

    def blocks() -> int:
        return sum(calls['fit of the block'] for calls in tuple(clocks.calls.values()))

    def watch() -> None:
        while (fits := blocks()) < SETTLE_BLOCKS:
            time.sleep(0.2)
        before, began = clocks.state(), time.monotonic()
        time.sleep(seconds)
        reported = {'before': before, 'after': clocks.state(), 'took': time.monotonic() - began}
        more = {'cost': clocks.cost_ns(), 'blocks': blocks() - fits}
        print(json.dumps({**reported, **more}), file=out, flush=True)

    threading.Thread(target=watch, name='measurement', daemon=True).start()
    return command_line(['estimator', '--port', port, '--record', folder])


def parts(reported: dict[str, Any]) -> tuple[dict[tuple[str, str], float], float, float]:
    """Of :func:`node`: CPU time (s) by thread and part, the window, s, and the clocks' share of it."""
    out: defaultdict[tuple[str, str], float] = defaultdict(float)
    calls = 0
    for number, after in reported['after'].items():
        if after['name'] == 'measurement':
            continue
        before = reported['before'].get(number, {'used': 0, 'spent': {}, 'calls': 0})
        name = after['name']
        used = after['used'] - before['used']
        spent = {part: ns - before['spent'].get(part, 0) for part, ns in after['spent'].items()}
        calls += after['calls'] - before['calls']
        shown = REST if spent else 'all of it'
        for part, ns in {**spent, shown: used - sum(spent.values())}.items():
            out[name, part] += ns / 1e9
    positive = {key: s for key, s in out.items() if s > 0.0}
    return positive, reported['took'], calls * reported['cost'] / 1e9 / sum(positive.values())


def measure(seconds: float) -> tuple[dict[tuple[str, str], float], float, float]:
    with Device() as device, tempfile.TemporaryDirectory() as folder:
        words = ['--node', device.port.name, '--folder', folder, '--seconds', f'{seconds:g}']
        child = piped('bench.cpu', *words)
        timer = threading.Timer(PATIENCE_S + seconds, child.kill)
        timer.start()
        assert child.stdout is not None
        line = next((line for line in child.stdout if line.startswith('{')), '')
        try:
            if not line:
                raise SystemExit('bench.cpu: the node ended before it was measured')
        finally:
            timer.cancel()
            child.send_signal(signal.SIGTERM)
            child.wait(60.0)
    reported = json.loads(line)
    if reported['blocks'] < ENOUGH * BLOCKS_PER_S * reported['took']:
        slow = f'bench.cpu: {reported["blocks"]} blocks in {reported["took"]:.0f} s: others take the processors'
        print(f'{slow}, and the parts of the threads that wait for them come out too small', file=sys.stderr)
    return parts(reported)


def row_of(spent: dict[tuple[str, str], float], took: float, clocks: float) -> Row:
    total = sum(spent.values())
    threads: defaultdict[str, float] = defaultdict(float)
    for (thread, _), s in spent.items():
        threads[thread] += s
    share = f'{100.0 * total / took:.1f} % of a core, clocks {100.0 * clocks:.0f} % of it'
    row = Row(f'CPU of the node by part: {share}', '%')
    for thread in sorted(threads, key=threads.__getitem__, reverse=True):
        for (name, part), s in sorted(spent.items(), key=lambda item: -item[1]):
            if name == thread and s >= 0.001 * total:
                row.figures.append(figure(f'{thread}: {part}', 'ours', [100.0 * s / total]))
    return row


def main() -> int:
    parser = options(__doc__)
    parser.add_argument('--seconds', type=float, default=20.0, help='of each window (default: 20)')
    parser.add_argument('--results', type=Path, default=BY_HAND / 'cpu.json')
    parser.add_argument('--node', help='of the child process: the port')
    parser.add_argument('--folder', help='of the child process: where it records')
    args = parser.parse_args()
    if args.node:
        return node(args.node, args.folder, args.seconds)
    row = row_of(*measure(args.seconds))
    args.results.unlink(missing_ok=True)
    keep([row], args.results, notified=False)
    return conclude('\n'.join([row.work, *(f'  {f.median:5.1f} %  {f.name}' for f in row.figures)]))


if __name__ == '__main__':
    sys.exit(main())
