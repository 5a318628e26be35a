# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Checks what a release would publish, and makes the files that repeat its facts."""

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import xml.etree.ElementTree
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
GENERATED = ('CHANGELOG.rst', 'CITATION.cff', 'setup.cfg')
PINNED = re.compile(r'[\w.-]+/[\w./-]+@[0-9a-f]{40}')
VERSION_LINE = re.compile(r'^## (\d+\.\d+\.\d+) \((unreleased|\d{4}-\d\d-\d\d)\)$')
LICENCE = 'Apache-2.0'
WITH_ADDRESSES = ('package.xml', *GENERATED, 'packaging', '.github')
COPYLEFT = re.compile(r'\b(A?GPL|GNU (Affero )?General Public)', re.I)
TITLE = 'psd_deflection: tip deflection and twist of a flexible link from position sensing detectors'


class Facts(NamedTuple):
    """What several files repeat. ``date``: of the newest version, '' if it is not released. ``urls``: by their type."""

    version: str
    date: str
    description: str
    email: str
    urls: dict[str, str]


def facts(root: Path) -> Facts:
    """From package.xml, the package and CHANGELOG.md. Raises ValueError if one of them lacks what is needed."""
    package = xml.etree.ElementTree.parse(root / 'package.xml').getroot()
    version = re.search(r"^__version__ = '(.+)'$", (root / 'psd_deflection/__init__.py').read_text(), re.M)
    newest = next(filter(None, map(VERSION_LINE.match, (root / 'CHANGELOG.md').read_text().splitlines())), None)
    if version is None or newest is None:
        raise ValueError('psd_deflection/__init__.py has no __version__, or CHANGELOG.md no line `## 1.2.3 (date)`')
    maintainer = package.find('maintainer')
    date = '' if newest[2] == 'unreleased' else newest[2]
    email = '' if maintainer is None else maintainer.get('email', '')
    urls = {str(e.get('type')): e.text or '' for e in package.iter('url')}
    return Facts(version[1], date, package.findtext('description', ''), email, urls)


def _rst(text: str) -> str:
    """A line of Markdown as reStructuredText: code, bold, links (their words only)."""
    pieces = re.split(r'(`[^`]+`)', text)
    outside = [re.sub(r'\[([^]]*)\]\([^)]*\)', r'\1', p) for p in pieces[::2]]
    outside = [re.sub(r'(?<!\*)([*_|\\])(?!\*)', r'\\\1', p) if '**' not in p else p for p in outside]
    code = [f'`{p}`' for p in pieces[1::2]]
    # Words beside code are joined to it by a backslash, which RST drops.
    code = [
        (r'\ ' if outside[i][-1:].isalnum() else '') + c + (r'\ ' if outside[i + 1][:1].isalnum() else '')
        for i, c in enumerate(code)
    ]
    return ''.join(a + b for a, b in zip(outside, [*code, ''], strict=True))


def changelog_rst(root: Path) -> str:
    """CHANGELOG.md in the form that bloom reads (REP 132): versions, and lists in lists."""
    title = 'Changelog for package psd_deflection'
    bar = '^' * len(title)
    lines = [f'.. Made from CHANGELOG.md by `make release STEP=files`.\n\n{bar}\n{title}\n{bar}']
    joined = re.sub(r'\n {2,}(?=\S)', ' ', (root / 'CHANGELOG.md').read_text())
    known = False
    for line in joined.splitlines():
        version = VERSION_LINE.match(line)
        if version is not None:
            head = 'Forthcoming' if version[2] == 'unreleased' else f'{version[1]} ({version[2]})'
            lines.append(f'\n{head}\n{"-" * len(head)}')
            known = True
        elif line.startswith('### '):
            lines.append(f'\n* {_rst(line[4:])}\n')
        elif line.startswith('- '):
            lines.append(f'  * {_rst(line[2:])}')
        elif line.startswith('#'):
            continue
        elif line and known:
            lines.append(f'* {_rst(line)}')
    return '\n'.join(lines) + '\n'


def citation_cff(root: Path) -> str:
    """How to cite the software (Citation File Format 1.2.0)."""
    f = facts(root)
    lines = [
        '# Made from package.xml, CHANGELOG.md and the version by `make release STEP=files`.',
        'cff-version: 1.2.0',
        'message: If you use this software, please cite it as below.',
        'type: software',
        f'title: "{TITLE}"',
        f'abstract: {json.dumps(f.description)}',
        'authors:',
        '  - name: psd_deflection maintainers',
        f'version: {f.version}',
        *([f'date-released: {f.date}'] if f.date else []),
        f'license: {LICENCE}',
        f'repository-code: {f.urls.get("repository", "")}',
        f'url: {f.urls.get("website", "")}',
    ]
    return '\n'.join(lines) + '\n'


def setup_cfg(root: Path) -> str:
    f = facts(root)
    text = (root / 'setup.cfg').read_text()
    text = re.sub(r'(?m)^author_email = .*$', f'author_email = {f.email}', text)
    for key, kind in (('url', 'website'), ('    Repository', 'repository'), ('    Issues', 'bugtracker')):
        text = re.sub(rf'(?m)^{key} = .*$', f'{key} = {f.urls.get(kind, "")}', text)
    return text


MAKERS: dict[str, Callable[[Path], str]] = dict(zip(GENERATED, (changelog_rst, citation_cff, setup_cfg), strict=True))


def check_facts(root: Path, release: bool) -> Iterator[str]:
    """Version, changelog entry, date, and the files that are made from them. Only a release has CHANGELOG.rst."""
    f = facts(root)
    package = xml.etree.ElementTree.parse(root / 'package.xml').getroot()
    if package.findtext('version') != f.version:
        yield f'package.xml: version {package.findtext("version")}, the package has {f.version}'
    if f'  version: "{f.version}"\n' not in (root / 'packaging/conda/recipe.yaml').read_text():
        yield f'packaging/conda/recipe.yaml: the version is not {f.version}'
    if f'## {f.version} (' not in (root / 'CHANGELOG.md').read_text():
        yield f'CHANGELOG.md: no entry for {f.version}'
    if release and not f.date:
        yield f'CHANGELOG.md: {f.version} is unreleased; a release has a date'
    for name, made in MAKERS.items():
        path = root / name
        if name == 'CHANGELOG.rst' and not release and not path.exists():
            continue
        if not path.is_file() or path.read_text() != made(root):
            yield f'{name}: stale or missing; `make release STEP=files` makes it'


def check_licence(root: Path, release: bool) -> Iterator[str]:
    """Our licence, the same everywhere, and one beside everything that is not ours."""
    licence = root / 'LICENSE'
    if not licence.is_file() or 'Apache License' not in licence.read_text():
        yield 'LICENSE: missing, or not the Apache License'
    for name, text in (('setup.cfg', f'license = {LICENCE}\n'), ('package.xml', f'>{LICENCE}</license>')):
        if text not in (root / name).read_text():
            yield f'{name}: the licence is not {LICENCE}'
    for folder in root.glob('psd_deflection/**/vendor'):
        if not any('LICEN' in p.name.upper() for p in folder.iterdir()):
            yield f'{folder.relative_to(root)}: what is not ours has no licence beside it'


def check_addresses(root: Path, release: bool) -> Iterator[str]:
    """A release has addresses that lead somewhere; package.xml is the one place for them."""
    if not release:
        return
    for name in WITH_ADDRESSES:
        path = root / name
        for file in sorted(path.rglob('*')) if path.is_dir() else [path]:
            if file.is_file() and '.invalid' in file.read_text(errors='replace'):
                yield f'{file.relative_to(root)}: an address ends with .invalid; fill in package.xml'


def rosdep_table(root: Path) -> dict[str, dict[str, str]]:
    """packaging/rosdep_keys.csv: by the key, how each system resolves it."""
    lines = (root / 'packaging/rosdep_keys.csv').read_text().splitlines()
    return {row.pop('key'): row for row in csv.DictReader(line for line in lines if not line.startswith('#'))}


def check_rosdep(root: Path, release: bool) -> Iterator[str]:
    """Every key of package.xml is one that apt resolves: bloom rejects keys of pip."""
    table = rosdep_table(root)
    if release:
        # A package that apt built without it would start, and fail at its first chunk.
        page = (root / 'docs/dependencies.md').read_text()
        for name in re.findall(r'^\| (\S+) \| none yet', page, re.M):
            yield f'package.xml: lacks {name}, for which rosdep has no key yet (packaging/rosdistro.md)'
    for element in xml.etree.ElementTree.parse(root / 'package.xml').getroot():
        if not element.tag.endswith('depend'):
            continue
        row = table.get(element.text or '')
        if row is None:
            yield f'package.xml: key {element.text} is not in packaging/rosdep_keys.csv'
            continue
        for system, how in row.items():
            if how == 'pip':
                yield f'package.xml: key {element.text} is resolved by pip on {system}; bloom rejects it'
            elif how != 'apt' and release:
                yield f'package.xml: key {element.text} has no row for {system} (packaging/rosdistro.md)'


def check_actions(root: Path, release: bool) -> Iterator[str]:
    """Every action of a workflow is named by a commit, which nobody can move."""
    for file in sorted((root / '.github/workflows').glob('*.yml')):
        for used in re.findall(r'^\s*(?:- )?uses:\s*(\S+)', file.read_text(), re.M):
            if not PINNED.fullmatch(used) and not used.startswith('./'):
                yield f'{file.relative_to(root)}: {used} is not pinned by the SHA of a commit'


def check_wheel(root: Path, wheel: Path) -> Iterator[str]:
    """The wheel has every file of the package that is no Python cache: modules, types, the page; and the licence."""
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    for package in ('psd_deflection', 'msg_adapters'):
        for path in sorted((root / package).rglob('*')):
            name = str(path.relative_to(root))
            if path.is_file() and '__pycache__' not in name and name not in inside:
                yield f'{wheel.name}: lacks {name}'
    for end, what in (('/LICENSE', 'LICENSE'), ('share/psd_deflection/package.xml', 'what `ros2 run` looks for')):
        if not any(name.endswith(end) for name in inside):
            yield f'{wheel.name}: lacks {what}'


Check = Callable[[Path, bool], Iterator[str]]
TREE: tuple[Check, ...] = (check_facts, check_licence, check_addresses, check_rosdep, check_actions)
RENDER = """
from rattler_build import Stage0Recipe, VariantConfig
recipe = Stage0Recipe.from_file('packaging/conda/recipe.yaml')
assert recipe.render(VariantConfig.from_yaml('python_min: ["3.11"]'))
"""
"""The conda recipe, rendered."""
LIST_LICENCES = """
import importlib.metadata, json
rows = []
for d in importlib.metadata.distributions():
    m = d.metadata
    words = [m.get('License-Expression') or '', (m.get('License') or '')[:200]]
    words += [c for c in m.get_all('Classifier') or [] if c.startswith('License')]
    files = [str(f) for f in d.files or () if 'licen' in str(f).lower() or 'copying' in str(f).lower()]
    rows.append([m['Name'], d.version, ' | '.join(w for w in words if w and w != 'UNKNOWN'), bool(files)])
print(json.dumps(rows))
"""


def check_licences_of(python: Path) -> tuple[list[str], list[str]]:
    """(problems, notes) of all distributions of an environment: copyleft of the strong kind is a problem."""
    message = subprocess.run([python, '-c', LIST_LICENCES], capture_output=True, text=True, check=True).stdout
    problems, silent = [], []
    for name, version, words, has_file in json.loads(message):
        if COPYLEFT.search(words) and 'LGPL' not in words and 'Lesser' not in words and ' OR ' not in words:
            problems.append(f'{name} {version}: {words}')
        elif not words and not has_file:
            silent.append(f'{name} {version}')
    return problems, silent


def _tool(command: list[str | Path], cwd: Path) -> tuple[int, str]:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False, cwd=cwd)
    return done.returncode, (done.stdout + done.stderr).strip()


def check_built(root: Path, dist: Path, installed: Path, tools: Path) -> tuple[list[str], list[str]]:
    """(problems, what was not tried) of the sdist, the wheel and the environment with all extras."""
    problems: list[str] = []
    untested: list[str] = []
    wheels, sdists = sorted(dist.glob('*.whl')), sorted(dist.glob('*.tar.gz'))
    if len(wheels) != 1 or len(sdists) != 1:
        return [f'{dist}: {len(wheels)} wheels and {len(sdists)} sdists, one of each is due'], untested
    problems += check_wheel(root, wheels[0])
    checks: tuple[tuple[str, list[str | Path]], ...] = (
        ('twine', ['check', '--strict', wheels[0], sdists[0]]),
        # W009: two packages at the top, on purpose.
        ('check-wheel-contents', ['--ignore', 'W009', wheels[0]]),
        ('zizmor', ['--offline', '--quiet', '.github/workflows']),
        ('hadolint', ['packaging/Dockerfile']),
        ('python', ['-c', RENDER]),
    )
    for name, words in checks:
        status, message = _tool([tools / 'bin' / name, *words], root)
        if status:
            problems.append(f'{name}: {message}')
    python = installed / 'bin/python'
    unlicensed, silent = check_licences_of(python)
    problems += unlicensed
    if silent:
        untested.append('licences that no metadata states: ' + ', '.join(silent))
    bom = dist.parent / 'build/release/sbom.cdx.json'
    status, message = _tool([tools / 'bin/cyclonedx-py', 'environment', python, '--of', 'JSON', '-o', bom], root)
    if status or not json.loads(bom.read_text()).get('components'):
        problems.append(f'cyclonedx-py: {message or "an empty SBOM"}')
    status, message = _tool([tools / 'bin/pip-audit', '--path', _site(python), '--progress-spinner', 'off'], root)
    # It ends with 1 for what it finds, and also if it reaches no database.
    if 'Found' in message and 'vulnerabilit' in message:
        problems.append(f'pip-audit: {message}')
    elif status or 'Skip Reason' in message:
        untested.append('pip-audit: not every package was found in its database: ' + message.splitlines()[-1])
    return problems, untested


def _site(python: Path) -> str:
    code = 'import sysconfig; print(sysconfig.get_path("purelib"))'
    return subprocess.run([python, '-c', code], capture_output=True, text=True, check=True).stdout.strip()


NEVER_HERE = (
    'publishing to PyPI, ros2-gbp, conda-forge and a registry of containers: only the maintainer does',
    'building the containers (packaging/Dockerfile): the workflow does, with a Docker engine',
    'the ROS distributions from apt (Jazzy, Lyrical, Rolling): the workflow does',
    'rosdep with the whole of rosdistro, and the .deb in a plain Debian: `make release` with STEP=rosdep and STEP=deb',
    'building the conda recipe (packaging/conda), which is rendered: no channel of conda is on a registry that we use',
)


def main(argv: list[str] | None = None, root: Path = ROOT) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('what', choices=('files', 'check'))
    parser.add_argument('--dist', type=Path, default=root / 'dist')
    parser.add_argument('--installed', type=Path, help='environment with the wheel and all extras')
    parser.add_argument('--tools', type=Path, help='environment with twine and the others')
    options = parser.parse_args(argv)
    if options.what == 'files':
        for name, made in MAKERS.items():
            (root / name).write_text(made(root))
        return 0
    release = os.environ.get('RELEASE') == '1'
    problems = [problem for check in TREE for problem in check(root, release)]
    untested: list[str] = []
    if options.installed and options.tools:
        installed, tools = options.installed.absolute(), options.tools.absolute()
        lacks, untested = check_built(root, options.dist.resolve(), installed, tools)
        problems += lacks
    else:
        untested = ['what is built: --installed and --tools name where it is']
    if not release:
        untested.append('what only a release must have (real addresses, a date, rows of rosdep): RELEASE=1')
    print(*(f'not tried: {line}' for line in (*untested, *NEVER_HERE)), sep='\n')
    for line in problems:
        print(f'PROBLEM: {line}')
    print('release-check: ' + (f'{len(problems)} problems' if problems else 'nothing is wrong with what was tried'))
    return 1 if problems else 0


if __name__ == '__main__':
    sys.exit(main())
