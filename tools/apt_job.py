# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The steps of the workflow's job ``apt``, as far as they go in a chroot of Debian: ``make release STEP=apt``."""

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import yaml

from tools.deb import inside
from tools.release import ROOT
from tools.rosdistro import our_rows, written

CANNOT = {
    r' -m bench\.mock_hardware$': 'the controllers of ros2_control are C++, which no registry has',
    r'^ *ros2 bag info ': 'rosbag2_py is C++, which no registry has',
}
"""Lines that are reported instead of run."""
FILES = ROOT / 'packaging/apt_job'
STAND_INS = {
    'opt/ros/jazzy/setup.bash': (FILES / 'setup.bash').read_text(),
    'opt/ros/jazzy/lib/tf2_ros/static_transform_publisher': '#!/bin/sh\necho publishing nothing\nexec sleep infinity\n',
    'opt/ros/jazzy/share/ament_index/resource_index/packages/tf2_ros': '',
    'etc/xml/catalog': (FILES / 'catalog').read_text(),
    'usr/local/bin/apt-get': (FILES / 'apt-get').read_text(),
}
IMAGE = (FILES / 'image.sh').read_text()


def ready(chroot: Path, ros: Path, rosdistro: Path) -> dict[str, str]:
    """The chroot with its stand-ins; returns the environment of its rosdep."""
    if not (chroot / 'etc/debian_version').is_file():
        command = ['debootstrap', '--variant=minbase', 'bookworm', str(chroot)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    shutil.copy2(ROOT / 'packaging/ubuntu-24.04.txt', chroot / 'opt')
    made = chroot / 'opt/image'
    if not made.is_file() or made.read_text() != IMAGE:
        subprocess.run(inside(chroot, f"bash -euc '{IMAGE}'"), check=True, stdout=subprocess.DEVNULL)
        made.write_text(IMAGE)
    for name in ('root/ws', 'root/temp', 'opt/ros', 'opt/rosdistro', 'opt/rosdep'):
        shutil.rmtree(chroot / name, ignore_errors=True)
    shutil.copytree(ros, chroot / 'opt/ros/jazzy', symlinks=True)
    for name in ('rosdep', 'jazzy', 'lyrical'):
        shutil.copytree(rosdistro / name, chroot / 'opt/rosdistro' / name)
    shutil.copy2(rosdistro / 'index-v4.yaml', chroot / 'opt/rosdistro')
    for name, text in STAND_INS.items():
        file = chroot / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        file.chmod(0o755)
    (chroot / 'root/temp').mkdir()
    subprocess.run(['git', 'clone', '-q', ROOT, chroot / 'root/ws/src/psd_deflection'], check=True)
    return written(chroot / 'opt/rosdistro', chroot / 'opt/rosdep', our_rows(ROOT), chroot)


def main(argv: list[str] | None = None) -> int:
    """Prints what became of each step; the exit status is 1 where one failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('ros', type=Path, help='what stands for /opt/ros/jazzy (docs/releasing.md)')
    parser.add_argument('rosdistro', type=Path, help='a checkout of ros/rosdistro')
    parser.add_argument('--chroot', type=Path, default=ROOT / 'build/apt_job')
    parser.add_argument('--skip', default='', help='a step to leave out')
    options = parser.parse_args(argv)
    chroot: Path = options.chroot.resolve()
    chroot.mkdir(parents=True, exist_ok=True)
    job = yaml.safe_load((ROOT / '.github/workflows/ci.yml').read_text())['jobs']['apt']
    row = next(row for row in job['strategy']['matrix']['include'] if row['ros'] == 'jazzy')
    env = {'ROS': 'jazzy', 'RUNNER_TEMP': '/root/temp', 'ROS_OS_OVERRIDE': 'ubuntu:24.04:noble'}
    env['ROS_DOMAIN_ID'] = os.environ.get('ROS_DOMAIN_ID', '0')
    env |= {'PATH': '/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin', **ready(chroot, options.ros, options.rosdistro)}
    words = ' '.join(f"'{name}={value}'" for name, value in env.items())
    failed = 0
    for step in (step for step in job['steps'] if 'run' in step and step['name'] != options.skip):
        lines, reported = step['run'].splitlines(), []
        for i, line in enumerate(lines):
            why = next((why for pattern, why in CANNOT.items() if re.search(pattern, line)), '')
            if why:
                lines[i] = ':'
                reported.append(f'{"":14}cannot run here: {line.strip()}: {why}')
        text = re.sub(r'\$\{\{ matrix\.(\w+) \}\}', lambda match: str(row[match[1]]), '\n'.join(lines))
        (chroot / 'root/step.sh').write_text(text)
        begun, log = time.monotonic(), chroot / f'root/{step["name"].split()[0]}.log'
        shell = f'cd /root/ws && exec env {words} bash --noprofile --norc -eo pipefail /root/step.sh'
        with log.open('wb') as out:
            status = subprocess.run(inside(chroot, shell), stdout=out, stderr=out, check=False).returncode
        print(f'{"FAILED" if status else "passed"} {time.monotonic() - begun:5.0f} s {step["name"]}', flush=True)
        reported += log.read_text(errors='replace').splitlines()[-40:] if status else []
        print(*(f'{line}\n' for line in reported), sep='', end='', flush=True)
        failed += status != 0
    print(f'{failed} steps failed, load {os.getloadavg()[0]:.1f}; stood in for: ROS from apt, tf2_ros, rosdistro')
    return 1 if failed else 0


if __name__ == '__main__':
    sys.exit(main())
