"""The arithmetic of the pipeline: the same bits on every processor, or as the libraries have it.

BLAS and LAPACK choose their kernels by the processor. numpy's exponential, logarithm, powers, tangent and complex
products use other instructions where there are wider registers, and the C library's sine and cosine where there is a
fused multiply-add. Each choice rounds differently in the last digit. :data:`FIXED` does the same work by sums,
products, quotients and square roots of single numbers in an order that stands here. IEEE 754 says how each of these
is rounded, so there is nothing left to choose. :data:`LIBRARY` calls numpy and the C library; recordings from before
the parameter ``arithmetic`` was there are replayed with it.

numpy adds and multiplies element by element alike everywhere, and its Fourier transform has no variants for
processors; so both are used. Its sums along an axis are not: their order is numpy's affair.

Functions with ``_many`` take arrays, the others floats. The elementary functions are series and rational reductions
(Muller, Elementary Functions, 2016, chapters 3 and 11), right to about one unit in the last place for the arguments
of the pipeline: angles up to 10^6 rad, exponents above -700.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cache
from math import factorial, fmod, ldexp, sqrt
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from psd_deflection.records import FloatArray

AnyFloats = npt.NDArray[np.floating[Any]]
ComplexArray = npt.NDArray[np.complex128]
Number = TypeVar('Number', float, FloatArray)


class Arithmetic:
    """As numpy and the C library have it."""

    def sin(self, x: float) -> float:
        """Sine of ``x`` rad."""
        return math.sin(x)

    def cos(self, x: float) -> float:
        """Cosine of ``x`` rad."""
        return math.cos(x)

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
        for pivot in _pivots(a):
            out = out + np.log(pivot)
        return out

    def is_positive(self, a: FloatArray) -> bool:
        """Whether symmetric ``a`` (n, n) is positive definite."""
        try:
            np.linalg.cholesky(a)
        except np.linalg.LinAlgError:
            return False
        return True

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

    def hermitian(self, spec: str, f: ComplexArray, middle: ComplexArray) -> FloatArray:
        """Real part of :meth:`einsum` of ``f``, ``middle`` and the conjugate of ``f``."""
        return np.asarray(np.einsum(spec, f, middle, np.conj(f)).real)


# pi/2 and log 2 in parts: products of the first parts with whole numbers below 2^22 are exact.
_HALF_PI = (1.570796325802803, 9.920935791635221e-10, 5.170182981794105e-19)
_PER_HALF_PI = 0.6366197723675814
_LOG_2 = (0.6931471803691238, 1.9082149292705877e-10)
_PER_LOG_2 = 1.4426950408889634
_TO_WHOLE = 1.5 * 2.0**52
"""Added and taken off again, it rounds a float to the nearest whole number."""
_FAR_ANGLE, _TURN = 1e6, 6.283185307179586
"""rad: of a larger angle whole turns are taken off first. Only a search that diverges asks for it."""
_SIN = tuple((-1.0) ** n / factorial(2 * n + 1) for n in range(8, 0, -1))
_COS = tuple((-1.0) ** n / factorial(2 * n) for n in range(9, 1, -1))
_EXP = tuple(1.0 / factorial(n) for n in range(14, 1, -1))
_LOG = tuple(2.0 / (2 * n + 1) for n in range(12, 0, -1))
_ATAN = tuple((-1.0) ** n / (2 * n + 1) for n in range(8, 0, -1))
_PI, _PI_REST = 3.141592653589793, 1.2246467991473532e-16
_QUARTER, _QUARTER_REST = 1.5707963267948966, 6.123233995736766e-17
_ATAN_AT = (
    0.0,
    0.12435499454676144,
    0.24497866312686414,
    0.35877067027057225,
    0.4636476090008061,
    0.5585993153435624,
    0.6435011087932844,
    0.7188299996216245,
    0.7853981633974483,
)
"""Arc tangents of 0, 1/8 ... 1, and below what these floats leave of them."""
_ATAN_REST = (
    0.0,
    -3.1253241424539383e-18,
    1.0698755618734451e-17,
    -2.4623815582638635e-17,
    2.2698777452961687e-17,
    -5.4556305485916264e-18,
    1.5834785051444286e-17,
    -2.1478388444456983e-17,
    3.061616997868383e-17,
)


def _series(z: Number, coefficients: Sequence[float]) -> Number:
    """The polynomial in ``z`` with these coefficients, the highest first."""
    out = coefficients[0] * z
    for c in coefficients[1:-1]:
        out = (out + c) * z
    return out + coefficients[-1]


def _sin_near(r: Number) -> Number:
    """Of at most an eighth of a turn either way."""
    z = r * r
    return r + r * (z * _series(z, _SIN))


def _cos_near(r: Number) -> Number:
    z = r * r
    half = 0.5 * z
    most = 1.0 - half
    return most + (((1.0 - most) - half) + z * (z * _series(z, _COS)))


def _reduced(x: Number) -> tuple[Number, Number]:
    """Quarter turns in ``x`` and what they leave."""
    k = (x * _PER_HALF_PI + _TO_WHOLE) - _TO_WHOLE
    return k, ((x - k * _HALF_PI[0]) - k * _HALF_PI[1]) - k * _HALF_PI[2]


def _by_quarter(x: float, ahead: int) -> float:
    """Sine of ``x`` and that many quarter turns."""
    if not -_FAR_ANGLE < x < _FAR_ANGLE:
        if not abs(x) < math.inf:
            return math.nan
        x = fmod(x, _TURN)
    k, r = _reduced(x)
    quarter = (int(k) + ahead) & 3
    value = _cos_near(r) if quarter & 1 else _sin_near(r)
    return -value if quarter & 2 else value


def _by_quarter_many(x: FloatArray, ahead: int) -> FloatArray:
    x = np.asarray(x, dtype=np.float64)
    if not bool((np.abs(x) < _FAR_ANGLE).all()):
        known = np.isfinite(x)
        within = np.where(known, x, 0.0)
        within = np.where(np.abs(within) < _FAR_ANGLE, within, np.fmod(within, _TURN))
        x = np.where(known, within, np.nan)
    k, r = _reduced(x)
    quarter = (np.nan_to_num(k).astype(np.int64) + ahead) & 3
    value = np.where(quarter & 1, _cos_near(r), _sin_near(r))
    return np.asarray(np.where(quarter & 2, -value, value))


def _exp_series(r: Number) -> Number:
    """exp(r) - 1 of at most log(2) / 2 either way."""
    return r + r * (r * _series(r, _EXP))


def _log_near(f: Number) -> Number:
    """log(1 + f); 1 + f between the root of 1/2 and that of 2."""
    s = f / (2.0 + f)
    z = s * s
    return 2.0 * s + s * (z * _series(z, _LOG))


def _atan_near(z: Number) -> Number:
    """Of at most 1/16 either way."""
    square = z * z
    return z + z * (square * _series(square, _ATAN))


class FixedArithmetic(Arithmetic):
    """In an order that stands in this module; see there."""

    def sin(self, x: float) -> float:
        """See :class:`Arithmetic`; NaN if ``x`` is not finite."""
        return _by_quarter(x, 0)

    def cos(self, x: float) -> float:
        """See :class:`Arithmetic`; NaN if ``x`` is not finite."""
        return _by_quarter(x, 1)

    def atan2(self, y: float, x: float) -> float:
        """See :class:`Arithmetic`; NaN if one is not finite."""
        across, along = abs(y), abs(x)
        if not (across < math.inf and along < math.inf):
            return math.nan
        steep = across > along
        least, most = (along, across) if steep else (across, along)
        t = least / most if most > 0.0 else 0.0
        k = int(8.0 * t + 0.5)
        at = 0.125 * k
        out = _ATAN_AT[k] + (_atan_near((t - at) / (1.0 + t * at)) + _ATAN_REST[k])
        if steep:
            out = (_QUARTER - out) + _QUARTER_REST
        if math.copysign(1.0, x) < 0.0:
            out = (_PI - out) + _PI_REST
        return math.copysign(out, y)

    def exp(self, x: float) -> float:
        """See :class:`Arithmetic`; 0 below -700."""
        if not x > -700.0:
            return 0.0 if x <= -700.0 else math.nan
        k = (x * _PER_LOG_2 + _TO_WHOLE) - _TO_WHOLE
        return ldexp(1.0 + _exp_series((x - k * _LOG_2[0]) - k * _LOG_2[1]), int(k))

    def expm1(self, x: float) -> float:
        """See :class:`Arithmetic`."""
        return _exp_series(x) if abs(x) < 0.34 else self.exp(x) - 1.0

    def atan(self, x: float) -> float:
        """See :class:`Arithmetic`."""
        return self.atan2(x, 1.0)

    def asin(self, x: float) -> float:
        """See :class:`Arithmetic`. Raises ValueError beyond 1 either way."""
        return self.atan2(x, sqrt((1.0 - x) * (1.0 + x)))

    def hypot(self, x: float, y: float) -> float:
        """See :class:`Arithmetic`."""
        return sqrt(x * x + y * y)

    def root(self, x: float) -> float:
        """See :class:`Arithmetic`."""
        return sqrt(x)

    def total(self, values: Iterable[float]) -> float:
        """See :class:`Arithmetic`. The first one first; Python's ``sum`` carries its rounding along from 3.12 on."""
        out = 0.0
        for value in values:
            out += value
        return out

    def square(self, x: float) -> float:
        """See :class:`Arithmetic`."""
        return x * x

    def power(self, x: float, n: int) -> float:
        """See :class:`Arithmetic`."""
        out = x
        for _ in range(n - 1):
            out *= x
        return out

    def sin_many(self, x: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return _by_quarter_many(x, 0)

    def cos_many(self, x: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return _by_quarter_many(x, 1)

    def tan_many(self, x: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return _by_quarter_many(x, 0) / _by_quarter_many(x, 1)

    def atan2_many(self, y: FloatArray, x: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        across, along = np.abs(y), np.abs(x)
        steep = across > along
        least, most = np.where(steep, along, across), np.where(steep, across, along)
        t = np.divide(least, most, out=np.zeros_like(most), where=most > 0.0)
        known = (across < np.inf) & (along < np.inf)
        k = np.where(known, 8.0 * t + 0.5, 0.0).astype(np.int64)
        at = 0.125 * k
        out = np.take(_ATAN_AT, k) + (_atan_near((t - at) / (1.0 + t * at)) + np.take(_ATAN_REST, k))
        out = np.where(steep, (_QUARTER - out) + _QUARTER_REST, out)
        out = np.where(np.signbit(x), (_PI - out) + _PI_REST, out)
        return np.asarray(np.copysign(np.where(known, out, np.nan), y))

    def exp_many(self, x: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        within = np.maximum(x, -700.0)
        k = (within * _PER_LOG_2 + _TO_WHOLE) - _TO_WHOLE
        out = np.ldexp(1.0 + _exp_series((within - k * _LOG_2[0]) - k * _LOG_2[1]), np.nan_to_num(k).astype(np.int32))
        return np.asarray(np.where(np.asarray(x) <= -700.0, 0.0, out))

    def log_many(self, x: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        size, power = np.frexp(x)
        low = size < 0.7071067811865476
        size, power = np.where(low, 2.0 * size, size), power - low
        out = power * _LOG_2[0] + (power * _LOG_2[1] + _log_near(size - 1.0))
        return np.asarray(np.where(np.asarray(x) > 0.0, out, np.where(np.asarray(x) == 0.0, -np.inf, np.nan)))

    def power_many(self, x: FloatArray | float, n: int | npt.NDArray[np.int_]) -> FloatArray:
        """See :class:`Arithmetic`."""
        out = np.ones(np.broadcast_shapes(np.shape(x), np.shape(n)))
        for done in range(int(np.max(n))):
            out = np.where(done < np.asarray(n), out * x, out)
        return out

    def hypot_many(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return np.asarray(np.sqrt(x * x + y * y))

    def einsum(self, spec: str, *operands: AnyFloats) -> FloatArray:
        """See :class:`Arithmetic`. Factors from the left; sums as in :func:`in_pairs`, indices as ``spec`` has them."""
        turns, summed = _plan(spec)
        views = [(a if axes is None else a.transpose(axes))[at] for (axes, at), a in zip(turns, operands, strict=True)]
        if summed == 1 and max([a.size for a in operands]) > _AT_ONCE:
            # Row by row: the table of all products would not stay in the cache.
            count = max([len(view) for view in views])
            out = np.zeros(np.broadcast_shapes(*[view.shape[1:] for view in views]))
            for row in range(count):
                out += _product([view[row if len(view) > 1 else 0] for view in views])
            return out
        products = _product(views)
        if not summed:
            return np.asarray(products, dtype=np.float64)
        return in_pairs(products if summed == 1 else products.reshape(-1, *products.shape[summed:]))

    def sum(self, values: FloatArray, axis: int) -> FloatArray:
        """See :class:`Arithmetic`."""
        return in_pairs(values if axis == 0 else np.moveaxis(values, axis, 0))

    def product(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        left, right = 'nam'[3 - np.ndim(a) :], 'mb'[: np.ndim(b)]
        return self.einsum(f'{left},{right}->{left[:-1]}{right[1:]}', a, b)

    def solve(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`. By elimination; the row with the largest number of the column is next."""
        rest = np.array(a, dtype=np.float64)
        size = rest.shape[-1]
        out = np.array(b, dtype=np.float64).reshape(*rest.shape[:-1], -1)
        both = np.concatenate((rest, np.broadcast_to(out, (*rest.shape[:-1], out.shape[-1]))), axis=-1)
        for i in range(size):
            best = i + np.argmax(np.abs(both[..., i:, i]), axis=-1)[..., None, None]
            first, other = both[..., i : i + 1, :].copy(), np.take_along_axis(both, best, axis=-2)
            np.put_along_axis(both, best, first, axis=-2)
            pivot = both[..., i : i + 1, :] = other / other[..., i : i + 1]
            for j in range(size):
                if j != i:
                    both[..., j : j + 1, :] -= both[..., j : j + 1, i : i + 1] * pivot
        return np.asarray(both[..., size:]).reshape(np.shape(b) if np.ndim(b) > 1 else (size,))

    def least_squares(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`. By Gram and Schmidt, each column made orthogonal twice."""
        q, r = _orthogonal(a)
        out = self.einsum('mn,mk->nk', q, b)
        for i in range(len(r) - 1, -1, -1):
            for j in range(i + 1, len(r)):
                out[i] -= r[i, j] * out[j]
            out[i] = out[i] / r[i, i] if r[i, i] > 0.0 else 0.0
        return out

    def pseudo_inverse(self, a: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return self.least_squares(a, np.eye(len(a)))

    def inverse_of(self, a: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return self.solve(a, np.eye(len(a)))

    def eigen(self, a: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See :class:`Arithmetic`. By Jacobi's rotations, in turn, until nothing is left beside the diagonal."""
        a, size = np.array(a, dtype=np.float64), len(a)
        vectors = np.eye(size)
        for _ in range(_SWEEPS):
            beside = np.abs(a - np.diag(np.diag(a)))
            if not beside.max() > 1e-17 * np.abs(np.diag(a)).max():
                break
            for i in range(size):
                for j in range(i + 1, size):
                    if a[i, j] != 0.0:
                        _rotate(a, vectors, i, j)
        order = np.argsort(np.diag(a), kind='stable')
        return np.diag(a)[order], vectors[:, order]

    def log_det(self, a: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return in_pairs(self.log_many(np.stack(_pivots(a))))

    def log_det_by_pivots(self, a: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return self.log_det(a)

    def is_positive(self, a: FloatArray) -> bool:
        """See :class:`Arithmetic`."""
        return all(bool(pivot > 0.0) for pivot in _pivots(a))

    def legendre(self, count: int) -> tuple[FloatArray, FloatArray]:
        """See :class:`Arithmetic`. By Newton's method on the polynomial."""
        x = -self.cos_many(_PI * (np.arange(1.0, count + 1.0) - 0.25) / (count + 0.5))
        slope = x
        for _ in range(_NEWTON_STEPS):
            before, value = np.ones(count), x
            for n in range(2, count + 1):
                before, value = value, ((2.0 * n - 1.0) * x * value - (n - 1.0) * before) / n
            slope = count * (x * value - before) / (x * x - 1.0)
            x = x - value / slope
        return x, 2.0 / ((1.0 - x * x) * slope * slope)

    def times_conjugate(self, a: ComplexArray, b: ComplexArray) -> ComplexArray:
        """See :class:`Arithmetic`."""
        out = np.empty(np.broadcast_shapes(a.shape, b.shape), dtype=np.complex128)
        out.real = a.real * b.real + a.imag * b.imag
        out.imag = a.real * b.imag - a.imag * b.real
        return out

    def power_spectrum(self, a: ComplexArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return np.asarray(a.real * a.real + a.imag * a.imag)

    def hermitian(self, spec: str, f: ComplexArray, middle: ComplexArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        fr, fi, mr, mi = (np.ascontiguousarray(part) for part in (f.real, f.imag, middle.real, middle.imag))
        out = self.einsum(spec, fr, mr, fr) + self.einsum(spec, fr, mi, fi)
        return out + (self.einsum(spec, fi, mr, fi) - self.einsum(spec, fi, mi, fr))


_AT_ONCE = 1 << 15
"""Numbers of an operand up to which a table of all products is made."""
_NEWTON_STEPS = 8
_SWEEPS = 30
"""Jacobi's method doubles its digits in each sweep; ten are more than enough for a hundred unknowns."""


@cache
def _plan(spec: str) -> tuple[tuple[tuple[tuple[int, ...] | None, tuple[Any, ...]], ...], int]:
    """How each operand is turned so that the summed indices come first; and the number of these."""
    left, _, out = spec.partition('->')
    terms = left.split(',')
    summed = ''.join(dict.fromkeys(c for c in left if c not in out and c != ','))
    order = summed + out
    turns = []
    for term in terms:
        axes = tuple(term.index(c) for c in order if c in term)
        if len(axes) != len(term):
            raise ValueError(f'{spec}: an index is twice in {term}')
        at = tuple(slice(None) if c in term else None for c in order)
        turns.append((axes if axes != tuple(range(len(axes))) else None, at))
    return tuple(turns), len(summed)


def _product(factors: Sequence[AnyFloats]) -> AnyFloats:
    """From the left; the first index is the slowest in memory."""
    out = factors[0]
    for factor in factors[1:]:
        out = np.multiply(out, factor, order='C')
    return out


def in_pairs(rows: AnyFloats) -> FloatArray:
    """Sum of ``rows`` (n, ...): the first half to the second until one row is left; zeros of none.

    A row without a partner goes to the first pair. Adding in pairs rounds less than adding in turn, and takes fewer
    calls.
    """
    rest = np.asarray(rows, dtype=np.float64)
    if not len(rest):
        return np.zeros(rest.shape[1:])
    while (count := len(rest)) > 1:
        half = count // 2
        pairs = rest[:half] + rest[half : 2 * half]
        if count & 1:
            pairs[0] += rest[-1]
        rest = pairs
    return np.asarray(rest[0])


def _orthogonal(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Q (m, n) with orthonormal columns and R (n, n), 0 below the diagonal, of ``a`` (m, n) = Q R.

    A column that depends on those before it has 0 in both.
    """
    columns = np.array(a.T, dtype=np.float64)
    r = np.zeros((len(columns), len(columns)))
    for i, column in enumerate(columns):
        size = sqrt(float(in_pairs(column * column)))
        # Twice: once leaves rounding that shows.
        for _ in range(2):
            for j in range(i):
                part = float(in_pairs(columns[j] * column))
                r[j, i] += part
                column -= part * columns[j]
        left = sqrt(float(in_pairs(column * column)))
        r[i, i] = left if left > 1e-13 * size else 0.0
        column[:] = column / left if left > 1e-13 * size else 0.0
    return columns.T, r


def _pivots(a: FloatArray) -> list[FloatArray]:
    """Pivots (...) of the elimination of symmetric ``a`` (..., n, n); it ends at one that is not above 0."""
    rest, out = np.asarray(a, dtype=np.float64), []
    while rest.shape[-1]:
        pivot, row = rest[..., 0, 0], rest[..., 0, 1:]
        out.append(np.asarray(pivot))
        if not bool((pivot > 0.0).all()):
            break
        rest = rest[..., 1:, 1:] - row[..., :, None] * (row / pivot[..., None])[..., None, :]
    return out


def _rotate(a: FloatArray, vectors: FloatArray, i: int, j: int) -> None:
    """Turn axes ``i`` and ``j`` so that the element that they share is 0 (Golub & Van Loan, 8.5)."""
    between = float(a[i, j])
    tau = (float(a[j, j]) - float(a[i, i])) / (2.0 * between)
    t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + sqrt(1.0 + tau * tau))
    c = 1.0 / sqrt(1.0 + t * t)
    s = t * c
    for rows in (a, a.T, vectors.T):
        first, second = rows[i].copy(), rows[j].copy()
        rows[i] = c * first - s * second
        rows[j] = s * first + c * second
    a[i, j] = a[j, i] = 0.0


LIBRARY = Arithmetic()
FIXED = FixedArithmetic()
ARITHMETICS: MappingProxyType[str, Arithmetic] = MappingProxyType({'fixed': FIXED, 'library': LIBRARY})
"""By the value of the parameter ``arithmetic``."""
