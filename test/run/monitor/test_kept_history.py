# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the page's hours are after a restart, and what a bad file or disk does to them."""

import contextlib
import sqlite3
import threading
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psd_deflection.base.log import texts
from psd_deflection.records import Mark
from psd_deflection.rig.config import load_rig
from psd_deflection.run.monitor import kept_history
from psd_deflection.run.monitor.history import LEVELS, Asked, History
from psd_deflection.run.monitor.kept_history import HistoryFile, HistoryKeeper, PageHistory
from psd_deflection.run.state import device_file
from test.heard import until

from .serving import BLOCK_NS, START_NS, Serving, StillShown
from .test_history import SECOND, SIZE, SMALL, blocks, filled, row
from .test_server import column, history_of

IN_MEMORY = Path(':memory:')
LATER = START_NS + 10**9 * SECOND
Serve = Callable[..., Serving]
Open = Callable[..., HistoryFile]


@pytest.fixture
def file_of(request: pytest.FixtureRequest) -> Open:
    """Opens the file of a history; closed at the end."""

    def opened(history: History, path: Path = IN_MEMORY) -> HistoryFile:
        file = HistoryFile(path, history.kind, history.names, history.kept_length)
        request.addfinalizer(file.close)
        return file

    return opened


def cells(history: History, since: int, points: int = 2000, span: int = 2000) -> dict[str, np.ndarray]:
    """By column, in cells of at least ten seconds."""
    begin = START_NS + since * SECOND
    return history.window(Asked(begin, begin + span * 10 * SECOND, points)).columns


@settings(max_examples=60)
@given(blocks, st.data())
def test_what_is_kept_at_any_time_is_what_there_was(
    rows: list[tuple[int, float | None, float, int, int]], data: st.DataObject
) -> None:
    """However often it is saved, and whatever the clock does in between."""
    made, t_ns = History(2, SIZE, SMALL), START_NS
    file = HistoryFile(IN_MEMORY, made.kind, made.names, made.kept_length)
    for step, dx, total, lost, gone in rows:
        t_ns += step
        made.add(row(t_ns, dx, total, lost, gone))
        if data.draw(st.booleans()):
            file.save(made.unsaved())
    file.save(made.unsaved())
    stored = file.load(LATER, LATER)
    full = made.rings[1].between(0, made.rings[1].newest + 1)
    assert stored.cells[-len(full) :].tobytes() == full.tobytes()
    file.close()


def test_two_runs_are_as_one(file_of: Open) -> None:
    rows = [row(START_NS + k * SECOND // 2, 1e-6 * k, lost=k % 3) for k in range(900)]
    first = filled(rows[:437])
    first.mark(START_NS, '[1]')
    file = file_of(first)
    file.save(first.unsaved())
    second = filled(rows[437:460])
    # The first blocks came before the disk had answered, and in the cell in which the first run ended.
    second.mark(START_NS + 230 * SECOND, '[2]')
    second.load(file.load(LATER, LATER))
    for result in rows[460:]:
        second.add(result)
    full = filled(rows)
    for points in (2000, 300):
        got, want = cells(second, 0, points), cells(full, 0, points)
        assert got.keys() == want.keys()
        for name, values in want.items():
            np.testing.assert_allclose(got[name], values, rtol=1e-12)
    assert [text for _, text in second.marks] == ['[1]', '[2]']
    file.save(second.unsaved())
    assert len(file.load(LATER, LATER).cells) == len(full.rings[1].between(0, full.rings[1].newest + 1))


def test_only_the_last_week_is_kept(file_of: Open) -> None:
    made = filled([row(START_NS, 0.0)])
    file = file_of(made)
    assert made.kept_length * LEVELS[1][0] == LEVELS[2][0] * LEVELS[2][1]
    file.save(made.unsaved())
    made.add(row(START_NS + 10 * SECOND * (made.kept_length - 1), 0.0))
    file.save(made.unsaved())
    assert len(file.load(LATER, LATER).cells) == 2
    made.add(row(START_NS + 10 * SECOND * made.kept_length, 0.0))
    file.save(made.unsaved())
    assert len(file.load(LATER, LATER).cells) == 2


def test_what_lies_after_now_is_passed_over_and_goes(file_of: Open) -> None:
    made = filled([row(START_NS, 0.0), row(START_NS + 100 * SECOND, 0.0)])
    made.mark(START_NS + 100 * SECOND, '[1]')
    file = file_of(made)
    file.save(made.unsaved())
    now = START_NS + 50 * SECOND
    stored = file.load(now // (10 * SECOND), now)
    assert [int(key) for key in stored.cells['key']] == [START_NS // (10 * SECOND)]
    assert stored.marks == []
    back = History(2, SIZE)
    back.load(stored)
    file.save(back.unsaved())
    assert len(file.load(LATER, LATER).cells) == 1


def test_a_file_of_other_channels_is_begun_anew(file_of: Open, tmp_path: Path) -> None:
    three, two = History(3, SIZE), filled([row(START_NS, 0.0)])
    file = file_of(two, tmp_path / 'a')
    file.save(two.unsaved())
    assert len(file_of(two, tmp_path / 'a').load(LATER, LATER).cells) == 1
    assert len(file_of(three, tmp_path / 'a').load(LATER, LATER).cells) == 0
    assert len(file_of(two, tmp_path / 'a').load(LATER, LATER).cells) == 0


def test_cells_and_marks_that_are_none_are_passed_over(file_of: Open, tmp_path: Path) -> None:
    made = filled([row(START_NS + k * 10 * SECOND, 0.0) for k in range(4)])
    made.mark(START_NS, '[1]')
    file = file_of(made, tmp_path / 'a')
    file.save(made.unsaved())
    key = START_NS // (10 * SECOND)
    with contextlib.closing(sqlite3.connect(tmp_path / 'a')) as database, database:
        database.execute('UPDATE cells SET cell = ? WHERE key = ?', (b'short', key))
        database.execute('UPDATE cells SET key = -5 WHERE key = ?', (key + 1,))
        database.execute("INSERT INTO marks VALUES (0, 'no JSON'), (1, '{}'), ('noon', '[1]')")
    stored = file.load(LATER, LATER)
    assert [int(k) for k in stored.cells['key']] == [key + 2, key + 3]
    assert (stored.from_key, stored.marks) == (0, [(START_NS, '[1]')])


class Keeping:
    """A keeper with its history."""

    def __init__(self, path: Path) -> None:
        self.logged: list[str] = []
        self.history = History(2, SIZE)
        self.keeper = HistoryKeeper(path, self.history, texts(self.logged.append))
        self.keeper.start()

    def restored(self) -> None:
        until(self.keeper.load_saved)

    def saved(self) -> None:
        self.keeper.save()
        until(lambda: self.keeper.idle)

    def count(self) -> int:
        return len(self.history.rings[1].between(0, LATER))


Keep = Callable[[], Keeping]


@pytest.fixture
def keep(tmp_path: Path, request: pytest.FixtureRequest) -> Keep:
    def begin() -> Keeping:
        keeping = Keeping(tmp_path / 'state' / 'history.sqlite')
        request.addfinalizer(keeping.keeper.end)
        return keeping

    return begin


def test_nothing_is_saved_before_what_was_kept_is_read(keep: Keep) -> None:
    first = keep()
    first.history.add(row(START_NS, 0.0))
    first.keeper.save()
    first.restored()
    first.saved()
    first.keeper.end()
    assert not first.keeper.alive
    two = keep()
    two.restored()
    assert two.count() == 1
    assert first.logged == two.logged == []


def test_a_damaged_file_is_put_aside(keep: Keep, tmp_path: Path) -> None:
    (tmp_path / 'state').mkdir()
    (tmp_path / 'state' / 'history.sqlite').write_bytes(b'no database at all' * 100)
    first = keep()
    first.restored()
    why = 'the kept history cannot be read (file is not a database); it is history.sqlite.damaged now'
    assert first.logged == [f'{tmp_path}/state/history.sqlite: {why}']
    assert (tmp_path / 'state' / 'history.sqlite.damaged').read_bytes()[:18] == b'no database at all'
    first.history.add(row(START_NS, 0.0))
    first.keeper.end()
    two = keep()
    two.restored()
    assert two.count() == 1


def test_a_file_that_is_damaged_inside_is_put_aside(keep: Keep, tmp_path: Path) -> None:
    first = keep()
    first.restored()
    for k in range(500):
        first.history.add(row(START_NS + k * 10 * SECOND, 0.0))
    first.keeper.end()
    path = tmp_path / 'state' / 'history.sqlite'
    content = bytearray(path.read_bytes())
    content[3 * 4096 : -4096] = bytes(len(content) - 4 * 4096)
    path.write_bytes(content)
    two = keep()
    two.restored()
    assert two.count() == 0
    assert 'the kept history cannot be read (database disk image is malformed)' in two.logged[0]
    assert path.with_name('history.sqlite.damaged').read_bytes() == content


def test_a_folder_that_cannot_be_written_costs_the_history_alone(keep: Keep, tmp_path: Path) -> None:
    (tmp_path / 'state').write_text('a file')
    keeping = keep()
    until(lambda: bool(keeping.logged))
    keeping.history.add(row(START_NS, 0.0))
    keeping.keeper.save()
    keeping.keeper.end()
    (logged,) = keeping.logged
    assert logged.startswith(f'{tmp_path}/state/history.sqlite: the history of the page cannot be kept (')


def test_what_the_disk_rejected_is_written_the_next_time(keep: Keep, monkeypatch: pytest.MonkeyPatch) -> None:
    first = keep()
    first.restored()
    with monkeypatch.context() as patched:
        full = Mock(side_effect=sqlite3.OperationalError('database or disk is full'))
        patched.setattr(HistoryFile, 'save', full)
        for k in range(3):
            first.history.add(row(START_NS + k * 10 * SECOND, 0.0))
            first.saved()
    assert len(first.logged) == 1
    assert 'disk is full' in first.logged[0]
    first.history.add(row(START_NS + 50 * SECOND, 0.0))
    first.keeper.end()
    two = keep()
    two.restored()
    assert two.count() == 4


def test_a_disk_that_hangs_holds_nobody(keep: Keep, monkeypatch: pytest.MonkeyPatch) -> None:
    waited = []

    class Hurried(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            waited.append(timeout or 0.0)
            return super().wait(0.05)

    monkeypatch.setattr(kept_history, 'threading', Mock(wraps=threading, Event=Hurried))
    keeping = keep()
    keeping.restored()
    gate = threading.Event()
    monkeypatch.setattr(HistoryFile, 'save', lambda self, content: gate.wait())
    keeping.history.add(row(START_NS, 0.0))
    for _ in range(3):
        keeping.keeper.save()
    keeping.keeper.end()
    # Not for the minutes that the disk may hang.
    assert 0.0 < sum(waited) <= 1.0
    assert keeping.keeper.alive
    gate.set()


def test_kept_hours_are_shown_at_once_and_saved_each_minute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @types.coroutine
    def sleep(seconds: float) -> Iterator[float]:
        yield seconds

    monkeypatch.setattr(kept_history, 'asyncio', Mock(sleep=sleep))
    page = PageHistory(2, SIZE, tmp_path / 'kept.sqlite', texts(list[str]().append))
    (job,) = page.jobs()
    # Until the file is read, it is asked for again within a blink.
    assert 0.0 < job.send(None) < 0.5
    page.start()
    until(lambda: job.send(None) == 60.0)
    assert job.send(None) == 60.0
    job.close()
    page.end()


def test_the_hours_of_a_page_outlive_it(serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StillShown, 'history_file', lambda _: tmp_path / 'kept.sqlite')
    first = serve()
    first.give(0, 1500)
    first.feed.put(Mark(START_NS + BLOCK_NS, 'bumped it'))
    first.settle()
    before = history_of(first, 400.0, points=40)
    first.server.close()

    second = serve()
    until(lambda: bool(history_of(second, 400.0, points=40)['marks']))
    after = history_of(second, 400.0, points=40)
    assert (after['columns'], column(after, 'blocks')) == (before['columns'], [500, 500, 500])
    assert [mark[1] for mark in after['marks']] == ['mark']
    # The seconds went with the run; ten of them are the finest that is kept.
    assert history_of(second, 40.0)['columns']['blocks'] == ''
    second.server.close()

    third = serve(monitor_history=False)
    assert history_of(third, 400.0, points=40)['marks'] == []


def test_two_devices_never_share_a_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv('XDG_STATE_HOME', str(tmp_path))
    names = {device_file('history', serial, '.sqlite') for serial in ('A', 'A.', '../A', '', 'unknown', 'a' * 70)}
    assert (len(names), {path.parent for path in names}) == (6, {tmp_path / 'psd_deflection'})
    assert load_rig().monitor.history is True
