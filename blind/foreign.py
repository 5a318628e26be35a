# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""discover_in on machines that others measured. ``python -m blind.foreign [boom|emps|arm|auxtel|...]``.

The boom lacks gravity and gives way at its root; the drive lacks its Coulomb friction and its offset; the arm is its
maker's model; the telescope lacks all terms but the zeros of its encoders, or one of four. ``--null`` gives each model
what is published. result.json and report.html go to ``--out``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from blind.arm import Arm
from blind.auxtel import PHYSICAL, AuxTel
from blind.boom import Boom
from blind.campaign import options
from blind.emps import Emps
from blind.measured import DATA
from psd_deflection.studies.discover.plant_search import PlantDiscovery, discover_in
from psd_deflection.studies.discover.plants import Plant
from psd_deflection.studies.discover.trees import size_of

MACHINES: Mapping[str, tuple[Callable[[Path], Plant], Callable[[Path], Plant] | None]] = {
    'boom': (lambda folder: Boom(folder), lambda folder: Boom(folder, weighed=True)),
    'emps': (lambda folder: Emps(('coulomb_friction', 'force_offset'), folder), lambda folder: Emps((), folder)),
    'arm': (lambda folder: Arm(folder), None),
    'auxtel': (lambda path: AuxTel(path), lambda path: AuxTel(path, known=PHYSICAL[:4])),
    'auxtel-AN': (lambda path: AuxTel(path, known=('CA', 'NPAE', 'AW')), None),
    'auxtel-AW': (lambda path: AuxTel(path, known=('CA', 'NPAE', 'AN')), None),
    # Of CA and NPAE the stars of that night show one: each takes the place of the other.
    'auxtel-NPAE': (lambda path: AuxTel(path, known=('AN', 'AW')), None),
}
FOLDERS = {'boom': 'boom', 'emps': 'emps', 'arm': 'two_link_arm', 'auxtel': 'auxtel.txt'}
"""Of each machine, as it is called up to a hyphen."""


def lines(found: PlantDiscovery) -> list[str]:
    """Return the answer in words."""
    out = [found.sentence]
    for e in found.effects:
        unseen = f'unseen cases {e.heldout.gain:+.1f} ± {e.heldout.error:.1f}'
        out.append(f'  {e.active.label} ({size_of(e)}): BIC better by {e.delta_bic:.1f}, {unseen}')
        out += [
            f'    or {r.active.label} ({size_of(r)}), BIC worse by {r.delta_bic:.1f}' for r in e.fitted_alternatives
        ]
    out += [f'  beside it {a.label}: {dict(a.values)} ± {dict(sd)}' for a, sd in found.nuisance]
    for name, (before, after) in found.per_channel.items():
        out.append(f'  {name}: {before:.4g} -> {after:.4g}, on unseen cases {found.heldout_per_channel[name]:.4g}')
    out += [f'  unknown: {u.signature}' for u in found.unknown]
    if found.remainder is not None and found.remainder.function is not None:
        residual = found.remainder.function.heldout_as_shaped
        out.append(f'  with its shape from all cases {residual:.4g} remain on unseen cases')
    return [*out, f'  {found.simulations} simulations']


def main() -> int:
    """Search, print, write."""
    parser = options(__doc__)
    parser.add_argument('machines', nargs='*', help=f'of {", ".join(MACHINES)} (default: all)')
    parser.add_argument('--data', type=Path, default=DATA, help='folder with a folder of each (default: %(default)s)')
    parser.add_argument('--null', action='store_true', help='with the published terms in the model')
    parser.add_argument('--out', type=Path, help='folder for result.json and report.html of each')
    args = parser.parse_args()
    for name in args.machines or MACHINES:
        if name not in MACHINES:
            parser.error(f'{name}: must be one of {", ".join(MACHINES)}')
        make = MACHINES[name][int(args.null)]
        if make is None:
            continue
        try:
            plant = make(args.data / FOLDERS[name.split('-')[0]])
        except OSError as error:
            print(f'{error.filename}: {error.strerror}', file=sys.stderr)
            return 3
        found = discover_in(plant, progress=lambda words: print(f'... {words}', file=sys.stderr))
        print('\n'.join([f'{name}: {lines(found)[0]}', *lines(found)[1:]]))
        if args.out is not None:
            found.save(args.out / name)
    return 0


if __name__ == '__main__':
    sys.exit(main())
