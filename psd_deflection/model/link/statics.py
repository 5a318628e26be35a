# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Static deflection of the link tip under a load at the tip, both ways.

The published wrench is the load that gives the measured deflection in this model. The inverse runs
once per block, so it uses plain floats.

A cantilever of bending stiffness EI, torsional stiffness GJ and length L, loaded at its tip
centroid without moments (thesis A-10, A-21; the signs are those of ``link_tip_rest``, right-handed)::

    dX = Fx L^3/3EI        dY = Fy L^3/3EI        theta = Tz L/GJ
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig


@dataclass(frozen=True, slots=True)
class LinkStatics:
    """Tip compliance of one link.

    ``length`` L, m; ``bending_stiffness`` EI, N m^2; ``torsional_stiffness`` GJ, N m^2; all > 0.
    ``clamp_bending`` and ``clamp_torsion``: turn of the clamp per moment at the root, rad/(N m). ``xp``: what computes.
    """

    length: float
    bending_stiffness: float
    torsional_stiffness: float
    clamp_bending: float = 0.0
    clamp_torsion: float = 0.0
    xp: Arithmetic = LIBRARY
    _force: float = field(init=False)
    _twist: float = field(init=False)

    def __post_init__(self) -> None:
        # A force F turns the clamp by its moment F L, which moves the tip by L times that.
        xp, length = self.xp, self.length
        bending = xp.power(length, 3) / (3.0 * self.bending_stiffness) + self.clamp_bending * xp.square(length)
        object.__setattr__(self, '_force', bending)
        object.__setattr__(self, '_twist', self.length / self.torsional_stiffness + self.clamp_torsion)

    @classmethod
    def from_rig(cls, rig: Rig) -> LinkStatics:
        """The link of a parameter file."""
        return cls(rig.link.length, rig.link.bending_stiffness, rig.link.torsional_stiffness)

    @property
    def compliance(self) -> FloatArray:
        """(3, 3): (Fx, Fy, Tz) to (dX, dY, theta); m/N, m/N, rad/(N m) on its diagonal."""
        return np.diag([self._force, self._force, self._twist])

    def deflection(self, fx: float, fy: float, tz: float) -> tuple[float, float, float]:
        """(dX m, dY m, theta rad) under a tip force (N) and torque (N m)."""
        return fx * self._force, fy * self._force, tz * self._twist

    def sag(self, weight_per_length: float) -> float:
        """How far (m) the tip sinks under the link's own weight, N/m, which turns the clamp by its moment w L^2/2."""
        bent = weight_per_length * self.xp.power(self.length, 4) / (8.0 * self.bending_stiffness)
        return bent + self.clamp_bending * weight_per_length * self.xp.power(self.length, 3) / 2.0

    def tip_load(self, dx: float, dy: float, theta: float) -> tuple[float, float, float]:
        """(fx N, fy N, tz N m) at the tip centroid that give this deflection without tip moments."""
        return dx / self._force, dy / self._force, theta / self._twist
