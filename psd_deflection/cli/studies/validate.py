# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compare the estimates of a recording with an independent reference: a camera, a stage, a laser tracker.

The reference is in the recording (topic /reference/deflection, CSV columns ref_dx, ref_dy, ref_theta), or in a
file of its own: the table that `psd-deflection camera` writes, or another recording. The offset between
the two clocks is found from the motion and told with its 95 % interval; --align removes it. Bias, scale, noise and
largest difference are those of the rig's solver; --solver adds another one, or all. --out writes a page with pictures
and validate.json.

  psd-deflection validate recordings/run
  psd-deflection validate run.csv --reference camera.csv --align --out validated
  psd-deflection validate run.csv --params-file calibrated.yaml --json
  psd-deflection validate run.csv --solver beam --solver wls
"""

import argparse

from psd_deflection.cli._progress import stage
from psd_deflection.cli._values import number
from psd_deflection.cli.studies._answer import answer, answer_arguments, opened_recording, progress, recording_arguments
from psd_deflection.model.solvers.registry import SOLVERS
from psd_deflection.studies.validate.validate import ALL, read_validate, validate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    recording_arguments(parser)
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
    parser.add_argument(
        '--solver',
        action='append',
        default=[],
        choices=(*SOLVERS, ALL),
        metavar='NAME',
        help="compare this solver beside the rig's; repeatable; all: every one that can solve the rig",
    )
    answer_arguments(parser, 'report.html and validate.json')


def run(args: argparse.Namespace) -> int:
    """Compare."""
    problem = read_validate(
        opened_recording(args),
        args.reference,
        align=args.align,
        largest=args.max_offset,
        exposure=args.exposure,
        solvers=args.solver,
        with_progress=progress(args),
    )
    with stage('comparing', quiet=args.json):
        comparison = validate(problem)
    return answer(args, comparison)
