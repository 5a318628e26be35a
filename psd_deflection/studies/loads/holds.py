# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What hung on the link, if it is not what was noted: the constant load between two changes that moves the plate as it
did. A few wrong notes stand out beside an effect, which acts in proportion to the loads."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import BoolArray, FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.loads.annotated_times import ordinal, unannotated_steps
from psd_deflection.studies.loads.plate_motion import across_plate, dot_rows, fine_means, moved_plate
from psd_deflection.studies.loads.thresholds import (
    DISTINCT_SD,
    EXACT,
    FEWEST_LOADS,
    FINE_SECONDS,
    LONG_S,
    MANYFOLD,
    MINOR,
    PART,
    PLATE_M,
    ROUND_STEPS,
    SLIGHT,
    TOLERANCE,
)

IntArray = npt.NDArray[np.intp]

AXES = np.array([1.0, 1.0, 0.1])
"""An angle counts by what it moves at a tenth of a metre, m/rad."""
ANY = 1e9
"""Nobody says how much an effect, a sign or a unit changes a load."""


@dataclass(frozen=True, slots=True, eq=False)
class Hold:
    """One time between two changes of the load: samples ``first`` to ``last`` of recording ``recording``.

    ``number``: of the annotated change that began it, from 1; 0 before the first. ``unannotated``: nothing was noted
    when it began; ``end_unannotated``: nor when it ended. ``annotated`` (3,): N, N, N m.
    """

    recording: int
    first: int
    last: int
    number: int
    unannotated: bool
    annotated: FloatArray
    end_unannotated: bool = False

    def of(self, loads: FloatArray) -> FloatArray:
        """(3,): the load in its middle, of ``loads`` (n, 3)."""
        return np.asarray(loads[(self.first + self.last) // 2])


def find_holds(
    rig: Rig, volts: FloatArray, loads: FloatArray, recording: int = 0, *, annotated_only: bool = False
) -> list[Hold]:
    """Return the times between changes of ``loads`` (n, 3), also between those that only the motion shows.

    ``volts`` (n, 3P) V of the PSDs, NaN if a sample is lost. ``recording``: its index. ``annotated_only``: only between
    annotated changes.
    """
    period = 1.0 / rig.converter.sample_rate_hz
    changed = np.flatnonzero(np.any(np.diff(loads, axis=0) != 0.0, axis=1)) + 1
    # A load that was applied slowly changes from sample to sample: what counts is its end.
    ends = changed[np.append(np.diff(changed) > 1, True)].tolist() if len(changed) else []
    dots = volts[:, dot_rows(len(rig.psds))] * rig.sensitivities.ravel()
    unannotated = [] if annotated_only else [round(t / period) for t in unannotated_steps(rig, dots, loads)]
    starts = sorted([(0, False), *((c, False) for c in ends), *((c, True) for c in unannotated)])
    stops = np.append(np.union1d(changed, unannotated), len(loads))
    out, number = [], 0
    for first, alone in starts:
        number += not alone and first > 0
        last = int(stops[np.searchsorted(stops, first, side='right')])
        if (last - first) * period >= LONG_S:
            middle = loads[(first + last) // 2].copy()
            out.append(Hold(recording, first, last, number, alone, middle, last in unannotated))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class ImpliedLoads:
    """``more`` (k, 3): by what the load of each of the ``holds`` seems to differ from the annotated one, N, N,
    N m; 0 if there are no readings of it.

    ``rest`` (3, m): the movement in fine blocks that no load explains, m, m, rad; ``moved`` (3, m): all of it.
    ``beside`` (2P - 3, m): what no movement of the plate makes, m.
    ``across`` (k,): how far the dots are then from where any movement of the plate would have them, m; of two PSDs with
    a sign.
    ``compliance`` (3,): m/N, m/N, rad/(N m). ``size``: samples of a fine block.
    """

    holds: tuple[Hold, ...]
    more: FloatArray
    rest: FloatArray
    moved: FloatArray
    beside: FloatArray
    across: FloatArray
    compliance: FloatArray
    size: int

    @property
    def annotated(self) -> FloatArray:
        """(k, 3) N, N, N m."""
        return np.array([p.annotated for p in self.holds]).reshape(-1, 3)

    @property
    def sizes(self) -> FloatArray:
        """(k,): how far ``more`` moves the plate, m."""
        return np.asarray(np.linalg.norm(self.more * self.compliance * AXES, axis=1))


def implied_loads(
    rig: Rig, difference: FloatArray, count: FloatArray, samples: int, size: int, listed: Sequence[Hold]
) -> ImpliedLoads:
    """Return the loads that readings ask for: ``difference`` (3P, m), V, measured minus simulated.

    Of a recording of so many ``samples``, in means of ``size``, of which the share ``count`` (3P, m) is there.
    """
    moved = moved_plate(rig, difference, count)
    compliance = np.diag(LinkStatics.from_rig(rig).compliance)
    there: BoolArray = np.isfinite(moved).all(axis=0) & _held(listed, samples, size, moved.shape[1])
    more, rest = np.zeros((len(listed), 3)), np.full_like(moved, np.nan)
    # The ringing after a hold that was left out does not say which load it was.
    shown = [k for k, p in enumerate(listed) if there[p.first // size : p.last // size].any()]
    d = rig.dynamics
    modes = (d.bending_frequency, d.bending_damping_ratio), (d.torsion_frequency, d.torsion_damping_ratio)
    bent, twisted = (_motion(rig, mode, samples, size, [listed[k] for k in shown]) for mode in modes)
    for axis, columns in enumerate((bent, bent, twisted)):
        solution = np.linalg.lstsq(columns[:, there].T, moved[axis, there], rcond=1e-9)[0]
        more[shown, axis] = solution[1:] / compliance[axis]
        rest[axis, there] = moved[axis, there] - solution @ columns[:, there]
    beside = np.where(there, across_plate(rig, difference), np.nan)
    across = np.array([[_mean(row[p.first // size : p.last // size]) for p in listed] for row in beside])
    across = across - across[:, :1]
    distance = across[0] if len(across) == 1 else np.linalg.norm(across, axis=0)
    # What the first time has is an offset, which all have.
    moved = np.where(there, moved, np.nan)
    return ImpliedLoads(tuple(listed), more, rest, moved, beside, distance, compliance, size)


def implied_beside_rig(rig: Rig, volts: FloatArray, acting: FloatArray) -> Callable[[Sequence[Hold]], ImpliedLoads]:
    """Return the same, of ``volts`` (n, 3P) held against the rig as its file says under ``acting`` loads (n, 3)."""
    size = max(1, round(FINE_SECONDS * rig.converter.sample_rate_hz))
    difference = (volts - ForwardModel(rig).expect(acting).volts.T).T
    there = np.isfinite(difference).astype(np.float64)
    means = fine_means(np.where(there > 0.0, difference, 0.0), size, there)
    count = fine_means(there, size)
    return lambda listed: implied_loads(rig, means, count, len(acting), size, listed)


def _mean(values: FloatArray) -> float:
    there = values[np.isfinite(values)]
    return float(there.mean()) if len(there) else 0.0


def _held(listed: Sequence[Hold], samples: int, size: int, blocks: int) -> BoolArray:
    inside = np.zeros(samples, dtype=bool)
    for p in listed:
        inside[p.first : p.last] = True
    return np.asarray(inside[: blocks * size].reshape(blocks, size).all(axis=1))


def _motion(rig: Rig, mode: tuple[float, float], samples: int, size: int, listed: Sequence[Hold]) -> FloatArray:
    """(1 + k, m): an offset, and how the link moves, as a share, if a load acts in one of the holds after the first."""
    out = np.ones((1 + len(listed), samples // size))
    for row, p in zip(out[1:], listed, strict=True):
        acts = np.zeros(samples)
        if p.first > 0:
            acts[p.first : p.last] = 1.0
        response = Filter(mode_coefficients(*mode, 1.0 / rig.converter.sample_rate_hz))(acts)
        row[:] = fine_means(response[None, :], size)[0]
    return out


@dataclass(frozen=True, slots=True)
class StandingOut:
    """``gone``: holds with another load than noted. ``softer``: the share by which effects may change the others."""

    gone: tuple[int, ...] = ()
    softer: float = 0.0


def outliers(implied: ImpliedLoads, bent: float = 0.0, largest: float = ANY) -> StandingOut:
    """Return the few holds with another load than noted; none if it is none or are many.

    ``bent``: share of what is wrong by which the others may seem to be, too. ``largest``: share by which an effect, a
    sign or another unit may change a load that no other is like.
    """
    count = len(implied.holds)
    if np.abs(implied.more).max(initial=0.0) < PART * DISTINCT_SD * TOLERANCE or not closes(implied, PART + bent):
        return StandingOut()
    # A detector at fault moves its dots as no plate does.
    as_plate = np.abs(implied.across) <= SLIGHT * implied.sizes + PLATE_M
    off = deviation_in_tolerances(implied, (), 0.0)
    order = np.argsort(-off, kind='stable')
    for share, right, most in ((PART, FEWEST_LOADS + 1, count - FEWEST_LOADS - 1), (1.0, FEWEST_LOADS + 2, 2)):
        for wrong in range(1, min(most, count - right) + 1):
            gone = order[:wrong]
            stands = are_outliers(off[gone] / share, off[order[wrong:]] / share, bent)
            if stands and (share == 1.0 or as_plate[gone].all()) and is_known(implied, gone, largest):
                return StandingOut(tuple(sorted(gone.tolist())))
    # Two wrong ones of seven leave too few to tell what effects do.
    fitting, tried = 0, []
    for k in range(1, count if count > FEWEST_LOADS + 2 else 0):
        slopes, offset = proportional_part(implied, (k,), MINOR)
        if np.abs(slopes).max() > DISTINCT_SD * MINOR or np.abs(offset).max() > DISTINCT_SD * TOLERANCE:
            continue
        apart = deviation_in_tolerances(implied, (k,), MINOR)
        remaining = np.delete(apart, k)
        fitting += bool(remaining.max() <= 1.0 + bent * apart[k])
        if are_outliers(apart[k : k + 1], remaining, bent) and is_known(implied, np.array([k]), largest):
            tried.append(k)
    # If the others are in proportion whichever is left out, nobody knows which one is wrong.
    return StandingOut(tuple(tried), MINOR) if len(tried) == fitting == 1 else StandingOut()


def is_known(implied: ImpliedLoads, gone: IntArray, largest: float) -> bool:
    """Whether the other loads say what effects in proportion do to those of ``gone``, or no effect does so much, or a
    change was noted twice.
    """
    twice = np.array([_annotated_twice(implied, int(k)) is not None for k in gone])
    too_large = np.linalg.norm(implied.more[gone], axis=1) > largest * np.linalg.norm(implied.annotated[gone], axis=1)
    return bool(np.all(_alike(implied, gone) | too_large | twice))


def _alike(implied: ImpliedLoads, gone: IntArray) -> BoolArray:
    """Of each of ``gone`` whether it is a sum of the other loads, nearly."""
    annotated = implied.annotated
    right = np.delete(annotated, gone, axis=0)
    outlying = annotated[gone]
    rest = outlying - outlying @ np.linalg.pinv(right, rcond=SLIGHT) @ right
    return np.asarray(np.linalg.norm(rest, axis=1) <= SLIGHT * np.linalg.norm(outlying, axis=1))


def _annotated_twice(implied: ImpliedLoads, k: int) -> FloatArray | None:
    """(3,): what hung in hold ``k`` if the change that began it was noted twice; None if something else did.

    Of the first load that is ambiguous: half of it may be another unit, or another stiffness.
    """
    annotated, before = implied.annotated[k], implied.annotated[k - 1]
    if k == 0 or implied.holds[k].unannotated or not np.any(before != 0.0):
        return None
    applied = 0.5 * (before + annotated)
    off = np.abs(implied.more[k] - (applied - annotated))
    allowed = TOLERANCE + EXACT * np.abs(annotated).max() + MINOR * np.abs(applied)
    return applied if np.all(off <= allowed) and np.any(np.abs(applied - annotated) > DISTINCT_SD * allowed) else None


def are_outliers(wrong: FloatArray, remaining: FloatArray, bent: float) -> bool:
    """Return whether the ``wrong`` are far off and the others are not, in tolerances."""
    rest, least = float(remaining.max()), float(wrong.min())
    return rest <= 1.0 + bent * least and least > max(DISTINCT_SD, 5.0 * rest)


def proportional_part(implied: ImpliedLoads, gone: Sequence[int], softer: float) -> tuple[FloatArray, FloatArray]:
    """What effects do to all loads but ``gone``: (3, 3) and (3,), the likeliest if it is a share of ``softer``."""
    if softer == 0.0:
        return np.zeros((3, 3)), np.zeros(3)
    keep = np.setdiff1d(np.arange(len(implied.holds)), gone)
    x = np.column_stack((implied.annotated[keep], np.ones(len(keep))))
    prior = np.diag([(0.1 * TOLERANCE / softer) ** 2] * 3 + [0.1**2])
    both = np.asarray(np.linalg.solve(x.T @ x + prior, x.T @ implied.more[keep]), dtype=np.float64)
    return both[:3], both[3]


def deviation_in_tolerances(implied: ImpliedLoads, gone: Sequence[int], softer: float) -> FloatArray:
    """(k,): how far each load is from what effects do to the others, in units of what is allowed."""
    slopes, offset = proportional_part(implied, gone, softer)
    off = np.abs(implied.more - implied.annotated @ slopes - offset)
    allowed = TOLERANCE + EXACT * np.abs(implied.annotated).max(axis=1, keepdims=True)
    return np.asarray((off / allowed).max(axis=1))


def all_free(implied: ImpliedLoads, loads: FloatArray) -> bool:
    """Return whether other loads than noted, at most of the times, leave next to nothing of the movement.

    ``loads`` (n, 3): as the movement of ``implied`` counts them; corrected ones differ from the annotated.
    """
    if len(implied.holds) < FEWEST_LOADS or not closes(implied):
        return False
    return int(np.count_nonzero(deviation_in_tolerances(implied, (), MINOR) > 1.0)) >= 2 or are_rounded(implied, loads)


def may_be_rounded(implied: ImpliedLoads) -> bool:
    """Whether the noted forces are multiples of a whole step, and ``implied`` asks for others by less than a step."""
    held = implied.annotated[np.any(implied.annotated != 0.0, axis=1)]
    if len(held) < FEWEST_LOADS:
        return False
    forces = float(steps_of(held)[0])
    return 0.0 < forces < np.inf and bool(np.all(np.abs(implied.more[:, :2]) < forces))


def are_rounded(implied: ImpliedLoads, loads: FloatArray) -> bool:
    """Whether the loads that ``implied`` asks for are the annotated ones before these were rounded; see
    :func:`rounded`.
    """
    return rounded(implied.annotated, np.array([p.of(loads) for p in implied.holds]).reshape(-1, 3) + implied.more)


def rounded(annotated: FloatArray, applied: FloatArray) -> bool:
    """Whether the ``annotated`` loads (k, 3) are what ``applied`` (k, 3), N, N, N m, rounded to a whole step.

    They are off by up to half of it, and by no less.

    An effect of the catalogue changes loads by little against such a step, or in proportion to them.
    """
    held = np.any(annotated != 0.0, axis=1)
    if np.count_nonzero(held) < FEWEST_LOADS:
        return False
    off, annotated = (applied - annotated)[held], annotated[held]
    steps = steps_of(annotated)
    if np.any(np.abs(off) > (0.5 + EXACT) * steps):
        return False
    return float(np.sqrt(np.mean(np.max(off[:, :2] ** 2, axis=1)))) > MINOR * float(steps[0])


def steps_of(annotated: FloatArray) -> FloatArray:
    """(3,): to which steps the ``annotated`` loads (k, 3) are rounded, N, N, N m; 0 for none, infinity if all are 0."""
    return np.array([largest_step(annotated[:, :2]), largest_step(annotated[:, :2]), largest_step(annotated[:, 2:])])


def largest_step(annotated: FloatArray) -> float:
    """The largest step of which all ``annotated`` numbers are multiples; infinity if all are 0, 0 if there is none."""
    if not np.any(annotated):
        return np.inf
    return max((s for s in ROUND_STEPS if np.allclose(annotated, s * np.round(annotated / s), atol=1e-6)), default=0.0)


def closes(implied: ImpliedLoads, share: float = PART) -> bool:
    """Return whether other loads, constant between changes, leave next to nothing of the movement."""
    return _rms(implied.rest) < share * _rms(implied.moved)


def _rms(part: FloatArray) -> float:
    there = np.isfinite(part).all(axis=0)
    centred = part[:, there] - part[:, there].mean(axis=1, keepdims=True)
    return float(np.sqrt(np.mean((centred * AXES[:, None]) ** 2)))


@dataclass(frozen=True, slots=True, eq=False)
class WrongNote:
    """A load that was noted wrong, or not at all: ``applied`` (3,) N, N, N m in ``hold``. ``period``: s between
    samples. ``exact``: from the other notes, not from the readings.
    """

    hold: Hold
    applied: FloatArray
    period: float
    exact: bool = False

    @property
    def name(self) -> str:
        """Of the finding."""
        return 'missing_load' if self.hold.unannotated else 'load_value'

    @property
    def where(self) -> str:
        """``load 3``, or when it was hung."""
        p = self.hold
        return f'{p.first * self.period:.3f} s' if p.unannotated else f'load {p.number}'

    @property
    def value(self) -> tuple[float, ...]:
        """What hung: N, N, N m."""
        return tuple(self.applied.tolist())

    @property
    def off(self) -> FloatArray:
        """(3,): by what it differs from the annotated load, N, N, N m."""
        return np.asarray(np.abs(self.applied - self.hold.annotated))

    @property
    def size(self) -> float:
        """The largest of these."""
        return float(self.off.max())

    def words(self, name: str) -> str:
        """What was wrong, and what to do; ``name``: of the recording."""
        p = self.hold
        return (
            f'{_begun(p, name)}: from {p.first * self.period:.3f} s to {p.last * self.period:.3f} s '
            f'({_worded(self.applied)}) hung, not ({_worded(p.annotated)}): note that'
        )


def wrong_notes(rig: Rig, volts: FloatArray, loads: FloatArray) -> list[WrongNote]:
    """Return the few loads of a recording that are not what hung, of a rig that is nearly as its file says.

    ``volts`` (n, 3P) V of the PSDs, NaN if a sample is lost; ``loads`` (n, 3) N, N, N m, held, at the times at which
    they acted. Effects of the catalogue are no reason: they change all loads in proportion, more or less.
    """
    listed = find_holds(rig, volts, loads)

    def asked(acting: FloatArray) -> ImpliedLoads:
        return implied_beside_rig(rig, volts, acting)(listed)

    return wrong_notes_against(loads, 1.0 / rig.converter.sample_rate_hz, asked)


def wrong_notes_against(
    loads: FloatArray, period: float, asked: Callable[[FloatArray], ImpliedLoads], largest: float = ANY
) -> list[WrongNote]:
    """Return the same of any simulation: ``asked`` holds the recording against that under other loads (n, 3).

    ``largest``: share by which effects may change a load; signs and units are right then.
    """
    first = asked(loads)
    if not len(first.holds) or np.abs(first.more).max(initial=0.0) < PART * DISTINCT_SD * TOLERANCE:
        return []
    # A load that is far off moves the dots to where neither plate nor detectors are linear, or off the detectors: what
    # the readings themselves say hung is simulated, then judged.
    annotated = first.annotated
    readings_ask = asked(np.zeros_like(loads)).more
    linear = MANYFOLD * TOLERANCE + MINOR * np.abs(readings_ask).max(axis=1)
    distant = np.abs(readings_ask - annotated).max(axis=1) > linear
    applied = np.where(distant[:, None], readings_ask, annotated)

    def against() -> ImpliedLoads:
        off = np.flatnonzero((applied != annotated).any(axis=1)).tolist()
        implied = asked(as_applied(loads, [WrongNote(first.holds[k], applied[k], period) for k in off]))
        return replace(implied, more=implied.more + applied - annotated, moved=first.moved)

    implied = against()
    which = outliers(implied, MINOR, largest)
    for bent in (0.2 * MINOR, 0.0, 0.0, 0.0):
        if not which.gone:
            return []
        slopes, offset = proportional_part(implied, which.gone, which.softer)
        for k in which.gone:
            applied[k] = np.linalg.solve((np.eye(3) + slopes).T, annotated[k] + implied.more[k] - offset)
        implied = against()
        which = outliers(implied, bent, largest)
    out = []
    for k in which.gone:
        # What effects do to a load that no other is like, the readings alone do not tell from the load.
        twice = None if _alike(implied, np.array([k]))[0] else _annotated_twice(implied, k)
        out.append(WrongNote(first.holds[k], applied[k] if twice is None else twice, period, twice is not None))
    return out


def as_applied(loads: FloatArray, wrong: Sequence[WrongNote]) -> FloatArray:
    """``loads`` (n, 3) with what hung in place of what was noted."""
    out = loads.copy()
    for note in wrong:
        out[note.hold.first : note.hold.last] = note.applied
    return out


def _begun(p: Hold, name: str) -> str:
    if not p.unannotated:
        return f'the {ordinal(p.number)} load of {name} was noted wrong'
    after = f' after the {ordinal(p.number)} annotated load' if p.number else ''
    return f'something was hung or taken off{after} of {name} and not noted'


def _worded(load: FloatArray) -> str:
    # Without a minus before nothing.
    return ', '.join(f'{round(v, 2) + 0.0:g} {unit}' for v, unit in zip(load.tolist(), UNITS, strict=True))


UNITS = ('N', 'N', 'N m')
