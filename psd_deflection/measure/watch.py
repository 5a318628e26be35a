# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detects from the records of a run when the rig no longer matches its model (terms: ``docs/glossary.md``).

A reading is one coordinate of a dot, in m: x1, y1, x2 ... A window is half a second of consecutive blocks, each with
an estimate from all PSDs. Three tests compare means over windows, the first and the third only while the tip rests:

* **Readings**: while a known load acts, each reading must keep the level of its first windows under this load.
* **Base line**: the distance between the dots of two PSDs, minus that expected from the rig file, must keep its level.
  This difference depends neither on load nor on pose, so the test needs no known load.
* **Load**: from one known load to the next, the pose must move as the link model predicts.

The first two tests are two-sided CUSUMs (Page, Biometrika 41 (1954) 100) with a dead zone: twice the standard deviation
of a window's mean or the parameter ``watch_wander``, whichever is larger. After a sum has exceeded ``ALARM_SUM``, the
alarm is delayed by ``CONFIRM_S`` (3 s): people annotate a load after they have applied it, and a new load cancels a
waiting alarm. Without a known load, no alarm is delayed. No test uses a clock or a thread, so the same records cause
the same alarms, live and in replay.
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
"""Length of a window, s (at least five blocks)."""
LEVEL_WINDOWS = 4
"""Number of windows from which a level is learned, and after which the noise counts as known."""
HISTORY_WINDOWS = 60
"""Number of recent windows from which the noise is estimated: half a minute."""
MOTION_FACTOR = 3.0
"""A window contains motion if its scatter exceeds the usual scatter by this factor. The scatter is the standard
deviation of the window's blocks; the usual scatter is the lower quartile over recent windows."""
DEAD_ZONE_SIGMAS = 2.0
"""Smallest dead zone of a CUSUM, in standard deviations of a window's mean."""
ALARM_SUM = 10.0
"""CUSUM above which a channel counts as shifted, in standard deviations of a window's mean. Independent normal noise
lifts a channel's two sums to this limit less than once in 10^15 windows."""
MAX_SUM = 3.0 * ALARM_SUM
"""Upper limit of a sum, so that the sum falls below ``ALARM_SUM`` soon after a shift has ended."""
MAX_INCREMENT = 8.0
"""Largest change of a sum by one window. A single outlier cannot lift a sum from 0 to ``ALARM_SUM``."""
MIN_SD = 1e-9
"""Lower limit of a standard deviation, m, for readings without noise."""
CONFIRM_S = 3.0
"""Delay of an alarm, s: a load may be annotated this late."""
LEVEL_GAIN = 1.0 / 120.0
"""Weight of a new window in the level while both sums are 0: the level follows drift with a time constant of 60 s."""
BASE_LINE_FRACTION = 0.002
"""Tolerance of base lines per movement of the tip, for errors of gains and angles, added to ``watch_wander``."""
POSE_TOLERANCES = {'dx': 5e-6, 'dy': 5e-6, 'theta': 40e-6}
"""Permitted error of the link model at zero movement: m, m, rad."""
POSE_FRACTION = 0.02
"""Permitted further error of the link model, as a fraction of the movement from one load to the next."""
TOLERANCE_SIGMAS = 6.0
"""The load test measures no standard deviation; its alarms report the tolerance divided by this number as ``sd``."""
RECOVERY_WINDOWS = 20
"""Number of successive windows without a shifted channel after which an alarm ends: ten seconds."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """A mismatch between rig and model, which began at ``since_ns`` and was certain at ``observed_ns``.

    ``channel``: a reading (``x1``), a base line (``base line of psd_1 and psd_2``) or, from the load test, a coordinate
    of the pose (``dx``, ``dy``, ``theta``). ``shift`` of the channel and its standard deviation ``sd``: m, rad for
    ``theta``. ``also``: names of the channels with smaller shifts.
    """

    since_ns: int
    observed_ns: int
    channel: str
    shift: float
    sd: float
    also: tuple[str, ...] = ()

    @property
    def sigmas(self) -> float:
        """Return the absolute shift in standard deviations."""
        return abs(self.shift) / max(self.sd, 1e-12)

    @property
    def words(self) -> str:
        """Return the alarm as a sentence without the time."""
        unit = 'µrad' if self.channel == 'theta' else 'µm'
        also = f'; {", ".join(self.also)} too' if self.also else ''
        return (
            f'{self.channel} is {1e6 * self.shift:+.2f} {unit} off ({self.sigmas:.0f} standard deviations){also}: '
            'the rig no longer matches its model, or a load acts that was not noted'
        )


def alarm_sentences(alarms: Sequence[Alarm], start_ns: int, watched: str) -> list[str]:
    """Return a sentence per alarm, timed in s from ``start_ns``; without alarms, one that names what is ``watched``."""
    lines = [f'since {(alarm.since_ns - start_ns) / 1e9:.1f} s: {alarm.words}' for alarm in alarms]
    return lines or [f'the rig matches its model; watched: {watched}']


class _PoseWindow(NamedTuple):
    """Start and end of a window, and its means of ``pose`` and ``deviation``, each (3,): dx m, dy m, theta rad.

    ``deviation``: estimated pose minus the pose that the link model predicts for the annotated load; None if unknown.
    """

    start_ns: int
    end_ns: int
    pose: list[float]
    deviation: list[float] | None


class _Channel:
    """A monitored scalar, m: its windows of ``blocks`` blocks, its level and its two CUSUMs.

    ``mean``: mean of the last complete window, m. ``still``: whether that window was free of motion. ``level``: m, None
    until known. ``shifted``: whether a CUSUM exceeds ``ALARM_SUM``, and ``since_ns``: when that CUSUM became positive.
    """

    def __init__(self, name: str, blocks: int) -> None:
        self.name = name
        self.mean = self._first_value = self._usual_scatter = self._mean_sd = 0.0
        self.still = False
        self._blocks = blocks
        self._scatters: deque[float] = deque(maxlen=HISTORY_WINDOWS)
        self._mean_steps: deque[float] = deque(maxlen=HISTORY_WINDOWS)
        self.forget_level()
        self.discard_window()

    def forget_level(self) -> None:
        """Reset the level and the CUSUMs; the estimates of the noise stay."""
        self._level_means: list[float] = []  # Bound: LEVEL_WINDOWS.
        self.level: float | None = None
        self._last_mean: float | None = None
        # CUSUMs of upward and downward shifts; for each, the start of the window in which it became positive.
        self._sums, self._sums_since_ns = [0.0, 0.0], [0, 0]
        self.shifted, self.since_ns = False, 0
        self._means_since_onset: deque[float] = deque(maxlen=LEVEL_WINDOWS)

    def discard_window(self) -> None:
        """Forget the blocks of the current window."""
        self._sum = self._squares = 0.0
        self._count = 0

    def add(self, value: float) -> None:
        """Add the value of a block, m, to the current window."""
        if not self._count:
            self._first_value = value
        value -= self._first_value  # Small values keep the sum of squares accurate.
        self._sum += value
        self._squares += value * value
        self._count += 1

    def finish_window(self) -> None:
        """Set ``mean`` and ``still`` from the current window."""
        mean = self._sum / self._count
        scatter = math.sqrt(max(self._squares / self._count - mean * mean, 0.0))
        self._scatters.append(scatter)
        # The lower quartile is the scatter of the noise, even if most windows contain motion.
        self._usual_scatter = sorted(self._scatters)[len(self._scatters) // 4]
        small = scatter <= MOTION_FACTOR * max(self._usual_scatter, MIN_SD)
        self.still = small and len(self._scatters) >= LEVEL_WINDOWS
        self.mean = self._first_value + mean

    def update(self, start_ns: int, tolerance: float) -> bool:
        """Use ``mean`` for the level or, if the level is known, for the CUSUMs. Return whether the level became known.

        ``start_ns``: start of the window. ``tolerance``: smallest dead zone, m.
        """
        if self.level is None:
            self._level_means.append(self.mean)
            if len(self._level_means) < LEVEL_WINDOWS:
                return False
            self.level = statistics.median(self._level_means)
            return True
        if self._last_mean is not None:
            self._mean_steps.append(abs(self.mean - self._last_mean))
        self._last_mean = self.mean
        self._mean_sd = sd = self._sd_of_mean()
        dead_zone = max(DEAD_ZONE_SIGMAS * sd, tolerance) / sd  # In standard deviations, as z.
        z = (self.mean - self.level) / sd
        for i, excess in enumerate((z - dead_zone, -z - dead_zone)):
            increment = min(max(excess, -MAX_INCREMENT), MAX_INCREMENT)
            new_sum = max(0.0, self._sums[i] + increment)
            if new_sum > 0.0 and self._sums[i] == 0.0:
                self._sums_since_ns[i] = start_ns
            self._sums[i] = min(new_sum, MAX_SUM)
        larger = max(self._sums)
        self.shifted, self.since_ns = larger > ALARM_SUM, self._sums_since_ns[self._sums.index(larger)]
        if larger > 0.0:
            self._means_since_onset.append(self.mean)
        else:
            self._means_since_onset.clear()
            self.level += LEVEL_GAIN * (self.mean - self.level)
        return False

    def _sd_of_mean(self) -> float:
        """Return the standard deviation of a window's mean, m: the larger of two estimates, by scatter and by steps."""
        from_scatter = self._usual_scatter / math.sqrt(self._blocks)
        from_steps = 0.0
        if len(self._mean_steps) >= LEVEL_WINDOWS:
            # Normal noise: 1.4826 times the median is the deviation of a step, which is sqrt(2) times that of a mean.
            from_steps = 1.4826 * statistics.median(self._mean_steps) / math.sqrt(2.0)
        return max(from_scatter, from_steps, MIN_SD)

    def shift(self) -> tuple[float, float]:
        """Return the shift of the last means from the level, and the standard deviation of the shift, m."""
        n = len(self._means_since_onset)
        if not n or self.level is None:
            return 0.0, self._mean_sd
        shift = statistics.median(self._means_since_onset) - self.level
        return shift, self._mean_sd * math.sqrt(1.0 / n + 1.0 / LEVEL_WINDOWS)


class Watch:
    """Runs the three tests on the records of a run.

    ``compliance``: deflection of the tip per load, m/N, m/N, rad/(N m). ``load``: the known load or None. ``alarm``:
    the present alarm or None. ``alarms``, ``windows``: numbers of alarms and of windows so far. ``spoilt``: number of
    windows with motion in a reading, plus the first three windows, in which the usual scatter is not yet known.
    """

    def __init__(self, rig: Rig, compliance: Sequence[float]) -> None:
        self.load: AppliedLoad | None = None
        self.alarms = self.windows = self.spoilt = 0
        self._compliance = tuple(compliance)
        self._drift_tolerance = rig.acquisition.watch_wander
        self._blocks = max(5, round(WINDOW_S * rig.converter.sample_rate_hz / rig.estimator.block_size))
        self._window_ns = round(1e9 * self._blocks * rig.estimator.block_size / rig.converter.sample_rate_hz)
        # All readings learn their levels in the same windows: if the first has a level, all have one.
        self._readings = [_Channel(name, self._blocks) for name in dot_names(len(rig.psds))]
        self._pairs = list(itertools.combinations(range(len(rig.psds)), 2))  # Indices of the PSDs of each base line.
        base_line_names = [f'base line of psd_{a + 1} and psd_{b + 1}' for a, b in self._pairs]
        self._base_lines = [_Channel(name, self._blocks) for name in base_line_names]
        self._channels = (*self._readings, *self._base_lines)
        self._last_index: int | None = None
        self._estimate: DeflectionEstimate | None = None
        self._tip_load: TipLoad | None = None
        self._pose_sum: list[float] = []
        self._deviation_sum: list[float] = []
        self._restart(rig)

    def _restart(self, rig: Rig) -> None:
        """Forget the alarm and all levels, and take the detector centres and zeros from ``rig``."""
        self._centers, beams = rig.centers.tolist(), (rig.centers + rig.zeros).tolist()
        self._beam_distances = [
            math.sqrt((x1 - x2) ** 2 + (y1 - y2) ** 2) for (x1, y1), (x2, y2) in itertools.combinations(beams, 2)
        ]
        self._reach = max(math.hypot(x, y) for x, y in self._centers)  # Movement of the outermost PSD per twist, m/rad.
        for channel in self._channels:
            channel.forget_level()
        self._discard_window()
        self.alarm: Alarm | None = None
        self._alarm_until_restart = False
        # During an alarm: number of successive windows without a shifted channel.
        self._good_windows = 0
        self._pending_ns: int | None = None  # Before an alarm: time since which a channel is shifted.
        self._base_line_pose: list[float] | None = None  # Pose at which the levels of the base lines became known.
        self._earlier: tuple[list[float], list[float]] | None = None  # Pose and deviation under an earlier load.
        # Windows without motion under the known load: those of the last CONFIRM_S, and LEVEL_WINDOWS before them.
        self._recent: deque[_PoseWindow] = deque(maxlen=LEVEL_WINDOWS + round(CONFIRM_S / WINDOW_S))

    def put(self, record: Record) -> None:
        """Process the next record, in the order of the pipeline; types other than the four below are ignored."""
        if isinstance(record, DeflectionEstimate):
            if record.primary:
                self._estimate = record
        elif isinstance(record, TipLoad):
            self._tip_load = record
        elif isinstance(record, SpotMeans):
            self._add_block(record)
        elif isinstance(record, AppliedLoad):
            self.note(record)

    def note(self, load: AppliedLoad) -> None:
        """Take ``load`` as the known load; if it differs from the previous load, forget the levels of the readings."""
        previous, self.load = self.load, load
        if previous is not None and previous[1:] == load[1:]:
            return
        # The earliest time at which the new load may have been applied.
        earliest_ns = load.t_ns - round(1e9 * CONFIRM_S)
        windows_before = [window for window in self._recent if window.end_ns <= earliest_ns]
        if self._readings[0].level is not None and windows_before:
            self._earlier = _median_pose(windows_before[-LEVEL_WINDOWS:])
        self._recent.clear()
        for channel in self._readings:
            channel.forget_level()
        # The new load explains a pending shift. A present alarm must not end by recovery: new levels include the shift.
        self._pending_ns = None
        self._alarm_until_restart = self.alarm is not None

    def changed(self, change: ParameterChange, rig: Rig) -> None:
        """Restart with ``rig``, the rig after ``change``, if a zero or an effect changed."""
        if any(name in ZEROS or name.startswith(EFFECTS_PREFIX) for name, _ in change.values):
            self._restart(rig)

    @property
    def state(self) -> str:
        """Return in words which tests are active."""
        if not self.windows:
            return 'no window yet'
        if self.load is None:
            return 'base line only: no load is known'
        if self._readings[0].level is None:
            return 'learns the readings under this load'
        return 'readings, base line and load'

    def _add_block(self, spots: SpotMeans) -> None:
        """Add a block to the current window; a block that is missing, bad or not estimated discards the window."""
        estimate, tip_load = self._estimate, self._tip_load
        all_psds_good = spots.status is BlockStatus.OK and not spots.excluded
        if not all_psds_good or estimate is None or estimate.block != spots.index:
            self._discard_window()
            return
        if self._last_index not in (None, spots.index - 1):
            self._discard_window()
        self._last_index = spots.index
        self._add_dots(spots.dots)
        self._pose_sum = [total + value for total, value in zip(self._pose_sum, estimate.pose, strict=True)]
        if self.load is not None and tip_load is not None and tip_load.t_ns == estimate.t_ns:
            # tip_load: the load computed from the estimated pose by the inverse link model.
            rows = zip(self._deviation_sum, self._compliance, tip_load[1:], self.load[1:], strict=True)
            self._deviation_sum = [total + per_load * (computed - known) for total, per_load, computed, known in rows]
            self._tip_loads += 1
        self._count += 1
        if self._count == self._blocks:
            self._finish_window(spots.t_ns)

    def _add_dots(self, dots: tuple[float, ...]) -> None:
        """Add the dots (2P,) of a block, m, to the channels of the P PSDs."""
        for reading, value in zip(self._readings, dots, strict=True):
            reading.add(value)
        centers = self._centers
        for base_line, (a, b), beam_distance in zip(self._base_lines, self._pairs, self._beam_distances, strict=True):
            x = centers[a][0] + dots[2 * a] - centers[b][0] - dots[2 * b]
            y = centers[a][1] + dots[2 * a + 1] - centers[b][1] - dots[2 * b + 1]
            base_line.add(math.sqrt(x * x + y * y) - beam_distance)

    def _discard_window(self) -> None:
        for channel in self._channels:
            channel.discard_window()
        self._count = 0
        self._pose_sum, self._deviation_sum = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
        self._tip_loads = 0

    def _finish_window(self, end_ns: int) -> None:
        """Test the current window, whose last block has the time ``end_ns``, and start a new window."""
        pose = [total / self._blocks for total in self._pose_sum]
        # Only every ``decimation``-th block has a tip load: the mean is over those.
        deviation = [total / self._tip_loads for total in self._deviation_sum] if self._tip_loads else None
        window = _PoseWindow(end_ns - self._window_ns, end_ns, pose, deviation)
        for channel in self._channels:
            channel.finish_window()
        self._discard_window()
        readings_still = all(reading.still for reading in self._readings)
        self.windows += 1
        self.spoilt += not readings_still
        if all(base_line.still for base_line in self._base_lines):
            self._test_base_lines(window)
        if readings_still and self.load is not None and self.load.t_ns <= window.start_ns:
            self._test_readings(window)
        self._update_alarm(end_ns)

    def _test_base_lines(self, window: _PoseWindow) -> None:
        """Update the base lines, with a tolerance that grows with the movement since their levels became known."""
        pose, learned_pose = window.pose, self._base_line_pose
        moved = 0.0
        if learned_pose is not None:
            moved = math.dist(pose[:2], learned_pose[:2]) + self._reach * abs(pose[2] - learned_pose[2])
        tolerance = self._drift_tolerance + BASE_LINE_FRACTION * moved
        for base_line in self._base_lines:
            if base_line.update(window.start_ns, tolerance):
                self._base_line_pose = pose

    def _test_readings(self, window: _PoseWindow) -> None:
        """Update the readings; in the window that completes their levels, test the load."""
        learned = [reading.update(window.start_ns, self._drift_tolerance) for reading in self._readings]
        if window.deviation is not None:
            self._recent.append(window)
        if all(learned):
            self._test_load(window.end_ns)

    def _test_load(self, end_ns: int) -> None:
        """Raise an alarm if the movement since the earlier load differs from the prediction of the link model."""
        if self._earlier is None or self.load is None or self.alarm is not None or not self._recent:
            return
        (pose, deviation), (old_pose, old_deviation) = _median_pose(self._recent), self._earlier
        moved, rotated = math.dist(pose[:2], old_pose[:2]), abs(pose[2] - old_pose[2])
        worst: Alarm | None = None
        worst_ratio = 1.0
        rows = zip(POSE_TOLERANCES.items(), (moved, moved, rotated), deviation, old_deviation, strict=True)
        for (axis, constant), movement, new, old in rows:
            shift, tolerance = new - old, constant + POSE_FRACTION * movement
            if abs(shift) > tolerance * worst_ratio:
                worst_ratio = abs(shift) / tolerance
                worst = Alarm(self.load.t_ns, end_ns, axis, shift, tolerance / TOLERANCE_SIGMAS)
        if worst is not None:
            self._raise(worst)
            self._alarm_until_restart = True

    def _update_alarm(self, end_ns: int) -> None:
        """Raise an alarm for shifted channels, or end the present alarm if its channels have recovered."""
        shifted = [channel for channel in self._channels if channel.shifted]
        if self.alarm is not None:
            self._good_windows = 0 if shifted else self._good_windows + 1
            if self._good_windows >= RECOVERY_WINDOWS and not self._alarm_until_restart:
                self.alarm = None
        elif not shifted:
            self._pending_ns = None
        else:
            self._pending_ns = end_ns if self._pending_ns is None else self._pending_ns
            if end_ns - self._pending_ns >= 1e9 * CONFIRM_S or self.load is None:
                largest = max(shifted, key=lambda channel: abs(channel.shift()[0]))
                also = tuple(channel.name for channel in shifted if channel is not largest)
                since_ns = min(channel.since_ns for channel in shifted)
                self._raise(Alarm(since_ns, end_ns, largest.name, *largest.shift(), also))

    def _raise(self, alarm: Alarm) -> None:
        self.alarm = alarm
        self.alarms += 1
        self._good_windows, self._pending_ns = 0, None


def _median_pose(windows: Collection[_PoseWindow]) -> tuple[list[float], list[float]]:
    """Return the medians of pose and deviation, each (3,), over windows with a deviation."""
    pose = [statistics.median(values) for values in zip(*(w.pose for w in windows), strict=True)]
    return pose, [
        statistics.median(values) for values in zip(*(w.deviation for w in windows if w.deviation), strict=True)
    ]
