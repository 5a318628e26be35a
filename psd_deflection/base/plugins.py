# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Loads code of other packages and of the user: whatever it does on import, the caller gets one error that names it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

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
