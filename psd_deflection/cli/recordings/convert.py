# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert a recording to another format: samples, loads, reference poses and temperatures.

The name OUT sets the format: X.csv is a CSV recording, X.mcap a single MCAP file, any other name a
bag folder. The voltages stay the same bit for bit. Estimates are not copied; psd-deflection replay
computes them. X.rrd is for the Rerun viewer only (pip install rerun-sdk): it has the computed
estimates, dots, loads and losses with a layout, and cannot be read back.

  psd-deflection convert bags/clean --out clean.csv
  psd-deflection convert bags/lost_samples --out lost_samples.rrd
  psd-deflection convert run.csv --out run --params-file my_rig.yaml
  psd-deflection convert bags/clean --out part.csv --from 1 --to 2.5
"""

import argparse
from pathlib import Path

from psd_deflection.cli._options import namespace_option, recording_name, span_options
from psd_deflection.cli._progress import progress_of, stage
from psd_deflection.cli._report import print_json, show, warn
from psd_deflection.recordings.conversion import Beside, convert, convert_computed
from psd_deflection.recordings.formats.format import format_of_name
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import open_for_replay, warnings_about_rig
from psd_deflection.rig.config import load_rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    parser.add_argument(
        '--out',
        type=recording_name(to_look_at=True),
        metavar='OUT',
        required=True,
        help='output: X.csv, X.mcap, X.rrd, or a bag folder (any other name)',
    )
    parser.add_argument(
        '--params-file',
        metavar='RIG.yaml',
        help="the rig to store in a bag or to compute an .rrd with (default: the recording's own)",
    )
    span_options(parser)
    namespace_option(parser)
    parser.add_argument('--json', action='store_true', help='print the summary as JSON')


def run(args: argparse.Namespace) -> int:
    """Convert and say what was written."""
    if format_of_name(args.out).read is None:
        return _to_viewer(args)
    recording = open_recording(args.recording, namespace=args.namespace, span=args.span)
    parameters = recording.parameters if args.params_file is None else load_rig(args.params_file).flat()
    with stage('reading loads, references, temperatures', quiet=args.json):
        beside = Beside.of(recording)
    with progress_of(recording.blocks(), quiet=args.json) as blocks:
        samples = convert(recording, Path(args.out), parameters, beside, blocks)
    if args.json:
        print_json({'out': args.out, 'samples': samples, 'warnings': list(recording.warnings)})
    else:
        show(f'{args.out}: {samples} samples')
    _warn(recording, args.params_file)
    return 0


def _to_viewer(args: argparse.Namespace) -> int:
    out, in_json = Path(args.out), args.json
    recording, rig = open_for_replay(args.recording, args.params_file, args.namespace, args.span)
    with progress_of(recording.blocks(), quiet=in_json) as blocks:
        done = convert_computed(recording, out, rig, blocks)
    if in_json:
        warnings = list(recording.warnings)
        print_json({'out': str(out), 'blocks': done.blocks, 'estimates': done.estimates, 'warnings': warnings})
    else:
        show(f'{out}: {done.estimates} estimates of {done.blocks} blocks; look at it: rerun {out}')
    _warn(recording, args.params_file)
    return 0


def _warn(recording: Recording, params_file: str | None) -> None:
    for warning in [*recording.warnings, *warnings_about_rig(recording, params_file)]:
        warn(warning)
