"""What hung on the link, if it is not what was noted: three free numbers for each time between two changes.

A movement of the plate that another constant load makes, from one change to the next, is a wrong note; one that swings
is a weight that sways. An effect of the catalogue moves the plate in proportion to the loads, more or less: so a few
wrong notes stand out beside it, and are free before any search. If all notes are wrong (rounded), they are free only if
the search has failed, and if free loads then leave next to nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.records import DOT_CHANNELS, FloatArray
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.search.workspace import LoadDirection, Workspace, fine_means
from psd_deflection.studies.discover.setup.redundant import across_plate, moved_plate
from psd_deflection.studies.noted_loads import MeasuredLoad, ordinal, unnoted_steps

BoolArray = npt.NDArray[np.bool_]

LONG_S = 1.0
"""Between two changes of the load there is at least this time, or it is a sweep."""
FEWEST = 4
"""Times between changes that a judgement needs."""
FEWEST_RIGHT = 6
"""Of which so many must agree for another one to be wrong: what effects do to the loads takes four numbers an axis."""
TOLERANCE, SHARE = 0.3, 0.01
"""N and N m, and share of the load, by which effects other than in proportion to the load may seem to change it."""
STANDS_OUT = 3.0
"""A few wrong notes must exceed that so many times."""
SOFTER, OFFSET = 0.1, 0.5
"""Standard deviations of what effects do to a load: share, and N or N m."""
SWAYS, SLOWEST_HZ, FASTEST_HZ = 8.0, 0.3, 6.0
"""A weight that sways makes so much more slow movement than any other, in this band."""
PLATE = 10.0
"""And moves the plate: what no movement of the plate makes has so many times less energy."""
SWAYS_M = 2e-6
"""And at least this, rms."""
STEPS = (1.0, 2.0, 5.0, 10.0)
"""N and N m to which people round loads."""
LEAST_STEP = 0.1
"""Share of the step, rms, by which rounded forces are off at least: on average 0.29."""
FREE = 100.0
"""N or N m: standard deviation of a load that nobody knows."""
CLOSES = 0.2
"""Free loads must leave less than this share of the movement."""
TELLING = 4.0
"""Standard deviations by which a load that is told differs from the noted one."""
LEAST_TOLD = (0.02, 0.02, 0.01)
"""N, N, N m: a smaller difference is not told."""


@dataclass(frozen=True, slots=True, eq=False)
class Plateau:
    """One time between two changes of the load: samples ``first`` to ``last`` of recording ``recording``.

    ``number``: of the noted change that began it, from 1; 0 before the first. ``unnoted``: nothing was noted when it
    began. ``noted`` (3,): N, N, N m.
    """

    recording: int
    first: int
    last: int
    number: int
    unnoted: bool
    noted: FloatArray

    def of(self, loads: FloatArray) -> FloatArray:
        """(3,): the load in its middle, of ``loads`` (n, 3)."""
        return np.asarray(loads[(self.first + self.last) // 2])


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


def plateaus(o: Observation, recording: int) -> list[Plateau]:
    """The times between changes of the load, also between those that only the motion shows."""
    changed = np.flatnonzero(np.any(np.diff(o.loads, axis=0) != 0.0, axis=1)) + 1
    # A load that was applied slowly changes from sample to sample: what counts is its end.
    ends = changed[np.append(np.diff(changed) > 1, True)].tolist() if len(changed) else []
    dots = o.volts[:, list(DOT_CHANNELS)] * o.rig.sensitivities.ravel()
    unnoted = [round(t / o.period) for t in unnoted_steps(o.rig, dots, o.loads)]
    starts = sorted([(0, False), *((c, False) for c in ends), *((c, True) for c in unnoted)])
    stops = np.append(np.union1d(changed, unnoted), len(o.loads))
    out, number = [], 0
    for first, alone in starts:
        number += not alone and first > 0
        last = int(stops[np.searchsorted(stops, first, side='right')])
        if (last - first) * o.period >= LONG_S:
            out.append(Plateau(recording, first, last, number, alone, o.loads[(first + last) // 2].copy()))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class PlateauLoads:
    """``more`` (k, 3): by what the load of each of the ``plateaus`` seems to differ from the noted one, N, N, N m.

    ``rest`` (3, m): the movement in fine blocks that no load explains, m, m, rad; ``moved`` (3, m): all of it;
    ``across`` (m,): of the dots, what no movement of the plate makes, m.
    """

    plateaus: tuple[Plateau, ...]
    more: FloatArray
    rest: FloatArray
    moved: FloatArray
    across: FloatArray

    @property
    def noted(self) -> FloatArray:
        """(k, 3) N, N, N m."""
        return np.array([p.noted for p in self.plateaus])


def levels(ws: Workspace, recording: int, difference: FloatArray, listed: Sequence[Plateau]) -> PlateauLoads:
    """The loads that the movement of ``difference`` (6, m), V, measured minus simulated, asks for."""
    o, size = ws.observations[recording], ws.fine[recording]
    moved = moved_plate(o.rig, difference, ws.count[recording])
    compliance = np.diag(LinkStatics.from_rig(o.rig).compliance)
    there: BoolArray = np.isfinite(moved).all(axis=0) & _held(listed, len(o.loads), size, moved.shape[1])
    more, rest = np.zeros((len(listed), 3)), np.full_like(moved, np.nan)
    for axis in range(3):
        columns = np.array(
            [np.ones(moved.shape[1]), *(fine_means(r[None, :], size)[0] for r in _pulses(o, listed, axis))]
        )
        found = np.linalg.lstsq(columns[:, there].T, moved[axis, there], rcond=1e-9)[0]
        more[:, axis] = found[1:] / compliance[axis]
        rest[axis, there] = moved[axis, there] - found @ columns[:, there]
    # What the first time has is an offset, which all have.
    return PlateauLoads(tuple(listed), more, rest, np.where(there, moved, np.nan), across_plate(o.rig, difference))


def _held(listed: Sequence[Plateau], samples: int, size: int, blocks: int) -> BoolArray:
    inside = np.zeros(samples, dtype=bool)
    for p in listed:
        inside[p.first : p.last] = True
    return np.asarray(inside[: blocks * size].reshape(blocks, size).all(axis=1))


def _pulses(o: Observation, listed: Sequence[Plateau], axis: int) -> list[FloatArray]:
    """How the link moves, as a share, if a load acts in one of the plateaus after the first."""
    d = o.rig.dynamics
    mode = (
        (d.torsion_frequency, d.torsion_damping_ratio) if axis == 2 else (d.bending_frequency, d.bending_damping_ratio)
    )
    out = []
    for p in listed:
        acts = np.zeros(len(o.loads))
        if p.first > 0:
            acts[p.first : p.last] = 1.0
        out.append(Filter(mode_coefficients(*mode, o.period))(acts))
    return out


def stand_out(found: PlateauLoads) -> list[tuple[int, FloatArray]]:
    """The few plateaus with another load than noted, and by what (3,) it differs; none if it is none or are many."""
    count = len(found.plateaus)
    if np.abs(found.more).max(initial=0.0) < STANDS_OUT * TOLERANCE or not _closes(found):
        return []
    # Two wrong ones of seven leave too few to tell what effects do: only beside loads that are right as noted.
    for size, softer in ((1, 0.0), (2, 0.0), (1, SOFTER)):
        if count - size < FEWEST_RIGHT:
            continue
        tried = []
        for gone in itertools.combinations(range(1, count), size):
            apart = _apart(found, gone, softer)
            rest = np.delete(apart, gone)
            if rest.max() <= 1.0 and apart[list(gone)].min() > max(STANDS_OUT, 5.0 * rest.max()):
                tried.append((float(rest.max()), gone))
        if tried:
            gone = min(tried)[1]
            slopes, offset = _proportion(found, gone, softer)
            out = []
            for k in gone:
                own = found.more[k] - found.noted[k] @ slopes - offset
                out.append((k, np.linalg.solve((np.eye(3) + slopes).T, own)))
            return out
    return []


def _proportion(found: PlateauLoads, gone: Sequence[int], softer: float) -> tuple[FloatArray, FloatArray]:
    """What effects do to all loads but ``gone``: (3, 3) and (3,), the likeliest if it is a share of ``softer``."""
    if softer == 0.0:
        return np.zeros((3, 3)), np.zeros(3)
    keep = np.setdiff1d(np.arange(len(found.plateaus)), gone)
    x = np.column_stack((found.noted[keep], np.ones(len(keep))))
    prior = np.diag([(0.1 * TOLERANCE / softer) ** 2] * 3 + [(0.1 * TOLERANCE / OFFSET) ** 2])
    both = np.asarray(np.linalg.solve(x.T @ x + prior, x.T @ found.more[keep]), dtype=np.float64)
    return both[:3], both[3]


def _apart(found: PlateauLoads, gone: Sequence[int], softer: float) -> FloatArray:
    """(k,): how far each load is from what effects do to the others, in units of what is allowed."""
    slopes, offset = _proportion(found, gone, softer)
    off = np.abs(found.more - found.noted @ slopes - offset)
    allowed = TOLERANCE + SHARE * np.abs(found.noted).max(axis=1, keepdims=True)
    return np.asarray((off / allowed).max(axis=1))


def all_free(found: PlateauLoads, loads: FloatArray) -> bool:
    """Whether other loads than noted, at most of the times, leave next to nothing of the movement.

    ``loads`` (n, 3): as the movement of ``found`` counts them; those that were already put right differ from the noted.
    """
    if len(found.plateaus) < FEWEST or not _closes(found):
        return False
    return int(np.count_nonzero(_apart(found, (), SOFTER) > 1.0)) >= 2 or _rounded(found, loads)


def _rounded(found: PlateauLoads, loads: FloatArray) -> bool:
    """Whether the noted loads are what hung, rounded to a whole step: off by up to half of it, and by no less.

    An effect of the catalogue changes loads by little against such a step, or in proportion to them.
    """
    hung = np.array([p.of(loads) for p in found.plateaus]) + found.more
    held = np.any(found.noted != 0.0, axis=1)
    if np.count_nonzero(held) < FEWEST:
        return False
    off, noted = (hung - found.noted)[held], found.noted[held]
    steps = np.array([_step(noted[:, :2]), _step(noted[:, :2]), _step(noted[:, 2:])])
    if np.any(np.abs(off) > (0.5 + SHARE) * steps):
        return False
    return float(np.sqrt(np.mean(np.max(off[:, :2] ** 2, axis=1)))) > LEAST_STEP * float(steps[0])


def _step(noted: FloatArray) -> float:
    """The largest step of which all ``noted`` numbers are multiples; infinity if all are 0, 0 if there is none."""
    if not np.any(noted):
        return np.inf
    return max((s for s in STEPS if np.allclose(noted, s * np.round(noted / s), atol=1e-6)), default=0.0)


def _closes(found: PlateauLoads) -> bool:
    """Whether other loads, constant between changes, leave next to nothing of the movement."""
    return _rms(found.rest) < CLOSES * _rms(found.moved)


def _rms(part: FloatArray) -> float:
    there = np.isfinite(part).all(axis=0)
    centred = part[:, there] - part[:, there].mean(axis=1, keepdims=True)
    # An angle counts by what it moves at a tenth of a metre.
    return float(np.sqrt(np.mean((centred * np.array([[1.0], [1.0], [0.1]])) ** 2)))


def swaying(ws: Workspace, recording: int, found: PlateauLoads) -> list[Swaying]:
    """Plateaus in which the link swings slowly, and only there."""
    o = ws.observations[recording]
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
        part = np.vstack((part, found.across[a:b]))
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
        hung = p.of(o.loads)
        sd = np.array([sds.get((id(p), axis), 0.0) for axis in range(3)])
        off = np.abs(hung - p.noted)
        if np.any(off > np.maximum(TELLING * sd, LEAST_TOLD)):
            words = f'{_begun(p, o.name)}: from {p.first * o.period:.3f} s to {p.last * o.period:.3f} s '
            words += f'({_worded(hung)}) hung, not ({_worded(p.noted)}): note that'
            name, where = (
                ('missing_load', f'{p.first * o.period:.3f} s') if p.unnoted else ('load_value', f'load {p.number}')
            )
            out.append(Finding(name, where, tuple(hung.tolist()), words, float(off.max())))
    return out


def _begun(p: Plateau, name: str) -> str:
    if not p.unnoted:
        return f'the {ordinal(p.number)} load of {name} was noted wrong'
    after = f' after the {ordinal(p.number)} noted load' if p.number else ''
    return f'something was hung or taken off{after} of {name} and not noted'


def _worded(load: FloatArray) -> str:
    # Without a minus before nothing.
    return ', '.join(f'{round(v, 2) + 0.0:g} {unit}' for v, unit in zip(load.tolist(), UNITS, strict=True))


UNITS = ('N', 'N', 'N m')
