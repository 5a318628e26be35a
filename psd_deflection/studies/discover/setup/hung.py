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
TONE = 0.25
"""Half of that movement is as near as this to its strongest frequency."""
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
    found = _not_cut(ws, recording, difference, found)
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
        f: FloatArray = np.fft.rfftfreq(b - a, period).astype(np.float64)
        band = (f >= SLOWEST_HZ) & (f <= FASTEST_HZ)
        *moves, across = power[:, band].sum(axis=1).tolist()
        each = np.array(moves) if sum(moves) > PLATE * across else np.zeros(2)
        axis = int(np.argmax(each))
        peak = _strongest(f[band], power[axis, band])
        # A step that nobody noted has no tone.
        tone = float(power[axis, band & (np.abs(f - peak) <= TONE * peak)].sum())
        if peak * (b - a) * period < 2.0 or tone < 0.5 * float(power[axis, band].sum()):
            each = np.zeros(2)
        rows.append((float(np.sqrt(each.sum())), float(np.sqrt(2.0 * each[axis]) / per[axis]), peak))
    sizes = np.array([r[0] for r in rows])
    limit = max(SWAYS * float(np.median(sizes)), SWAYS_M) if len(sizes) >= FEWEST else np.inf
    return [Swaying(p, r[1], r[2]) for p, r in zip(found.plateaus, rows, strict=True) if r[0] > limit]


def _strongest(f: FloatArray, power: FloatArray) -> float:
    """Frequency at which ``power`` is largest, between those of ``f``: the top of a parabola through its logarithm."""
    if not len(f) or not power.any():
        return 0.0
    k = min(max(int(np.argmax(power)), 1), len(f) - 2)
    if k < 1:
        return float(f[np.argmax(power)])
    a, b, c = np.log(np.maximum(power[k - 1 : k + 2], 1e-300)).tolist()
    bend = a - 2.0 * b + c
    shift = 0.5 * (a - c) / bend if bend < 0.0 else 0.0
    return float(f[k] + min(max(shift, -1.0), 1.0) * (f[1] - f[0]))


def _not_cut(ws: Workspace, recording: int, difference: FloatArray, found: PlateauLoads) -> PlateauLoads:
    """What swings seems to step, too: the time of a noted load is whole if steps cut it into too short pieces."""
    o = ws.observations[recording]
    listed = list[Plateau]()
    for whole in plateaus(o.rig, o.volts, o.loads, recording, noted=True):
        pieces = [p for p in found.plateaus if p.number == whole.number]
        all_there = sum(p.last - p.first for p in pieces) >= whole.last - whole.first
        listed += pieces if all_there else [whole]
    return found if listed == [*found.plateaus] else levels(ws, recording, difference, listed)


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
