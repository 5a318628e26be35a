# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write a calibration certificate: the expanded uncertainty of a calibrated rig at stated poses, with all its inputs.

CALIBRATION is the folder that `psd-deflection calibrate --out` wrote, by a reference. DIR gets certificate.html (to be
printed and signed), certificate.json, and the tables from which each U can be computed again in a spreadsheet:
inputs.csv, correlations.csv, results.csv.

What acts after the calibration (drift, air, noise) and the scale of the reference are inputs as those of
`psd-deflection budget`: --set NAME=VALUE, or a file of them. Serial numbers, surroundings, the reference's own
certificate and names are fields: --fields takes a YAML file of NAME: WORDS lines; what is left out is for a pen.

  psd-deflection certificate calibrated --out certificate
  psd-deflection certificate calibrated --out c --set reference_scale=2e-5
  psd-deflection certificate calibrated --out c --pose 0 -0.002 0.01
  psd-deflection certificate calibrated --out c --limit 5e-5 5e-5 1e-3
"""

import argparse
from pathlib import Path

from psd_deflection.base.text import plain_number
from psd_deflection.cli._options import make_writable
from psd_deflection.cli._values import given_as_option, need_finite
from psd_deflection.cli.studies._answer import answer
from psd_deflection.cli.studies.budget import settings_of
from psd_deflection.studies.budget.certificate import CertificateProblem, certify
from psd_deflection.studies.budget.certificate_page import Certified, read_calibration, read_fields
from psd_deflection.studies.budget.inputs import INPUTS, REFERENCE_INPUTS, read_inputs

DECLARED = (*INPUTS, *REFERENCE_INPUTS)
_AXES = ('DX', 'DY', 'THETA')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('calibration', metavar='CALIBRATION', help='the folder of a calibration by a reference')
    parser.add_argument('--out', metavar='DIR', required=True, help='folder for the certificate and its tables')
    parser.add_argument(
        '--pose',
        type=plain_number,
        nargs=3,
        action='append',
        default=[],
        metavar=_AXES,
        help='a pose to state U at, m, m, rad; repeatable (default: at rest and the ends of what the calibration saw)',
    )
    parser.add_argument(
        '--limit', type=plain_number, nargs=3, metavar=_AXES, help='largest errors that are allowed, m, m, rad'
    )
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE', help='set one input; repeatable')
    parser.add_argument('--inputs', metavar='FILE.yaml', help='a file of inputs')
    parser.add_argument('--fields', metavar='FILE.yaml', help='serial numbers, surroundings, reference, names')
    parser.add_argument('--json', action='store_true', help='print the content of certificate.json')


def run(args: argparse.Namespace) -> int:
    """Compute and write."""
    folder = Path(args.calibration)
    rig, tree = read_calibration(folder)
    fields = read_fields(args.fields)
    read_inputs(args.inputs, {}, declared=DECLARED)
    with given_as_option():
        inputs = read_inputs(args.inputs, settings_of(args.set), '--set', DECLARED)
    for pose in args.pose:
        need_finite('--pose', pose)
    limits = None
    if args.limit is not None:
        need_finite('--limit', args.limit)
        limits = tuple(abs(v) for v in args.limit)
    make_writable(args.out)
    poses = [tuple(pose) for pose in args.pose]
    with given_as_option('pose'):
        problem = CertificateProblem(rig, tree, inputs, poses, limits, fields, str(folder / 'rig.yaml'))
        certificate = certify(problem)
    return answer(args, Certified(certificate, problem))
