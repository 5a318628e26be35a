# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The readings too many of three and more PSDs: whether all belong to one pose, and which PSD does not.

With residual r of the readings, their covariance C and slopes J by the p unknowns, what no pose explains has

    chi-square = r^T Q r,     Q = W - W J (J^T W J)^-1 J^T W,     W = C^-1,

of 2P - p degrees of freedom (generalised least squares; Q J = 0, so r may come from any solver). If PSD i alone is
wrong, it is wrong by e_i = Q_ii^-1 (Q r)_i (Baarda's data snooping, by pairs). A PSD is wrong if the readings
contradict each other with it and agree without it, and no other PSD could be blamed. It is then left out for a second:
while the link rings, its readings may be right for a block. If several PSDs could be blamed, or none alone, the
covariance is widened by what each would cause. One degree of freedom (``pose`` with three PSDs) tells no PSD from
another: then each reading could be blamed. A residual that lasts is widened for at a smaller size than that of a single
block, as with two PSDs.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.measure.uncertainty.block_fit import inverse
from psd_deflection.measure.uncertainty.consistency import LASTING, SLOWLY, ConsistencyCheck
from psd_deflection.records import FloatArray

CONTRADICTS, DOUBTFUL = 5.7330e-7, 0.01
"""Shares of sound blocks that are taken for contradictory, and for doubtful: those of two PSDs (``consistency``)."""

HOLD = 50
"""Blocks for which a wrong PSD is left out after its last contradiction: a second at 50 blocks a second."""

_MORE = 1.5
"""Times the error of one PSD alone, as for two PSDs."""

_FADE = 0.98
"""What is left of a held square after a block."""

_UNSEEN = 4e-4
"""A reading of which a smaller share shows in what is redundant cannot be checked."""


class Redundancy:
    """Checks the readings of block after block. It remembers who was wrong lately, and by how much."""

    def __init__(self, psds: int, unknowns: int, by: Arithmetic = FIXED) -> None:
        """``psds``: P. ``unknowns``: p; with as many readings or fewer nothing is redundant."""
        self._psds = psds
        self._by = by
        self.freedom = max(2 * psds - unknowns, 0)
        # Imported here: it takes a fifth of a second, and few rigs have more than two PSDs.
        from scipy.special import chdtri

        self._limit, self._doubtful = (
            float(chdtri(self.freedom, share)) if self.freedom else 0.0 for share in (CONTRADICTS, DOUBTFUL)
        )
        self._wrong = 0
        self._left = 0
        self._held = np.zeros(2 * psds)
        self._mean, self._lasting = np.zeros(2 * psds), np.zeros(2 * psds)

    def agrees(self, residual: tuple[float, ...], slopes: FloatArray, covariance: FloatArray, times: float) -> bool:
        """Whether these readings agree with each other, and there are enough of them to tell; as :meth:`check`."""
        if not self.freedom:
            return False
        r = np.array(residual)
        chi_square = float(self._by.einsum('i,ij,j->', r, _unexplained(slopes, covariance, self._by), r))
        return chi_square <= times * self._limit

    def check(
        self,
        residual: tuple[float, ...],
        slopes: FloatArray,
        covariance: FloatArray,
        times: float,
        agree_without: Callable[[int], bool] | None = None,
    ) -> ConsistencyCheck:
        """Check one block: ``residual`` (2P,) m, ``slopes`` (2P, p), ``covariance`` (2P, 2P) m^2.

        ``times``: by how much more chi-square may be, while the noise is not known. ``agree_without``: whether the
        readings of this block agree without a PSD (from 1), by a fit of their own: that of all readings mixes a wrong
        one into the others. None: none may be left out. :attr:`Checked.wrong` is the PSD to leave out.
        """
        none = (0.0,) * len(residual)
        if not self.freedom:
            return ConsistencyCheck(0.0, False, none, none, 0, 0)
        q = _unexplained(slopes, covariance, self._by)
        r = np.array(residual)
        pull = self._by.einsum('ij,j->i', q, r)
        chi_square = max(float(self._by.sum(r * pull, 0)), 0.0)
        errors = self._errors(q, pull)
        contradict = chi_square > times * self._limit
        suspects: list[int] = []
        if agree_without is None:
            self._wrong = 0
        elif contradict:
            suspects = [psd for psd in range(1, self._psds + 1) if agree_without(psd)]
            if self._wrong not in suspects:
                self._wrong = suspects[0] if len(suspects) == 1 else 0
            self._left = HOLD if self._wrong else 0
        elif self._wrong:
            self._left -= 1
            self._wrong = self._wrong if self._left > 0 and agree_without(self._wrong) else 0
        self._last(q, r, times)
        possible = self._possible(q, errors, suspects, chi_square, contradict and not self._wrong, times)
        if self._wrong:
            return ConsistencyCheck(chi_square, True, tuple(errors), none, self._wrong, self.freedom)
        held = bool(self._held.any())
        return ConsistencyCheck(
            chi_square, contradict or held, tuple(errors), tuple(possible.tolist()), 0, self.freedom
        )

    def _errors(self, q: FloatArray, pull: FloatArray) -> list[float]:
        """The error (2P,) m of each PSD if it alone is wrong; with one degree of freedom of each reading."""
        if self.freedom < 3:
            least = _UNSEEN * float(q.max())
            return [p / own if own > least else 0.0 for own, p in zip(np.diag(q).tolist(), pull.tolist(), strict=True)]
        errors: list[float] = []
        for psd in range(self._psds):
            (a, b), (_, d) = q[2 * psd : 2 * psd + 2, 2 * psd : 2 * psd + 2].tolist()
            u, v = pull[2 * psd : 2 * psd + 2].tolist()
            determinant = a * d - b * b
            if determinant > _UNSEEN * a * d:
                x, y = (d * u - b * v) / determinant, (a * v - b * u) / determinant
            else:
                # It is seen in one direction only.
                x, y = u / (a + d), v / (a + d)
            errors += [x, y]
        return errors

    def _last(self, q: FloatArray, r: FloatArray, times: float) -> None:
        """Take the residual into the mean of the last blocks, and hold the errors of one that lasts."""
        self._mean = self._mean + SLOWLY * (r - self._mean)
        pull = self._by.einsum('ij,j->i', q, self._mean)
        squares = np.zeros(len(r))
        if self._by.sum(self._mean * pull, 0) > times * LASTING:
            squares = np.square(self._errors(q, pull))
        self._lasting = np.maximum(_FADE * self._lasting, squares)
        if not (self._lasting * np.diag(q) > 1.0).any():
            self._lasting = np.zeros(len(r))

    def _possible(
        self, q: FloatArray, errors: list[float], suspects: list[int], chi_square: float, hold: bool, times: float
    ) -> FloatArray:
        """What the covariance is to allow for, (2P,) m: errors of this block or held ones; ``hold``: keep them."""
        squares = np.zeros(len(errors))
        if hold or chi_square > times * self._doubtful:
            squares = np.square(errors)
            if suspects:
                squares *= np.repeat([psd in suspects for psd in range(1, self._psds + 1)], 2)
        self._held = np.maximum(_FADE * self._held, squares if hold else 0.0)
        if self._wrong or not (self._held * np.diag(q) > times * self._limit).any():
            self._held = np.zeros(len(errors))
        # Both readings of a PSD may be wrong together: the sum of two outer products is at least half of theirs.
        together = 2.0 if self.freedom >= 3 else 1.0
        return np.asarray(_MORE * np.sqrt(together * np.maximum(np.maximum(squares, self._held), self._lasting)))

    def state(self) -> tuple[float, ...]:
        """What :meth:`set_state` needs to go on from here."""
        arrays = (self._held, self._mean, self._lasting)
        return (float(self._wrong), float(self._left), *(v for array in arrays for v in array.tolist()))

    def set_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state` of another one. Raises ValueError if it is of another number of PSDs."""
        wrong, left, *arrays = values
        if len(arrays) != 6 * self._psds or not 0 <= wrong <= self._psds:
            raise ValueError(f'the check of {self._psds} PSDs has {2 + 6 * self._psds} values, not {len(values)}')
        self._wrong, self._left = int(wrong), int(left)
        self._held, self._mean, self._lasting = np.reshape(arrays, (3, -1))


def survival(chi_square: float, freedom: int) -> float:
    """Probability that a chi-square of ``freedom`` degrees is larger; 1 of none."""
    from scipy.special import chdtrc

    return float(chdtrc(freedom, chi_square)) if freedom else 1.0


def _unexplained(slopes: FloatArray, covariance: FloatArray, by: Arithmetic) -> FloatArray:
    """Q (2P, 2P) of the module's text, 1/m^2."""
    weights = inverse(covariance[None])[0]
    # Each unknown in its own unit, so that the elimination sees numbers of one size.
    scaled = slopes / np.sqrt(by.sum(slopes * slopes, 0))
    seen = by.einsum('ij,jk->ik', weights, scaled)
    normal = inverse(by.einsum('ji,jk->ik', scaled, seen)[None])[0]
    return np.asarray(weights - by.einsum('ia,ab,jb->ij', seen, normal, seen))
