# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What computes: the versions and the processor on which the last digits of a number may depend.

A recording keeps it, so that ``replay --compare`` can say why bits differ.
"""

import os
import platform
import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType

from psd_deflection import __version__
from psd_deflection.base.text import sanitize

COMPUTES = ('psd_deflection', 'python', 'numpy', 'scipy')
"""Entries that the last digits of an estimate may depend on."""
NAMES = (*COMPUTES, 'machine', 'processor', 'kernel', 'C library')
_LONGEST = 120
_OVERRIDES = ('OPENBLAS_CORETYPE', 'NPY_DISABLE_CPU_FEATURES', 'GLIBC_TUNABLES')
"""Environment variables that choose other instructions than the processor's best."""


@cache
def provenance() -> Mapping[str, str]:
    """Name and value of each; of this process."""
    entries = {'psd_deflection': __version__, 'python': platform.python_version()}
    for name in ('numpy', 'scipy'):
        try:
            entries[name] = version(name)
        except PackageNotFoundError:
            entries[name] = 'unknown'
    entries['machine'] = platform.machine()
    entries['processor'] = _processor()
    if chosen := ' '.join(f'{name}={os.environ[name]}' for name in _OVERRIDES if os.environ.get(name)):
        entries['kernel'] = chosen
    entries['C library'] = ' '.join(platform.libc_ver()).strip() or sys.platform
    return MappingProxyType(entries)


def differences(then: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """The differences of what computes in words: "numpy 2.3.1, now 2.4.0"."""
    if not then:
        return ['a version that does not say what computed it']
    return [
        f'{name} {sanitize(then.get(name, "not stated"), _LONGEST)}, now {now.get(name, "not stated")}'
        for name in COMPUTES
        if then.get(name) != now.get(name)
    ]


def _processor() -> str:
    """Its name as Linux has it; that of the machine where there is none."""
    try:
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8', errors='replace').splitlines()
    except OSError:
        lines = []
    for key in ('model name', 'Hardware', 'CPU part'):
        for line in lines:
            name, _, value = line.partition(':')
            if name.strip() == key and value.strip():
                return value.strip()
    return platform.processor() or platform.machine()
