# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute the error budget of a rig: how much each cause adds to the error of ΔX, ΔY and θ.

The causes are those of the thesis's Table 3.1, with corrected equations, and those that it leaves
out. Numbers are standard deviations, except for known biases: errors that follow from the pose
because the method ignores something. Percentages are shares of the mean square of the total.

  psd-deflection budget --params-file config/thesis_rig.yaml --out budget
  psd-deflection budget --set rotation_tolerance=0.001 --method beam --json
  psd-deflection budget --explain

Inputs that are not in the rig file have defaults (--explain lists them with their sources); set them
with --set NAME=VALUE, or keep them in a YAML file of NAME: VALUE lines (--inputs).
"""

import argparse
import contextlib
import math
from pathlib import Path

from tqdm import tqdm

from psd_deflection.base.axes import MDEG
from psd_deflection.base.errors import UsageError
from psd_deflection.base.text import plain_number
from psd_deflection.cli._options import PICTURES, make_writable, need_folder, picture_or_folder, reject
from psd_deflection.cli._report import save_figure, show, show_text
from psd_deflection.cli._values import given_as_option, integer, need_finite, seed
from psd_deflection.cli.studies._answer import answer, print_answer
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.budget import sensor
from psd_deflection.studies.budget.budget import BudgetProblem, budget
from psd_deflection.studies.budget.chain import METHODS
from psd_deflection.studies.budget.evaluate import CAUSES, stop_window
from psd_deflection.studies.budget.inputs import INPUTS, read_inputs
from psd_deflection.studies.budget.installation import averaging_gain

MAX_DRAWS = 10_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--params-file', metavar='RIG.yaml', help='a ROS 2 parameter file (default: the thesis rig)')
    parser.add_argument(
        '--load',
        type=plain_number,
        nargs=3,
        metavar=('FX', 'FY', 'TZ'),
        help='tip load at which the errors are computed, N, N, N m (default: a weight on a sidebar as long as the '
        'link: 50 N for the thesis rig, else one that uses half of the active area)',
    )
    parser.add_argument(
        '--method', choices=METHODS, help='method whose errors are computed (default: that of the rig file)'
    )
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE', help='set one input; repeatable')
    parser.add_argument('--inputs', metavar='FILE.yaml', help='a file of inputs')
    parser.add_argument(
        '--monte-carlo',
        type=integer('--monte-carlo', 100, MAX_DRAWS),
        metavar='N',
        help='check the totals with N random draws of all causes (at least 100)',
    )
    parser.add_argument('--seed', type=seed, default=1, help='seed of the random draws (default 1)')
    parser.add_argument(
        '--out',
        type=picture_or_folder(*PICTURES),
        metavar='DIR|FILE.png|svg|pdf',
        help='write report.html and budget.json into this folder, or draw the chart alone',
    )
    parser.add_argument('--json', action='store_true', help='print JSON in SI units')
    parser.add_argument('--explain', action='store_true', help='print formulas, inputs and their sources, and stop')


def run(args: argparse.Namespace) -> int:
    """Print the table; draw the chart if a name is given."""
    if args.explain:
        reject(args, {'json': False, 'out': None, 'monte_carlo': None, 'load': None}, 'does nothing beside --explain')
    rig = load_rig(args.params_file)
    # Of the file alone first, so that what is wrong in it is not laid to the options.
    read_inputs(args.inputs, {})
    with given_as_option():
        inputs = read_inputs(args.inputs, settings_of(args.set), '--set')
    if args.explain:
        show_text(explain(rig, inputs))
        return 0
    load = tuple(args.load) if args.load else None
    if load is not None:
        need_finite('--load', load)
    chart_alone = args.out is not None and Path(args.out).suffix.lower() in PICTURES and not Path(args.out).is_dir()
    if chart_alone:
        need_folder(Path(args.out))
    elif args.out is not None:
        make_writable(args.out)
    draws = args.monte_carlo or 0
    hidden = True if args.json or not draws else None
    with (
        given_as_option('load') if args.load or args.set else contextlib.nullcontext(),
        tqdm(total=draws, unit=' draws', delay=1.0, leave=False, disable=hidden, ncols=80) as bar,
    ):
        result = budget(
            BudgetProblem(rig, inputs, load, args.method, draws, args.seed, args.params_file or ''), bar.update
        )
    if not chart_alone:
        return answer(args, result)
    print_answer(args, result)
    save_figure(result.plot(), Path(args.out), dpi=150)
    if not args.json:
        show('', args.out)
    return 0


def settings_of(pairs: list[str]) -> dict[str, object]:
    """What --set gave, by name. Raises UsageError."""
    out: dict[str, object] = {}
    for pair in pairs:
        name, equals, value = pair.partition('=')
        if not equals:
            raise UsageError(f'--set {pair}: must be NAME=VALUE')
        out[name.strip()] = value.strip()
    return out


def explain(rig: Rig, inputs: dict[str, float]) -> str:
    """Every term with its formula, every input with value, unit, bounds and source, and what follows from them."""
    lines = [
        'Terms: name (row of Table 3.1), kind: deviation of each error parameter, before it goes through the model'
    ]
    for cause in CAUSES:
        row = f' ({cause.row})' if cause.row else ''
        lines.append(f'  {cause.name}{row}, {cause.kind.value}: {cause.formula}')
    lines += ['', 'Inputs: name = value unit: what it is (bounds); source of the default']
    for entry in INPUTS:
        p = entry.parameter
        unit = f' {p.unit}' if p.unit else ''
        lines.append(f'  {p.name} = {inputs[p.name]:g}{unit}: {p.description} ({p.bound_text()}); {entry.source}')
    return '\n'.join([*lines, '', 'From these:', *_derived(rig, inputs)])


def _derived(rig: Rig, inputs: dict[str, float]) -> list[str]:
    """Intermediate results of chapter 3 at these inputs."""
    length, temperature, wavelength = rig.link.length, inputs['temperature'], inputs['laser_wavelength']
    spot = sensor.beam_diameter(inputs['laser_diameter'], wavelength, length)
    index = sensor.air_index(sensor.STANDARD_PRESSURE, temperature, wavelength=wavelength)
    per_kelvin = sensor.index_per_kelvin(temperature, wavelength)
    per_gradient = sensor.gradient_shift(abs(per_kelvin), length)
    warm = sensor.air_index(sensor.STANDARD_PRESSURE, temperature + inputs['air_step'], wavelength=wavelength)
    step = sensor.boundary_shift(inputs['air_step_angle'], index, warm, length)
    rate, block = rig.converter.sample_rate_hz, rig.estimator.block_size
    hum = averaging_gain(block, inputs['interference_frequency'], rate)
    noise = rig.noises[:, :2] * rig.sensitivities
    window = stop_window(rig.centers + rig.zeros, inputs['iteration_tolerance'])
    return [
        f'  spot on the sensor (3.1): {spot * 1e3:.4f} mm',
        f'  index of air (3.3) at 50 % humidity: {index:.9f}, dn/dT {per_kelvin:.3e} 1/K',
        f'  shift by a gradient across the beam: {per_gradient * 1e6:.3f} µm per K/m',
        f'  shift behind a boundary (3.4): {step * 1e6:.3f} µm',
        f'  noise of a dot: {_each(noise, 3)} µm a sample, {_each(noise / math.sqrt(block), 3)} µm a mean of {block}',
        f'  step of the converter: {_each(rig.converter.volts_per_count * rig.sensitivities, 4)} µm',
        f'  hum that a mean of {block} leaves at {inputs["interference_frequency"]:g} Hz: {hum:.3f}',
        f'  stop window of thesis_iteration: {window * MDEG:.2f} mdeg',
    ]


def _each(metres: FloatArray, digits: int) -> str:
    """The values of x1, y1, x2, y2 in µm; one if all are the same."""
    words = [f'{value * 1e6:.{digits}f}' for value in metres.ravel()]
    return words[0] if len(set(words)) == 1 else ', '.join(words)
