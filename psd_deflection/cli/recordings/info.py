# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Summarise a recording: duration, samples, losses, topics, device and changed parameters.

The whole recording is read, so that damage anywhere is found. Of several recordings you get a table. REC may also be
a pattern, or a .txt file that lists recordings and patterns. A table of readings (a CSV without times) is told as one.

  psd-deflection info bags/clean
  psd-deflection info recordings/psd_20260101_120000 --json
  psd-deflection info 'recordings/*' --executor processes --out all.parquet
"""

import argparse
import contextlib
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from msg_adapters import SAMPLES
from psd_deflection.base.text import sanitize
from psd_deflection.cli._many import FLEET, executor_option, recordings_argument, several
from psd_deflection.cli._options import namespace_option, parquet_name, span_options
from psd_deflection.cli._progress import progress_of, stage
from psd_deflection.cli._report import print_json, show
from psd_deflection.recordings.provenance import NAMES
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.read.references import described, is_table
from psd_deflection.recordings.recording import EPOCH_FROM_NS
from psd_deflection.recordings.spans import Span
from psd_deflection.recordings.summary import summary
from psd_deflection.recordings.write.parquet import ERROR, Field, ParquetFile
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.declarations import ACQUISITION, MONITOR

FIELDS = (
    *(ERROR, Field('complete', bool), Field('bytes', int, 'B'), Field('start_ns', int, 'ns')),
    Field('duration_s', float, 's'),
    *(Field(name, int) for name in ('samples', 'lost', 'flagged', 'restarts')),
    *(Field('clock_steps', str), Field('squeezed', int), Field('sample_rate_hz', float, 'Hz')),
    *(Field('blocks', int), Field('block_size', int)),
    *(Field(name, str) for name in ('namespace', 'node', 'version', 'lacks')),
    *(Field(name, str) for name in ('warnings', 'marks', 'topics', 'parameters')),
)
"""Columns of --out. ``marks``, ``clock_steps``, ``topics`` and ``parameters`` are JSON."""

HEAD = ('state', 'seconds', 'samples', 'lost', 'flagged', 'rate (1/s)', 'lacks')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    recordings_argument(parser, 'a bag folder, an .mcap or a .csv')
    if FLEET:
        parser.add_argument('--out', metavar='X.parquet', type=parquet_name, help='write a row a recording')
    span_options(parser)
    namespace_option(parser)
    executor_option(parser)
    parser.add_argument('--json', action='store_true', help='print the summary as JSON')


def run(args: argparse.Namespace) -> int:
    """Print the summary, or a table of many."""
    names = several(args)
    if names is not None:
        return _many(args, names)
    path = Path(args.recordings[0])
    if is_table(path):
        reported_of = described(path)
        if args.json:
            print_json({'path': str(path), 'table': reported_of}, indent=2)
        else:
            show(f'{path}: a table of readings', *(_row_of(name, text) for name, text in reported_of))
        return 0
    recording = open_recording(path, namespace=args.namespace, span=args.span)
    with stage('counting messages', quiet=args.json):
        topics = recording.topics()
    info = summary(recording, topics, progress_of(recording.blocks(), topics.get(SAMPLES), quiet=args.json))
    if args.json:
        print_json(info, indent=2)
        return 0
    show(*_lines(info))
    return 0


def summary_of(name: str, namespace: str | None, span: Span) -> dict[str, Any]:
    """The task for one of many recordings."""
    recording = open_recording(name, namespace=namespace, span=span)
    return summary(recording, recording.topics(), recording.blocks())


def _many(args: argparse.Namespace, names: list[str]) -> int:
    results: dict[str, dict[str, Any]] = {}
    with contextlib.ExitStack() as stack:
        out = None if args.out is None else stack.enter_context(ParquetFile(args.out, FIELDS))
        work = partial(summary_of, namespace=args.namespace, span=args.span)
        failed = FLEET.run_each(args, names, work, results.__setitem__)
        if out is not None:
            FLEET.write_rows(out, names, {name: _row(info) for name, info in results.items()}, failed)
    FLEET.notify_each(args, names, results, failed, HEAD, _line)
    return 0


def _row(info: Mapping[str, Any]) -> dict[str, object]:
    texts = {name: '; '.join(info[name]) for name in ('lacks', 'warnings')}
    return {
        **info,
        **texts,
        **{name: json.dumps(info[name]) for name in ('marks', 'clock_steps', 'topics', 'parameters')},
    }


def _line(info: Mapping[str, Any]) -> list[str]:
    state = 'complete' if info['complete'] and not info['warnings'] else 'damaged'
    return [
        state,
        f'{info["duration_s"]:.3f}',
        str(info['samples']),
        str(info['lost']),
        str(info['flagged']),
        f'{info["sample_rate_hz"]:.6g}',
        str(len(info['lacks'])),
    ]


def _row_of(name: str, text: str) -> str:
    return f'  {name:<12} {text}'


def _lines(info: Mapping[str, Any]) -> list[str]:
    out = [f'{info["path"]}: {info["bytes"] / 1e6:.2f} MB']
    out += _lines_of_origin(info)
    out += _lines_of_samples(info)
    out += [
        _row_of('marks' if i == 0 else '', f'{round(mark["t_s"], 3) + 0.0:9.3f} s  {mark["text"]}')
        for i, mark in enumerate(info['marks'])
    ]
    out += [_row_of('lacks' if i == 0 else '', text) for i, text in enumerate(info['lacks'])]
    out.append('  topics')
    width = max((len(t) for t in info['topics']), default=0)
    out += [f'    {topic:<{width}}  {count}' for topic, count in sorted(info['topics'].items())]
    out += _lines_of_parameters(info)
    out += [f'  warning: {w}' for w in info['warnings']]
    return out


def _lines_of_origin(info: Mapping[str, Any]) -> list[str]:
    row = _row_of
    out = [row('state', 'complete' if info['complete'] else 'INCOMPLETE, see below')]
    if info['namespace']:
        out.append(row('namespace', info['namespace']))
    if info['version']:
        node_text = f', node {info["node"]}' if info['node'] else ''
        out.append(row('recorded by', f'psd_deflection {info["version"]}{node_text}'))
    if info['made_with']:
        reported = [
            f'{name} {sanitize(info["made_with"][name], 120)}' for name in NAMES[1:] if name in info['made_with']
        ]
        out.append(row('computed by', ', '.join(reported)))
    if info['device_hello'] is not None:
        hello = {k: ' '.join(map(str, v)) if isinstance(v, list) else v for k, v in info['device_hello'].items()}
        out.append(row('device', ', '.join(f'{k} {v}' for k, v in hello.items())))
    return out


def _lines_of_samples(info: Mapping[str, Any]) -> list[str]:
    row = _row_of
    start, samples, lost = info['start_ns'], info['samples'], info['lost']
    if not samples:
        return [row('samples', 'none')]
    when = f'{start * 1e-9:.9f} s'
    if start >= EPOCH_FROM_NS:
        second = datetime.fromtimestamp(start // 1_000_000_000, UTC).strftime('%Y-%m-%d %H:%M:%S')
        when = f'{second}.{start % 1_000_000_000:09d} UTC'
    share = f'{100.0 * lost / (samples + lost):.3g} %'
    out = [
        row('start', when),
        row('duration', f'{info["duration_s"]:.3f} s'),
        row('samples', f'{samples} present, {lost} lost ({share}), {info["flagged"]} flagged'),
    ]
    here = info['dropped_here']
    if here['samples'] or here['messages']:
        out.append(
            row(
                'dropped',
                f'{here["samples"]} samples, {here["messages"]} messages: the host that recorded was too slow',
            )
        )
    if info['restarts']:
        out.append(row('restarts', f'{info["restarts"]} of the device'))
    if info['clock_steps']:
        worst = max(info['clock_steps'], key=lambda step: abs(step['step_s']))
        at, size = f'{(worst["t_ns"] - start) / 1e9:.3f} s', f'{worst["step_s"] * 1e3:+.1f} ms'
        text = f'{len(info["clock_steps"])}, the largest at {at} by {size}: stamps before it are off by as much'
        out.append(row('clock steps', text))
    if info['squeezed']:
        out.append(row('squeezed', f'{info["squeezed"]} samples have stamps 1 ns apart after a step back'))
    out.append(row('rate', f'{info["sample_rate_hz"]:.6g} samples/s'))
    if (moved := info['vibration']) is not None:
        size, hz, share = moved['rms_m'] * 1e6, moved['hz'], moved['share']
        out.append(
            row('vibrates', f'up to {size:.1f} µm rms near {hz:.3g} Hz, in {100.0 * share:.3g} % of the seconds')
        )
    out.append(row('blocks', f'{info["blocks"]} of up to {info["block_size"]} samples'))
    return out


def _lines_of_parameters(info: Mapping[str, Any]) -> list[str]:
    out: list[str] = []
    # What says how a node runs describes no rig.
    running = {p.name for section in (ACQUISITION, MONITOR) for p in section.parameters.values()}
    unknown = len(load_rig().flat().keys() - running - info['parameters'].keys()) if info['parameters'] else 0
    if info['parameters'] and not info['changed_parameters']:
        out.append(f'  {"the recorded" if unknown else "all"} parameters at their defaults')
    elif info['parameters']:
        out.append('  parameters that are not at their defaults')
        out += [f'    {k} = {v}' for k, v in sorted(info['changed_parameters'].items())]
    if unknown:
        out.append(f'  {unknown} parameters of a rig are not in the recording')
    if info['as_in_the_thesis']:
        out.append('  parameters as in the thesis rig, unless they were measured to be the same')
        out += [f'    {text}' for text in info['as_in_the_thesis']]
    # What the pipeline remembered at the start is for a replay, and for --json.
    for c in info['changes']:
        values = {k: v for k, v in c['values'].items() if not k.startswith('state.')}
        remembered = f'{len(c["values"])} values that the estimator remembered, for a replay'
        reported = ', '.join(f'{k} = {v}' for k, v in values.items()) or remembered
        # Of a part the first ones are older than its start.
        since = (c['t_ns'] - info['start_ns']) / 1e9
        out.append(f'  {f"from {since:.3f} s on" if since >= 0.0005 else "at the start"}: {reported}')
    return out
