"""List every parameter with unit, bounds, default and what it is for.

With --params-file the values of that file are shown and checked, also against each other: unknown solvers and
effects, and a geometry that cannot be solved, are refused.

  psd-deflection params
  psd-deflection params --params-file my_rig.yaml --json
"""

from __future__ import annotations

import argparse

from psd_deflection.cli._report import print_json, show
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.declarations import PARAMETERS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--params-file', metavar='RIG.yaml', help='a ROS 2 parameter file')
    parser.add_argument('--json', action='store_true', help='for programs: one JSON object, name to value')


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    rig = load_rig(args.params_file)
    if args.params_file is not None:
        # It makes the solvers and the effects, and refuses what cannot be evaluated.
        Pipeline(rig)
    if args.json:
        print_json(dict(rig.values), indent=2)
        return 0
    for p in PARAMETERS:
        bounds = p.bound_text()
        unit = f' {p.unit}' if p.unit else ''
        show(f'{p.name} = {rig.values[p.name]}{unit}')
        show(f'    {p.description}' + (f' ({bounds})' if bounds else ''))
    return 0
