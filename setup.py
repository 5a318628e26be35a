# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Builds with colcon (ament_python) and with pip from the same tree.

colcon installs console scripts where ``ros2 run`` looks (setup.cfg, ``install_scripts``); pip
ignores that, so a wheel carries small executables under ``lib/psd_deflection`` of its own, which
start the console script of the same environment. They are made at build time, for wheels only.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree
from collections.abc import Sequence
from pathlib import Path

from setuptools import setup

PACKAGE = 'psd_deflection'
EXECUTABLES = (
    'estimator',
    'chain',
    'compensator',
    'shaper',
    'replay',
    'simulate',
    'discover',
    'calibrate',
    'camera',
    'check',
    'effects',
    'validate',
    'identify',
)
BUILDS_WHEEL = bool({'bdist_wheel', 'editable_wheel', 'dist_info'} & set(sys.argv))

SHIM = """#!/bin/sh
# `ros2 run psd_deflection {name}` of a pip installation: the console script of this environment.
here=$(CDPATH= cd -- "$(dirname -- "$0")" && pwd)
exec "$here/../../bin/python" -m psd_deflection {name} "$@"
"""


def files(folder: str, pattern: str) -> list[str]:
    return sorted(str(p) for p in Path(folder).glob(pattern) if p.is_file())


data_files: list[tuple[str, Sequence[str]]] = [
    ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
    (f'share/{PACKAGE}', ['package.xml']),
    (f'share/{PACKAGE}/config', files('config', '*')),
    (f'share/{PACKAGE}/launch', files('launch', '*.py')),
]

if BUILDS_WHEEL:
    shim_dir = Path('build') / 'ros2_run'
    shim_dir.mkdir(parents=True, exist_ok=True)
    for name in EXECUTABLES:
        shim = shim_dir / name
        shim.write_text(SHIM.format(name=name))
        shim.chmod(0o755)
    data_files.append((f'lib/{PACKAGE}', [str(shim_dir / name) for name in EXECUTABLES]))

package = xml.etree.ElementTree.parse('package.xml').getroot()
maintainer = package.find('maintainer')

setup(
    # colcon reads this file's arguments back as text, which a version specifier does not survive.
    python_requires='>=3.11' if BUILDS_WHEEL else None,
    # Addresses have one place, package.xml.
    maintainer_email=maintainer.get('email') if BUILDS_WHEEL and maintainer is not None else None,
    project_urls={str(e.get('type')): str(e.text) for e in package.iter('url')} if BUILDS_WHEEL else {},
    data_files=data_files,
    entry_points={
        'console_scripts': ['psd-deflection = psd_deflection.cli.main:main']
        + ([] if BUILDS_WHEEL else [f'{name} = psd_deflection.cli.main:{name}' for name in EXECUTABLES]),
    },
)
