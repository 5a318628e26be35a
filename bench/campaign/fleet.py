# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Many simulated recordings on a local Dask cluster: is the answer the serial one, byte for byte, with workers
killed?"""

import contextlib
import io
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from distributed import Client, LocalCluster
from distributed.diagnostics.plugin import SchedulerPlugin
from tqdm import tqdm

from blind.campaign import conclude, options
from psd_deflection.cli.main import main as psd_deflection

EFFECTS = ('sensor_rotation,psd=2,angle=0.01', 'axis_crosstalk,psd=1,xy=0.02', '')
LOOK_S = 0.02


class Found(NamedTuple):
    """One run: seconds, what was printed, the bytes of the Parquet file."""

    seconds: float
    message: str
    rows: bytes


def make(folder: Path, recordings: int, seconds: float) -> None:
    """Recordings below ``folder``, in ten folders."""
    for i in tqdm(range(recordings), unit=' recordings', disable=None, leave=False):
        below = folder / f'day_{i % 10}'
        below.mkdir(exist_ok=True)
        words = ['simulate', '--seed', str(i), '--loads', f'ramp:0,0,0;0,{-1 - i % 30},{0.1 * (i % 7)}:{seconds:g}']
        effect = EFFECTS[i % len(EFFECTS)]
        if effect:
            words += ['--effect', effect]
        with contextlib.redirect_stdout(io.StringIO()):
            status = psd_deflection([*words, '--out', str(below / f'run_{i:05}.mcap')])
        if status != 0:
            raise SystemExit(f'recording {i} could not be made: status {status}')


def replayed(folder: Path, out: Path, executor: str) -> Found:
    """All of them, by the command."""
    message = io.StringIO()
    began = time.perf_counter()
    words = ['replay', f'{folder}/**/*.mcap', '--compare', '--json', '--executor', executor, '--out', str(out)]
    with contextlib.redirect_stdout(message):
        status = psd_deflection(words)
    if status != 0:
        raise SystemExit(f'replay on {executor}: status {status}')
    return Found(time.perf_counter() - began, message.getvalue(), out.read_bytes())


@contextlib.contextmanager
def cluster_of(workers: int) -> Iterator[Any]:
    """A scheduler in this process and workers in processes of their own, which are started again when they end."""
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


class Done(SchedulerPlugin):  # type: ignore[misc]
    """Counts tasks that were done."""

    def __init__(self) -> None:
        self.count = 0

    def transition(self, key: object, start: str, finish: str, *_: object, **__: object) -> None:
        """Called by the scheduler for each change of a task."""
        self.count += finish == 'memory'


class Killer:
    """Kills workers of ``cluster`` that are busy, ``times`` in all, spread over the ``recordings``."""

    def __init__(self, cluster: Any, recordings: int, times: int) -> None:
        self._cluster = cluster
        self._at = [recordings * (n + 1) // (times + 2) for n in range(times)]
        self._given_up = threading.Event()
        self.killed: list[int] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        scheduler, done = self._cluster.scheduler, Done()
        scheduler.add_plugin(done)
        with Client(self._cluster, set_as_default=False) as client:
            before = done.count
            while len(self.killed) < len(self._at) and not self._given_up.wait(LOOK_S):
                if done.count - before < self._at[len(self.killed)]:
                    continue
                busy = [address for address, worker in list(scheduler.workers.items()) if worker.processing]
                if not busy:
                    continue
                pid = client.run(os.getpid, workers=busy[:1])[busy[0]]
                os.kill(pid, signal.SIGKILL)
                self.killed.append(pid)

    def end(self) -> None:
        self._given_up.set()
        self._thread.join()


def campaign(folder: Path, recordings: int, seconds: float, kills: int, one: bool = True) -> tuple[str, list[str]]:
    """What was found in words, and what is wrong. ``one``: measure a cluster of one worker too."""
    archive = folder / 'archive'
    archive.mkdir()
    make(archive, recordings, seconds)
    serial = replayed(archive, folder / 'serial.parquet', 'serial')
    runs: dict[str, Found] = {}
    if one:
        with cluster_of(1) as cluster:
            runs['one worker'] = replayed(archive, folder / 'one.parquet', _address(cluster))
        with cluster_of(2) as cluster:
            runs['two workers'] = replayed(archive, folder / 'two.parquet', _address(cluster))
    with cluster_of(2) as cluster:
        killer = Killer(cluster, recordings, kills)
        try:
            runs[f'two workers, {kills} killed'] = replayed(archive, folder / 'killed.parquet', _address(cluster))
        finally:
            killer.end()
    wrong = [f'{what}: the rows differ from the serial ones' for what, run in runs.items() if run.rows != serial.rows]
    wrong += [
        f'{what}: other lines than in the serial run' for what, run in runs.items() if run.message != serial.message
    ]
    if len(killer.killed) != kills:
        wrong.append(f'{len(killer.killed)} workers were killed, not {kills}')
    lines = [f'{recordings} recordings of {seconds:g} s, {len(serial.rows) / 1e6:.1f} MB of estimates']
    lines += [f'  {what:28}{run.seconds:8.1f} s' for what, run in {'this process': serial, **runs}.items()]
    if one:
        ratio = runs['one worker'].seconds / runs['two workers'].seconds
        lines.append(f'  two workers are {ratio:.2f} times as fast as one')
    lines.append('  every byte is that of the serial run' if not wrong else '  WRONG')
    return '\n'.join(lines), wrong


def _address(cluster: Any) -> str:
    return 'dask://' + str(cluster.scheduler_address).removeprefix('tcp://')


def main() -> int:
    """Run it; the exit status is 1 if anything differed."""
    parser = options(__doc__)
    parser.add_argument('--recordings', type=int, default=1000)
    parser.add_argument('--seconds', type=float, default=1.0, help='of each recording')
    parser.add_argument('--kills', type=int, default=2, help='workers that are killed on the way')
    parser.add_argument('--only-killed', action='store_true', help='only the run whose workers are killed')
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        message, wrong = campaign(Path(folder), args.recordings, args.seconds, args.kills, not args.only_killed)
    return conclude('\n'.join([message, *wrong]), not wrong)


if __name__ == '__main__':
    sys.exit(main())
