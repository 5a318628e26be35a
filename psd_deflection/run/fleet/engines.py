# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where tasks run: in this process, in processes of this machine, or on a Dask cluster.

All are used through :mod:`concurrent.futures`.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import importlib
import multiprocessing
import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from typing import Any, Protocol, TypeVar

from psd_deflection.base.errors import ConfigError, DaemonError, UsageError

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
        self._others = set(multiprocessing.active_children())
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
        for process in set(multiprocessing.active_children()) - self._others:
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
