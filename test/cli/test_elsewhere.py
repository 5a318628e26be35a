# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The half that analyses recordings runs where there is no Unix: on Windows and macOS, in the workflow.

Here it runs without what only Unix has: those modules cannot be imported, and those names are gone.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from psd_deflection.cli.main import COMMANDS

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
ELSEWHERE = """
import importlib.abc, os, select, signal, sys
MODULES = {'fcntl', 'grp', 'pty', 'pwd', 'resource', 'syslog', 'termios', 'tty'}
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in MODULES:
            raise ModuleNotFoundError(f'No module named {name!r}', name=name)
# What the standard library itself imports of them on this system.
import asyncio, multiprocessing.connection, shutil, subprocess, tempfile, http.server
for name in MODULES:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Absent())
for module, names in (
    (os, 'O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_PATH chown fork geteuid getuid nice openpty setsid statvfs'),
    (os, 'sched_getaffinity sched_setscheduler'),
    (signal, 'SIGALRM SIGHUP SIGUSR1 setitimer'),
    (select, 'poll epoll'),
):
    for name in names.split():
        vars(module).pop(name, None)
os.supports_dir_fd.clear()
from psd_deflection.cli.main import main
sys.exit(main())
"""
ON_UNIX = pytest.mark.skipif(sys.platform == 'win32', reason='there is no Unix to be without')
ROTATED = ['--effect', 'sensor_rotation,psd=2,angle=0.02']
PUSHES = 'steps:0,0,0;30,0,0;0,-50,-29;-40,40,20:1'
STEPS = [
    ['simulate', '--out', 'bag', '--loads', PUSHES, '--seed', '3', '--reference-noise', '1e-5,5e-4', *ROTATED],
    ['info', 'bag'],
    ['replay', 'bag', '--compare'],
    ['replay', str(ROOT / 'bags' / 'clean'), '--compare'],
    ['convert', 'bag', '--out', 'run.csv'],
    ['convert', 'run.csv', '--out', 'again.mcap'],
    ['plot', 'run.csv', '--out', 'run.html'],
    ['plot', 'run.csv', '--out', 'run.png'],
    ['check', 'run.csv', '--out', 'checked'],
    ['identify', 'run.csv', '--out', 'modes'],
    ['validate', 'bag', '--out', 'validated'],
    ['calibrate', 'bag', '--out', 'calibrated', '--quiet'],
    ['calibrate', 'bag', '--check', str(Path('calibrated', 'rig.yaml'))],
    ['discover', 'bag', '--out', 'found', '--quiet'],
    ['recover', 'bag'],
    ['budget'],
]
"""From a simulated recording to its studies, in turn."""
WITHOUT = pytest.param(('-c', ELSEWHERE), marks=ON_UNIX, id='without Unix')
AS_IT_IS = pytest.param(('-m', 'psd_deflection'), id='as it is')


@pytest.mark.parametrize('way', [WITHOUT, AS_IT_IS])
def test_recordings_are_made_read_and_studied(way: tuple[str, str], tmp_path: Path) -> None:
    for step in (step for step in STEPS if step[0] in COMMANDS):
        done = subprocess.run(
            [sys.executable, *way, *step], cwd=tmp_path, capture_output=True, text=True, check=False, encoding='utf-8'
        )
        assert done.returncode in ((0, 1) if '--compare' in step else (0,)), (step, done.stderr[-3000:])
    of_studies = {'discover': 'found/report.html', 'calibrate': 'calibrated/rig.yaml'}
    results = (file for command, file in of_studies.items() if command in COMMANDS)
    for name in ('bag', 'again.mcap', 'run.html', 'run.png', *results):
        assert (tmp_path / name).exists(), name


@pytest.mark.parametrize('way', [WITHOUT, AS_IT_IS])
def test_the_page_of_a_recording_is_served(way: tuple[str, str]) -> None:
    command = [sys.executable, *way, 'monitor', str(ROOT / 'bags' / 'clean'), '--monitor-port', '0']
    # Its output ends with it: if it fails, nothing is waited for.
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding='utf-8') as page:
        assert page.stdout is not None
        logged = []
        for line in page.stdout:
            logged.append(line)
            if line.startswith('monitor: http://'):
                break
        page.terminate()
    assert logged[-1].startswith('monitor: http://'), logged
