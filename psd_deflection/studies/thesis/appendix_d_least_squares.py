# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``appendix_d_ols``, ``appendix_d_wls``: the thesis's MATLAB least squares; for comparison only.

Its matrix (4.12 with theta_1 = -90, theta_2 = -180 degrees) has rows of two different rigs: with PSD 1
above and PSD 2 on the -X side, the torsion entries of the two PSDs disagree in sign. A twist theta then
comes out as 0.342 theta in plain least squares, 0.912 theta with the sidebar's weights (which suppress x1
and with it most of the contradiction: the thesis found them "closest to calibration data"), and -0.995
theta with those for direct loads (which suppress y2). The pre-load readings are not subtracted.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.solvers.fixed_gain import FixedGain
from psd_deflection.model.solvers.wls import THESIS_ROW_SCALING
from psd_deflection.records import FloatArray


def printed_design_matrix(geometry: Geometry) -> FloatArray:
    """Return a (4, 3) of 4.12 as the code fills it in, in m; its angle is positive clockwise.

    R_1 and R_2 are the centres' distances from the tip's origin; -90 and -180 degrees are constants of
    the code, whatever the rig.
    """
    r1, r2 = np.hypot(*np.asarray(geometry.centers, dtype=np.float64).T).tolist()
    return np.array([[-1.0, 0.0, r1], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, -r2]])


class AppendixDOlsSolver(FixedGain):
    """Appendix D, "Simple Least Squares". theta is the code's angle, clockwise, with its sign changed."""

    name: ClassVar[str] = 'appendix_d_ols'
    budgeted_as: ClassVar[str] = ''

    def __init__(self, geometry: Geometry, row_scaling: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)) -> None:
        """Bind to ``geometry``; ``row_scaling`` (4,): Po. Raises SolverError unless there are two PSDs."""
        if check_twist(geometry) != 2:
            raise SolverError(f'{self.name} takes two PSDs; of more take exact, or pose if their heights differ')
        design = printed_design_matrix(geometry) * np.array([1.0, 1.0, -1.0])
        super().__init__(design, np.zeros((2, 2)), np.array(row_scaling, dtype=np.float64), geometry.arithmetic)


class AppendixDWlsSolver(AppendixDOlsSolver):
    """Appendix D, "Weighted Least Squares": the same matrix with rows scaled by Po."""

    name: ClassVar[str] = 'appendix_d_wls'

    def __init__(self, geometry: Geometry, row_scaling: tuple[float, ...] = THESIS_ROW_SCALING) -> None:
        """Bind to ``geometry``; ``row_scaling`` (4,): Po. Raises SolverError unless there are two PSDs."""
        super().__init__(geometry, row_scaling)
