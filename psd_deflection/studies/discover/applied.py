# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Free loads of a search: what hung where another load was noted, and weights that sway. If all notes are wrong, loads
are free only if the search has failed and free loads then leave next to nothing."""

import dataclasses
from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.sparse import csc_array

from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import BoolArray, FloatArray
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.check.shared_findings import note_finding
from psd_deflection.studies.discover.hidden import Direction, LoadDirection
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.thresholds import CERTAIN_SD, HALF, LEAST_REPORTED, UNKNOWN_SD
from psd_deflection.studies.loads.annotated_times import CorrectedNote, MeasuredLoad, shifted
from psd_deflection.studies.loads.effective import SwayingLoad, swaying
from psd_deflection.studies.loads.holds import Hold, ImpliedLoads, WrongNote, find_holds, implied_loads

RINGING = 'ringing after what is left out'


def times(o: Observation, recording: int) -> list[Hold]:
    """Those of a recording between changes of its load."""
    return find_holds(o.rig, o.volts, o.loads, recording)


def levels(ws: Workspace, recording: int, difference: FloatArray, listed: Sequence[Hold]) -> ImpliedLoads:
    """Return the loads that ``difference`` (3P, m), V, measured minus simulated, asks for."""
    o = ws.observations[recording]
    return implied_loads(o.rig, difference, ws.count[recording], len(o.loads), ws.fine[recording], listed)


def swayed(ws: Workspace, recording: int, difference: FloatArray, implied: ImpliedLoads) -> list[SwayingLoad]:
    """Loads that swayed; ``implied``: what ``difference`` asks for between all steps."""
    o = ws.observations[recording]
    annotated = find_holds(o.rig, o.volts, o.loads, recording, annotated_only=True)
    return swaying(implied, annotated, partial(levels, ws, recording, difference), o.period)


def directions(ws: Workspace, wrong: Sequence[Hold]) -> list[LoadDirection]:
    """Any load in each of ``wrong``, and the times at which it was hung and taken off if nobody noted them."""
    free, out = np.full(3, UNKNOWN_SD), list[LoadDirection]()
    for p in wrong:
        o = ws.observations[p.recording]
        out += of_hold(o, p.recording, p, free)
        for at in _unannotated(p):
            out += in_time(
                o,
                p.recording,
                CorrectedNote(p.number, tuple(p.of(o.loads).tolist()), at * o.period, at * o.period, 0.0),
            )
    return out


def _unannotated(p: Hold) -> list[int]:
    """Return the samples at which it began and ended, if nothing was noted then."""
    return [*([p.first] if p.unannotated else []), *([p.last] if p.end_unannotated else [])]


def in_time(o: Observation, recording: int, note: CorrectedNote) -> list[LoadDirection]:
    """Return the time of a ``note`` and, if its load was applied slowly, how long that took."""
    effective = shifted(note, o.loads, o.period)
    none = (0.0, 0.0) if note.took > 0.0 else (0.0,)
    changes = [effective([float(k == axis) for k in range(len(none))]) for axis in range(len(none))]
    return [
        LoadDirection(recording, csc_array(change), UNKNOWN_SD, note, axis, effective, none)
        for axis, change in enumerate(changes)
    ]


def of_hold(o: Observation, recording: int, hold: Hold | MeasuredLoad, sd: FloatArray) -> list[LoadDirection]:
    """1 N or 1 N m more in ``hold``, known to ``sd`` (3,) N, N, N m; axes that are known exactly are left out."""
    out = []
    for axis in np.flatnonzero(sd > 0.0).tolist():
        change = _at(o, slice(hold.first, hold.last), axis)
        out.append(LoadDirection(recording, change, float(sd[axis]), hold, axis))
    return out


def _at(o: Observation, samples: slice, axis: int) -> csc_array:
    """Return loads (n, 3) of 1 N or 1 N m on one axis in the ``samples``."""
    out = np.zeros_like(o.loads)
    out[samples, axis] = 1.0
    return csc_array(out)


def ringing_on(o: Observation, recording: int, effects: Sequence[ActiveEffect]) -> list[LoadDirection]:
    """How the link rang when each stretch ended that is left out, of the modes that keep their energy longer with
    ``effects`` than the rig file says: the stretch ends when the link of the rig file is at rest. Two pulses of a load,
    a quarter of a period of its mode apart, give the mode any speed and place.
    """
    stated, now = (_decays(ForwardModel(o.rig, e).physics) for e in ((), effects))
    there: BoolArray = np.any(np.isfinite(o.volts), axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate(([True], there)).astype(np.int8)))
    out = []
    # A stretch that ends with the recording is followed by nothing.
    for first, last in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=False):
        for axis, ((_, usual), (frequency, decay)) in enumerate(zip(stated, now, strict=True)):
            for before in (1, 1 + round(0.25 / (frequency * o.period))):
                if decay < HALF * usual and last - before >= first:
                    change = _at(o, slice(last - before, last - before + 1), axis)
                    out.append(LoadDirection(recording, change, UNKNOWN_SD, RINGING, axis, swings=True))
    return out


def unseen(ws: Workspace, direction: Direction) -> bool:
    """Return whether it is the time of a load that was hung in what is left out."""
    if not isinstance(direction, LoadDirection) or not isinstance(direction.of, CorrectedNote):
        return False
    o = ws.observations[direction.recording]
    at = min(round(direction.of.applied / o.period), len(o.volts) - 1)
    return bool(np.isnan(o.volts[at]).all())


def _decays(p: Physics) -> list[tuple[float, float]]:
    """Frequency, Hz, of the mode of each load, and 1/s by which it decays, in units of a turn."""
    bending, torsion = p.bending_frequency, p.torsion_frequency
    return [*[(bending, bending * p.bending_damping_ratio)] * 2, (torsion, torsion * p.torsion_damping_ratio)]


def wrong_load_findings(ws: Workspace, wrong: Sequence[Hold]) -> list[Finding]:
    """What hung in each of ``wrong``, after the search."""
    sds = ws.direction_sd()
    out = []
    for p in wrong:
        o = ws.observations[p.recording]
        note = WrongNote(_timed(ws, p), p.of(o.loads), o.period)
        sd = np.array([sds.get((id(p), axis), 0.0) for axis in range(3)])
        if np.any(note.off > np.maximum(CERTAIN_SD * sd, LEAST_REPORTED)):
            out.append(note_finding(note, o.name))
    return out


def _timed(ws: Workspace, p: Hold) -> Hold:
    """``p`` between the times that were fitted, in whole samples."""
    moved = {}
    for d in ws.directions:
        if isinstance(d, LoadDirection) and d.recording == p.recording and isinstance(d.of, CorrectedNote):
            period = ws.observations[d.recording].period
            moved[round(d.of.applied / period)] = round(d.of.moved(d.sizes, period).applied / period)
    first, last = (moved.get(at, at) if at in _unannotated(p) else at for at in (p.first, p.last))
    return dataclasses.replace(p, first=first, last=last)
