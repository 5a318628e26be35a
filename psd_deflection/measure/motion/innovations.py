# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How well a filter predicted what it then saw."""

from __future__ import annotations

import math
from typing import NamedTuple


class Innovations(NamedTuple):
    """How well the filter predicted the samples so far.

    ``squares``: sums of the normalised innovations squared (NIS) of dX, dY, theta; each has the
    mean 1 a sample.
    """

    squares: tuple[float, ...] = (0.0, 0.0, 0.0)
    samples: int = 0

    def since(self, before: Innovations) -> Innovations:
        """Those that came after ``before``."""
        squares = tuple(now - then for now, then in zip(self.squares, before.squares, strict=True))
        return Innovations(squares, self.samples - before.samples)

    def means(self) -> tuple[float, ...]:
        """NIS a sample, of dX, dY, theta; 0 without samples."""
        return tuple(square / max(self.samples, 1) for square in self.squares)

    def band(self, deviations: float) -> tuple[float, float]:
        """Where the mean NIS is, up to so many standard deviations: of a chi-square with a degree for each sample."""
        half = deviations * math.sqrt(2.0 / max(self.samples, 1))
        return max(1.0 - half, 0.0), 1.0 + half
