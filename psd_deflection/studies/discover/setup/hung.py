"""Free loads of a search: what hung where another load was noted, and weights that sway.

A movement of the plate that swings is a weight that sways. A few wrong notes stand out (:mod:`.loads.plateaus`) and are
free before any search. If all notes are wrong (rounded), they are free only if the search has failed, and if free loads
then leave next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.check.judges import note_finding
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.search.free import LoadDirection
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.loads.load_cell import MeasuredLoad
from psd_deflection.studies.loads.plateaus import Plateau, PlateauLoads, WrongNote, asked_for, plateaus
from psd_deflection.studies.loads.sway import SwayingLoad, swaying

FREE = 100.0
"""N or N m: standard deviation of a load that nobody knows."""
TELLING = 4.0
"""Standard deviations by which a load that is told differs from the noted one."""
LEAST_TOLD = (0.02, 0.02, 0.01)
"""N, N, N m: a smaller difference is not told."""


def times(o: Observation, recording: int) -> list[Plateau]:
    """Those of a recording between changes of its load."""
    return plateaus(o.rig, o.volts, o.loads, recording)


def levels(ws: Workspace, recording: int, difference: FloatArray, listed: Sequence[Plateau]) -> PlateauLoads:
    """The loads that ``difference`` (3P, m), V, measured minus simulated, asks for."""
    o = ws.observations[recording]
    return asked_for(o.rig, difference, ws.count[recording], len(o.loads), ws.fine[recording], listed)


def swayed(ws: Workspace, recording: int, difference: FloatArray, found: PlateauLoads) -> list[SwayingLoad]:
    """Loads that swayed; ``found``: what ``difference`` asks for between all steps."""
    o = ws.observations[recording]
    noted = plateaus(o.rig, o.volts, o.loads, recording, noted=True)
    return swaying(found, noted, partial(levels, ws, recording, difference), o.period)


def directions(ws: Workspace, wrong: Sequence[Plateau]) -> list[LoadDirection]:
    """Any load in each of ``wrong``."""
    free = np.full(3, FREE)
    return [d for p in wrong for d in of_plateau(ws.observations[p.recording], p.recording, p, free)]


def of_plateau(o: Observation, recording: int, plateau: Plateau | MeasuredLoad, sd: FloatArray) -> list[LoadDirection]:
    """1 N or 1 N m more in ``plateau``, known to ``sd`` (3,) N, N, N m; axes that are known exactly are left out."""
    out = []
    for axis in np.flatnonzero(sd > 0.0).tolist():
        more = np.zeros_like(o.loads)
        more[plateau.first : plateau.last, axis] = 1.0
        out.append(LoadDirection(recording, more, float(sd[axis]), plateau, axis))
    return out


def told(ws: Workspace, wrong: Sequence[Plateau]) -> list[Finding]:
    """What hung in each of ``wrong``, after the search."""
    sds = ws.direction_sd()
    out = []
    for p in wrong:
        o = ws.observations[p.recording]
        note = WrongNote(p, p.of(o.loads), o.period)
        sd = np.array([sds.get((id(p), axis), 0.0) for axis in range(3)])
        if np.any(note.off > np.maximum(TELLING * sd, LEAST_TOLD)):
            out.append(note_finding(note, o.name))
    return out
