# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Runs the commands of README and docs as a reader would: ``make docs STEP=commands``."""

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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from tools.program import PSD_DEFLECTION, ROOT, Program, copy_checkout, ros_domain
from tools.tasks import SHORTEST_BENCH, TASKS

WAIT_S = 1200.0
PAGES = [ROOT / 'README.md', *sorted((ROOT / 'docs').rglob('*.md'))]
FENCE = re.compile(r'^```(?P<kind>\w*)\n(?P<text>.*?)^```', re.M | re.S)
INLINE = re.compile(r'`((?:make|psd-deflection|python|python3|pip|apt|sudo|colcon|ros2) [^`\n]+)`')
SPOKEN_OF = re.compile(r'(psd-deflection (NAME|[a-z-]+)|ros2 [a-z]+( [a-z]+)?)$')
"""Names of commands that take arguments: no reader types them as they stand."""
INDENTED = re.compile(r'^ {4}(?:psd-deflection|make|python|ros2|pip) .+\n(?: {4,}.+\n)*', re.M)
PROGRAMS = ('psd-deflection', 'make', 'ros2', 'pip', 'python', 'python3')
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

NO_CAMPAIGNS = '--no-campaigns'

NEVER_HERE = ('a machine to administer', 'ros2', 'two hours', 'the data of others')
"""Needs that NEED_TOOLS=1 (any other missing program is a failure) does not ask for."""

QUICK = re.compile(
    r'^psd-deflection (info|replay|convert|plot|budget|design|params|effects|completion|thesis)\b'
    r'|^psd-deflection simulate .*--(out|help)\b'
)
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


def is_quick(line: str) -> bool:
    """Whether the tests run it within themselves; `replay --watch` is of what the line before it has recorded."""
    slow = '--serve' in line or '--watch' in line
    return QUICK.search(line) is not None and not slow and run_by_ci(line) is None


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


def blocks_to_run() -> list[list[Command]]:
    """What is run here, in the documents' order; blocks that are quick throughout are left to the tests."""
    blocks: dict[int, list[Command]] = {}
    observed: set[str] = set()
    for command in commands():
        blocks.setdefault(command.block, []).append(command)
    out = []
    for block in blocks.values():
        if block[0].page in JOURNEYS:
            out.append([c for c in block if run_by_ci(c.line) is None])
            continue
        if all(is_quick(c.line) or run_by_ci(c.line) for c in block):
            continue
        left = [c for c in block if run_by_ci(c.line) is None and typed_as(c.line) not in observed]
        # The lines below it may need what a quick one writes.
        left = [c for c in left if not is_quick(c.line) or ' --out ' in c.line]
        observed.update(typed_as(c.line) for c in left)
        if left:
            out.append(left)
    return out


def what_is_missing(line: str) -> str:
    """Why ``line`` cannot be run here (a missing program, or a command for root); '' if it can."""
    if ADMINISTRATION.search(line):
        return NEVER_HERE[0]
    if HOURS.search(line):
        return NEVER_HERE[2]
    if FOREIGN.search(line):
        return NEVER_HERE[3]
    return ', '.join(t for p, tools in TOOLS.items() if re.search(p, line) for t in tools if not shutil.which(t))


def stale() -> list[str]:
    lines = [c.line for c in commands()]
    patterns = [p for p, *_ in CI_RUNS]
    patterns += [
        f'^make {kind} (NAME|STEP)={name}\\b' for kind, tasks in TASKS.items() for name in tasks if name != 'site'
    ]
    patterns += [*TOOLS, *SHORTER, ADMINISTRATION.pattern, HOURS.pattern, FOREIGN.pattern]
    return [p for p in patterns if not any(re.search(p, line) for line in lines)]


class Reader:
    """A reader who types the documented commands in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._device: Program | None = None
        self._background: list[Program] = []
        self._served = ''

    def block(self, lines: list[str], ran: Callable[[str, float, str], None]) -> None:
        """Type the lines of a block one after the other; ``ran`` gets the seconds and, after a failure, the reason."""
        try:
            for line in lines:
                began = time.monotonic()
                failed = ''
                try:
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
        line = line.replace('/dev/ttyACM0', 'ttyACM0').replace('/dev/pts/3', self._served)
        if 'ttyACM0' in line and self._device is None:
            self._device = self._start('psd-deflection simulate --serve --link ttyACM0')
            self._device.until('port: ')
        if line.startswith('curl '):
            self._press(line)
        elif LIVE.search(line):
            self._live(line)
        elif BESIDE.search(line):
            self._background.append(self._start(line))
            self._background[-1].until('publishing ')
        elif AT_THE_BENCH.search(line):
            self._serve()
            self._background.append(self._start(line))
            self._background[-1].until('recording to ')
        elif ASKS.search(line):
            self._serve()
            self._to_the_end(line)
        elif line.startswith('make '):
            command, words, verdict = shortest(line)
            self._to_the_end(f'{command} ARGS="{words}"' if command else line, verdict)
        else:
            if line.startswith(('ros2 topic ', 'ros2 service ', 'ros2 lifecycle ')) and not self._background:
                self._background.append(self._start('psd-deflection estimator'))
                self._background[-1].until(r'θ +[-+]\d')
                # The daemon of ros2 meets it later than its first line.
                self._to_the_end("timeout 60 bash -c 'until ros2 lifecycle nodes | grep -q /estimator; do :; done'")
            self._to_the_end(line)

    def _start(self, line: str) -> Program:
        """The line in a terminal, as a person types it."""
        words = line.replace('psd-deflection', shlex.join(PSD_DEFLECTION), 1) if line.startswith('psd-') else line
        return Program(['bash', '-c', f'exec {words}'], self._folder, terminal=True, wait_s=WAIT_S)

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
            self._background.append(self._start('psd-deflection monitor'))
            self._background[-1].until(r'θ +[-+]\d')

    def _press(self, line: str) -> None:
        self._serve()
        url = self._background[-1].until(r'monitor: (http://[^\s#]+)/')[1]
        line = line.replace('http://127.0.0.1:8790', url)
        end = time.monotonic() + WAIT_S
        while True:
            silent = '--silent' if 'POST' in line else '--silent --fail'
            done = subprocess.run(
                ['bash', '-c', f'{line} {silent}'], capture_output=True, text=True, check=True, timeout=WAIT_S
            )
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
    ``--no-campaigns``: without those that have a short form."""
    # A shell that runs us in the background has it ignored, and so would all that we start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    campaigns = NO_CAMPAIGNS not in sys.argv
    only = ' '.join(word for word in sys.argv[1:] if word != NO_CAMPAIGNS)
    environment = Path(sys.prefix)
    failures = 0
    with tempfile.TemporaryDirectory() as temporary, ros_domain() as domain:
        folder = Path(temporary) / 'checkout'
        copy_checkout(folder, '--cached', '--others', '--exclude-standard')
        full = (ROOT / 'bags/clean/clean_0.mcap').read_bytes()
        (folder / CUT).mkdir(parents=True)
        (folder / CUT / 'cut_0.mcap').write_bytes(full[: len(full) * 6 // 10])
        os.environ.update(
            PATH=f'{environment / "bin"}:{os.environ["PATH"]}',
            VIRTUAL_ENV=str(environment),
            VENV=str(environment),
            MAKEFLAGS=f'VENV={environment}',
            ROS_DOMAIN_ID=str(domain),
            ROS_LOG_DIR=f'{temporary}/log',
            XDG_STATE_HOME=f'{temporary}/state',
        )
        reader = Reader(folder)
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
        try:
            for block in blocks_to_run():
                lines = [c.line for c in block] if any(only in f'{c.page}: {c.line}' for c in block) else []
                for line in [*lines]:
                    if not campaigns and is_campaign(line):
                        lines.remove(line)
                        passed_over.setdefault(NO_CAMPAIGNS, []).append(line)
                    elif missing := what_is_missing(line):
                        lines.remove(line)
                        passed_over.setdefault(missing, []).append(line)
                        failures += os.environ.get('NEED_TOOLS') == '1' and missing not in NEVER_HERE
                reader.block(lines, ran)
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
