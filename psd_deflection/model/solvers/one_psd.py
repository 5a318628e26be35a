# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Translation from one detector, for the time in which the other cannot be believed.

One dot gives two equations; three unknowns stay undetermined. With the twist *given* as
theta +- sd, the flat plate's model m = R(-theta)(l - d) - c gives d = l - R(theta)(c + m), and its
covariance says what that costs: the dot's own noise, and sd times the arm |c + m|. Nothing is
estimated of the twist: it comes out as it went in.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.model.plate.layout import Geometry

NAME = 'one_psd'


class OnePsd:
    """Bound to ``geometry``; see the module's text."""

    def __init__(self, geometry: Geometry) -> None:
        self._xp = geometry.arithmetic
        self._centers = [(float(x), float(y)) for x, y in np.asarray(geometry.centers)]
        self._beams = [(float(x), float(y)) for x, y in np.asarray(geometry.beams)]

    def solve(
        self, psd: int, dot: tuple[float, float], variances: tuple[float, float], theta: float, theta_variance: float
    ) -> tuple[float, float, tuple[float, ...]]:
        """(dX, dY) m and the 3 x 3 covariance of (dX, dY, theta), row by row.

        ``psd``: 0 or 1. ``dot``: its reading, m; ``variances`` of it, m^2. ``theta`` rad,
        ``theta_variance`` rad^2.
        """
        qx = self._centers[psd][0] + dot[0]
        qy = self._centers[psd][1] + dot[1]
        lx, ly = self._beams[psd]
        c, s = self._xp.cos_sin(theta)
        vx, vy = variances
        # d(d)/d(theta) = -R'(theta) q
        gx = s * qx + c * qy
        gy = -c * qx + s * qy
        xx = c * c * vx + s * s * vy + gx * gx * theta_variance
        yy = s * s * vx + c * c * vy + gy * gy * theta_variance
        xy = c * s * (vx - vy) + gx * gy * theta_variance
        xt, yt = gx * theta_variance, gy * theta_variance
        return lx - (c * qx - s * qy), ly - (s * qx + c * qy), (xx, xy, xt, xy, yy, yt, xt, yt, theta_variance)
