# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute the estimates of a recording again, in the same way as the live node.

With the recorded parameters (the default) the estimates are the published ones, bit for bit.
--compare checks this and ends with status 1 if anything differs that the recording and its replay
both hold. If another version made the recording, rounding may differ: then a sentence says so, and
the status is 0. --strict counts rounding too, and messages that only one side has. With --params-file
you see what another rig would have estimated from the same samples. --watch says since when the rig
is not its model. --from and --to take a part: what comes before is computed too, because the estimates depend
on it, so that the part is what it is in the whole.

Of several recordings you get a table; REC may also be a pattern, or a .txt file that lists recordings and patterns.
Then --out X.parquet takes the estimates of all.

  psd-deflection replay recordings/psd_20260101_120000 --compare
  psd-deflection replay run.csv --params-file my_rig.yaml --out estimates.csv
  psd-deflection replay run.csv --from 1 --to 3 --out part.csv
  psd-deflection replay recordings/psd_20260101_120000 --out again.mcap
  psd-deflection replay 'recordings/*' --executor processes --out all.parquet
"""

import argparse
import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection.base.axes import ranges
from psd_deflection.base.errors import UsageError
from psd_deflection.base.log import texts
from psd_deflection.base.tables import Column
from psd_deflection.cli._many import FLEET, absolute, executor_option, recordings_argument, several
from psd_deflection.cli._options import namespace_option, parameter_option, recording_name, reject, span_options
from psd_deflection.cli._progress import progress_of, stage
from psd_deflection.cli._report import print_json, show, show_text, warn
from psd_deflection.cli._values import given_as_option
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.watch import alarm_sentences
from psd_deflection.recordings.estimates import EstimateSeries
from psd_deflection.recordings.formats.format import Sink, open_sink
from psd_deflection.recordings.recording import Recording, RecordingWindow
from psd_deflection.recordings.replay.comparison import ReplayComparison
from psd_deflection.recordings.replay.engine import (
    BufferedEstimates,
    WatchedReplay,
    open_for_replay,
    part_of,
    replayed,
    warnings_about_rig,
)
from psd_deflection.recordings.spans import Span
from psd_deflection.recordings.write.parquet import ENDING, Field, ParquetFile, is_parquet
from psd_deflection.records import DeflectionEstimate, Record, SampleBlock, SpotMeans
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run.alarm_out import AlarmOut

DIFFERS = 1
END_S = 60.0
"""How long the end waits for alarms to be handed on."""
HEAD = ('state', 'seconds', 'samples', 'lost', 'blocks', 'estimates', 'rejected')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    recordings_argument(parser, 'a bag folder, an .mcap or a .csv')
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help='use this rig instead of the parameters in the recording'
    )
    parser.add_argument(
        '--out',
        type=recording_name(ENDING, to_look_at=True),
        metavar='OUT',
        help='write the estimates: X.csv, X.mcap, X.rrd or a bag folder (X); of many recordings X.parquet',
    )
    parser.add_argument(
        '--compare',
        action='store_true',
        help='compare with the recorded estimates; exit status 1 if a bit differs that no other version explains',
    )
    parser.add_argument(
        '--strict',
        action='store_true',
        help='with --compare: what only one side holds is a difference too, and so is rounding',
    )
    parser.add_argument(
        '--watch', action='store_true', help='test whether the rig stays its model, as the node does with watch: on'
    )
    parameter_option(parser, '--watch-command', 'watch_command')
    parameter_option(parser, '--watch-webhook', 'watch_webhook')
    span_options(parser)
    namespace_option(parser)
    executor_option(parser)
    parser.add_argument('--json', action='store_true', help='print the summary as JSON')


@dataclass
class Totals:
    """What came out, for the summary."""

    recording: Recording
    blocks: int = 0
    samples: int = 0
    first_seq: int | None = None
    last_seq: int = 0
    first_ns: int = 0
    last_ns: int = 0
    poses: list[tuple[float, float, float]] = field(default_factory=list)
    rejected: Counter[str] = field(default_factory=Counter)
    _estimated: int | None = None

    def add(self, record: Record) -> None:
        """Count one record."""
        if isinstance(record, SampleBlock):
            self.blocks += 1
            self.samples += len(record.seq)
            if self.first_seq is None:
                self.first_seq, self.first_ns = int(record.seq[0]), int(record.t_ns[0])
            self.last_seq, self.last_ns = int(record.seq[-1]), int(record.t_ns[-1])
        elif isinstance(record, DeflectionEstimate) and record.primary:
            self.poses.append((record.dx, record.dy, record.theta))
            self._estimated = record.block
        elif isinstance(record, SpotMeans) and record.index != self._estimated:
            # The estimate of a block comes before its means.
            self.rejected[record.status.name.lower()] += 1

    @property
    def seconds(self) -> float:
        """How long the samples last, by their stamps."""
        return self.recording.lasts(self.first_ns, self.last_ns) if self.blocks else 0.0

    @property
    def lost(self) -> int:
        """Samples missing between the first and the last."""
        return self.recording.lost(self.first_seq, self.last_seq, self.samples) if self.first_seq is not None else 0


@dataclass
class ReplayTask:
    """One recording through the pipeline."""

    recording: Recording
    rig: Rig
    pipeline: Pipeline
    totals: Totals
    comparison: ReplayComparison | None
    warnings: list[str]
    seconds: float = 0.0

    def summary(self) -> dict[str, object]:
        """What came out, for programs."""
        return {
            'samples': self.totals.samples,
            'lost': self.totals.lost,
            'blocks': self.totals.blocks,
            'estimates': len(self.totals.poses),
            'rejected': dict(self.totals.rejected),
            'solver': self.rig.estimator.solver,
            'seconds': self.totals.seconds,
            'compared': None if self.comparison is None else self.comparison.counts(),
        }


def run(args: argparse.Namespace) -> int:
    """Replay."""
    if not args.compare:
        reject(args, {'strict': False}, 'needs --compare')
    if not args.watch:
        reject(args, {'watch_command': None, 'watch_webhook': None}, 'needs --watch')
    names = several(args)
    if names is not None:
        reject(args, {'watch': False}, 'is for one recording')
        return _many(args, names)
    path = args.recordings[0]
    recording, rig = open_for_replay(path, args.params_file, args.namespace)
    with stage('looking for what was recorded', quiet=args.json):
        part = part_of(recording, args.span)
        comparison = ReplayComparison(recording, part) if args.compare else None
    sink: Sink | None = None
    if args.out is not None:
        sink = open_sink(args.out, rig.flat(), device_hello=recording.hello)
    out = _alarm_out(args, recording)
    watched = WatchedReplay(rig, recording, out.put, part) if args.watch else None
    takers = [taker.put for taker in (sink, watched) if taker is not None]
    bar = progress_of(recording.blocks(), quiet=args.json)
    try:
        done = _replayed(recording, rig, args.params_file, comparison, takers, bar, part)
    finally:
        bar.close()
        if sink is not None:
            sink.close()
        if not out.close(END_S):
            warn(f'alarms: not all handed on within {END_S:g} s')
    for warning in done.warnings:
        warn(warning)
    _print_summary(args, done)
    if watched is not None:
        show(*_watch_lines(watched, done.totals.first_ns), aside=args.json)
    if comparison is None:
        return 0
    text = comparison.summary()
    if comparison.different and args.params_file is None and not recording.parameters:
        text += '\n  the recording names no rig and was evaluated with the nominal one: give its own with --params-file'
    if comparison.same_but_for_rounding and not comparison.identical:
        text += ' (--strict counts them as differences)'
    show_text(text, aside=args.json)
    return 0 if _agrees(comparison.counts(), args.strict) else DIFFERS


def _watch_lines(watched: WatchedReplay, first_ns: int) -> list[str]:
    sentences = alarm_sentences(watched.alarms, first_ns, str(watched.watch.state))
    return [f'  watch: {sentence}' for sentence in sentences]


def _alarm_out(args: argparse.Namespace, recording: Recording) -> AlarmOut:
    """Where alarms go. What the recording's own rig names is not run: the file may be a stranger's."""
    about = {'recording': str(recording.path)}
    with given_as_option('watch_command', 'watch_webhook'):
        return AlarmOut(args.watch_command or '', args.watch_webhook or '', texts(warn), about)


def _replayed(
    recording: Recording,
    rig: Rig,
    params_file: str | None,
    comparison: ReplayComparison | None,
    takers: Iterable[Callable[[Record], None]],
    blocks: Iterable[SampleBlock] | None = None,
    part: RecordingWindow | None = None,
) -> ReplayTask:
    """Every record of ``part`` to each of ``takers``; ``comparison`` is finished."""
    pipeline, totals = Pipeline(rig), Totals(recording)
    began = time.perf_counter()
    for records in replayed(recording, pipeline, blocks, part):
        for record in records:
            totals.add(record)
            for take in takers:
                take(record)
        if comparison is not None:
            comparison.add(records)
    seconds = time.perf_counter() - began
    warnings = [*recording.warnings, *warnings_about_rig(recording, params_file), *_rate_warning(recording, rig)]
    if comparison is not None:
        comparison.finish()
    return ReplayTask(recording, rig, pipeline, totals, comparison, warnings, seconds)


def _agrees(counts: Mapping[str, object], strict: bool) -> bool:
    return bool(counts['identical'] or (counts['same_but_for_rounding'] and not strict))


@dataclass(frozen=True, slots=True)
class Replayed:
    """What the task of one of many recordings gives: JSON, warnings, and the estimates if they are written."""

    summary: dict[str, object]
    warnings: list[str]
    columns: list[Column]


def replay_of(
    path: str, *, params_file: str | None, namespace: str | None, span: Span, compare: bool, columns: bool
) -> Replayed:
    """The task for one of many recordings."""
    recording, rig = open_for_replay(path, params_file, namespace)
    buffered = BufferedEstimates()
    part = part_of(recording, span)
    comparison = ReplayComparison(recording, part) if compare else None
    done = _replayed(recording, rig, params_file, comparison, [buffered.add] if columns else [], part=part)
    return Replayed(done.summary(), done.warnings, _columns(buffered.series()) if columns else [])


def _columns(series: EstimateSeries) -> list[Column]:
    table = series.table()
    return [table.index, *table.columns]


def _many(args: argparse.Namespace, names: list[str]) -> int:
    if args.out is not None and not is_parquet(args.out):
        raise UsageError(f'--out {args.out}: of many recordings the estimates go into one X{ENDING}')
    if args.params_file is not None:
        # What is wrong in it is so for all.
        load_rig(args.params_file)
    results: dict[str, dict[str, object]] = {}
    with contextlib.ExitStack() as stack:
        out: ParquetFile | None = None
        if args.out is not None:
            fields = [
                Field(c.name, int if c.values.dtype.kind == 'i' else float, c.unit)
                for c in _columns(BufferedEstimates().series())
            ]
            out = stack.enter_context(ParquetFile(args.out, fields))

        def take(name: str, replayed: Replayed) -> None:
            results[name] = replayed.summary
            for warning in replayed.warnings:
                warn(warning)
            if out is not None:
                cells = {c.name: c.values for c in replayed.columns}
                out.put([name] * replayed.columns[0].values.size, cells)

        work = partial(
            replay_of,
            params_file=absolute(args.params_file),
            namespace=args.namespace,
            span=args.span,
            compare=args.compare,
            columns=args.out is not None,
        )
        failed = FLEET.run_each(args, names, work, take)
        if out is not None:
            out.close(failed)
    FLEET.notify_each(args, names, results, failed, HEAD, partial(_line, strict=args.strict))
    differs = args.compare and not all(_agrees(_counts(summary), args.strict) for summary in results.values())
    return DIFFERS if differs else 0


def _counts(summary: Mapping[str, Any]) -> Mapping[str, object]:
    counts: Mapping[str, object] = summary['compared']
    return counts


def _line(summary: Mapping[str, Any], strict: bool) -> list[str]:
    state = 'replayed'
    if summary['compared'] is not None:
        state = 'the same' if _agrees(_counts(summary), strict) else 'DIFFERS'
    rejected = sum(summary['rejected'].values())
    return [
        state,
        f'{summary["seconds"]:.1f}',
        *(str(summary[key]) for key in ('samples', 'lost', 'blocks', 'estimates')),
        str(rejected),
    ]


def _rate_warning(recording: Recording, rig: Rig) -> list[str]:
    measured, stated = recording.sample_rate_hz, rig.converter.sample_rate_hz
    if not measured or abs(measured - stated) < 0.01 * stated:
        return []
    return [
        f'{recording.path}: has {measured:.4g} samples a second, the rig says {stated:g} '
        '(converter.sample_rate_hz): the stamps of shortened blocks are off'
    ]


def _print_summary(args: argparse.Namespace, done: ReplayTask) -> None:
    totals = done.totals
    path = args.recordings[0]
    poses = np.array(totals.poses).reshape(-1, 3)
    if args.json:
        summary = done.summary()
        compared = summary.pop('compared')
        print_json(
            {'recording': str(path), **summary, 'replay_seconds': done.seconds, 'out': args.out, 'compared': compared}
        )
        return
    show(
        f'{path}: {totals.samples} samples, {totals.lost} lost, {totals.blocks} blocks, '
        f'{len(totals.poses)} estimates ({done.rig.estimator.solver})'
    )
    for cause, count in sorted(totals.rejected.items()):
        show(f'  no estimate: {count} {"block" if count == 1 else "blocks"}, {cause.replace("_", " ")}')
    if len(poses):
        show('  ' + ', '.join(' '.join(row) for row in ranges(poses)))
    show(f'  {totals.seconds:.1f} s of data in {done.seconds:.2f} s')
    if args.out is not None:
        show(f'  written to {Path(args.out)}')
