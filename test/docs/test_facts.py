# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the pages state is what the program says: figures, files, options, defaults, lines to paste."""

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from psd_deflection.cli.main import main
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.declarations import BY_NAME
from tools import gallery
from tools.gallery import CASES, STUDIES, Case
from tools.program import ROOT
from tools.run_commands import FENCE, PAGES

FOLDERS = 'bags|bench|blind|config|docs|launch|msg_adapters|packaging|psd_deflection|resource|test|tools'
OF_OTHERS = {'--group-add', '--show-args', '--log-level'}
"""Options of Docker, ros2 launch and rcl."""
SPOKEN = [
    (page.name, code) for page in PAGES for code in re.findall(r'`([^`\n]+)`', FENCE.sub('', page.read_text('utf-8')))
]


def test_every_file_named_on_a_page_exists() -> None:
    named = [(page, code) for page, code in SPOKEN if re.fullmatch(rf'(?:{FOLDERS})/[\w./-]+', code)]
    assert len(named) > 30
    # NAME and ROOM stand for any.
    missing = [(page, code) for page, code in named if not re.search('[A-Z]{4}', code) and not (ROOT / code).exists()]
    assert missing == []


def test_every_option_named_on_a_page_is_declared() -> None:
    folders = ('psd_deflection', 'bench', 'blind', 'tools')
    sources = [ROOT / 'test/conftest.py', *(path for folder in folders for path in (ROOT / folder).rglob('*.py'))]
    text = '\n'.join(path.read_text('utf-8') for path in sources)
    declared = set(re.findall(r"""['"`](--[a-z][a-z-]*)""", text)) | OF_OTHERS
    # The options of settings are made of their fields.
    declared |= {f'--{name.replace("_", "-")}' for name in re.findall(r'^    (\w+): .*= parameter\(', text, re.M)}
    ours = [
        (page, code) for page, code in SPOKEN if not re.match(r'(apt|curl|docker|git|mcap|pip|ros2|ssh|uvx) ', code)
    ]
    named = {(page, option) for page, code in ours for option in re.findall(r'(?<![\w-])--[a-z][a-z-]*', code)}
    assert len(named) > 60
    assert {(page, option) for page, option in named if option not in declared} == set()


def test_every_parameter_that_a_page_sets_is_declared() -> None:
    named = {m[1] for _, code in SPOKEN if (m := re.fullmatch(r'([a-z]+[_.][a-z_.0-9]*): \S.*', code))}
    assert len(named) > 10
    assert named <= set(BY_NAME)


PROMISES = (ROOT / 'tools' / 'promises.txt').read_text('utf-8').splitlines()[2:]


@pytest.mark.parametrize('line', PROMISES)
def test_a_promised_number_is_that_of_the_program(line: str) -> None:
    """To 1 %: a page may round it."""
    match = re.fullmatch(r'(.*?): (.*) = (.*?):(.*?)(?: \* (.*))?', line)
    assert match is not None
    page, words, module, name, factor = match.groups('1')
    before, number, after = re.split('[{}]', words)
    assert ' '.join((ROOT / 'docs' / page).read_text('utf-8').split()).count(before + number + after) == 1
    ours = float(f'{{0.{name}}}'.format(import_module(module)))
    assert float(re.sub('[ ,]', '', number)) * float(factor) == pytest.approx(ours, rel=0.01)


RIG = str(ROOT / 'config' / 'thesis_rig.yaml')


@pytest.mark.slow
@pytest.mark.parametrize(
    ('page', 'arguments'),
    [
        ('mechanics.md', ['design', '--params-file', RIG, '--sigma', '2e-6']),
        ('budget.md', ['budget', '--params-file', RIG, '--monte-carlo', '20000']),
    ],
)
def test_the_quoted_tables_are_the_printed_ones(
    page: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 0
    printed = capsys.readouterr().out.rstrip()
    assert f'```\n{printed}\n```' in (ROOT / 'docs' / page).read_text(encoding='utf-8')


@pytest.mark.slow
def test_the_quoted_answer_is_the_printed_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['discover', str(ROOT / 'docs' / 'hung.csv'), '--out', str(tmp_path)]) == 0
    answer, *_ = capsys.readouterr().out.splitlines()
    assert f'The answer: "{answer}"' in ' '.join((ROOT / 'docs' / 'discover.md').read_text(encoding='utf-8').split())


@pytest.mark.slow
def test_the_errata_of_appendix_b_are_the_printed_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['design']) == 0
    errata = capsys.readouterr().out.partition('Errata:\n')[2].rstrip()
    assert f'```\nErrata:\n{errata}\n```' in (ROOT / 'docs' / 'audit.md').read_text(encoding='utf-8')
    assert 'E-glass/epoxy +-45' in errata


@pytest.mark.slow
@pytest.mark.parametrize(
    ('arguments', 'quoted'),
    [
        (['--method', 'wls'], '29.826 | 5.017 | 0.042'),
        (['--method', 'thesis_iteration'], '66.025 | 0.000 | 52.375'),
        (
            [
                *('--set', 'rotation_tolerance=1e-3', '--set', 'center_tolerance=1e-4'),
                *('--set', 'height_tolerance=2e-4', '--set', 'pointing_drift=2e-6'),
            ],
            '2.992 µm, 5.048 µm and 2.723 mdeg',
        ),
    ],
)
def test_the_quoted_figures_are_the_printed_ones(
    arguments: list[str], quoted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['budget', '--params-file', RIG, '--out', str(tmp_path / 'chart.png'), *arguments]) == 0
    out = capsys.readouterr().out
    assert quoted in (ROOT / 'docs' / 'budget.md').read_text(encoding='utf-8')
    name = 'computation' if '--method' in arguments else 'total'
    line = next(line.split() for line in out.splitlines() if line.startswith(name))
    figures = line[6:9] if name == 'computation' else line[1:4]
    # 'computation  E_C  known bias  B  ∞  ΔX ΔY θ ...'
    assert [w for w in quoted.replace('|', ' ').split() if w[0].isdigit()] == figures


LAST = {'2.': 49, '3.': 23, '4.': 34, '5.': 7, 'A-': 21, 'B-': 8}
"""The last equation of each chapter and appendix; all before it are numbered."""
FIGURES = {'1.': 4, '2.': 13, '3.': 4, '4.': 3, '5.': 35}
EQUATIONS = {f'{chapter}{n}' for chapter, last in LAST.items() for n in range(1, last + 1)}
EVERY = {
    *(f'({e})' for e in EQUATIONS),
    *(f'Fig. {chapter}{n}' for chapter, last in FIGURES.items() for n in range(1, last + 1)),
    *('Fig. A1', 'Fig. A2', 'Fig. B1', 'Table 3.1', 'Table 5.1', 'Table B1', 'Table B2'),
    *(f'Appendix {letter}' for letter in 'ABCD'),
}
STATES = ('done', 'corrected', 'replaced', 'out of scope')
_NUMBER = r'(?:[2-5]\.[1-9]\d?|[AB]-[1-9]\d?)'
_QUOTED = re.compile(rf'\(({_NUMBER}(?:(?:, | and |–|-){_NUMBER})*)\)')


def spelled(words: str) -> Iterator[str]:
    """The numbers of a row's first cell: ``(2.1–2.4), Fig. 2.5``."""
    for part in words.split(', '):
        match = re.fullmatch(r'(\(|Fig\. |Table |Appendix )([^–)]+)(?:–([^–)]+))?(\)?)', part)
        assert match is not None, part
        kind, first, last, close = match.groups()
        if last is None:
            yield f'{kind}{first}{close}'
            continue
        head = re.sub(r'\d+$', '', first)
        assert last.startswith(head), part
        for n in range(int(first[len(head) :]), int(last[len(head) :]) + 1):
            yield f'{kind}{head}{n}{close}'


def test_every_number_of_the_thesis_has_one_row_with_its_state() -> None:
    page = (ROOT / 'docs' / 'audit.md').read_text(encoding='utf-8')
    rows = [line.strip('|').split('|') for line in page.split('## Every number')[1].splitlines() if line[:1] == '|']
    rows = [[cell.strip() for cell in row] for row in rows if row[0].strip('- ') not in ('', 'number')]
    numbers = [number for row in rows for number in spelled(row[0])]
    assert sorted(numbers) == sorted(EVERY)
    assert {row[1] for row in rows} <= set(STATES)
    assert all(row[2] for row in rows)


def texts() -> Iterator[tuple[str, str]]:
    """Pages, and docstrings of the package."""
    for path in (ROOT / 'docs').glob('*.md'):
        yield path.name, path.read_text(encoding='utf-8')
    for path in (ROOT / 'psd_deflection').rglob('*.py'):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                yield str(path.relative_to(ROOT)), ast.get_docstring(node) or ''


@pytest.mark.slow
def test_no_equation_is_quoted_that_the_thesis_has_not() -> None:
    quoted = [(where, n) for where, text in texts() for q in _QUOTED.findall(text) for n in re.findall(_NUMBER, q)]
    assert len(quoted) > 50
    assert [(where, n) for where, n in quoted if n not in EQUATIONS] == []


EVERY_PAGE = sorted([ROOT / 'README.md', *(ROOT / 'docs').rglob('*.md')])
SNIPPETS = [
    (page.relative_to(ROOT), text)
    for page in EVERY_PAGE
    for text in re.findall(r'^```yaml\n(.*?)^```', page.read_text(encoding='utf-8'), re.MULTILINE | re.DOTALL)
]
SECTIONS = {name.partition('.')[0] for name in BY_NAME} | {'effects'}
NO_RIGS = {'target', 'connection', 'name', 'distributed', 'scrape_configs', 'controller_manager'}


@pytest.mark.parametrize(('page', 'text'), SNIPPETS, ids=[f'{p.stem}_{i}' for i, (p, _) in enumerate(SNIPPETS)])
def test_a_rig_in_a_page_can_be_pasted(page: Path, text: str, tmp_path: Path) -> None:
    tree = YAML(typ='safe').load(text)
    if not isinstance(tree, dict):
        return
    bare = set(tree) & SECTIONS - NO_RIGS
    assert not bare, f'{page}: {", ".join(bare)}: below "/**: ros__parameters:"'
    if '/**' in tree:
        (tmp_path / 'rig.yaml').write_text(text, encoding='utf-8')
        assert load_rig(tmp_path / 'rig.yaml').psds


@pytest.mark.slow
def test_every_case_is_on_the_page_with_its_picture() -> None:
    message = gallery.stored()
    assert list(message) == [case.name for study in STUDIES for case in CASES if case.study == study]
    assert gallery.PAGE.read_text() == gallery.page(message)
    assert {path.stem for path in gallery.FIGURES.glob('*.png')} == set(message)


@pytest.mark.slow
# One of each study: ``make docs STEP=gallery ARGS=--check`` has them all.
@pytest.mark.parametrize('case', {case.study: case for case in CASES}.values(), ids=lambda case: str(case.name))
def test_the_program_says_what_the_page_has(case: Case, tmp_path: Path) -> None:
    message = gallery.answered(case, tmp_path)
    assert gallery.same(message, gallery.stored()[case.name]), message
