# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run pytest in one child after another of a process that has imported all libraries already."""

import contextlib
import functools
import itertools
import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import NamedTuple

import pytest

OPTIONS = (
    *('-x', '-q', '-p', 'no:cacheprovider', '-p', 'pytest_timeout', '-m', 'not browser'),
    *('-W', 'ignore::pytest.PytestAssertRewriteWarning'),
)
OURS = ('psd_deflection', 'msg_adapters', 'test', 'blind', 'bench', 'tools')
LONGEST = 600.0  # s that one of the arguments may take at first.
MOST = 120.0  # s, as measured at first, that the tests of one function may take together.
Entered = dict[int, CodeType]


class Test(NamedTuple):
    """How long a test takes, and the functions that it enters: file of the checkout and first line."""

    seconds: float
    entered: frozenset[tuple[str, int]]


class Watch:
    """A plugin of pytest that notes which functions each test enters. What is entered while modules are imported counts
    for all tests, a fixture for all tests of its file."""

    def __init__(self) -> None:
        self._common: Entered = {}
        self._fixtures: dict[str, Entered] = {}
        self._tests: dict[str, Entered] = {}
        self._seconds: dict[str, float] = {}
        self._into = self._common
        threading.settrace(self._call)
        sys.settrace(self._call)

    def _call(self, frame: FrameType, event: str, arg: object) -> None:
        self._into[id(frame.f_code)] = frame.f_code

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Iterator[None]:
        self._into = self._fixtures.setdefault(item.nodeid.partition('::')[0], {})
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        self._into = self._tests.setdefault(item.nodeid, {})
        begun = time.monotonic()
        try:
            return (yield)
        finally:
            self._seconds[item.nodeid] = time.monotonic() - begun

    def observed(self) -> str:
        sys.settrace(None)
        here = str(Path.cwd()) + os.sep
        out = {}
        for name, entered in self._tests.items():
            codes = {**self._common, **self._fixtures[name.partition('::')[0]], **entered}.values()
            ours = [c for c in codes if c.co_filename.startswith(here)]
            out[name] = self._seconds[name], [(c.co_filename.removeprefix(here), c.co_firstlineno) for c in ours]
        return json.dumps(out)


def passed(run: Callable[[], int], seconds: float) -> bool:
    """Whether ``run`` returns 0 in a child of this process; ends the child and all that it started."""
    child = os.fork()
    if child == 0:
        os.setsid()
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):
            os.dup2(nowhere, stream)
        os._exit(run())
    end = time.monotonic() + seconds
    done, status = 0, 1
    while not done and time.monotonic() < end:
        time.sleep(0.02)
        done, status = os.waitpid(child, os.WNOHANG)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    if not done:
        os.waitpid(child, 0)
    return bool(done) and os.waitstatus_to_exitcode(status) == 0


def warm_up(tests: Sequence[str]) -> None:
    """Import what the tests import, and forget what is of this checkout: a child reads it anew."""
    with Path(os.devnull).open('w') as nowhere, contextlib.redirect_stdout(nowhere):
        pytest.main([*OPTIONS, '--collect-only', *(t.split(' ')[0] for t in tests)])
    here = str(Path.cwd())
    for name, module in list(sys.modules.items()):
        if name.split('.')[0] in OURS or str(getattr(module, '__file__', '')).startswith(here):
            del sys.modules[name]


def tested(tests: Sequence[str]) -> int:
    return int(pytest.main([*OPTIONS, *tests]))


def watched(tier: str, tests: Sequence[str], answer: Path) -> int:
    """Run ``tests`` and write what they enter into ``answer``; the exit code of pytest."""
    watch = Watch()
    code = pytest.main([*OPTIONS, '--tier', tier, *tests], plugins=[watch])
    answer.write_text(watch.observed())
    return int(code)


def known(tier: str, tests: Sequence[str]) -> dict[str, Test] | None:
    """Those of a tier that ``tests`` (the arguments) choose, by name. None if one fails or is not found by its name."""
    out: dict[str, Test] = {}
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder, 'seen.json')
        for path in tests:
            if not passed(functools.partial(watched, tier, [path], answer), LONGEST):
                return None
            for name, (seconds, entered) in json.loads(answer.read_text()).items():
                out[name] = Test(seconds, frozenset((file, line) for file, line in entered))
    # A test that is not found by its name would count as one that fails.
    return out if passed(functools.partial(tested, ['--collect-only', *out]), LONGEST) else None


def chosen(tests: dict[str, Test], file: str, first: int) -> list[str]:
    """Those of ``tests`` that enter the function that begins in line ``first`` of ``file``, the quickest first. 0: all,
    those that enter a function of ``file`` first."""
    in_file = {name: any(f == file for f, _ in test.entered) for name, test in tests.items()}
    names = [name for name, test in tests.items() if first == 0 or (file, first) in test.entered]
    names.sort(key=lambda name: (not in_file[name], tests[name].seconds))
    total = itertools.accumulate(tests[name].seconds for name in names)
    return [name for name, seconds in zip(names, total, strict=True) if seconds <= MOST]


def main() -> None:
    os.environ['PYTEST_DISABLE_PLUGIN_AUTOLOAD'] = '1'
    # test/conftest.py reads it.
    os.environ['PSD_DEFLECTION_MUTANTS'] = '1'
    tier, *arguments = sys.argv[1:]
    warm_up(arguments)
    tests = known(tier, arguments)
    print(int(tests is not None), flush=True)
    if tests is None:
        return
    for line in sys.stdin:
        file, first = line.split()
        names = chosen(tests, file, int(first))
        # A program that never ends is noticed soon.
        seconds = 20.0 + 4.0 * sum(tests[name].seconds for name in names)
        print(int(not names or passed(functools.partial(tested, names), seconds)), flush=True)


if __name__ == '__main__':
    main()
