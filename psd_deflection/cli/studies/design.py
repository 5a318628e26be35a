# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute the stiffness of a link and compare sensor placements.

Without --params-file it recomputes Tables B1 and B2 of the thesis and explains every difference.
With it, it prints the stiffness of the rig's link and searches for the placement of the two sensors
with the smallest errors, inside the space that --radius, --keep-out and --box allow (m, in the
frame link_tip). With --splitter it asks instead whether two lasers over one beam splitter keep the
three rules of the thesis (5.4), and simulates the failure of one, with the other beside it or as a cold spare.

  psd-deflection design
  psd-deflection design --params-file config/thesis_rig.yaml --out placement.png
  psd-deflection design --params-file config/thesis_rig.yaml --json
  psd-deflection design --splitter 1e-3 1e-3 --allowed 1e-3
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from psd_deflection.base.axes import MDEG
from psd_deflection.base.errors import UsageError
from psd_deflection.base.plugins import optional
from psd_deflection.base.tables import columns
from psd_deflection.base.text import plain_number
from psd_deflection.cli._options import PICTURES, need_folder, picture_name, reject
from psd_deflection.cli._report import print_json, save_figure, show, show_text
from psd_deflection.cli._values import given_as_option
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.link.section import TubeSection
from psd_deflection.model.plate import placement
from psd_deflection.model.plate.linear import condition_number, design_matrix
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, check_two_psds, load_rig
from psd_deflection.studies import scaling, splitter

TILTED = np.array([0.0, 0.0, 0.0, math.radians(0.3), math.radians(0.1)])
"""Where observability of tilt is stated: φ 0.3 deg, ω 0.1 deg. At rest coplanar sensors see none."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--params-file', metavar='RIG.yaml', help='ROS 2 parameter file with the rig')
    parser.add_argument(
        '--sigma',
        type=plain_number,
        metavar='M',
        help='standard deviation of a dot reading, m (default: amplifier noise of a block mean)',
    )
    parser.add_argument(
        '--radius',
        type=plain_number,
        metavar='M',
        help='sensor centres at most this far from the tip centre, m (default: as in the rig)',
    )
    parser.add_argument(
        '--keep-out',
        type=plain_number,
        default=0.0,
        metavar='M',
        help='sensor centres at least this far from it, m (default 0)',
    )
    parser.add_argument(
        '--box',
        type=plain_number,
        nargs=4,
        metavar=('X_MIN', 'Y_MIN', 'X_MAX', 'Y_MAX'),
        help='sensor centres inside this box, m',
    )
    parser.add_argument(
        '--splitter', type=plain_number, nargs=2, metavar=('W', 'W'), help='powers of two lasers over one beam splitter'
    )
    parser.add_argument('--allowed', type=plain_number, metavar='W', help='power that one PSD is allowed to get')
    parser.add_argument(
        '--warm-up', type=plain_number, metavar='S', help='until a cold spare has its power, s (default 1)'
    )
    parser.add_argument(
        '--apart', type=plain_number, metavar='M', help="from laser 1's dot to laser 2's on each PSD, m (default 0.001)"
    )
    parser.add_argument('--out', type=picture_name(*PICTURES), metavar='FILE.png|svg|pdf', help='draw the placements')
    parser.add_argument('--json', action='store_true', help='print link and placements as JSON in SI units')


def run(args: argparse.Namespace) -> int:
    """Print the tables or the study."""
    if args.splitter is not None:
        return splitter_of(args)
    reject(args, {'allowed': None, 'warm_up': None, 'apart': None}, 'is of two lasers: give --splitter W W')
    if args.params_file is None:
        placing = {'out': None, 'sigma': None, 'radius': None, 'keep_out': 0.0, 'box': None, 'json': False}
        reject(args, placing, 'is for the placement of a rig: give --params-file RIG.yaml')
        show_text(appendix_b())
        return 0
    rig = load_rig(args.params_file)
    check_two_psds(rig, 'a placement')
    each = rig.noises[:, :2] * rig.sensitivities
    sigma = float(np.sqrt((each * each).mean() / rig.estimator.block_size))
    if args.sigma is not None:
        sigma = args.sigma
    if not (sigma > 0.0 and math.isfinite(sigma)):
        raise UsageError(f'--sigma = {sigma} m: must be above 0')
    radius = float(np.max(np.hypot(*rig.centers.T))) if args.radius is None else args.radius
    if args.out is not None:
        need_folder(Path(args.out))
    with given_as_option('radius', 'keep_out', 'box'):
        room = placement.Room(radius, args.keep_out, tuple(args.box) if args.box else None)
        candidates = placements(rig, room)
    if args.out is not None:
        draw_placements(candidates, room, rig, Path(args.out))
    if args.json:
        print_json({**design_json(rig, candidates, sigma), 'out': args.out})
        return 0
    show_text(link_text(rig))
    show()
    show_text(placement_text(candidates, sigma))
    show()
    show_text(tilt_text(rig, radius, sigma))
    if budget := optional('psd_deflection.studies.budget.budget'):
        show()
        show_text(tied_text(rig, candidates[-1].centers, sigma, budget.default_load(rig)))
    if args.out is not None:
        show('', args.out)
    return 0


# ---- Two lasers over one beam splitter ----


def splitter_of(args: argparse.Namespace) -> int:
    """Print the rules and the simulation; 1 if a rule is broken."""
    of_placements = {'out': None, 'sigma': None, 'radius': None, 'keep_out': 0.0, 'box': None}
    reject(args, of_placements, 'is for the placement of a rig, not for --splitter')
    if args.allowed is None:
        raise UsageError('--splitter: give --allowed W too, the power that one PSD is allowed to get')
    rig = load_rig(args.params_file)
    with given_as_option('splitter', 'allowed', 'warm_up', 'apart'):
        chosen = {name: value for name in ('warm_up', 'apart') if (value := getattr(args, name)) is not None}
        lasers = splitter.Lasers(tuple(args.splitter), args.allowed, **chosen)
    rules = splitter.rules(rig, lasers)
    phases = splitter.simulated(rig, lasers)
    if args.json:
        lists = ('deviations', 'off', 'scatter')
        shown = [
            {**p._asdict(), 'status': p.status.name, **{name: getattr(p, name).tolist() for name in lists}}
            for p in phases
        ]
        print_json({'rules': [rule.tree() for rule in rules], 'phases': shown})
    else:
        show_text(rules_text(rules))
        show()
        show_text(phases_text(phases))
    return 0 if all(rule.satisfied for rule in rules) else 1


def rules_text(rules: Sequence[splitter.SplitterRule]) -> str:
    """A row for each rule."""
    rows = [['rule', 'is', 'limit', 'unit', 'satisfied']]
    for rule in rules:
        rows.append(
            [rule.words, f'{rule.value:.4g}', f'{rule.limit:.4g}', rule.unit, 'yes' if rule.satisfied else 'NO']
        )
    return columns(rows)


def phases_text(phases: Sequence[splitter.LightPhase]) -> str:
    """A row for each phase of the simulation, and what is said in it."""
    rows = [['simulated', 'blocks', 'ΔX ± µm', 'ΔY ± µm', 'θ ± mdeg', 'ΔX off µm', 'largest, in ±']]
    for p in phases:
        sds = (p.deviations * np.array([1e6, 1e6, MDEG])).tolist()
        numbers = [*(f'{v:.3f}' for v in sds), f'{1e6 * p.off[0]:.1f}', f'{p.largest:.1f}']
        rows.append([p.name, f'{p.estimates:.0%}', *(numbers if p.estimates else ['–'] * 5)])
    message = [f'{p.name}: {p.message}' for p in phases if p.message]
    return '\n'.join([columns(rows), *(['', *message] if message else [])])


# ---- Appendix B ----


def appendix_b() -> str:
    """Tables B1 and B2 beside the thesis's own figures."""
    cells = scaling.table_b1()
    rows = [['case', 'length m', *scaling.COLUMNS]]
    for case in scaling.table_b1_cases():
        row = [f'{case.number} {case.what}', f'{case.link.length:g}']
        for cell in cells:
            if cell.row == str(case.number):
                value = f'{float(scaling.round_as(cell.computed, cell.printed)):.4g}'
                row.append(value if cell.agrees else f'{value} ({float(cell.printed):.4g})')
        rows.append(row)
    table_2 = scaling.table_b2()
    rows_2 = [['material', 'E GPa', 'G GPa', 'TBR = 1.5 E/G', 'thesis']]
    for material, cell in zip(scaling.MATERIALS, table_2, strict=True):
        value = str(scaling.round_as(cell.computed, cell.printed))
        moduli = (f'{material.youngs_modulus / 1e9:g}', f'{material.shear_modulus / 1e9:g}')
        rows_2.append([material.name, *moduli, value, cell.printed])
    errata = [f'  B1 case {c.row}, {c.column}: thesis {c.printed}: {c.erratum}' for c in cells if not c.agrees]
    errata.append(f'  B1 case 1 experimental, D total: thesis 29.45: {scaling.EXPERIMENTAL_ERRATUM}')
    errata += [f'  B2 {c.row}: thesis {c.printed}: {c.erratum}' for c in table_2 if not c.agrees]
    base = scaling.table_b1_cases()[0].link
    exact = scaling.torsion_to_bending_ratio_exact(base, scaling.FORCE)
    poisson = scaling.YOUNGS_MODULUS / (2.0 * scaling.SHEAR_MODULUS) - 1.0
    virtual = scaling.table_b1_cases()[4].link.section.mean_radius
    return '\n'.join(
        [
            f'Table B1: {scaling.FORCE:g} N at D, E {scaling.YOUNGS_MODULUS / 1e9:g} GPa, '
            f'G {scaling.SHEAR_MODULUS / 1e9:g} GPa; I, J m^4; radii, bend m; twist rad; D mm',
            'computed, rounded to the digits of the thesis; what it prints in brackets where that differs',
            '',
            columns(rows),
            '',
            'Table B2: torsion-to-bending ratio of two links of equal length',
            '',
            columns(rows_2),
            '',
            f'With the sine (B-5) the aluminium ratio is {exact:.6f}; with unequal links it is (L_CD/L_BC)^2 as large.',
            f'E/G of its aluminium needs a Poisson ratio of {poisson:.4f}; alloy 6061 has 0.33.',
            f'Twice the length bends as before at a mean radius of {virtual * 1e3:.3f} mm (thesis: "EVD" 29.76 mm).',
            '',
            'Errata:',
            *errata,
        ]
    )


# ---- A rig's placement ----


class PlacementRow(NamedTuple):
    """A placement of two sensors, with what it is."""

    name: str
    centers: FloatArray


def placements(rig: Rig, room: placement.Room) -> list[PlacementRow]:
    """The rig's own placement, the same base line put opposite, and the best that the room holds."""
    centers = rig.centers
    half = float(np.hypot(*(centers[0] - centers[1]))) / 2.0
    return [
        PlacementRow('this rig', centers),
        PlacementRow('same base line, opposite', placement.opposite(half)),
        PlacementRow('best in the room', placement.best_pair(room)),
    ]


def link_text(rig: Rig) -> str:
    """The link in one paragraph."""
    section = TubeSection(rig.link.outer_radius, rig.link.inner_radius)
    statics = LinkStatics.from_rig(rig)
    bend, _, twist = np.diag(statics.compliance).tolist()
    ratio = scaling.torsion_to_bending_ratio(rig.link.youngs_modulus, rig.link.shear_modulus)
    return (
        f'Link: L {rig.link.length:g} m, I {section.second_moment:.4e} m^4, J {section.polar_moment:.4e} m^4, '
        f'area {section.area * 1e6:.1f} mm^2\n'
        f'EI {statics.bending_stiffness:.1f} N m^2, GJ {statics.torsional_stiffness:.1f} N m^2; '
        f'tip {bend * 1e6:.2f} µm/N, {twist * MDEG:.2f} mdeg/(N m); torsion-to-bending ratio {ratio:.3f}'
    )


def design_json(rig: Rig, candidates: list[PlacementRow], sigma: float) -> dict[str, Any]:
    """The link and its placements for programs: m, N, rad; no number for what cannot be seen."""
    statics = LinkStatics.from_rig(rig)
    bend, _, twist = np.diag(statics.compliance).tolist()
    return {
        'link': {
            'bending_stiffness': statics.bending_stiffness,
            'torsional_stiffness': statics.torsional_stiffness,
            'tip_compliance': {'bending': bend, 'torsion': twist},
            'torsion_to_bending_ratio': scaling.torsion_to_bending_ratio(
                rig.link.youngs_modulus, rig.link.shear_modulus
            ),
        },
        'sigma': sigma,
        'placements': [
            {'name': name, 'centers': centers.tolist(), 'sd': _deviation(centers, sigma)._asdict()}
            for name, centers in candidates
        ],
    }


def _deviation(centers: FloatArray, sigma: float) -> placement.PoseDeviations:
    """Infinite where both sensors are at one place: they see no twist then, and nothing that it moves."""
    if math.dist(centers[0], centers[1]) > 0.0:
        return placement.deviations_of_pair(centers, sigma)
    return placement.PoseDeviations(math.inf, math.inf, math.inf)


def placement_text(candidates: list[PlacementRow], sigma: float) -> str:
    """Spreads and condition numbers, and how much the best one gains."""
    head = ['placement', 'c1 mm', 'c2 mm', 'ΔX µm', 'ΔY µm', 'θ mdeg', 'cond (0.1 m rad)', 'cond (m, rad)']
    rows = [head]
    by_choice = []
    for name, centers in candidates:
        s = _deviation(centers, sigma)
        by_choice.append(s)
        if not math.isfinite(s.theta):
            rows.append([name, *_places(centers), *['unseen'] * 3, 'inf', 'inf'])
            continue
        design = design_matrix(centers)
        in_metres, scaled = (condition_number(design, length).two for length in (1.0, placement.SCALE))
        theta = f'{s.theta * MDEG:.3f}'
        deviations = [f'{s.dx * 1e6:.3f}', f'{s.dy * 1e6:.3f}', theta]
        rows.append([name, *_places(centers), *deviations, f'{scaled:.3f}', f'{in_metres:.3f}'])
    current, best = by_choice[0], by_choice[-1]
    gains = [a / b for a, b in zip(current, best, strict=True)]
    return (
        f'Placement, one standard deviation for {sigma * 1e6:.3f} µm on each reading, at rest:\n\n'
        + columns(rows)
        + f'\n\n{candidates[-1].name} against this rig: deviation of ΔX {gains[0]:.2f}, ΔY {gains[1]:.2f}, '
        f'θ {gains[2]:.2f} times smaller'
    )


def _places(centers: FloatArray) -> list[str]:
    # Adding 0.0 turns the -0.0 of a rounding error into 0.
    return [f'({x:.1f}, {y:.1f})' for x, y in (np.round(centers * 1e3, 1) + 0.0).tolist()]


def tilt_text(rig: Rig, radius: float, sigma: float) -> str:
    """What the sensors tell of the tilts, with all of ΔX, ΔY, θ, φ, ω free."""
    three = placement.ring(3, radius)
    stagger = np.array([radius, -radius / 2.0, -radius / 2.0])
    rows = [['tilts left free, at φ 0.3, ω 0.1 deg', 'ΔX µm', 'ΔY µm', 'θ mdeg', 'φ mdeg', 'ω mdeg']]
    for name, centers, heights in (
        ('this rig, two sensors', rig.centers, rig.heights),
        (f'three on a ring of {radius * 1e3:g} mm, one plane', three, np.zeros(3)),
        (f'the same, heights {", ".join(f"{h * 1e3:+g}" for h in stagger)} mm', three, stagger),
    ):
        s = placement.pose_deviations(TILTED, centers, heights, sigma) * np.array([1e6, 1e6, *[MDEG] * 3])
        rows.append([name, *(f'{v:.3f}' if math.isfinite(v) else 'unseen' for v in s.tolist())])
    return (
        columns(rows)
        + '\nTwo sensors give four readings for five unknowns: tie the tilts to the deflection, or ignore them.'
    )


def tied_text(rig: Rig, best: FloatArray, sigma: float, load: tuple[float, float, float]) -> str:
    """What two sensors tell of the slope ratio k under ``load`` once the tilts are tied to the deflection."""
    link = rig.link
    pose = np.array(LinkStatics.from_rig(rig).deflection(*load))
    stagger = np.array([0.05, -0.05])
    # Across the bending direction heights tell nothing of k: the best pair is turned into it.
    opposite = placement.opposite(float(np.hypot(*(best[0] - best[1]))) / 2.0)
    rows = [[f'tilts tied, k free, at {-load[1]:g} N', 'ΔX µm', 'ΔY µm', 'θ mdeg', 'k']]
    for name, centers, heights in (
        ('this rig', rig.centers, rig.heights),
        ('this rig, heights +50, -50 mm', rig.centers, rig.heights + stagger),
        ('opposite along Y, heights +50, -50 mm', opposite, stagger),
    ):
        s = placement.slope_ratio_deviations(pose, link.slope_ratio, link.length, centers, heights, sigma)
        dx, dy, theta, ratio = (s * np.array([1e6, 1e6, MDEG, 1.0])).tolist()
        rows.append([name, f'{dx:.3f}', f'{dy:.3f}', f'{theta:.3f}', f'{ratio:.4f}'])
    return columns(rows)


def draw_placements(candidates: list[PlacementRow], room: placement.Room, rig: Rig, path: Path) -> None:
    """The placements seen from beyond the tip (X right, Y up), written to ``path``."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Rectangle

    figure = Figure(figsize=(6.0, 6.0), layout='constrained')
    axes: Any = figure.subplots()
    axes.add_patch(Circle((0.0, 0.0), room.radius * 1e3, fill=False, linestyle=':', color='0.4', label='room'))
    if room.keep_out > 0.0:
        axes.add_patch(Circle((0.0, 0.0), room.keep_out * 1e3, fill=False, linestyle=':', color='0.4'))
    if room.box is not None:
        x_min, y_min, x_max, y_max = (1e3 * v for v in room.box)
        axes.add_patch(Rectangle((x_min, y_min), x_max - x_min, y_max - y_min, fill=False, linestyle=':', color='0.4'))
    axes.add_patch(Circle((0.0, 0.0), rig.link.outer_radius * 1e3, color='0.85', label='link'))
    # Colours that also differ for a colour-blind reader (Okabe & Ito), and different marks.
    for (name, centers), colour, mark in zip(candidates, ('#000000', '#0072B2', '#D55E00'), 's^o', strict=True):
        places = 1e3 * centers
        axes.plot(*places.T, color=colour, marker=mark, markersize=9, label=name)
    axes.set(aspect='equal', xlabel='X, mm (link_tip)', ylabel='Y, mm', title='Sensor centres and base lines')
    axes.legend(loc='upper center', bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False)
    axes.grid(alpha=0.2)
    save_figure(figure, path, dpi=150)
