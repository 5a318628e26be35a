# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every page of ours takes into itself: uPlot, the scripts of charts, arrays as text.

The live page gets the files from its server; reports and the page of a recording have them inside, so that each is
one file that asks for nothing from anywhere.
"""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

FOLDER = Path(__file__).parent / 'page'
"""``charts.js``, which draws with uPlot (``vendor/``), and what reports add to it."""

UPLOT = FOLDER / 'vendor' / 'uPlot.iife.min.js'
UPLOT_STYLE = FOLDER / 'vendor' / 'uPlot.min.css'
CHARTS = FOLDER / 'charts.js'


def text(path: Path) -> str:
    """Of a file of ours."""
    return path.read_text(encoding='utf-8')


def joined(*paths: Path) -> str:
    """Modules as one: what they export to each other is in one file."""
    return '\n'.join(re.sub(r'^import .*\n|^export (?=const|function|class)', '', text(p), flags=re.M) for p in paths)


def packed(values: npt.ArrayLike, kind: type[np.floating[Any]] = np.float32) -> str:
    """Little-endian floats in base64: an hour is 13 MB, where its digits would be 25 MB."""
    return base64.b64encode(np.asarray(values, np.dtype(kind).newbyteorder('<')).tobytes()).decode()


def safe(json_text: str) -> str:
    """JSON that ends no script element."""
    return json_text.replace('<', '\\u003c')
