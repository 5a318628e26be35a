"""Exact sampled response of one mode to a load held between samples.

q'' + 2 zeta w q' + w^2 q = w^2 u with u constant over each sample period T has the exact pulse
transfer function (b1 z^-1 + b2 z^-2)/(1 + a1 z^-1 + a2 z^-2): the sample at t sees the loads
applied before t, so there is no direct term.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import lfilter

from psd_deflection.records import FloatArray


def mode_coefficients(frequency: float, damping_ratio: float, period: float) -> tuple[FloatArray, FloatArray]:
    """Numerator (3,) and denominator (3,) of one mode; ``frequency`` Hz, ``period`` s.

    Zero-order-hold discretisation of the second-order system, closed form; needs
    0 <= ``damping_ratio`` < 1.
    """
    w = 2.0 * math.pi * frequency
    wd = w * math.sqrt(1.0 - damping_ratio**2)
    e = math.exp(-damping_ratio * w * period)
    c, s = math.cos(wd * period), math.sin(wd * period)
    r = damping_ratio * w / wd * s
    numerator = np.array([0.0, 1.0 - e * (c + r), e * e + e * (r - c)])
    return numerator, np.array([1.0, -2.0 * e * c, e * e])


def lag_coefficients(time_constant: float, period: float) -> tuple[FloatArray, FloatArray]:
    """First-order low-pass tau y' = u - y of a smooth input: numerator (4,), denominator (2,).

    Exact for an input that is a cubic through its last four samples: for modes of tens of hertz at
    1 kHz, linear interpolation between samples would cause an error of 1 % of the lag.
    """
    a = period / time_constant
    e = math.exp(-a)
    # Moments of (s/T)^n under the kernel exp(-(T - s)/tau)/tau over one period.
    if a < 1.0:
        nodes, weights = np.polynomial.legendre.leggauss(12)
        s = 0.5 * (nodes + 1.0)
        kernel = 0.5 * weights * a * np.exp(-a * (1.0 - s))
        moments = [float(kernel @ s**n) for n in range(4)]
    else:
        moments = [-math.expm1(-a)]
        for n in range(1, 4):
            moments.append(1.0 - n / a * moments[-1])
    numerator = np.empty(4)
    places = (1.0, 0.0, -1.0, -2.0)
    for j, place in enumerate(places):
        polynomial = np.polynomial.Polynomial([1.0])
        for other in places:
            if other != place:
                polynomial *= np.polynomial.Polynomial([-other, 1.0]) / (place - other)
        coefficients = np.zeros(4)
        coefficients[: len(polynomial.coef)] = polynomial.coef
        numerator[j] = float(coefficients @ moments)
    return numerator, np.array([1.0, -e])


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
