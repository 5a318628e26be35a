"""Every method against the golden answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psd_deflection.solvers import SolverStatus, make_solver

CASES = [f'G{i}' for i in range(1, 13)]
EQUAL = (4e-12,) * 4
SIDEBAR = (0.03, 0.5, 10.0, 0.1)
DIRECT = (3.0, 0.5, 10.0, 0.1)

METHODS: list[tuple[str, dict[str, Any], str]] = [
    ('exact', {}, 'procrustes'),
    ('exact', {}, 'planar_gn_k0'),
    ('iterative', {}, 'procrustes'),
    ('wls', {}, 'ols'),
    ('wls', {'weights': 'thesis'}, 'wls_sidebar'),
    ('wls', {'weights': 'thesis', 'row_scaling': SIDEBAR}, 'wls_sidebar'),
    ('wls', {'weights': 'thesis', 'row_scaling': DIRECT}, 'wls_direct'),
]


@pytest.mark.parametrize('case', CASES)
@pytest.mark.parametrize(('method', 'options', 'key'), METHODS)
def test_golden_pose(golden: Any, case: str, method: str, options: dict[str, Any], key: str) -> None:
    solver = make_solver(method, golden.geometry(case), **options)
    dots = golden.dots(case)
    one = solver.solve(dots, EQUAL)
    many = solver.solve_many(np.array([dots, dots]), np.array(EQUAL))
    want = golden.cases[case][key]
    assert one.status is SolverStatus.OK
    np.testing.assert_allclose([one.dx, one.dy, one.theta], want, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(many.pose, [want, want], rtol=0.0, atol=1e-9)
    assert many.status.tolist() == [0, 0]
