# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The bits of a recording on other processors: ``make bits``; three minutes on two cores."""

from __future__ import annotations

import argparse
import concurrent.futures
import hashlib
import importlib.metadata
import itertools
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from psd_deflection.recordings.recording import Recording
    from psd_deflection.records import Record
    from psd_deflection.rig.config import Rig

ROOT = Path(__file__).resolve().parent.parent
BAGS = ROOT / 'bags'
NAMES = ('clean', 'lost_samples', 'laser_off', 'motion', 'calibrated', 'three_psds')
KERNELS = {'Haswell': 'avx2', 'SkylakeX': 'avx512f', 'Zen': 'avx2', 'Nehalem': 'sse4_2'}
"""Kernels of OpenBLAS, each with the instructions that it needs, as /proc/cpuinfo names them."""
FOLDER = ROOT / 'build' / 'aarch64'  # A Python for aarch64 with our versions of the libraries, for qemu to run.
LIBRARIES = ('numpy', 'scipy', 'zstandard', 'PyYAML', 'ruamel.yaml', 'tqdm', 'pyserial')
PLATFORMS = tuple(f'--platform=manylinux_2_{glibc}_aarch64' for glibc in (28, 27, 17))


class BuildError(Exception):
    """This machine cannot get the packages; the message says which command failed."""


def emulated_python() -> tuple[list[str], dict[str, str]]:
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
        by_uv = [str(uv), 'pip', 'install', '--python-platform', 'aarch64-manylinux_2_28']
        install = by_uv if uv else [sys.executable, '-m', 'pip', 'install', *PLATFORMS]
        words = ['--target', str(FOLDER / 'site'), '--only-binary=:all:', '--python-version', version]
        _done([*install, *words, *wanted.split()])
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
    _done([*get, 'update'])
    if architecture:
        _done([*get, 'install', '--download-only', '--yes', '--no-install-recommends', *packages])
    else:
        _done([*get, 'download', *packages], state / 'archives')
    for archive in sorted((state / 'archives').glob('*.deb')):
        _done(['dpkg', '-x', str(archive), str(folder)])
    shutil.rmtree(state)


def _done(command: list[str], folder: Path | None = None) -> None:
    environment = {**os.environ, 'DEBIAN_FRONTEND': 'noninteractive'}
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise BuildError(f'no {command[0]}') from error
    if done.returncode:
        raise BuildError(f'{command[0]} {command[-1]}: {done.stderr.strip().splitlines()[-1:]}')


Setting = tuple[list[str], dict[str, str]]
"""How Python is started, and what its environment has besides."""


def settings() -> tuple[dict[str, Setting], list[str]]:
    """The settings that this machine can run, by name; those that it cannot, and why."""
    flags = set(' '.join(re.findall('^flags.*', Path('/proc/cpuinfo').read_text(encoding='utf-8'), re.M)).split())
    ours = [sys.executable]
    there = [kernel for kernel, needs in KERNELS.items() if needs in flags]
    out: dict[str, Setting] = {kernel: (ours, {'OPENBLAS_CORETYPE': kernel}) for kernel in there}
    out |= {name: (ours, {'NPY_DISABLE_CPU_FEATURES': ' '.join(off)}) for name, off in _numpy_features() if off}
    if 'fma' in flags:
        out['libc without FMA'] = ours, {'GLIBC_TUNABLES': 'glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F'}
    excluded = [f'{kernel}: not of this processor' for kernel in KERNELS if kernel not in there]
    try:
        out['aarch64, in qemu'] = emulated_python()
    except BuildError as error:
        excluded.append(f'aarch64: {error}')
    return out, excluded


def _numpy_features() -> list[tuple[str, list[str]]]:
    """Sets of instructions that numpy chooses at run time and that this processor has, to be switched off."""
    code = (
        'import numpy; m = getattr(numpy, "_core", None) or numpy.core; u = m._multiarray_umath; '
        'print(*[f for f in u.__cpu_dispatch__ if u.__cpu_features__.get(f)])'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    have = done.stdout.split()
    widest = [f for f in have if f.startswith(('AVX512', 'X86_V4'))]
    return [('numpy without AVX-512', widest), ('numpy without AVX2', have)]


def of_setting(setting: Setting, *words: str) -> str:
    """What this module prints in a process of that setting."""
    environment = {k: v for k, v in os.environ.items() if k not in ('OPENBLAS_CORETYPE', 'NPY_DISABLE_CPU_FEATURES')}
    python, variables = setting
    environment |= {**variables, 'OMP_NUM_THREADS': '1'}
    command = [*python, '-m', 'bench.bits', *words]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f'{setting}: {" ".join(words)} ended with {done.returncode}:\n{done.stderr}')
    return done.stdout


def again(folder: Path) -> Iterator[tuple[str, Recording, Rig, Iterator[list[Record]]]]:
    """The recordings of a folder by name, and what the pipeline of this process makes of each."""
    from psd_deflection.measure.pipeline import Pipeline
    from psd_deflection.recordings.replay.engine import open_for_replay, replayed

    for name in NAMES:
        recording, rig = open_for_replay(str(folder / name), None, None)
        yield name, recording, rig, replayed(recording, Pipeline(rig), None)


def record(folder: Path) -> None:
    """The golden recordings' samples through the pipeline of this process, recorded in ``folder``."""
    from psd_deflection.recordings.formats.format import open_sink

    for name, recording, rig, replay in again(BAGS):
        sink = open_sink(str(folder / name), rig.flat(), device_hello=recording.hello)
        for output in itertools.chain.from_iterable(replay):
            sink.put(output)
        sink.close()


def compare(folders: Sequence[str]) -> None:
    """Print the messages that differ, of each of ``folders``, if this process replays what is in it."""
    from psd_deflection.recordings.replay.comparison import ReplayComparison

    for folder in folders:
        differ = equal = 0
        for _, recording, _, replay in again(Path(folder)):
            comparison = ReplayComparison(recording)
            for records in replay:
                comparison.add(records)
            comparison.finish()
            differ += comparison.different + comparison.only_recorded + comparison.only_replayed
            equal += comparison.equal
        print(differ, equal)


def estimates_of(folder: Path) -> str:
    """A number for all the messages of a setting's recordings but for the one that says what computed them."""
    from msg_adapters import RIG
    from psd_deflection.recordings.read.readers import open_recording

    digest = hashlib.sha256()
    for name in NAMES:
        recording = open_recording(folder / name)
        for message in recording.messages([t for t in recording.topics() if t != RIG]):
            digest.update(message.channel.topic.encode() + message.cdr)
    return digest.hexdigest()


def table(jobs: int, folder: Path) -> bool:
    every, excluded = settings()
    places = {name: folder / str(i) for i, name in enumerate(every)}
    for place in places.values():
        place.mkdir()
    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        list(pool.map(lambda name: of_setting(every[name], '--record', str(places[name])), every))
        # What is the same message by message is replayed once for all.
        first = {estimates_of(place): str(place) for place in reversed(places.values())}
        kinds = {name: estimates_of(place) for name, place in places.items()}
        answers = pool.map(lambda setting: of_setting(setting, '--compare', *first.values()), every.values())
        differing = [
            dict(zip(first, (tuple(map(int, line.split())) for line in answer.splitlines()), strict=True))
            for answer in answers
        ]
    wide = max(map(len, every))
    print('messages that differ; recorded under: one row each, replayed under: one column each, in the same order')
    total = 0
    for name in every:
        counts = [row[kinds[name]][0] for row in differing]
        total += sum(counts)
        print(f'{name:<{wide}}  ' + ' '.join(f'{count:>5}' for count in counts))
    equal = differing[0][kinds[next(iter(every))]][1]
    words = 'no bit differs' if not total else f'{total} differ'
    print(f'{len(every)} settings, {equal} messages each ({", ".join(NAMES)}): {words}')
    print(*(f'not tried: {each}\n' for each in excluded), sep='', end='')
    return total == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--jobs', type=int, default=os.cpu_count() or 1, help='processes at a time')
    parser.add_argument('--record', type=Path, metavar='FOLDER', help=argparse.SUPPRESS)
    parser.add_argument('--compare', nargs='+', metavar='FOLDER', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.record or args.compare:
        record(args.record) if args.record else compare(args.compare)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        return 0 if table(args.jobs, Path(folder)) else 1


if __name__ == '__main__':
    sys.exit(main())
