# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whole searches that never saw what judges them, beside peers in the same folds. ``python -m blind.nested auxtel``.

Each fold's readings are taken out, terms, sizes and shrinkage are found without them, and what the model that predicts
best says of them is held against what was measured. The peers choose and fit in the same folds: forward and backward
selection by BIC (N log RSS + k log N, one term added or dropped at a time), and, where the simulation is linear in all
terms, sequentially thresholded least squares (STLSQ, Brunton and others 2016) with the threshold by BIC.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from blind.arm import Arm
from blind.auxtel import AuxTel
from blind.boom import Boom
from blind.campaign import options
from blind.duel_peers import BoolArray, Residual, _bent, _linear, _vector, rms
from blind.emps import Emps
from blind.measured import DATA
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plant_search import discover_in
from psd_deflection.studies.discover.plants import Plant

GROUPS = 11
"""Folds into which the parts of a plant are dealt in turn, at most."""
THRESHOLDS = np.geomspace(1e-2, 1.0, 25)
"""Of STLSQ, in units of the largest contribution of a term."""


def _folds(plant: Plant) -> list[FloatArray]:
    """Of each case the fold (n,) of each column."""
    out, first = [], 0
    for part in plant.parts():
        out.append((part + first) % GROUPS)
        first += int(part.max()) + 1
    return [np.asarray(f, dtype=np.float64) for f in out]


def _without(plant: Plant, tables: Sequence[FloatArray], hidden: Sequence[BoolArray]) -> None:
    """Let ``plant`` have measured ``tables`` but for what is ``hidden`` (n,) of each case."""
    shown = [np.where(h, np.nan, np.asarray(t, dtype=np.float64)) for t, h in zip(tables, hidden, strict=True)]
    plant.measured = lambda: shown  # type: ignore[method-assign]


def ours(make: Callable[[], Plant], tables: Sequence[FloatArray], hidden: Sequence[BoolArray]) -> FloatArray:
    """What the search without the hidden readings leaves of all."""
    plant = make()
    _without(plant, tables, hidden)
    found = discover_in(plant)
    message = found.predict(plant)
    return _vector([t - s for t, s in zip(tables, message, strict=True)])


def forward_backward(plant: Plant, residual: Residual, observed: BoolArray) -> FloatArray:
    """What is left of all values by terms chosen and fitted with those that are ``observed``."""
    count = int(observed.sum())
    terms = range(len(plant.library))
    kept: dict[frozenset[int], FloatArray] = {}

    def of(chosen: frozenset[int]) -> FloatArray:
        if chosen not in kept:
            kept[chosen] = residual([plant.library[j] for j in sorted(chosen)], observed)
        return kept[chosen]

    def bic(chosen: frozenset[int]) -> float:
        return float(count * np.log(np.sum(of(chosen)[observed] ** 2)) + len(chosen) * np.log(count))

    chosen: frozenset[int] = frozenset()
    while True:
        best = min((chosen ^ {j} for j in terms), key=bic)
        if not bic(best) < bic(chosen):
            return of(chosen)
        chosen = best


def stlsq(plant: Plant, y: FloatArray, observed: BoolArray) -> FloatArray:
    """Return the same by least squares over all terms, again without those whose contribution is below a threshold."""
    nothing = _vector(plant.simulate({}))
    effects = [*plant.nuisance, *plant.library]
    table = np.column_stack([_vector(plant.simulate({e.name: {e.parameters[0].name: 1.0}})) - nothing for e in effects])
    table /= np.sqrt(np.mean(table[observed] ** 2, axis=0))
    always, count, best = len(plant.nuisance), int(observed.sum()), (np.inf, y)
    for threshold in THRESHOLDS:
        keep = np.ones(table.shape[1], dtype=bool)
        sizes = np.zeros(table.shape[1])
        for _ in range(20):
            sizes[:] = 0.0
            sizes[keep] = np.linalg.lstsq(table[observed][:, keep], (y - nothing)[observed], rcond=1e-8)[0]
            less = np.abs(sizes) >= threshold * np.abs(sizes).max()
            less[:always] = True
            if np.array_equal(less & keep, keep):
                break
            keep &= less
        out = y - nothing - table @ sizes
        bic = count * np.log(np.sum(out[observed] ** 2)) + keep.sum() * np.log(count)
        # As many terms as readings fit anything.
        if keep.sum() < count // 2 and bic < best[0]:
            best = (float(bic), out)
    return best[1]


MACHINES: Mapping[str, tuple[Callable[[Path], Plant], bool]] = {
    'auxtel': (lambda data: AuxTel(data / 'auxtel.txt'), True),
    'boom': (lambda data: Boom(data / 'boom'), False),
    'arm': (lambda data: Arm(data / 'two_link_arm'), False),
    'emps': (lambda data: Emps(('coulomb_friction', 'force_offset'), data / 'emps'), False),
}


def unseen(make: Callable[[], Plant], is_linear: bool, log: Callable[[str], None]) -> dict[str, float]:
    """Of each way the rms error over all readings, each predicted without its fold."""
    plant = make()
    tables = [np.asarray(t, dtype=np.float64) for t in plant.measured()]
    y = _vector(tables)
    folds = _folds(plant)
    row_folds = _vector([np.tile(f, (len(plant.channels), 1)) for f in folds])
    residual = _linear(plant, y) if is_linear else _bent(plant, y)
    out: dict[str, FloatArray] = {}
    for fold in np.unique(row_folds):
        hidden = row_folds == fold
        answers = {
            'discover_in': ours(make, tables, [f == fold for f in folds]),
            'forward-backward BIC': forward_backward(plant, residual, ~hidden & np.isfinite(y)),
        }
        if is_linear:
            answers['STLSQ'] = stlsq(plant, y, ~hidden & np.isfinite(y))
        for name, rest in answers.items():
            out.setdefault(name, np.full(len(y), np.nan))[hidden] = rest[hidden]
        words = ', '.join(f'{name} {rms(rest[hidden & np.isfinite(y)]):.4g}' for name, rest in answers.items())
        log(f'fold {fold:.0f}: {words}')
    return {name: rms(rest[np.isfinite(rest)]) for name, rest in out.items()}


def main(argv: Sequence[str] | None = None) -> int:
    """Print a table: data, way, unseen error. 3 if no data are there."""
    parser = options(__doc__)
    parser.add_argument('machines', nargs='*', default=list(MACHINES), help=f'of {", ".join(MACHINES)}')
    parser.add_argument('--data', type=Path, default=DATA, help='folder with the data (default: %(default)s)')
    args = parser.parse_args(argv)
    print('| data | unit | way | unseen error, nested |\n| --- | --- | --- | --- |')
    done = 0
    for name in args.machines:
        if name not in MACHINES:
            parser.error(f'{name}: must be one of {", ".join(MACHINES)}')
        make, is_linear = MACHINES[name]
        try:
            plant = make(args.data)
        except OSError as error:
            print(f'{error.filename}: {error.strerror}', file=sys.stderr)
            continue
        found = unseen(lambda m=make: m(args.data), is_linear, lambda w: print(f'... {w}', file=sys.stderr, flush=True))  # type: ignore[misc]
        for way, wrong in found.items():
            print(f'| {name} | {plant.units[0]} | {way} | {wrong:.4g} |', flush=True)
        done += 1
    return 0 if done else 3


if __name__ == '__main__':
    sys.exit(main())
