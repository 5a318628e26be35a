# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where programs keep what outlives a run: a folder of the user, and files named by the device's serial number."""

import hashlib
import os
import re
from pathlib import Path


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
