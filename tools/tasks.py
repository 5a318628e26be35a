# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What ``make bench``, ``campaign``, ``demo``, ``docs`` and ``release`` start; ``list`` prints the names."""

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent


class Task(NamedTuple):
    """As tools/tasks.toml explains."""

    line: str
    what: str
    shortest: str = ''
    verdict: str = ''
    fresh: str = ''
    packages: Sequence[str] = ()
    environment: str = ''
    apt: Sequence[tuple[str, str]] = ()


ROOT_WORD = '' if os.geteuid() == 0 else 'sudo '
WORDS = {'{jobs}': f'--jobs {os.cpu_count() or 1}', '{root}': str(ROOT), '{python}': sys.executable}
WORDS |= {'{purelib}': sysconfig.get_path('purelib'), '{sudo}': ROOT_WORD}
_TABLES = tomllib.loads((ROOT / 'tools' / 'tasks.toml').read_text(encoding='utf-8'))
WORDS['{site}'] = _TABLES['docs']['site']['line']
BENCH: dict[str, list[str]] = _TABLES.pop('bench')
TASKS = {kind: {name: Task(**task) for name, task in tasks.items()} for kind, tasks in _TABLES.items()}
COLCON = TASKS.pop('colcon')['build']
COLCON_TESTS = ['test/rig', 'test/test_packaging.py']
SHORTEST_BENCH = '--shortest'


def install(packages: Sequence[str], environment: str = sys.prefix) -> None:
    """Install packages of PyPI into an environment, made if it is not there: by uv where that is, else by pip."""
    python = Path(environment) / 'bin/python'
    if not python.exists():
        subprocess.run([sys.executable, '-m', 'venv', environment], check=True)
    uv = shutil.which('uv')
    installer = [uv, 'pip', 'install', '--python', str(python)] if uv else [str(python), '-m', 'pip', 'install']
    subprocess.run([*installer, '--quiet', *packages], cwd=ROOT, check=True)


def bench(words: list[str]) -> int:
    """A look below build/bench; ``--full``: longer and more often, into the files of docs/performance.md."""
    full, shortest = '--full' in words, SHORTEST_BENCH in words
    out = Path('bench' if full else 'build/bench')
    out.mkdir(parents=True, exist_ok=True)
    (out / 'results.json').unlink(missing_ok=True)
    for module, (look, short) in BENCH.items():
        arguments = '' if full else short if shortest else look
        results = {'cpu': 'cpu.json', 'solvers': '', 'accuracy': ''}.get(module, 'results.json')
        into = f'--results {out / results}' if results else ''
        if status := shell(f'python -m bench.{module} {arguments} {into}'):
            return status
    return shell('python -m bench.page') if full else 0


def shell(line: str) -> int:
    """The exit status of ``line``, run in the checkout with our environment first in its path."""
    path = f'{Path(sys.executable).parent}:{os.environ.get("PATH", "")}'
    return subprocess.run(['bash', '-c', line], cwd=ROOT, env={**os.environ, 'PATH': path}, check=False).returncode


def run(task: Task, words: list[str]) -> int:
    wanted = [package for program, package in task.apt if shutil.which(program) is None]
    if wanted:
        get = f'{ROOT_WORD}apt-get -qq'
        shell(f'{get} update && {get} install -y --no-install-recommends {" ".join(wanted)}')
    if task.packages:
        install(task.packages, task.environment or sys.prefix)
    if task.fresh:
        shutil.rmtree(ROOT / task.fresh, ignore_errors=True)
        (ROOT / task.fresh).parent.mkdir(parents=True, exist_ok=True)
    line = task.line
    # Last first: the site has none of the others.
    for word, meaning in reversed(WORDS.items()):
        line = line.replace(word, meaning)
    return shell(f'{line} {shlex.join(words)}')


def main(kind: str, words: list[str]) -> int:
    """Run ``kind`` NAME; without a name, or with another one, print the names."""
    if kind == 'bench':
        return bench(words)
    if kind == 'colcon':
        return run(COLCON, words or COLCON_TESTS)
    tasks = TASKS[kind]
    name, *more = words or ['']
    if name not in tasks:
        print(*(f'{each:18} {task.what}' for each, task in tasks.items()), sep='\n')
        return 0 if name in ('', 'list') else 2
    return run(tasks[name], more)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1], sys.argv[2:]))
