"""Columns that line up and figures on disk, for the commands that report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from psd_deflection.errors import ConfigError


def columns(rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """``rows`` (the first is the head) as text: the first ``left`` columns flush left, the rest right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
        lines.append('  '.join(cells).rstrip())
    lines.insert(1, '  '.join('-' * w for w in widths))
    return '\n'.join(lines)


def save_figure(figure: Any, path: Path) -> None:
    """Write a matplotlib figure; raises ConfigError for a kind or a place that cannot be written."""
    if path.suffix.lower() not in ('.png', '.svg', '.pdf'):
        raise ConfigError(f'--out {path}: the name must end in .png, .svg or .pdf')
    try:
        figure.savefig(path, dpi=150)
    except OSError as error:
        raise ConfigError(f'--out {path}: cannot be written ({error.strerror})') from None
