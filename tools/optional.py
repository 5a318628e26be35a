# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Deletes each optional room in turn, in a copy of the tree, and judges what is left: commands, lint, contracts, types,
the core's quick tests; ``--fast``: the first three. Words: the rooms, else all. Last comes the size of the core."""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tools.program import ROOT

# Commands and options of each room, and its files and folders; those that have the name of a command go with it.
ROOMS = {
    'arms': ('chain, compensator, shaper', 'arms run/chain.py ros/follow.py ../test/cli/test_arms.py'),
    'camera': ('camera', 'camera'),
    'fleet': (
        'calibrate --each, calibrate --executor, discover --each, discover --executor, info --executor, info --out, '
        'replay --executor',
        'run/fleet cli/_fleet.py ../test/cli/test_many.py',
    ),
    'foxglove': ('estimator --foxglove, monitor --foxglove', 'run/monitor/foxglove.py run/monitor/test_foxglove.py'),
    'history': ('', 'run/monitor/*history.py'),
    'rerun': ('', 'recordings/*/rerun*.py recordings/test_rerun.py'),
    'plants': ('', 'plants.py studies/discover/plant*.py studies/discover/readings.py'),
    'discover': ('discover', 'plants.py'),
    'check': ('check, discover', 'plants.py run/guided.py'),
    'calibrate': ('calibrate', 'cli/studies/_cal*.py run/bench_*.py run/test_bench_*.py */*/test_cal*ing.py'),
    'budget': ('budget, certificate', ''),
    'design': ('design', 'studies/s[cp]*.py studies/test_splitter.py'),
    **{name: (name, '') for name in ('identify', 'thesis', 'validate')},
    'watch': ('', 'studies/watch'),
}
OF_COMMAND = 'cli/*/{0}.py ros/{0}.py studies/{0} ../launch/{0}.* ../resource/ros2_run/{0} ../test/*/test_{0}*.py '
TESTS = [f'test/{room}' for room in ('base', 'rig', 'measure', 'recordings', 'run', 'cli')]
COMMANDS = """
import json
from psd_deflection.cli.main import COMMANDS, make_parser
subs = next(a for a in make_parser(COMMANDS)._actions if a.dest == 'command').choices
print(json.dumps([*subs, *(f'{n} {o}' for n, p in subs.items() for o in p.get_default('known_options'))]))
"""


def files_of(room: str) -> set[Path]:
    """The files of a room and of its tests, below the root."""
    words, names = ROOMS[room]
    names += ''.join(f' {OF_COMMAND.format(word)}' for word in words.split(', ') if word and ' ' not in word)
    paths = [path for name in names.split() for top in ('psd_deflection', 'test') for path in (ROOT / top).glob(name)]
    files = {file.resolve() for path in paths for file in (path, *path.rglob('*')) if file.suffix != '.pyc'}
    return {file.relative_to(ROOT) for file in files if file.is_file()}


def run(tree: Path, program: str, *words: str) -> str:
    """What a program of this environment prints in ``tree``; raises ValueError with it if it ends with an error."""
    command = [str(Path(sys.executable).with_name(program)), *words]
    environment = {**os.environ, 'PYTHONPATH': str(tree)}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise ValueError((done.stdout + done.stderr)[-2000:])
    return done.stdout


def verdict_of(tree: Path, words: set[str], before: set[str], fast: bool) -> str:
    """The last line of the tests of a tree without the commands ``words``. Raises ValueError for what is wrong."""
    lost = before - set(json.loads(run(tree, 'python', '-c', COMMANDS)))
    if odd := words - lost | {name for name in lost - words if name.partition(' ')[0] not in words}:
        raise ValueError(f'gone or not, against its words: {sorted(odd)}')
    run(tree, 'ruff', 'check', '-q', '.')
    run(tree, 'lint-imports', '--no-cache')
    if fast:
        return ''
    run(tree, 'mypy', 'psd_deflection')
    return run(tree, 'pytest', '-n', '2', '--tier', 'quick', '-m', 'not browser', *TESTS).strip().rpartition('\n')[2]


def main(words: list[str]) -> int:
    """Print a row a room; return 1 if one is not green."""
    tracked = subprocess.run(['git', 'ls-files'], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    ours = [Path(name) for name in tracked if name.startswith('psd_deflection/') and name.endswith('.py')]
    lines = {file: (ROOT / file).read_bytes().count(b'\n') for file in ours}
    status = 0
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        for name in tracked:
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tree / name)
        before = set(json.loads(run(tree, 'python', '-c', COMMANDS)))
        contracts = (ROOT / 'pyproject.toml').read_text().splitlines()
        for room in [word for word in words if word in ROOMS] or ROOMS:
            gone, named = files_of(room), {*filter(None, ROOMS[room][0].split(', '))}
            modules = '|'.join('.'.join(file.with_suffix('').parts).removesuffix('.__init__') for file in gone)
            imports_it = re.compile(rf'^ *(from|import) ({modules})[ .]', re.M)
            line_of_it = re.compile(rf' *"(.*> )?({modules})(\.\*+)?[": ]')
            (tree / 'pyproject.toml').write_text('\n'.join(x for x in contracts if not line_of_it.match(x)) + '\n')
            for file in gone:
                (tree / file).unlink()
            # The functions of the package are doors into every room. mypy finds what is gone in the wheel beside it.
            package = set((tree / 'psd_deflection').rglob('*.py')) - {tree / 'psd_deflection/__init__.py'}
            try:
                if importers := [str(file) for file in package if imports_it.search(file.read_text())]:
                    raise ValueError(f'imported by {importers}')
                verdict = f'green | {verdict_of(tree, named, before, "--fast" in words)} |'
            except ValueError as error:
                status, verdict = 1, f'NOT GREEN | |\n{error}'
            size = sum(lines.get(file, 0) for file in gone)
            print(f'| {room} | {size} lines | {", ".join(sorted(named))} | {verdict}', flush=True)
            for file in gone:
                shutil.copy2(ROOT / file, tree / file)
    core = [lines[file] for file in set(ours).difference(*map(files_of, ROOMS))]
    print(f'core: {sum(core)} of {sum(lines.values())} lines, {len(core)} of {len(ours)} files')
    return status


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
