"""Compute the error budget of a rig: how much each cause adds to the error of ΔX, ΔY and θ.

The causes are those of the thesis's Table 3.1, with corrected equations, and those that it leaves
out. Numbers are standard deviations, except for known biases: errors that follow from the pose
because the method ignores something. Percentages are shares of the mean square of the total.

  psd-deflection budget --params-file config/thesis_rig.yaml --out budget.png
  psd-deflection budget --set rotation_tolerance=0.001 --method beam --json
  psd-deflection budget --explain

Inputs that are not in the rig file have defaults (--explain lists them with their sources); set them
with --set NAME=VALUE, or keep them in a YAML file of NAME: VALUE lines (--inputs).
"""

from __future__ import annotations

import argparse
import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from psd_deflection.base.errors import UsageError
from psd_deflection.base.tables import columns
from psd_deflection.cli._options import (
    PICTURES,
    given_as_option,
    need_finite,
    need_folder,
    picture_name,
    refuse,
    seed,
    whole,
)
from psd_deflection.cli._report import print_json, save_figure, show, show_text
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.budget import optics
from psd_deflection.studies.budget.computation import stop_window
from psd_deflection.studies.budget.environment import averaging_gain
from psd_deflection.studies.budget.estimate import METHODS, method_of
from psd_deflection.studies.budget.evaluate import CAUSES, Budget, evaluate, monte_carlo
from psd_deflection.studies.budget.inputs import INPUTS, read_inputs
from psd_deflection.studies.budget.load import default_load
from psd_deflection.studies.budget.term import Contribution, Kind, Situation

MICRO_MILLIDEGREE = np.array([1e6, 1e6, math.degrees(1e3)])

MAX_DRAWS = 10_000_000

KINDS = {Kind.PER_ESTIMATE: 'per estimate', Kind.SYSTEMATIC: 'systematic', Kind.KNOWN: 'known bias'}

# Okabe & Ito: told apart by a colour-blind reader too.
COLOURS = {Kind.PER_ESTIMATE: '#56B4E9', Kind.SYSTEMATIC: '#E69F00', Kind.KNOWN: '#999999'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--params-file', metavar='RIG.yaml', help='a ROS 2 parameter file (default: the thesis rig)')
    parser.add_argument(
        '--load',
        type=float,
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
        type=whole('--monte-carlo', 100, MAX_DRAWS),
        metavar='N',
        help='check the totals with N random draws of all causes (at least 100)',
    )
    parser.add_argument('--seed', type=seed, default=1, help='seed of the random draws (default 1)')
    parser.add_argument(
        '--out',
        type=picture_name(*PICTURES),
        metavar='FILE.png|svg|pdf',
        help='draw the chart',
    )
    parser.add_argument('--json', action='store_true', help='print JSON in SI units')
    parser.add_argument('--explain', action='store_true', help='print formulas, inputs and their sources, and stop')


def run(args: argparse.Namespace) -> int:
    """Print the table; draw the chart if a name is given."""
    if args.explain:
        refuse(args, {'json': False, 'out': None, 'monte_carlo': None, 'load': None}, 'does nothing beside --explain')
    rig = load_rig(args.params_file)
    # Of the file alone first, so that what is wrong in it is not laid to the options.
    read_inputs(args.inputs, {})
    with given_as_option():
        inputs = read_inputs(args.inputs, _settings(args.set), '--set')
    if args.explain:
        show_text(explain(rig, inputs))
        return 0
    method = args.method or method_of(rig)
    load = tuple(args.load) if args.load else default_load(rig)
    need_finite('--load', load)
    if args.out is not None:
        need_folder(Path(args.out))
    with given_as_option('load') if args.load or args.set else contextlib.nullcontext():
        budget = evaluate(Situation.at_load(rig, inputs, load, method))
    draws = args.monte_carlo
    sampled = None
    if draws is not None:
        hidden = True if args.json else None
        with tqdm(total=draws, unit=' draws', delay=1.0, leave=False, disable=hidden, ncols=80) as bar:
            sampled = monte_carlo(budget.at, draws, args.seed, drawn=bar.update)
    if args.json:
        print_json(as_json(budget, load, sampled), indent=1)
    else:
        show_text(table(budget, load))
        if sampled is not None:
            show('', f'Monte Carlo, {draws} draws of everything at once (seed {args.seed}):')
            show('total     ' + _figures_text(sampled))
    if args.out is not None:
        draw_terms(budget, Path(args.out))
        if not args.json:
            show('', args.out)
    return 0


def _settings(pairs: list[str]) -> dict[str, object]:
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
        lines.append(f'  {cause.name}{row}, {KINDS[cause.kind]}: {cause.formula}')
    lines += ['', 'Inputs: name = value unit: what it is (bounds); source of the default']
    for entry in INPUTS:
        p = entry.parameter
        unit = f' {p.unit}' if p.unit else ''
        lines.append(f'  {p.name} = {inputs[p.name]:g}{unit}: {p.description} ({p.bound_text()}); {entry.source}')
    return '\n'.join([*lines, '', 'From these:', *_derived(rig, inputs)])


def _derived(rig: Rig, inputs: dict[str, float]) -> list[str]:
    """Intermediate results of chapter 3 at these inputs."""
    length, temperature, wavelength = rig.link.length, inputs['temperature'], inputs['laser_wavelength']
    spot = optics.beam_diameter(inputs['laser_diameter'], wavelength, length)
    index = optics.air_index(optics.STANDARD_PRESSURE, temperature, wavelength=wavelength)
    per_kelvin = optics.index_per_kelvin(temperature, wavelength)
    per_gradient = optics.gradient_shift(abs(per_kelvin), length)
    warm = optics.air_index(optics.STANDARD_PRESSURE, temperature + inputs['air_step'], wavelength=wavelength)
    step = optics.boundary_shift(inputs['air_step_angle'], index, warm, length)
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
        f'  stop window of thesis_iteration: {math.degrees(window) * 1e3:.2f} mdeg',
    ]


def _each(metres: FloatArray, digits: int) -> str:
    """The values of x1, y1, x2, y2 in µm; one if all are the same."""
    words = [f'{value * 1e6:.{digits}f}' for value in metres.ravel()]
    return words[0] if len(set(words)) == 1 else ', '.join(words)


def table(budget: Budget, load: tuple[float, ...]) -> str:
    """The budget as text."""
    at = budget.at
    dx, dy, theta = at.pose.tolist()
    rows = [['term', 'Table 3.1', 'kind', 'ΔX µm', 'ΔY µm', 'θ mdeg', 'ΔX %', 'ΔY %', 'θ %']]
    for cause, line in budget.lines:
        shares = [f'{100.0 * v:.1f}' for v in budget.shares(line).tolist()]
        rows.append([cause.name, cause.row or '-', KINDS[cause.kind], *_figures(line), *shares])
    totals = [['', 'ΔX µm', 'ΔY µm', 'θ mdeg']]
    totals += [[f'all {name} terms', *_figures(budget.total(kind))] for kind, name in KINDS.items()]
    totals.append(['total', *_figures(budget.total())])
    samples = at.rig.estimator.block_size
    return (
        f'Load ({load[0]:g} N, {load[1]:g} N, {load[2]:g} N m): ΔX {dx * 1e3:.4f} mm, ΔY {dy * 1e3:.4f} mm, '
        f'θ {math.degrees(theta):.4f} deg; method {at.method}; mean of {samples} samples\n\n'
        + columns(rows, left=3)
        + '\n\n'
        + columns(totals)
    )


def _figures(line: Contribution) -> list[str]:
    return [f'{v:.3f}' for v in (line.rms * MICRO_MILLIDEGREE).tolist()]


def _figures_text(line: Contribution) -> str:
    dx, dy, theta = _figures(line)
    return f'ΔX {dx} µm  ΔY {dy} µm  θ {theta} mdeg'


def as_json(budget: Budget, load: tuple[float, ...], sampled: Contribution | None) -> dict[str, Any]:
    """The budget for another program: SI, (ΔX, ΔY, θ) in this order."""

    def figures(line: Contribution) -> dict[str, Any]:
        return {'rms': line.rms.tolist(), 'bias': line.bias.tolist(), 'covariance': line.covariance.tolist()}

    totals = {kind.name.lower(): figures(budget.total(kind)) for kind in Kind}
    totals['total'] = figures(budget.total())
    if sampled is not None:
        totals['monte_carlo'] = figures(sampled)
    return {
        'unit': ['m', 'm', 'rad'],
        'load': list(load),
        'pose': budget.at.pose.tolist(),
        'method': budget.at.method,
        'terms': [
            {
                'name': cause.name,
                'row': cause.row,
                'kind': cause.kind.name.lower(),
                'formula': cause.formula,
                'inputs': {name: budget.at[name] for name in cause.inputs},
                **figures(line),
                'share': budget.shares(line).tolist(),
            }
            for cause, line in budget.lines
        ],
        'totals': totals,
    }


def draw_terms(budget: Budget, path: Path) -> None:
    """Bars of every term, largest first, beside the total, written to ``path``."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    total = budget.total().rms * MICRO_MILLIDEGREE
    # What does nothing, or only rounds, has no place on a logarithmic axis.
    least = 1e-9 * budget.total().rms
    lines = [(c, line.rms * MICRO_MILLIDEGREE) for c, line in budget.lines if np.any(line.rms > least)]
    lines.sort(key=lambda entry: float(np.max(entry[1] / np.where(total > 0.0, total, 1.0))))
    names = [f'{c.name} ({c.row})' if c.row else c.name for c, _ in lines]
    figure = Figure(figsize=(11.0, 0.28 * len(lines) + 1.8), layout='constrained')
    panels: Any = figure.subplots(1, 3, sharey=True)
    titles = ('ΔX, µm', 'ΔY, µm', 'θ, mdeg')
    for panel, title, index in zip(panels, titles, range(3), strict=True):
        values = [v[index] for _, v in lines]
        panel.barh(names, values, color=[COLOURS[c.kind] for c, _ in lines])
        panel.axvline(total[index], color='black', linewidth=1.0)
        panel.text(total[index], len(lines) - 0.4, f' {total[index]:.3g}', ha='right', va='bottom', fontsize=9)
        panel.set(xscale='log', xlabel=title, xlim=(total[index] * 1e-3, total[index] * 2.0))
        panel.grid(axis='x', alpha=0.3)
        panel.set_axisbelow(True)
    handles = [Patch(color=COLOURS[kind], label=name) for kind, name in KINDS.items()]
    handles.append(Patch(facecolor='white', edgecolor='black', label='total (line)'))
    figure.legend(handles=handles, loc='outside lower center', ncols=4, frameon=False)
    figure.suptitle(f'Error budget, method {budget.at.method}: standard deviation or known bias')
    save_figure(figure, path, dpi=150)
