# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The arithmetic of numpy and the C library."""

import math
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic.matrices import AnyFloats, has_factors, pivots
from psd_deflection.records import FloatArray

ComplexArray = npt.NDArray[np.complex128]


class Arithmetic:
    """As numpy and the C library have it."""

    def sin(self, x: float) -> float:
        """Sine of ``x`` rad."""
        return math.sin(x)

    def cos(self, x: float) -> float:
        """Cosine of ``x`` rad."""
        return math.cos(x)

    def cos_sin(self, x: float) -> tuple[float, float]:
        """Cosine and sine of ``x`` rad."""
        return math.cos(x), math.sin(x)

    def atan2(self, y: float, x: float) -> float:
        """Angle of the vector (x, y), rad."""
        return math.atan2(y, x)

    def exp(self, x: float) -> float:
        """Exponential."""
        return math.exp(x)

    def expm1(self, x: float) -> float:
        """exp(x) - 1, also of small ``x``."""
        return math.expm1(x)

    def atan(self, x: float) -> float:
        """Arc tangent, rad."""
        return math.atan(x)

    def asin(self, x: float) -> float:
        """Arc sine, rad."""
        return math.asin(x)

    def hypot(self, x: float, y: float) -> float:
        """Length of the vector (x, y)."""
        return math.hypot(x, y)

    def root(self, x: float) -> float:
        """Square root."""
        return float(x**0.5)

    def total(self, values: Iterable[float]) -> float:
        """Sum of floats."""
        return float(sum(values))

    def square(self, x: float) -> float:
        """``x`` times itself."""
        return float(x**2)

    def power(self, x: float, n: int) -> float:
        """``x`` to the power ``n``, 1 or more."""
        return float(x**n)

    def sin_many(self, x: FloatArray) -> FloatArray:
        """Sines of ``x`` rad."""
        return np.asarray(np.sin(x))

    def cos_many(self, x: FloatArray) -> FloatArray:
        """Cosines of ``x`` rad."""
        return np.asarray(np.cos(x))

    def tan_many(self, x: FloatArray) -> FloatArray:
        """Tangents of ``x`` rad."""
        return np.asarray(np.tan(x))

    def atan2_many(self, y: FloatArray, x: FloatArray) -> FloatArray:
        """Angles of the vectors (x, y), rad."""
        return np.asarray(np.arctan2(y, x))

    def exp_many(self, x: FloatArray) -> FloatArray:
        """Exponentials."""
        return np.asarray(np.exp(x))

    def log_many(self, x: FloatArray) -> FloatArray:
        """Natural logarithms of ``x``, 0 or more."""
        return np.asarray(np.log(x))

    def power_many(self, x: FloatArray | float, n: int | npt.NDArray[np.int_]) -> FloatArray:
        """``x`` to the power ``n``: whole numbers, 0 or more."""
        return np.asarray(x**n, dtype=np.float64)

    def hypot_many(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Lengths of the vectors (x, y)."""
        return np.asarray(np.hypot(x, y))

    def einsum(self, spec: str, *operands: AnyFloats) -> FloatArray:
        """Products of ``operands``, summed over the indices that the result in ``spec`` lacks, as ``np.einsum``."""
        return np.asarray(np.einsum(spec, *operands))

    def sum(self, values: FloatArray, axis: int) -> FloatArray:
        """Sum over one axis."""
        return np.asarray(values.sum(axis=axis))

    def product(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Matrix product of ``a`` (..., n, m) or (m,) and ``b`` (m, k) or (m,); at most three indices."""
        return np.asarray(a @ b)

    def solve(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """x of a x = b; ``a`` (..., n, n), ``b`` (..., n, k), or (n,) of one matrix."""
        return np.asarray(np.linalg.solve(a, b))

    def least_squares(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """x (n, k) that makes |a x - b| least; ``a`` (m, n) of independent columns, ``b`` (m, k)."""
        return np.asarray(np.linalg.lstsq(a, b, rcond=None)[0])

    def pseudo_inverse(self, a: FloatArray) -> FloatArray:
        """(n, m) of ``a`` (m, n) of independent columns."""
        return np.asarray(np.linalg.pinv(a))

    def inverse_of(self, a: FloatArray) -> FloatArray:
        """Inverse (n, n)."""
        return np.asarray(np.linalg.inv(a))

    def eigen(self, a: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues (n,), ascending, and eigenvectors (n, n), in columns, of symmetric ``a``."""
        values, vectors = np.linalg.eigh(a)
        return values, vectors

    def log_det(self, a: FloatArray) -> FloatArray:
        """log det (...) of positive definite ``a`` (..., n, n)."""
        return np.asarray(np.linalg.slogdet(a)[1])

    def log_det_by_pivots(self, a: FloatArray) -> FloatArray:
        """The same for small ``a``."""
        out: FloatArray = np.zeros(a.shape[:-2])
        for pivot in pivots(a):
            out = out + np.log(pivot)
        return out

    def is_positive(self, a: FloatArray) -> bool:
        """Whether symmetric ``a`` (n, n) is positive definite."""
        return has_factors(a)

    def legendre(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Nodes and weights of Gauss and Legendre's rule over -1 to 1."""
        nodes, weights = np.polynomial.legendre.leggauss(count)
        return nodes, weights

    def times_conjugate(self, a: ComplexArray, b: ComplexArray) -> ComplexArray:
        """Conjugate of ``a`` times ``b``, element by element."""
        return np.asarray(np.conj(a) * b)

    def power_spectrum(self, a: ComplexArray) -> FloatArray:
        """Squares of the sizes of ``a``."""
        return np.asarray(np.abs(a) ** 2)
