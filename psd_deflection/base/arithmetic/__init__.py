# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The arithmetic of the pipeline: the same bits on every processor, or as the libraries have it.

BLAS and LAPACK choose their kernels by the processor. numpy's exponential, logarithm, powers, tangent and complex
products use other instructions where there are wider registers, and the C library's sine and cosine where there is a
fused multiply-add. Each choice rounds differently in the last digit. :data:`FIXED` does the same work by sums,
products, quotients and square roots of single numbers in an order that stands in the source. IEEE 754 says how each
of these is rounded, so there is nothing left to choose. :data:`LIBRARY` calls numpy and the C library, for studies.

numpy adds and multiplies element by element alike everywhere, so that is used. Its sums along an axis are not: their
order is numpy's affair. Its Fourier transform is compiled with multiply-adds on some machines:
:mod:`psd_deflection.base.arithmetic.spectra` has one of our own.

Functions with ``_many`` take arrays, the others floats.
"""

from psd_deflection.base.arithmetic.fixed import FixedArithmetic
from psd_deflection.base.arithmetic.library import Arithmetic
from psd_deflection.base.arithmetic.matrices import in_pairs

LIBRARY = Arithmetic()
FIXED = FixedArithmetic()

__all__ = ['FIXED', 'LIBRARY', 'Arithmetic', 'FixedArithmetic', 'in_pairs']
