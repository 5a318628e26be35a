# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Watches the records of a run for the moment from which the rig is no longer what its model says.

Three tests, each on means over windows of half a second that are not spoilt by motion:

* **readings**, if the load is known: while it is held, the readings must not shift. Each of x1 y1 x2 y2 ... has a
  two-sided CUSUM (Page, Biometrika 41 (1954) 100) against the level that it had under this load.
* **base line**: the distance of the dots of two PSDs is that of their beams under every load and in motion. Its CUSUM
  needs no load.
* **load**, if it is known: from one load to the next the pose must move as the link model says, within ``SHARE``.

A CUSUM counts what exceeds ``allowed``: two standard deviations of a window's mean, and at least the rig's
``watch_wander``. The level follows slow drift. The alarm comes ``CONFIRM_S`` later, unless a load is noted meanwhile:
people note a load after they have put it on. The object owns no clock and no thread; the same records give the same
alarms, live and in replay.
"""

import itertools
import math
import statistics
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from psd_deflection.records import (
    AppliedLoad,
    BlockStatus,
    DeflectionEstimate,
    ParameterChange,
    Record,
    SpotMeans,
    TipLoad,
    dot_names,
)
from psd_deflection.rig.config import Rig
from psd_deflection.rig.declarations import ZEROS
from psd_deflection.rig.parameter_files import EFFECTS_PREFIX

WINDOW_S = 0.5
LEARN = 4
"""Windows from which a level is learned."""
REMEMBER = 60
"""Windows whose scatter tells what is usual."""
MOVING = 3.0
"""A window that scatters by more than this factor of the usual is spoilt by motion."""
SIGMAS = 2.0
"""Standard deviations of a window's mean that are never counted."""
ALARM = 10.0
"""Sum of what was counted, in standard deviations, from which it is an alarm. For normal windows two sums of this limit
give one in more than 10^15 windows; no window counts more than ``MOST``."""
MOST = 8.0
CONFIRM_S = 3.0
FORGET = 1.0 / 120.0
"""Share of a window in the level: it follows drift in a minute."""
RELATIVE = 0.002
"""Share of the movement by which the base line may be wrong in a sound rig: discover believes its simulation as far."""
SHARE = 0.02
"""Share of the movement by which the pose under a known load may be off the link model."""
OFF, OFF_TWIST = 5e-6, 40e-6
"""What it may be off besides, m and rad."""
BACK = 20
"""Windows at the old level after which an alarm ends."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """``since_ns``: when it began; ``observed_ns``: when it was sure. ``channel``: of the readings, the base line of
    two PSDs, or an axis of the pose. ``shift`` and ``sd``, m or rad. ``sigmas``: how many standard deviations it is.
    ``also``: other channels that shifted.
    """

    since_ns: int
    observed_ns: int
    channel: str
    shift: float
    sd: float
    also: tuple[str, ...] = ()

    @property
    def sigmas(self) -> float:
        """The shift in standard deviations."""
        return abs(self.shift) / max(self.sd, 1e-12)

    @property
    def words(self) -> str:
        """What is seen, without the time."""
        unit = 'µrad' if self.channel == 'theta' else 'µm'
        also = f'; {", ".join(self.also)} too' if self.also else ''
        return (
            f'{self.channel} is {1e6 * self.shift:+.2f} {unit} off ({self.sigmas:.0f} standard deviations){also}: '
            'the rig is no longer its model, or a load acts that was not noted'
        )


def alarm_sentences(alarms: Sequence[Alarm], start_ns: int, watched: str) -> list[str]:
    """Each alarm with its time from ``start_ns``; or that there was none, and what was ``watched``."""
    lines = [f'since {(alarm.since_ns - start_ns) / 1e9:.1f} s: {alarm.words}' for alarm in alarms]
    return lines or [f'the rig is its model; watched: {watched}']


class _Window(NamedTuple):
    mean: float
    scatter: float


class _Channel:
    """One number a block: its windows, its level, and its two sums."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._sum = self._squares = self._first = 0.0
        self._count = 0
        self._scatters: deque[float] = deque(maxlen=REMEMBER)
        self._steps: deque[float] = deque(maxlen=REMEMBER)
        self._last: float | None = None
        self._sigma = 0.0
        self.forget()

    def forget(self) -> None:
        """Learn the level anew."""
        self._learned: list[float] = []  # Bound: LEARN.
        self.level: float | None = None
        self._up = self._down = 0.0
        self._up_ns = self._down_ns = 0
        self._since: list[float] = []  # Bound: REMEMBER.
        self._last = None

    def add(self, value: float) -> None:
        """The value of a block."""
        if not self._count:
            self._first = value
        value -= self._first
        self._sum += value
        self._squares += value * value
        self._count += 1

    def drop(self) -> None:
        """Begin the window again."""
        self._sum = self._squares = 0.0
        self._count = 0

    def close(self) -> _Window:
        """The window's mean and scatter; the next begins."""
        n = self._count
        mean = self._sum / n
        scatter = math.sqrt(max(self._squares / n - mean * mean, 0.0))
        out = _Window(self._first + mean, scatter)
        self.drop()
        return out

    def still(self, window: _Window) -> bool:
        """Whether the window is not spoilt by motion."""
        self._scatters.append(window.scatter)
        usual = sorted(self._scatters)[len(self._scatters) // 4]
        return len(self._scatters) >= LEARN and window.scatter <= MOVING * max(usual, 1e-9)

    def sigma(self, blocks: int) -> float:
        """Standard deviation of a window's mean, m: from the scatter, or from window to window if that is more."""
        usual = sorted(self._scatters)[len(self._scatters) // 4] / math.sqrt(blocks)
        steps = 1.4826 * statistics.median(self._steps) / math.sqrt(2.0) if len(self._steps) >= LEARN else 0.0
        return max(usual, steps, 1e-9)

    def learn(self, mean: float) -> bool:
        """Take a window into the level; whether the level is known now."""
        self._learned.append(mean)
        if len(self._learned) < LEARN:
            return False
        self.level = statistics.median(self._learned)
        return True

    def count(self, mean: float, began_ns: int, blocks: int, least: float) -> float:
        """A window's mean: the greater of the two sums. ``least``: shift that is not counted whatever the noise, m."""
        if self._last is not None:
            self._steps.append(abs(mean - self._last))
        self._last = mean
        self._sigma = sigma = self.sigma(blocks)
        level = self.level
        if level is None:
            return 0.0
        allowed = max(SIGMAS * sigma, least)
        z = (mean - level) / sigma
        k = allowed / sigma
        up = max(0.0, self._up + min(max(z - k, -MOST), MOST))
        down = max(0.0, self._down + min(max(-z - k, -MOST), MOST))
        if up > 0.0 and self._up == 0.0:
            self._up_ns = began_ns
        if down > 0.0 and self._down == 0.0:
            self._down_ns = began_ns
        if up > 0.0 or down > 0.0:
            self._since.append(mean)
            del self._since[:-REMEMBER]
        else:
            self._since.clear()
            self.level = level + FORGET * (mean - level)
        self._up, self._down = min(up, 3.0 * ALARM), min(down, 3.0 * ALARM)
        return max(self._up, self._down)

    @property
    def beyond(self) -> bool:
        """Whether a sum is beyond the alarm."""
        return max(self._up, self._down) > ALARM

    @property
    def since_ns(self) -> int:
        """When the shift began."""
        return self._up_ns if self._up >= self._down else self._down_ns

    def shift(self) -> tuple[float, float]:
        """The shift and its standard deviation, m."""
        if not self._since or self.level is None:
            return 0.0, self._sigma
        middle = statistics.median(self._since[-LEARN:])
        return middle - self.level, self._sigma * math.sqrt(1.0 / min(len(self._since), LEARN) + 1.0 / LEARN)


class Watch:
    """Takes the records of a run in order. ``compliance``: deflection for 1 N, 1 N, 1 N m at the tip: m/N, m/N,
    rad/(N m). ``alarm``: what is wrong now, or None. ``alarms``: how many there were.
    """

    def __init__(self, rig: Rig, compliance: Sequence[float]) -> None:
        self._compliance = tuple(compliance)
        self._allowed_drift = rig.acquisition.watch_wander
        self._blocks = max(5, round(WINDOW_S * rig.converter.sample_rate_hz / rig.estimator.block_size))
        self._window_ns = round(1e9 * self._blocks * rig.estimator.block_size / rig.converter.sample_rate_hz)
        count = len(rig.psds)
        self._pairs = list(itertools.combinations(range(count), 2))
        self._readings = [_Channel(name) for name in dot_names(count)]
        self._lines = [_Channel(f'base line of psd_{a + 1} and psd_{b + 1}') for a, b in self._pairs]
        self.load: AppliedLoad | None = None
        self.alarm: Alarm | None = None
        self.alarms = 0
        self.windows = 0
        self.spoilt = 0
        self._last_index: int | None = None
        self._estimate: DeflectionEstimate | None = None
        self._reported: TipLoad | None = None
        self.forget(rig)

    def forget(self, rig: Rig) -> None:
        """Begin anew with ``rig``: its zero or its parameters have changed."""
        self._centers, self._beams = rig.centers.tolist(), (rig.centers + rig.zeros).tolist()
        self._reach = max(math.hypot(x, y) for x, y in self._centers)
        for channel in (*self._readings, *self._lines):
            channel.forget()
            channel.drop()
        self.alarm = None
        self._lasting = False
        self._pending_ns: int | None = None
        self._count = 0
        self._off = [0.0, 0.0, 0.0]
        self._pose = [0.0, 0.0, 0.0]
        self._reference: tuple[list[float], list[float]] | None = None
        self._recent: deque[tuple[int, list[float], list[float]]] = deque(maxlen=LEARN + round(CONFIRM_S / WINDOW_S))
        self._known = False
        self._line_pose: list[float] | None = None
        self._quiet = 0

    def put(self, record: Record) -> None:
        """One record; what it does not need it passes over."""
        if isinstance(record, DeflectionEstimate):
            if record.primary:
                self._estimate = record
        elif isinstance(record, TipLoad):
            self._reported = record
        elif isinstance(record, SpotMeans):
            self._block(record)
        elif isinstance(record, AppliedLoad):
            self.note(record)

    def note(self, load: AppliedLoad) -> None:
        """A known load that acts from now on."""
        before, self.load = self.load, load
        if before is not None and before[1:] == load[1:]:
            return
        for channel in self._readings:
            channel.forget()
        # The last moments in which the load was surely not on yet, so that slow drift does not add up.
        before_ns = load.t_ns - round(1e9 * CONFIRM_S)
        last = [r for r in self._recent if r[0] <= before_ns][-LEARN:]
        if self._known and last:
            self._reference = _level(last)
        self._recent.clear()
        self._known = False
        # What was not sure yet was this load. What was sure can no longer be seen to end.
        self._pending_ns = None
        self._lasting = self.alarm is not None

    def changed(self, change: ParameterChange, rig: Rig) -> None:
        """Parameters have changed to those of ``rig``; only those that move the readings or the pose matter."""
        if any(name in ZEROS or name.startswith(EFFECTS_PREFIX) for name, _ in change.values):
            self.forget(rig)

    @property
    def state(self) -> str:
        """What is watched, in words."""
        if not self.windows:
            return 'no window yet'
        if self.load is None:
            return 'base line only: no load is known'
        if self._readings[0].level is None:
            return 'learns the readings under this load'
        return 'readings, base line and load'

    def _block(self, spots: SpotMeans) -> None:
        estimate, reported = self._estimate, self._reported
        sound = spots.status is BlockStatus.OK and not spots.excluded
        if not sound or estimate is None or estimate.block != spots.index:
            self._drop()
            return
        if self._last_index not in (None, spots.index - 1):
            self._drop()
        self._last_index = spots.index
        self._add_readings(spots.dots)
        if self.load is not None and reported is not None and reported.t_ns == estimate.t_ns:
            loads = zip(self._compliance, reported[1:], self.load[1:], strict=True)
            self._off = [off + c * (a - b) for off, (c, a, b) in zip(self._off, loads, strict=True)]
        self._pose = [total + value for total, value in zip(self._pose, estimate.pose, strict=True)]
        self._count += 1
        if self._count == self._blocks:
            self._close(spots.t_ns)

    def _add_readings(self, d: tuple[float, ...]) -> None:
        """Add the dots (2P,), m, of a block, and the excess length of each base line."""
        c = self._centers
        for channel, value in zip(self._readings, d, strict=True):
            channel.add(value)
        for channel, (a, b) in zip(self._lines, self._pairs, strict=True):
            x = c[a][0] + d[2 * a] - c[b][0] - d[2 * b]
            y = c[a][1] + d[2 * a + 1] - c[b][1] - d[2 * b + 1]
            (ax, ay), (bx, by) = self._beams[a], self._beams[b]
            channel.add(math.sqrt(x * x + y * y) - math.sqrt((ax - bx) ** 2 + (ay - by) ** 2))

    def _drop(self) -> None:
        for channel in (*self._readings, *self._lines):
            channel.drop()
        self._count = 0
        self._off, self._pose = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]

    def _close(self, t_ns: int) -> None:
        """A window is complete; ``t_ns``: of its last block."""
        n = self._count
        pose = [v / n for v in self._pose]
        off = [v / n for v in self._off]
        self._count, self._off, self._pose = 0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        began_ns = t_ns - self._window_ns
        self.windows += 1
        lines = [channel.close() for channel in self._lines]
        readings = [channel.close() for channel in self._readings]
        # Each is asked, so that each remembers its own scatter.
        still = all([channel.still(w) for channel, w in zip(self._readings, readings, strict=True)])
        steady = all([channel.still(w) for channel, w in zip(self._lines, lines, strict=True)])
        held = self.load is None or self.load.t_ns <= began_ns
        self.spoilt += not still
        if steady:
            self._base_lines(lines, pose, began_ns, n)
        if still and held and self.load is not None:
            self._held_readings(readings, pose, off, began_ns, n)
        self._evaluate(t_ns)

    def _base_lines(self, windows: Sequence[_Window], pose: list[float], began_ns: int, blocks: int) -> None:
        for channel, window in zip(self._lines, windows, strict=True):
            if channel.level is None:
                if channel.learn(window.mean):
                    self._line_pose = pose
                continue
            moved = 0.0
            if self._line_pose is not None:
                moved = math.dist(pose[:2], self._line_pose[:2]) + self._reach * abs(pose[2] - self._line_pose[2])
            channel.count(window.mean, began_ns, blocks, self._allowed_drift + RELATIVE * moved)

    def _held_readings(
        self, windows: Sequence[_Window], pose: list[float], off: list[float], began_ns: int, blocks: int
    ) -> None:
        learned = False
        for channel, window in zip(self._readings, windows, strict=True):
            if channel.level is None:
                learned = channel.learn(window.mean)
            else:
                channel.count(window.mean, began_ns, blocks, self._allowed_drift)
        self._recent.append((began_ns + self._window_ns, pose, off))
        if learned:
            self._known = True
            self._new_load(began_ns)

    def _new_load(self, began_ns: int) -> None:
        """The level under a load is known: has the pose moved from the load before as the link model says?"""
        if self._reference is None:
            return
        (pose, off), (pose0, off0) = _level(self._recent), self._reference
        moved = math.dist(pose[:2], pose0[:2])
        worst: tuple[float, str, float, float] = (1.0, '', 0.0, 0.0)
        for i, name in enumerate(('dx', 'dy', 'theta')):
            shift = off[i] - off0[i]
            allowed = OFF + SHARE * moved if i < 2 else OFF_TWIST + SHARE * abs(pose[2] - pose0[2])
            if abs(shift) > allowed * worst[0]:
                worst = (abs(shift) / allowed, name, shift, allowed / 6.0)
        if worst[1] and self.alarm is None and self.load is not None:
            self._raise(Alarm(self.load.t_ns, began_ns + self._window_ns, worst[1], worst[2], worst[3]))
            self._lasting = True

    def _evaluate(self, t_ns: int) -> None:
        beyond = [c for c in (*self._readings, *self._lines) if c.beyond]
        if self.alarm is not None:
            # It lasts until the readings are back for a while under the same load, or until the zero is taken.
            self._quiet = 0 if beyond else self._quiet + 1
            if self._quiet >= BACK and not self._lasting:
                self.alarm = None
        elif not beyond:
            self._pending_ns = None
        else:
            self._pending_ns = t_ns if self._pending_ns is None else self._pending_ns
            if t_ns - self._pending_ns >= 1e9 * CONFIRM_S or self.load is None:
                self._confirm(t_ns, beyond)

    def _confirm(self, t_ns: int, beyond: list[_Channel]) -> None:
        """Raise the alarm of the channel that is shifted most."""
        shifts = {c.name: c.shift() for c in beyond}
        first = max(beyond, key=lambda c: abs(shifts[c.name][0]))
        also = tuple(c.name for c in beyond if c is not first)
        self._raise(Alarm(min(c.since_ns for c in beyond), t_ns, first.name, *shifts[first.name], also))

    def _raise(self, alarm: Alarm) -> None:
        self.alarm = alarm
        self.alarms += 1
        self._quiet = 0
        self._pending_ns = None


def _level(windows: Collection[tuple[int, list[float], list[float]]]) -> tuple[list[float], list[float]]:
    """Pose (3,) and how far it is off the link model (3,) in some windows: medians."""
    _, poses, offs = zip(*windows, strict=True)
    pose = [statistics.median(c) for c in zip(*poses, strict=True)]
    return pose, [statistics.median(c) for c in zip(*offs, strict=True)]
