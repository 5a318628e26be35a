# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fourier transforms and products of series with themselves, with the same bits on every machine.

The transforms of numpy are compiled with multiply-adds where the processor has them (aarch64), and round differently.
"""

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from psd_deflection.base.arithmetic.fixed import FixedArithmetic
from psd_deflection.records import FloatArray

_BY = FixedArithmetic()
_MANTISSA = 52
"""Bits of a sum of whole numbers that float64 holds in any order of the sum, one of 53 left for its sign."""


def lagged_products(series: FloatArray, lags: int) -> FloatArray:
    """(c, d, lags): sum over t of ``series[t, c] * series[t + lag, d]``; ``series`` (n, c), finite.

    The series are rounded to whole multiples of a 2^-k of their largest number, so few bits that every partial sum of
    products is a whole number that float64 holds: no order of the sum and no multiply-add changes it. With 1000
    samples a multiple is 5e-7 of the largest number, with 50,000 it is 4e-6.
    """
    count = series.shape[1]
    bits = (_MANTISSA - len(series).bit_length()) // 2
    powers = [math.frexp(largest)[1] - bits for largest in np.abs(series).max(axis=0).tolist()]
    units = np.array([math.ldexp(1.0, power) for power in powers])
    integers = np.rint(series / units)
    out = np.empty((count, count, lags))
    for lag in range(lags):
        out[:, :, lag] = integers[: len(integers) - lag].T @ integers[lag:]
    return np.asarray(out * (units[:, None, None] * units[:, None]))


def transform(series: FloatArray) -> npt.NDArray[np.complex128]:
    """Discrete Fourier transform (n // 2 + 1, c) of real ``series`` (n, c), as ``np.fft.rfft`` along the first axis.

    By the prime factors of n (Cooley and Tukey), two series at a time as the parts of a complex one.
    """
    n, count = series.shape
    pairs = np.zeros((n, count + count % 2))
    pairs[:, :count] = series
    re, im = _rotated(pairs[:, 0::2], pairs[:, 1::2])
    half = n // 2 + 1
    mirrored = -np.arange(half) % n
    out = np.empty((half, pairs.shape[1]), dtype=np.complex128)
    out.real[:, 0::2] = 0.5 * (re[:half] + re[mirrored])
    out.imag[:, 0::2] = 0.5 * (im[:half] - im[mirrored])
    out.real[:, 1::2] = 0.5 * (im[:half] + im[mirrored])
    out.imag[:, 1::2] = 0.5 * (re[mirrored] - re[:half])
    return out[:, :count]


def _rotated(re: FloatArray, im: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The transform (n, c), as real and imaginary parts, of a complex series (n, c)."""
    n, count = re.shape
    if n == 1:
        return re, im
    factor = next(p for p in range(2, n + 1) if n % p == 0 or p * p > n)
    factor = factor if n % factor == 0 else n
    rest = n // factor
    of_rest = [part.reshape(rest, factor, count) for part in _rotated(*_split(re, im, rest))]
    cos, sin, own_cos, own_sin = _twiddles(n, factor)
    tr = of_rest[0] * cos - of_rest[1] * sin
    ti = of_rest[0] * sin + of_rest[1] * cos
    out_re, out_im = np.empty((2, factor, rest, count))
    out_re[:], out_im[:] = tr[:, 0], ti[:, 0]
    for r in range(1, factor):
        c, s = own_cos[r], own_sin[r]
        out_re += c * tr[:, r] - s * ti[:, r]
        out_im += s * tr[:, r] + c * ti[:, r]
    return out_re.reshape(n, count), out_im.reshape(n, count)


def _split(re: FloatArray, im: FloatArray, rest: int) -> tuple[FloatArray, FloatArray]:
    return re.reshape(rest, -1), im.reshape(rest, -1)


@lru_cache(maxsize=64)
def _twiddles(n: int, factor: int) -> tuple[FloatArray, ...]:
    """Cosines and sines before the last step (n / factor, factor, 1) and in it (factor, factor, 1, 1)."""
    rest = n // factor
    steps = np.arange(rest)[:, None] * np.arange(factor) % n
    inner = np.arange(factor)[:, None] * np.arange(factor) % factor
    first, last = (np.asarray(-2.0 * math.pi * at / size, np.float64) for at, size in ((steps, n), (inner, factor)))
    before = [f(first)[:, :, None] for f in (_BY.cos_many, _BY.sin_many)]
    return *before, *(f(last)[:, :, None, None] for f in (_BY.cos_many, _BY.sin_many))
