# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Builds what has no wheel for a Python without ROS 2 from apt: FollowJointTrajectory of control_msgs, or of another
package: ``python -m tools.control_msgs tf2_msgs`` prints the folder that belongs into PYTHONPATH."""

import fcntl
import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tools.program import ROOT

PACKAGE = 'control_msgs'
FOLDER = ROOT / 'build' / PACKAGE
USED = (
    *('action_msgs', 'builtin_interfaces', 'geometry_msgs', 'service_msgs', 'std_msgs', 'trajectory_msgs'),
    *('type_description_interfaces', 'unique_identifier_msgs'),
)
"""The packages whose messages are in it."""
RUNTIME = (
    *('rosidl_runtime_c', 'rosidl_typesupport_c', 'rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_fastrtps_cpp'),
    *('rosidl_typesupport_introspection_c', 'fastcdr', 'rmw'),
)
SUPPORTS = ('rosidl_typesupport_fastrtps_c', 'rosidl_typesupport_introspection_c')
"""What the only rmw that has a wheel asks for."""
KINDS = ('rosidl_generator_c', *SUPPORTS, 'rosidl_typesupport_c', 'rosidl_generator_py')
"""Of sources, each of which becomes a library that may use those before it."""


def _given(package: str) -> Path:
    return ROOT / 'tools' / f'{package}_interface'


def installed(package: str = PACKAGE) -> bool:
    """Whether this Python has the package."""
    return importlib.util.find_spec(package) is not None


def not_here() -> list[str]:
    """What compiles it and is not on this machine."""
    programs = [name for name in ('gcc', 'g++') if not shutil.which(name)]
    header = Path(sysconfig.get_path('include')) / 'Python.h'
    return programs if header.is_file() else [*programs, str(header)]


def buildable() -> bool:
    """Whether compiler and generators are there."""
    return not not_here() and importlib.util.find_spec('rosidl_generator_py') is not None


def available() -> bool:
    """Have it: installed, or built here and from now on the path, of our children too. False if it cannot be."""
    if installed():
        return True
    if not buildable():
        return False
    place = str(built())
    sys.path.append(place)
    os.environ['PYTHONPATH'] = os.pathsep.join(filter(None, [os.environ.get('PYTHONPATH', ''), place]))
    importlib.invalidate_caches()
    return installed()


def built(package: str = PACKAGE) -> Path:
    """The folder in which the package lies, once it is whole. RuntimeError with what the compiler said."""
    key = hashlib.sha256(b''.join(f.read_bytes() for f in (Path(__file__), *sorted(_given(package).rglob('*.*')))))
    key.update(f'{package}{sys.version}{sys.prefix}'.encode())
    place = FOLDER / key.hexdigest()[:16]
    FOLDER.mkdir(parents=True, exist_ok=True)
    with (FOLDER / 'lock').open('w') as lock:
        # The workers of pytest come at once.
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / package).is_dir():
            work = FOLDER / 'work'
            shutil.rmtree(work, ignore_errors=True)
            _generate(work, package)
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir()
            _compile(work, package).rename(place / package)
    return place


def _generate(work: Path, package: str) -> None:
    """Sources in ``work/KIND/PACKAGE``, as the generators write them."""
    from rosidl_adapter.action import convert_action_to_idl
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_generator_type_description.cli import HashTypeDescription
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    given_from = _given(package)
    os.environ.setdefault('AMENT_PREFIX_PATH', sys.prefix)
    given_in = work / package
    shutil.copytree(given_from, given_in)
    names = [file.relative_to(given_from) for file in sorted(given_from.rglob('*.*'))]
    for name in names:
        convert = convert_msg_to_idl if name.suffix == '.msg' else convert_action_to_idl
        convert(given_in, package, name, (given_in / name).parent)
    given = [f'{given_in}:{name.with_suffix(".idl")}' for name in names]
    shares = [Path(sys.prefix) / 'share' / used for used in USED]
    hashes = HashTypeDescription('').generate_type_hashes(package, given, shares, given_in)
    makers = (
        GenerateC(''),
        GenerateFastRTPSCTypesupport(''),
        GenerateIntrospectionCTypesupport(''),
        GenerateCTypesupport('', typesupport_implementations=list(SUPPORTS)),
        GeneratePython('', typesupport_implementations=['rosidl_typesupport_c']),
    )
    for kind, maker in zip(KINDS, makers, strict=True):
        more = [hashes] if kind == KINDS[0] else []
        maker.generate(package, given, shares, work / kind / package, *more)


def _compile(work: Path, package: str) -> Path:
    """The package that rclpy imports, with a library for each kind in it."""
    import numpy as np

    prefix, out = Path(sys.prefix), work / KINDS[-1] / package
    (out / '__init__.py').touch()
    include = [*(work / kind for kind in KINDS), Path(sysconfig.get_path('include')), Path(np.get_include())]
    include += [prefix / 'include', *(path for path in (prefix / 'include').iterdir() if path.is_dir())]
    flags = ['-O0', '-fPIC', *(f'-I{path}' for path in include)]
    files = [(kind, file) for kind in KINDS for file in (work / kind).rglob('*.c*')]

    def compile_file(file: Path) -> None:
        _run('gcc' if file.suffix == '.c' else 'g++', '-c', *flags, str(file), '-o', f'{file}.o')

    with ThreadPoolExecutor(2) as two:
        list(two.map(compile_file, (file for _, file in files)))
    # A library is found by its name once it is loaded: the last one loads all of them.
    names = {kind: f'lib{package}__{kind}.so' for kind in KINDS[:-1]}
    names[KINDS[-1]] = f'{package}_s__rosidl_typesupport_c{sysconfig.get_config_var("EXT_SUFFIX")}'
    needed = [*(f'{used}__{kind}' for used in USED for kind in KINDS), *RUNTIME]
    of_ros = [f'-l{name}' for name in needed if (prefix / 'lib' / f'lib{name}.so').exists()]
    before: list[str] = []
    for kind, name in names.items():
        objects = [f'{file}.o' for of, file in files if of == kind]
        paths = [f'-L{prefix / "lib"}', f'-Wl,-rpath,$ORIGIN:{prefix / "lib"}', '-Wl,--no-as-needed']
        _run('g++', '-shared', f'-Wl,-soname,{name}', *objects, *paths, *before, *of_ros, '-o', str(out / name))
        before.append(str(out / name))
    return out


def _run(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f'{" ".join(words)}\n{done.stderr[-4000:]}')


def main(package: str = PACKAGE) -> int:
    """Print where it is; SystemExit with what to install, if it cannot be compiled here."""
    if missing := not_here():
        raise SystemExit(f'{package}: cannot be compiled without {", ".join(missing)}: apt install gcc g++ python3-dev')
    print(built(package))
    return 0


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:]))
