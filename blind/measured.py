# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where the data lie that others measured on their machines; nothing of them is in this repository."""

from __future__ import annotations

import os
from pathlib import Path

DATA = Path(os.environ.get('PSD_FOREIGN_DATA', 'PSD_FOREIGN_DATA is not set'))
"""A folder for each machine, which the environment variable names; a name that says so if it does not."""
