# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs the commands and the Python of README and docs as a reader would: ``make docs STEP=commands``.

``--clean``: in the environment that the pages tell a reader to make, without the tools of the tests: what `make run`
installs, and on a page what that page's lines of pip add. A notebook has only what its own line of pip installs.
"""

import configparser
import contextlib
import importlib.metadata
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

from tools.program import PSD_DEFLECTION, ROOT, Program, copy_checkout, ros_domain
from tools.tasks import SHORTEST_BENCH, TASKS, install

WAIT_S = 1200.0
PAGES = [ROOT / 'README.md', *sorted((ROOT / 'docs').rglob('*.md'))]
NOTEBOOKS = sorted((ROOT / 'docs').glob('*.ipynb'))
FENCE = re.compile(r'^```(?P<kind>\w*)\n(?P<text>.*?)^```', re.M | re.S)
INLINE = re.compile(r'`((?:make|psd-deflection|python|python3|pip|apt|sudo|colcon|ros2) [^`\n]+)`')
SPOKEN_OF = re.compile(r'(psd-deflection (NAME|[a-z-]+)|ros2 [a-z]+( [a-z]+)?)$')
"""Names of commands that take arguments: no reader types them as they stand."""
INDENTED = re.compile(r'^ {4}(?:psd-deflection|make|python|ros2|pip) .+\n(?: {4,}.+\n)*', re.M)
PROGRAMS = ('psd-deflection', 'make', 'ros2', 'pip', 'python', 'python3')
DEVICE = 'ttyACM0'  # Where the simulated device is that a line with /dev/ttyACM0 gets.
CUT = 'recordings/cut'  # A recording that a crash left without its end.
_TABLES = tomllib.loads((ROOT / 'tools' / 'run_commands.toml').read_text(encoding='utf-8'))
CI_RUNS: list[list[str]] = _TABLES['ci']
SHORTER: dict[str, str] = _TABLES['shorter']
TOOLS: dict[str, list[str]] = _TABLES['tools']
ADMINISTRATION = re.compile(
    r'/opt/psd_deflection|^DASK_CONFIG=|^(apt|install|journalctl|rosdep|source|ssh|sudo|systemctl|udevadm|useradd) '
)
"""Lines for root or for another machine: never typed here. test/docs/test_docs.py checks the files they install."""
HOURS = re.compile(r'^make mutants\b')  # Campaigns whose shortest form says nothing: never run here.
FOREIGN = re.compile(r'^(python -m blind\.duels\b|make campaign NAME=duels\b|make release STEP=apt\b)')
"""Reads data of others, which are not in the repository."""
NO_CAMPAIGNS, CLEAN = '--no-campaigns', '--clean'
NEVER_HERE = ('a machine to administer', 'ros2', 'two hours', 'the data of others')
"""Needs that NEED_TOOLS=1 (any other missing program is a failure) does not ask for."""
LIVE = re.compile(
    r'^psd-deflection (estimator|monitor|chain)\b|--serve\b|^make run\b'
    r'|^ros2 (run|launch) psd_deflection (estimator|chain)\b(?!.*--show-args)'
)
BESIDE = re.compile(r'^(ros2 (run|launch) psd_deflection|psd-deflection) (compensator|shaper)\b|^ros2 run tf2_ros ')
"""Nodes that run beside the lines below them."""
AT_THE_BENCH = re.compile(r'^psd-deflection calibrate --live\b')
"""Records with a running daemon while the lines below it load the tip."""
ASKS = re.compile(r'^psd-deflection (echo|zero|record|load|mark)\b')  # Commands that speak to a running daemon.


class Command(NamedTuple):
    page: str
    block: int
    line: str


def commands() -> Iterator[Command]:
    """All of them: every line of a block that is a command, and in running text those that have arguments."""
    number = 0
    for page in PAGES:
        name, text = str(page.relative_to(ROOT)), page.read_text(encoding='utf-8')
        for fence in FENCE.finditer(text):
            number += 1
            for line in _lines(fence['kind'], fence['text']):
                yield Command(name, number, line)
        rest = FENCE.sub('', text)
        for indented in INDENTED.finditer(rest):
            number += 1
            for line in _lines('sh', indented[0]):
                yield Command(name, number, line.strip())
        for inline in INLINE.finditer(rest):
            number += 1
            line = inline[1].strip()
            if SPOKEN_OF.match(line) is None:
                yield Command(name, number, line)


def _lines(kind: str, text: str) -> Iterator[str]:
    if kind not in ('', 'sh', 'bash', 'console'):
        return
    lines = [raw.rstrip() for raw in text.replace('\\\n', ' ').splitlines() if raw.strip()]
    if kind in ('', 'console'):
        prompted = [raw[2:] for raw in lines if raw.startswith('$ ')]
        full = lines if lines and lines[0].split()[0] in PROGRAMS else []
        lines = prompted or full
    for raw in lines:
        line = re.split(r'\s+#\s|^#', raw + ' ')[0].strip()
        if line:
            yield line


def filled(line: str, recording: str = 'bags/clean') -> str:
    """``line`` with its placeholders filled in; ``recording``: replaces a recording that the reader would have made."""
    line = re.sub(r'\bREC(ORDING)?\b', 'bags/clean', re.sub(r'recordings/psd_(\.\.\.|\w+)', recording, line))
    line = line.replace('OUT.csv', 'out.csv').replace('--out OUT', '--out out').replace('METHOD', 'wls')
    return re.sub(r'\b(my|other)_rig\.yaml', 'config/thesis_rig.yaml', line)


def run_by_ci(line: str) -> tuple[str, str] | None:
    return next(((file, text) for pattern, file, text in CI_RUNS if re.search(pattern, line)), None)


JOURNEYS = ('docs/first-day.md', 'docs/first-month.md')
"""Paths of which every line is typed, in its order, also what is run elsewhere."""


def shortest(line: str) -> tuple[str, str, str]:
    """The target, shortest arguments and verdict of a ``make`` line that has a short form; three '' otherwise."""
    if line.startswith('make bench'):
        return 'make bench', SHORTEST_BENCH, ''
    named = re.match(r'make (\w+) (?:NAME|STEP)=(\S+)', line)
    task = TASKS.get(named[1], {}).get(named[2]) if named else None
    return (str(named and named[0]), task.shortest, task.verdict) if task and task.shortest else ('', '', '')


def typed_as(line: str) -> str:
    """What tells a command from others: a campaign cut short is the same one with whatever numbers it is documented."""
    if shortest(line)[0]:
        return shortest(line)[0]
    return next((pattern for pattern in SHORTER if re.search(pattern, line)), line)


def is_campaign(line: str) -> bool:
    """Whether it takes minutes or hours unless it is cut short."""
    return shortest(line)[0] != '' or (line.startswith('python') and typed_as(line) != line)


WRITES = re.compile(r' --out\b|>|^(cp|sed)\b')


def blocks_to_run() -> list[list[Command]]:
    """What is run here, in the documents' order: a line once, or once a page if it writes or the page needs more."""
    blocks: dict[int, list[Command]] = {}
    observed: set[tuple[str, str]] = set()
    for command in commands():
        blocks.setdefault(command.block, []).append(command)
    out = []
    for block in blocks.values():
        selected = []
        for c in block:
            once_a_page = c.page in JOURNEYS or WRITES.search(c.line) or extras_of(c.page)
            key = (c.page if once_a_page and not is_campaign(c.line) else '', typed_as(c.line))
            if run_by_ci(c.line) is None and (key not in observed or c.page in JOURNEYS):
                selected.append(c)
                observed.add(key)
        if selected:
            out.append(selected)
    return out


PIP = re.compile(r"""pip install '?(?:(?:\.|psd_deflection)\[(?P<extras>[a-z0-9,]+)\]|(?P<package>[a-z]+))(?=['`\s])""")
TRIED_ALONE = frozenset({'rerun'})  # `make demo NAME=rerun` has an environment of its own.


def extras_of(page: str) -> list[str]:
    """The packages that the lines of pip of ``page`` add to what its reader has."""
    wanted = []
    for match in PIP.finditer((ROOT / page).read_text(encoding='utf-8')):
        wanted += [match['package']] if match['package'] else []
        wanted += required(set((match['extras'] or '').split(',')) - {*base_of(page), *TRIED_ALONE, ''})
    return sorted(set(wanted))


def required(extras: Iterable[str]) -> list[str]:
    """What setup.cfg requires for them."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / 'setup.cfg')
    return [package for extra in extras for package in setup['options.extras_require'][extra].split()]


BASE = ('ros', 'monitor', 'plot')
"""The extras that `make run` installs."""


def base_of(page: str) -> tuple[str, ...]:
    """The extras that the reader of ``page`` has: whoever runs a notebook in a folder has no `make run`."""
    return () if page.endswith('.ipynb') else BASE


def python_of(page: str, folder: Path) -> list[str]:
    """Lines that run each Python block of ``page`` and its sessions with their answers, or the cells of a notebook."""
    text, lines, session = (ROOT / page).read_text(encoding='utf-8'), [], ''
    if page.endswith('.ipynb'):
        code = [''.join(cell['source']) for cell in json.loads(text)['cells'] if cell['cell_type'] == 'code']
        (folder / 'notebook.py').write_text('\n'.join(code), encoding='utf-8')
        return ['python notebook.py']
    for number, fence in enumerate(FENCE.finditer(text)):
        if fence['kind'] == 'pycon':
            session += fence['text'] + '\n'
        elif fence['kind'] == 'python':
            (folder / f'block_{number}.py').write_text(fence['text'], encoding='utf-8')
            lines.append(f'python block_{number}.py')
    if session:
        (folder / 'session.txt').write_text(session, encoding='utf-8')
        lines.append('python -m doctest -o ELLIPSIS -o NORMALIZE_WHITESPACE session.txt')
    return lines


def what_is_missing(line: str) -> str:
    """Why ``line`` cannot be run here (a missing program, or a command for root); '' if it can."""
    for pattern, need in ((ADMINISTRATION, 0), (HOURS, 2), (FOREIGN, 3)):
        if pattern.search(line):
            return NEVER_HERE[need]
    return ', '.join(t for p, tools in TOOLS.items() if re.search(p, line) for t in tools if not shutil.which(t))


def stale() -> list[str]:
    lines = [c.line for c in commands()]
    of_tasks = [(kind, name) for kind, tasks in TASKS.items() for name in tasks if name != 'site']
    patterns = [*(p for p, *_ in CI_RUNS), *(f'^make {kind} (NAME|STEP)={name}\\b' for kind, name in of_tasks)]
    patterns += [*TOOLS, *SHORTER, ADMINISTRATION.pattern, HOURS.pattern, FOREIGN.pattern]
    return [p for p in patterns if not any(re.search(p, line) for line in lines)]


OF_THE_TOOLS = re.compile(r'^(make (?!run\b)|python -m (bench|blind|tools)\b)')
"""Lines of who changes the code: README says that they need `make setup`; a target of make installs what it needs."""


class CleanRoom:
    """What a reader has: ``folder/.venv`` as `make run` installs it, and of the environment's variables a few.

    ``beside``: a folder for the home of its own.
    """

    def __init__(self, folder: Path, beside: Path) -> None:
        self._venv = folder / '.venv'
        self._ours = {**os.environ}
        bare = {k: v for k, v in os.environ.items() if k not in ('MAKEFLAGS', 'WITH', 'VENV', 'VIRTUAL_ENV')}
        subprocess.run(['make', f'PYTHON={sys.executable}', '.venv/.installed'], cwd=folder, env=bare, check=True)
        self._base = self._installed()
        inherited = ('ROS_DOMAIN_ID', 'ROS_LOG_DIR', 'XDG_STATE_HOME', 'LANG', 'TERM', 'OMP_NUM_THREADS')
        self._reader = {name: os.environ[name] for name in inherited if name in os.environ}
        self._reader |= {'PATH': f'{self._venv}/bin:/usr/local/bin:/usr/bin:/bin', 'HOME': str(beside / 'home')}
        Path(self._reader['HOME']).mkdir()

    def _installed(self) -> dict[str, str]:
        places = [str(place) for place in self._venv.glob('lib/python*/site-packages')]
        return {d.name: d.version for d in importlib.metadata.distributions(path=places)}

    @contextlib.contextmanager
    def page(self, name: str) -> Iterator[None]:
        """Have what the lines of pip of the page ``name`` add, and a notebook nothing else, until its end."""
        wanted = extras_of(name)
        without = [] if base_of(name) else [package for package in required(BASE) if package not in wanted]
        self._uninstall(re.split(r'[\[<>=]', package)[0] for package in without)
        if wanted:
            install(wanted, str(self._venv))
        yield
        self._uninstall(sorted(self._installed().keys() - self._base.keys()))
        if without:
            install(without, str(self._venv))

    def _uninstall(self, packages: Iterable[str]) -> None:
        names = [*packages]
        if names:
            pip = [f'{self._venv}/bin/python', '-m', 'pip', 'uninstall', '--quiet', '--yes', *names]
            subprocess.run(pip, check=True)

    def typing(self, line: str) -> AbstractContextManager[object]:
        """Have the variables with which ``line`` is typed."""
        return patch.dict(os.environ, self._ours if OF_THE_TOOLS.search(line) else self._reader, clear=True)


class Reader:
    """A reader who types the documented commands in ``folder``; ``room``: a clean one, or None for our environment."""

    def __init__(self, folder: Path, room: CleanRoom | None = None) -> None:
        self._folder = folder
        self._room = room
        self._program = 'psd-deflection' if room else shlex.join(PSD_DEFLECTION)
        self._device: Program | None = None
        self._background: list[Program] = []
        self._served = ''

    def block(self, lines: list[str], ran: Callable[[str, float, str], None]) -> None:
        """Type the lines of a block one after the other; ``ran`` gets the seconds and, after a failure, the reason."""
        try:
            for line in lines:
                began, failed = time.monotonic(), ''
                try:
                    with self._room.typing(line) if self._room else contextlib.nullcontext():
                        self.type(filled(line, CUT))
                except (RuntimeError, OSError, subprocess.SubprocessError) as error:
                    failed = str(error)
                ran(line, time.monotonic() - began, failed)
        finally:
            for program in self._background:
                program.end()
            self._background.clear()

    def type(self, line: str) -> None:
        line += next((f' {arguments}' for pattern, arguments in SHORTER.items() if re.search(pattern, line)), '')
        line = line.replace('/dev/ttyACM0', DEVICE).replace('/dev/pts/3', self._served)
        if DEVICE in line and self._device is None:
            self._device = self._start(f'psd-deflection simulate --serve --link {DEVICE}')
            self._device.until('port: ')
        if line.startswith('curl '):
            self._press(line)
        elif LIVE.search(line):
            self._live(line)
        elif BESIDE.search(line):
            self._beside(line, 'publishing ')
        elif AT_THE_BENCH.search(line):
            self._serve()
            self._beside(line, 'recording to ')
        elif ASKS.search(line):
            self._serve()
            self._to_the_end(line)
        elif line.startswith('make '):
            command, words, verdict = shortest(line)
            self._to_the_end(f'{command} ARGS="{words}"' if command else line, verdict)
        else:
            if line.startswith(('ros2 topic ', 'ros2 service ', 'ros2 lifecycle ')) and not self._background:
                self._beside('psd-deflection estimator', r'θ +[-+]\d')
                # The daemon of ros2 meets it later than its first line.
                self._to_the_end("timeout 60 bash -c 'until ros2 lifecycle nodes | grep -q /estimator; do :; done'")
            self._to_the_end(line)

    def _start(self, line: str) -> Program:
        """The line in a terminal, as a person types it."""
        words = line.replace('psd-deflection', self._program, 1) if line.startswith('psd-') else line
        return Program(['bash', '-c', f'exec {words}'], self._folder, terminal=True, wait_s=WAIT_S)

    def _beside(self, line: str, begun: str) -> None:
        self._background.append(self._start(line))
        self._background[-1].until(begun)

    def _to_the_end(self, line: str, verdict: str = '') -> None:
        program = self._start(line)
        status = program.wait()
        holds = verdict != '' and re.search(verdict, program.text) and 'Traceback' not in program.text
        if status != 0 and not holds:
            raise RuntimeError(f'exit status {status}\n{program.text[-2000:]}')

    def _live(self, line: str) -> None:
        record = re.search(r'--record|record:=true|^make run$', line) is not None
        page = re.search(r' monitor|--monitor|monitor:=true|^make run$', line) is not None
        program = self._start(line)
        try:
            if '--serve' in line:
                self._served = program.until(r'port: (\S+)')[1]
                self._background.append(program)
                return
            if page:
                url = program.until(r'monitor: (http://[^\s#]+)')[1]
                with urllib.request.urlopen(url, timeout=WAIT_S) as answer:
                    if b'psd_deflection monitor' not in answer.read():
                        raise RuntimeError('the address that it prints has another page')
            if not re.search(r' monitor bags/', line):
                program.until(r'(θ +[-+]\d+\.\d\d|rx [-+]\d+\.\d) ± \d')
            status = program.end()
        except RuntimeError as error:
            program.end()
            raise RuntimeError(f'{error}\n{program.text[-2000:]}') from None
        # make and launch themselves are ended by Ctrl-C too.
        if (status != 0 and not line.startswith(('make', 'ros2 launch'))) or 'Traceback' in program.text:
            raise RuntimeError(f'exit status {status} after Ctrl-C\n{program.text[-2000:]}')
        if record and 'replay it:' not in program.text:
            raise RuntimeError(f'no recording was made\n{program.text[-2000:]}')

    def _serve(self) -> None:
        if not self._background:
            self._beside('psd-deflection monitor', r'θ +[-+]\d')

    def _press(self, line: str) -> None:
        self._serve()
        url = self._background[-1].until(r'monitor: (http://[^\s#]+)/')[1]
        line = line.replace('http://127.0.0.1:8790', url)
        end = time.monotonic() + WAIT_S
        while True:
            command = ['bash', '-c', f'{line} --silent' if 'POST' in line else f'{line} --silent --fail']
            done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=WAIT_S)
            answer: dict[str, Any] = json.loads(done.stdout) if 'POST' in line else {'ok': True}
            if answer['ok'] is True:
                return
            # A zero has to wait until the simulated link rests: it does so once in each of its load cases.
            if 'the link moves' not in answer['message'] or time.monotonic() > end:
                raise RuntimeError(done.stdout)
            time.sleep(0.25)

    def close(self) -> None:
        if self._device is not None:
            self._device.end()


def main() -> int:
    """Run all blocks, or those with the words given in a ``PAGE: LINE``; the exit status is 1 where one failed.
    ``--no-campaigns``: without those that have a short form. ``--clean``: as the module says."""
    # A shell that runs us in the background has it ignored, and so would all that we start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    options = {NO_CAMPAIGNS, CLEAN}
    campaigns = NO_CAMPAIGNS not in sys.argv
    only = ' '.join(word for word in sys.argv[1:] if word not in options)
    environment, failures = Path(sys.prefix), 0
    with tempfile.TemporaryDirectory() as temporary, ros_domain() as domain:
        folder = Path(temporary) / 'checkout'
        copy_checkout(folder, '--cached', '--others', '--exclude-standard')
        full = (ROOT / 'bags/clean/clean_0.mcap').read_bytes()
        (folder / CUT).mkdir(parents=True)
        (folder / CUT / 'cut_0.mcap').write_bytes(full[: len(full) * 6 // 10])
        ours = {'VIRTUAL_ENV': str(environment), 'VENV': str(environment), 'MAKEFLAGS': f'VENV={environment}'}
        places = {'ROS_LOG_DIR': f'{temporary}/log', 'XDG_STATE_HOME': f'{temporary}/state'}
        os.environ.update(ours | places, ROS_DOMAIN_ID=str(domain), PATH=f'{environment / "bin"}:{os.environ["PATH"]}')
        room = CleanRoom(folder, Path(temporary)) if CLEAN in sys.argv else None
        reader = Reader(folder, room)
        if shutil.which('ros2'):
            # Without it the first `ros2 lifecycle` sees what it meets in half a second.
            subprocess.run(['ros2', 'daemon', 'start'], check=True)

        def ran(line: str, seconds: float, failed: str) -> None:
            nonlocal failures
            failures += bool(failed)
            print(f'{"FAILED" if failed else "ok":6} {seconds:5.1f} s  {line}', flush=True)
            if failed:
                print(failed, flush=True)

        passed_over: dict[str, list[str]] = {}

        def typed(block: list[Command]) -> list[str]:
            nonlocal failures
            lines = [c.line for c in block if only in f'{c.page}: {c.line}']
            for line in [*lines]:
                if why := NO_CAMPAIGNS if not campaigns and is_campaign(line) else what_is_missing(line):
                    lines.remove(line)
                    passed_over.setdefault(why, []).append(line)
                    failures += os.environ.get('NEED_TOOLS') == '1' and why not in (NO_CAMPAIGNS, *NEVER_HERE)
            return lines

        at_first = {*folder.iterdir(), folder / DEVICE}
        blocks: dict[str, list[list[Command]]] = {str(page.relative_to(ROOT)): [] for page in (*PAGES, *NOTEBOOKS)}
        for block in blocks_to_run():
            blocks[block[0].page].append(block)
        try:
            for page, of_page in blocks.items():
                to_type = [lines for lines in map(typed, of_page) if lines]
                to_type += [[line] for line in python_of(page, folder) if only in f'{page}: {line}']
                if not to_type:
                    continue
                with room.page(page) if room else contextlib.nullcontext():
                    for lines in to_type:
                        reader.block(lines, ran)
                # Two pages may write the same name; the second journey goes on from the first.
                for made in {*folder.iterdir()} - at_first if page not in JOURNEYS else ():
                    if made.is_dir() and not made.is_symlink():
                        shutil.rmtree(made)
                    else:
                        made.unlink()
        finally:
            reader.close()
            if shutil.which('ros2'):
                subprocess.run(['ros2', 'daemon', 'stop'], check=True)
        for missing, lines in passed_over.items():
            where = ', run by the apt job of .github/workflows/ci.yml' if missing == 'ros2' else ''
            why = 'because of' if missing == NO_CAMPAIGNS else 'for want of'
            print(f'not run here, {why} {missing}{where}: {"; ".join(lines)}')
    for pattern in stale():
        failures += 1
        print(f'FAILED: nothing in the documents is like {pattern} any more')
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main())
