"""The recordings made ready for the search: what is no measurement taken out, loads, wiring and units put right.

:class:`Recorded` is frozen; each of the ``STEPS`` takes one and gives the next.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.proposals import coarse_step
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup.cleaning import clean, time_loads
from psd_deflection.studies.discover.setup.hidden import beginning
from psd_deflection.studies.discover.setup.setup import likely_delays, wire


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """``observations`` of the ``rig``, whose file has the effects ``known``. ``without``: effects that are not looked
    for. ``findings``: what was wrong, with ``values`` that put the rig file right. ``stated_gap``: m, before loads and
    wiring were put right, 0 if they were right. ``lattice``: the effect of coarse steps that the readings show.
    ``delays``: by how much the loads may be noted late, s.
    """

    observations: tuple[Observation, ...]
    rig: Rig
    known: tuple[ActiveEffect, ...]
    without: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    values: Mapping[str, object] = field(default_factory=dict)
    stated_gap: float = 0.0
    lattice: ActiveEffect | None = None
    delays: tuple[float, ...] = ()

    @property
    def physics(self) -> Physics:
        """Of the rig as it was put right."""
        return Physics.of(self.rig)


def cleaned(recorded: Recorded) -> Recorded:
    """Without outliers, stuck channels and times without a known load."""
    found = [clean(o, recorded.known) for o in recorded.observations]
    rates = {o.rig.converter.sample_rate_hz for o in recorded.observations if o.stated_rate_hz}
    return replace(
        recorded,
        observations=tuple(o for o, _ in found),
        findings=tuple(f for _, own in found for f in own),
        values={'converter.sample_rate_hz': rates.pop()} if len(rates) == 1 else {},
    )


def put_right(recorded: Recorded) -> Recorded:
    """With loads at the times at which they acted, and with wiring, signs and units as they are."""
    timed = [time_loads(o) for o in recorded.observations]
    late = [f for _, found in timed for f in found]
    observations, wrong, lines = wire([o for o, _ in timed], recorded.known)
    gap = 0.0
    if wrong or late:
        stated = Workspace(recorded.observations, recorded.known)
        gap = stated.gap(stated.residual(recorded.known)[1])
    values = {**recorded.values, **lines}
    return replace(
        recorded,
        observations=tuple(observations),
        rig=replace_values(recorded.rig, values) if values else recorded.rig,
        findings=(*late, *recorded.findings, *wrong),
        values=values,
        stated_gap=gap,
    )


def snapped(recorded: Recorded) -> Recorded:
    """With the coarse steps of the converter, if all readings lie on such."""
    effects = [e for e in catalogue().values() if e.lattice and e.name not in recorded.without]
    if not effects or any(a.effect.lattice for a in recorded.known):
        return recorded
    found = [coarse_step(o) for o in recorded.observations]
    steps = [s for s in found if s is not None]
    if len(steps) < len(found):
        return recorded
    effect = effects[0]
    values = effect.off_values(recorded.physics, next(effect.variants()))
    # The recording with the widest range of values determines it best.
    step = min(steps, key=lambda s: s[1])[0]
    # The converter has rounded each reading once more.
    observations = tuple(_with_volts(o, np.rint(o.volts / step) * step) for o in recorded.observations)
    return replace(recorded, observations=observations, lattice=ActiveEffect(effect, {**values, effect.lattice: step}))


STEPS: Sequence[Callable[[Recorded], Recorded]] = (cleaned, put_right, snapped)


def compared(recorded: Recorded) -> tuple[Recorded, Workspace]:
    """The recordings against the simulation of the rig as it is described, from how each of them began.

    Where loads may be noted late, without the last moments, whose loads are noted after the end.
    """
    workspace = Workspace(recorded.observations, recorded.known)
    delays = likely_delays(workspace)
    if any(d > 0.0 for d in delays):
        cut = tuple(_without_end(o, max(delays)) for o in recorded.observations)
        recorded = replace(recorded, observations=cut)
        workspace = Workspace(cut, recorded.known)
    recorded = replace(recorded, delays=tuple(delays))
    return recorded, workspace.replaced(nuisance=_beginnings(workspace))


def _beginnings(workspace: Workspace) -> tuple[ActiveEffect, ...]:
    """How the link moved when the loads of a recording became known, if it was not unloaded and at rest."""
    starts = [o.unknown_load[0] * o.period for o in workspace.observations]
    effect = beginning(starts)
    out = []
    for o, choice in zip(workspace.observations, effect.variants(), strict=True):
        if o.unknown_load[0] or np.any(o.loads[0] != 0.0):
            out.append(ActiveEffect(effect, effect.off_values(workspace.physics, choice)))
    return refit(workspace, out, iterations=3).effects if out else ()


def _without_end(o: Observation, seconds: float) -> Observation:
    volts = o.volts.copy()
    volts[len(volts) - math.ceil(seconds / o.period) - 1 :] = np.nan
    return _with_volts(o, volts)


def _with_volts(o: Observation, volts: FloatArray) -> Observation:
    return dataclasses.replace(o, volts=volts, digest=o.digest or o.hashed())
