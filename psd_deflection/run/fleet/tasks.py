# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One task for each recording; what comes out, in the order of the recordings."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass
from typing import Generic, TypeVar

from psd_deflection import __version__
from psd_deflection.base.errors import PsdDeflectionError
from psd_deflection.run.fleet.engines import Engine

T = TypeVar('T')

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
        self._under_way: dict[Future[Outcome[T]], int] = {}
        self._to_retry: deque[int] = deque()
        self._ready: dict[int, Outcome[T]] = {}

    def outcomes(self) -> Iterator[Outcome[T]]:
        for turn in range(len(self._names)):
            while turn not in self._ready:
                if self._to_retry:
                    self._try_alone(self._to_retry.popleft())
                else:
                    self._fill(turn)
                    self._gather()
            yield self._ready.pop(turn)

    def _submit(self, i: int) -> Future[Outcome[T]]:
        return self._engine.submit(attempt, self._work, self._names[i], __version__)

    def _fill(self, turn: int) -> None:
        slots = self._engine.slots
        while self._waiting and len(self._under_way) < slots and self._waiting[0] < turn + slots + AHEAD:
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
