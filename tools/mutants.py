"""``make mutants``: break the numerics one line at a time, and see whether a test notices.

cosmic-ray makes the mutants: a sign, a number, a comparison, a truth value. Of each room so many are
drawn with a fixed seed, each is put into a copy of this checkout, and those quick tests of the room that enter
the function run until one fails. What they do not notice is tried by the slow tests of the room, if it has any. What
no test notices is listed; tools/mutants_equivalent.txt has those that nobody could notice, each with the reason, and
they do not count.

  python -m tools.mutants --count 32 --rooms solvers plate
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

ROOT = Path(__file__).parent.parent
EQUIVALENT = Path(__file__).with_name('mutants_equivalent.txt')
NOTICED = ROOT / 'build' / 'mutants' / 'noticed_by.txt'
"""Broken files that a test has noticed, "DIGEST STAGE" a line: only what was not is tried again. Delete it to begin
anew.
"""


class Room(NamedTuple):
    """``code``: files and folders that are broken. ``tests``: what should notice, in seconds.

    ``leave``: files that only draw or word what others computed. ``slow``: what else CI runs; it takes minutes, and
    tries what the ``tests`` do not notice.
    """

    code: tuple[str, ...]
    tests: tuple[str, ...]
    leave: tuple[str, ...] = ()
    slow: tuple[str, ...] = ()


_PIPELINE = (
    'test/measure/test_pipeline.py -k not(drift or rms_errors or rotation or crosstalk or nonlinearity or iterative)'
)
_GOLDEN = 'test/test_golden.py'
_SOLVERS = (
    *('sensitivity', 'truth', 'golden', 'interface', 'properties', 'degenerate', 'registry', 'gauss_newton', 'one_psd'),
)
_UNCERTAINTY = (
    *('formulas', 'consistency', 'combinations', 'stamped', 'redundancy', 'rest', 'block_fit', 'noise', 'converter'),
)
_RUNS = ('test/measure/test_pipeline.py', 'test/test_layouts.py')

ROOMS: Mapping[str, Room] = {
    'solvers': Room(
        ('psd_deflection/model/solvers',),
        (*(f'test/model/solvers/test_{n}.py' for n in _SOLVERS), _GOLDEN),
        slow=('test/model/solvers/test_audit.py', 'test/studies/budget', *_RUNS),
    ),
    'plate': Room(
        ('psd_deflection/model/plate',),
        ('test/model/plate',),
        slow=(
            *(f'test/model/solvers/test_{n}.py' for n in ('sensitivity', 'truth', 'golden')),
            'test/model/simulation/test_simulator.py',
        ),
    ),
    'averaging': Room(('psd_deflection/measure/averaging.py',), ('test/measure/test_averaging.py', _GOLDEN)),
    'timing': Room(
        ('psd_deflection/measure/timing.py',),
        ('test/measure/test_timing.py', 'test/run/test_clock_watch.py'),
        slow=('test/run/test_acquisition.py', 'test/run/test_pinger.py'),
    ),
    'pipeline': Room(
        (
            'psd_deflection/measure/pipeline.py',
            'psd_deflection/measure/estimation.py',
            'psd_deflection/measure/correction.py',
        ),
        (
            _PIPELINE,
            'test/measure/test_estimation.py',
            'test/measure/test_correction.py',
            'test/model/misalignment/test_spread.py',
            'test/measure/uncertainty/test_pipeline_state.py',
            'test/measure/test_health.py',
            'test/model/simulation/test_added_effect.py -k refused or heights',
            'test/test_more_psds.py -k psd_left or without_one or contradicts or on_itself or all_psds or the_last',
            'test/measure/motion/test_motion.py -k anew or begun_at or noted or is_refused',
            _GOLDEN,
        ),
        slow=(
            'test/measure/test_pipeline.py -k drift or an_effect_in or iterative',
            'test/test_more_psds.py',
            'test/measure/motion/test_motion.py -k recorded or coast or ahead or foretold or stated',
            'test/measure/motion/test_inertia.py',
            'test/model/simulation/test_base_pair.py',
            'test/model/simulation/test_effects.py -k correction or together or the_wrench',
        ),
    ),
    'detector': Room(
        ('psd_deflection/model/detector', 'psd_deflection/measure/health.py', 'psd_deflection/rig/wiring.py'),
        ('test/model/detector', 'test/measure/test_health.py', 'test/rig/test_wiring.py', _GOLDEN),
        slow=_RUNS,
    ),
    'uncertainty': Room(
        ('psd_deflection/measure/uncertainty',),
        (
            *(f'test/measure/uncertainty/test_{n}.py' for n in _UNCERTAINTY),
            'test/measure/uncertainty/test_vibration.py -k tone or hum or regular or fit_states or counted',
            'test/measure/test_pipeline.py -k zero or contradict',
            'test/test_more_psds.py -k contradicts or degree or tells_on_itself or one_after or from_the_memory',
            'test/measure/uncertainty/test_pipeline_state.py',
        ),
        slow=_RUNS,
    ),
    'adapters': Room(
        ('msg_adapters',),
        (
            'test/recordings/test_adapters.py',
            'test/recordings/test_contract.py',
            'test/test_more_psds.py -k cloud_of_two',
        ),
        slow=(
            *(f'test/recordings/test_{n}.py' for n in ('bag_writer', 'bag_reader', 'cdr', 'references')),
            'test/arms/chains/test_chain.py',
        ),
    ),
    'protocol': Room(
        ('psd_deflection/devices/protocol', 'psd_deflection/base/sequence.py'),
        (
            'test/devices/protocol',
            'test/base/test_sequence.py',
            *(f'test/devices/test_{n}.py' for n in ('dataq', 'text_lines', 'thorlabs')),
            'test/recordings/test_bag_reader.py -k restart or wrap or again',
        ),
        slow=(
            *(f'test/devices/test_{n}.py' for n in ('source', 'survey')),
            *(f'test/run/test_{n}.py' for n in ('acquisition', 'hello', 'restarts')),
        ),
    ),
    'effects': Room(
        ('psd_deflection/model/simulation/effects',),
        (
            'test/model/simulation/test_catalogue.py',
            'test/model/simulation/test_effect_terms.py',
            'test/model/simulation/test_effect_formulas.py',
            'test/model/simulation/test_effects.py -k back or play or pieces or (wrench and (creep or '
            'friction or load))',
        ),
        slow=('test/model/simulation/test_effects.py', 'test/model/simulation/test_simulator.py'),
    ),
    'discover': Room(
        ('psd_deflection/studies/discover',),
        (
            *(
                f'test/studies/discover/test_{n}.py'
                for n in (
                    *('formulas', 'law_formulas', 'plant_formulas', 'answers', 'rules', 'steps', 'parts'),
                    *('problem', 'limits', 'ties'),
                )
            ),
            # Their pieces: a whole discovery of the catalogue takes seconds.
            'test/studies/discover/test_discover.py -k stripped or refined or coarse or imagined',
            'test/studies/discover/test_planning.py -k loop or words or every_proposal or pieces',
            'test/studies/discover/test_setup.py -k put_right or other_unit or at_its or outliers or stuck',
        ),
        leave=('psd_deflection/studies/discover/report.py',),
        slow=tuple(
            f'test/studies/discover/test_{n}.py'
            for n in ('discover', 'plants', 'planning', 'setup', 'laws', 'readings')
        ),
    ),
    'link': Room(
        ('psd_deflection/model/link',),
        ('test/model/link',),
        slow=('test/model/simulation/test_simulator.py', 'test/studies/thesis'),
    ),
    'misalignment': Room(
        ('psd_deflection/model/misalignment',),
        ('test/model/misalignment',),
        slow=('test/studies/calibrate', 'test/measure/test_estimation.py'),
    ),
    'motion': Room(
        ('psd_deflection/measure/motion',),
        (
            'test/measure/motion/test_modal.py',
            'test/measure/motion/test_unseen.py',
            'test/measure/motion/test_inertia.py',
        ),
        slow=('test/measure/motion/test_motion.py',),
    ),
    'watch': Room(
        ('psd_deflection/measure/watch.py',),
        ('test/measure/test_watch.py',),
        slow=('test/run/test_watcher.py',),
    ),
    'chains': Room(
        ('psd_deflection/arms/chains',),
        ('test/arms/chains',),
        slow=('test/run/test_chain.py', 'test/cli/test_chain.py'),
    ),
    'compensation': Room(
        ('psd_deflection/arms/compensation', 'psd_deflection/arms/shapers.py', 'psd_deflection/arms/inputs.py'),
        ('test/arms/compensation', 'test/arms/test_shapers.py', 'test/arms/test_inputs.py'),
        slow=('test/cli/test_shaper.py',),
    ),
    'camera': Room(
        ('psd_deflection/camera',),
        ('test/camera',),
        leave=('psd_deflection/camera/preview.py', 'psd_deflection/camera/print_target.py'),
        slow=('test/cli/test_camera.py',),
    ),
    'calibrate': Room(
        ('psd_deflection/studies/calibrate',),
        ('test/studies/calibrate/test_dark.py', 'test/studies/calibrate/test_fit.py'),
        leave=('psd_deflection/studies/calibrate/pictures.py',),
        slow=('test/studies/calibrate/test_calibrate.py', 'test/cli/test_calibrate.py'),
    ),
    'check': Room(
        ('psd_deflection/studies/check', 'psd_deflection/studies/noted_loads.py'),
        ('test/studies/check', 'test/studies/test_noted_loads.py'),
        slow=('test/run/test_guided.py',),
    ),
    'identify': Room(
        ('psd_deflection/studies/identify',),
        ('test/studies/identify',),
        leave=('psd_deflection/studies/identify/pictures.py',),
        slow=('test/cli/test_identify.py',),
    ),
    'validate': Room(
        ('psd_deflection/studies/validate',),
        ('test/studies/validate',),
        leave=('psd_deflection/studies/validate/pictures.py',),
        slow=('test/cli/test_validate.py',),
    ),
    'budget': Room(
        ('psd_deflection/studies/budget',),
        ('test/studies/budget',),
        leave=('psd_deflection/studies/budget/pictures.py',),
        slow=('test/cli/test_budget.py',),
    ),
    'thesis': Room(
        ('psd_deflection/studies/thesis',),
        ('test/studies/thesis',),
        leave=('psd_deflection/studies/thesis/figures.py',),
        slow=('test/cli/test_compare_methods.py',),
    ),
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
    """One change of one line, ``line`` from 1; ``occurrence``: of those that ``operator`` finds in ``file``."""

    file: str
    line: int
    operator: str
    occurrence: int

    def code(self, text: str) -> str:
        """The file with the change."""
        return str(mutate_code(text, get_operator('core/' + self.operator)(), self.occurrence))

    def words(self, text: str) -> str:
        """The first changed line as it is and as it was made, for the list."""
        lines = zip(text.splitlines(), self.code(text).splitlines(), strict=True)
        was, made = next((a.strip(), b.strip()) for a, b in lines if a != b)
        return f'{self.file}: {was} -> {made}'


def copy_of_checkout(folder: Path) -> Path:
    """What git knows of this checkout, as it lies here."""
    for name in subprocess.check_output(['git', 'ls-files', '-z'], cwd=ROOT, text=True).split('\0'):
        if name and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def mutants_of(file: str, text: str) -> Iterator[Mutant]:
    """All of a file."""
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
def warm(python: str, folder: Path, tests: Sequence[str]) -> Iterator[Callable[[str, int], bool]]:
    """Says whether the ``tests`` that enter a function pass in a copy of the checkout: its file and first line.

    Raises RuntimeError if they do not pass as it is.
    """
    environment = {**os.environ, 'PYTHONPATH': str(folder), 'PYTHONDONTWRITEBYTECODE': '1'}
    command = [python, str(ROOT / 'tools' / 'warm_pytest.py'), *tests]
    with subprocess.Popen(command, cwd=folder, env=environment, stdin=-1, stdout=-1, text=True) as process:
        if process.stdin is None or process.stdout is None:
            raise RuntimeError('the process that runs the tests has no pipes')
        into, answers = process.stdin, process.stdout

        def answer() -> bool:
            said = answers.readline()
            if not said:
                raise RuntimeError('the process that runs the tests ended')
            return said == '1\n'

        def passed(file: str, first: int) -> bool:
            into.write(f'{file} {first}\n')
            into.flush()
            return answer()

        if not answer():
            raise RuntimeError(f'the tests fail without a mutant: run pytest {" ".join(tests)}')
        yield passed
        process.terminate()


STAGES = ('quick', 'slow')


def tried(
    name: str, python: str, count: int, seed: int, known: Container[str], slow: bool
) -> Iterator[tuple[str, str]]:
    """The mutants of one room in words, and which of the ``STAGES`` noticed; '' if none did.

    The slow tests, if they are asked (``slow``), do not try what is ``known`` to change no answer. Raises RuntimeError
    if the tests fail without.
    """
    room = ROOMS[name]
    lines = NOTICED.read_text().splitlines() if NOTICED.exists() else []
    noticed = dict(line.split(' ') for line in lines)
    with tempfile.TemporaryDirectory() as scratch:
        folder = copy_of_checkout(Path(scratch))
        left = drawn(folder, room, count, seed)
        stages = [
            (stage, tests)
            for stage, tests in zip(STAGES, (room.tests, room.slow if slow else ()), strict=True)
            if tests
        ]
        for stage, tests in stages:
            if not left:
                break
            left, these = [], left
            with warm(python, folder, tests) as passed:
                for mutant in these:
                    file = folder / mutant.file
                    text = file.read_text()
                    code = mutant.code(text)
                    words = mutant.words(text)
                    key = hashlib.sha256(f'{mutant.file}\n{code}'.encode()).hexdigest()
                    seen = noticed.get(key, '')
                    if not seen and not (stage == 'slow' and words in known):
                        file.write_text(code)
                        if not passed(mutant.file, function_at(text, mutant.line)):
                            seen = stage
                            with NOTICED.open('a') as stream:
                                stream.write(f'{key} {stage}\n')
                        file.write_text(text)
                    if seen or stage == stages[-1][0]:
                        yield f'{words}  (line {mutant.line})', seen
                    else:
                        left.append(mutant)


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
    parser.add_argument('--quick', action='store_true', help='without the slow tests')
    parser.add_argument('--python', default=sys.executable, help='the Python that runs the tests (default this one)')
    arguments = parser.parse_args(argv)
    known = equivalent()
    good = True
    print(
        '| room | mutants | equivalent | noticed: quick | slow | of those that count |\n|---|---|---|---|---|---|',
        flush=True,
    )
    unnoticed: list[str] = []
    for name in arguments.rooms:
        same, left, noticed = 0, 0, dict.fromkeys(STAGES, 0)
        for words, seen in tried(name, arguments.python, arguments.count, arguments.seed, known, not arguments.quick):
            print(f'{seen or "NOT noticed"}: {words}', file=sys.stderr, flush=True)
            if seen:
                noticed[seen] += 1
            elif words.rpartition('  (')[0] in known:
                same += 1
            else:
                left += 1
                unnoticed.append(words)
        quick, slow = noticed.values()
        share = (quick + slow) / max(quick + slow + left, 1)
        good &= share >= 0.95
        print(f'| {name} | {same + quick + slow + left} | {same} | {quick} | {slow} | {share:.0%} |', flush=True)
    for words in unnoticed:
        print(f'\nnot noticed: {words}')
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
