"""Run pytest in one child after another of a process that has imported all libraries already.

Arguments: the tests, a file or folder each, perhaps with "-k WORDS". Each line of the input is a number of
seconds that a file may take when it is run first, and the name of a module, whose own tests come first; each line
of the output is 1 if all tests passed, 0 if not. Later a file may take four times as long as at first, and 20 s more.
Every child imports the program again.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

OPTIONS = (
    *('-x', '-q', '-p', 'no:cacheprovider', '-p', 'pytest_timeout', '-m', 'not browser'),
    *('-W', 'ignore::pytest.PytestAssertRewriteWarning'),
)

OURS = ('psd_deflection', 'msg_adapters', 'test', 'blind', 'bench', 'tools')


def passed(tests: Sequence[str], seconds: float) -> bool:
    """Whether ``tests`` pass in a child of this process; ends the child and all that it started."""
    child = os.fork()
    if child == 0:
        os.setsid()
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in range(3):
            os.dup2(nowhere, stream)
        os._exit(pytest.main([*OPTIONS, *tests]))
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


def main() -> None:
    """Answer until the input ends."""
    os.environ['PYTEST_DISABLE_PLUGIN_AUTOLOAD'] = '1'
    # test/conftest.py reads it.
    os.environ['PSD_DEFLECTION_MUTANTS'] = '1'
    warm_up(sys.argv[1:])
    tests = [f for t in sys.argv[1:] for f in sorted(map(str, Path(t).rglob('test_*.py'))) or [t]]
    longest: dict[str, float] = {}
    for line in sys.stdin:
        seconds, module = line.split()
        good = True
        # One after the other: what the first notices need not wait for the imports of the rest.
        for test in sorted(tests, key=lambda t: module not in t):
            begun = time.monotonic()
            good = passed(test.split(' ', 2), longest.get(test, float(seconds)))
            if not good:
                break
            # A program that never ends is noticed soon.
            longest.setdefault(test, 20.0 + 4.0 * (time.monotonic() - begun))
        print(int(good), flush=True)


if __name__ == '__main__':
    main()
