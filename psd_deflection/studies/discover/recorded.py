# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The recordings made ready for the search: what is no measurement taken out, loads, wiring and units put right.

:class:`Recorded` is frozen; each of the ``STEPS`` takes one and gives the next.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray, dot_channels
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.check.shared_findings import note_finding
from psd_deflection.studies.discover.applied import directions, in_time, levels, of_hold, swayed, times
from psd_deflection.studies.discover.cleaning import clean, time_loads
from psd_deflection.studies.discover.hidden import Direction, LoadDirection, ZeroDirection, beginning
from psd_deflection.studies.discover.redundant import FourthReading, fourth_reading, solved
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.proposals import CoarseStep, coarse_step
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import correct_wiring, likely_delays
from psd_deflection.studies.discover.thresholds import HALF, LEVELS
from psd_deflection.studies.loads.alignment import SKEW, LatePsd, aligned
from psd_deflection.studies.loads.annotated_times import CorrectedLoads
from psd_deflection.studies.loads.effective import (
    SwayingLoad,
    UnannotatedTime,
    excluded,
    swung,
    unannotated_times,
    without_times,
)
from psd_deflection.studies.loads.holds import Hold, ImpliedLoads, WrongNote, as_applied, wrong_notes_against
from psd_deflection.studies.loads.thresholds import MANYFOLD


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """``observations`` of the ``rig``, whose file has the effects ``known``. ``without``: effects that are not looked
    for. ``findings``: what was wrong, with ``values`` that put the rig file right. ``stated_gap``: m, before loads and
    wiring were put right, 0 if they were right. ``value_grid``: the effect of coarse steps that the readings show;
    ``value_grid_stated``: the rig file has it.
    ``delays``: by how much the loads may be noted late, s. ``corrected``: of each recording, its loads as they were put
    right, if they were. ``wrong``: where another load hung than noted; it is free.
    ``fourth``: what the readings say of themselves. ``late``: the PSDs that were on another clock.
    """

    observations: tuple[Observation, ...]
    rig: Rig
    known: tuple[ActiveEffect, ...]
    without: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    values: Mapping[str, object] = field(default_factory=dict)
    stated_gap: float = 0.0
    value_grid: ActiveEffect | None = None
    value_grid_stated: bool = False
    delays: tuple[float, ...] = ()
    corrected: tuple[CorrectedLoads | None, ...] = ()
    wrong: tuple[Hold, ...] = ()
    fourth: FourthReading | None = None
    late: tuple[LatePsd, ...] = ()

    @property
    def stated(self) -> tuple[ActiveEffect, ...]:
        """The effects that the rig file has."""
        return (*self.known, self.value_grid) if self.value_grid is not None and self.value_grid_stated else self.known

    @property
    def physics(self) -> Physics:
        """Of the rig as it was put right."""
        return Physics.of(self.rig)

    @property
    def mistaken(self) -> bool:
        """Whether anything was noted or wired otherwise than it was."""
        return bool(self.findings or self.late) or any(m is not None and m.notes for m in self.corrected)

    def delayed_loads(self, workspace: Workspace) -> list[Finding]:
        """Loads that acted at another time than noted; ``workspace``: where their times were fitted."""
        sizes = {id(d.of): d.sizes for d in workspace.directions if isinstance(d, LoadDirection) and d.exact}
        out = []
        for o, corrected in zip(workspace.observations, self.corrected, strict=True):
            for note in corrected.notes if corrected is not None else ():
                out.append(note_finding(note.moved(sizes.get(id(note), ()), o.period), o.name))
        return out


def cleaned(recorded: Recorded) -> Recorded:
    """Without outliers, stuck channels and times without a known load."""
    results = [clean(o, recorded.known) for o in recorded.observations]
    rates = {o.rig.converter.sample_rate_hz for o in recorded.observations if o.stated_rate_hz}
    return replace(
        recorded,
        observations=tuple(o for o, _ in results),
        findings=tuple(f for _, findings in results for f in findings),
        values={'converter.sample_rate_hz': rates.pop()} if len(rates) == 1 else {},
    )


def on_one_clock(recorded: Recorded) -> Recorded:
    """With the readings of all PSDs at the same times, to the nearest sample.

    Raises RecordingError if a PSD is late in one recording otherwise than in another.
    """
    if SKEW in recorded.without:
        return recorded
    results = [aligned(o.rig, o.volts, o.loads) for o in recorded.observations]
    late = results[0][1]
    for o, (_, late_psds) in zip(recorded.observations, results, strict=True):
        if [(a.psd, a.rows) for a in late_psds] != [(a.psd, a.rows) for a in late]:
            words = (
                a.words(name)
                for name, listed in ((recorded.observations[0].name, late), (o.name, late_psds))
                for a in listed
            )
            raise RecordingError(f'{"; ".join(words)}: the clocks are not alike: search the recordings one by one')
    if not late:
        return recorded
    stated = Workspace(recorded.observations, recorded.known)
    both = zip(recorded.observations, results, strict=True)
    observations = tuple(_with_volts(o, volts) for o, (volts, _) in both)
    gap = stated.gap(stated.residual(recorded.known)[1])
    return replace(recorded, observations=observations, late=late, stated_gap=gap)


def put_right(recorded: Recorded) -> Recorded:
    """With loads at the times at which they acted, and with wiring, signs and units as they are."""
    timed = [time_loads(o) for o in recorded.observations]
    observations, wrong, lines = correct_wiring([o for o, _ in timed], recorded.known)
    gap = recorded.stated_gap
    if not gap and (wrong or any(corrected is not None and corrected.notes for _, corrected in timed)):
        stated = Workspace(recorded.observations, recorded.known)
        gap = stated.gap(stated.residual(recorded.known)[1])
    values = {**recorded.values, **lines}
    return replace(
        recorded,
        observations=tuple(observations),
        rig=replace_values(recorded.rig, values) if values else recorded.rig,
        findings=(*recorded.findings, *wrong),
        values=values,
        stated_gap=gap,
        corrected=tuple(corrected for _, corrected in timed),
    )


def snapped(recorded: Recorded) -> Recorded:
    """With the coarse steps of the converter, if all readings lie on such, or all positions."""
    effects = [e for e in catalogue().values() if e.value_grid and e.name not in recorded.without]
    stated = [a for a in recorded.known if a.effect.value_grid]
    step = _common_step(recorded.observations) if effects or stated else None
    if step is None:
        return recorded
    # The converter has rounded each reading once more.
    psds = len(recorded.rig.psds)
    rows = list(range(3 * psds) if step.sums else dot_channels(psds))
    observations = tuple(_with_volts(o, _on_steps(o.volts, rows, step.step)) for o in recorded.observations)
    if stated:
        known = tuple(a for a in recorded.known if a is not stated[0])
        return replace(recorded, observations=observations, known=known, value_grid=stated[0], value_grid_stated=True)
    effect = effects[0]
    choice = next(v for v in effect.variants() if effect.steps_sums(v) == step.sums)
    values = {**effect.off_values(recorded.physics, choice), effect.value_grid: step.step}
    return replace(recorded, observations=observations, value_grid=ActiveEffect(effect, values))


def _common_step(observations: Sequence[Observation]) -> CoarseStep | None:
    """That of all recordings, None if one has none."""
    per_recording = [coarse_step(o) for o in observations]
    steps = [s for s in per_recording if s is not None]
    if not steps or len(steps) < len(per_recording):
        return None
    # The recording with the widest range of values determines it best.
    return min(steps, key=lambda s: s.sd)._replace(sums=all(s.sums for s in steps))


def _on_steps(volts: FloatArray, rows: list[int], step: float) -> FloatArray:
    out = volts.copy()
    out[:, rows] = np.rint(out[:, rows] / step) * step
    return out


STEPS: Sequence[Callable[[Recorded], Recorded]] = (cleaned, on_one_clock, put_right, snapped)


def compared(recorded: Recorded) -> tuple[Recorded, Workspace]:
    """Return the recordings against the simulation of the rig as it is described, from how each of them began.

    Where loads may be noted late, without the last moments, whose loads are noted after the end.
    """
    workspace = Workspace(recorded.observations, recorded.known)
    delays = likely_delays(workspace)
    if any(d > 0.0 for d in delays):
        cut = tuple(_without_end(o, max(delays)) for o in recorded.observations)
        recorded = replace(recorded, observations=cut)
        workspace = Workspace(cut, recorded.known)
    recorded = replace(recorded, delays=tuple(delays))
    recorded, workspace = _corrected(recorded, workspace)
    residual, difference = workspace.residual(workspace.base)
    if workspace.gap(difference) > MANYFOLD * workspace.floor():
        # Poses that are far off bend what no movement makes.
        residual = solved(workspace, difference)
    recorded = replace(recorded, fourth=fourth_reading(workspace, residual))
    return recorded, workspace.replaced(nuisance=_beginnings(workspace))


def _corrected(recorded: Recorded, workspace: Workspace) -> tuple[Recorded, Workspace]:
    """Without the time in which a weight swayed, or in which many loads were not noted; the few loads that were noted
    wrong, and fitted times, are free.
    """
    _, difference = workspace.residual(workspace.base)
    gap = workspace.gap(difference)
    if gap <= MANYFOLD * min(workspace.floor(), _stated_floor(workspace)):
        return recorded, with_free(recorded, workspace)
    notes = [_wrong_notes(workspace, i, part) for i, part in enumerate(difference)]
    if not any(notes):
        return recorded, with_free(recorded, workspace)
    observations = [
        _with_effective_loads(o, notes_of_recording)
        for o, notes_of_recording in zip(workspace.observations, notes, strict=True)
    ]
    both = zip(notes, workspace.observations, strict=True)
    free = [
        n.hold for notes_of_recording in notes for n in notes_of_recording if isinstance(n, WrongNote) and not n.exact
    ]
    findings = [
        note_finding(n, o.name)
        for notes_of_recording, o in both
        for n in notes_of_recording
        if not isinstance(n, WrongNote) or n.exact
    ]
    recorded = replace(
        recorded,
        observations=tuple(observations),
        findings=(*findings, *recorded.findings),
        wrong=(*recorded.wrong, *free),
        stated_gap=recorded.stated_gap or gap,
    )
    workspace = beside(workspace, observations, recorded.known)
    if any(isinstance(n, UnannotatedTime) for notes_of_recording in notes for n in notes_of_recording):
        return _corrected(recorded, workspace)
    return recorded, with_free(recorded, workspace)


def _stated_floor(workspace: Workspace) -> float:
    """Return the gap that the noise of the rig file alone leaves, m: motion spoils any other estimate of it."""
    dots = [
        o.rig.noises[:, :2] * o.rig.sensitivities / math.sqrt(o.rig.estimator.block_size)
        for o in workspace.observations
    ]
    return float(np.sqrt(np.mean(np.square(dots))))


def _wrong_notes(
    workspace: Workspace, i: int, difference: FloatArray
) -> list[WrongNote | SwayingLoad | UnannotatedTime]:
    """What of recording ``i`` was noted otherwise than it hung; ``difference`` (3P, m), V: measured minus simulated."""
    o = workspace.observations[i]
    implied = levels(workspace, i, difference, times(o, i))
    wrong = wrong_notes_against(o.loads, o.period, partial(_implied_loads, workspace, i, implied), HALF)
    if not wrong and (unannotated := unannotated_times(implied, len(o.loads), o.period)):
        return [*unannotated]
    return [*swayed(workspace, i, difference, implied), *wrong]


def _implied_loads(workspace: Workspace, i: int, implied: ImpliedLoads, acting: FloatArray) -> ImpliedLoads:
    """Return the loads that recording ``i`` asks for under ``acting`` ones; ``implied``: under those that it has."""
    o = workspace.observations[i]
    if acting is o.loads:
        return implied
    moved = workspace.loaded(i, acting)
    return levels(workspace, i, moved.residual(moved.base)[1][i], implied.holds)


def _with_effective_loads(o: Observation, notes: Sequence[WrongNote | SwayingLoad | UnannotatedTime]) -> Observation:
    """With the loads that hung, without the times in which nobody knows them."""
    if not notes:
        return o
    swayed = [n for n in notes if isinstance(n, SwayingLoad)]
    volts = excluded(o.rig, o.volts, swayed)
    volts = without_times(volts, [n for n in notes if isinstance(n, UnannotatedTime)])
    loads = as_applied(o.loads, [n for n in notes if isinstance(n, WrongNote)])
    return dataclasses.replace(_with_volts(o, volts), loads=loads, swing=swung(len(loads), swayed))


def beside(workspace: Workspace, observations: Sequence[Observation], known: Sequence[ActiveEffect]) -> Workspace:
    """Return the ``observations`` in place of those of ``workspace``, with its simulations counted on."""
    out = Workspace(observations, known)
    workspace.tally.count += out.tally.count
    return out.replaced(tally=workspace.tally)


def with_free(recorded: Recorded, workspace: Workspace) -> Workspace:
    """``workspace`` with what is not known free: loads that were noted wrong, times that were fitted, zeros."""
    free: list[Direction] = [*directions(workspace, recorded.wrong)]
    for i, o in enumerate(workspace.observations):
        sds = np.sqrt(o.zero_variances).tolist()
        free += [ZeroDirection(i, axis, sd) for axis, sd in enumerate(sds) if sd > 0.0]
    for i, corrected in enumerate(recorded.corrected):
        if corrected is None:
            continue
        o = workspace.observations[i]
        for note in corrected.timed:
            free += in_time(o, i, note)
        # In whatever unit they were measured.
        unit = np.abs(o.loads).max(axis=0) / np.maximum(np.abs(corrected.loads).max(axis=0), 1e-30)
        if len(corrected.measured) <= LEVELS:
            free += [d for m in corrected.measured for d in of_hold(o, i, m, m.sd * unit)]
    workspace = workspace.with_free(free)
    # What a large load bends is no change in proportion.
    for _ in range(2 if recorded.wrong else 0):
        workspace = workspace.refitted(workspace.residual(workspace.base)[1])
    return workspace


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
