"""The watch: what it sees, what it passes over, and the short form of its campaign."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from blind.watch import SIZES, WITHIN_S, one, quiet, table
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.watch import Watch
from psd_deflection.model.solvers.registry import solver_from_rig
from psd_deflection.records import (
    AppliedLoad,
    BlockStatus,
    DeflectionEstimate,
    FloatArray,
    ParameterChange,
    SpotMeans,
    TipLoad,
)
from psd_deflection.rig.config import load_rig

RIG = load_rig()
SOLVER = solver_from_rig('exact', RIG)
COMPLIANCE = Pipeline(RIG).tip_loads.compliance
NOISE = 0.3e-6
REST = RIG.zeros.ravel()
SECOND = 50
"""Blocks."""


class Fed:
    """A watch that is fed block means."""

    def __init__(self) -> None:
        self.watch = Watch(RIG, COMPLIANCE)
        self.block = 0
        self._rng = np.random.default_rng(1)

    def load(self, fx: float, fy: float, tz: float = 0.0) -> None:
        self.watch.put(AppliedLoad(self.block * 20_000_000, fx, fy, tz))

    def run(
        self, seconds: float, of: Callable[[FloatArray], FloatArray] | FloatArray, status: BlockStatus = BlockStatus.OK
    ) -> None:
        """Blocks with the readings ``of`` (4,) m, or a function of the time in this run (n,) that gives (n, 4)."""
        t = np.arange(round(seconds * SECOND)) / SECOND
        dots = (of(t) if callable(of) else np.tile(of, (len(t), 1))) + NOISE * self._rng.standard_normal((len(t), 4))
        poses = SOLVER.solve_many(dots, np.full(4, NOISE**2)).pose
        for four, pose in zip(dots.tolist(), poses[:, :3].tolist(), strict=True):
            t_ns = self.block * 20_000_000
            loads = (p / c for p, c in zip(pose, COMPLIANCE, strict=True))
            dx, dy, theta = pose
            for record in (
                DeflectionEstimate(t_ns, self.block, 'exact', dx, dy, theta, 0.0, 0.0, (0.0,) * 9, 0.0, True),
                TipLoad(t_ns, *loads),
                SpotMeans(t_ns, self.block, tuple(four), (5.0, 5.0), np.zeros((4, 4)), 20, 0, status, ''),
            ):
                self.watch.put(record)
            self.block += 1


def under(fx: float, fy: float) -> FloatArray:
    """The readings under a load, m: PSDs move against the dots."""
    return np.asarray(REST - np.tile([fx * COMPLIANCE[0], fy * COMPLIANCE[1]], 2))


def alarmed(fed: Fed) -> bool:
    return fed.watch.alarm is not None


X1 = np.array([5e-6, 0.0, 0.0, 0.0])


def test_a_bump_is_told_with_its_time_channel_and_size() -> None:
    fed = Fed()
    fed.load(0.0, 0.0)
    fed.run(10.0, REST)
    assert fed.watch.alarms == 0
    assert fed.watch.state == 'readings, base line and load'
    fed.run(6.0, REST + X1)
    alarm = fed.watch.alarm
    assert alarm is not None
    assert alarm.channel == 'x1'
    assert alarm.shift == pytest.approx(5e-6, abs=0.3e-6)
    assert alarm.since_ns / 1e9 == pytest.approx(10.0, abs=0.6)
    assert alarm.seen_ns / 1e9 - 10.0 < 6.0
    assert alarm.sigmas > 20.0
    assert fed.watch.alarms == 1
    assert 'x1 is +5' in alarm.words.replace('+4.9', '+5')


def test_a_bump_the_other_way_is_told_with_its_time_too() -> None:
    fed = Fed()
    fed.load(0.0, 0.0)
    fed.run(10.0, REST)
    fed.run(6.0, REST - X1)
    alarm = fed.watch.alarm
    assert alarm is not None
    assert alarm.shift == pytest.approx(-5e-6, abs=0.3e-6)
    assert alarm.since_ns / 1e9 == pytest.approx(10.0, abs=0.2)


def test_a_load_that_is_noted_again_changes_nothing() -> None:
    """What was learnt under it stays, so that a bump with the second note is no new level."""
    fed = Fed()
    fed.load(7.0, -10.0, 1.0)
    fed.run(10.0, under(7.0, -10.0))
    fed.load(7.0, -10.0, 1.0)
    fed.run(6.0, under(7.0, -10.0) + X1)
    assert fed.watch.alarm is not None
    assert fed.watch.alarm.channel == 'x1'


def test_the_base_line_may_be_wrong_by_two_thousandths_of_a_movement() -> None:
    """A link that moved by 2 mm, without a known load: 3 um are a sound rig's, 9 um are not."""
    for wrong, alarm in ((1.5e-6, False), (6e-6, True)):
        fed = Fed()
        fed.run(8.0, under(0.0, 0.0))
        longer = wrong * np.array([1.0, 1.0, -1.0, -1.0])
        fed.run(8.0, under(0.0, -45.0) + longer)
        assert alarmed(fed) is alarm


def test_what_comes_back_ends_the_alarm_and_a_zero_too() -> None:
    fed = Fed()
    fed.load(0.0, 0.0)
    fed.run(8.0, REST)
    fed.run(8.0, REST + X1)
    assert alarmed(fed)
    fed.run(20.0, REST)
    assert not alarmed(fed)
    fed.run(8.0, REST + X1)
    assert fed.watch.alarms == 2
    fed.watch.changed(ParameterChange(0, 0, (('state.held_twist', (0.0, 0.0, 0.0)),)), RIG)
    assert alarmed(fed)
    fed.watch.changed(ParameterChange(0, 0, (('psd_1.zero', (0.0, 0.0)),)), RIG)
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
    assert fed.watch.state == 'base line only: no load is known'
    assert fed.watch.alarms == 0
    fed.run(8.0, under(20.0, -30.0) + np.array([4e-6, 4e-6, -4e-6, -4e-6]))
    assert fed.watch.alarm is not None
    assert fed.watch.alarm.channel == 'base line of psd_1 and psd_2'


@pytest.mark.parametrize(('share', 'alarm'), [(1.01, False), (1.06, True)])
def test_a_load_must_do_what_the_link_model_says(share: float, alarm: bool) -> None:
    fed = Fed()
    fed.load(0.0, 0.0)
    fed.run(6.0, under(0.0, 0.0))
    fed.load(0.0, -40.0)
    fed.run(6.0, under(0.0, -40.0 * share))
    found = fed.watch.alarm
    assert (found is not None) == alarm
    if found is not None:
        assert found.channel == 'dy'
        assert found.shift == pytest.approx(-40.0 * (share - 1.0) * COMPLIANCE[1], rel=0.05)
        # Six of these are what is allowed: 5 um and 2 % of the movement.
        assert found.sd == pytest.approx((5e-6 + 0.02 * abs(40.0 * share * COMPLIANCE[1])) / 6.0, rel=0.01)
        # It is not seen to end under another load.
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
    fed.run(5.0, REST + 1e-3, status=BlockStatus.LASER_LOST)
    fed.run(10.0, REST + 1e-6)
    assert fed.watch.alarms == 0
    assert fed.watch.spoilt > 0


@pytest.mark.statistics
@pytest.mark.parametrize('kind', SIZES)
def test_events_of_the_second_generator_are_seen(kind: str) -> None:
    run = one((kind, 1000))
    assert run.after < WITHIN_S
    assert not run.early
    text, met = table([run], 0.0, 0, (), 0.0)
    assert met
    assert 'in 1 of 1' in text


def test_quiet_minutes_are_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('blind.watch.HOLDS', 3)
    hours, alarms, said, _ = quiet((0.05, 1))
    assert hours >= 0.05
    assert (alarms, said) == (0, [])
    assert not table([], hours, 1, ['x1'], 0.0)[1]
