"""Make a recording whole that a crash or a power cut left without its end.

Each cut file is written anew beside the old one, with everything that lies whole in it, an index
and a summary; the old one is kept as NAME.mcap.cut. Then metadata.yaml is made, so that
`ros2 bag play` and other readers take the bag. Files that are whole are not touched, and neither is
a recording that is still being made.

  psd-deflection recover recordings/psd_20260101_120000
  psd-deflection recover lone.mcap
"""

from __future__ import annotations

import argparse
import sys

from psd_deflection.cli._progress import told
from psd_deflection.io.recover import recover


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', nargs='+', help='a bag folder or an .mcap')


def run(args: argparse.Namespace) -> int:
    """Repair and say what was done."""
    for path in args.recording:
        with told(f'reading {path}, and writing anew what is cut'):
            done = recover(path)
        for file in done.files:
            for warning in file.warnings:
                print(f'warning: {warning}', file=sys.stderr)
            span = (file.count.end_ns - file.count.start_ns) * 1e-9
            what = f'repaired, the old one is {file.path.name}.cut' if file.repaired else 'was whole'
            print(f'{file.path}: {file.count.messages} messages, {span:.3f} s; {what}')
        for aside in done.set_aside:
            print(f'{aside}: held nothing and is set aside')
        if done.metadata_written:
            print(f'{path}: metadata.yaml written')
    return 0
