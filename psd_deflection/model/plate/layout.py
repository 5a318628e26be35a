# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where the PSDs, the beams and the link are, as every solver takes them; an unsolvable layout is rejected with the
reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psd_deflection.base.arithmetic import FIXED, LIBRARY, Arithmetic
from psd_deflection.base.errors import SolverError
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig

SMALLEST_BASE_LINE = 1e-6
"""m. Beams closer together than the noise of a dot count as one beam."""


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """The layout of P PSDs and their beams.

    ``centers`` (P, 2): c_i, m, in ``link_tip``. ``zeros`` (P, 2): m_i0, the dots before load, m.
    ``heights`` (P,): h_i, the sensitive surface above the reference section, m (``base_pair``: -L_i).
    ``link_length``: L, m. ``slope_ratio``: k of phi = -k dY/L, omega = +k dX/L. ``arithmetic``: what solvers compute
    with.
    """

    centers: FloatArray
    zeros: FloatArray
    heights: FloatArray
    link_length: float
    slope_ratio: float = 1.5
    arithmetic: Arithmetic = LIBRARY

    @classmethod
    def from_rig(cls, rig: Rig) -> Geometry:
        """The geometry that ``psd_N.center``, ``.zero``, ``.height`` and ``link`` of a parameter file
        describe.
        """
        return cls(rig.centers, rig.zeros, rig.heights, rig.link.length, rig.link.slope_ratio, FIXED)

    @property
    def beams(self) -> FloatArray:
        """l_i = c_i + m_i0, (P, 2), m."""
        return self.centers + self.zeros


def check_shapes(geometry: Geometry) -> int:
    """The number P of PSDs, after checking that the arrays agree and are finite.

    Raises SolverError.
    """
    centers = np.asarray(geometry.centers)
    if centers.ndim != 2 or centers.shape[1] != 2:
        raise SolverError(f'geometry: centers has shape {centers.shape}: must be (number of PSDs, 2)')
    count = int(centers.shape[0])
    if count < 2:
        raise SolverError(
            f'geometry: {count} PSD: one dot cannot tell a twist from a translation; at least 2 are needed'
        )
    if np.shape(geometry.zeros) != centers.shape or np.shape(geometry.heights) != (count,):
        raise SolverError(f'geometry: centers, zeros and heights must all be of the same {count} PSDs')
    for name in ('centers', 'zeros', 'heights'):
        if not np.isfinite(getattr(geometry, name)).all():
            raise SolverError(f'geometry: {name} must be finite')
    return count


def check_twist(geometry: Geometry) -> int:
    """The number P of PSDs, after checking that their beams do not coincide.

    For two PSDs det(A^T A) = 2 |l_1 - l_2|^2, so a flat plate needs no more than distinct beams
    (the thesis's 4.21 *and* 4.22 ask too much). Raises SolverError.
    """
    count = check_shapes(geometry)
    beams = geometry.beams
    base_line = float(np.hypot(*np.ptp(beams, axis=0)))
    if base_line < SMALLEST_BASE_LINE:
        x, y = (float(v) for v in beams[0])
        names = ' and '.join(f'psd_{i + 1}' for i in range(count))
        raise SolverError(
            f'the beams of {names} coincide at ({x:g}, {y:g}) m: the twist cannot be seen; '
            'set psd_1.center and psd_2.center apart'
        )
    return count


Vector = tuple[float, float, float]
Box = tuple[Vector, Vector]
"""Centre and size, m."""


def bend(places: FloatArray) -> FloatArray:
    """Deflection at ``places`` (1: the tip) over that of the tip: a cantilever under a force at its tip."""
    return np.asarray(places**2 * (3.0 - places) / 2.0)


def tip_boxes(rig: Rig) -> list[Box]:
    """The plate, then each detector, in ``link_tip`` (the plate's axes)."""
    xs, ys = ([0.0, *(p.center[i] for p in rig.psds)] for i in (0, 1))
    side = 0.03
    middle = ((max(xs) + min(xs)) / 2, (max(ys) + min(ys)) / 2, 0.003)
    plate = (middle, (max(xs) - min(xs) + side, max(ys) - min(ys) + side, 0.004))
    return [plate, *(((*p.center, p.height), (*p.active_area, 0.002)) for p in rig.psds)]
