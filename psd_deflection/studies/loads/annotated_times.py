# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""When annotated loads began to act: steps of the dots are matched with the notes in their order. Only the link's
natural frequencies are taken from the rig file, so a wrong wiring, sign or unit changes no time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from psd_deflection.measure.steps import LEAST_SHARE, PERIODS, DotStep, lasting_steps
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.plate.linear import design_matrix
from psd_deflection.records import BoolArray, FloatArray, IntArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.loads.steps import applied, link_modes, link_motion, time_of_step
from psd_deflection.studies.loads.thresholds import (
    APART_S,
    AS_GOOD,
    BRIEF_S,
    DISTINCT_SD,
    EXACT,
    FEWEST_VALUES,
    FINE_SECONDS,
    LATE_COST,
    ON_TIME_S,
    ONE_DELAY_S,
    OUTLIER_SD,
    PART,
    SAME,
    SKIP_STEP,
)

ALIKE_S = 0.5 * FINE_SECONDS
"""Notes are late alike if their delays differ by less than this."""


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredLoad:
    """The mean of what a load cell measured at samples ``first`` to ``last``; ``sd`` (3,) of the mean, N, N, N m."""

    first: int
    last: int
    sd: FloatArray


def without_cell_noise(loads: FloatArray) -> tuple[FloatArray, tuple[MeasuredLoad, ...]]:
    """``loads`` (n, 3) as measured by a load cell, with the mean from one step to the next, and how exact each is.

    A load of 0.05 N more or less at every sample moves the simulated link as no hung weight does. What is not white
    between two steps is motion, and stays.
    """
    changed = np.flatnonzero(np.any(np.diff(loads, axis=0) != 0.0, axis=1)) + 1
    if len(changed) < max(SAME * len(loads), 50):
        return loads, ()
    at = np.concatenate(([0], changed))
    values = loads[at]
    apart = np.diff(values, axis=0)
    noise = 1.4826 * np.median(np.abs(apart), axis=0) / math.sqrt(2.0)
    # A channel that measures nothing has no steps either.
    steps = np.flatnonzero(np.any(np.abs(apart) > OUTLIER_SD * np.maximum(noise, 1e-9), axis=1)) + 1
    edges = np.concatenate(([0], steps, [len(values)]))
    out = loads.copy()
    measured = []
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = values[a:b]
        last = at[b] if b < len(at) else len(loads)
        if b - a < FEWEST_VALUES:
            continue
        centred = part - part.mean(axis=0)
        memory = np.abs((centred[1:] * centred[:-1]).sum(axis=0)) / np.maximum((centred**2).sum(axis=0), 1e-300)
        if np.any(memory[noise > 0.0] > max(PART, 4.0 / math.sqrt(b - a))):
            continue
        lengths = np.diff(np.append(at[a:b], last))
        out[at[a] : last] = (part * lengths[:, None]).sum(axis=0) / lengths.sum()
        sd = np.sqrt((centred**2).mean(axis=0) / (b - a))
        measured.append(MeasuredLoad(int(at[a]), int(last), sd))
    return out, tuple(measured)


@dataclass(frozen=True, slots=True)
class CorrectedNote:
    """One annotated load: ``number`` from 1; ``load`` fx N, fy N, tz N m.

    ``annotated``, ``applied``: s from the first sample.

    ``took``: time that it was applied over, s, 0 for a step. ``rest_only``: the motion is left out.
    """

    number: int
    load: tuple[float, float, float]
    annotated: float
    applied: float
    took: float
    rest_only: bool = False

    @property
    def delay(self) -> float:
        """s; below 0 if it was noted early."""
        return self.annotated - self.applied

    @property
    def name(self) -> str:
        """Of the finding: ``load_time``, or ``load_ramp`` if it was noted in time and applied slowly."""
        return 'load_time' if self._is_delayed else 'load_ramp'

    @property
    def where(self) -> str:
        """``load 3``."""
        return f'load {self.number}'

    @property
    def value(self) -> float:
        """s by which it was noted late, or in which it was applied."""
        return self.delay if self._is_delayed else self.took

    @property
    def size(self) -> float:
        """s by which it was noted late or early."""
        return abs(self.delay)

    @property
    def wrong(self) -> bool:
        """Whether it was noted otherwise than it was hung."""
        return abs(self.delay) > ALIKE_S or self.took > 0.0

    def moved(self, moments: Sequence[float], period: float) -> CorrectedNote:
        """It acted so many moments later and, the second number, took so many longer; what is not given was not fitted.
        A moment is a quarter of a sample, of which one comes every ``period``, s.
        """
        later, slower, *_ = (*moments, 0.0, 0.0)
        moment = 0.25 * period
        return replace(self, applied=self.applied + later * moment, took=max(self.took + slower * moment, 0.0))

    @property
    def _is_delayed(self) -> bool:
        return abs(self.delay) > ALIKE_S and abs(self.delay) > self.took

    def words(self, name: str) -> str:
        """What was wrong, and what to do; ``name``: of the recording."""
        fx, fy, tz = self.load
        how = ' and '.join(self._how())
        until = f', as a ramp until {self.applied + self.took:.3f} s' if self.took > 0.0 else ''
        remark = '; here only the link at rest under it is used' if self.rest_only else ''
        return (
            f'the {ordinal(self.number)} load of {name} ({fx:g} N, {fy:g} N, {tz:g} N m) was noted {how}: note it '
            f'{self.applied:.3f} s after the first sample{until}, not {self.annotated:.3f} s{remark}'
        ).replace('was noted applied', 'was applied')

    def _how(self) -> list[str]:
        out = []
        if self._is_delayed:
            out.append(f'{abs(self.delay):.3f} s {"late" if self.delay > 0.0 else "early"}')
        if self.took > 0.0:
            out.append(f'applied over {self.took:.2g} s')
        return out


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedLoads:
    """``loads`` (n, 3) N, N, N m as they acted; ``notes``: those that were wrong; ``unused`` (n,): samples in motion
    that the corrected loads do not describe; ``measured``: those that were measured; ``timed``: all whose time is
    fitted, also those that were right as annotated: a fitted time is known no better than what else the dots do then.
    """

    loads: FloatArray
    notes: tuple[CorrectedNote, ...]
    unused: BoolArray
    measured: tuple[MeasuredLoad, ...] = ()
    timed: tuple[CorrectedNote, ...] = ()


def ordinal(number: int) -> str:
    """1st, 2nd, 3rd, 4th."""
    ending = 'th' if 10 <= number % 100 <= 20 else {1: 'st', 2: 'nd', 3: 'rd'}.get(number % 10, 'th')
    return f'{number}{ending}'


def correct_loads(rig: Rig, dots: FloatArray, loads: FloatArray) -> CorrectedLoads | None:
    """The loads with the times at which they acted and without the noise of a load cell; None if they are right as
    noted or the motion does not tell.

    ``dots`` (n, 2P) m of any wiring, NaN if a sample is lost; ``loads`` (n, 3) N, N, N m as annotated, held.
    """
    calm, measured = without_cell_noise(loads)
    corrected = _corrected_times(rig, dots, calm)
    if corrected is None:
        return CorrectedLoads(calm, (), np.zeros(len(loads), dtype=bool), measured) if measured else None
    return replace(corrected, measured=measured)


def unannotated_steps(rig: Rig, dots: FloatArray, loads: FloatArray) -> list[float]:
    """When a load began to act that nobody noted, s from the first sample: steps of ``dots`` (n, 2P), m, without a
    change of ``loads`` (n, 3) near them.
    """
    period = 1.0 / rig.converter.sample_rate_hz
    changes = np.flatnonzero(np.any(np.diff(loads, axis=0) != 0.0, axis=1)) + 1
    # A load that was applied slowly changes from sample to sample.
    ends = changes[np.append(np.diff(changes) > 1, True)] if len(changes) else changes
    if np.any(np.diff(ends) * period < APART_S):
        return []
    width = max(2, round(PERIODS / rig.dynamics.bending_frequency / period))
    steps = lasting_steps(dots, width)
    between = calm_between(steps, len(dots), width, period)
    out = []
    for j, step in enumerate(steps):
        nearby = (changes >= step.first - 2 * width) & (changes <= step.last + 2 * width)
        if not nearby.any():
            out.append(time_of_step(rig, dots, step, between[j], period)[0])
    return out


def _corrected_times(rig: Rig, dots: FloatArray, loads: FloatArray) -> CorrectedLoads | None:
    period = 1.0 / rig.converter.sample_rate_hz
    changes = np.flatnonzero(np.any(np.diff(loads, axis=0) != 0.0, axis=1)) + 1
    if len(changes) == 0 or np.any(np.diff(changes) * period < APART_S):
        return None
    width = max(2, round(PERIODS / rig.dynamics.bending_frequency / period))
    steps = lasting_steps(dots, width)
    sizes = expected_movements(rig, loads[changes] - loads[changes - 1])
    matched = matched_notes(changes, sizes, steps, period)
    if not matched:
        return None
    delays = np.array([(changes[i] - steps[j].at) * period for i, j in matched])
    if are_alike(delays, ALIKE_S) and not any(_duration(steps[j], width, period) for _, j in matched):
        return None
    between = calm_between(steps, len(dots), width, period)
    fitted = {i: time_of_step(rig, dots, steps[j], between[j], period) for i, j in matched}
    delays = np.array([changes[i] * period - start for i, (start, _) in fitted.items()])
    # One delay is left to a search, unless it would have to find it from what was lost.
    unseen = abs(float(np.median(delays))) > ALIKE_S and any(steps[j].lost for _, j in matched)
    if not unseen and are_alike(delays, ALIKE_S) and max(took for _, took in fitted.values()) <= BRIEF_S:
        return None
    corrected, timed = loads_with_times(loads, changes, fitted, period)
    residual, rest = residual_of_dots(rig, dots, corrected)
    if AS_GOOD * residual > residual_of_dots(rig, dots, loads)[0]:
        return None
    return replace(without_rough_motion(rig, corrected, [n for n in timed if n.wrong], rest), timed=tuple(timed))


def _duration(step: DotStep, width: int, period: float) -> float:
    """Return for how many samples the dots of a gradual step move, about; 0 of a sudden one."""
    duration = step.last - step.first - 2.0 * width
    return duration if duration > BRIEF_S / period else 0.0


def calm_between(steps: Sequence[DotStep], samples: int, width: int, period: float) -> list[tuple[float, float]]:
    """Return for each step the samples between which no other one moves the dots."""
    half = [0.5 * _duration(step, width, period) for step in steps]
    ends = [0.0, *(step.at + more for step, more in zip(steps, half, strict=True))]
    starts = [*(step.at - more for step, more in zip(steps, half, strict=True)), float(samples)]
    return list(zip(ends, starts[1:], strict=False))


def loads_with_times(
    loads: FloatArray, changes: IntArray, fitted: Mapping[int, tuple[float, float]], period: float
) -> tuple[FloatArray, list[CorrectedNote]]:
    """The loads with change ``i`` from the time ``fitted[i]`` says, in the time that it took; the notes of these."""
    corrected = np.tile(loads[0], (len(loads), 1))
    t: FloatArray = np.arange(len(loads), dtype=np.float64) * period
    notes = []
    for i, at in enumerate(changes.tolist()):
        annotated = at * period
        start, took = fitted.get(i, (annotated, 0.0))
        corrected += applied(t, start, took, period)[:, None] * (loads[at] - loads[at - 1])
        if i in fitted:
            fx, fy, tz = loads[at].tolist()
            notes.append(CorrectedNote(i + 1, (fx, fy, tz), annotated, start, took if took > BRIEF_S else 0.0))
    return corrected, notes


def without_rough_motion(
    rig: Rig, corrected: FloatArray, notes: Sequence[CorrectedNote], rest: FloatArray
) -> CorrectedLoads:
    """Return the corrected loads; the motion under one applied slowly is left out if ``rest`` (n, 2P), m, is
    another.
    """
    t: FloatArray = np.arange(len(corrected), dtype=np.float64) / rig.converter.sample_rate_hz
    unused = np.zeros(len(corrected), dtype=bool)
    notes_used = []
    for note in notes:
        moving = in_motion(rig, note, t)
        notes_used.append(note)
        # A step is the simplest motion: if the link rings otherwise, that is the rig's.
        if note.took > 0.0 and is_rough(rest, moving & (t > note.applied + note.took), rig.estimator.block_size):
            unused |= moving
            notes_used[-1] = CorrectedNote(
                note.number, note.load, note.annotated, note.applied, note.took, rest_only=True
            )
    return CorrectedLoads(corrected, tuple(notes_used), unused)


def shifted(note: CorrectedNote, loads: FloatArray, period: float) -> Callable[[Sequence[float]], FloatArray]:
    """What so many moments more do to ``loads`` (n, 3): of the time at which the load of ``note`` began to act and, the
    second number if it was applied slowly, of how long that took.
    """
    t: FloatArray = np.arange(len(loads), dtype=np.float64) * period
    before, after = np.searchsorted(t, (note.applied - period, note.applied + note.took + 2.0 * period))
    step = loads[min(int(after), len(loads) - 1)] - loads[max(int(before) - 1, 0)]
    now = applied(t, note.applied, note.took, period)

    def more(moments: Sequence[float]) -> FloatArray:
        then = note.moved(moments, period)
        return np.asarray((applied(t, then.applied, then.took, period) - now)[:, None] * step)

    return more


def are_alike(delays: FloatArray, within: float) -> bool:
    """Return whether all delays, s, are ``within`` s of the middle one, and that is one delay of all."""
    middle = float(np.median(delays))
    return abs(middle) <= ONE_DELAY_S and bool(np.all(np.abs(delays - middle) <= within))


def expected_movements(rig: Rig, changes: FloatArray) -> FloatArray:
    """How far (k,) the dots move, m, by changes (k, 3) of the load."""
    poses = changes @ LinkStatics.from_rig(rig).compliance
    return np.asarray(np.linalg.norm(poses @ design_matrix(rig.centers + rig.zeros).T, axis=1))


def matched_notes(changes: IntArray, sizes: FloatArray, steps: list[DotStep], period: float) -> list[tuple[int, int]]:
    """Pairs of an annotated change and a step, both in their order, at least cost; changes that move nothing have
    none.
    """
    if not steps or float(sizes.sum()) <= 0.0:
        return []
    significant = [i for i in range(len(changes)) if sizes[i] > LEAST_SHARE * float(sizes.max())]
    factor = sum(s.size for s in steps) / float(sizes[significant].sum())
    apart = np.abs(np.array([step.at for step in steps]) - changes[significant, None]) * period
    on_time = apart <= ON_TIME_S
    least_share = DISTINCT_SD**2 if 2 * np.count_nonzero(on_time.any(axis=1)) >= len(significant) else 0.0
    cost = np.zeros((len(significant) + 1, len(steps) + 1))
    way = np.zeros(cost.shape, dtype=np.int64)
    cost[:, 0], cost[0] = DISTINCT_SD**2 * np.arange(len(significant) + 1), SKIP_STEP * np.arange(len(steps) + 1)
    way[1:, 0], way[0, 1:] = 1, 2
    for a, i in enumerate(significant, start=1):
        for b, step in enumerate(steps, start=1):
            away = float(apart[a - 1, b - 1])
            unlike = math.log(max(step.size, 1e-12) / (factor * float(sizes[i]))) / 0.5
            pair = LATE_COST * away + min(unlike**2, 8.0)
            pair -= least_share * float(on_time[a - 1, b - 1])
            ways = (cost[a - 1, b - 1] + pair, cost[a - 1, b] + DISTINCT_SD**2, cost[a, b - 1] + SKIP_STEP)
            way[a, b] = int(np.argmin(ways))
            cost[a, b] = ways[way[a, b]]
    out = []
    a, b = len(significant), len(steps)
    while a > 0 or b > 0:
        chosen = way[a, b]
        if chosen == 0:
            out.append((significant[a - 1], b - 1))
        a, b = a - (chosen != 2), b - (chosen != 1)
    return out[::-1]


def residual_of_dots(rig: Rig, dots: FloatArray, loads: FloatArray) -> tuple[float, FloatArray]:
    """What a regression of the dots on the motion under ``loads`` leaves, m^2; block means of it (n, 2P), m."""
    poses = link_motion(rig, loads)
    scale = np.maximum(np.abs(poses).max(axis=0), 1e-30)
    t = np.linspace(-1.0, 1.0, len(dots))
    design = np.column_stack((poses / scale, np.ones_like(t), t))
    there: BoolArray = np.all(np.isfinite(dots), axis=1)
    slopes = np.linalg.lstsq(design[there], dots[there], rcond=1e-9)[0]
    rest = np.where(there[:, None], dots - design @ slopes, 0.0)
    # Means of blocks, so that noise does not hide what the loads leave.
    size = rig.estimator.block_size
    first = np.arange(0, len(dots), size)
    counts = np.add.reduceat(there.astype(np.float64), first)
    blocks = np.add.reduceat(rest, first, axis=0) / np.maximum(counts, 1.0)[:, None]
    blocks[counts == 0.0] = np.nan
    return float((rest**2).sum()), np.repeat(blocks, size, axis=0)[: len(dots)]


def in_motion(rig: Rig, note: CorrectedNote, t: FloatArray) -> BoolArray:
    """Samples (n,) in which the link moves by the load of ``note``."""
    slowest = max(1.0 / (2.0 * math.pi * f * max(ratio, 1e-3)) for f, ratio in link_modes(rig))
    ends = note.applied + note.took - math.log(EXACT) * slowest
    return np.asarray((t >= note.applied - 0.02) & (t < ends))


def is_rough(rest: FloatArray, ringing: BoolArray, size: int) -> bool:
    """Whether the link rings otherwise than the corrected load makes it; ``rest`` (n, 2P): means of blocks of
    ``size``.
    """
    blocks, rings = rest[::size], ringing[::size]
    noise = 0.5 * np.nanmedian((np.diff(blocks, axis=0) ** 2).sum(axis=1))
    valid = blocks[rings & np.all(np.isfinite(blocks), axis=1)]
    if len(valid) < 4:
        return False
    return bool(((valid - valid.mean(axis=0)) ** 2).sum(axis=1).mean() > DISTINCT_SD**2 * noise)
