"""Compute the estimates of a recording again, in the same way as the live node.

With the recorded parameters (the default) the estimates are the published ones, bit for bit.
--compare checks this and ends with status 1 if anything differs that the recording and its replay
both hold; --strict also if one of them lacks a message of the other. With --params-file you see what
another rig would have estimated from the same samples. --watch says since when the rig is not its model.

  psd-deflection replay recordings/psd_20260101_120000 --compare
  psd-deflection replay run.csv --params-file my_rig.yaml --out estimates.csv
  psd-deflection replay recordings/psd_20260101_120000 --out again.mcap
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from psd_deflection.cli._options import namespace_option, recording_name, refuse
from psd_deflection.cli._progress import progress_of, told
from psd_deflection.cli._report import print_json, show, show_text, warn
from psd_deflection.config import Rig
from psd_deflection.pipeline import Pipeline
from psd_deflection.recordings.comparison import Comparison
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay_engine import nominal_rig, open_for_replay, replayed
from psd_deflection.recordings.sinks import Sink, open_sink
from psd_deflection.recordings.watched import WatchedReplay
from psd_deflection.records import DeflectionEstimate, Record, SampleBlock

DIFFERS = 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help='use this rig instead of the parameters in the recording'
    )
    parser.add_argument(
        '--out',
        type=recording_name(rerun=True),
        metavar='OUT',
        help='write the estimates: X.csv, X.mcap, X.rrd or a bag folder (X)',
    )
    parser.add_argument(
        '--compare', action='store_true', help='compare with the recorded estimates; exit status 1 if a bit differs'
    )
    parser.add_argument(
        '--strict', action='store_true', help='with --compare: what only one side holds is a difference too'
    )
    parser.add_argument(
        '--watch', action='store_true', help='test whether the rig stays its model, as the node does with watch: on'
    )
    namespace_option(parser)
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

    @property
    def seconds(self) -> float:
        """How long the samples last, by their stamps."""
        return self.recording.lasts(self.first_ns, self.last_ns) if self.blocks else 0.0

    @property
    def lost(self) -> int:
        """Samples missing between the first and the last."""
        return self.recording.lost(self.first_seq, self.last_seq, self.samples) if self.first_seq is not None else 0


def run(args: argparse.Namespace) -> int:
    """Replay."""
    if not args.compare:
        refuse(args, {'strict': False}, 'needs --compare')
    recording, rig = open_for_replay(args.recording, args.params_file, args.namespace)
    pipeline = Pipeline(rig)
    with told('looking for what was recorded', quiet=args.json):
        comparison = Comparison(recording) if args.compare else None
    sink: Sink | None = None
    if args.out is not None:
        sink = open_sink(args.out, rig.flat(), device_hello=recording.hello)
    totals = Totals(recording)
    watched = WatchedReplay(rig, pipeline, recording) if args.watch else None
    began = time.perf_counter()
    bar = progress_of(recording.blocks(), quiet=args.json)
    try:
        for records in replayed(recording, pipeline, bar):
            for record in records:
                totals.add(record)
                if sink is not None:
                    sink.put(record)
                if watched is not None:
                    watched.put(record)
            if comparison is not None:
                comparison.add(records)
    finally:
        bar.close()
        if sink is not None:
            sink.close()
    seconds = time.perf_counter() - began
    for warning in [*recording.warnings, *nominal_rig(recording, args.params_file), *_rate_warning(recording, rig)]:
        warn(warning)
    if comparison is not None:
        comparison.finish()
    _print_summary(args, rig, pipeline, totals, seconds, comparison)
    if watched is not None:
        show(*watched.said(totals.first_ns), aside=args.json)
    if comparison is None:
        return 0
    text = comparison.summary()
    if comparison.different and args.params_file is None and not recording.parameters:
        text += '\n  the recording names no rig and was evaluated with the nominal one: give its own with --params-file'
    if comparison.same and not comparison.identical:
        text += ' (--strict counts them as differences)'
    show_text(text, aside=args.json)
    return 0 if comparison.identical or (comparison.same and not args.strict) else DIFFERS


def _rate_warning(recording: Recording, rig: Rig) -> list[str]:
    found, stated = recording.sample_rate_hz, rig.converter.sample_rate_hz
    if not found or abs(found - stated) < 0.01 * stated:
        return []
    return [
        f'{recording.path}: has {found:.4g} samples a second, the rig says {stated:g} '
        '(converter.sample_rate_hz): the stamps of shortened blocks are off'
    ]


def _print_summary(
    args: argparse.Namespace,
    rig: Rig,
    pipeline: Pipeline,
    totals: Totals,
    seconds: float,
    comparison: Comparison | None,
) -> None:
    counters = pipeline.counters
    poses = np.array(totals.poses).reshape(-1, 3)
    if args.json:
        summary = {
            'recording': str(args.recording),
            'samples': totals.samples,
            'lost': totals.lost,
            'blocks': totals.blocks,
            'estimates': counters.estimates,
            'refused': counters.refused,
            'solver': rig.estimator.solver,
            'seconds': totals.seconds,
            'replay_seconds': seconds,
            'out': args.out,
            'compared': None if comparison is None else comparison.counts(),
        }
        print_json(summary)
        return
    show(
        f'{args.recording}: {totals.samples} samples, {totals.lost} lost, {totals.blocks} blocks, '
        f'{counters.estimates} estimates ({rig.estimator.solver})'
    )
    for cause, count in sorted(counters.refused.items()):
        show(f'  no estimate: {count} {"block" if count == 1 else "blocks"}, {cause.replace("_", " ")}')
    if len(poses):
        low, high = poses.min(axis=0), poses.max(axis=0)
        show(
            f'  ΔX {low[0] * 1e6:+.2f} … {high[0] * 1e6:+.2f} µm, ΔY {low[1] * 1e6:+.2f} … {high[1] * 1e6:+.2f} µm, '
            f'θ {np.rad2deg(low[2]) * 1e3:+.2f} … {np.rad2deg(high[2]) * 1e3:+.2f} mdeg'
        )
    show(f'  {totals.seconds:.1f} s of data in {seconds:.2f} s')
    if args.out is not None:
        show(f'  written to {Path(args.out)}')
