# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every campaign shares: its options, its cases over several processes with a bar, and its end."""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from psd_deflection.records import RawChunk

C = TypeVar('C')
R = TypeVar('R')


def options(about: str | None, jobs: int | None = None) -> argparse.ArgumentParser:
    """Return the options of a campaign, whose help is ``about``; with --jobs, of ``jobs`` by default."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    if jobs is not None:
        parser.add_argument('--jobs', type=int, default=jobs, help='processes at once')
    return parser


def watched(cases: Iterable[C], words: str | None = None) -> Iterable[C]:
    return tqdm(cases, desc=words, file=sys.stderr)


def over(work: Callable[[C], R], cases: Sequence[C], jobs: int = 1, words: str | None = None) -> Iterator[R]:
    """``work`` of each case in their order, in this process or in ``jobs`` of them, with a bar."""
    with tqdm(total=len(cases), desc=words, file=sys.stderr) as bar:
        if jobs > 1:
            with ProcessPoolExecutor(jobs) as pool:
                for result in pool.map(work, cases):
                    bar.update()
                    yield result
        else:
            for case in cases:
                result = work(case)
                bar.update()
                yield result


def chunk(volts: npt.NDArray[np.float64], first: int = 0) -> RawChunk:
    """The samples ``volts`` (n, 6) at 1 kHz, numbered from ``first``."""
    seq = np.arange(first, first + len(volts))
    return RawChunk(seq, seq * 1_000_000, volts.astype(np.float32), np.zeros(len(seq), np.uint8))


def bound_line(met: bool, words: str) -> str:
    return f'{"ok  " if met else "MISS"} {words}'


def conclude(text: str, met: bool = True, path: Path | None = None) -> int:
    """Print the table, keep it in ``path``; the exit status: 1 if what is wanted is not met."""
    print(text)
    if path is not None:
        path.write_text(text + '\n')
    return 0 if met else 1
