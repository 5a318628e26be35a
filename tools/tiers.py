# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rooms of tools/tiers.toml: what ``make mutants`` breaks, and the tests that should notice."""

import tomllib
from pathlib import Path
from typing import NamedTuple


class Room(NamedTuple):
    """As tools/tiers.toml explains."""

    code: tuple[str, ...]
    tests: tuple[str, ...]
    leave: tuple[str, ...] = ()
    slow: tuple[str, ...] = ()


_TABLE = tomllib.loads(Path(__file__).with_name('tiers.toml').read_text(encoding='utf-8'))
ROOMS = {name: Room(**{key: tuple(paths) for key, paths in room.items()}) for name, room in _TABLE.items()}
TIERS = ('quick', 'slow')


def paths_of(name: str) -> tuple[str, ...]:
    """Return what ``make test ROOM=name`` runs: a folder of test/, and the tests of a room of mutants."""
    return (f'test/{name}', *(ROOMS[name].tests if name in ROOMS else ()))


def holds(paths: tuple[str, ...], file: str) -> bool:
    return any(file == path or file.startswith(f'{path}/') for path in paths)
