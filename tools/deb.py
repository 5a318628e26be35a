# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From a plain Debian to the live page: by pip, and by the .deb of bloom's templates; both timed."""

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

from tools.program import ROOT, copy_checkout
from tools.release import changelog_rst
from tools.rosdistro import our_rows, prepared

PAGE = re.compile(r'http://127\.0\.0\.1:\d+/')
LONGEST = 3600.0  # s: longer than this nobody waits for a step on a busy machine; an idle one needs a minute or two.
ENTER, BUILD = ((ROOT / 'packaging/deb' / name).read_text() for name in ('enter.sh', 'build.sh'))
PIP = 'apt-get install -qq --no-install-recommends python3-venv >/dev/null 2>&1'
OF_APT = './stand-in*.deb ./ros-jazzy-*.deb python3-zstandard python3-aiohttp'
INSTALL = f'cd /root && apt-get install -qq --no-install-recommends {OF_APT} >/dev/null 2>&1'
JAZZY = '/opt/ros/jazzy'
START = f'cd /root && PYTHONPATH=$(echo {JAZZY}/lib/python3*/site-packages) exec {JAZZY}/bin/psd-deflection monitor'
LEFT = (
    'the tests of the package in its build (nocheck): Debian has no ROS',
    'the node of ROS: its packages are stood in for; the workflow runs it with those of apt',
    'Ubuntu 24.04 and 26.04: no registry here has them; the workflow runs the line of pip there',
)


def one_line(root: Path) -> str:
    """The line of README.md that goes from a checkout to the live page by pip."""
    match = re.search(r'^python3 -m venv .+ monitor$', (root / 'README.md').read_text(), re.M)
    if match is None:
        raise ValueError('README.md: no line `python3 -m venv ... monitor`')
    return match[0]


def tree(folder: Path) -> Path:
    """What git has of the checkout, copied into ``folder``, with the changelog that bloom reads."""
    (copy_checkout(folder) / 'CHANGELOG.rst').write_text(changelog_rst(ROOT))
    return folder


def templates(folder: Path, env: dict[str, str], system: str, version: str) -> list[str]:
    """Fills ``folder/debian`` as bloom does, and returns what it warns of. Raises RuntimeError if it rejects."""
    words = f'bloom-generate rosdebian --os-name {system} --os-version {version} --ros-distro jazzy .'
    none = subprocess.DEVNULL
    done = subprocess.run(words.split(), cwd=folder, env=env, stdin=none, capture_output=True, text=True, check=False)
    message = re.sub(r'\x1b\[\d*m', '', done.stdout + done.stderr)
    if done.returncode or not (folder / 'debian/control').is_file():
        raise RuntimeError(f'bloom rejects the package for {version}:\n{message}')
    return [line for line in message.splitlines() if 'warn' in line.lower() or line.startswith('No CHANGELOG')]


def inside(chroot: Path, script: str) -> list[str]:
    """The command that runs ``script`` in the chroot."""
    # What ends the first process of its name space ends all of it.
    return ['unshare', '--mount', '--pid', '--fork', '--kill-child', 'bash', '-c', ENTER, '-', str(chroot), script]


def seconds_of(chroot: Path, script: str) -> float:
    """How long a step took, s."""
    begun = time.monotonic()
    subprocess.run(inside(chroot, script), check=True, timeout=LONGEST)
    return time.monotonic() - begun


def answers(address: str) -> bool:
    """Whether the live page is there."""
    try:
        with urllib.request.urlopen(address, timeout=5) as page:
            return b'<title>' in page.read()
    except (urllib.error.URLError, TimeoutError):
        return False


def seconds_to_the_page(chroot: Path, script: str) -> float:
    """From the start of ``script`` until the page that it names answers, s. Raises RuntimeError if it never does."""
    begun = time.monotonic()
    log = chroot / 'root/said'
    with log.open('wb') as out, subprocess.Popen(inside(chroot, script), stdout=out, stderr=out) as running:
        try:
            while time.monotonic() - begun < LONGEST and running.poll() is None:
                address = PAGE.search(log.read_text(errors='replace'))
                if address and answers(address[0]):
                    return time.monotonic() - begun
                time.sleep(0.1)
        finally:
            # unshare passes no other signal on, and does not end by them.
            running.kill()
            running.wait()
    raise RuntimeError(f'no page after {time.monotonic() - begun:.0f} s:\n{log.read_text(errors="replace")[-2000:]}')


def main(argv: list[str] | None = None) -> int:
    """Prints the seconds of each step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('rosdistro', type=Path)
    parser.add_argument('--suite', default='trixie', help='of Debian')
    parser.add_argument('--tools', type=Path, default=ROOT / 'build/bloom', help='environment with bloom and rosdep')
    parser.add_argument('--work', type=Path, default=ROOT / 'build/deb')
    options = parser.parse_args(argv)
    if os.geteuid() != 0 or shutil.which('debootstrap') is None:
        print('deb: debootstrap and root are needed', file=sys.stderr)
        return 2
    work: Path = options.work.resolve()
    shutil.rmtree(work / 'made', ignore_errors=True)
    env = prepared(options.rosdistro, options.tools, work / 'made/rosdistro', our_rows(ROOT))
    for system, version in (('debian', 'bookworm'), ('ubuntu', 'noble')):
        warned = templates(tree(work / 'made' / version), env, system, version)
        print(f'bloom, {version}: ' + ('; '.join(warned) or 'no warning'))
    chroot = work / options.suite
    if not (chroot / 'etc/debian_version').is_file():
        command = ['debootstrap', '--variant=minbase', options.suite, chroot]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    shutil.rmtree(chroot / 'root', ignore_errors=True)
    tree(chroot / 'root/checkout')
    shutil.copytree(work / 'made/noble', chroot / 'root/deb')
    print(f'load of this machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores')
    ready = seconds_of(chroot, 'apt-get update -qq && ' + PIP)
    page = seconds_to_the_page(chroot, f'cd /root/checkout && {one_line(ROOT)}')
    print(f'{options.suite}, pip: {page:.0f} s to the page, after {ready:.0f} s for python3-venv', flush=True)
    built, installed = seconds_of(chroot, BUILD), seconds_of(chroot, INSTALL)
    page = seconds_to_the_page(chroot, START)
    print(f'{options.suite}, .deb: {built:.0f} s to build, {installed:.0f} s to install, {page:.0f} s to the page')
    for line in LEFT:
        print(f'not tried: {line}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
