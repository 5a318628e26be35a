"""What a wheel installs is what ``ros2 run`` looks for, and the tables in three places agree."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
import sysconfig
import xml.etree.ElementTree
from pathlib import Path

import pytest

from psd_deflection import __version__
from psd_deflection.cli.main import COMMANDS
from psd_deflection.config import read_parameter_file, rig_from_values
from tools.ros2 import launched

ROOT = Path(__file__).parent.parent
EXECUTABLES = ('estimator', 'replay', 'simulate', 'discover')


def installed_files() -> dict[str, Path]:
    """What pip installed, by the path below the environment; skips where the tests run off a checkout."""
    # Of the environment, not of the checkout that we run in.
    where = [sysconfig.get_path('purelib')]
    found = list(importlib.metadata.distributions(name='psd_deflection', path=where))
    if not found:
        pytest.skip('psd_deflection is not installed here; `make test` installs it')
    (distribution,) = found
    prefix = Path(sys.prefix).resolve()
    located = (Path(str(distribution.locate_file(f))).resolve() for f in distribution.files or ())
    return {str(p.relative_to(prefix)): p for p in located if p.is_relative_to(prefix)}


def test_a_wheel_carries_what_ros2_run_looks_for() -> None:
    files = installed_files()
    assert 'share/ament_index/resource_index/packages/psd_deflection' in files
    assert 'share/psd_deflection/package.xml' in files
    assert 'share/psd_deflection/config/thesis_rig.yaml' in files
    assert 'share/psd_deflection/launch/estimator.launch.py' in files
    for name in EXECUTABLES:
        assert files[f'lib/psd_deflection/{name}'].stat().st_mode & 0o111, name


@pytest.mark.parametrize('name', [n for n in EXECUTABLES if n in COMMANDS])
def test_the_executable_that_ros2_run_starts_runs(name: str, tmp_path: Path) -> None:
    # `ros2 run` takes the package's prefix from the ament index and starts lib/PACKAGE/EXECUTABLE.
    program = installed_files()[f'lib/psd_deflection/{name}']
    done = subprocess.run([program, '--help'], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f'usage: psd-deflection {name}' in done.stdout


def test_a_launch_leaves_to_the_file_what_it_is_not_told(tmp_path: Path) -> None:
    installed_files()
    prefix = Path(sys.prefix)
    plain = launched('ros2 launch psd_deflection estimator.launch.py params_file:=rig.yaml', prefix, tmp_path)
    program = str(prefix / 'lib/psd_deflection/estimator')
    assert plain == [program, '--ros-args', '--params-file', 'rig.yaml', '-r', '__node:=estimator']
    told = launched('ros2 launch psd_deflection estimator.launch.py record:=true port:=7', prefix, tmp_path)
    assert told[3] == str(prefix / 'share/psd_deflection/config/thesis_rig.yaml')
    given = read_parameter_file(told[-1])
    assert given == {'record': True, 'port': '7'}
    rig_from_values(given)


def test_type_hints_are_shipped() -> None:
    names = [f for f in installed_files() if f.endswith('py.typed')]
    assert any('psd_deflection/py.typed' in n for n in names)
    assert any('msg_adapters/py.typed' in n for n in names)


def test_the_version_is_the_same_everywhere() -> None:
    root = xml.etree.ElementTree.parse(ROOT / 'package.xml').getroot()
    assert root.findtext('version') == __version__
    assert f'## {__version__}' in (ROOT / 'CHANGELOG.md').read_text()


def test_importing_the_package_is_light() -> None:
    code = 'import sys, psd_deflection; print([m for m in ("numpy", "mcap", "yaml") if m in sys.modules])'
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[]'
