# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The documents do what they say: every command is run, every link leads somewhere.

``make docs STEP=commands`` types their commands and Python (tools/run_commands.py).
"""

import configparser
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from psd_deflection.base import errors
from psd_deflection.cli.main import COMMANDS, main, make_parser
from psd_deflection.rig.declarations import BY_NAME
from tools import pages, run_commands
from tools.program import PSD_DEFLECTION, ROOT
from tools.run_commands import FENCE, PAGES
from tools.tasks import TASKS

ALL = list(run_commands.commands())


def run(words: Sequence[str], cwd: Path = ROOT, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, cwd=cwd, capture_output=True, text=True, check=False, env=env)


def test_there_are_commands_and_python_blocks(tmp_path: Path) -> None:
    assert sum(c.line.startswith('psd-deflection ') for c in ALL) > 40
    every = (*PAGES, *run_commands.NOTEBOOKS)
    python = [line for page in every for line in run_commands.python_of(str(page.relative_to(ROOT)), tmp_path)]
    assert len(python) > 9
    assert 'python notebook.py' in python
    assert {'README.md', 'docs/quickstart.md', 'docs/monitor.md', 'docs/security.md'} <= {c.page for c in ALL}


def test_every_command_is_run() -> None:
    here = {run_commands.typed_as(c.line) for block in run_commands.blocks_to_run() for c in block}
    for command in ALL:
        elsewhere = run_commands.run_by_ci(command.line) is not None
        assert (run_commands.typed_as(command.line) in here) != elsewhere, command
    assert run_commands.stale() == []


def test_a_page_has_what_its_lines_of_pip_add() -> None:
    names = [str(page.relative_to(ROOT)) for page in (*PAGES, *run_commands.NOTEBOOKS)]
    extras = {name: run_commands.extras_of(name) for name in names}
    assert {page: wanted for page, wanted in extras.items() if wanted} == {
        'docs/api.md': ['pandas>=2.1', 'xarray>=2024.1'],
        'docs/commands.md': ['shtab'],
        'docs/camera.md': ['opencv-python-headless>=4.6'],
        'docs/first-day.md': ['pandas'],
        'docs/recording.ipynb': ['matplotlib>=3.6', 'pandas>=2.1', 'xarray>=2024.1'],
        'docs/fleet.md': ['distributed>=2024.1', 'pyarrow>=15'],
    }


def make_targets() -> set[str]:
    """Of the Makefile."""
    return set((ROOT / 'Makefile').read_text().partition('\n.PHONY: ')[2].partition('\n')[0].split())


def test_make_keeps_no_half_made_environment(tmp_path: Path) -> None:
    """As of a Debian without python3-venv."""
    venv, python = tmp_path / 'venv', tmp_path / 'python'
    python.write_text(
        f'#!/bin/sh\ntest "$1" = -c && exit 0\necho "$@"\nmkdir -p {venv}/bin\ntouch {venv}/pyvenv.cfg\nexit 1\n'
    )
    python.chmod(0o755)
    make = ('make', f'PYTHON={python}', f'VENV={venv}', 'UV=', f'{venv}/.requirements')
    for words in ('-m venv', '-m venv --clear'):
        done = run(make)
        assert (done.returncode, venv.exists()) == (2, False)
        assert f'{words} {venv}\n' in re.sub(' +', ' ', done.stdout)
        # One that an older make kept.
        (venv / 'bin').mkdir(parents=True)
        (venv / 'pyvenv.cfg').touch()
        (venv / 'bin/python').symlink_to(shutil.which('false') or '')


def test_tools_are_typed_as_modules() -> None:
    """As files they do not find their neighbours."""
    assert [c for c in ALL if re.match(r'python3? (bench|blind|tools)/', c.line)] == []
    done = run((sys.executable, '-m', 'tools.control_msgs', 'tf2_msgs'), env={'PATH': '', 'PYTHONPATH': str(ROOT)})
    assert re.fullmatch(r'tf2_msgs: cannot be compiled without gcc, g\+\+.*: apt install gcc .*\n', done.stderr)


def test_make_has_few_targets_and_help_names_each() -> None:
    head = (ROOT / 'Makefile').read_text().partition('\nPYTHON ')[0]
    assert (len(make_targets()) <= 22, len(head.splitlines()) <= 15) == (True, True)
    assert [target for target in make_targets() if not re.search(rf'\b{target}\b', head)] == []


def test_ci_runs_what_it_is_reported_to_run() -> None:
    for _, file, text in run_commands.CI_RUNS:
        assert text in (ROOT / file).read_text(), (file, text)
    assert {c.line.split()[1] for c in ALL if c.line.startswith('make ')} <= make_targets()
    demo = TASKS['demo']['discover'].line.replace('build/demo/', '').split(' &&\n')[1:]
    assert demo == [c.line for c in ALL if c.page == 'docs/discover.md'][:3]


def anchors(page: Path) -> set[str]:
    headings = re.findall(r'^#+ (.+)$', page.read_text(), re.M)
    return {re.sub(r'[^\w\- ]', '', h.lower()).strip().replace(' ', '-') for h in headings}


def links(page: Path) -> list[str]:
    """The targets of its links within the repository."""
    targets = re.findall(r'\]\(([^)\s]+)(?: "[^"]*")?\)', FENCE.sub('', page.read_text()))
    return [target for target in targets if not target.startswith(('http://', 'https://', 'mailto:'))]


def linked(page: Path) -> set[Path]:
    """The files that it links to."""
    return {(page.parent / target.partition('#')[0]).resolve() for target in links(page) if target[0] != '#'}


def near_readme() -> set[Path]:
    """The files that are two steps from it."""
    first = linked(ROOT / 'README.md')
    return first.union(*(linked(page) for page in first if page.suffix == '.md'))


QUESTIONS = {
    'May my user open the port?': ('hardware.md', 'dialout'),
    'How is an Arduino wired?': ('devices/lines.md', '## Wiring'),
    'A PSD is mirrored: what now?': ('calibration.md', 'mirrored'),
    'How is a recording computed with another rig file?': ('recording.md', '--params-file'),
    'What does ± mean?': ('accuracy.md', '# Accuracy: what ±'),
    'Which converter shall I buy?': ('hardware.md', '## Which converter'),
    'Is my NI or LabJack supported?': ('devices/replay.md', 'LabJack (T7, U6), MCC, NI (USB-6009'),
    'How long must lasers warm up, and does a zero outlive a restart?': ('calibration.md', 'also after restarts'),
    'How do I hang the link on my robot?': ('topics.md', 'psd_link.urdf.xacro'),
    'How is the last week kept?': ('recording.md', '`bag_keep`'),
    'What does hum of 50 Hz do to ±?': ('devices/README.md', 'averages 50 Hz hum'),
    'Does it run on Kilted?': ('quickstart.md', 'ros-kilted-rclpy'),
    'How is a load noted?': ('monitor.md', 'psd-deflection load 0 -10 0'),
    'Why is there no estimate without a laser?': ('troubleshooting.md', '| laser lost |'),
    'How do estimates get into pandas?': ('api.md', 'to_pandas()'),
    'How does it start at boot?': ('deploy/README.md', 'systemctl'),
    'How is the page seen from another computer?': ('monitor.md', 'ssh -L'),
    'What are gap and noise floor?': ('glossary.md', '| noise floor |'),
    "What sets the page's port in a rig file?": ('monitor.md', '`monitor_port`'),
    'How is a recording cut?': ('recording.md', '## A part of a recording'),
    'How many loads does discover need?': ('discover.md', 'How much is enough?'),
    # Of the first month.
    'Does it run on Windows or on a Mac?': ('quickstart.md', '**Windows and macOS**'),
    'Does it run on a Raspberry Pi?': ('quickstart.md', 'Raspberry Pi'),
    'How is it updated, and what becomes of old recordings?': ('quickstart.md', '## Updating'),
    'How does MATLAB read a recording?': ('recording.md', 'ros2bagreader'),
    'How is a device behind a network connected?': ('devices/network.md', 'socket://'),
    'Who is told at night that the rig has moved?': ('watch.md', '`watch_webhook`'),
    'The beams wander: how does the alarm become quiet?': ('watch.md', '`watch_wander`'),
    'Can I calibrate without a reference?': ('calibration.md', '**Without a reference.**'),
    'What does a calibration still lack?': ('calibration.md', 'calibrate --live'),
    'Are the clocks of two computers the same?': ('topics.md', 'chrony'),
    'How is a trajectory of MoveIt shaped?': ('shaping.md', '## MoveIt'),
    'How is the drift of a night seen?': ('monitor.md', '## The last hours and days'),
    'What happens if the disk is full?': ('robustness.md', '| disk nearly full |'),
}
"""What newcomers looked for, and the words that answer it."""


def test_newcomer_questions_are_answered_near_readme() -> None:
    docs, linked = ROOT / 'docs', near_readme()
    asked = {q: (docs / name, words) for q, (name, words) in QUESTIONS.items()}
    assert [q for q, (page, words) in asked.items() if page not in linked or words not in page.read_text()] == []


def named(tree: Any) -> list[str]:
    """The files that a part of the menu names."""
    if isinstance(tree, str):
        return [tree]
    return [name for part in (tree.values() if isinstance(tree, dict) else tree) for name in named(part)]


def test_every_page_is_in_the_menu_and_near_the_readme() -> None:
    assert {*PAGES} - near_readme() - {ROOT / 'README.md'} == set()
    menu = named(yaml.safe_load((ROOT / 'packaging/mkdocs.yml').read_text())['nav'])
    assert sorted(menu) == sorted(str(page.relative_to(ROOT / 'docs')) for page in PAGES if page != ROOT / 'README.md')


def test_the_pages_are_short() -> None:
    assert len((ROOT / 'README.md').read_text().splitlines()) <= 100
    words = {page: len(page.read_text().split()) for page in PAGES}
    assert [page for page, count in words.items() if count > 2500] == []


def test_tables_and_fences_are_complete() -> None:
    wrong = []
    for page in PAGES:
        text = page.read_text()
        if text.count('\n```') % 2:
            wrong.append(f'{page.name}: a fence without its end')
        for table in re.findall(r'(?:^[ ]*\|.*\n)+', re.sub(r'```.*?```', '', text, flags=re.S), re.M):
            rows = [len(re.findall(r'(?<!\\)\|', re.sub(r'`[^`]*`', '', row))) for row in table.splitlines()]
            wrong += [f'{page.name}: {row}' for row, n in zip(table.splitlines(), rows, strict=True) if n != rows[0]]
    assert wrong == []


def test_links_lead_somewhere() -> None:
    dead = []
    for page, target in [(p, t) for p in PAGES for t in links(p)]:
        name, _, anchor = target.partition('#')
        path = (page.parent / name).resolve() if name else page
        if not path.exists() or (anchor and path.suffix == '.md' and anchor not in anchors(path)):
            dead.append(f'{page.name}: {target}')
    assert dead == []


def test_errata_of_the_thesis_are_on_one_page() -> None:
    audit = {page.name: page.read_text() for page in PAGES}.pop('audit.md')
    assert len(re.findall(r'^## ', audit, re.M)) > 6
    elsewhere = re.compile(r'^#+ .*(errat|discrepanc)|errors of the source', re.M | re.I)
    assert [page for page in PAGES if page.name != 'audit.md' and elsewhere.search(page.read_text())] == []


def test_no_page_loads_anything_from_elsewhere() -> None:
    assert [page for page in PAGES if re.search(r'!\[[^\]]*\]\(https?:', page.read_text())] == []


NOTEBOOKS = sorted((ROOT / 'docs').glob('*.ipynb'))


def outputs(notebook: Path) -> list[list[tuple[Any, ...]]]:
    """Of each cell with code: the kinds of its outputs, and what it prints."""
    cells = [c for c in json.loads(notebook.read_text())['cells'] if c['cell_type'] == 'code']
    return [[(*o.get('data', {}), o.get('text') or o['data']['text/plain']) for o in c['outputs']] for c in cells]


@pytest.mark.slow
@pytest.mark.parametrize('notebook', NOTEBOOKS, ids=lambda p: p.name)
def test_a_notebook_is_shipped_executed_and_runs_in_any_folder(notebook: Path, tmp_path: Path) -> None:
    pytest.importorskip('nbmake')
    copy = tmp_path / notebook.name
    cells = json.loads(notebook.read_text())
    for cell in cells['cells']:
        if cell['cell_type'] == 'code':
            cell.update(outputs=[], execution_count=None)
    copy.write_text(json.dumps(cells))
    words = ('-m', 'pytest', '-q', '--nbmake', '--overwrite', '-p', 'no:cacheprovider', copy.name)
    done = run((sys.executable, *words), tmp_path, {**os.environ, 'PYTHONPATH': str(ROOT), 'HOME': str(tmp_path)})
    assert done.returncode == 0, done.stdout
    assert outputs(copy) == outputs(notebook)
    assert sum(('image/png' in str(kinds)) for cell in outputs(notebook) for kinds in cell) == 1


@pytest.mark.parametrize('page', pages.PAGES, ids=lambda p: p.name)
def test_tables_of_a_page_are_current(page: Path) -> None:
    text = page.read_text()
    assert text.count('python -m tools.pages writes') >= 1
    assert pages.written(text) == text, 'python -m tools.pages'


def test_the_pages_have_few_words() -> None:
    assert 20_000 < pages.words() <= pages.MOST_WORDS


def test_every_table_of_the_program_is_on_a_page() -> None:
    text = ''.join(page.read_text() for page in pages.PAGES)
    assert [name for name in pages.TABLES if f'<!-- {name}: ' not in text] == []
    assert len(pages.OWN_EFFECTS) >= 27
    assert '`monitor_control`' in text


def test_every_error_has_a_documented_status() -> None:
    kinds = [k for k in vars(errors).values() if isinstance(k, type) and issubclass(k, errors.PsdDeflectionError)]
    ours = {k.exit_status for k in kinds} - {errors.PsdDeflectionError.exit_status}
    assert set(errors.EXIT_STATUSES) == {0, 1, errors.INTERRUPTED, *ours}


@pytest.mark.parametrize('shell', ['bash', 'zsh'])
def test_completion_knows_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['completion', shell]) == 0
    script = capsys.readouterr().out
    for word in (*COMMANDS, '--params-file', '--no-ros', '--control'):
        assert word in script


UNIT = ROOT / 'docs' / 'deploy' / 'psd-deflection.service'


def verified(text: str, folder: Path) -> tuple[int, str]:
    """Exit status and complaints of ``systemd-analyze verify``, with a program that is on this machine."""
    if shutil.which('systemd-analyze') is None:
        pytest.skip('the unit file is verified by systemd: apt install systemd')
    unit = folder / UNIT.name
    unit.write_text(text.replace('/opt/psd_deflection/bin/psd-deflection', sys.executable))
    done = run(('systemd-analyze', 'verify', str(unit)))
    return done.returncode, '\n'.join(line for line in done.stderr.splitlines() if UNIT.name in line)


def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    assert verified(UNIT.read_text(), tmp_path) == (0, '')


def test_the_unit_asks_for_what_the_daemon_uses() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(UNIT)
    service = unit['Service']
    assert (service['Type'], service['LimitRTPRIO'], service['LimitMEMLOCK']) == ('notify', '50', 'infinity')
    assert int(service['WatchdogSec']) > 5
    program, command, *arguments = service['ExecStart'].split()
    assert program.endswith('/psd-deflection')
    assert command in COMMANDS
    ours = arguments[: arguments.index('--ros-args')]
    make_parser([command]).parse_args([command, *ours])
    assert arguments[len(ours) :] == ['--ros-args', '-p', 'realtime:=true']
    assert not BY_NAME['realtime'].default


def test_the_paths_of_the_unit_are_those_that_the_page_makes() -> None:
    page = (UNIT.parent / 'README.md').read_text()
    (rig,) = re.findall(r'--params-file (\S+)', UNIT.read_text())
    (user,) = re.findall(r'^User=(\S+)', UNIT.read_text(), re.M)
    assert f'config/thesis_rig.yaml {rig}' in page
    assert re.search(rf'^useradd .*\b{user}$', page, re.M)


PAGE = ROOT / 'docs' / 'ci.md'
BLOCKS = {block['kind']: block['text'] for block in FENCE.finditer(PAGE.read_text())}
STEPS: list[dict[str, Any]] = yaml.safe_load(BLOCKS['yaml'])['jobs']['replay']['steps']


def test_github_takes_the_workflow(tmp_path: Path) -> None:
    pytest.importorskip('check_jsonschema')
    workflow = tmp_path / 'recordings.yml'
    workflow.write_text(BLOCKS['yaml'])
    check = [sys.executable, '-m', 'check_jsonschema', '--builtin-schema', 'vendor.github-workflows']
    done = run((*check, str(workflow)))
    assert done.returncode == 0, done.stdout


def test_the_lines_run(tmp_path: Path) -> None:
    for name in ('bags', 'config'):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / 'check_recording.py').write_text(BLOCKS['python'])
    lines = [step['run'] for step in STEPS if 'run' in step]
    # `make release STEP=wheel` builds it and installs it so.
    assert lines.pop(0) == 'pip install wheels/psd_deflection-*.whl'
    assert len(lines) == 3
    programs = f'{Path(sys.executable).parent}:/usr/bin:/bin'
    for line in lines:
        typed = line.replace('psd-deflection ', f'{shlex.join(PSD_DEFLECTION)} ')
        done = run(('bash', '-e', '-c', typed), tmp_path, {'PATH': programs, 'PYTHONPATH': str(ROOT)})
        # Last bits may differ on a machine of another kind, as the page says.
        assert done.returncode == 0 or (done.returncode == 1 and '--compare' in line), done.stdout + done.stderr
    assert done.stdout.endswith('mdeg\n')
    assert (tmp_path / 'estimates.csv').read_text().startswith('t,dx,dy,theta,')


def test_a_changed_rig_file_fails_the_check(tmp_path: Path) -> None:
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    (tmp_path / 'config').mkdir()
    changed = (ROOT / 'config' / 'thesis_rig.yaml').read_text().replace('[-0.100, 0.0]', '[-0.099, 0.0]')
    (tmp_path / 'config' / 'thesis_rig.yaml').write_text(changed)
    done = run((sys.executable, '-c', BLOCKS['python']), tmp_path, {'PYTHONPATH': str(ROOT)})
    assert (done.returncode, done.stderr.splitlines()[-1]) == (1, 'AssertionError: the estimates have changed')
