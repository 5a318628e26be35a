# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimate how the real rig differs from its rig file: turned or mis-scaled PSDs, centres, heights, tilt, noise.

REC is a bag folder, an .mcap or a .csv with a reference (a camera, a stage, a tracker) or with known loads.
Give several if you have them. DIR gets rig.yaml (use it as --params-file: estimates are corrected, and their covariance
holds what the calibration left open), report.html and calibration.json.

--check RIG.yaml instead holds a calibrated rig file against a recording made since: what moved, by how much, how sure.
--dark takes a recording with the lasers off, both or one after the other, in the light of the room: what the PSDs
then read is written as psd_N.dark and taken off every reading. Without REC that is all that is done, when the light of
the room has changed.
--self takes recordings without reference and loads: the one redundant reading tells relative gains and turns.

--live calibrates at the bench: it starts a recording of the running daemon (`monitor`, `estimator --monitor`), shows
what the motion so far has determined, what is open and what to do next, and ends when nothing is open, with
`psd-deflection record stop` or with Ctrl-C; the answer is that of the recording.

All REC together make one calibration. With --each every REC is one for itself: DIR/REC gets its files, or X.parquet a
row. REC may then be a pattern, or a .txt file that lists recordings and patterns.

  psd-deflection calibrate run.csv --params-file my_rig.yaml --out new
  psd-deflection calibrate run.csv --reference camera.csv --out new
  psd-deflection calibrate run.csv --dark lasers_off.csv --out new
  psd-deflection calibrate --dark off.csv --params-file new/rig.yaml --out b
  psd-deflection calibrate today.csv --check new/rig.yaml
  psd-deflection calibrate run --self --params-file my_rig.yaml --out new
  psd-deflection calibrate --live --params-file my_rig.yaml --out new
  psd-deflection calibrate 'archive/*' --each --out calibrations.parquet
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from psd_deflection import __version__
from psd_deflection.base.errors import ConfigError, UsageError
from psd_deflection.cli._daemon import url_option
from psd_deflection.cli._many import FLEET, absolute, each_for_itself, each_option
from psd_deflection.cli._options import make_writable, namespace_option, reject, span_options
from psd_deflection.cli._progress import stage
from psd_deflection.cli._report import print_json, save_all, show, warn
from psd_deflection.cli._values import number
from psd_deflection.cli.studies._calibrate_live import calibrate_live
from psd_deflection.model.misalignment.rig import is_calibrated
from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.recordings.spans import FULL
from psd_deflection.recordings.write.parquet import ERROR, Field
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.rig.parameter_files import with_values
from psd_deflection.studies.calibrate import check as checking
from psd_deflection.studies.calibrate.dark import (
    DarkLevel,
    result_of_levels,
    source_of_levels,
    values_of_levels,
    words_of_level,
)
from psd_deflection.studies.calibrate.fit import NAMES, REPORTED, UNITS
from psd_deflection.studies.calibrate.from_recordings import CalibrationOptions, read_runs
from psd_deflection.studies.calibrate.result import Calibrated
from psd_deflection.studies.study import described, edited_rig_file

MOST_EXPOSURE = 0.02
"""s. The polynomial that is fitted to the samples about a reference is 21 samples long."""
STEPS = 5
"""Steps that the progress bar counts: noise, rows, fitting, held-out motion, report."""
HEAD = ('state', 'by', 'undetermined', 'heldout before (um)', 'after')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recordings', metavar='REC', nargs='*', help='recordings with a reference or with known loads')
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help='the rig as it is known (default: the parameters in the recording)'
    )
    parser.add_argument(
        '--reference',
        metavar='FILE',
        action='append',
        default=[],
        help='a table t,dx,dy,theta or another recording, one for each REC in order (default: in REC)',
    )
    parser.add_argument(
        '--exposure',
        type=number('--exposure', 0.0, MOST_EXPOSURE),
        default=0.0,
        metavar='S',
        help='time over which each reference is a mean, s: the exposure of a camera (default 0)',
    )
    parser.add_argument(
        '--dark',
        metavar='FILE',
        action='append',
        default=[],
        help='a recording with the lasers off, several if they were off one after the other; the light is that of REC',
    )
    parser.add_argument('--out', metavar='DIR', help='folder for rig.yaml, report.html, calibration.json')
    each_option(parser)
    parser.add_argument('--check', metavar='RIG.yaml', help='instead: does this calibrated rig file still hold?')
    parser.add_argument(
        '--self', action='store_true', dest='alone', help='by the redundant reading alone, without reference and loads'
    )
    parser.add_argument(
        '--live', action='store_true', help='at the bench: record and calibrate with a running daemon, without REC'
    )
    url_option(parser)
    span_options(parser)
    namespace_option(parser)
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.add_argument('--json', action='store_true', help='print the content of calibration.json, or of the check')


def _reject_mixed(args: argparse.Namespace) -> None:
    """Reject options that contradict each other."""
    if args.reference and len(args.reference) != len(args.recordings):
        raise UsageError(
            f'--reference is given {len(args.reference)} times for {len(args.recordings)} recordings: '
            f'give one for each, in the same order'
        )
    if args.live:
        if args.recordings or args.span != FULL:
            raise UsageError('REC, --from, --to: --live makes a recording of its own and takes all of it')
        made: dict[str, object] = {'check': None, 'each': False, 'executor': None, 'reference': []}
        made |= {'dark': [], 'namespace': None}
        reject(args, made, 'is for recordings that are there: --live makes its own')
    elif args.url is not None:
        raise UsageError('--url: is for --live')
    elif not args.recordings and (args.check is not None or args.alone or args.each or not args.dark):
        raise UsageError('REC is missing: a recording with a reference or with known loads; --dark alone needs none')
    if args.check is not None:
        excluded = (args.params_file, args.out, args.each or None, args.executor, args.dark or None)
        if any(option is not None for option in excluded):
            raise UsageError(
                '--check RIG.yaml is for itself: give none of --params-file, --out, --each, --executor, --dark'
            )
    elif args.out is None:
        raise UsageError('--out DIR (a calibration) or --check RIG.yaml (of an older one) is needed')


def run(args: argparse.Namespace) -> int:
    """Read, calibrate or check, write, and say it in a sentence."""
    _reject_mixed(args)
    if args.check is not None:
        return _check(args)
    asked = CalibrationOptions(
        absolute(args.params_file),
        args.namespace,
        args.exposure,
        args.alone,
        tuple(args.reference),
        tuple(args.dark),
        span=args.span,
    )
    if args.live:
        return _live(args, asked)
    names = each_for_itself(args)
    if names is not None:
        return _each(args, names, asked)
    rig = asked.rig(args.recordings or args.dark, warn)
    with stage('reading', quiet=args.quiet or args.json):
        runs = asked.runs(args.recordings, rig)
        levels = asked.levels(rig, runs)
    make_writable(args.out)
    if not runs:
        return _dark_alone(args, asked, rig, levels)
    hidden = True if args.quiet or args.json else None
    with tqdm(total=STEPS, disable=hidden, file=sys.stderr, bar_format='{l_bar}{bar}| {elapsed}') as bar:

        def progress(words: str) -> None:
            bar.set_description_str(words)
            bar.update()

        calibration = asked.calibrated(runs, rig, levels, progress, warn)
        progress('report')
        files = calibration.files()
    return _answer(args, calibration, files)


def _live(args: argparse.Namespace, asked: CalibrationOptions) -> int:
    if asked.params_file is not None:
        load_rig(asked.params_file)
    make_writable(args.out)
    calibration = calibrate_live(args, asked)
    return _answer(args, calibration, calibration.files())


def _answer(args: argparse.Namespace, calibration: Calibrated, files: Mapping[str, str]) -> int:
    """Write the files and say the answer."""
    out = Path(args.out)
    save_all(files, out)
    if args.json:
        print(files[calibration.json_name].removesuffix('\n'))  # noqa: T201 - no control characters, long lines
        return 0
    show(*calibration.lines(), f'see {out / "report.html"}; use {out / "rig.yaml"} as --params-file')
    return 0


def answer_of(path: str, asked: CalibrationOptions) -> Any:
    """The task for one of many recordings; its TaskResult."""
    warnings: list[str] = []
    rig = asked.rig([path], warnings.append)
    answer = asked.calibrated(asked.runs([path], rig), rig, (), lambda words: None, warnings.append)
    calibration, files, tree = answer.calibration, answer.files(), answer.tree()
    cells: dict[str, object] = {
        'kind': calibration.kind,
        'rejected': calibration.rejected or '',
        'undetermined': len(calibration.undetermined),
        'heldout_before': calibration.gap.heldout_before,
        'heldout_after': calibration.gap.heldout_after,
        **{name: parameter['value'] for name, parameter in tree['parameters'].items()},
        **{f'sd {name}': parameter['sd'] for name, parameter in tree['parameters'].items()},
        'result': files[answer.json_name],
    }
    return FLEET.TaskResult(files, cells, warnings)


def _fields() -> list[Field]:
    """Columns of --each: each parameter and its standard deviation; ``result`` is the content of calibration.json."""
    of_parameters = [Field(NAMES[i], float, UNITS[i]) for i in REPORTED]
    return [
        ERROR,
        Field('kind', str),
        Field('rejected', str),
        Field('undetermined', int),
        Field('heldout_before', float, 'm'),
        Field('heldout_after', float, 'm'),
        *of_parameters,
        *(Field(f'sd {f.name}', float, f.unit) for f in of_parameters),
        Field('result', str),
    ]


def _each(args: argparse.Namespace, names: list[str], asked: CalibrationOptions) -> int:
    if args.reference:
        raise UsageError('--reference: not with --each, which takes the reference that is in each recording')
    if args.dark:
        raise UsageError('--dark: not with --each, whose recordings may have been made in different light')
    if args.params_file is not None:
        # What is wrong in it is so for all.
        load_rig(args.params_file)
    answered: int = FLEET.answer_each(args, names, partial(answer_of, asked=asked), _fields(), HEAD, _line)
    return answered


def _line(cells: Mapping[str, Any]) -> list[str]:
    state = 'rejected' if cells['rejected'] else 'calibrated'
    return [
        state,
        cells['kind'],
        str(cells['undetermined']),
        *(f'{cells[key] * 1e6:.2f}' for key in ('heldout_before', 'heldout_after')),
    ]


def _dark_alone(args: argparse.Namespace, asked: CalibrationOptions, rig: Rig, levels: Sequence[DarkLevel]) -> int:
    """Write the dark levels into the rig file and change nothing else."""
    source = f'Dark levels by psd-deflection {__version__}, {asked.date}, from {source_of_levels(levels)}'
    text = edited_rig_file(
        asked.params_file,
        'rig.yaml',
        lambda: described(rig, effects_of_rig(rig)),
        lambda text, path: with_values(text, values_of_levels(levels), source, path),
        warn,
    )
    save_all({'rig.yaml': text}, Path(args.out))
    if args.json:
        print_json({'dark': result_of_levels(levels)}, indent=1)
        return 0
    show(*map(words_of_level, levels), f'use {Path(args.out) / "rig.yaml"} as --params-file')
    return 0


def _check(args: argparse.Namespace) -> int:
    rig = load_rig(args.check)
    if not is_calibrated(rig):
        raise ConfigError(f'{args.check}: calibration.names: not there; --check takes the rig.yaml of a calibration')
    with stage('checking', quiet=args.quiet or args.json):
        runs = read_runs(
            args.recordings,
            rig,
            references=args.reference,
            exposure=args.exposure,
            namespace=args.namespace,
            span=args.span,
        )
        checked = checking.check(runs, rig, alone=args.alone)
    if args.json:
        print_json(checking.result(checked), indent=1)
        return 0
    show(checking.sentence(checked))
    worst = int(abs(checked.zero / checked.zero_sd).argmax())
    show(
        f'unloaded readings against the file (µm): {", ".join(f"{v * 1e6:+.1f}" for v in checked.zero)} '
        f'± {checked.zero_sd[worst] * 1e6:.1g}; ~/zero takes them anew'
    )
    return 0
