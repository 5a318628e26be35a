# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Progress of work that may take longer than two seconds: only on a terminal, and removed at the end."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from tqdm import tqdm

from psd_deflection.records import SampleBlock

if TYPE_CHECKING:
    Bar = tqdm[SampleBlock]


def progress_of(blocks: Iterable[SampleBlock], total: int | None = None, *, quiet: bool = False) -> Bar:
    """Yield ``blocks`` and count them on the standard error after the first second; ``quiet``: not at all."""
    hidden = True if quiet else None
    return tqdm(blocks, total=total, unit=' blocks', delay=1.0, leave=False, disable=hidden, ncols=80)


@contextlib.contextmanager
def stage(words: str, *, quiet: bool = False) -> Iterator[None]:
    """Show on a terminal what is being done, for work that cannot be counted; removed at the end."""
    shown = not quiet and sys.stderr is not None and sys.stderr.isatty()
    if shown:
        print(f'{words} ...', end='', file=sys.stderr, flush=True)
    try:
        yield
    finally:
        if shown:
            print('\r\x1b[K', end='', file=sys.stderr, flush=True)
