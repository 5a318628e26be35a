# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Section 2.3 of the thesis: four tilts explain the readings at any admissible twist; the printed equations by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate import Geometry
from psd_deflection.studies.thesis.comparison import dots_of, thesis_geometry
from psd_deflection.studies.thesis.tilt_compensation import compared, mismatch, tilt_branches

THREE = [[0.1, 0.0], [-0.05, 0.087], [-0.05, -0.087]]


@pytest.mark.parametrize('case', [f'G{i}' for i in range(1, 13) if i != 4])
def test_tilt_branches(golden: Any, case: str) -> None:
    """G4 lies on the edge, where rounding alone decides whether a branch exists; its list is empty."""
    theta = golden.cases[case]['pose'][3]
    got = np.array(tilt_branches(golden.geometry(case), golden.dots(case), theta))
    want = np.array(golden.cases[case]['tilt_branches_at_true_theta'])
    assert got.shape == (4, 4)
    at_rest = np.abs(want[:, 2:]) < 1e-7
    np.testing.assert_allclose(got[:, :2], want[:, :2], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(got[:, 2:][~at_rest], want[:, 2:][~at_rest], rtol=0.0, atol=1e-9)
    assert np.abs(got[:, 2:][at_rest]).max(initial=0.0) < 1e-7


def test_tilt_branches_name_their_degenerate_rigs() -> None:
    for centers, message in (
        ([[0.0, 0.05], [-0.1, 0.05]], 'same y: phi'),
        ([[0.1, 0.05], [0.1, -0.05]], 'same x: omega'),
        (THREE, 'two PSDs'),
    ):
        geometry = Geometry(np.array(centers), np.zeros((len(centers), 2)), np.zeros(len(centers)), 0.585)
        with pytest.raises(SolverError, match=message):
            tilt_branches(geometry, (0.0,) * (2 * len(centers)), 0.0)


def test_no_tilt_lengthens_the_base_line_beyond_the_beams(golden: Any) -> None:
    """Dots closer together than the beams, along y and along x: no branch."""
    geometry = golden.geometry()
    assert tilt_branches(geometry, (0.0, -1e-4, 0.0, 0.0), 0.0) == ()
    assert tilt_branches(geometry, (-1e-4, 0.0, 0.0, 0.0), 0.0) == ()


AT_PLUS_X = Geometry(np.array([[0.0, 0.07], [0.1, 0.0]]), np.zeros((2, 2)), np.zeros(2), 0.585)
"""PSD 2 where section 2.3 has it."""


def degrees(*values: float) -> list[float]:
    return [float(v) for v in np.radians(values)]


@pytest.mark.parametrize(
    ('pose', 'name', 'printed', 'true'),
    [
        ([1e-3, -2e-3, *degrees(0, 0, 0)], '2.36 ΔY', 2e-3, -2e-3),
        ([1e-3, -2e-3, *degrees(1, 0.5, -0.3)], '2.41 |ω|', *degrees(0.4, 0.3)),
        ([1e-3, -2e-3, *degrees(1, 0.5, 0.3)], '2.41 |ω|', *degrees(1.0, 0.3)),
        ([5e-3, 5e-3, *degrees(3, 1, 1)], '2.44, 2.45 δX^ of PSD 1', 19.043e-6, 20.566e-6),
        ([5e-3, 5e-3, *degrees(3, 1, 1)], '2.44, 2.45 δX^ of PSD 2', -2.285e-6, -15.995e-6),
    ],
)
def test_printed_equations_are_wrong_by_what_the_audit_says(
    pose: list[float], name: str, printed: float, true: float
) -> None:
    (row,) = (c for c in compared(AT_PLUS_X, np.array(pose)) if c.equation == name)
    assert row.printed == pytest.approx(printed, rel=1e-3)
    assert row.corrected == pytest.approx(true, rel=1e-4)
    assert row.true == pytest.approx(true, rel=1e-4)


def test_corrected_equations_hold_printed_root_never() -> None:
    rng = np.random.default_rng(5)
    sums_hold = 0
    for _ in range(300):
        pose = rng.uniform(-1.0, 1.0, 5) * (5e-3, 5e-3, *degrees(3, 1, 1))
        for row in compared(thesis_geometry(), pose):
            assert row.corrected == pytest.approx(row.true, abs=2e-9), row
            assert np.isnan(row.printed) == row.equation.startswith('2.38')
            if row.equation.startswith('2.41'):
                sums_hold += abs(row.printed - row.true) < 1e-6
    # A third of poses, as the page says.
    assert 0.25 < sums_hold / 300 < 0.40


def test_the_stopping_test_holds_at_every_admissible_trial() -> None:
    """So it selects no twist: from a thousandth of a degree below the true one to twenty above."""
    pose = np.array([1e-3, -2e-3, *degrees(1, 0.5, -0.3)])
    (dots,) = dots_of(thesis_geometry(), pose[None]).tolist()
    for off in (-0.001, 0.0, 0.01, 1.0, 5.0, 20.0):
        assert mismatch(thesis_geometry(), tuple(dots), pose[2] + np.radians(off)) < 1e-16
    assert mismatch(thesis_geometry(), tuple(dots), pose[2] - np.radians(0.01)) == np.inf
