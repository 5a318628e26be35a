# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where programs keep what outlives a run: a folder of the user, and files named by the device's serial number.

One of them keeps the unloaded dots of the last ``~/zero`` (or ``zero_file``), with the rig file's zero of that time:
once that changes, the kept one is ignored. A bad file is ignored with a line in the log.
"""

import hashlib
import json
import os
import re
import threading
from pathlib import Path
from typing import Any

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.files import replace_file
from psd_deflection.base.log import ERROR, INFO, WARNING, LogCallback
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.rig.declarations import BY_NAME
from psd_deflection.rig.parameters import check_value


def state_folder() -> Path:
    """Folder for the state of programs (XDG base directory specification)."""
    return Path(os.environ.get('XDG_STATE_HOME') or Path.home() / '.local' / 'state') / 'psd_deflection'


def device_file(kind: str, serial: str, ending: str) -> Path:
    """The file that holds ``kind`` of the device with this serial number; ``ending`` with its dot.

    The device chooses its serial number: it does not lead out of the folder, and no two share a file.
    """
    safe = re.sub(r'[^A-Za-z0-9._-]', '_', serial)[:64].strip('.') or 'unknown'
    if safe != serial:
        # Serial numbers that differ only in characters that were replaced or cut need two files.
        safe += '_' + hashlib.sha256(serial.encode(errors='backslashreplace')).hexdigest()[:12]
    return state_folder() / f'{kind}_{safe}{ending}'


MAX_BYTES = 10_000


class ZeroStore:
    """The kept zero of one device. ``configured``: the rig from its file, without a kept zero.

    ``loaded``: whether :meth:`load` found one that holds.
    """

    def __init__(self, configured: Rig, serial: object) -> None:
        self._configured = configured.zeros_by_name
        named = configured.acquisition.zero_file
        self._serial = str(serial)
        self.path = Path(named).expanduser() if named else device_file('zero', self._serial, '.json')
        self.loaded = False
        self._saving = threading.Lock()
        self._wanted: Rig | None = None
        self._thread: threading.Thread | None = None

    def load(self, rig: Rig) -> tuple[Rig, str, int]:
        """The rig with the kept zero, if there is one; a line to report about it, or ''; the line's severity."""
        try:
            with self.path.open('rb') as stream:
                content = stream.read(MAX_BYTES + 1)
            if len(content) > MAX_BYTES:
                raise ValueError(f'more than {MAX_BYTES} bytes')
            saved: Any = json.loads(content)
            if not isinstance(saved, dict) or not isinstance(saved.get('configured'), dict):
                raise ValueError('not what ~/zero writes')
            zeros = {name: check_value(BY_NAME[name], saved.get(name), str(self.path)) for name in rig.zeros_by_name}
        except FileNotFoundError:
            return rig, '', INFO
        except (OSError, ValueError, RecursionError, ConfigError) as error:
            return rig, f'{self.path}: the kept zero cannot be used ({error}); the rig file holds', WARNING
        if saved.get('serial') != self._serial:
            return rig, f'{self.path}: the kept zero is that of another device; the rig file holds', WARNING
        if saved['configured'] != self._configured:
            return (
                rig,
                f'{self.path}: the rig file has another zero than when this one was kept; the rig file holds',
                WARNING,
            )
        self.loaded = True
        return replace_values(rig, zeros, str(self.path)), f'zero of the last run, from {self.path}', INFO

    def save(self, rig: Rig) -> str:
        """Save the zero of ``rig``; return '' or why it failed."""
        content = {'serial': self._serial, **rig.zeros_by_name, 'configured': self._configured}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(self.path, json.dumps(content, indent=1).encode())
        except OSError as error:
            return f'{self.path}: the zero cannot be kept ({error.strerror or error})'
        return ''

    def keep(self, rig: Rig, log: LogCallback) -> None:
        """Save the zero of ``rig`` in a separate thread; ``log`` gets a line if it fails. The last zero wins."""
        self._wanted = rig
        self._thread = threading.Thread(target=self._keep, args=(log,), name='zero', daemon=True)
        self._thread.start()

    def join(self, timeout: float) -> bool:
        """Wait until the last zero is saved; return whether it is."""
        if self._thread is None:
            return True
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _keep(self, log: LogCallback) -> None:
        with self._saving:
            rig, self._wanted = self._wanted, None
            trouble = self.save(rig) if rig is not None else ''
        if trouble:
            log(trouble, ERROR)
