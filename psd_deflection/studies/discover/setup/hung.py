"""Free loads of a search: what hung where another load was noted, and weights that sway.

A movement of the plate that swings is a weight that sways. A few wrong notes stand out (:mod:`.loads.plateaus`) and are
free before any search. If all notes are wrong (rounded), they are free only if the search has failed, and if free loads
then leave next to nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.model.link import LinkStatics
from psd_deflection.records import FloatArray
from psd_deflection.studies.check.judges import note_finding
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.search.workspace import LoadDirection, Workspace
from psd_deflection.studies.loads.load_cell import MeasuredLoad
from psd_deflection.studies.loads.plate_motion import across_plate
from psd_deflection.studies.loads.plateaus import (
    FEWEST,
    Plateau,
    PlateauLoads,
    WrongNote,
    asked_for,
    plateaus,
)

SWAYS, SLOWEST_HZ, FASTEST_HZ = 8.0, 0.3, 6.0
"""A weight that sways makes so much more slow movement than any other, in this band."""
PLATE = 10.0
"""And moves the plate: what no movement of the plate makes has so many times less energy."""
SWAYS_M = 2e-6
"""And at least this, rms."""
FREE = 100.0
"""N or N m: standard deviation of a load that nobody knows."""
TELLING = 4.0
"""Standard deviations by which a load that is told differs from the noted one."""
LEAST_TOLD = (0.02, 0.02, 0.01)
"""N, N, N m: a smaller difference is not told."""


@dataclass(frozen=True, slots=True, eq=False)
class Swaying:
    """A weight that swayed: its plateau, the amplitude of the force, N, and the frequency, Hz."""

    plateau: Plateau
    force: float
    frequency: float

    def finding(self, o: Observation) -> Finding:
        """In words."""
        p = self.plateau
        words = (
            f'the weight that hung on the link of {o.name} from {p.first * o.period:.3f} s to '
            f'{p.last * o.period:.3f} s swayed at {self.frequency:.2f} Hz by {self.force:.2g} N: '
            'steady it; this time is left out'
        )
        return Finding('load_value', f'load {p.number}', None, words, self.force)


def times(o: Observation, recording: int) -> list[Plateau]:
    """Those of a recording between changes of its load."""
    return plateaus(o.rig, o.volts, o.loads, recording)


def levels(ws: Workspace, recording: int, difference: FloatArray, listed: Sequence[Plateau]) -> PlateauLoads:
    """The loads that ``difference`` (6, m), V, measured minus simulated, asks for."""
    o = ws.observations[recording]
    return asked_for(o.rig, difference, ws.count[recording], len(o.loads), ws.fine[recording], listed)


def swaying(ws: Workspace, recording: int, difference: FloatArray, found: PlateauLoads) -> list[Swaying]:
    """Plateaus in which the link swings slowly, and only there; ``found``: the loads that ``difference`` asks for."""
    o = ws.observations[recording]
    beyond = across_plate(o.rig, difference)
    period = o.period * ws.fine[recording]
    per = np.diag(LinkStatics.from_rig(o.rig).compliance)
    rows = []
    for p in found.plateaus:
        # The link has come to rest by then, or nearly.
        a, b = p.first // ws.fine[recording] + round(0.4 / period), p.last // ws.fine[recording]
        part = found.rest[:2, a:b]
        there = np.isfinite(part).all(axis=0)
        # How the link moved before the first sample is nobody's mistake.
        if p.first == 0 or there.sum() < round(0.5 / period):
            rows.append((0.0, 0.0, 0.0))
            continue
        part = np.vstack((part, beyond[a:b]))
        part = np.where(there, part - part[:, there].mean(axis=1, keepdims=True), 0.0)
        power = np.abs(np.fft.rfft(part * np.hanning(b - a), axis=1)) ** 2 / (0.375 * (b - a) ** 2) * 2.0
        f = np.fft.rfftfreq(b - a, period)
        band = (f >= SLOWEST_HZ) & (f <= FASTEST_HZ)
        *moves, across = power[:, band].sum(axis=1).tolist()
        each = np.array(moves) if sum(moves) > PLATE * across else np.zeros(2)
        axis = int(np.argmax(each))
        peak = float(f[band][np.argmax(power[axis, band])]) if band.any() else 0.0
        rows.append((float(np.sqrt(each.sum())), float(np.sqrt(2.0 * each[axis]) / per[axis]), peak))
    sizes = np.array([r[0] for r in rows])
    limit = max(SWAYS * float(np.median(sizes)), SWAYS_M) if len(sizes) >= FEWEST else np.inf
    return [Swaying(p, r[1], r[2]) for p, r in zip(found.plateaus, rows, strict=True) if r[0] > limit]


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
