"""Static deflection of the link tip under a load at the tip, both ways.

The wrench that is published is the load that this model needs for the deflection that was
measured, so the inverse runs once a block: plain floats. Replay, simulation and the error budget
take the vectorised twins, which give the same numbers to the last bit.

A cantilever of bending stiffness EI, torsional stiffness GJ and length L, loaded at its tip
centroid (thesis A-10, A-21, superposed; the signs are those of ``link_tip_rest``, right-handed)::

    dX    = Fx L^3/3EI + My L^2/2EI        omega = Fx L^2/2EI + My L/EI
    dY    = Fy L^3/3EI - Mx L^2/2EI        phi   = Mx L/EI   - Fy L^2/2EI
    theta = Tz L/GJ
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from psd_deflection.config import Rig
from psd_deflection.records import FloatArray


@dataclass(frozen=True, slots=True)
class LinkStatics:
    """Tip compliance of one link.

    ``length`` L, m; ``bending_stiffness`` EI, N m^2; ``torsional_stiffness`` GJ, N m^2; all > 0.
    """

    length: float
    bending_stiffness: float
    torsional_stiffness: float
    _force: float = field(init=False, repr=False, compare=False)
    _cross: float = field(init=False, repr=False, compare=False)
    _moment: float = field(init=False, repr=False, compare=False)
    _twist: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        length, stiffness = self.length, self.bending_stiffness
        object.__setattr__(self, '_force', length**3 / (3.0 * stiffness))
        object.__setattr__(self, '_cross', length**2 / (2.0 * stiffness))
        object.__setattr__(self, '_moment', length / stiffness)
        object.__setattr__(self, '_twist', length / self.torsional_stiffness)

    @classmethod
    def from_rig(cls, rig: Rig) -> LinkStatics:
        """The link of a parameter file."""
        return cls(rig.link.length, rig.link.bending_stiffness, rig.link.torsional_stiffness)

    @property
    def compliance(self) -> FloatArray:
        """(3, 3): (Fx, Fy, Tz) to (dX, dY, theta); m/N, m/N, rad/(N m) on its diagonal."""
        return np.diag([self._force, self._force, self._twist])

    @property
    def full_compliance(self) -> FloatArray:
        """(5, 5): (Fx, Fy, Tz, Mx, My) to (dX, dY, theta, phi, omega); symmetric (Maxwell).

        Units: m/N for force to translation, rad/N = m/(N m) for the cross terms, rad/(N m).
        """
        f, c, m, t = self._force, self._cross, self._moment, self._twist
        return np.array(
            [
                [f, 0.0, 0.0, 0.0, c],
                [0.0, f, 0.0, -c, 0.0],
                [0.0, 0.0, t, 0.0, 0.0],
                [0.0, -c, 0.0, m, 0.0],
                [c, 0.0, 0.0, 0.0, m],
            ]
        )

    def deflection(
        self, fx: float, fy: float, tz: float, mx: float = 0.0, my: float = 0.0
    ) -> tuple[float, float, float]:
        """(dX m, dY m, theta rad) under a tip force (N), torque and tip moments (N m)."""
        return fx * self._force + my * self._cross, fy * self._force - mx * self._cross, tz * self._twist

    def slopes(self, fx: float, fy: float, mx: float = 0.0, my: float = 0.0) -> tuple[float, float]:
        """Tip tilts (phi, omega), rad, about X and Y, under the same load."""
        return mx * self._moment - fy * self._cross, fx * self._cross + my * self._moment

    def tip_load(self, dx: float, dy: float, theta: float) -> tuple[float, float, float]:
        """(fx N, fy N, tz N m) at the tip centroid that give this deflection without tip moments."""
        return dx / self._force, dy / self._force, theta / self._twist

    def deflections(self, loads: FloatArray) -> FloatArray:
        """(n, 3) of (dX, dY, theta) for (n, 3) of (Fx, Fy, Tz) or (n, 5) with Mx, My appended."""
        out: FloatArray = loads[:, :3] * np.array([self._force, self._force, self._twist])
        if loads.shape[1] == 5:
            out[:, 0] += loads[:, 4] * self._cross
            out[:, 1] -= loads[:, 3] * self._cross
        return out

    def tip_loads(self, poses: FloatArray) -> FloatArray:
        """(n, 3) of (Fx, Fy, Tz) for (n, 3) of (dX, dY, theta)."""
        out: FloatArray = poses / np.array([self._force, self._force, self._twist])
        return out
