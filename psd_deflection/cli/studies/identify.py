"""Find the modes of the link in a recording: frequencies, damping ratios, and the input shaper that does not ring them.

Record a few seconds in which the link rings: release a load, or knock on the link. Stretches in which it
rings alone are found without knowing the loads. If it never does, the spectrum of its motion in operation is
fitted instead, with wider intervals. --out writes a page with spectra, ring-downs and shapers, identify.json, and
rig.yaml with the modes in it.

  psd-deflection identify recordings/run
  psd-deflection identify run.csv --params-file my_rig.yaml --out modes
  psd-deflection identify run.csv --json
"""

from __future__ import annotations

import argparse
import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from psd_deflection import __version__
from psd_deflection.cli._options import make_folder, namespace_option
from psd_deflection.cli._progress import told
from psd_deflection.cli._report import print_json, save, show
from psd_deflection.cli._rig_file import rig_file
from psd_deflection.cli._seen import opened, seen_in
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.model.solvers.registry import solver_from_rig
from psd_deflection.recordings.read.grid import digest_of
from psd_deflection.recordings.recording import Recording
from psd_deflection.rig.config import Rig
from psd_deflection.rig.parameter_files import with_values
from psd_deflection.studies.discover.result import model_yaml
from psd_deflection.studies.identify.modes import modes_of
from psd_deflection.studies.identify.report import Identified, as_json, report_html, sentences


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help='use this rig instead of the parameters in the recording'
    )
    parser.add_argument('--out', metavar='DIR', help='write report.html, identify.json and rig.yaml into this folder')
    namespace_option(parser)
    parser.add_argument('--json', action='store_true', help='print the modes as JSON in SI units')


def run(args: argparse.Namespace) -> int:
    """Identify."""
    if args.out is not None:
        make_folder(args.out)
    recording, rig = opened(args)
    seen = seen_in(recording, rig, quiet=args.json)
    with told('looking for modes', quiet=args.json):
        rate = rig.converter.sample_rate_hz
        solver = solver_from_rig(rig.estimator.solver, rig)
        solved = solver.solve_many(seen.dots, dot_noise_variances(rig))
        place = np.rint((seen.t_ns - seen.t_ns[0]) * 1e-9 * rate).astype(np.int64)
        poses = np.full((int(place[-1]) + 1, 3), np.nan)
        good = solved.status == 0
        poses[place[good]] = solved.pose[good]
        x, y, twist = (modes_of(poses[:, i], rate) for i in range(3))
        found = Identified(poses, rate, (x, y, twist))
    answer = as_json(found)
    if args.json:
        print_json(answer)
    else:
        show(*sentences(found))
        if found.values:
            show('', 'Lines for the rig file, below ros__parameters:', '')
            show(*(f'    {name}: {value:g}' for name, value in found.values.items()))
    if args.out is not None:
        out = Path(args.out)
        sources = {'recording': args.recording, 'rig': args.params_file or 'the parameters in the recording'}
        with told('drawing', quiet=args.json):
            page = report_html(found, sources)
        save(page.encode(), out / 'report.html')
        save((json.dumps(answer, indent=1) + '\n').encode(), out / 'identify.json')
        save(_rig_yaml(args.params_file, rig, found, recording).encode(), out / 'rig.yaml')
        show(f'wrote report.html, identify.json and rig.yaml into {out}', aside=args.json)
    return 0


def _rig_yaml(params_file: str | None, rig: Rig, found: Identified, recording: Recording) -> str:
    """The user's parameter file with the modes, comments kept; without one what describes the rig."""
    date = datetime.now(UTC).date().isoformat()
    name, digest = recording.path.name, digest_of(recording.path)
    source = f'Identified by psd-deflection {__version__}, {date}, from {name} (sha256 {digest[:16]})'

    def edit(text: str, path: Path) -> str:
        return with_values(text, found.values, source, path)

    return rig_file(params_file, 'rig.yaml', lambda: model_yaml(rig, effects_of_rig(rig)), edit)
