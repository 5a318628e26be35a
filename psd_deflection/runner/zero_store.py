"""The unloaded dots that ``~/zero`` took, kept from run to run: one small file a device.

They are kept by the device's serial number below ``$XDG_STATE_HOME/psd_deflection`` (or in the file
that ``zero_file`` names). The rig file has the last word: the zero that it had when the kept one was
taken stands in the file beside it, and once the rig file says something else the kept one is passed
over. What the file holds is checked like any parameter, and a bad file is passed over with a line in
the log; it never stops a run. Whoever takes a zero does not wait for the disk: a thread writes the file.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from psd_deflection.config import BY_NAME, ZEROS, Rig, replace_values
from psd_deflection.errors import ConfigError
from psd_deflection.files import replace_file
from psd_deflection.parameters import check_value

MAX_BYTES = 10_000


def state_folder() -> Path:
    """Where programs keep what they remember (XDG base directory specification)."""
    return Path(os.environ.get('XDG_STATE_HOME') or Path.home() / '.local' / 'state') / 'psd_deflection'


class ZeroStore:
    """The kept zero of one device. ``configured``: the rig as its file has it, without a kept zero."""

    def __init__(self, configured: Rig, serial: object) -> None:
        self._configured = {name: configured.values[name] for name in ZEROS}
        named = configured.acquisition.zero_file
        # A serial number is the device's word: nothing of it may lead out of the folder.
        self._serial = str(serial)
        safe = re.sub(r'[^A-Za-z0-9._-]', '_', self._serial)[:64].strip('.') or 'unknown'
        if safe != self._serial:
            # Two serial numbers that differ only in what was taken out are two files.
            safe += '_' + hashlib.sha256(self._serial.encode(errors='backslashreplace')).hexdigest()[:12]
        self.path = Path(named).expanduser() if named else state_folder() / f'zero_{safe}.json'
        self._saving = threading.Lock()
        self._wanted: Rig | None = None
        self._thread: threading.Thread | None = None

    def load(self, rig: Rig) -> tuple[Rig, str]:
        """The rig with the kept zero, where there is one, and a line to say about it, or ''."""
        try:
            with self.path.open('rb') as stream:
                content = stream.read(MAX_BYTES + 1)
            if len(content) > MAX_BYTES:
                raise ValueError(f'more than {MAX_BYTES} bytes')
            kept: Any = json.loads(content)
            if not isinstance(kept, dict) or not isinstance(kept.get('configured'), dict):
                raise ValueError('not what ~/zero writes')
            zeros = {name: check_value(BY_NAME[name], kept.get(name), str(self.path)) for name in ZEROS}
        except FileNotFoundError:
            return rig, ''
        except (OSError, ValueError, RecursionError, ConfigError) as error:
            return rig, f'{self.path}: the kept zero cannot be used ({error}); the rig file holds'
        if kept.get('serial') != self._serial:
            return rig, f'{self.path}: the kept zero is that of another device; the rig file holds'
        if kept['configured'] != self._configured:
            return rig, f'{self.path}: the rig file has another zero than when this one was kept; the rig file holds'
        return replace_values(rig, zeros, str(self.path)), f'zero of the last run, from {self.path}'

    def save(self, rig: Rig) -> str:
        """Keep the zero of ``rig``; '' or why that could not be."""
        kept = {'serial': self._serial, **{name: rig.values[name] for name in ZEROS}, 'configured': self._configured}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            replace_file(self.path, json.dumps(kept, indent=1).encode())
        except OSError as error:
            return f'{self.path}: the zero cannot be kept ({error.strerror or error})'
        return ''

    def keep(self, rig: Rig, say: Callable[[str], None]) -> None:
        """Save the zero of ``rig`` in a thread of its own; ``say`` is told if that could not be. The last one wins."""
        self._wanted = rig
        self._thread = threading.Thread(target=self._keep, args=(say,), name='zero', daemon=True)
        self._thread.start()

    def join(self, timeout: float) -> bool:
        """Wait until the last zero is saved; whether it is."""
        if self._thread is None:
            return True
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _keep(self, say: Callable[[str], None]) -> None:
        with self._saving:
            rig, self._wanted = self._wanted, None
            trouble = self.save(rig) if rig is not None else ''
        if trouble:
            say(trouble)
