# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Geometry that cannot be solved is rejected, and the message names what is wrong with it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate import Geometry
from psd_deflection.model.solvers import SOLVERS, make_solver


def rig(centers: Any, heights: Any = None, k: float = 1.5, length: float = 0.585) -> Geometry:
    places = np.array(centers, dtype=float)
    up = np.zeros(len(places)) if heights is None else np.array(heights, dtype=float)
    return Geometry(places, np.zeros_like(places), up, length, k)


CORNER = [[0.0, 0.07], [-0.1, 0.0]]
THREE = [[0.1, 0.0], [-0.05, 0.087], [-0.05, -0.087]]


@pytest.mark.parametrize('method', SOLVERS)
def test_coinciding_beams(method: str) -> None:
    with pytest.raises(SolverError, match=r'beams of psd_1 and psd_2 coincide at .* the twist cannot be seen'):
        make_solver(method, rig([[0.0, 0.07], [0.0, 0.07]]))


@pytest.mark.parametrize('method', SOLVERS)
def test_one_psd(method: str) -> None:
    with pytest.raises(SolverError, match=r'cannot tell a twist from a translation; at least 2'):
        make_solver(method, rig([[0.0, 0.07]]))


@pytest.mark.parametrize('method', SOLVERS)
def test_what_is_no_geometry(method: str) -> None:
    with pytest.raises(SolverError, match=r'centers must be finite'):
        make_solver(method, rig([[0.0, float('nan')], [0.0, 0.0]]))
    with pytest.raises(SolverError, match=r'of the same 2 PSDs'):
        make_solver(method, Geometry(np.array(CORNER), np.zeros((2, 2)), np.zeros(3), 0.585))
    with pytest.raises(SolverError, match=r'must be \(number of PSDs, 2\)'):
        make_solver(method, Geometry(np.zeros(4), np.zeros(4), np.zeros(2), 0.585))


@pytest.mark.parametrize('centers', [[[0.0, 0.07], [0.0, -0.07]], [[0.07, 0.0], [-0.07, 0.0]]])
@pytest.mark.parametrize('method', ['exact', 'wls', 'wls_exact', 'ols', 'iterative', 'beam', 'minimum_tilt'])
def test_one_of_the_two_rank_conditions_is_enough(rays: Any, method: str, centers: Any) -> None:
    """The source asks for 4.21 and 4.22; these rigs break one of them and are well-conditioned."""
    geometry = rig(centers)
    dots = tuple(rays.tip_dots(geometry, (0.0, 0.0, 1e-6, 0.0, 0.0)).tolist())
    assert make_solver(method, geometry).solve(dots, (4e-12,) * 4).theta == pytest.approx(1e-6, rel=1e-5)


@pytest.mark.parametrize(
    ('method', 'geometry', 'options', 'message'),
    [
        ('beam', rig(CORNER, [-0.39, 0.0]), {}, r'psd_1\.height = -0\.39 m: .*the deflection cannot be seen'),
        ('beam', rig(CORNER, length=0.0), {}, r'link\.length = 0\.0 m: must be above 0'),
        ('beam', rig(CORNER, k=float('inf')), {}, r'link\.slope_ratio = inf: must be finite'),
        ('pose', rig(CORNER, [0.1, -0.1]), {}, r'4 readings for 5 unknowns'),
        ('pose', rig(THREE), {}, r'coplanar surfaces do not see a tilt'),
        ('pose', rig([[0.1, 0.0], [0.0, 0.0], [-0.1, 0.0]], [0.1, 0.0, -0.1]), {}, r'lie on one line in space'),
        ('minimum_tilt', rig(THREE), {}, r'takes two PSDs'),
        ('minimum_tilt', rig(CORNER, [0.02, 0.02]), {}, r'takes both surfaces at 0'),
        ('base_pair', rig(CORNER), {}, r'psd_1\.height = 0 m: a PSD at the base stands below'),
        ('base_pair', rig(CORNER, [-0.585, -0.485]), {'assume': 'nothing'}, r'4 readings for 5 unknowns: with torsion'),
        ('base_pair', rig(CORNER, [-0.5, -0.5]), {'assume': 'no_twist'}, r'all PSD planes are 0\.5 m from the lasers'),
        ('base_pair', rig(CORNER, [-0.585, -0.585], k=1.0), {}, r'slope_ratio = 1 with all PSDs 0\.585 m .*Fig\. 5\.9'),
        ('base_pair', rig(THREE, [-0.5, -0.5, -0.5]), {'assume': 'nothing'}, r'some motion of the tip moves no dot'),
        ('iterative_printed', rig(THREE), {}, r'takes two PSDs'),
        ('appendix_d', rig(THREE), {}, r'takes two PSDs'),
        ('appendix_d', rig([[0.07, 0.0], [-0.1, 0.0]]), {}, r'appendix_d divides by both'),
        ('appendix_d_ols', rig(THREE), {}, r'takes two PSDs'),
    ],
)
def test_rejected_by_name(method: str, geometry: Geometry, options: dict[str, Any], message: str) -> None:
    with pytest.raises(SolverError, match=message):
        make_solver(method, geometry, **options)


def test_the_rejection_under_torsion_says_how_bad_it_is(rays: Any) -> None:
    """0.1 degree of twist is read as -1.02 mm of dY (thesis 5.3; docs/audit.md)."""
    geometry = rig(CORNER, [-0.585, -0.485])
    with pytest.raises(SolverError, match=r'one degree of twist looks like 10\.2 mm of ΔY'):
        make_solver('base_pair', geometry, assume='nothing')
