"""Compare the estimates of a recording with an independent reference: a camera, a stage, a laser tracker.

The reference is in the recording (topic /reference/deflection, CSV columns ref_dx, ref_dy, ref_theta), or in a
file of its own: the table that `psd-deflection camera` writes, or another recording. The offset between
the two clocks is found from the motion and told with its 95 % interval; --align removes it. Every solver that can
solve the rig is compared: bias, scale, noise, largest difference. --out writes a page with pictures
and validate.json.

  psd-deflection validate recordings/run
  psd-deflection validate run.csv --reference camera.csv --align --out validated
  psd-deflection validate run.csv --params-file calibrated.yaml --json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.cli._options import make_folder, namespace_option, number
from psd_deflection.cli._progress import told
from psd_deflection.cli._report import columns, print_json, save, show, show_text
from psd_deflection.cli._seen import opened, seen_in
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.solvers.registry import SOLVERS, solver_from_rig
from psd_deflection.recordings.read.references import read_references, references_of
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.validate.agreement import validate
from psd_deflection.studies.validate.motion import Motion, Solve
from psd_deflection.studies.validate.report import as_json, report_html, rows, sentences


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help='use this rig instead of the parameters in the recording'
    )
    parser.add_argument(
        '--reference', metavar='FILE', help='a table t,dx,dy,theta or another recording (default: in REC)'
    )
    parser.add_argument('--align', action='store_true', help='remove the offset between the clocks before comparing')
    parser.add_argument(
        '--max-offset',
        type=number('--max-offset', 0.001, 3600.0),
        default=1.0,
        metavar='S',
        help='offset between the clocks that is looked for, s (default 1)',
    )
    parser.add_argument(
        '--exposure',
        type=number('--exposure', 0.0, 1.0),
        default=0.0,
        metavar='S',
        help='time over which each reference is a mean, s: the exposure of a camera (default 0)',
    )
    parser.add_argument('--out', metavar='DIR', help='write report.html and validate.json into this folder')
    namespace_option(parser)
    parser.add_argument('--json', action='store_true', help='print the figures as JSON in SI units')


def run(args: argparse.Namespace) -> int:
    """Compare."""
    if args.out is not None:
        make_folder(args.out)
    recording, rig = opened(args)
    references = references_of(recording) if args.reference is None else read_references(args.reference)
    seen = seen_in(recording, rig, quiet=args.json)
    solvers = _solvers(rig)
    start = int(seen.t_ns[0])
    with told('comparing', quiet=args.json):
        motion = Motion(
            _seconds(seen.t_ns, start),
            seen.dots,
            1.0 / rig.converter.sample_rate_hz,
            solvers[rig.estimator.solver],
        )
        found = validate(
            motion,
            solvers,
            _seconds(references.t_ns, start),
            references.poses,
            references.sd,
            seen.estimate_sd,
            align=args.align,
            largest=args.max_offset,
            exposure=args.exposure,
        )
    solver = rig.estimator.solver
    answer = as_json(found, solver, references.refused)
    if args.json:
        print_json(answer)
    else:
        show(*sentences(found, solver, references.refused), '')
        show_text(columns(rows(found), left=3))
    if args.out is not None:
        sources = {
            'recording': args.recording,
            'reference': args.reference or args.recording,
            'rig': args.params_file or 'the parameters in the recording',
        }
        out = Path(args.out)
        save(report_html(found, solver, references.refused, sources).encode(), out / 'report.html')
        save((json.dumps(answer, indent=1) + '\n').encode(), out / 'validate.json')
        show(f'wrote {out / "report.html"} and {out / "validate.json"}', aside=args.json)
    return 0


def _seconds(t_ns: IntArray, start_ns: int) -> FloatArray:
    seconds: FloatArray = (t_ns - start_ns).astype(np.float64) * 1e-9
    return seconds


def _solvers(rig: Rig) -> dict[str, Solve]:
    """Every solver that can solve the rig, the rig's first."""
    variances = dot_noise_variances(rig) / rig.estimator.block_size
    out: dict[str, Solve] = {}
    for name in dict.fromkeys([rig.estimator.solver, *SOLVERS]):
        try:
            out[name] = _solve(name, rig, variances)
        except (SolverError, ConfigError):
            if name == rig.estimator.solver:
                raise
    return out


def _solve(name: str, rig: Rig, variances: FloatArray) -> Solve:
    solver = solver_from_rig(name, rig)

    def solve(dots: FloatArray) -> FloatArray:
        found = solver.solve_many(dots, variances)
        poses = found.pose.copy()
        poses[found.status != 0] = float('nan')
        return poses

    return solve
