# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A Python for aarch64 with our versions of the libraries, below build/, for qemu to run on another processor."""

import importlib.metadata
import os
import shutil
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent / 'build' / 'aarch64'
LIBRARIES = ('numpy', 'scipy', 'zstandard', 'PyYAML', 'ruamel.yaml', 'tqdm', 'pyserial')
PIP = (sys.executable, '-m', 'pip')
PLATFORMS = tuple(f'--platform=manylinux_2_{glibc}_aarch64' for glibc in (28, 27, 17))


class BuildError(Exception):
    """This machine cannot get the packages; the message says which command failed."""


def python() -> tuple[list[str], dict[str, str]]:
    """Command and environment of the interpreter; the first call downloads 100 MB by apt-get and pip.

    Raises BuildError."""
    done = FOLDER / 'done'
    wanted = '\n'.join(f'{name}=={importlib.metadata.version(name)}' for name in LIBRARIES)
    if not done.exists() or done.read_text(encoding='utf-8') != wanted:
        shutil.rmtree(FOLDER, ignore_errors=True)
        _unpack_debian('arm64', FOLDER / 'root', 'python3-minimal', 'libpython3-stdlib', 'libstdc++6')
        _unpack_debian('', FOLDER / 'qemu', 'qemu-user-static')
        version = _interpreter().name.removeprefix('python')
        uv = shutil.which('uv')
        install = (
            [uv, 'pip', 'install', '--python-platform', 'aarch64-manylinux_2_28']
            if uv
            else [*PIP, 'install', *PLATFORMS]
        )
        _run(
            [
                *install,
                '--target',
                str(FOLDER / 'site'),
                '--only-binary=:all:',
                '--python-version',
                version,
                *wanted.split(),
            ]
        )
        done.write_text(wanted, encoding='utf-8')
    qemu = FOLDER / 'qemu/usr/bin/qemu-aarch64-static'
    return [str(qemu), '-L', str(FOLDER / 'root'), str(_interpreter())], {'PYTHONPATH': str(FOLDER / 'site')}


def _interpreter() -> Path:
    return (FOLDER / 'root/usr/bin/python3').resolve()


def _unpack_debian(architecture: str, folder: Path, *packages: str) -> None:
    """Unpack packages and what they depend on, of this system's mirrors, without installing them.

    ``architecture``: '' for this machine's, of which the packages alone are unpacked."""
    state = folder.with_suffix('.apt')
    for each in ('lists/partial', 'archives/partial'):
        (state / each).mkdir(parents=True)
    folder.mkdir(parents=True)
    options = [f'Dir::State={state}', f'Dir::Cache={state}', 'Dir::State::status=/dev/null', 'APT::Sandbox::User=root']
    if architecture:
        options += [f'APT::Architecture={architecture}', f'APT::Architectures::={architecture}']
    get = ['apt-get', '-qq', *(word for option in options for word in ('-o', option))]
    _run([*get, 'update'])
    if architecture:
        _run([*get, 'install', '--download-only', '--yes', '--no-install-recommends', *packages])
    else:
        _run([*get, 'download', *packages], state / 'archives')
    for archive in sorted((state / 'archives').glob('*.deb')):
        _run(['dpkg', '-x', str(archive), str(folder)])
    shutil.rmtree(state)


def _run(command: list[str], folder: Path | None = None) -> None:
    environment = {**os.environ, 'DEBIAN_FRONTEND': 'noninteractive'}
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise BuildError(f'no {command[0]}') from error
    if done.returncode:
        raise BuildError(f'{command[0]} {command[-1]}: {done.stderr.strip().splitlines()[-1:]}')
