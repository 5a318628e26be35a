"""Section 2.3 put right: all four tilts, against the golden answers; rigs that lose one are refused by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from psd_deflection.errors import SolverError
from psd_deflection.geometry import Geometry
from psd_deflection.thesis.tilt_branches import tilt_branches

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
    for centers, said in (
        ([[0.0, 0.05], [-0.1, 0.05]], 'same y: phi'),
        ([[0.1, 0.05], [0.1, -0.05]], 'same x: omega'),
        (THREE, 'two PSDs'),
    ):
        geometry = Geometry(np.array(centers), np.zeros((len(centers), 2)), np.zeros(len(centers)), 0.585)
        with pytest.raises(SolverError, match=said):
            tilt_branches(geometry, (0.0,) * (2 * len(centers)), 0.0)


def test_no_tilt_lengthens_the_base_line_beyond_the_beams(golden: Any) -> None:
    """Dots closer together than the beams, along y and along x: no branch."""
    geometry = golden.geometry()
    assert tilt_branches(geometry, (0.0, -1e-4, 0.0, 0.0), 0.0) == ()
    assert tilt_branches(geometry, (-1e-4, 0.0, 0.0, 0.0), 0.0) == ()
