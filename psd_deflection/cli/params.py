# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""List every parameter with unit, bounds, default and what it is for.

With --short only those that a rig of one's own needs. With --params-file the values of that file are
shown and checked, also against each other: unknown solvers and
effects, and a geometry that cannot be solved, are rejected.

  psd-deflection params
  psd-deflection params --short
  psd-deflection params --params-file my_rig.yaml --json
"""

import argparse

from psd_deflection.cli._report import print_json, show
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.declarations import PARAMETERS

NEEDED = (
    *('source', 'port', 'link.length', 'link.outer_radius', 'link.inner_radius', 'link.youngs_modulus'),
    *('link.shear_modulus', 'psd_1.center', 'psd_2.center', 'amplifier.sensitivity', 'amplifier.noise'),
    *('converter.bits', 'converter.sample_rate_hz', 'dynamics.bending_frequency', 'dynamics.torsion_frequency'),
)
"""Without these no rig but that of the thesis is described."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--params-file', metavar='RIG.yaml', help='a ROS 2 parameter file')
    parser.add_argument('--short', action='store_true', help="only those that a rig of one's own needs")
    parser.add_argument('--json', action='store_true', help='for programs: one JSON object, name to value')


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    rig = load_rig(args.params_file)
    if args.params_file is not None:
        # It makes the solvers and the effects, and rejects what cannot be evaluated.
        Pipeline(rig)
    shown = [p for p in PARAMETERS if p.name in NEEDED or not args.short]
    if args.json:
        print_json({p.name: rig.values[p.name] for p in shown} if args.short else dict(rig.values), indent=2)
        return 0
    for p in shown:
        bounds = p.bound_text()
        unit = f' {p.unit}' if p.unit else ''
        show(f'{p.name} = {rig.values[p.name]}{unit}')
        show(f'    {p.description}' + (f' ({bounds})' if bounds else ''))
    return 0
