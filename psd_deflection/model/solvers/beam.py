# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``beam``: flat-plate unknowns plus the tilts of a cantilever's tip, which follow from its deflection.

Four readings cannot give five unknowns, but in a bending link the deflection determines the two
tilts: phi = -k dY/L, omega = +k dX/L, with k = 3/2 for a force at the tip and 2 for a moment there.
That leaves dX, dY and theta, found by Gauss-Newton on the exact crossing of beams and tilted plate,
starting from the flat plate's answer. The tilts matter if the sensitive surface is off the
reference section: at a height of 20 mm, a flat model's dY is wrong by 115 um under 50 N.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from psd_deflection.base.errors import SolverError
from psd_deflection.model.plate.layout import Geometry, check_twist
from psd_deflection.model.plate.plate import Tilts, crossing, flat_pose
from psd_deflection.model.solvers.gauss_newton import answer, fit
from psd_deflection.model.solvers.interface import Solution, Solver, flat_gain
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig


class BeamSolver(Solver):
    """Tilts tied to the deflection by ``Geometry.slope_ratio``; heights in the model; P >= 2 PSDs.

    If the rig file lists the effect ``plane_tilt``, as a calibrated one does, what tilts and heights did to the dots is
    taken off before any solver sees them: the model is then the flat plate, and only the tilts are told.
    """

    name: ClassVar[str] = 'beam'
    budgeted_as: ClassVar[str] = 'beam'
    tilts: ClassVar[Tilts] = 'tied'

    def __init__(self, geometry: Geometry, tilt_in_dots: bool = True) -> None:
        """Bind to ``geometry``. ``tilt_in_dots``: the dots are as the tilted plate has them.

        Raises SolverError if the beams coincide, or if 1 + k h/L = 0 for a surface: there the
        rotation cancels the displacement.
        """
        check_twist(geometry)
        self._slope = slope_per_metre(geometry)
        self._xp = geometry.arithmetic
        self._tie = self._slope if tilt_in_dots else 0.0
        for i, height in enumerate(np.asarray(geometry.heights).tolist()):
            if abs(1.0 + self._tie * height) < 1e-3:
                raise SolverError(
                    f'psd_{i + 1}.height = {height:g} m: there the tip slope (link.slope_ratio = '
                    f'{geometry.slope_ratio:g}) moves the dot back by as much as the deflection moves it: '
                    'the deflection cannot be seen'
                )
        self._centers = tuple(np.asarray(geometry.centers).ravel().tolist())
        self._beams = [(lx, ly) for lx, ly in np.asarray(geometry.beams).tolist()]
        self._heights = np.asarray(geometry.heights).tolist()

    @classmethod
    def options_from_rig(cls, rig: Rig) -> dict[str, Any]:
        """Whether the rig file's effects leave the tilts in the dots."""
        # An effect that says how the plate leans: its correction takes the tilts off.
        return {'tilt_in_dots': not any(k.endswith('.slope_ratio') and v for k, v in rig.effects.items())}

    def solve(self, dots: tuple[float, ...], variances: tuple[float, ...]) -> Solution:
        """One block, pure floats. See :class:`Solver`."""
        q = [c + m for c, m in zip(self._centers, dots, strict=True)]
        start = flat_pose(q, self._beams, self._xp)
        minimum = fit(self._model, start, q, variances, self._xp)
        dx, dy, theta = minimum.parameters
        return answer(minimum, (dx, dy, theta, -self._slope * dy, self._slope * dx), minimum.covariance)

    def _model(self, x: Sequence[float]) -> tuple[list[float], list[Sequence[float]]]:
        dx, dy, theta = x
        tie = self._tie
        pose = dx, dy, theta, -tie * dy, tie * dx
        predicted: list[float] = []
        rows: list[Sequence[float]] = []
        for (lx, ly), height in zip(self._beams, self._heights, strict=True):
            qx, qy, jx, jy = crossing((lx, ly, height), pose, self._xp)
            predicted.append(qx)
            predicted.append(qy)
            rows.append((jx[0] + tie * jx[4], jx[1] - tie * jx[3], jx[2]))
            rows.append((jy[0] + tie * jy[4], jy[1] - tie * jy[3], jy[2]))
        return predicted, rows

    def gain(self, dots: tuple[float, ...], variances: tuple[float, ...], solution: Solution) -> FloatArray:
        """As of a flat plate: the tilts change it by their own size, some thousandths. See :class:`Solver`."""
        return flat_gain(self._centers, dots, variances, solution, self._xp)


def slope_per_metre(geometry: Geometry) -> float:
    """k/L, rad/m. Raises SolverError for a length that is not above 0 or a k that is not finite."""
    length = geometry.link_length
    if not 0.0 < length < float('inf'):
        raise SolverError(f'link.length = {length} m: must be above 0')
    if not abs(geometry.slope_ratio) < float('inf'):
        raise SolverError(f'link.slope_ratio = {geometry.slope_ratio}: must be finite')
    return geometry.slope_ratio / length
