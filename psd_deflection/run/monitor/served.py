# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pages that this user's daemons serve now, a small file each below ``$XDG_STATE_HOME/psd_deflection`` that only
the user can read (it holds the token), so that commands find them without an address."""

import contextlib
import importlib.metadata
import importlib.util
import json
import os
import re
from pathlib import Path
from typing import NamedTuple

from psd_deflection.base.errors import ConfigError
from psd_deflection.run.state import state_folder

MAX_BYTES = 10_000

MAX_AGO_S = 600.0
"""A load may have hung for so long before it is noted, and a request may come so late, s."""
SINCE_STEP = 'step'
"""In place of that time: since the last step of the dots."""


TOKEN_VARIABLE = 'PSD_DEFLECTION_MONITOR_TOKEN'
TOKEN_HEADER = 'X-Monitor-Token'


class Served(NamedTuple):
    """A served page: its address without the token, the token or '', what it shows, its process."""

    url: str
    token: str
    name: str
    pid: int


def announce(page: Served) -> Path | None:
    """Write the file of ``page``; None if it cannot be written: then commands need ``--url``."""
    path = state_folder() / f'page_{page.pid}_{page.url.rstrip("/").rpartition(":")[2]}.json'
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Left by a process that had the same number.
        path.unlink(missing_ok=True)
        with os.fdopen(
            os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, 'O_CLOEXEC', 0), 0o600), 'w'
        ) as stream:
            json.dump(page._asdict(), stream)
    except (OSError, RuntimeError):
        # RuntimeError: a user without a home folder.
        return None
    return path


def withdraw(path: Path | None) -> None:
    """Remove the file of :func:`announce`."""
    if path is not None:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def served_pages() -> list[Served]:
    """The pages of the processes that run."""
    with contextlib.suppress(OSError, RuntimeError):
        return [page for path in sorted(state_folder().glob('page_*.json')) if (page := _read(path)) is not None]
    return []


def _read(path: Path) -> Served | None:
    try:
        with path.open('rb') as stream:
            content = json.loads(stream.read(MAX_BYTES))
        page = Served(str(content['url']), str(content['token']), str(content['name']), int(content['pid']))
        if os.name == 'posix':
            # Elsewhere 0 is no question but Ctrl-C.
            os.kill(page.pid, 0)
    except ProcessLookupError:
        withdraw(path)
        return None
    except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None
    return page


def need_server() -> None:
    """Raise ConfigError, with the fix, if aiohttp is not installed, or so old that it would not answer."""
    if importlib.util.find_spec('aiohttp') is None:
        raise ConfigError(
            "the live page and Foxglove need aiohttp: `pip install 'psd_deflection[monitor]'` or "
            '`apt install python3-aiohttp`, or run without monitor and foxglove'
        )
    installed = importlib.metadata.version('aiohttp')
    if tuple(int(n) for n in re.findall(r'\d+', installed)[:2]) < (3, 9):
        raise ConfigError(
            f'the live page needs aiohttp 3.9 or later, {installed} is installed: '
            "`pip install 'psd_deflection[monitor]'` in a virtual environment, or run without monitor"
        )
