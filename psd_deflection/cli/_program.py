# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The name under which the user can call this program, for the commands that it suggests."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

NAME = 'psd-deflection'


def program() -> str:
    """``psd-deflection`` if the shell finds it; else the path that was used, as by ``make run`` from ``.venv/bin``."""
    if shutil.which(NAME) is not None:
        return NAME
    called = Path(sys.argv[0])
    return str(called) if called.name == NAME else f'{sys.executable} -m psd_deflection'
