# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make mutants``: break the numerics one line at a time, and see whether a test notices."""

import argparse
import ast
import hashlib
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

from tools.mutants_by_hand import BY_HAND, HandMade, hand_made
from tools.program import ROOT, copy_checkout
from tools.tiers import ROOMS, Room

EQUIVALENT = Path(__file__).with_name('mutants_equivalent.txt')
NOTICED = ROOT / 'build' / 'mutants' / 'noticed_by.txt'
"""Broken files that a test has noticed, "DIGEST STAGE" a line: only what was not is tried again. Delete it to begin
anew."""
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
    """One change of one line, ``line`` from 1; ``occurrence``: of those that ``operator`` finds in ``file``."""

    file: str
    line: int
    operator: str
    occurrence: int

    def code(self, text: str) -> str:
        return str(mutate_code(text, get_operator('core/' + self.operator)(), self.occurrence))

    def words(self, text: str) -> str:
        """The first changed line as it is and as it was made, for the list."""
        lines = zip(text.splitlines(), self.code(text).splitlines(), strict=True)
        was, made = next((a.strip(), b.strip()) for a, b in lines if a != b)
        return f'{self.file}: {was} -> {made}'


def in_room(file: str, room: Room) -> bool:
    return any(file == c or file.startswith(c + '/') for c in room.code)


def of_room(room: Room) -> list[HandMade]:
    """Those made by hand. Raises ValueError if one is of no room."""
    every = hand_made()
    for m in every:
        if not any(in_room(m.file, r) for r in ROOMS.values()):
            raise ValueError(f'{BY_HAND.name}: {m.file} is of no room')
    return [m for m in every if in_room(m.file, room)]


def mutants_of(file: str, text: str) -> Iterator[Mutant]:
    lines, tree = text.splitlines(), get_ast(text)
    for name in OPERATORS:
        operator = get_operator('core/' + name)()
        places = [start for node in ast_nodes(tree) for start, _ in operator.mutation_positions(node)]
        for occurrence, (line, _) in enumerate(places):
            # That a record is frozen or has slots is no number.
            if not lines[line - 1].lstrip().startswith('@'):
                yield Mutant(file, line, name, occurrence)


def drawn(folder: Path, room: Room, count: int, seed: int) -> list[Mutant]:
    """``count`` mutants of the copy in ``folder``, at most one a line."""
    places = [p for c in room.code for p in ([folder / c] if c.endswith('.py') else (folder / c).rglob('*.py'))]
    files = {str(p.relative_to(folder)) for p in places} - {*room.leave}
    every = sorted(m for f in files for m in mutants_of(f, (folder / f).read_text()))
    random.Random(seed).shuffle(every)
    lines: dict[tuple[str, int], Mutant] = {}
    for m in every:
        lines.setdefault((m.file, m.line), m)
    return list(lines.values())[:count]


def function_at(text: str, line: int) -> int:
    """The line in which the innermost function around ``line`` begins, its decorators included; 0 if there is none."""
    around = [
        (node.lineno, min(n.lineno for n in (node, *node.decorator_list)))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.lineno <= line <= (node.end_lineno or 0)
    ]
    return max(around)[1] if around else 0


@contextmanager
def warm(python: str, folder: Path, tier: str, tests: Sequence[str]) -> Iterator[Callable[[str, int], bool]]:
    """Says whether those of ``tests`` that enter a function pass in a copy of the checkout: its file and first line.
    Raises RuntimeError if they do not pass as it is."""
    environment = {**os.environ, 'PYTHONPATH': str(folder), 'PYTHONDONTWRITEBYTECODE': '1'}
    command = [python, str(ROOT / 'tools' / 'warm_pytest.py'), tier, *tests]
    with subprocess.Popen(command, cwd=folder, env=environment, stdin=-1, stdout=-1, text=True) as process:
        if process.stdin is None or process.stdout is None:
            raise RuntimeError('the process that runs the tests has no pipes')
        into, answers = process.stdin, process.stdout

        def answer() -> bool:
            message = answers.readline()
            if not message:
                raise RuntimeError('the process that runs the tests ended')
            return message == '1\n'

        def passed(file: str, first: int) -> bool:
            into.write(f'{file} {first}\n')
            into.flush()
            return answer()

        if not answer():
            raise RuntimeError(f'the tests fail without a mutant: run pytest {" ".join(tests)}')
        yield passed
        process.terminate()


STAGES = ('quick', 'slow')
TIER_OF = {'quick': 'quick', 'slow': 'all'}  # The quick tests of a room are those that `make test` runs.


def tried(
    name: str, python: str, count: int, seed: int | None, known: Container[str], slow: bool
) -> Iterator[tuple[str, str]]:
    """The mutants of one room in words, and which of the ``STAGES`` noticed; '' if none did. ``seed``: of those that
    are drawn; None: those made by hand. The slow tests, if they are asked (``slow``), do not try what is ``known`` to
    change no answer. Raises RuntimeError if the tests fail without."""
    room = ROOMS[name]
    noticed = dict(line.split(' ') for line in (NOTICED.read_text().splitlines() if NOTICED.exists() else ()))
    with tempfile.TemporaryDirectory() as scratch:
        folder = copy_checkout(Path(scratch))
        remaining: list[Mutant | HandMade] = [*(of_room(room) if seed is None else drawn(folder, room, count, seed))]
        every = zip(STAGES, (room.tests, room.slow if slow else ()), strict=True)
        stages = [(stage, tests) for stage, tests in every if tests]
        for stage, tests in stages:
            if not remaining:
                break
            remaining, these = [], remaining
            with warm(python, folder, TIER_OF[stage], tests) as passed:
                for mutant in these:
                    file = folder / mutant.file
                    text = file.read_text()
                    code, words = mutant.code(text), mutant.words(text)
                    line = mutant.line if isinstance(mutant, Mutant) else mutant.line_of(text)
                    key = hashlib.sha256(f'{mutant.file}\n{code}'.encode()).hexdigest()
                    observed = noticed.get(key, '')
                    if not observed and not (stage == 'slow' and words in known):
                        file.write_text(code)
                        if not passed(mutant.file, function_at(text, line)):
                            observed = stage
                            with NOTICED.open('a') as stream:
                                stream.write(f'{key} {stage}\n')
                        file.write_text(text)
                    if observed or stage == stages[-1][0]:
                        yield f'{words}  (line {line})', observed
                    else:
                        remaining.append(mutant)


def equivalent() -> dict[str, str]:
    """Mutants that nobody could notice (:meth:`Mutant.words`), and why. Raises ValueError if a reason is missing."""
    out: dict[str, str] = {}
    for number, line in enumerate(EQUIVALENT.read_text().splitlines(), 1):
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
    parser.add_argument('--by-hand', action='store_true', help=f'instead: those of {BY_HAND.name}')
    parser.add_argument('--quick', action='store_true', help='without the slow tests')
    parser.add_argument('--python', default=sys.executable, help='the Python that runs the tests (default this one)')
    arguments, known = parser.parse_args(argv), equivalent()
    good = True
    print('| room | mutants | equivalent | noticed: quick | slow | of those that count |')
    print('|---|---|---|---|---|---|', flush=True)
    unnoticed: list[str] = []
    for name in arguments.rooms:
        same, survived, noticed = 0, 0, dict.fromkeys(STAGES, 0)
        seed = None if arguments.by_hand else arguments.seed
        for words, observed in tried(name, arguments.python, arguments.count, seed, known, not arguments.quick):
            print(f'{observed or "NOT noticed"}: {words}', file=sys.stderr, flush=True)
            if observed:
                noticed[observed] += 1
            elif words.rpartition('  (')[0] in known:
                same += 1
            else:
                survived += 1
                unnoticed.append(words)
        quick, slow = noticed.values()
        share = (quick + slow) / max(quick + slow + survived, 1)
        good &= share >= 0.95
        print(f'| {name} | {same + quick + slow + survived} | {same} | {quick} | {slow} | {share:.0%} |', flush=True)
    for words in unnoticed:
        print(f'\nnot noticed: {words}')
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
