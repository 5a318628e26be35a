# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Score tests: with whitened signatures M, residual r, g = M'r and F = M'M beside the columns in the model, a
candidate's gain is T = g'F^-1 g: the drop of chi-square to first order; with nothing missing, chi-square of as many
columns."""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from psd_deflection.model.simulation.declaration import ActiveEffect, Effect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.hidden import Free
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.thresholds import ROUNDING

Columns = Sequence[Sequence[npt.NDArray[np.floating[Any]]]]
"""Per column, per recording: fine-block volts (3P, nf), of the precision of a screen."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """One effect with its choices and shapes fixed; its columns span its possible effects, to first order.

    ``free``: the parameter of each column. ``start``: values at the probe.
    """

    effect: Effect
    start: Mapping[str, float]
    free: tuple[str, ...]
    off: Mapping[str, float]

    @property
    def key(self) -> tuple[object, ...]:
        """A key that distinguishes it from other candidates."""
        return (self.effect.name, *(round(v, 9) if math.isfinite(v) else 'rig' for v in self.start.values()))

    @property
    def variant(self) -> tuple[object, ...]:
        """Effect and discrete choices, without the shapes."""
        return (self.effect.name, *(self.start[p.name] for p in self.effect.parameters if p.kind == 'choice'))

    @property
    def one_sided(self) -> bool:
        """One column, whose coefficient cannot be negative."""
        if len(self.free) != 1:
            return False
        p = self.effect.parameter(self.free[0])
        return self.effect.finite or p.minimum >= self.off[p.name]

    def from_coefficients(self, coefficients: FloatArray) -> ActiveEffect:
        """Parameter values of a linear combination of the columns."""
        values = dict(self.start)
        if self.effect.finite:
            p = self.effect.parameter(self.free[0])
            if p.power:
                values[p.name] = self.start[p.name] * max(float(coefficients[0]), 1e-4) ** (1.0 / p.power)
            return ActiveEffect(self.effect, values)
        by_name = dict(zip(self.free, (float(c) for c in coefficients), strict=True))
        main = next(n for n in self.free if self.effect.parameter(n).kind == 'amplitude')
        for name, c in by_name.items():
            p = self.effect.parameter(name)
            if p.kind == 'amplitude':
                values[name] = self.off[name] + c * p.scale
            elif p.kind == 'coupled':
                values[name] = c / by_name[main] * p.scale if abs(by_name[main]) > 1e-6 else 0.0
        for name, c in by_name.items():
            partner = self.effect.parameter(name).partner
            if partner:
                values[name] = math.atan2(c, by_name[partner])
                values[partner] = self.effect.parameter(partner).scale * math.hypot(c, by_name[partner])
        for name in self.free:
            p = self.effect.parameter(name)
            values[name] = min(max(values[name], p.minimum), p.maximum)
        return ActiveEffect(self.effect, values)


def candidates(
    library: Sequence[Effect], physics: Physics | None, proposals: Mapping[str, Sequence[float]]
) -> Iterator[Candidate]:
    """Every candidate of ``library``.

    ``proposals``: the values to try, by the name that a parameter's ``propose`` gives.
    """
    psds = 2 if physics is None else physics.psds
    for effect in library:
        for choice in effect.variants(psds):
            off = effect.off_values(physics, choice)
            shapes: list[list[tuple[str, float]]] = []
            probed: list[tuple[str, float]] = []
            for p in effect.parameters:
                propose = p.proposed_by(choice)
                grid = list(proposals.get(propose, ())) if propose else list(p.grid)
                if p.kind == 'shape':
                    if propose == 'spectral':
                        grid += p.grid
                    low, high = p.bounds(physics, off)
                    shapes.append([(p.name, v) for v in grid if low <= v <= high])
                elif p.kind == 'amplitude' and effect.finite:
                    probed += [(p.name, v) for v in grid]
            for combination in itertools.product(*shapes):
                start = {**off, **dict(combination)}
                if effect.finite:
                    for name, value in probed:
                        yield Candidate(effect, {**start, name: value}, (name,), off)
                else:
                    free = tuple(p.name for p in effect.parameters if p.kind in ('amplitude', 'coupled', 'phase'))
                    yield Candidate(effect, start, free, off)


def signature_columns(
    candidate: Candidate, workspace: Comparison, nominal: list[FloatArray], base: Sequence[ActiveEffect]
) -> Columns:
    """Return the candidate's signatures: change of the fine-block volts for one ``scale`` of each parameter.

    ``nominal``: the simulation with ``base`` alone.
    """

    def simulate(values: Mapping[str, float]) -> list[FloatArray]:
        return workspace.simulate([*base, ActiveEffect(candidate.effect, values)])

    def minus(a: list[FloatArray], b: list[FloatArray], sign: float = 1.0) -> list[npt.NDArray[np.float32]]:
        return [(sign * (x - y)).astype(np.float32) for x, y in zip(a, b, strict=True)]

    if candidate.effect.finite:
        return [minus(simulate(candidate.start), nominal)]
    out = list[list[npt.NDArray[np.float32]]]()
    effect, start = candidate.effect, candidate.start
    main = next(p for p in effect.parameters if p.kind == 'amplitude')
    dose = {**start, main.name: start[main.name] + main.scale}
    dosed: list[FloatArray] | None = None
    for name in candidate.free:
        p = effect.parameter(name)
        if p.kind == 'amplitude':
            sign = 1.0 if start[name] + p.scale <= p.maximum else -1.0
            out.append(minus(simulate({**start, name: start[name] + sign * p.scale}), nominal, sign))
        elif p.kind == 'phase':
            partner = effect.parameter(p.partner)
            out.append(minus(simulate({**start, partner.name: partner.scale, name: math.pi / 2.0}), nominal))
        else:
            if dosed is None:
                dosed = simulate(dose)
            out.append(minus(simulate({**dose, name: p.scale}), dosed))
    return out


def signatures_beside(
    workspace: Comparison, listed: Iterable[Candidate], fit: Fit
) -> Iterator[tuple[Candidate, Columns]]:
    """Yield the signatures of the candidates beside what ``fit`` has already."""
    beside = [*workspace.base, *fit.coefficients_with_nuisance]
    now = workspace.simulate(beside)
    for c in listed:
        yield c, signature_columns(c, workspace, now, beside)


class SignatureBank:
    """Signatures of one design (rigs, loads, temperatures), kept for the next search on it."""

    def __init__(self) -> None:
        self._kept: dict[tuple[object, ...], Columns] = {}
        self._nominal: list[FloatArray] | None = None
        self._base: tuple[ActiveEffect, ...] = ()

    def nominal(self, workspace: Comparison) -> list[FloatArray]:
        """Return the simulation with what every model has, and no more."""
        if self._nominal is None:
            self._base = (*workspace.base, *workspace.nuisance)
            self._nominal = workspace.simulate(self._base)
        return self._nominal

    def get(self, candidate: Candidate, workspace: Comparison) -> Columns:
        """Return the candidate's columns, simulated once."""
        columns = self._kept.get(candidate.key)
        if columns is None:
            columns = signature_columns(candidate, workspace, self.nominal(workspace), self._base)
            self._kept[candidate.key] = columns
        return columns


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
    keep = values > ROUNDING
    if not np.any(keep):
        return 0.0, 0, np.zeros_like(score)
    along = vectors[:, keep].T @ g
    c = vectors[:, keep] @ (along / values[keep])
    return float(np.sum(along**2 / values[keep])), int(keep.sum()), c / scale


class Screen:
    """All candidates' signatures, whitened, side by side.

    ``most``: bound of their columns, if the signatures are to be taken one by one: those of minutes are hundreds of
    megabytes.
    """

    def __init__(
        self, workspace: Comparison, signatures: Iterable[tuple[Candidate, Columns]], most: int | None = None
    ) -> None:
        self.candidates: list[Candidate] = []
        self.slices: list[slice] = []
        listed = list(signatures) if most is None else signatures
        count = sum(len(c) for _, c in listed) if most is None else most
        # One array from the start.
        rows = np.empty((count, sum(m.size for m in workspace.measured)), dtype=np.float32)
        at = 0
        for candidate, columns in listed:
            white = rows[at : at + len(columns)]
            for row, column in zip(white, columns, strict=True):
                row[:] = workspace.whiten([table.astype(np.float64) for table in column])
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

    def _projected(self, residual: FloatArray, known: FloatArray | Free | None) -> tuple[FloatArray, FloatArray]:
        g = (self.rows @ residual.astype(np.float32)).astype(np.float64)
        fisher = self.fisher
        if isinstance(known, Free):
            across = np.array([known.shares(row) for row in self.rows]).reshape(len(self.rows), -1)
            fisher = fisher - across @ across.T
            g = g - across @ known.shares(residual)
        elif known is not None:
            q, _ = np.linalg.qr(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300))
            across = (self.rows @ q.astype(np.float32)).astype(np.float64)
            fisher = fisher - across @ across.T
            g = g - across @ (q.T @ residual)
        return g, fisher

    def score(self, residual: FloatArray, known: FloatArray | Free | None = None) -> list[Score]:
        """Return every candidate on ``residual`` (D,), best first; ``known``: what is free, or columns (D, p)."""
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
