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
  psd-deflection convert first.csv second.csv --out joined

Two CSVs are those of two loggers, each with some of the PSDs (t,x1,y1,sum1 and t,x2,y2,sum2) and a clock of its own.
The time between the clocks is found from the motion. The recording is on the first clock; each of its samples is a
reading of both, the nearest within 3/4 of a period; without one the sample is lost. Loads are those of the first.
"""

import argparse
from pathlib import Path

from psd_deflection.base.errors import UsageError
from psd_deflection.cli._options import namespace_option, recording_name, reject, span_options
from psd_deflection.cli._progress import progress_of, stage
from psd_deflection.cli._report import print_json, show, warn
from psd_deflection.cli._values import number
from psd_deflection.recordings.conversion import Beside, convert, convert_computed
from psd_deflection.recordings.formats.format import format_of_name
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import open_for_replay, warnings_about_rig
from psd_deflection.recordings.spans import FULL
from psd_deflection.recordings.two_loggers import join
from psd_deflection.rig.config import load_rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'recordings', nargs='+', metavar='REC', help='a bag folder, an .mcap or a .csv; or the two .csv of two loggers'
    )
    parser.add_argument(
        '--offset',
        type=number('--offset', -1e10, 1e10),
        metavar='S',
        help='of two loggers: what the second clock shows more, s (default: found from the motion)',
    )
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
    if len(args.recordings) > 2:
        raise UsageError(f'{args.recordings[2]}: one recording is converted, or the .csv of two loggers joined')
    if format_of_name(args.out).read is None:
        return _to_viewer(args)
    joined = None
    if len(args.recordings) == 2:
        reject(args, {'namespace': None}, 'is for a bag')
        with stage('finding the time between the clocks', quiet=args.json):
            joined = join(args.recordings[0], args.recordings[1], args.offset)
        recording: Recording = joined.recording if args.span == FULL else joined.recording.crop(*args.span)
    else:
        reject(args, {'offset': None}, 'is for the .csv of two loggers')
        recording = open_recording(args.recordings[0], namespace=args.namespace, span=args.span)
    parameters = recording.parameters if args.params_file is None else load_rig(args.params_file).flat()
    with stage('reading loads, references, temperatures', quiet=args.json):
        beside = Beside.of(recording)
    with progress_of(recording.blocks(), quiet=args.json) as blocks:
        samples = convert(recording, Path(args.out), parameters, beside, blocks)
    if args.json:
        clocks = {} if joined is None else {'clocks': joined.tree()}
        print_json({'out': args.out, 'samples': samples, **clocks, 'warnings': list(recording.warnings)})
    else:
        for text in () if joined is None else joined.sentences():
            show(text)
        show(f'{args.out}: {samples} samples')
    _warn(recording, args.params_file)
    return 0


def _to_viewer(args: argparse.Namespace) -> int:
    out, in_json = Path(args.out), args.json
    if len(args.recordings) == 2:
        raise UsageError(f'{args.out}: join the two loggers to a bag or .csv first, and convert that')
    recording, rig = open_for_replay(args.recordings[0], args.params_file, args.namespace, args.span)
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
