# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The watch: what it sees, what it passes over, and the short form of its campaign."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from psd_deflection import records
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.watch import Watch
from psd_deflection.model.solvers.registry import solver_from_rig
from psd_deflection.rig.config import Rig, load_rig

RIG = load_rig()
THREE = load_rig(overrides={'psd_3.center': [0.08, -0.05]})
COMPLIANCE = Pipeline(RIG).tip_loads.compliance
NOISE = 0.3e-6
REST = RIG.zeros.ravel()
SECOND = 50
"""Blocks."""


class Fed:
    """A watch of ``rig`` that is fed block means with this noise, m."""

    def __init__(self, rig: Rig = RIG, noise: float = NOISE, decimation: int = 1) -> None:
        self._decimation = decimation
        self.watch = Watch(rig, COMPLIANCE)
        self.block = 0
        self._noise = noise
        self._solver = solver_from_rig('exact', rig)
        self._readings = 2 * len(rig.psds)
        self._rng = np.random.default_rng(1)

    def load(self, fx: float, fy: float, tz: float = 0.0) -> None:
        self.watch.put(records.AppliedLoad(self.block * 20_000_000, fx, fy, tz))

    def run(
        self,
        seconds: float,
        of: Callable[[records.FloatArray], records.FloatArray] | records.FloatArray,
        status: records.BlockStatus = records.BlockStatus.OK,
    ) -> records.FloatArray:
        """Blocks with the readings ``of`` (4,) m, or a function of the time in this run (n,) that gives (n, 4).

        Their readings with the noise (n, 4), m.
        """
        t, many = np.arange(round(seconds * SECOND)) / SECOND, self._readings
        dots = of(t) if callable(of) else np.tile(of, (len(t), 1))
        dots = dots + self._noise * self._rng.standard_normal((len(t), many))
        poses = self._solver.solve_many(dots, np.full(many, NOISE**2)).pose
        for four, pose in zip(dots.tolist(), poses[:, :3].tolist(), strict=True):
            t_ns = self.block * 20_000_000
            loads = (p / c for p, c in zip(pose, COMPLIANCE, strict=True))
            dx, dy, theta = pose
            for record in (
                records.DeflectionEstimate(t_ns, self.block, 'exact', dx, dy, theta, 0.0, 0.0, (0.0,) * 9, 0.0, True),
                records.TipLoad(t_ns if self.block % self._decimation == 0 else -1, *loads),
                records.SpotMeans(
                    *(t_ns, self.block, tuple(four), (5.0,) * (many // 2), np.zeros((many, many)), 20, 0, status, '')
                ),
            ):
                self.watch.put(record)
            self.block += 1
        return dots


def under(fx: float, fy: float) -> records.FloatArray:
    """The readings under a load, m: PSDs move against the dots."""
    return np.asarray(REST - np.tile([fx * COMPLIANCE[0], fy * COMPLIANCE[1]], 2))


def twisted(tz: float) -> records.FloatArray:
    """The readings under a torque, m: R(-theta) l - c of each PSD."""
    theta = tz * COMPLIANCE[2]
    c, s = np.cos(theta), np.sin(theta)
    beams = RIG.centers + RIG.zeros
    return np.asarray((beams @ np.array([[c, -s], [s, c]]) - RIG.centers).ravel())


def alarmed(fed: Fed) -> bool:
    return fed.watch.alarm is not None


X1 = np.array([5e-6, 0.0, 0.0, 0.0])


def wandering(t: records.FloatArray, rms: float = 1e-6, tau: float = 20.0) -> records.FloatArray:
    """Readings whose beams wander, each by itself: a Gauss-Markov process of ``rms`` m and ``tau`` s."""
    rng = np.random.default_rng(7)
    keep = np.exp(-1.0 / (SECOND * tau))
    steps = rms * np.sqrt(1.0 - keep**2) * rng.standard_normal((len(t), 4))
    out = np.empty_like(steps)
    last = np.zeros(4)
    for row, step in zip(out, steps, strict=True):
        last = keep * last + step
        row[:] = last
    return np.asarray(REST + out)


@pytest.mark.slow
def test_beams_that_wander_are_an_alarm_unless_the_rig_says_so() -> None:
    """Review: 1 um rms with 20 s between one place and another."""
    allowed = {'watch_wander': 4e-6}
    alarms = []
    for rig in (RIG, load_rig(overrides=allowed)):
        fed = Fed(rig)
        fed.load(0.0, 0.0)
        fed.run(600.0, wandering)
        alarms.append(fed.watch.alarms)
    assert alarms[0] > 0
    assert alarms[1] == 0
    fed.run(10.0, REST + 3.0 * X1)
    assert alarmed(fed)


@pytest.mark.parametrize('way', [1.0, -1.0])
def test_a_bump_is_reported_with_its_time_channel_and_size(way: float) -> None:
    fed = Fed()
    fed.load(0.0, 0.0)
    fed.run(10.0, REST)
    assert (fed.watch.alarms, fed.watch.state) == (0, 'readings, base line and load')
    fed.run(6.0, REST + way * X1)
    alarm = fed.watch.alarm
    assert alarm is not None
    assert alarm.channel == 'x1'
    assert alarm.shift == pytest.approx(5e-6 * way, abs=0.3e-6)
    assert alarm.since_ns / 1e9 == pytest.approx(10.0, abs=0.6 if way > 0.0 else 0.2)
    assert 3.0 < alarm.observed_ns / 1e9 - 10.0 < 6.0
    # Of two means of four windows, which are means of 25 blocks.
    assert alarm.sd == pytest.approx(NOISE / 5.0 * 0.5**0.5, rel=0.4)
    assert alarm.sigmas > 20.0
    assert fed.watch.alarms == 1
    assert f'x1 is {5.0 * way:+.0f}' in alarm.words.replace('4.9', '5')


def test_a_load_that_is_noted_again_changes_nothing() -> None:
    """What was learnt under it stays, so that a bump with the second note is no new level."""
    fed = Fed()
    fed.load(7.0, -10.0, 1.0)
    fed.run(10.0, under(7.0, -10.0))
    fed.load(7.0, -10.0, 1.0)
    fed.run(6.0, under(7.0, -10.0) + X1)
    assert fed.watch.alarm is not None
    assert fed.watch.alarm.channel == 'x1'


def test_base_line_tolerance_is_0_2_percent_of_motion() -> None:
    """A link that moved by 2 mm, without a known load: 4 um are a sound rig's, 7 um are not."""
    for wrong, alarm in ((1.5e-6, False), (2.5e-6, True)):
        fed = Fed()
        fed.run(8.0, under(0.0, 0.0))
        longer = wrong * np.array([1.0, 1.0, -1.0, -1.0])
        fed.run(8.0, under(0.0, -45.0) + longer)
        assert alarmed(fed) is alarm


def test_the_readings_under_a_load_are_learnt_in_two_seconds() -> None:
    fed = Fed()
    assert fed.watch.state == 'no window yet'
    fed.run(6.0, REST)
    fed.load(0.0, 0.0)
    # Four whole windows; the first one begins up to half a second later.
    fed.run(1.9, REST)
    assert fed.watch.state == 'learns the readings under this load'
    fed.run(0.7, REST)
    assert fed.watch.state == 'readings, base line and load'


def test_readings_without_noise_are_watched_too() -> None:
    fed = Fed(noise=0.0)
    fed.load(0.0, 0.0)
    fed.run(10.0, REST)
    assert not alarmed(fed)
    fed.run(6.0, REST + X1)
    assert fed.watch.alarm is not None
    assert fed.watch.alarm.channel == 'x1'


@pytest.mark.parametrize(('a', 'b'), [(1, 2), (1, 3), (2, 3)])
def test_each_base_line_of_three_psds_is_watched(a: int, b: int) -> None:
    """Both dots go apart along the line between their PSDs, soon after the begin."""
    rest = THREE.zeros.ravel()
    along = THREE.centers[b - 1] - THREE.centers[a - 1]
    apart = np.zeros((3, 2))
    apart[b - 1] = 12e-6 * along / np.linalg.norm(along)
    apart[a - 1] = -apart[b - 1]
    fed = Fed(THREE)
    # Four windows tell what scatter is usual, four the level.
    fed.run(4.1, rest)
    fed.run(8.0, rest + apart.ravel())
    assert fed.watch.alarm is not None
    assert fed.watch.alarm.channel == f'base line of psd_{a} and psd_{b}'
    assert fed.watch.alarm.shift == pytest.approx(24e-6, abs=0.5e-6)


@pytest.mark.parametrize(('share', 'alarm'), [(1.01, False), (1.06, True)])
def test_torque_response_off_link_model_raises_alarm(share: float, alarm: bool) -> None:
    """Two per cent of the movement, which is from one side to the other, and 40 urad."""
    fed = Fed()
    fed.load(0.0, 0.0, 10.0)
    fed.run(6.0, twisted(10.0))
    fed.load(0.0, 0.0, -10.0)
    fed.run(6.0, twisted(-10.0 * share))
    assert alarmed(fed) is alarm
    if fed.watch.alarm is not None:
        assert fed.watch.alarm.channel == 'theta'
        shift = -10.0 * (share - 1.0) * COMPLIANCE[2]
        assert fed.watch.alarm.shift == pytest.approx(shift, rel=0.05)
        assert fed.watch.alarm.sd == pytest.approx((40e-6 + 0.02 * abs(20.6 * COMPLIANCE[2])) / 6.0, rel=0.01)
        assert fed.watch.alarm.words.startswith(f'theta is {1e6 * fed.watch.alarm.shift:+.2f} µrad off')


def test_what_comes_back_ends_the_alarm_and_a_zero_too() -> None:
    fed = Fed()
    fed.load(0.0, 0.0)
    fed.run(8.0, REST)
    fed.run(8.0, REST + X1)
    for seconds, there in ((8.0, True), (12.0, False)):
        fed.run(seconds, REST)
        assert alarmed(fed) is there
    fed.run(8.0, REST + X1)
    assert fed.watch.alarms == 2
    fed.watch.changed(records.ParameterChange(0, 0, (('state.held_twist', (0.0, 0.0, 0.0)),)), RIG)
    assert alarmed(fed)
    fed.watch.changed(records.ParameterChange(0, 0, (('psd_1.zero', (0.0, 0.0)),)), RIG)
    assert not alarmed(fed)
    fed.run(20.0, REST + X1)
    assert not alarmed(fed)


def test_a_load_may_be_noted_after_it_was_put_on() -> None:
    fed = Fed()
    fed.load(0.0, 0.0)
    fed.run(8.0, under(0.0, 0.0))
    for fy in (-20.0, 0.0, -50.0, -10.0):
        fed.run(2.0, under(0.0, fy))
        fed.load(0.0, fy)
        fed.run(8.0, under(0.0, fy))
    assert fed.watch.alarms == 0


def test_a_load_that_is_not_noted_is_an_alarm() -> None:
    fed = Fed()
    fed.load(0.0, 0.0)
    fed.run(8.0, under(0.0, 0.0))
    fed.run(6.0, under(0.0, -1.0))
    assert fed.watch.alarm is not None
    assert fed.watch.alarm.channel in ('y1', 'y2')


def test_without_a_known_load_only_the_base_line_is_watched() -> None:
    fed = Fed()
    fed.run(8.0, under(0.0, 0.0))
    fed.run(8.0, under(20.0, -30.0))
    assert (fed.watch.state, fed.watch.alarms) == ('base line only: no load is known', 0)
    fed.run(8.0, under(20.0, -30.0) + np.array([4e-6, 4e-6, -4e-6, -4e-6]))
    assert fed.watch.alarm is not None
    assert fed.watch.alarm.channel == 'base line of psd_1 and psd_2'


@pytest.mark.parametrize(('share', 'alarm', 'axis'), [(1.01, False, 1), (1.06, True, 1), (1.06, True, 0)])
def test_a_load_must_do_what_the_link_model_says(share: float, alarm: bool, axis: int) -> None:
    fed, way = Fed(decimation=(7, 1)[axis]), np.eye(2)[axis]
    fed.load(0.0, 0.0)
    fed.run(6.0, under(0.0, 0.0))
    # Noted less than three seconds before the next: its pose is not yet sure, so the one before it counts.
    fed.load(*(-20.0 * way))
    fed.run(2.6, under(*(-20.0 * way)))
    fed.load(*(-40.0 * way))
    fed.run(6.0, under(*(-40.0 * share * way)))
    alarmed = fed.watch.alarm
    assert (alarmed is not None) == alarm
    if alarmed is not None:
        assert alarmed.channel == ('dx', 'dy')[axis]
        assert alarmed.shift == pytest.approx(-40.0 * (share - 1.0) * COMPLIANCE[axis], rel=0.05)
        # Six of these are what is allowed: 5 um and 2 % of the movement.
        assert alarmed.sd == pytest.approx((5e-6 + 0.02 * abs(40.0 * share * COMPLIANCE[axis])) / 6.0, rel=0.01)
        # What the level under this load is does not end it, and it is not seen to end under another one.
        fed.run(20.0, under(*(-40.0 * share * way)))
        assert fed.watch.alarm is alarmed
        fed.load(0.0, 0.0)
        fed.run(20.0, under(0.0, 0.0))
        assert fed.watch.alarm is not None


def test_drift_ringing_and_gaps_are_no_alarm() -> None:
    fed = Fed()
    fed.load(0.0, 0.0)
    fed.run(10.0, REST)
    # A micrometre in a minute; then the link swings by half a millimetre, and blocks are missing.
    fed.run(60.0, lambda t: REST + np.outer(t / 60.0, np.full(4, 1e-6)))
    fed.run(10.0, lambda t: REST + 1e-6 - np.outer(5e-4 * np.exp(-1.8 * t) * np.sin(88.0 * t), [0.0, 1.0, 0.0, 1.0]))
    fed.run(5.0, REST + 1e-3, status=records.BlockStatus.LASER_LOST)
    fed.run(10.0, REST + 1e-6)
    assert fed.watch.alarms == 0
    assert fed.watch.spoilt > 0


class Expected(NamedTuple):
    """A second reckoning of one channel: the alarm, and how many windows after it ended."""

    since: int
    observed: int
    shift: float
    sd: float
    ended: int


def page(values: records.FloatArray, least: float) -> Expected:
    """Page's two sums of the means of 25 blocks, from the eighth window on; four tell the level before.

    A window that scatters more than three times as much as a quarter of all do is passed over.
    """
    windows = values.reshape(-1, 25)
    means, scatters = windows.mean(axis=1), windows.std(axis=1)
    level, sums, began = float(np.median(means[3:7])), np.zeros(2), [0, 0]
    since, first, quiet, out, used = 0, 0, 0, None, list[float]()
    for k in range(7, len(means)):
        usual = np.sort(scatters[max(0, k - 59) : k + 1])
        if scatters[k] > 3.0 * usual[len(usual) // 4]:
            continue
        used.append(means[k])
        steps = np.abs(np.diff(used))
        between_sd = 1.4826 * np.median(steps) / 2**0.5 if len(steps) >= 4 else 0.0
        sd = max(usual[len(usual) // 4] / 5.0, between_sd)
        off = (means[k] - level) / sd
        before, sums = sums, np.maximum(sums + np.clip(np.array([off, -off]) - max(2.0, least / sd), -8.0, 8.0), 0.0)
        began = [k if b == 0.0 < s else at for b, s, at in zip(before, sums, began, strict=True)]
        sums, since = np.minimum(sums, 30.0), since + 1 if sums.any() else 0
        if not since:
            level += (means[k] - level) / 120.0
        if out is None:
            first = (first or k) if sums.max() > 10.0 else 0
            if first and k >= first + 6:
                shift = float(np.median(means[k + 1 - min(since, 4) : k + 1])) - level
                out = began[int(sums.argmax())], k, shift, sd * (1.0 / min(since, 4) + 0.25) ** 0.5
        else:
            quiet = 0 if sums.max() > 10.0 else quiet + 1
            if quiet == 20:
                return Expected(*out, k)
    raise AssertionError('no alarm that ends')


@pytest.mark.parametrize('shift', [0.0, 0.6e-6])
def test_an_alarm_is_that_of_a_second_reckoning(shift: float) -> None:
    """psd_1 is moved across the base line, so that this stays as long, as soon as its level is known; then back.

    With ``shift`` m all go from place to place, so that the windows' means differ by more than they scatter.
    """
    fed, dots = Fed(), []
    fed.load(0.0, 0.0)
    moved = 4e-6 * np.array([0.07, -0.1, 0.0, 0.0]) / np.hypot(0.07, 0.1)

    def window(number: int) -> None:
        """All shake alike, now more, now less, so that what is usual is no wander from window to window."""
        size = {12: 8.2e-6, 20: 11e-6}.get(number, (2.0 + 0.5 * (3 * number % 7)) * 1e-6)
        still = REST + moved * (7 <= number < 19) + shift * (number % 2)
        dots.append(fed.run(0.5, lambda t: still + size * np.sin(12.0 * np.pi * t)[:, None]))

    for number in range(19):
        window(number)
    alarm, ended = fed.watch.alarm, 18
    while alarmed(fed):
        ended += 1
        window(ended)
    x1, y1 = (page(np.concatenate(dots)[:, i], RIG.acquisition.watch_wander) for i in (0, 1))
    assert alarm is not None
    assert (alarm.channel, alarm.also) == ('y1', ('x1',))
    assert '; x1 too: ' in alarm.words
    assert (alarm.shift, alarm.sd) == pytest.approx((y1.shift, y1.sd), rel=1e-9)
    assert alarm.since_ns + 20_000_000 == 500_000_000 * y1.since
    assert alarm.observed_ns + 20_000_000 == 500_000_000 * (y1.observed + 1)
    assert (x1.since, ended) == (y1.since, max(x1.ended, y1.ended))
    # Which scatter is usual is known after four windows.
    assert (fed.watch.windows, fed.watch.spoilt) == (ended + 1, 3 + 1)


@pytest.mark.parametrize('lost', [False, True])
@pytest.mark.parametrize('load', [(0.0, -40.0, 0.0), (0.0, 0.0, 10.0)])
def test_after_zero_or_lost_block_first_window_counts(load: tuple[float, float, float], lost: bool) -> None:
    """The level before the load is that of one window, and nothing of before the zero or the gap is in it."""
    fed = Fed(noise=0.0)
    fed.run(2.0, REST)
    fed.load(0.0, 0.0)
    fed.run(0.1, under(3.0, 5.0) + X1)
    if lost:
        fed.run(0.02, REST, records.BlockStatus.LASER_LOST)
    else:
        fed.watch.changed(records.ParameterChange(0, 0, (('psd_1.zero', (0.0, 0.0)),)), RIG)
    fed.run(3.6, REST)
    fed.load(*load)
    fed.run(3.0, under(0.0, 1.06 * load[1]) if load[1] else twisted(1.06 * load[2]))
    alarm, moved = fed.watch.alarm, 1.06 * load[1] * COMPLIANCE[1] + 1.06 * load[2] * COMPLIANCE[2]
    assert alarm is not None
    assert alarm.channel == ('dy' if load[1] else 'theta')
    assert alarm.shift == pytest.approx(moved * 0.06 / 1.06, rel=1e-6)
    assert alarm.sd == pytest.approx(((5e-6 if load[1] else 40e-6) + 0.02 * abs(moved)) / 6.0, rel=1e-6)
