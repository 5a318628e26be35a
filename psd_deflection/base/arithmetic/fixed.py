# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The arithmetic in an order that stands in the source: sums in pairs, elimination, Jacobi's rotations."""

from __future__ import annotations

import numpy as np

from psd_deflection.base.arithmetic.elementary import FixedFunctions
from psd_deflection.base.arithmetic.library import ComplexArray
from psd_deflection.base.arithmetic.matrices import (
    AT_ONCE,
    AnyFloats,
    in_pairs,
    orthogonal,
    pivots,
    plan,
    product_of,
    rotate,
    surely_positive,
)
from psd_deflection.records import FloatArray

_NEWTON_STEPS = 8
"""Newton's method doubles its digits in each step; the first guess of a root of Legendre's polynomial has two."""
_SWEEPS = 30
"""Jacobi's method doubles its digits in each sweep; ten are more than enough for a hundred unknowns."""


class FixedArithmetic(FixedFunctions):
    """Sums in an order that stands in :mod:`psd_deflection.base.arithmetic.matrices`."""

    def einsum(self, spec: str, *operands: AnyFloats) -> FloatArray:
        """See :class:`Arithmetic`. Factors from the left; sums as in :func:`in_pairs`, indices as ``spec`` has them."""
        turns, summed = plan(spec)
        views = [(a if axes is None else a.transpose(axes))[at] for (axes, at), a in zip(turns, operands, strict=True)]
        if summed == 1 and max([a.size for a in operands]) > AT_ONCE:
            # Row by row: the table of all products would not stay in the cache.
            count = max([len(view) for view in views])
            out = np.zeros(np.broadcast_shapes(*[view.shape[1:] for view in views]))
            for row in range(count):
                out += product_of([view[row if len(view) > 1 else 0] for view in views])
            return out
        products = product_of(views)
        if not summed:
            return np.asarray(products, dtype=np.float64)
        return in_pairs(products if summed == 1 else products.reshape(-1, *products.shape[summed:]))

    def sum(self, values: FloatArray, axis: int) -> FloatArray:
        """See :class:`Arithmetic`."""
        if axis:
            # np.moveaxis, which costs more than the sum of a block.
            order = list(range(values.ndim))
            order.insert(0, order.pop(axis))
            values = values.transpose(order)
        return in_pairs(values)

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
        q, r = orthogonal(a)
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
                        rotate(a, vectors, i, j)
        order = np.argsort(np.diag(a), kind='stable')
        return np.diag(a)[order], vectors[:, order]

    def log_det(self, a: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return in_pairs(self.log_many(np.stack(pivots(a))))

    def log_det_by_pivots(self, a: FloatArray) -> FloatArray:
        """See :class:`Arithmetic`."""
        return self.log_det(a)

    def is_positive(self, a: FloatArray) -> bool:
        """See :class:`Arithmetic`. By the pivots, unless the answer is the same however one rounds."""
        sure = surely_positive(a)
        return all(bool(pivot > 0.0) for pivot in pivots(a)) if sure is None else sure

    def legendre(self, count: int) -> tuple[FloatArray, FloatArray]:
        """See :class:`Arithmetic`. By Newton's method on the polynomial."""
        x = -self.cos_many(np.pi * (np.arange(1.0, count + 1.0) - 0.25) / (count + 0.5))
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
