# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``pytest --shaken``: every answer of LAPACK and of the optimisers is off by a last bit, another one at each call.

Which bits LAPACK gives depends on the processor. A test that compares two of its answers exactly passes on the machine
of its author and fails on another. Here it fails on every machine. What is promised bit for bit does not go through
LAPACK (:mod:`psd_deflection.base.arithmetic`), so such tests pass all the same. A test that is marked ``repeatable``
asks whether the same computation gives the same answer again on one machine: there the same question has the same
answer.
"""

import functools
import zlib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

NUMPY = (
    'solve', 'inv', 'pinv', 'lstsq', 'svd', 'svdvals', 'eig', 'eigh', 'eigvals', 'eigvalsh', 'cholesky', 'qr',
    'slogdet', 'det', 'norm', 'cond',
)  # fmt: skip
SCIPY = ('solve', 'inv', 'pinv', 'lstsq', 'svd', 'eigh', 'cholesky', 'cho_factor', 'cho_solve', 'qr')
OPTIMISERS = ('least_squares', 'minimize', 'minimize_scalar', 'curve_fit', 'brentq', 'nnls', 'lsq_linear')


def _question(parts: Iterable[Any]) -> int:
    """A number for the numbers among ``parts``."""
    number = 0
    for part in parts:
        if isinstance(part, (np.ndarray, list, tuple, float, int)):
            number = zlib.crc32(np.asarray(part, dtype=np.float64).tobytes(), number)
    return number


def _shaken(answer: Any, rng: np.random.Generator) -> Any:
    """``answer`` with each of its floats changed by one part in 2^52 or not at all."""
    if isinstance(answer, np.ndarray) and answer.dtype == np.float64:
        return answer * (1.0 + np.spacing(1.0) * rng.integers(-1, 2, answer.shape))
    if isinstance(answer, (float, np.float64)):
        return type(answer)(answer * (1.0 + np.spacing(1.0) * int(rng.integers(-1, 2))))
    if isinstance(answer, tuple):
        parts = [_shaken(part, rng) for part in answer]
        return type(answer)(*parts) if hasattr(answer, '_fields') else tuple(parts)
    if isinstance(answer, dict) and 'x' in answer:
        # scipy.optimize.OptimizeResult
        answer['x'] = _shaken(answer['x'], rng)
    return answer


class Shaker:
    """Shakes what functions return. A test is shaken alike each time, whatever ran before it."""

    def __init__(self) -> None:
        self.begin('', repeatable=False)

    def begin(self, test: str, *, repeatable: bool) -> None:
        """A test of that name begins; ``repeatable``: it may ask the same twice and compare."""
        self._rng = np.random.default_rng(zlib.crc32(test.encode()))
        self._repeatable = repeatable

    def around(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function`` with shaken answers."""

        @functools.wraps(function)
        def shaken(*args: Any, **kwargs: Any) -> Any:
            rng = np.random.default_rng(_question((*args, *kwargs.values()))) if self._repeatable else self._rng
            return _shaken(function(*args, **kwargs), rng)

        return shaken


def shake() -> Shaker:
    """Shake numpy and scipy for the rest of the process; call it before anything imports their functions by name."""
    import scipy.linalg
    import scipy.optimize

    shaker = Shaker()
    for module, names in ((np.linalg, NUMPY), (scipy.linalg, SCIPY), (scipy.optimize, OPTIMISERS)):
        for name in names:
            # Not every version has each of them.
            if hasattr(module, name):
                setattr(module, name, shaker.around(getattr(module, name)))
    return shaker
