# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Work that fails or kills its process, for the tests of many recordings: processes import it by its name."""

import os
import signal
from pathlib import Path

from psd_deflection.base.errors import RecordingError


def length(name: str) -> int:
    """The number of characters of ``name``; ``rejected`` and ``defect`` fail."""
    if 'rejected' in name:
        raise RecordingError(f'{name}: no such recording')
    if 'defect' in name:
        raise ZeroDivisionError('division by zero')
    return len(name)


def dies(name: str) -> int:
    """As :func:`length`; ``poison`` kills its process each time, ``once`` the first time: then the file is there."""
    path = Path(name)
    if path.name == 'poison' or (path.name == 'once' and not path.exists()):
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return len(path.name)
