# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The drawn laws for other programs that find laws: the same residuals, SINDy (pysindy) and ADCD (adcd).

``python -m blind.law_peers export FOLDER --first 100 --laws 12`` writes one .npz a law; then, with a Python that has
pysindy or adcd (neither is needed here), ``python blind/law_peers.py sindy FOLDER`` and ``... adcd FOLDER``.

A peer is given more than discover is: the channel with the largest residual, the residual without noise of the other
channels, and as block means only the variables that the laws on it
have: loads, the dot of that PSD, temperature, time, each divided by its largest value. It fits the
odd half-seconds and is judged on the even ones. Variables count as right if exactly those of the truth are in its law,
a gap as closed if at most 1.2 times the noise of that channel remains.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
HALF_SECOND = 25
MOST_FLOORS = 1.2


def export(folder: Path, first: int, count: int) -> None:
    """Residual and variables of each law."""
    # Imported here: the peers' Python need not have this package.
    from blind.law_forms import truth_of
    from blind.laws import drawn, observe, sized
    from psd_deflection.studies.discover.laws.law_features import known_values
    from psd_deflection.studies.discover.search.workspace import Workspace

    folder.mkdir(parents=True, exist_ok=True)
    for law in drawn(first, count):
        ws = Workspace(observe(sized(law), law['number']))
        _, difference = ws.residual(())
        (blocks,) = ws.block_dots(difference)
        row = int(np.argmax(np.mean(blocks**2, axis=1)))
        # Of what is nearly the same (a load, the pose and the dots that it makes) as little as the truth needs.
        psd = row // 2 + 1
        names = ['load_fx', 'load_fy', 'load_tz', f'x{psd}', f'y{psd}', 'temperature', 'time']
        known = np.stack([known_values(ws, (), name)[0] for name in names])
        truth = json.dumps(truth_of(law))
        floor = ws.noise[0].block_sigma[[0, 1, 3, 4]][row] * ws.observations[0].rig.sensitivities.ravel()[row]
        path = folder / f'law-{law["number"]}.npz'
        np.savez(path, residual=blocks[row], floor=floor, known=known, names=names, truth=truth)


def _data(path: Path) -> tuple[dict[str, Array], Array, float, dict[str, Any], npt.NDArray[np.bool_]]:
    with np.load(path) as stored:
        known = {
            str(name): row / np.max(np.abs(row))
            for name, row in zip(stored['names'], stored['known'], strict=True)
            if np.max(np.abs(row)) > 0.0
        }
        residual, floor = stored['residual'], float(stored['floor'])
        truth = json.loads(str(stored['truth']))
    fitted = np.arange(len(residual)) // HALF_SECOND % 2 == 0
    return known, residual / floor, floor, truth, fitted


def sindy(path: Path) -> tuple[list[str], str, Array]:
    """Sequentially thresholded least squares over polynomials of the third degree; the threshold that fits best."""
    pysindy = importlib.import_module('pysindy')
    known, y, _, _, fitted = _data(path)
    library = pysindy.PolynomialLibrary(degree=3)
    x = np.stack(list(known.values()), axis=1)
    table = np.asarray(library.fit_transform(x))
    names = library.get_feature_names(list(known))
    # Of what is fitted a quarter chooses the threshold.
    inner = fitted & (np.arange(len(y)) // HALF_SECOND % 8 != 0)
    choice = fitted & ~inner
    best: tuple[float, Array] | None = None
    for threshold, alpha in itertools.product(np.geomspace(0.1, 100.0, 13).tolist(), (1e-6, 1e-2, 1.0)):
        fit = pysindy.STLSQ(threshold=threshold, alpha=alpha).fit(table[inner], y[inner, None])
        c = np.asarray(fit.coef_).ravel()
        score = float(np.sum((y[choice] - table[choice] @ c) ** 2)) + np.log(len(y)) * int(np.count_nonzero(c))
        if best is None or score < best[0]:
            best = score, c
    if best is None:
        return [], '', y
    c = best[1]
    terms = [f'{v:.3g} {n}' for v, n in zip(c, names, strict=True) if v != 0.0]
    used = [n for n, v in zip(names, c, strict=True) if v != 0.0]
    variables = sorted({w.split('^')[0] for n in used for w in n.split()} & set(known))
    return variables, ' + '.join(terms), y - table @ c


def adcd(path: Path) -> tuple[list[str], str, Array]:
    """Its additive correction by the offline proposer, each variable in turn as the one of its limit; the best."""
    package, sympy = importlib.import_module('adcd'), importlib.import_module('sympy')
    known, y, _, _, fitted = _data(path)
    best: tuple[float, str, dict[str, float]] | None = None
    # As many points as its own scenarios have: it takes minutes with all of them.
    some = np.flatnonzero(fitted)[:: max(1, int(fitted.sum()) // 200)]
    for name in known:
        found = package.fit(
            {k: v[some] for k, v in known.items()},
            y[some],
            np.zeros(len(some)),
            limit_variable=name,
            correction_mode='additive',
            max_iterations=1,
            verbose=False,
        )
        if found.best_expr and (best is None or found.best_nmse_residual < best[0]):
            best = float(found.best_nmse_residual), str(found.best_expr), dict(found.best_theta)
    if best is None:
        return [], '', y
    expression = sympy.sympify(best[1], locals={k: sympy.Symbol(k) for k in (*known, *best[2])})
    symbols = sorted(str(s) for s in expression.free_symbols)
    function = sympy.lambdify(symbols, expression, 'numpy')
    values = function(*[known[s] if s in known else best[2].get(s, 0.0) for s in symbols])
    return [s for s in symbols if s in known], str(expression), y - values


def main(argv: Sequence[str] | None = None) -> int:
    """Export, or let one peer answer and count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('what', choices=('export', 'sindy', 'adcd'))
    parser.add_argument('folder', type=Path)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--laws', type=int, default=12)
    args = parser.parse_args(argv)
    if args.what == 'export':
        export(args.folder, args.first, args.laws)
        return 0
    right = closed = 0
    paths = sorted(args.folder.glob('law-*.npz'))
    for path in paths:
        variables, words, score = {'sindy': sindy, 'adcd': adcd}[args.what](path)
        _, _, _, truth, fitted = _data(path)
        floors = float(np.sqrt(np.mean(score[~fitted] ** 2)))
        right += variables == truth['variables']
        closed += floors <= MOST_FLOORS
        print(f'{path.stem} {truth["form"]} of {truth["variables"]}: {variables}, {floors:.2f} floors: {words[:120]}')
    print(f'{args.what}: variables {right}/{len(paths)}, gap closed {closed}/{len(paths)}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
