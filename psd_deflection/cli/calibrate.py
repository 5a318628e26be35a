"""Estimate how the real rig differs from its rig file: turned or mis-scaled PSDs, centres, heights, tilt, noise.

REC is a bag folder, an .mcap or a .csv with a reference (a camera, a stage, a tracker) or with known loads.
Give several if you have them. DIR gets rig.yaml (use it as --params-file: estimates are corrected, and their covariance
holds what the calibration left open), report.html and calibration.json.

--check RIG.yaml instead holds a calibrated rig file against a recording made since: what moved, by how much, how sure.
--self takes recordings without reference and loads: the one redundant reading tells relative gains and turns.

  psd-deflection calibrate run.csv --params-file my_rig.yaml --out new
  psd-deflection calibrate run.csv --reference camera.csv --out new
  psd-deflection calibrate today.csv --check new/rig.yaml
  psd-deflection calibrate run --self --params-file my_rig.yaml --out new
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from datetime import UTC, datetime
from pathlib import Path

from tqdm import tqdm

from psd_deflection.calibrating import check as checking
from psd_deflection.calibrating.calibrate import Calibration, calibrate
from psd_deflection.calibrating.observation import Run
from psd_deflection.calibrating.report import report_html
from psd_deflection.calibrating.result import result, sentence, source_of, values_of
from psd_deflection.cli._options import make_folder, namespace_option, number
from psd_deflection.cli._progress import told
from psd_deflection.cli._report import print_json, save, show, warn
from psd_deflection.cli._rig_file import rig_file
from psd_deflection.config import Rig, load_rig
from psd_deflection.discovery.result import model_yaml
from psd_deflection.errors import ConfigError, RecordingError, UsageError
from psd_deflection.misalignment.rig import is_calibrated
from psd_deflection.parameter_files import with_effects_section, with_values
from psd_deflection.recordings.calibration_runs import read_runs
from psd_deflection.recordings.readers import open_recording
from psd_deflection.recordings.replay_engine import nominal_rig, rig_at_end
from psd_deflection.simulation.catalogue import effects_of_rig, effects_to_values

MOST_EXPOSURE = 0.02
"""s. The polynomial that is fitted to the samples about a reference is 21 samples long."""
STEPS = 5
"""Steps that the progress bar counts: noise, rows, fitting, held-out motion, report."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recordings', metavar='REC', nargs='+', help='recordings with a reference or with known loads')
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
    parser.add_argument('--out', metavar='DIR', help='folder for rig.yaml, report.html, calibration.json')
    parser.add_argument('--check', metavar='RIG.yaml', help='instead: does this calibrated rig file still hold?')
    parser.add_argument(
        '--self', action='store_true', dest='alone', help='by the redundant reading alone, without reference and loads'
    )
    namespace_option(parser)
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.add_argument('--json', action='store_true', help='print the content of calibration.json, or of the check')


def run(args: argparse.Namespace) -> int:
    """Read, calibrate or check, write, and say it in a sentence."""
    if args.reference and len(args.reference) != len(args.recordings):
        raise UsageError(
            f'--reference is given {len(args.reference)} times for {len(args.recordings)} recordings: '
            f'give one for each, in the same order'
        )
    if args.check is not None:
        if args.params_file is not None or args.out is not None:
            raise UsageError('--check RIG.yaml is for itself: give neither --params-file nor --out')
        return _check(args)
    if args.out is None:
        raise UsageError('--out DIR (a calibration) or --check RIG.yaml (of an older one) is needed')
    out = Path(args.out)
    rig = _rig_of(args)
    with told('reading', quiet=args.quiet or args.json):
        runs = _runs_of(args, rig)
    make_folder(args.out)
    # Before the work, which takes its time.
    if not os.access(out, os.W_OK):
        raise RecordingError(f'--out {out}: cannot be written in; give another folder')
    date = datetime.now(UTC).date().isoformat()
    hidden = True if args.quiet or args.json else None
    with tqdm(total=STEPS, disable=hidden, file=sys.stderr, bar_format='{l_bar}{bar}| {elapsed}') as bar:

        def progress(words: str) -> None:
            bar.set_description_str(words)
            bar.update()

        found = calibrate(runs, rig, alone=args.alone, progress=progress)
        progress('report')
        report = report_html(found, date)
    in_json = json.dumps(result(found, date), indent=1, allow_nan=False)
    files = {
        'rig.yaml': _rig_yaml(args.params_file, rig, found, date),
        'calibration.json': in_json + '\n',
        'report.html': report,
    }
    for name, text in files.items():
        save(text.encode(errors='replace'), out / name)
    if args.json:
        print(in_json)  # noqa: T201 - JSON has no control characters, and its lines may be long
        return 0
    show(sentence(found))
    for direction in found.undetermined:
        show(f'undetermined: {", ".join(direction.parts)}; it needs {direction.needs}')
    show(f'see {out / "report.html"}; use {out / "rig.yaml"} as --params-file')
    return 0


def _runs_of(args: argparse.Namespace, rig: Rig) -> list[Run]:
    return read_runs(args.recordings, rig, references=args.reference, exposure=args.exposure, namespace=args.namespace)


def _rig_of(args: argparse.Namespace) -> Rig:
    if args.params_file is not None:
        return load_rig(args.params_file)
    recording = open_recording(args.recordings[0], namespace=args.namespace)
    for warning in nominal_rig(recording):
        warn(warning)
    return rig_at_end(recording)


def _rig_yaml(params_file: str | None, rig: Rig, found: Calibration, date: str) -> str:
    """The user's parameter file with the calibration, comments kept; without one what describes the rig."""
    values, effects = values_of(found, date)

    def edit(text: str, path: Path) -> str:
        # Without a calibration the effects are those of the file.
        plain = text if found.refused else with_effects_section(text, effects_to_values(effects), path)
        return with_values(plain, values, f'Calibrated by {source_of(found, date)}', path)

    return rig_file(
        params_file, 'rig.yaml', lambda: model_yaml(rig, effects_of_rig(rig) if found.refused else effects), edit
    )


def _check(args: argparse.Namespace) -> int:
    rig = load_rig(args.check)
    if not is_calibrated(rig):
        raise ConfigError(f'{args.check}: calibration.names: not there; --check takes the rig.yaml of a calibration')
    with told('checking', quiet=args.quiet or args.json):
        found = checking.check(_runs_of(args, rig), rig, alone=args.alone)
    if args.json:
        print_json(checking.result(found), indent=1)
        return 0
    show(checking.sentence(found))
    worst = int(abs(found.zero / found.zero_sd).argmax())
    show(
        f'unloaded readings against the file (um): {", ".join(f"{v * 1e6:+.1f}" for v in found.zero)} '
        f'± {found.zero_sd[worst] * 1e6:.1g}; ~/zero takes them anew'
    )
    return 0
