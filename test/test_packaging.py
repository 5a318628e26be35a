# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a wheel installs is what ``ros2 run`` looks for; tables agree; the tree may be released."""

import ast
import configparser
import importlib.metadata
import re
import subprocess
import sys
import sysconfig
import xml.etree.ElementTree
from pathlib import Path

import pytest

from psd_deflection import __version__
from psd_deflection.base import plugins
from psd_deflection.cli.main import main
from tools.release import TREE

ROOT = Path(__file__).parent.parent
BESIDE_THE_PACKAGE = {'bench', 'blind', 'data', 'docs'}
"""Folders of test/ that are no room of the package: what they test, or use, lies beside it."""
TESTED_ELSEWHERE = {'plants', 'records'}
"""A room without tests of its own: it declares only."""
EXECUTABLES = (
    *('estimator', 'replay', 'simulate', 'discover', 'calibrate', 'camera'),
    *('validate', 'check', 'identify', 'compensator', 'effects'),
    *('chain', 'shaper'),
)
"""What `ros2 run psd_deflection` lists: what others rely on, and the other nodes."""


def installed_files() -> dict[str, Path]:
    """What pip installed, by the path below the environment; skips where the tests run off a checkout."""
    # Of the environment, not of the checkout that we run in.
    where = [sysconfig.get_path('purelib')]
    distributions = list(importlib.metadata.distributions(name='psd_deflection', path=where))
    if not distributions:
        pytest.skip('psd_deflection is not installed here; `make test` installs it')
    (distribution,) = distributions
    prefix = Path(sys.prefix).resolve()
    located = (Path(str(distribution.locate_file(f))).resolve() for f in distribution.files or ())
    return {str(p.relative_to(prefix)): p for p in located if p.is_relative_to(prefix)}


def test_a_wheel_carries_what_ros2_run_looks_for() -> None:
    files = installed_files()
    assert 'share/ament_index/resource_index/packages/psd_deflection' in files
    for path in ('package.xml', 'config/thesis_rig.yaml', 'launch/estimator.launch.py'):
        assert f'share/psd_deflection/{path}' in files
    programs = {name.removeprefix('lib/psd_deflection/') for name in files if name.startswith('lib/psd_deflection/')}
    assert programs == set(EXECUTABLES)
    for name in EXECUTABLES:
        assert files[f'lib/psd_deflection/{name}'].stat().st_mode & 0o111, name
    beside = Path(sys.executable).parent
    assert not [name for name in EXECUTABLES if (beside / name).exists()]


def test_the_executables_that_ros2_run_starts_run(tmp_path: Path) -> None:
    """One is run; the others are the same."""
    # `ros2 run` takes the package's prefix from the ament index and starts lib/PACKAGE/EXECUTABLE.
    programs = {name: installed_files()[f'lib/psd_deflection/{name}'] for name in EXECUTABLES}
    done = subprocess.run([programs['replay'], '--help'], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert 'usage: psd-deflection replay' in done.stdout
    assert len({program.read_text() for program in programs.values()}) == 1


def test_type_hints_are_shipped() -> None:
    names = [f for f in installed_files() if f.endswith('py.typed')]
    assert any('psd_deflection/py.typed' in n for n in names)
    assert any('msg_adapters/py.typed' in n for n in names)


def test_the_version_is_the_same_everywhere() -> None:
    root = xml.etree.ElementTree.parse(ROOT / 'package.xml').getroot()
    assert root.findtext('version') == __version__
    assert f'## {__version__}' in (ROOT / 'CHANGELOG.md').read_text()


KEYS = {'ruamel': 'python3-ruamel.yaml'}
"""Imported name to rosdep key. The key of any other is ``python3-NAME``."""
ROS_PACKAGES = {'rclpy', 'rcl_interfaces', 'launch', 'launch_ros'}
UNNAMED = {
    **dict.fromkeys(('cobs', 'mcap', 'mcap_ros2'), 'frames, files and messages as judges; from PyPI'),
    'cyclonedds': 'another DDS as judge; not in rosdep',
    'rosbags': 'another reader as judge; from PyPI, so not forced on whoever builds the workspace',
    'selenium': 'the page in a browser; not tested in a build of ROS',
    'prometheus_client': 'the judge of /metrics; not tested in a build of ROS',
    **dict.fromkeys(('psd_deflection', 'msg_adapters', 'test', 'tools', 'bench', 'blind'), 'ours'),
}
"""What the sources import and no list of dependencies names."""
IMPORTED_AS = {'opencv-python-headless': 'cv2', 'rerun-sdk': 'rerun', 'pyserial': 'serial', 'PyYAML': 'yaml'}


def requirements() -> tuple[set[str], dict[str, str]]:
    """Of setup.cfg: what is always installed, and the extra of each further package."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / 'setup.cfg')
    always = {re.split(r'[\[<>=]', line)[0] for line in setup['options']['install_requires'].split()}
    extras = {
        re.split(r'[\[<>=]', line)[0]: extra
        for extra, lines in setup['options.extras_require'].items()
        if extra not in ('test', 'docs')
        for line in lines.split()
    }
    return always, extras


def tables() -> tuple[dict[str, str], dict[str, str]]:
    """Of docs/dependencies.md: the rosdep key of what is always installed, and the extra of the rest."""
    always, _, rest = (ROOT / 'docs/dependencies.md').read_text().partition('## By extras')
    keys = dict(re.findall(r'^\| ([\w.-]+) \| (python3-[\w.]+|none yet)', always, re.M))
    return keys, dict(re.findall(r'^\| ([\w.-]+) \| [^|]+ \| `(\w+)` \|', rest, re.M))


def imported(*folders: str) -> set[str]:
    """Keys in package.xml of all that the sources below ``folders`` import. Messages the node loads by their names."""
    names: set[str] = set()
    for path in (p for folder in folders for p in (ROOT / folder).rglob('*.py')):
        for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition('.')[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names.add(node.module.partition('.')[0])
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and 'test' not in folders:
                match = re.fullmatch(r'(\w+)(?:/(?:msg|action)/\w+|\.msg)', node.value)
                names |= {match[1]} if match else set()
    always, extras = requirements()
    keyless = {name for name, key in tables()[0].items() if not key.startswith('python3-')}
    names -= {*sys.stdlib_module_names, *UNNAMED, *(IMPORTED_AS.get(n, n) for n in (*extras, *keyless))}
    ros = {n for n in names if n in ROS_PACKAGES or n.endswith(('_msgs', '_srvs'))}
    if 'test' not in folders:
        assert names - ros == {IMPORTED_AS.get(n, n.partition('.')[0]) for n in always - keyless}
    return ros | {KEYS.get(n, f'python3-{n}') for n in names - ros}


@pytest.mark.slow
def test_package_xml_names_what_the_sources_import() -> None:
    root = xml.etree.ElementTree.parse(ROOT / 'package.xml').getroot()
    runs, tests = ({e.text for e in root.iter(f'{kind}_depend')} for kind in ('exec', 'test'))
    # ros2launch is the command that reads launch/.
    assert runs == imported('psd_deflection', 'msg_adapters', 'launch') | {'ros2launch'}
    # Plug-ins of pytest are named in its options only.
    assert tests == (imported('test') - runs) | {'python3-pytest-timeout', 'python3-pytest-xdist'}
    assert {e.get('type') for e in root.iter('url')} == {'website', 'repository', 'bugtracker'}
    assert all(e.get('email') for e in root.iter('maintainer'))


def test_the_three_lists_of_dependencies_agree() -> None:
    """setup.cfg, package.xml and docs/dependencies.md."""
    always, extras = requirements()
    keys, documented_extras = tables()
    assert set(keys) == always
    assert documented_extras == extras
    root = xml.etree.ElementTree.parse(ROOT / 'package.xml').getroot()
    named = {e.text for e in root.iter('exec_depend') if (e.text or '').startswith('python3-')}
    assert named == {key for key in keys.values() if key != 'none yet'}


@pytest.mark.parametrize('name', sorted(plugins.EXTRAS))
def test_a_missing_package_is_named_with_what_brings_it(name: str) -> None:
    error = plugins.not_installed(ModuleNotFoundError(f'No module named {name}', name=f'{name}.inside'))
    extra, apt = plugins.EXTRAS[name]
    always, extras = requirements()
    assert (extra == extras[name]) if extra else name in always
    assert str(error).startswith(f'{name} is not installed: `pip install ')
    assert apt in str(error)
    assert '\n' not in str(error)


def test_a_command_whose_extra_is_missing_says_so(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    hidden = {m: None for m in [*sys.modules, 'matplotlib'] if m.partition('.')[0] == 'matplotlib'}
    with pytest.MonkeyPatch.context() as patch:
        for module in hidden:
            patch.setitem(sys.modules, module, None)
        assert main(['plot', str(ROOT / 'bags/clean'), '--out', str(tmp_path / 'plot.png')]) == 3
    message = capsys.readouterr().err
    assert "psd-deflection plot: matplotlib is not installed: `pip install 'psd_deflection[plot]'`" in message
    assert not list(tmp_path.iterdir())


def rooms(package: Path) -> set[str]:
    """Folders and modules of the package, without ``__init__`` and ``__main__``."""
    return {p.stem for p in package.iterdir() if p.stem.isidentifier() and not p.stem.startswith('__')}


def test_the_tests_mirror_the_package() -> None:
    ours = rooms(ROOT / 'psd_deflection') - {'py'}
    folders = {p.name for p in (ROOT / 'test').iterdir() if p.is_dir() and p.name != '__pycache__'}
    assert folders - ours == BESIDE_THE_PACKAGE
    untested = {room for room in ours - folders if not (ROOT / 'test' / f'test_{room}.py').exists()}
    assert untested == TESTED_ELSEWHERE


def test_importing_the_package_is_light() -> None:
    code = 'import sys, psd_deflection; print([m for m in ("numpy", "mcap", "yaml") if m in sys.modules])'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[]'


def test_every_extra_that_is_asked_for_is_there() -> None:
    setup = configparser.ConfigParser()
    setup.read(ROOT / 'setup.cfg')
    places = ('README.md', 'Makefile', 'docs', 'packaging', '.github', 'psd_deflection')
    roots = [ROOT / name for name in places]
    files = [f for root in roots for f in ([root] if root.is_file() else root.rglob('*')) if f.is_file()]
    asked: dict[str, str] = {}
    for file in files:
        if file.suffix in ('.md', '.yml', '.yaml', '.py', ''):
            text = file.read_text(encoding='utf-8', errors='replace')
            groups = re.findall(r'(?:psd[-_]deflection|\.whl"?\)?|[\'" ]\.)\[([a-z,]+)\]', text)
            asked |= {extra: file.name for group in groups for extra in group.split(',')}
    assert {'ros', 'monitor', 'camera'} <= set(asked)
    assert {extra: name for extra, name in asked.items() if extra not in setup['options.extras_require']} == {}


SOURCES = (
    *('psd_deflection', 'msg_adapters', 'launch', 'test', 'bench', 'blind', 'tools', 'resource/ros2_run', 'setup.py'),
)


@pytest.mark.parametrize('place', SOURCES)
def test_every_source_file_names_its_licence(place: str) -> None:
    files = [ROOT / place] if place.endswith('.py') else [p for p in (ROOT / place).rglob('*') if p.is_file()]
    ours = [p for p in files if p.suffix in ('.py', '.c', '.pyx', '.pxd', '.sh') or p.parent.name == 'ros2_run']
    assert ours
    heads = {p: p.read_text(encoding='utf-8')[:300] for p in ours if p.stat().st_size}
    assert [str(p) for p, head in heads.items() if 'SPDX-License-Identifier: Apache-2.0' not in head] == []


@pytest.mark.slow
def test_the_tree_as_it_is_has_no_problem() -> None:
    assert [problem for check in TREE for problem in check(ROOT, False)] == []
