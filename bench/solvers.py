# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Speed of the solvers, beside scipy's in the same run: ``python -m bench.solvers``."""

import argparse
import functools
import timeit
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from psd_deflection.model.solvers import SOLVERS, make_solver
from psd_deflection.records import FloatArray
from psd_deflection.studies.thesis.comparison import VARIANCES, dots_of, thesis_geometry

UNLIKE = (4e-12, 1e-12, 9e-12, 2e-12)


def some_blocks(count: int) -> FloatArray:
    """Dots (count, 4), m, of poses within 2 mm and 2 degrees, with 2 um of noise."""
    rng = np.random.default_rng(0)
    poses = np.zeros((count, 5))
    poses[:, :3] = rng.uniform(-1, 1, (count, 3)) * (2e-3, 2e-3, np.radians(2.0))
    return dots_of(thesis_geometry(), poses) + 2e-6 * rng.standard_normal((count, 4))


def peer(dots: FloatArray) -> None:
    """scipy.optimize.least_squares on the flat plate, Levenberg-Marquardt, derivatives given."""
    geometry = thesis_geometry()

    def residual(p: FloatArray, m: FloatArray) -> FloatArray:
        c, s = np.cos(p[2]), np.sin(p[2])
        u, v = (geometry.beams - p[:2]).T
        return np.array([c * u + s * v - geometry.centers[:, 0], c * v - s * u - geometry.centers[:, 1]]).T.ravel() - m

    def jacobian(p: FloatArray, m: FloatArray) -> FloatArray:
        c, s = np.cos(p[2]), np.sin(p[2])
        u, v = (geometry.beams - p[:2]).T
        j = np.empty((4, 3))
        j[0::2, 0], j[0::2, 1], j[0::2, 2] = -c, -s, c * v - s * u
        j[1::2, 0], j[1::2, 1], j[1::2, 2] = s, -c, -(c * u + s * v)
        return j

    for m in dots:
        least_squares(residual, np.zeros(3), jacobian, method='lm', x_scale=(1e-3, 1e-3, 1e-2), args=(m,))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--blocks', type=int, default=1_000_000, help='blocks of the vectorised solve')
    blocks = parser.parse_args().blocks
    dots, geometry = some_blocks(blocks), thesis_geometry()
    exact, sample = make_solver('exact', geometry), tuple(dots[0].tolist())

    def row(label: str, action: Callable[[], object], count: int, calls: int = 1) -> float:
        least = min(timeit.repeat(action, number=calls, repeat=4)) / calls / count
        print(f'{label:60} {1e6 * least:9.3f} us a block')
        return least

    each = np.tile(UNLIKE, (blocks, 1))
    row(f'exact, {blocks} blocks at once, with covariance', lambda: exact.solve_many(dots, VARIANCES), blocks)
    row('the same, variances of each block, x and y unlike', lambda: exact.solve_many(dots, each), blocks)
    row('exact, one block, x and y unlike', lambda: exact.solve(sample, UNLIKE), 1, 200)
    for name in sorted(set(SOLVERS) - {'pose', 'base_pair', 'exact'}):
        solve = make_solver(name, geometry).solve
        row(f'{name}, one block', functools.partial(solve, sample, (4e-12,) * 4), 1, 200)
    ours = row('exact, one block', lambda: exact.solve(sample, (4e-12,) * 4), 1, 200)
    theirs = row('scipy.optimize.least_squares', lambda: peer(dots[:200]), 200)
    print(f'exact is {theirs / ours:.0f} times as fast')


if __name__ == '__main__':
    main()
