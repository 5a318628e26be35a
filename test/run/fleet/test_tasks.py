# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which recordings a command line means; tasks on engines: order, failures, killed workers."""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any, TypeVar

import pytest

from psd_deflection import __version__
from psd_deflection.base.errors import ConfigError, DaemonError, RecordingError, UsageError
from psd_deflection.run.fleet import tasks
from test.run.fleet.mortal import dies, length

T = TypeVar('T')
NAMES = ['a', 'bbb', 'rejected', 'cc', 'defect', 'dddd']


class Later:
    """An engine that finishes what the test says, in its order; ``breaks``: names that lose all workers."""

    def __init__(self, slots: int, *breaks: str) -> None:
        self.slots = slots
        self.breaks = list(breaks)
        self.renewed = 0
        self.most = 0
        self.under_way: list[tuple[Future[Any], Callable[[], Any]]] = []

    def submit(self, task: Callable[..., T], *arguments: object) -> Future[T]:
        future: Future[T] = Future()
        name = arguments[1]
        if name in self.breaks:
            self.breaks.remove(str(name))
            for waiting in (future, *(f for f, _ in self.under_way)):
                waiting.set_exception(BrokenExecutor('killed'))
            self.under_way = []
            return future
        self.under_way.append((future, lambda: task(*arguments)))
        self.most = max(self.most, len(self.under_way))
        # The newest first, once all slots are full or nothing else will come.
        if len(self.under_way) == self.slots:
            self.finish()
        return future

    def finish(self) -> None:
        for future, answer in reversed(self.under_way):
            future.set_result(answer())
        self.under_way = []

    def renew(self) -> None:
        self.renewed += 1


def test_outcomes_come_in_order_whatever_ends_first() -> None:
    ended: list[int] = []
    outcomes = list(tasks.outcomes(length, NAMES, Later(3), lambda: ended.append(1)))
    assert [o.name for o in outcomes] == NAMES
    assert [o.value for o in outcomes] == [1, 3, None, 2, None, 4]
    assert (len(ended), outcomes[2].error) == (len(NAMES), 'rejected: no such recording')
    assert outcomes[4].error.startswith('defect: a defect of psd_deflection, ZeroDivisionError: division by zero; ')


def test_a_lost_worker_costs_only_what_it_worked_on() -> None:
    # `cc` breaks the pool while `a` and `bbb` are under way, and twice more alone.
    engine = Later(3, 'cc', 'cc', 'cc')
    engine.slots = 3

    def alone(task: Callable[..., T], *arguments: object) -> Future[T]:
        future = Later.submit(engine, task, *arguments)
        if engine.renewed:
            engine.finish()
        return future

    engine.submit = alone  # type: ignore[method-assign]
    outcomes = list(tasks.outcomes(length, ['a', 'bbb', 'cc', 'dddd', 'e'], engine))
    assert [o.value for o in outcomes] == [1, 3, None, 4, 1]
    assert (outcomes[2].error, engine.renewed) == ('cc: its worker was killed, twice; too little memory?', 3)


def test_a_worker_that_is_lost_once_more_costs_nothing() -> None:
    # `cc` waited for a worker when the pool was lost, and is killed once itself.
    engine = Later(1, 'cc', 'cc')
    outcomes = list(tasks.outcomes(length, ['a', 'cc', 'dddd'], engine))
    assert [o.value for o in outcomes] == [1, 2, 4]
    assert engine.renewed == 2


def test_results_that_wait_for_an_earlier_one_are_bounded() -> None:
    given: list[str] = []
    first: Future[tasks.Outcome[int]] = Future()

    class Slow:
        slots = 4

        def submit(self, task: Callable[..., T], *arguments: object) -> Future[T]:
            given.append(str(arguments[1]))
            future: Future[Any] = first if len(given) == 1 else Future()
            if future is not first:
                future.set_result(task(*arguments))
            if len(given) == 4 + tasks.AHEAD:
                first.set_result(tasks.Outcome('0', 1))
            return future

        def renew(self) -> None:
            raise AssertionError

    names = [str(i) for i in range(200)]
    work = tasks.outcomes(length, names, Slow())
    assert (next(work).name, len(given)) == ('0', 4 + tasks.AHEAD)
    assert [o.name for o in work] == names[1:]


def test_a_worker_of_another_version_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert tasks.attempt(length, 'abc', __version__).value == 3
    answer = tasks.attempt(length, 'abc', '99.0')
    assert answer.value is None
    assert answer.error.startswith(f'a worker has psd_deflection {__version__}, here is 99.0')


@pytest.mark.slow
def test_a_killed_process_costs_only_its_task(tmp_path: Path) -> None:
    names = [str(tmp_path / name) for name in ('a', 'poison', 'bb', 'once', 'ccc')]
    with tasks.open_engine('processes:2') as pool:
        outcomes = list(tasks.outcomes(dies, names, pool))
    assert [o.value for o in outcomes] == [1, None, 2, 4, 3]
    assert outcomes[1].error.endswith('poison: its worker was killed, twice; too little memory?')


@pytest.mark.slow
def test_a_run_that_is_given_up_leaves_no_process() -> None:
    before = multiprocessing.active_children()

    def interrupted() -> None:
        with tasks.open_engine('processes:2') as pool:
            next(tasks.outcomes(length, NAMES, pool))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert multiprocessing.active_children() == before


@pytest.mark.parametrize(
    'word', ['process', 'processes:0', 'processes:-1', 'dask://host', 'dask://:1', 'dask://a:b', '']
)
def test_another_word_is_rejected(word: str) -> None:
    with pytest.raises(UsageError, match='must be serial, processes'):
        tasks.check_engine(word)


# Nothing listens on the port of tcpmux.
@pytest.mark.parametrize(
    ('word', 'error', 'message'),
    [
        ('dask://127.0.0.1:1', DaemonError, r'^dask://127\.0\.0\.1:1: no Dask scheduler answers'),
        ('dask+tls://127.0.0.1:1', ConfigError, r"^--executor dask\+tls://\S+ Dask's configuration has no cert"),
    ],
)
def test_a_scheduler_out_of_reach_is_named(
    word: str, error: type[Exception], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip('distributed')
    monkeypatch.setattr('psd_deflection.run.fleet.tasks.CONNECT_S', 0.2)
    with pytest.raises(error, match=message), tasks.open_engine(word):
        pass


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ('a/run_1', 'a/run_2', 'b', 'b/notes'):
        (tmp_path / name).mkdir(parents=True)
    for name in ('a/run_1/run_1_0.mcap', 'a/run_1/metadata.yaml', 'a/run_2/run_2_0.mcap'):
        (tmp_path / name).touch()
    for name in ('b/lone.mcap', 'b/table.CSV', 'b/notes/readme.md', 'b/run[1].csv'):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_pattern_takes_bags_and_files_not_bag_parts(archive: Path) -> None:
    # Words stay in their order, each once.
    assert tasks.listed(['b/lone.mcap', 'nowhere', 'a/run_1', 'b/lone.mcap']) == ['b/lone.mcap', 'nowhere', 'a/run_1']
    assert tasks.listed(['**']) == ['a/run_1', 'a/run_2', 'b/lone.mcap', 'b/run[1].csv', 'b/table.CSV']
    assert tasks.listed(['a/*']) == ['a/run_1', 'a/run_2']
    # Asked for by name, a file of a bag is a recording.
    assert tasks.listed(['**/*.mcap']) == ['a/run_1/run_1_0.mcap', 'a/run_2/run_2_0.mcap', 'b/lone.mcap']
    assert tasks.listed([f'{archive}/b/*.mcap']) == [f'{archive}/b/lone.mcap']


def test_a_name_that_looks_like_a_pattern_and_exists_is_a_name(archive: Path) -> None:
    assert tasks.is_plain('b/run[1].csv')
    assert tasks.listed(['b/run[1].csv']) == ['b/run[1].csv']
    assert not tasks.is_plain('b/run[12].csv')


def test_a_list_is_relative_to_its_folder(archive: Path) -> None:
    (archive / 'b' / 'list.txt').write_text('\ufeff# the good ones\n\nlone.mcap\n  ../a/*  \n', encoding='utf-8')
    assert not tasks.is_plain('b/list.txt')
    assert tasks.listed(['b/list.txt', 'a/run_1']) == ['b/lone.mcap', 'b/../a/run_1', 'b/../a/run_2', 'a/run_1']
    assert tasks.listed(['none.txt']) == ['none.txt']


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        (b'# nothing\n', 'lists no recording'),
        (b'\xff\xfe\n', 'is not UTF-8'),
        (b'*.mcap\n', 'matches no recording'),
        (b'\n' * (tasks.LARGEST_LIST + 1), 'larger than 16 MiB'),
    ],
)
def test_a_bad_list_is_rejected(archive: Path, content: bytes, message: str) -> None:
    (archive / 'list.txt').write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        tasks.listed(['list.txt'])
    with pytest.raises(RecordingError, match=r'^c\*: matches no recording'):
        tasks.listed(['c*'])
