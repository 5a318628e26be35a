"""The progress of what may take longer than two seconds: on a terminal only, and gone when it is done."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from tqdm import tqdm

from psd_deflection.records import SampleBlock

if TYPE_CHECKING:
    Bar = tqdm[SampleBlock]


def progress_of(blocks: Iterable[SampleBlock], total: int | None = None, *, quiet: bool = False) -> Bar:
    """``blocks``, counted on the standard error once a second has gone by; ``quiet``: not at all."""
    hidden = True if quiet else None
    return tqdm(blocks, total=total, unit=' blocks', delay=1.0, leave=False, disable=hidden, ncols=80)
