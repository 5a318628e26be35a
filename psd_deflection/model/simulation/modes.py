# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Exact sampled response of one mode to a load held between samples.

q'' + 2 zeta w q' + w^2 q = w^2 u with u constant over each sample period T has the exact pulse
transfer function (b1 z^-1 + b2 z^-2)/(1 + a1 z^-1 + a2 z^-2): the sample at t sees the loads
applied before t, so there is no direct term.
"""

import math

import numpy as np
from scipy.signal import lfilter

from psd_deflection.records import FloatArray


def mode_coefficients(
    frequency: float, damping_ratio: float, period: float, phase: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Numerator (3,) and denominator (3,) of one mode; ``frequency`` Hz, ``period`` s.

    ``phase``: the output is taken this long after each sample, below ``period``, s. Zero-order-hold
    discretisation of the second-order system, closed form; needs 0 <= ``damping_ratio`` < 1.
    """
    w = 2.0 * math.pi * frequency
    wd = w * math.sqrt(1.0 - damping_ratio**2)
    e = math.exp(-damping_ratio * w * period)
    c, s = math.cos(wd * period), math.sin(wd * period)
    r = damping_ratio * w / wd * s
    denominator = np.array([1.0, -2.0 * e * c, e * e])
    if phase == 0.0:
        return np.array([0.0, 1.0 - e * (c + r), e * e + e * (r - c)]), denominator
    # From place and speed at the sample, x+ = phi x + gamma u, the output is x's free motion and u's share.
    decay = math.exp(-damping_ratio * w * phase)
    speed = decay * math.sin(wd * phase) / wd
    place = decay * math.cos(wd * phase) + damping_ratio * w * speed
    phi_11, phi_12 = e * (c + r), e * s / wd
    phi = ((phi_11, phi_12), (-w * w * phi_12, phi_11 - 2.0 * damping_ratio * w * phi_12))
    gamma = (1.0 - phi_11, w * w * phi_12)
    numerator = (1.0 - place) * denominator
    numerator[1] += place * gamma[0] + speed * gamma[1]
    numerator[2] += place * (phi[0][1] * gamma[1] - phi[1][1] * gamma[0])
    numerator[2] += speed * (phi[1][0] * gamma[0] - phi[0][0] * gamma[1])
    return numerator, denominator


LAG_NODES = (0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0)
"""Where in an interval the input of a lag is read. Held loads leave kinks between intervals, and none inside."""


def lag_weights(time_constant: float, interval: float) -> FloatArray:
    """What inputs at ``LAG_NODES`` of an interval (s) add to tau y' = u - y at its end, (4,).

    y at its start counts exp(-interval/tau). Exact for an input that is a cubic there.
    """
    a = interval / time_constant
    # Moments of s^n under the kernel a exp(-a (1 - s)) over the interval.
    if a < 1.0:
        nodes, weights = np.polynomial.legendre.leggauss(12)
        s = 0.5 * (nodes + 1.0)
        kernel = 0.5 * weights * a * np.exp(-a * (1.0 - s))
        moments = [float(kernel @ s**n) for n in range(4)]
    else:
        moments = [-math.expm1(-a)]
        for n in range(1, 4):
            moments.append(1.0 - n / a * moments[-1])
    # The weights that give these moments.
    return np.linalg.solve(np.vander(LAG_NODES, increasing=True).T, moments)


def held_lag_coefficients(time_constant: float, period: float) -> tuple[FloatArray, FloatArray]:
    """First-order low-pass of an input that is held between samples (zero-order hold), exact."""
    e = math.exp(-period / time_constant)
    return np.array([0.0, 1.0 - e]), np.array([1.0, -e])


class Filter:
    """A linear filter with state: any splitting of its input gives the same output, bit for bit.

    ``start``: the constant input before the first sample (the filter is settled on it).
    """

    __slots__ = ('_a', '_b', '_state')

    def __init__(self, coefficients: tuple[FloatArray, FloatArray], start: float = 0.0) -> None:
        b, a = coefficients
        n = max(len(a), len(b))
        self._b, self._a = np.zeros(n), np.zeros(n)
        self._b[: len(b)], self._a[: len(a)] = b, a
        # Settled state of the transposed direct form II with unit gain at rest.
        state = np.zeros(n - 1)
        tail = 0.0
        for i in range(n - 2, -1, -1):
            tail += self._b[i + 1] - self._a[i + 1]
            state[i] = tail
        self._state = state * start

    def __call__(self, u: FloatArray) -> FloatArray:
        """Filter the next (n,) samples."""
        if u.size == 0:
            return u.copy()
        y, self._state = lfilter(self._b, self._a, u, zi=self._state)
        return np.asarray(y, dtype=np.float64)
