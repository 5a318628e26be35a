# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What hung on the link of a recording: loads noted otherwise than they were, unknown times, weights that sway."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.loads.annotated_times import CorrectedNote
from psd_deflection.studies.loads.holds import (
    Hold,
    ImpliedLoads,
    WrongNote,
    as_applied,
    find_holds,
    implied_beside_rig,
    wrong_notes,
)
from psd_deflection.studies.loads.thresholds import (
    DISTINCT_SD,
    EXACT,
    FEWEST_LOADS,
    MANYFOLD,
    OUTLIER_SD,
    PART,
    PLATE_M,
    REST_S,
    SEVERAL,
    SLIGHT,
    SWAY_HZ,
    TOLERANCE,
)


@dataclass(frozen=True, slots=True, eq=False)
class SwayingLoad:
    """A weight that swayed: its hold, the amplitude of the force, N, and the frequency, Hz. ``period``: s from one
    sample to the next. ``swung`` (k, 3): N, N, N m, what it added to the load in each sample of the hold, about; a
    clamp that sticks keeps the last of it.
    """

    hold: Hold
    force: float
    frequency: float
    period: float
    swung: FloatArray | None = None

    @property
    def name(self) -> str:
        """Of the finding."""
        return 'load_value'

    @property
    def where(self) -> str:
        """``load 3``."""
        return f'load {self.hold.number}'

    @property
    def value(self) -> None:
        """Nothing else is to be noted."""
        return

    @property
    def size(self) -> float:
        """N."""
        return self.force

    def words(self, name: str) -> str:
        """What happened, and what to do; ``name``: of the recording."""
        p = self.hold
        return (
            f'the weight that hung on the link of {name} from {p.first * self.period:.3f} s to '
            f'{p.last * self.period:.3f} s swayed at {self.frequency:.2f} Hz by {self.force:.2g} N: '
            'steady it; this time is left out'
        )


def swaying(
    implied: ImpliedLoads, annotated: Sequence[Hold], again: Callable[[Sequence[Hold]], ImpliedLoads], period: float
) -> list[SwayingLoad]:
    """Return the holds of ``implied`` in which the link swings. ``annotated``: between annotated changes; ``again``:
    the loads that other holds ask for; ``period``: s from one sample to the next.
    """
    implied = _not_cut(implied, annotated, again)
    size, fine = implied.size, period * implied.size
    rows = []
    for p in implied.holds:
        a, b = p.first // size + round(REST_S / fine), p.last // size
        part = implied.rest[:2, a:b]
        there = np.isfinite(part).all(axis=0)
        # How the link moved before the first sample is nobody's mistake.
        if p.first == 0 or there.sum() < round(0.5 / fine):
            rows.append((0.0, 0.0, 0.0))
            continue
        part = np.vstack((part, implied.beside[..., a:b]))
        part = np.where(there, part - part[:, there].mean(axis=1, keepdims=True), 0.0)
        power = np.abs(np.fft.rfft(part * np.hanning(b - a), axis=1)) ** 2 / (0.375 * (b - a) ** 2) * 2.0
        f: FloatArray = np.fft.rfftfreq(b - a, fine).astype(np.float64)
        band = (f >= SWAY_HZ[0]) & (f <= SWAY_HZ[1])
        moves, across = np.split(power[:, band].sum(axis=1), [2])
        each = moves if sum(moves) > MANYFOLD * sum(across) else np.zeros(2)
        axis = int(np.argmax(each))
        peak = peak_frequency(f[band], power[axis, band])
        # A step that nobody noted has no tone.
        tone = float(power[axis, band & (np.abs(f - peak) <= PART * peak)].sum())
        if peak * (b - a) * fine < 2.0 or tone < 0.5 * float(power[axis, band].sum()):
            each = np.zeros(2)
        rows.append((float(np.sqrt(each.sum())), float(np.sqrt(2.0 * each[axis]) / implied.compliance[axis]), peak))
    sizes = np.array([r[0] for r in rows])
    limit = max(OUTLIER_SD * float(np.median(sizes)), MANYFOLD * PLATE_M) if len(sizes) >= FEWEST_LOADS else np.inf
    out: dict[int, SwayingLoad] = {}
    for p, (moved, force, frequency) in sorted(zip(implied.holds, rows, strict=True), key=lambda both: both[1][0]):
        if moved > limit:
            # A strong sway seems to step: all of the time of that load, from its largest part.
            annotated_hold = next((w for w in annotated if w.first <= p.first < w.last), p)
            out[annotated_hold.first] = SwayingLoad(
                annotated_hold, force, frequency, period, _swung(implied, annotated_hold, frequency, period)
            )
    return [out[first] for first in sorted(out)]


def _swung(implied: ImpliedLoads, p: Hold, frequency: float, period: float) -> FloatArray:
    """(k, 3): the load in each sample of ``p`` that the link swings with: a tone whose amplitude changes slowly."""
    size, count = implied.size, p.last - p.first
    a, b = p.first // size + round(REST_S / (period * size)), p.last // size

    def tone(at: FloatArray) -> FloatArray:
        along, phase = at / count, 2.0 * math.pi * frequency * period * at
        swing = np.array([np.sin(phase), np.cos(phase)])
        return np.array([*swing, *along * swing, *along**2 * swing, np.ones_like(at)])

    part = implied.rest[:2, a:b]
    there = np.flatnonzero(np.isfinite(part).all(axis=0))
    middles = np.asarray((a + there + 0.5) * size - 0.5 - p.first, dtype=np.float64)
    sizes = np.asarray(np.linalg.lstsq(tone(middles).T, part[:, there].T, rcond=1e-9)[0])
    every: FloatArray = np.arange(count, dtype=np.float64)
    out = np.zeros((count, 3))
    # What does not swing is no sway.
    out[:, :2] = tone(every)[:-1].T @ sizes[:-1] / implied.compliance[:2]
    return out


def swung(samples: int, swayed: Sequence[SwayingLoad]) -> FloatArray | None:
    """What swayed, (samples, 3) N, N, N m, of a recording; None if nothing did."""
    if not swayed:
        return None
    out = np.zeros((samples, 3))
    for s in swayed:
        if s.swung is not None:
            out[s.hold.first : s.hold.last] += s.swung
    return out


def swaying_loads(rig: Rig, volts: FloatArray, loads: FloatArray) -> list[SwayingLoad]:
    """Those of a recording of a rig that is nearly as its file says.

    ``volts`` (n, 3P) V of the PSDs, NaN if a sample is lost; ``loads`` (n, 3) N, N, N m, held, as they acted.
    """
    period = 1.0 / rig.converter.sample_rate_hz
    asked = implied_beside_rig(rig, volts, loads)
    listed = find_holds(rig, volts, loads)
    if len(listed) < FEWEST_LOADS:
        return []
    return swaying(asked(listed), find_holds(rig, volts, loads, annotated_only=True), asked, period)


def excluded(rig: Rig, volts: FloatArray, swayed: Sequence[SwayingLoad]) -> FloatArray:
    """``volts`` (n, 3P) without the times in which a weight swayed, and until the link has come to rest after it."""
    out = volts.copy()
    d = rig.dynamics
    slowest = 1.0 / (2.0 * math.pi * d.bending_frequency * max(d.bending_damping_ratio, 1e-3))
    for s in swayed:
        out[s.hold.first : s.hold.last + round(-math.log(EXACT) * slowest / s.period)] = np.nan
    return out


def peak_frequency(f: FloatArray, power: FloatArray) -> float:
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


def _not_cut(
    implied: ImpliedLoads, annotated: Sequence[Hold], again: Callable[[Sequence[Hold]], ImpliedLoads]
) -> ImpliedLoads:
    """What swings seems to step, too: the time of an annotated load is whole if steps cut it into too short pieces."""
    listed = list[Hold]()
    for annotated_hold in annotated:
        pieces = [p for p in implied.holds if p.number == annotated_hold.number]
        all_there = sum(p.last - p.first for p in pieces) >= annotated_hold.last - annotated_hold.first
        listed += pieces if all_there else [annotated_hold]
    return implied if listed == [*implied.holds] else again(listed)


@dataclass(frozen=True, slots=True)
class UnannotatedTime:
    """Samples ``first`` to ``last`` of ``samples``, in which ``changes`` of the load were not noted. ``period``: s from
    one sample to the next.
    """

    first: int
    last: int
    samples: int
    changes: int
    period: float

    @property
    def name(self) -> str:
        """Of the finding."""
        return 'load_coverage'

    @property
    def where(self) -> str:
        """The loads."""
        return 'load_fx load_fy load_tz'

    @property
    def value(self) -> float:
        """Share of the recording."""
        return (self.last - self.first) / self.samples

    @property
    def size(self) -> float:
        """The same."""
        return self.value

    def words(self, name: str) -> str:
        """What was wrong, and what to do; ``name``: of the recording."""
        end = 'the end' if self.last == self.samples else f'{self.last * self.period:.3f} s'
        return (
            f'{name}: from {self.first * self.period:.3f} s to {end} the load changed {self.changes} times, and nobody '
            'noted it: note each change; this time is left out'
        )


def unannotated_times(implied: ImpliedLoads, samples: int, period: float) -> list[UnannotatedTime]:
    """Those of a recording of so many ``samples``; none if no annotated load would be left. ``period``: s from one
    sample to the next.

    A change counts if the plate moves with it by what no effect does to the annotated load.
    """
    allowed = DISTINCT_SD * (TOLERANCE + EXACT * np.abs(implied.annotated).max(initial=0.0))
    out = []
    numbered = groupby(range(len(implied.holds)), key=lambda k: implied.holds[k].number)
    for _, group in numbered:
        in_group = list(group)
        more = implied.more[in_group]
        steps = np.abs(np.diff(more, axis=0)).max(axis=1) > allowed
        alone = [k for k, stepped in zip(in_group[1:], steps, strict=True) if stepped and implied.holds[k].unannotated]
        as_plate = np.abs(implied.across[in_group]).max() <= SLIGHT * float(implied.sizes[in_group].max()) + PLATE_M
        if len(alone) >= SEVERAL and as_plate:
            first, last = implied.holds[alone[0]].first, implied.holds[in_group[-1]].last
            out.append(UnannotatedTime(first, last, samples, len(alone), period))
    remaining = [
        p for p in implied.holds if not any(u.first <= p.first < u.last for u in out) and np.any(p.annotated != 0.0)
    ]
    return out if remaining else []


def without_times(volts: FloatArray, times: Sequence[UnannotatedTime]) -> FloatArray:
    """``volts`` (n, 3P) without these."""
    out = volts.copy()
    for u in times:
        out[u.first : u.last] = np.nan
    return out


LoadNote = CorrectedNote | WrongNote | SwayingLoad | UnannotatedTime
"""What was noted of a load otherwise than it was."""


@dataclass(frozen=True, slots=True, eq=False)
class EffectiveLoads:
    """``loads`` (n, 3) N, N, N m, as they acted; ``volts`` (n, 3P) V without the times in which nobody knows; ``notes``
    of what was noted otherwise.
    """

    loads: FloatArray
    volts: FloatArray
    notes: tuple[LoadNote, ...]


def effective_loads(rig: Rig, volts: FloatArray, loads: FloatArray) -> EffectiveLoads:
    """Those of a recording. ``volts`` (n, 3P) V of the PSDs, NaN if a sample is lost; ``loads`` (n, 3) N, N, N m, held,
    at the times at which they acted.
    """
    period = 1.0 / rig.converter.sample_rate_hz
    swayed = swaying_loads(rig, volts, loads)
    steady = excluded(rig, volts, swayed)
    wrong = wrong_notes(rig, steady, loads)
    listed = find_holds(rig, volts, loads)
    if not wrong and sum(p.unannotated for p in listed) >= SEVERAL:
        implied = implied_beside_rig(rig, volts, loads)(listed)
        if unannotated := unannotated_times(implied, len(loads), period):
            # What seemed to sway there was hung and taken off.
            rest = effective_loads(rig, without_times(volts, unannotated), loads)
            return EffectiveLoads(rest.loads, rest.volts, (*unannotated, *rest.notes))
    return EffectiveLoads(as_applied(loads, wrong), steady, (*swayed, *wrong))
