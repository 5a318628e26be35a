# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``ols``: ordinary least squares on the linearised plate, with the corrected design matrix.

The thesis's section 4.2 (4.24, x = A+ b) with the corrected rows of ``model.plate.linear`` and the pre-load
readings subtracted. On exact data of a flat plate it gives theta' = sin theta and
d' = R(-theta) d + (1 - cos theta) lbar, lbar the mean of the l_i: the turn of d that it leaves out,
not the sine, is its largest error (43 um at 1 degree and 2 mm).
"""

from typing import ClassVar

import numpy as np

from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.linear import design_matrix
from psd_deflection.model.solvers.fixed_gain import FixedGain


class OlsSolver(FixedGain):
    """Unweighted linear least squares, P >= 2 PSDs; covariance G V G^T with V the dots' own."""

    name: ClassVar[str] = 'ols'
    budgeted_as: ClassVar[str] = 'wls'

    def __init__(self, geometry: Geometry) -> None:
        """Bind to ``geometry``. Raises SolverError if the beams coincide."""
        count = check_twist(geometry)
        super().__init__(
            design_matrix(geometry.beams), np.asarray(geometry.zeros), np.ones(2 * count), geometry.arithmetic
        )
