# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Repair recordings that a crash or a power cut left without their end.

For each damaged file a new one is written: all intact messages, an index and a summary. The damaged
file is kept as NAME.mcap.cut. In a bag folder metadata.yaml is written too, so that `ros2 bag play`
and other readers accept the bag. Intact files stay as they are. A recording that is still being
written is rejected.

  psd-deflection recover recordings/psd_20260101_120000
  psd-deflection recover lone.mcap
"""

import argparse
from collections.abc import Iterator
from typing import Any

from psd_deflection.cli._progress import stage
from psd_deflection.cli._report import print_json, show, warn
from psd_deflection.recordings.repair import Recovered, recover


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', nargs='+', help='a bag folder or an .mcap')
    parser.add_argument('--json', action='store_true', help='for programs: the summary as one JSON object')


def run(args: argparse.Namespace) -> int:
    """Repair and say what was done."""
    repaired = []
    for path in args.recording:
        with stage(f'reading and repairing {path}', quiet=args.json):
            done = recover(path)
        for warning in (w for file in done.files for w in file.warnings):
            warn(warning)
        repaired.append({'path': path, **in_json(done)})
        if not args.json:
            show(*_lines(path, done))
    if args.json:
        print_json({'recordings': repaired})
    return 0


def in_json(done: Recovered) -> dict[str, Any]:
    """What ``--json`` prints of one: counts, ns."""
    return {
        'files': [
            {
                'path': str(file.path),
                'repaired': file.repaired,
                'messages': file.count.messages,
                'start_ns': file.count.start_ns,
                'end_ns': file.count.end_ns,
                'span_s': file.span_ns * 1e-9,
                'warnings': file.warnings,
            }
            for file in done.files
        ],
        'metadata_written': done.metadata_written,
        'set_aside': [str(aside) for aside in done.set_aside],
    }


def _lines(path: str, done: Recovered) -> Iterator[str]:
    for file in done.files:
        what = f'repaired, the old one is {file.path.name}.cut' if file.repaired else 'was intact'
        yield f'{file.path}: {file.count.messages} messages, {file.span_ns * 1e-9:.3f} s; {what}'
    for aside in done.set_aside:
        yield f'{aside}: held nothing and is set aside'
    if done.metadata_written:
        yield f'{path}: metadata.yaml written'
