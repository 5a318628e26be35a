"""The progress of what may take longer than two seconds: on a terminal only, and gone when it is done."""

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
    """``blocks``, counted on the standard error once a second has gone by; ``quiet``: not at all."""
    hidden = True if quiet else None
    return tqdm(blocks, total=total, unit=' blocks', delay=1.0, leave=False, disable=hidden, ncols=80)


@contextlib.contextmanager
def told(words: str, *, quiet: bool = False) -> Iterator[None]:
    """Say on a terminal what is done meanwhile, where it cannot be counted; gone when it is done."""
    shown = not quiet and sys.stderr is not None and sys.stderr.isatty()
    if shown:
        print(f'{words} ...', end='', file=sys.stderr, flush=True)
    try:
        yield
    finally:
        if shown:
            print('\r\x1b[K', end='', file=sys.stderr, flush=True)
