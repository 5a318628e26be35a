# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The tube's cross-section: the part of the stiffness that comes from geometry (thesis A-9 ... A-15, B-1, B-3)."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TubeSection:
    """A circular tube; ``outer_radius`` > ``inner_radius`` >= 0, m."""

    outer_radius: float
    inner_radius: float

    @classmethod
    def from_mean(cls, mean_radius: float, wall: float) -> TubeSection:
        """The tube whose wall of thickness ``wall`` lies half inside, half outside ``mean_radius`` (m)."""
        return cls(mean_radius + wall / 2.0, mean_radius - wall / 2.0)

    @classmethod
    def of_stiffness(cls, second_moment: float, wall: float) -> TubeSection:
        """The tube of that wall (m) with that I (m^4): I = pi r t (r^2 + t^2/4) solved for the mean radius r.

        The cubic r^3 + (t^2/4) r = I/(pi t) has one real root, by Cardano's formula (both terms of
        the left side grow with r, so no other).
        """
        third = wall**2 / 12.0
        half = second_moment / (2.0 * math.pi * wall)
        # Cardano's second term as third/first: the difference would lose half the digits.
        first = math.cbrt(half + math.sqrt(half**2 + third**3))
        return cls.from_mean(first - third / first, wall)

    @property
    def wall(self) -> float:
        """Wall thickness t, m."""
        return self.outer_radius - self.inner_radius

    @property
    def mean_radius(self) -> float:
        """Radius of the wall's middle, m."""
        return (self.outer_radius + self.inner_radius) / 2.0

    @property
    def area(self) -> float:
        """Area of the material, m^2."""
        return math.pi * (self.outer_radius**2 - self.inner_radius**2)

    @property
    def second_moment(self) -> float:
        """I = pi/4 (Ro^4 - Ri^4), m^4, about any diameter (A-13, B-1)."""
        return math.pi / 4.0 * (self.outer_radius**4 - self.inner_radius**4)

    @property
    def polar_moment(self) -> float:
        """J = Ix + Iy = 2 I, m^4 (A-15, B-3, B-7)."""
        return 2.0 * self.second_moment
