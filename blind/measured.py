# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where the data lie that others measured on their machines; nothing of them is in this repository."""

from __future__ import annotations

import os
from pathlib import Path

DATA = Path(os.environ.get('PSD_FOREIGN_DATA', Path(__file__).resolve().parent.parent.parent / 'shared' / 'data'))
"""A folder for each machine: that of the environment variable, or ``../shared/data`` beside the checkout."""
