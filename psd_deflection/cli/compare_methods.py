"""How far each method is off, by condition, and where the figures of the thesis's Table 5.1 come from.

Exact readings of the thesis's rig go through every method; no noise. The first table has the rms
error over a grid of poses (flat plate, independent tilts, tilts of a cantilever), then the largest.
The second takes Table 5.1 apart by cause. --out draws the figures of docs/methods.md as well.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from psd_deflection.errors import ConfigError
from psd_deflection.solvers.comparison import (
    CAUSES,
    CONDITIONS,
    METHODS,
    REPORTED,
    Errors,
    errors,
    grid,
    table_5_1,
    thesis_geometry,
)

_UNITS = (1e6, 1e6, 1e3 * 180.0 / math.pi)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--out', metavar='DIR', help='draw the figures into this folder')


def run(args: argparse.Namespace) -> int:
    """Print the tables; draw where asked."""
    if args.out is not None:
        try:
            Path(args.out).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f'--out {args.out}: cannot be made a folder ({error.strerror})') from None
    print('\n'.join([*error_table(), '', *cause_table()]))
    if args.out is not None:
        # matplotlib takes a second to import; who only reads the tables need not wait for it.
        from psd_deflection.cli._method_figures import draw_all

        try:
            for path in draw_all(Path(args.out)):
                print(f'wrote {path}')
        except OSError as error:
            raise ConfigError(f'--out {args.out}: cannot be written ({error.strerror})') from None
    return 0


def error_table() -> list[str]:
    """Lines of the table method by condition: first the rms, then the largest."""
    geometry = thesis_geometry()
    titles = [f'{c} ({len(grid(c, geometry))})' for c in CONDITIONS]
    width = max(len(m.label) for m in METHODS)
    cells = {m.label: [errors(m, c) for c in CONDITIONS] for m in METHODS}
    lines = [
        'Error on exact readings, dX um / dY um / theta mdeg. The rig of the thesis; dX, dY within 5 mm, theta within',
        '3 deg; tilts of -1, 0, 1 deg about each axis, or those of a cantilever, k = 1.5.',
    ]
    for title, largest in (('rms', False), ('largest', True)):
        lines += ['', f'{title:{width}}  ' + ''.join(f'{t:25}' for t in titles) + 'no answer']
        for label, row in cells.items():
            silent = max(c.silent for c in row)
            lines.append(
                f'{label:{width}}  ' + ''.join(f'{_cell(c, largest):25}' for c in row) + f'{100.0 * silent:.1f} %'
            )
    return lines


def _cell(cell: Errors, largest: bool) -> str:
    values = cell.largest if largest else cell.rms
    return ' / '.join(_short(v * u) for v, u in zip(values, _UNITS, strict=True))


def _short(value: float) -> str:
    """Three digits; below a millionth of a unit it is rounding, and 0."""
    if value < 1e-6:
        return '0'
    return f'{value:.0f}' if value >= 100.0 else f'{value:.3g}'


def cause_table() -> list[str]:
    """Lines of Table 5.1 by cause."""
    width = max(len(c.label) for c in CAUSES)
    reported = ' | '.join(_percent(row) for row in REPORTED)
    lines = [
        'Table 5.1 (50 N on the sidebar), error in % of theta, dX, dY. Exact readings of dX = 0.12 mm (fitted: the',
        'only free number), dY = -2.2272 mm, theta = -0.9407 deg (theory), then one cause at a time.',
        '',
        f'{"":{width}}  {"iterative (Appendix D)":23} | weighted least squares',
        f'{"reported":{width}}  {reported}',
    ]
    for cause in CAUSES:
        iterative, linear = table_5_1(cause)
        cells = ' | '.join(_percent([100.0 * float(v) for v in row]) for row in (iterative, linear))
        lines.append(f'{cause.label:{width}}  {cells}')
    lines += [
        '',
        'The 84 % and 21 % of dX are the algorithms: the early stop times its lever of 70 mm, and the turn of d that',
        'linearising leaves out (theta dY = 37 um, less theta^2/2 of 100 mm). Of dY, some 5.5 % common to both need',
        'the rig: surfaces about 22 mm above the section, or a scale error. Least squares, +1.5 % of theta: open.',
    ]
    return lines


def _percent(values: tuple[float, float, float] | list[float]) -> str:
    # Adding 0.0 turns a rounded -0.0 into 0.0.
    return ''.join(f'{round(v, 1) + 0.0:7.1f} ' for v in values).rstrip().rjust(23)
