# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The same work on each of many recordings: options, engine, progress, table, and the exit status."""

import argparse
import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from tqdm import tqdm

from psd_deflection.base.errors import SomeFailedError, UsageError
from psd_deflection.base.tables import columns
from psd_deflection.cli._options import make_folder, make_writable
from psd_deflection.cli._report import print_json, save, show, show_text, warn
from psd_deflection.recordings.write.parquet import ENDING, ERROR, Field, ParquetFile, is_parquet
from psd_deflection.run.fleet.tasks import FORMS, SERIAL, Outcome, check_engine, is_plain, listed, open_engine, outcomes

T = TypeVar('T')


def executor_option(parser: argparse.ArgumentParser) -> None:
    """Add --executor."""
    parser.add_argument(
        '--executor',
        metavar='WHERE',
        type=check_engine,
        help=f'for many recordings: {FORMS} (default {SERIAL}: one after the other)',
    )


def each_option(parser: argparse.ArgumentParser) -> None:
    """Add --each and --executor, for the commands that else take all recordings together."""
    parser.add_argument(
        '--each',
        action='store_true',
        help=f'each REC for itself, DIR/REC or a row of X{ENDING} for each; REC may be a pattern or a .txt list',
    )
    executor_option(parser)


def several(args: argparse.Namespace) -> list[str] | None:
    """The recordings by absolute path if there may be many, None if one is named.

    Raises UsageError and RecordingError.
    """
    words: list[str] = args.recordings
    if len(words) == 1 and is_plain(words[0]) and args.executor is None and not is_parquet(args.out):
        return None
    return _paths(words)


def each_for_itself(args: argparse.Namespace) -> list[str] | None:
    """The recordings by absolute path with --each, else None. Raises UsageError and RecordingError."""
    if args.each:
        return _paths(args.recordings)
    if args.executor is not None and not getattr(args, 'rehearse', None):
        raise UsageError(f'--executor {args.executor}: needs --each; without it all recordings are one task')
    if is_parquet(args.out):
        raise UsageError(f'--out {args.out}: needs --each; without it there is one answer, and DIR is a folder')
    return None


def _paths(words: Sequence[str]) -> list[str]:
    # Workers may run in another folder.
    return list(dict.fromkeys(os.path.abspath(name) for name in listed(words)))  # noqa: PTH100 - links stay as they are


def folders_of(names: Sequence[str], out: Path) -> dict[str, Path]:
    """For each recording a folder of its own below ``out``, named after its path below what all have in common."""
    common = os.path.commonpath([os.path.dirname(name) for name in names])  # noqa: PTH120 - text, as commonpath takes
    return {name: out / Path(name).relative_to(common) for name in names}


def run_each(
    args: argparse.Namespace, names: Sequence[str], work: Callable[[str], T], take: Callable[[str, T], None]
) -> dict[str, str]:
    """Do ``work`` on each recording with the engine of --executor; returns the errors of those that failed.

    ``take`` is given each name and what came out, in order. Raises ConfigError and DaemonError.
    """
    failed: dict[str, str] = {}
    hidden = True if args.json or getattr(args, 'quiet', False) else None
    with (
        open_engine(args.executor or SERIAL, warn) as engine,
        tqdm(total=len(names), unit=' recordings', delay=1.0, leave=False, disable=hidden, ncols=80) as bar,
    ):
        for outcome in outcomes(work, names, engine, bar.update):
            _take(outcome, take, failed)
    return failed


def results_of(tasks: Iterable[Callable[[], T]], executor: str) -> Iterator[T]:
    """The results of ``tasks`` that are no recordings, in their order, with the engine of --executor."""
    with open_engine(executor, warn) as engine:
        for future in [engine.submit(task) for task in tasks]:
            yield future.result()


def _take(outcome: Outcome[T], take: Callable[[str, T], None], failed: dict[str, str]) -> None:
    if outcome.value is None:
        failed[outcome.name] = outcome.error
    else:
        take(outcome.name, outcome.value)


def write_rows(
    out: ParquetFile, names: Sequence[str], rows: Mapping[str, Mapping[str, object]], failed: Mapping[str, str]
) -> None:
    """One row a recording: its cells, or the error alone. Ends the file."""
    rows_of_all = [rows.get(name, {}) for name in names]
    cells: dict[str, list[object]] = {f.name: [row.get(f.name) for row in rows_of_all] for f in out.fields}
    cells[ERROR.name] = [failed.get(name, '') for name in names]
    out.put(names, cells)
    out.close(failed)


@dataclass(frozen=True, slots=True)
class TaskResult:
    """What the task of one recording gives: the files of its folder, the cells of its row, warnings."""

    files: Mapping[str, str]
    cells: Mapping[str, object]
    warnings: Sequence[str]


def answer_each(
    args: argparse.Namespace,
    names: Sequence[str],
    work: Callable[[str], TaskResult],
    fields: Sequence[Field],
    head: Sequence[str],
    line: Callable[[Mapping[str, object]], Sequence[str]],
) -> int:
    """Do ``work`` on each recording; its files go into a folder of its own below DIR, or its cells into X.parquet."""
    rows: dict[str, Mapping[str, object]] = {}
    with contextlib.ExitStack() as stack:
        out = stack.enter_context(ParquetFile(args.out, fields)) if is_parquet(args.out) else None
        folders = {} if out is not None else folders_of(names, make_writable(args.out))

        def take(name: str, answer: TaskResult) -> None:
            for warning in answer.warnings:
                warn(f'{_short(name)}: {warning}')
            rows[name] = answer.cells
            if out is None:
                folder = make_folder(str(folders[name]))
                for file, text in answer.files.items():
                    save(text.encode(errors='replace'), folder / file)

        failed = run_each(args, names, work, take)
        if out is not None:
            write_rows(out, names, rows, failed)
    notify_each(args, names, rows, failed, head, line)
    return 0


def notify_each(
    args: argparse.Namespace,
    names: Sequence[str],
    results: Mapping[str, Mapping[str, object]],
    failed: Mapping[str, str],
    head: Sequence[str],
    line: Callable[[Mapping[str, object]], Sequence[str]],
) -> None:
    """Print the table, or with --json one object a line. Raises SomeFailedError if some failed.

    ``results``: what is printed of each as JSON; ``line``: the cells of its line under ``head``.
    """
    if args.json:
        for name in names:
            print_json({'recording': name, 'error': failed.get(name), **results.get(name, {})})
    else:
        lines = [
            (_short(name), *(line(results[name]) if name in results else ('failed', *[''] * (len(head) - 1))))
            for name in names
        ]
        show_text(columns([('recording', *head), *lines], align_left=2))
        show(*(f'failed: {error}' for error in failed.values())) if failed else None
        if args.out is not None:
            show(f'written to {args.out}')
    if failed:
        raise SomeFailedError(f'{len(failed)} of {len(names)} recordings failed; the others are done')


def _short(name: str) -> str:
    """The path from here, if it is below."""
    here = os.path.join(os.path.abspath('.'), '')  # noqa: PTH100, PTH118 - text
    return name.removeprefix(here)
