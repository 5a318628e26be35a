# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Keeps the page's history of a week in an SQLite file per device, written once a minute by a thread of its own. A
damaged file is put aside; nothing that the disk does reaches the page or the run."""

from __future__ import annotations

import asyncio
import contextlib
import json
import queue
import sqlite3
import threading
import time
from collections.abc import Coroutine, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection.base.log import WARNING, LogCallback
from psd_deflection.run.monitor.history import KEPT_LEVEL, LEVELS, MOST_MARKS, History, Kept, asked

VERSION = 1
KEEP_EVERY_S, RESTORE_S = 60.0, 0.1
END_S = 1.0
"""The end of a run waits so long for the disk."""
ASIDE = '.damaged'
_TABLES = """
CREATE TABLE IF NOT EXISTS cells (key INTEGER PRIMARY KEY, cell BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS marks (t_ns INTEGER NOT NULL, content TEXT NOT NULL);
"""


class PageHistory:
    """The history of a page, of ``psds`` and blocks of ``block_size``; kept in the file ``path`` if there is one.

    ``log`` gets a line if that fails. :meth:`jobs` keep it; all else is called by the thread that runs them.
    """

    def __init__(self, psds: int, block_size: int, path: Path | None, log: LogCallback) -> None:
        self._history = History(psds, block_size)
        self._keeper = None if path is None else HistoryKeeper(path, self._history, log)
        self.add, self.mark = self._history.add, self._history.mark

    @property
    def bytes(self) -> int:
        """Memory of the cells."""
        return self._history.bytes

    def answer(self, query: Mapping[str, str]) -> str:
        """The JSON of the window that the parameters of a request name. Raises AskedError, a ValueError."""
        return self._history.answer(asked(query))

    def start(self) -> None:
        """Begin to read what was kept."""
        if self._keeper is not None:
            self._keeper.start()

    def end(self) -> None:
        """Save what is new; a second call does nothing."""
        keeper, self._keeper = self._keeper, None
        if keeper is not None:
            keeper.end()

    def jobs(self) -> list[Coroutine[Any, Any, None]]:
        """What restores and saves; none if no file is given."""
        return [] if self._keeper is None else [self._keep(self._keeper)]

    async def _keep(self, keeper: HistoryKeeper) -> None:
        while not keeper.load_saved():
            await asyncio.sleep(RESTORE_S)
        while True:
            await asyncio.sleep(KEEP_EVERY_S)
            keeper.save()


class HistoryFile:
    """The file: cells of ``kind``, which have ``names``, the newest ``length`` of them. One thread uses it.

    Raises sqlite3.Error and OSError.
    """

    def __init__(self, path: Path, kind: np.dtype[np.void], names: Sequence[str], length: int) -> None:
        self._kind, self._length = kind, length
        path.parent.mkdir(parents=True, exist_ok=True)
        # Another program that looks into the file may hold it for the 5 s that sqlite3 waits by default.
        self._file = sqlite3.connect(path, isolation_level=None)
        try:
            self._begin(f'{VERSION} {kind.itemsize} {" ".join(names)}')
        except BaseException:
            self._file.close()
            raise

    def _begin(self, about: str) -> None:
        """Make the tables, anew if those that are there are of other channels or of another version."""
        with self._transaction():
            self._file.execute('CREATE TABLE IF NOT EXISTS about (words TEXT NOT NULL)')
            if self._file.execute('SELECT words FROM about').fetchall() != [(about,)]:
                for table in ('cells', 'marks'):
                    self._file.execute(f'DROP TABLE IF EXISTS {table}')
                self._file.execute('DELETE FROM about')
                self._file.execute('INSERT INTO about VALUES (?)', (about,))
            for statement in _TABLES.split(';')[:-1]:
                self._file.execute(statement)

    def load(self, until_key: int, until_ns: int) -> Kept:
        """What was kept, without what lies after now: the clock was set back since."""
        rows = self._file.execute(
            'SELECT key, cell FROM cells WHERE key <= ? ORDER BY key DESC LIMIT ?', (until_key, self._length)
        ).fetchall()
        size = self._kind.itemsize
        good = [(key, cell) for key, cell in reversed(rows) if isinstance(cell, bytes) and len(cell) == size]
        cells = np.frombuffer(b''.join(cell for _, cell in good), self._kind)
        right = cells['key'] == np.array([key for key, _ in good], np.int64)
        cells = cells[right & (cells['count'] <= cells['blocks'][:, None]).all(axis=1)]
        marks = self._file.execute('SELECT t_ns, content FROM marks WHERE t_ns <= ?', (until_ns,)).fetchmany(MOST_MARKS)
        return Kept(0, cells, [(t_ns, text) for t_ns, text in marks if isinstance(t_ns, int) and _is_mark(text)])

    def save(self, unsaved: Kept) -> None:
        """Replace what is there from ``unsaved.from_key`` on, and the marks if there are new ones; drop the oldest."""
        rows = [(int(cell['key']), cell.tobytes()) for cell in unsaved.cells]
        with self._transaction():
            self._file.execute('DELETE FROM cells WHERE key >= ?', (unsaved.from_key,))
            self._file.executemany('INSERT OR REPLACE INTO cells VALUES (?, ?)', rows)
            if rows:
                self._file.execute('DELETE FROM cells WHERE key <= ?', (rows[-1][0] - self._length,))
            if unsaved.marks is not None:
                self._file.execute('DELETE FROM marks')
                self._file.executemany('INSERT INTO marks VALUES (?, ?)', unsaved.marks)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        self._file.execute('BEGIN IMMEDIATE')
        try:
            yield
            self._file.execute('COMMIT')
        except BaseException:
            # A full disk may have ended it already.
            with contextlib.suppress(sqlite3.Error):
                self._file.execute('ROLLBACK')
            raise


class HistoryKeeper:
    """Keeps ``history`` in the file ``path``. ``log`` gets a line if that fails.

    One thread calls the methods; the file is touched by the keeper's own thread alone.
    """

    def __init__(self, path: Path, history: History, log: LogCallback) -> None:
        self._path, self._history, self._log = path, history, log
        self._shape = (history.kind, history.names, history.kept_length)
        self._todo: queue.Queue[Kept | None] = queue.Queue(maxsize=1)
        self._loaded: Kept | None = None
        self._restored = self._reported = False
        self._failed_from: int | None = None
        self._idle = threading.Event()
        self._thread = threading.Thread(target=self._run, name='history', daemon=True)

    def start(self) -> None:
        """Begin to read what was kept."""
        self._thread.start()

    def load_saved(self) -> bool:
        """Give the history what was kept, once it is read; return whether that was done by now."""
        if self._loaded is not None:
            self._history.load(self._loaded)
            self._loaded, self._restored = None, True
        return self._restored

    def save(self) -> None:
        """Save what is new, unless the disk still has to do with the last time."""
        if self._restored and self.idle:
            self._idle.clear()
            unsaved, self._failed_from = self._history.unsaved(self._failed_from), None
            self._todo.put_nowait(unsaved)

    @property
    def idle(self) -> bool:
        """Whether nothing waits to be written."""
        return self._idle.is_set()

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    def end(self) -> None:
        """Save what is new, and end; a disk that hangs is not waited for longer than ``END_S``."""
        until = time.monotonic() + END_S
        if not self.alive or not self._idle.wait(END_S):
            return
        self.load_saved()
        self.save()
        if self._idle.wait(max(0.0, until - time.monotonic())):
            self._todo.put_nowait(None)
            self._thread.join(max(0.0, until - time.monotonic()))

    def _run(self) -> None:
        try:
            file, self._loaded = self._opened()
        except (sqlite3.Error, OSError, ValueError) as error:
            self._fail(error)
            return
        with contextlib.closing(file):
            while True:
                self._idle.set()
                unsaved = self._todo.get()
                if unsaved is None:
                    break
                try:
                    file.save(unsaved)
                    self._reported = False
                except (sqlite3.Error, OSError) as error:
                    self._failed_from = unsaved.from_key
                    self._fail(error)

    def _opened(self) -> tuple[HistoryFile, Kept]:
        try:
            return self._read()
        except sqlite3.OperationalError:
            raise
        except sqlite3.DatabaseError as error:
            aside = self._path.with_name(self._path.name + ASIDE)
            self._path.replace(aside)
            self._log(f'{self._path}: the kept history cannot be read ({error}); it is {aside.name} now', WARNING)
            return self._read()

    def _read(self) -> tuple[HistoryFile, Kept]:
        file = HistoryFile(self._path, *self._shape)
        now_ns = time.time_ns()
        try:
            return file, file.load(now_ns // (LEVELS[KEPT_LEVEL][0] * 1_000_000_000), now_ns)
        except BaseException:
            file.close()
            raise

    def _fail(self, error: Exception) -> None:
        if not self._reported:
            self._reported = True
            self._log(f'{self._path}: the history of the page cannot be kept ({error})', WARNING)


def _is_mark(text: object) -> bool:
    try:
        return isinstance(json.loads(str(text)), list)
    except (ValueError, RecursionError):
        return False
