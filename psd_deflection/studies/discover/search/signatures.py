# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The signature of each effect: the change of these recordings by a small simulated dose."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from psd_deflection.model.simulation.declaration import ActiveEffect, Effect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit

Columns = list[list[FloatArray]]
"""Per column, per recording: fine-block volts (3P, nf)."""


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

    def minus(a: list[FloatArray], b: list[FloatArray]) -> list[FloatArray]:
        return [x - y for x, y in zip(a, b, strict=True)]

    if candidate.effect.finite:
        return [minus(simulate(candidate.start), nominal)]
    out: Columns = []
    effect, start = candidate.effect, candidate.start
    main = next(p for p in effect.parameters if p.kind == 'amplitude')
    dose = {**start, main.name: start[main.name] + main.scale}
    dosed: list[FloatArray] | None = None
    for name in candidate.free:
        p = effect.parameter(name)
        if p.kind == 'amplitude':
            sign = 1.0 if start[name] + p.scale <= p.maximum else -1.0
            moved = minus(simulate({**start, name: start[name] + sign * p.scale}), nominal)
            out.append([sign * m for m in moved])
        elif p.kind == 'phase':
            partner = effect.parameter(p.partner)
            out.append(minus(simulate({**start, partner.name: partner.scale, name: math.pi / 2.0}), nominal))
        else:
            if dosed is None:
                dosed = simulate(dose)
            out.append(minus(simulate({**dose, name: p.scale}), dosed))
    return out


def signatures_beside(workspace: Comparison, listed: Iterable[Candidate], fit: Fit) -> list[tuple[Candidate, Columns]]:
    """Return the signatures of the candidates beside what ``fit`` has already."""
    beside = [*workspace.base, *fit.coefficients_with_nuisance]
    now = workspace.simulate(beside)
    return [(c, signature_columns(c, workspace, now, beside)) for c in listed]


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
