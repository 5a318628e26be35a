# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""discover_in beside other methods, on machines that others measured: ``make campaign NAME=duels``."""

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from blind.campaign import options
from blind.machines import PHYSICAL, AuxTel, Boom, Emps, TwoLinkArm
from psd_deflection.model.simulation.declaration import Effect
from psd_deflection.records import BoolArray, FloatArray
from psd_deflection.studies.discover.plant_search import PlantDiscovery, discover_in
from psd_deflection.studies.discover.plants import Model, Plant
from psd_deflection.studies.discover.trees import size_of

DATA = Path(os.environ.get('PSD_FOREIGN_DATA', 'PSD_FOREIGN_DATA is not set'))
GROUPS = 11  # Folds into which the parts of a plant are dealt in turn, at most.
THRESHOLDS = np.geomspace(1e-2, 1.0, 25)  # Of STLSQ, in units of the largest contribution of a term.
RIDGE = 1e-4  # Of STLSQ, in units of the mean square of a term.
FRICTION = ('coulomb_friction', 'force_offset')
Residual = Callable[[Sequence[Effect], BoolArray], FloatArray]
"""What effects leave of all values if their sizes are fitted to some of them."""


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _vector(tables: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([t.ravel() for t in tables])


def _model(effects: Sequence[Effect], x: FloatArray) -> Model:
    return {e.name: {e.parameters[0].name: float(v)} for e, v in zip(effects, x, strict=True)}


def linear(plant: Plant, y: FloatArray) -> Residual:
    """By linear least squares over what 1 of each effect does."""
    nothing = _vector(plant.simulate({}))
    alone = {e.name: _vector(plant.simulate(_model([e], np.ones(1)))) - nothing for e in plant.nuisance + plant.library}

    def residual(effects: Sequence[Effect], observed: BoolArray) -> FloatArray:
        names = [e.name for e in (*plant.nuisance, *effects)]
        if not names:
            return y - nothing
        table = np.column_stack([alone[n] for n in names])
        sizes = np.linalg.lstsq(table[observed], (y - nothing)[observed], rcond=None)[0]
        return np.asarray(y - nothing - table @ sizes)

    return residual


def bent(plant: Plant, y: FloatArray) -> Residual:
    """By least squares within the bounds, from where the effects are off."""

    def residual(effects: Sequence[Effect], observed: BoolArray) -> FloatArray:
        used = [*plant.nuisance, *effects]
        if not used:
            return y - _vector(plant.simulate({}))
        ends = ('minimum', 'maximum', 'scale')
        low, high, size = (np.array([getattr(e.parameters[0], n) for e in used]) for n in ends)
        start = np.clip(np.zeros(len(used)), low + 1e-3 * size, high - 1e-3 * size)

        def apart(x: FloatArray) -> FloatArray:
            return y - _vector(plant.simulate(_model(used, x)))

        def subset(x: FloatArray) -> FloatArray:
            return apart(x)[observed]

        return apart(np.asarray(least_squares(subset, start, bounds=(low, high), x_scale=size).x))

    return residual


def forward_backward(plant: Plant, residual: Residual, observed: BoolArray) -> FloatArray:
    """What is left of all values by terms chosen by BIC, one added or dropped at a time, from the ``observed``."""
    count = int(observed.sum())
    residuals: dict[frozenset[int], FloatArray] = {}

    def bic(chosen: frozenset[int]) -> float:
        if chosen not in residuals:
            residuals[chosen] = residual([plant.library[j] for j in sorted(chosen)], observed)
        return float(count * np.log(np.sum(residuals[chosen][observed] ** 2)) + len(chosen) * np.log(count))

    chosen: frozenset[int] = frozenset()
    while True:
        best = min((chosen ^ {j} for j in range(len(plant.library))), key=bic)
        if not bic(best) < bic(chosen):
            return residuals[chosen]
        chosen = best


def stlsq(plant: Plant, y: FloatArray, observed: BoolArray) -> FloatArray:
    """The same by sequentially thresholded least squares (Brunton and others 2016), with the threshold by BIC."""
    nothing = _vector(plant.simulate({}))
    alone = (plant.simulate(_model([e], np.ones(1))) for e in (*plant.nuisance, *plant.library))
    table = np.column_stack([_vector(simulated) - nothing for simulated in alone])
    table /= np.sqrt(np.mean(table[observed] ** 2, axis=0))
    always, count, best = len(plant.nuisance), int(observed.sum()), (np.inf, y)
    for threshold in THRESHOLDS:
        keep, sizes = np.ones(table.shape[1], dtype=bool), np.zeros(table.shape[1])
        for _ in range(20):
            sizes[:] = 0.0
            a, b = table[observed][:, keep], (y - nothing)[observed]
            sizes[keep] = np.linalg.solve(a.T @ a + RIDGE * count * np.eye(a.shape[1]), a.T @ b)
            less = np.abs(sizes) >= threshold * np.abs(sizes[always:]).max()
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


def ours(plant: Plant, tables: Sequence[FloatArray], hidden: Sequence[BoolArray]) -> FloatArray:
    """What the search without the readings that are ``hidden`` (n,) of each case leaves of all."""
    shown = [np.where(h, np.nan, t) for t, h in zip(tables, hidden, strict=True)]
    plant.measured = lambda: shown  # type: ignore[method-assign]
    predicted = discover_in(plant).predict(plant)
    return _vector([t - s for t, s in zip(tables, predicted, strict=True)])


def nested(make: Callable[[], Plant], is_linear: bool) -> Iterator[tuple[str, float]]:
    """Of each way the rms error over all readings, each predicted without its fold."""
    plant, folds, first = make(), list[FloatArray](), 0
    tables = [np.asarray(t, dtype=np.float64) for t in plant.measured()]
    y = _vector(tables)
    for part in plant.parts():
        folds.append(np.asarray((part + first) % GROUPS, dtype=np.float64))
        first += int(part.max()) + 1
    row_folds = _vector([np.tile(f, (len(plant.channels), 1)) for f in folds])
    residual = linear(plant, y) if is_linear else bent(plant, y)
    out: dict[str, FloatArray] = {}
    for fold in np.unique(row_folds):
        hidden = row_folds == fold
        observed = ~hidden & np.isfinite(y)
        answers = {
            'discover_in': ours(make(), tables, [f == fold for f in folds]),
            'forward-backward BIC': forward_backward(plant, residual, observed),
        }
        if is_linear:
            answers['STLSQ'] = stlsq(plant, y, observed)
        for name, rest in answers.items():
            out.setdefault(name, np.full(len(y), np.nan))[hidden] = rest[hidden]
        print(f'... fold {fold:.0f} of {row_folds.max() + 1:.0f}', file=sys.stderr, flush=True)
    for name, rest in out.items():
        yield name, rms(rest[np.isfinite(rest)])


class Duel(NamedTuple):
    """``make``: the machine, of the folder of the data; ``known``: the same with what is published in its model.
    ``is_linear``: in all terms."""

    make: Callable[[Path], Plant]
    known: Callable[[Path], Plant]
    is_linear: bool = False


DUELS: Mapping[str, Duel] = {
    'auxtel': Duel(lambda d: AuxTel(d / 'auxtel.txt'), lambda d: AuxTel(d / 'auxtel.txt', known=PHYSICAL[:4]), True),
    'emps': Duel(lambda d: Emps(FRICTION, d / 'emps'), lambda d: Emps((), d / 'emps')),
    'arm': Duel(lambda d: TwoLinkArm(d / 'two_link_arm'), lambda d: TwoLinkArm(d / 'two_link_arm')),
    'boom': Duel(lambda d: Boom(d / 'boom'), known=lambda d: Boom(d / 'boom', weighed=True)),
}


def answered(discovery: PlantDiscovery) -> str:
    words = [f'`{e.active.effect.name}` {size_of(e)}' for e in discovery.effects]
    return '; '.join([*words, *(['the rest is called unknown'] if discovery.unknown else [])]) or 'nothing is missing'


def main(argv: Sequence[str] | None = None) -> int:
    """Print of each machine what is named, and the unseen errors. 3 if no data are there."""
    parser = options(__doc__)
    parser.add_argument('machines', nargs='*', help=f'of {", ".join(DUELS)} (default: all)')
    parser.add_argument('--data', type=Path, default=DATA, help='folder with the data (default: %(default)s)')
    parser.add_argument('--named', action='store_true', help='without the folds')
    parser.add_argument('--null', action='store_true', help='what is named with the published terms in the model')
    parser.add_argument('--out', type=Path, help='folder for result.json and report.html of each')
    args = parser.parse_args(argv)
    if unknown := set(args.machines) - set(DUELS):
        parser.error(f'{", ".join(unknown)}: must be of {", ".join(DUELS)}')
    print('| machine | measure | way | figure |\n|---|---|---|---|', flush=True)
    status = 3
    for name in args.machines or DUELS:
        duel = DUELS[name]
        make = duel.known if args.null else duel.make
        try:
            discovery = discover_in(make(args.data))
            print(f'| {name} | named | discover_in | {answered(discovery)} |', flush=True)
            if args.out is not None:
                discovery.save(args.out / name)
            status = 0
            if not args.null and not args.named:
                unit = make(args.data).units[0]
                for way, figure in nested(lambda make=make: make(args.data), duel.is_linear):  # type: ignore[misc]
                    print(f'| {name} | unseen, nested; {unit} | {way} | {figure:.4g} |', flush=True)
        except OSError as error:
            print(f'| {name} | not run: {error.strerror or error} | | |', flush=True)
    return status


if __name__ == '__main__':
    sys.exit(main())
