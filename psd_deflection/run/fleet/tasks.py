# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Many recordings: which they are by the words of a command line, one task for each on one of several engines (this
process, processes of this machine, Dask; all through :mod:`concurrent.futures`), answered in their order."""

import concurrent.futures
import contextlib
import glob
import importlib
import multiprocessing
import os
import re
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from psd_deflection import __version__
from psd_deflection.base.errors import ConfigError, DaemonError, PsdDeflectionError, RecordingError, UsageError
from psd_deflection.recordings.formats.format import endings_of_recordings

T = TypeVar('T')

SERIAL = 'serial'
FORMS = 'serial, processes, processes:N, dask://HOST:PORT or dask+tls://HOST:PORT'
CONNECT_S = 10.0
DASK_SLOTS = 256
"""Tasks that a scheduler is given at a time: enough that a cluster that grows with its work does."""

_PROCESSES = re.compile(r'processes(?::([1-9]\d{0,3}))?')
_DASK = re.compile(r'dask(?:\+tls)?://([^\s/]+:\d{1,5})/?')


class Engine(Protocol):
    """``slots``: tasks that are given to it at a time."""

    slots: int

    def submit(self, task: Callable[..., T], *arguments: object) -> Future[T]:
        """Begin ``task``. Raises BrokenExecutor if the engine has lost its workers."""

    def renew(self) -> None:
        """Go on after BrokenExecutor, with new workers."""


class _Here:
    """In this process, one task after the other."""

    slots = 1

    def submit(self, task: Callable[..., T], *arguments: object) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(task(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    def renew(self) -> None:
        """Nothing can be lost."""


class _Processes:
    """A pool of processes. Each imports the package anew, so that none inherits a lock that is held."""

    def __init__(self, count: int) -> None:
        self.slots = count
        self._previous = set(multiprocessing.active_children())
        self._pool = self._made()

    def _made(self) -> ProcessPoolExecutor:
        # As Ctrl-C reaches them too, they end without a word.
        pool = ProcessPoolExecutor(
            self.slots, multiprocessing.get_context('spawn'), signal.signal, (signal.SIGINT, signal.SIG_DFL)
        )
        # All processes at once: in CPython 3.11 the pool hangs if one is lost while another one is begun.
        for _ in range(self.slots):
            pool.submit(time.sleep, 0.01 * self.slots)
        return pool

    def submit(self, task: Callable[..., T], *arguments: object) -> Future[T]:
        return self._pool.submit(task, *arguments)

    def renew(self) -> None:
        # A pool that has lost one process has ended the others.
        self._pool.shutdown()
        self._pool = self._made()

    def end(self) -> None:
        """Wait for what is under way, and end the processes."""
        self._pool.shutdown()

    def kill(self) -> None:
        """End the processes at once."""
        for process in set(multiprocessing.active_children()) - self._previous:
            process.terminate()
        self._pool.shutdown(cancel_futures=True)


class _Dask:
    """The workers of a scheduler, which gives the task of a lost worker to another one."""

    slots = DASK_SLOTS

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def submit(self, task: Callable[..., T], *arguments: object) -> Future[T]:
        return self._executor.submit(task, *arguments)

    def renew(self) -> None:
        """Dask does so itself."""


def check_engine(word: str) -> str:
    """``word``, if it is the name of an engine; raises UsageError."""
    if word == SERIAL or _PROCESSES.fullmatch(word) or _DASK.fullmatch(word):
        return word
    raise UsageError(f'--executor {word}: must be {FORMS}')


def _cores() -> int:
    """Processors that this process may use; not every system tells."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def open_engine(word: str, notify: Callable[[str], None] = lambda _: None) -> Iterator[Engine]:
    """The engine of that name. At the end its processes have ended; a cluster of others is left as it is.

    ``notify`` is told if a cluster has no worker yet. Raises UsageError for another word, DaemonError if no scheduler
    answers, ConfigError if Dask is not installed.
    """
    check_engine(word)
    if word == SERIAL:
        yield _Here()
    elif (processes := _PROCESSES.fullmatch(word)) is not None:
        pool = _Processes(int(processes[1] or _cores()))
        try:
            yield pool
        except BaseException:
            pool.kill()
            raise
        pool.end()
    else:
        with _connected(word) as client:
            if not client.scheduler_info()['workers']:
                notify(f'{word} has no worker yet: the work begins with the first one')
            yield _Dask(client.get_executor())


@contextlib.contextmanager
def _connected(word: str) -> Iterator[Any]:
    try:
        distributed = importlib.import_module('distributed')
    except ImportError:
        raise ConfigError(
            f"--executor {word} needs Dask: `pip install 'psd_deflection[dask]'` or `pip install distributed`"
        ) from None
    scheme, _, address = word.rstrip('/').partition('://')
    # The certificates are in Dask's own configuration.
    protocol = 'tls' if scheme.endswith('tls') else 'tcp'
    if protocol == 'tls' and distributed.Security().get_connection_args('client')['ssl_context'] is None:
        raise ConfigError(f"--executor {word}: Dask's configuration has no certificates (distributed.comm.tls)")
    try:
        client = distributed.Client(f'{protocol}://{address}', timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, concurrent.futures.TimeoutError) as error:
        raise DaemonError(f'{word}: no Dask scheduler answers ({error}); start one with `dask scheduler`') from None
    with client:
        yield client


AHEAD = 64
"""Results that wait in memory for an earlier one, beside those under way."""


@dataclass(frozen=True, slots=True)
class Outcome(Generic[T]):
    """``value``: what the work gave for the recording ``name``, or None and the ``error`` in a line."""

    name: str
    value: T | None
    error: str = ''


def attempt(work: Callable[[str], T], name: str, version: str) -> Outcome[T]:
    """Do ``work`` on the recording ``name``, on a worker; ``version``: of the package where the answer goes."""
    if version != __version__:
        return Outcome(name, None, f'a worker has psd_deflection {__version__}, here is {version}: install the same')
    try:
        return Outcome(name, work(name))
    except PsdDeflectionError as error:
        return Outcome(name, None, str(error))
    except MemoryError:
        return Outcome(name, None, f'{name}: too little memory on the worker')
    except Exception as error:
        # The other recordings can still be done.
        text = f'{name}: a defect of psd_deflection, {type(error).__name__}: {error}'
        return Outcome(name, None, f'{text}; the command on this recording alone shows where')


def outcomes(
    work: Callable[[str], T], names: Sequence[str], engine: Engine, ended: Callable[[], object] = lambda: None
) -> Iterator[Outcome[T]]:
    """The outcome of ``work`` on each of ``names``, in their order; ``ended`` is called when one has ended.

    ``work`` and its results must be able to go to another process. If a worker of a pool is killed, what was under way
    is tried again, one at a time and twice at most, so that only a recording that kills its worker fails. Dask does
    this by itself.
    """
    return _Run(work, names, engine, ended).outcomes()


class _Run(Generic[T]):
    def __init__(
        self, work: Callable[[str], T], names: Sequence[str], engine: Engine, ended: Callable[[], object]
    ) -> None:
        self._work = work
        self._names = names
        self._engine = engine
        self._ended = ended
        self._waiting = deque(range(len(names)))
        self._under_way: dict[Future[Outcome[T]], int] = {}  # Bound: the slots of the engine.
        self._to_retry: deque[int] = deque()  # Bound: the list that was given.
        self._ready: dict[int, Outcome[T]] = {}  # Bound: the slots of the engine.

    def outcomes(self) -> Iterator[Outcome[T]]:
        for index in range(len(self._names)):
            while index not in self._ready:
                if self._to_retry:
                    self._try_alone(self._to_retry.popleft())
                else:
                    self._fill(index)
                    self._gather()
            yield self._ready.pop(index)

    def _submit(self, i: int) -> Future[Outcome[T]]:
        return self._engine.submit(attempt, self._work, self._names[i], __version__)

    def _fill(self, index: int) -> None:
        slots = self._engine.slots
        while self._waiting and len(self._under_way) < slots and self._waiting[0] < index + slots + AHEAD:
            try:
                self._under_way[self._submit(self._waiting[0])] = self._waiting[0]
            except BrokenExecutor:
                if not self._under_way:
                    self._engine.renew()
                    continue
                # Those under way have been lost: see there.
                return
            self._waiting.popleft()

    def _gather(self) -> None:
        done, _ = wait(self._under_way, return_when=FIRST_COMPLETED)
        broken = False
        for future in done:
            try:
                outcome = future.result()
            except BrokenExecutor:
                broken = True
                continue
            except (CancelledError, Exception) as error:
                outcome = self._lost(self._under_way[future], error)
            self._end(self._under_way.pop(future), outcome)
        if broken:
            self._to_retry.extend(sorted(self._under_way.values()))
            self._under_way.clear()
            self._engine.renew()

    def _try_alone(self, i: int) -> None:
        """Twice: whether it was under way when a worker was lost, or waited for one, cannot be known."""
        for _ in range(2):
            try:
                outcome = self._submit(i).result()
                break
            except BrokenExecutor as error:
                self._engine.renew()
                outcome = self._lost(i, error)
        self._end(i, outcome)

    def _lost(self, i: int, error: BaseException) -> Outcome[T]:
        """The outcome of a recording whose task came to no end."""
        name = self._names[i]
        if isinstance(error, BrokenExecutor):
            return Outcome(name, None, f'{name}: its worker was killed, twice; too little memory?')
        return Outcome(name, None, f'{name}: came to no end on the cluster ({type(error).__name__}: {error})')

    def _end(self, i: int, outcome: Outcome[T]) -> None:
        self._ready[i] = outcome
        self._ended()


LIST = '.txt'
"""Ending of a file with one recording or pattern a line."""

LARGEST_LIST = 16 * 2**20
"""Bytes of such a file."""


def is_plain(word: str) -> bool:
    """Whether ``word`` is one recording by its path, neither a pattern nor a list."""
    return not (_is_list(Path(word)) or _is_pattern(word))


def listed(words: Sequence[str]) -> list[str]:
    """Every recording of ``words`` once, in their order; what a pattern matches is sorted.

    A pattern (``*``, ``?``, ``[a-z]``, ``**`` for folders at any depth) takes bag folders, ``.mcap`` and ``.csv``, and
    of a bag folder that it takes not the files as well. A list is a ``.txt``: one path or pattern a line, relative to
    the list's folder; empty lines and lines that begin with ``#`` are left out. A path that does not exist stays: the
    command says so when its turn comes.

    Raises RecordingError if a list cannot be read or a pattern matches nothing.
    """
    paths: list[str] = []
    for word in words:
        paths += _of_list(Path(word)) if _is_list(Path(word)) else _of_word(word)
    return list(dict.fromkeys(paths))


def _is_list(path: Path) -> bool:
    return path.suffix.lower() == LIST and path.is_file()


def _is_pattern(word: str) -> bool:
    return glob.has_magic(word) and not Path(word).exists()


def _of_word(word: str) -> list[str]:
    if not _is_pattern(word):
        return [word]
    matches = sorted(Path(name) for name in glob.iglob(word, recursive=True))  # noqa: PTH207 - Path has no `..` in it
    folders = {path for path in matches if path.is_dir() and _is_bag(path)}
    endings = endings_of_recordings()
    files = (p for p in matches if p.suffix.lower() in endings and p.is_file() and p.parent not in folders)
    paths = [str(path) for path in sorted([*folders, *files])]
    if not paths:
        raise RecordingError(f'{word}: matches no recording (bag folders, {", ".join(endings)})')
    return paths


def _is_bag(folder: Path) -> bool:
    # Without metadata it was cut off; its files have its name.
    return (folder / 'metadata.yaml').is_file() or any(folder.glob(f'{glob.escape(folder.name)}_*.mcap'))


def _of_list(path: Path) -> Iterator[str]:
    try:
        with path.open('rb') as stream:
            content = stream.read(LARGEST_LIST + 1)
        text = content.decode('utf-8-sig')
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
    except UnicodeDecodeError:
        raise RecordingError(f'{path}: is no list of recordings: it is not UTF-8 text') from None
    if len(content) > LARGEST_LIST:
        raise RecordingError(f'{path}: is larger than {LARGEST_LIST >> 20} MiB; give several lists')
    lines = [line.strip() for line in text.splitlines()]
    entries = [line for line in lines if line and not line.startswith('#')]
    if not entries:
        raise RecordingError(f'{path}: lists no recording (one a line, or a pattern)')
    for entry in entries:
        yield from _of_word(str(path.parent / entry))
