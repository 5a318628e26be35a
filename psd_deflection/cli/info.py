"""Summarise a recording: duration, samples, losses, topics, device and changed parameters.

The whole recording is read, so that damage anywhere is found.

  psd-deflection info bags/clean
  psd-deflection info recordings/psd_20260101_120000 --json
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from msg_adapters import SAMPLES
from psd_deflection.cli._options import namespace_option
from psd_deflection.cli._progress import progress_of, told
from psd_deflection.cli._report import print_json, show
from psd_deflection.recordings.readers import open_recording
from psd_deflection.recordings.summary import summary

_EPOCH_FROM_NS = 10**18
"""September 2001; smaller times do not count from the epoch."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    namespace_option(parser)
    parser.add_argument('--json', action='store_true', help='print the summary as JSON')


def run(args: argparse.Namespace) -> int:
    """Print the summary."""
    recording = open_recording(Path(args.recording), namespace=args.namespace)
    with told('counting messages', quiet=args.json):
        topics = recording.topics()
    found = summary(recording, topics, progress_of(recording.blocks(), topics.get(SAMPLES), quiet=args.json))
    if args.json:
        print_json(found, indent=2)
        return 0
    show(*_lines(found))
    return 0


def _lines(found: Mapping[str, Any]) -> list[str]:
    def row(name: str, text: str) -> str:
        return f'  {name:<12} {text}'

    out = [f'{found["path"]}: {found["bytes"] / 1e6:.2f} MB']
    out.append(row('state', 'complete' if found['complete'] else 'INCOMPLETE, see below'))
    if found['namespace']:
        out.append(row('namespace', found['namespace']))
    if found['version']:
        by = f', node {found["node"]}' if found['node'] else ''
        out.append(row('recorded by', f'psd_deflection {found["version"]}{by}'))
    if found['device_hello'] is not None:
        hello = {k: ' '.join(map(str, v)) if isinstance(v, list) else v for k, v in found['device_hello'].items()}
        out.append(row('device', ', '.join(f'{k} {v}' for k, v in hello.items())))
    start, samples, lost = found['start_ns'], found['samples'], found['lost']
    share = 100.0 * lost / (samples + lost) if samples else 0.0
    if not samples:
        out.append(row('samples', 'none'))
    else:
        if start >= _EPOCH_FROM_NS:
            when = datetime.fromtimestamp(start // 1_000_000_000, UTC).strftime('%Y-%m-%d %H:%M:%S')
            out.append(row('start', f'{when}.{start % 1_000_000_000:09d} UTC'))
        else:
            out.append(row('start', f'{start * 1e-9:.9f} s'))
        out.append(row('duration', f'{found["duration_s"]:.3f} s'))
        out.append(row('samples', f'{samples} present, {lost} lost ({share:.3g} %), {found["flagged"]} flagged'))
        if found['restarts']:
            out.append(row('restarts', f'{found["restarts"]} of the device'))
        out.append(row('rate', f'{found["sample_rate_hz"]:.6g} samples/s'))
        out.append(row('blocks', f'{found["blocks"]} of up to {found["block_size"]} samples'))
    out += [row('lacks' if i == 0 else '', text) for i, text in enumerate(found['lacks'])]
    out.append('  topics')
    width = max((len(t) for t in found['topics']), default=0)
    out += [f'    {topic:<{width}}  {count}' for topic, count in sorted(found['topics'].items())]
    if found['parameters'] and not found['changed_parameters']:
        out.append('  all parameters at their defaults')
    elif found['parameters']:
        out.append('  parameters that are not at their defaults')
        out += [f'    {k} = {v}' for k, v in sorted(found['changed_parameters'].items())]
    if found['as_in_the_thesis']:
        out.append('  parameters as in the thesis rig, unless they were measured to be the same')
        out += [f'    {text}' for text in found['as_in_the_thesis']]
    out += [
        f'  from block {c["block"]} on: ' + ', '.join(f'{k} = {v}' for k, v in c['values'].items())
        for c in found['changes']
    ]
    out += [f'  warning: {w}' for w in found['warnings']]
    return out
