# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Score tests: how much of a residual each effect's signature explains by itself.

With whitened signatures M and residual r, g = M'r and F = M'M; the part that parameters already in
the model (columns J) can explain is projected out. The gain of a candidate is T = g'F^-1 g over its
own columns: the drop of chi-square if it were added, to first order; under "nothing missing" it is
chi-square with as many degrees of freedom as columns.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.signatures import Candidate, Columns

OBSERVED = 1e-6
"""Columns that keep less than this fraction of their squared length after projection are skipped as
already explained.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """``gain``: expected drop of chi-square; ``dof`` columns; ``p``: library-wide, by Sidak."""

    candidate: Candidate
    gain: float
    dof: int
    p: float
    coefficients: FloatArray


def promising(scores: Sequence[Score], penalty: float, share: float, limit: int) -> list[Score]:
    """Return the best candidate of each variant, those that gain at least ``share`` of the best gain."""
    out: list[Score] = []
    visited: set[tuple[object, ...]] = set()
    best = max((s.gain for s in scores), default=0.0)
    for s in sorted(scores, key=lambda s: -(s.gain - penalty * s.dof)):
        if s.candidate.variant in visited or s.gain < share * best or s.gain <= 0.0:
            continue
        visited.add(s.candidate.variant)
        out.append(s)
        if len(out) == limit:
            break
    return out


def solve_observable(fisher: FloatArray, score: FloatArray, original: FloatArray) -> tuple[float, int, FloatArray]:
    """Gain, rank and coefficients of F c = g, without directions that cannot be seen.

    ``original`` (k,): squared lengths of the columns before projection.
    """
    scale = np.sqrt(np.maximum(original, 1e-300))
    f = fisher / np.outer(scale, scale)
    g = score / scale
    values, vectors = np.linalg.eigh(f)
    keep = values > OBSERVED
    if not np.any(keep):
        return 0.0, 0, np.zeros_like(score)
    along = vectors[:, keep].T @ g
    c = vectors[:, keep] @ (along / values[keep])
    return float(np.sum(along**2 / values[keep])), int(keep.sum()), c / scale


class Screen:
    """All candidates' signatures, whitened, side by side."""

    def __init__(self, workspace: Comparison, signatures: Sequence[tuple[Candidate, Columns]]) -> None:
        self.candidates: list[Candidate] = []
        self.slices: list[slice] = []
        # One array from the start: a recording of minutes has hundreds of megabytes of signatures.
        rows = np.empty((sum(len(c) for _, c in signatures), sum(m.size for m in workspace.measured)), dtype=np.float32)
        at = 0
        for candidate, columns in signatures:
            white = rows[at : at + len(columns)]
            for row, column in zip(white, columns, strict=True):
                row[:] = workspace.whiten(column)
            # Ignore signatures that change the readings by less than a thousandth of sigma.
            if max(float(np.dot(w, w)) for w in white) < 1e-6:
                continue
            self.candidates.append(candidate)
            self.slices.append(slice(at, at + len(columns)))
            at += len(columns)
        self.rows = rows[:at]
        self.fisher = (self.rows @ self.rows.T).astype(np.float64)
        self.lengths = np.diag(self.fisher)

    def columns_of(self, candidate: Candidate) -> list[FloatArray]:
        """Return the whitened signatures (D,) of one of its candidates."""
        return list(self.rows[self.slice_of(candidate)].astype(np.float64))

    def slice_of(self, candidate: Candidate) -> slice:
        """Return the rows of one of its candidates."""
        return next(s for c, s in zip(self.candidates, self.slices, strict=True) if c is candidate)

    def _projected(self, residual: FloatArray, known: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        g = (self.rows @ residual.astype(np.float32)).astype(np.float64)
        fisher = self.fisher
        if known is not None:
            q, _ = np.linalg.qr(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300))
            across = (self.rows @ q.astype(np.float32)).astype(np.float64)
            fisher = fisher - across @ across.T
            g = g - across @ (q.T @ residual)
        return g, fisher

    def score(self, residual: FloatArray, known: FloatArray | None = None) -> list[Score]:
        """Return every candidate on ``residual`` (D,), the best first; ``known`` (D, p): columns in the model."""
        g, fisher = self._projected(residual, known)
        count = len(self.candidates)
        out = []
        for candidate, s in zip(self.candidates, self.slices, strict=True):
            gain, dof, c = solve_observable(fisher[s, s], g[s], self.lengths[s])
            if candidate.one_sided and dof and c[0] < 0.0:
                gain = 0.0
            p = -np.expm1(count * np.log1p(-min(float(chi2.sf(gain, max(dof, 1))), 1.0 - 1e-16)))
            out.append(Score(candidate, gain, dof, float(p), c))
        out.sort(key=lambda score: -score.gain)
        return out

    def pairs(
        self, residual: FloatArray, penalty: float, limit: int, known: FloatArray | None = None
    ) -> list[tuple[Score, Score, float]]:
        """Return the ``limit`` best pairs by joint gain minus ``penalty`` per column; greedy steps may miss these."""
        g, fisher = self._projected(residual, known)
        singles = self.score(residual, known)
        # For each effect and its choices the best shape is enough; thousands of pairs take milliseconds.
        best: dict[tuple[object, ...], Score] = {}
        for score in singles:
            best.setdefault(score.candidate.variant, score)
        where = {id(c): s for c, s in zip(self.candidates, self.slices, strict=True)}
        scored = []
        for a, b in itertools.combinations(best.values(), 2):
            sa, sb = where[id(a.candidate)], where[id(b.candidate)]
            index = np.r_[sa, sb]
            gain, dof, c = solve_observable(fisher[np.ix_(index, index)], g[index], self.lengths[index])
            na = sa.stop - sa.start
            if (a.candidate.one_sided and c[0] < 0.0) or (b.candidate.one_sided and c[na] < 0.0):
                continue
            scored.append((gain - penalty * dof, a, b, gain, c, na))
        scored.sort(key=lambda item: -item[0])
        out = []
        for _, a, b, gain, c, na in scored[:limit]:
            out.append((replace(a, coefficients=c[:na]), replace(b, coefficients=c[na:]), gain))
        return out
