"""``make mutants``: break the numerics one line at a time, and see whether a test notices.

cosmic-ray makes the mutants: a sign, a number, a comparison, a truth value. Of each room so many are
drawn with a fixed seed, each is put into a copy of this checkout, and the tests of the room run until
one fails. What no test notices is listed with its difference; tools/mutants_equivalent.txt has those
that nobody could notice, each with the reason, and they do not count.

  python -m tools.mutants --count 32 --rooms solvers geometry
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
EQUIVALENT = Path(__file__).with_name('mutants_equivalent.txt')


class Room(NamedTuple):
    """``code``: files and folders that are broken. ``tests``: what should notice, the quickest first."""

    code: tuple[str, ...]
    tests: tuple[str, ...]


_WHOLE = ('test/test_golden.py', 'test/test_pipeline.py')

ROOMS: Mapping[str, Room] = {
    'solvers': Room(('psd_deflection/solvers',), ('test/solvers', *_WHOLE)),
    'geometry': Room(('psd_deflection/geometry',), ('test/geometry', 'test/solvers', 'test/budget')),
    'averaging': Room(('psd_deflection/averaging.py',), ('test/test_averaging.py', *_WHOLE)),
    'timing': Room(('psd_deflection/timing.py',), ('test/test_timing.py', 'test/runner/test_clock_watch.py')),
    'pipeline': Room(
        ('psd_deflection/pipeline.py', 'psd_deflection/correction.py'),
        ('test/test_pipeline.py', 'test/test_golden.py', 'test/uncertainty', 'test/simulation/test_effects.py'),
    ),
    'calibration': Room(('psd_deflection/calibration',), ('test/calibration', *_WHOLE)),
    'uncertainty': Room(('psd_deflection/uncertainty',), ('test/uncertainty', 'test/blind/test_coverage.py')),
    'adapters': Room(('msg_adapters',), ('test/recordings/test_adapters.py', 'test/recordings/test_contract.py')),
    'protocol': Room(
        ('psd_deflection/protocol',),
        (
            'test/protocol',
            'test/runner/test_hello.py',
            *(f'test/devices/test_{n}.py' for n in ('dataq', 'text_lines', 'thorlabs')),
        ),
    ),
    'effects': Room(
        ('psd_deflection/simulation/effects',),
        ('test/simulation/test_effect_formulas.py', 'test/simulation/test_effects.py'),
    ),
    'discovery': Room(('psd_deflection/discovery',), ('test/discovery', 'test/blind/test_blind.py')),
}

OPERATORS = (
    *('NumberReplacer', 'AddNot', 'ReplaceAndWithOr', 'ReplaceOrWithAnd', 'ReplaceTrueWithFalse'),
    *('ReplaceFalseWithTrue', 'ReplaceBreakWithContinue', 'ReplaceContinueWithBreak', 'ZeroIterationForLoop'),
    *('ReplaceBinaryOperator_Add_Sub', 'ReplaceBinaryOperator_Sub_Add', 'ReplaceBinaryOperator_Mul_Div'),
    *('ReplaceBinaryOperator_Div_Mul', 'ReplaceBinaryOperator_Pow_Mul', 'ReplaceUnaryOperator_USub_UAdd'),
    *('ReplaceUnaryOperator_Delete_Not', 'ReplaceComparisonOperator_Lt_GtE', 'ReplaceComparisonOperator_Gt_LtE'),
    *('ReplaceComparisonOperator_LtE_Gt', 'ReplaceComparisonOperator_GtE_Lt', 'ReplaceComparisonOperator_Eq_NotEq'),
    *('ReplaceComparisonOperator_NotEq_Eq', 'ReplaceComparisonOperator_Is_IsNot'),
    *('ReplaceComparisonOperator_Lt_LtE', 'ReplaceComparisonOperator_Gt_GtE'),
    'ReplaceComparisonOperator_IsNot_Is',
)
"""The others of cosmic-ray make programs that cannot run (a shift of a float)."""


class Mutant(NamedTuple):
    """One that was tried. ``noticed``: a test failed, or took too long. ``diff``: as of ``diff -u``."""

    room: str
    file: str
    line: int
    noticed: bool
    diff: str

    def changed(self) -> tuple[str, str]:
        """The line as it is and as it was made, without indentation."""
        lines = [d[1:].strip() for d in self.diff.splitlines() if d[:1] in '+-' and d[:3] not in ('+++', '---')]
        return (lines[0], lines[-1]) if lines else ('', '')

    def words(self) -> str:
        """The line as it is and as it was made, for the list."""
        was, made = self.changed()
        return f'{self.file}: {was} -> {made}'


def cosmic_ray(*arguments: str, folder: Path) -> str:
    """What cosmic-ray printed. Raises CalledProcessError."""
    environment = {**os.environ, 'PYTHONPATH': '.', 'PYTHONDONTWRITEBYTECODE': '1'}
    command = [sys.executable, '-m', 'cosmic_ray.cli', *arguments]
    return subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True, text=True).stdout


def copy_of_checkout(folder: Path) -> Path:
    """What git knows of this checkout, as it lies here."""
    for name in subprocess.check_output(['git', 'ls-files', '-z'], cwd=ROOT, text=True).split('\0'):
        if name and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def draw(session: Path, count: int, seed: int) -> None:
    """Leave ``count`` of a session's mutants, at most one a line, of :data:`OPERATORS`."""
    with sqlite3.connect(session) as base:
        rows = base.execute(
            'SELECT job_id, module_path, start_pos_row, operator_name, occurrence FROM mutation_specs'
        ).fetchall()
        good = sorted((r for r in rows if r[3].removeprefix('core/') in OPERATORS), key=lambda r: r[1:])
        chance = random.Random(seed)
        chance.shuffle(good)
        lines: dict[tuple[str, int], str] = {}
        for job, module, line, _, _ in good:
            lines.setdefault((module, line), job)
        kept = list(lines.values())[:count]
        marks = ','.join('?' * len(kept))
        for table in ('mutation_specs', 'work_items'):
            base.execute(f'DELETE FROM {table} WHERE job_id NOT IN ({marks})', kept)


def tried(name: str, python: str, count: int, seed: int) -> list[Mutant]:
    """The mutants of one room. Raises RuntimeError if its tests fail without any."""
    room = ROOMS[name]
    with tempfile.TemporaryDirectory() as scratch:
        folder = copy_of_checkout(Path(scratch))
        # In the order given: what notices most, and soonest, first.
        tests = ' '.join(room.tests)
        options = '-x -q -p no:cacheprovider -p no:randomly -m "not browser"'
        paths = ', '.join(json.dumps(c) for c in room.code)
        (folder / 'mutants.toml').write_text(
            f'[cosmic-ray]\nmodule-path = [{paths}]\ntimeout = 300.0\nexcluded-modules = []\n'
            f'test-command = {json.dumps(f"{python} -m pytest {options} {tests}")}\n'
            '[cosmic-ray.distributor]\nname = "local"\n'
        )
        cosmic_ray('init', 'mutants.toml', 'mutants.sqlite', folder=folder)
        draw(folder / 'mutants.sqlite', count, seed)
        try:
            cosmic_ray('baseline', 'mutants.toml', folder=folder)
        except subprocess.CalledProcessError as exc:
            raise RuntimeError(f'{name}: the tests fail without a mutant:\n{exc.stdout}{exc.stderr}') from None
        cosmic_ray('exec', 'mutants.toml', 'mutants.sqlite', folder=folder)
        out = []
        for line in cosmic_ray('dump', 'mutants.sqlite', folder=folder).splitlines():
            item, result = json.loads(line)
            (spec,) = item['mutations']
            noticed = result['test_outcome'] != 'survived'
            place = int(spec['start_pos'][0])
            out.append(Mutant(name, str(spec['module_path']), place, noticed, result['diff'] or ''))
        return out


def equivalent() -> dict[str, str]:
    """Mutants that nobody could notice (:meth:`Mutant.words`), and why. Raises ValueError if a reason is missing."""
    out: dict[str, str] = {}
    text = EQUIVALENT.read_text() if EQUIVALENT.exists() else ''
    for number, line in enumerate(text.splitlines(), 1):
        if line and not line.startswith('#'):
            what, _, why = line.partition('  # ')
            if not why:
                raise ValueError(f'{EQUIVALENT.name}, line {number}: a mutant, two spaces, "# " and the reason')
            out[what] = why
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """0 if every room notices 95 % of its mutants that are not equivalent."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--rooms', nargs='+', choices=list(ROOMS), default=list(ROOMS))
    parser.add_argument('--count', type=int, default=32, help='mutants of each room (default 32)')
    parser.add_argument('--seed', type=int, default=1, help='another seed draws others (default 1)')
    parser.add_argument('--python', default=sys.executable, help='the Python that runs the tests (default this one)')
    parser.add_argument('--jobs', type=int, default=2, help='rooms at once (default 2)')
    arguments = parser.parse_args(argv)
    known = equivalent()
    one = functools.partial(tried, python=arguments.python, count=arguments.count, seed=arguments.seed)
    good = True
    print('| room | mutants | equivalent | noticed | of those that count |\n|---|---|---|---|---|', flush=True)
    unnoticed: list[Mutant] = []
    with ThreadPoolExecutor(arguments.jobs) as pool:
        for name, mutants in zip(arguments.rooms, pool.map(one, arguments.rooms), strict=True):
            left = [m for m in mutants if not m.noticed and m.words() not in known]
            noticed = sum(m.noticed for m in mutants)
            share = noticed / max(noticed + len(left), 1)
            good &= share >= 0.95
            same = len(mutants) - noticed - len(left)
            print(f'| {name} | {len(mutants)} | {same} | {noticed} | {share:.0%} |', flush=True)
            unnoticed += left
    for m in unnoticed:
        print(f'\nnot noticed: {m.words()}  (line {m.line})')
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
