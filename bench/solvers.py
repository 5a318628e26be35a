# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Speed of the solvers, beside their peers in the same run: ``python -m bench.solvers``."""

import argparse
import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from psd_deflection.model.solvers import SOLVERS, Solver, make_solver
from psd_deflection.records import FloatArray
from psd_deflection.studies.thesis.comparison import VARIANCES, dots_of, thesis_geometry


def best_of(action: Callable[[], Any], repeats: int = 5) -> float:
    """Least time, s: the least affected by other work on the machine."""
    action()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def some_blocks(count: int) -> FloatArray:
    """Dots (count, 4), m, of poses within 2 mm and 2 degrees, with 2 um of noise."""
    rng, poses = np.random.default_rng(0), np.zeros((count, 5))
    poses[:, :3] = rng.uniform(-1, 1, (count, 3)) * (2e-3, 2e-3, np.radians(2.0))
    return dots_of(thesis_geometry(), poses) + 2e-6 * rng.standard_normal((count, 4))


def peer_least_squares(dots: FloatArray) -> None:
    """scipy.optimize.least_squares on the flat plate, Levenberg-Marquardt, derivatives given."""
    geometry = thesis_geometry()
    centers, beams = geometry.centers, geometry.beams

    def residual(p: FloatArray, m: FloatArray) -> FloatArray:
        c, s = np.cos(p[2]), np.sin(p[2])
        u, v = (beams - p[:2]).T
        return np.array([c * u + s * v - centers[:, 0], c * v - s * u - centers[:, 1]]).T.ravel() - m

    def jacobian(p: FloatArray, m: FloatArray) -> FloatArray:
        c, s = np.cos(p[2]), np.sin(p[2])
        u, v = (beams - p[:2]).T
        j = np.empty((4, 3))
        j[0::2, 0], j[0::2, 1], j[0::2, 2] = -c, -s, c * v - s * u
        j[1::2, 0], j[1::2, 1], j[1::2, 2] = s, -c, -(c * u + s * v)
        return j

    for m in dots:
        least_squares(residual, np.zeros(3), jacobian, method='lm', x_scale=(1e-3, 1e-3, 1e-2), args=(m,))


def peer_lstsq(dots: FloatArray) -> None:
    """numpy.linalg.lstsq on the linearised plate: no exact rotation, no covariance."""
    geometry, a = thesis_geometry(), np.zeros((4, 3))
    a[0::2, 0] = a[1::2, 1] = -1.0
    a[0::2, 2], a[1::2, 2] = geometry.beams[:, 1], -geometry.beams[:, 0]
    for m in dots:
        np.linalg.lstsq(a, m, rcond=None)


def repeat(solver: Solver, dots: tuple[float, ...], variances: tuple[float, ...]) -> None:
    """200 calls of a single block."""
    for _ in range(200):
        solver.solve(dots, variances)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--blocks', type=int, default=1_000_000, help='blocks of the vectorised solve')
    blocks = parser.parse_args().blocks
    geometry, dots = thesis_geometry(), some_blocks(blocks)
    print(f'{blocks} blocks at once, with covariance, residual and status')
    seconds = []
    solver = make_solver('exact', geometry)
    of_each = np.tile((4e-12, 1e-12, 9e-12, 2e-12), (blocks, 1))
    for label, variances in (('one set of variances', VARIANCES), ('variances of each block, x and y unlike', of_each)):
        seconds.append(best_of(functools.partial(solver.solve_many, dots, variances), 3) / blocks)
        print(f'  {f"exact, {label}":50} {1e6 * seconds[-1]:9.3f} us a block')
    peer = best_of(functools.partial(peer_least_squares, dots[:500]), 3) / 500
    ratio = peer / seconds[0]
    print(f'  {"scipy.optimize.least_squares a block":50} {1e6 * peer:9.1f} us, exact is {ratio:.0f} times as fast')
    print('one block at a time, with covariance')
    sample, default = tuple(dots[0].tolist()), 0.0
    alike, unlike = ('', (4e-12,) * 4), (', x and y unlike', (4e-12, 1e-12, 9e-12, 2e-12))
    for name in (name for name in SOLVERS if name not in ('pose', 'base_pair')):
        solver = make_solver(name, geometry)
        for label, single in (alike, unlike) if name == 'exact' else (alike,):
            value = best_of(functools.partial(repeat, solver, sample, single)) / 200
            default = default or value
            print(f'  {name + label:50} {1e6 * value:9.1f} us')
    linear = 'numpy.linalg.lstsq, linear, no covariance'
    for text, solve in (('scipy.optimize.least_squares', peer_least_squares), (linear, peer_lstsq)):
        value = best_of(functools.partial(solve, dots[:200])) / 200
        print(f'  {text:50} {1e6 * value:9.1f} us, exact is {value / default:.0f} times as fast')


if __name__ == '__main__':
    main()
