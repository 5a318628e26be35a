# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Loads code of other packages: whatever it does on import, the caller gets one error that names it or its extra. Finds
modules of our own optional rooms."""

import importlib
from collections.abc import Callable
from typing import Any, TypeVar

from psd_deflection.base.errors import ConfigError

T = TypeVar('T')


def loaded(what: str, load: Callable[[], T]) -> T:
    """What ``load`` gives. Raises ConfigError beginning with ``what`` if it raises anything, or wants to exit."""
    try:
        return load()
    except ConfigError:
        raise
    except (Exception, SystemExit, GeneratorExit) as error:
        # A plug-in that exits must not take the program along, with a status that means something else.
        raise ConfigError(f'{what} ({type(error).__name__}: {error})') from error


def optional(module: str) -> Any:
    """The ``module`` of an optional room; None if this installation has no such room."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f'{module}.'.startswith(f'{error.name}.'):
            raise
        return None


EXTRAS = {
    'matplotlib': ('plot', 'python3-matplotlib'),
    'shtab': ('completion', ''),
    'lz4': ('lz4', 'python3-lz4'),
    'zstandard': ('', 'python3-zstandard'),
}
"""By the imported name: the extra of setup.cfg ('': a dependency that rosdep cannot name) and the package of apt."""


def not_installed(error: ModuleNotFoundError) -> ConfigError | None:
    """Return the error that says how to install the missing package; None if it is none of ``EXTRAS``."""
    name = (error.name or '').partition('.')[0]
    if name not in EXTRAS:
        return None
    extra, apt = EXTRAS[name]
    pip = f"`pip install 'psd_deflection[{extra}]'`" if extra else f'`pip install {name}`'
    return ConfigError(f'{name} is not installed: {pip}' + (f' or `apt install {apt}`' if apt else ''))
