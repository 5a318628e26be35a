# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The offsets: what they reach, their limits, and when they hold."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.simulated_arm import SimulatedArm, largest_step
from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.arms.chains.transform import IDENTITY, Transform, shift
from psd_deflection.arms.compensation.arm import Arm, read_arm
from psd_deflection.arms.compensation.compensator import FOREIGN_S, UNVERIFIED, Command, Compensator, Observed, State
from psd_deflection.arms.compensation.response import JointResponse
from psd_deflection.arms.compensation.settings import SETTINGS, SHAPING, CompensatorSettings, ShaperSettings, shaper_of
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.link.shapers import shaper
from psd_deflection.records import FloatArray

HERE = Path(__file__).parent
EXAMPLE = HERE.parents[2] / 'config' / 'two_links.yaml'
PERIOD = 0.02
ELBOW = np.array([1.2, 0.6])
PAYLOAD = np.array([0.0, 0.0, -40.0])
CERTAIN = np.eye(6) * 1e-12
OTHER_PUBLISHER = 'another node publishes'


@pytest.fixture(scope='module')
def arm() -> Arm:
    return read_arm(EXAMPLE.with_suffix('.urdf'), 'tool')


class Loop:
    """A compensator that sees a simulated arm through estimates of noise; ``offsets`` are those the controller has.

    ``reports``: the controller tells them, or with commands its command. ``applies``: the share of them that it adds.
    ``droop``: how far the joints stand below their command. ``measured``: what encoders make of angles. ``sent``:
    when what was sent. ``whys``: why it held, and ''.
    """

    def __init__(self, arm: Arm, dry: bool = False, applies: float = 1.0, **chosen: Any) -> None:
        given: dict[str, Any] = {'takeover': False, **chosen}
        self.commands = given.get('output') == 'commands'
        self.reports = bool(given['takeover']) or self.commands
        self.applies, self.droop = applies, 0.0
        self.measured: Callable[[FloatArray], FloatArray] = lambda angles: angles
        self.sent: list[tuple[float, FloatArray]] = []
        self.whys: set[str] = set()
        self.compensator = Compensator(arm, CompensatorSettings(axes=('x', 'z'), **given), dry)
        self.plant = SimulatedArm(read_chain(EXAMPLE).chain, ELBOW, damping=0.1)
        self.offsets = np.zeros(2)
        self.dry = dry
        self.t = 0.0
        self.noise = np.random.default_rng(3)

    def run(self, seconds: float, wanted: FloatArray = ELBOW, report_every: int = 1) -> Command:
        """Let the arm be moved to ``wanted`` at once, and the compensator act."""
        for n in range(round(seconds / PERIOD)):
            self.t += PERIOD
            if self.commands and not self.sent:
                self.has = wanted
            there = wanted + (0.0 if self.dry else self.applies * self.offsets)
            if self.commands:
                there = wanted + self.applies * (self.has - wanted)
            self.plant.step(there - self.droop, PERIOD)
            if n % report_every == 0:
                self.compensator.joints(self.t, self.measured(self.plant.angles))
            if self.reports and n % report_every == 0:
                self.compensator.controller_has(self.t, self.has if self.commands else self.offsets)
            at = self.plant.end().deflection
            noisy = Transform(at.rotation, at.position + self.noise.normal(size=3) * 1e-6)
            self.compensator.observe(self.t, Observed(self.t, noisy, CERTAIN))
            command = self.send(self.t)
            self.whys.add(command.why)
        return command

    def send(self, now: float) -> Command:
        """What the compensator says at a time; the controller takes it, if it is to."""
        command = self.compensator.watch(now)
        if command.sends:
            self.compensator.sent(now, command)
            self.offsets = command.offsets
            self.has = command.offsets if command.positions is None else command.positions
            self.sent.append((now, self.has))
        return command

    def step(self) -> float:
        """The largest step over what the rate allows."""
        return largest_step([t for t, _ in self.sent], [v for _, v in self.sent], self.compensator.settings.max_rate)

    def error(self, wanted: FloatArray = ELBOW) -> float:
        """Distance of the end effector from where it would be if no link bent."""
        rigid = self.plant.chain.rigid(wanted.tolist())
        return float(np.linalg.norm(self.plant.end().deflected.position - rigid.position))


@pytest.mark.slow
def test_a_payload_is_compensated_to_one_part_in_hundred(arm: Arm) -> None:
    loop = Loop(arm)
    loop.plant.force = PAYLOAD
    loop.run(0.6)
    before = loop.error()
    assert before > 2e-3
    loop.compensator.enable(True)
    command = loop.run(1.6)
    assert command.state is State.FOLLOWING
    assert not command.limited
    assert loop.error() < 0.01 * before
    elsewhere = np.array([0.7, 1.4])
    loop.run(1.5, elsewhere)
    assert loop.error(elsewhere) < 0.01 * before
    loop.plant.force = np.zeros(3)
    loop.run(2.0, elsewhere)
    assert np.abs(loop.offsets).max() < 2e-5


def test_dry_it_proposes_what_it_would_command(arm: Arm) -> None:
    dry, wet = Loop(arm, dry=True), Loop(arm)
    for loop in (dry, wet):
        loop.plant.force = PAYLOAD
        loop.run(PERIOD)
        loop.compensator.enable(True)
        # Estimates from before it was enabled have no residual.
        assert math.isnan(loop.send(loop.t).residual)
        loop.run(1.6)
    assert dry.offsets == pytest.approx(wet.offsets, rel=0.05)
    assert dry.error() > 30 * wet.error()


@pytest.mark.parametrize('rate', [0.002, 0.1])
def test_offsets_stay_within_their_limits(arm: Arm, rate: float) -> None:
    """It says so if either limit is reached, also the largest offset alone."""
    loop = Loop(arm, max_offset=1e-3, max_rate=rate)
    loop.plant.force = PAYLOAD
    loop.run(1.0)
    loop.compensator.enable(True)
    before = loop.offsets
    for _ in range(80):
        command = loop.run(PERIOD)
        assert np.abs(command.offsets - before).max() <= rate * PERIOD * (1 + 1e-9)
        before = command.offsets
    assert np.abs(before).max() == pytest.approx(1e-3)
    assert command.limited


def test_a_step_beyond_the_rate_alone_is_limited(arm: Arm) -> None:
    loop = following(arm, max_rate=0.002)
    assert loop.run(PERIOD).limited
    assert np.abs(loop.offsets).max() < 0.1 * loop.compensator.settings.max_offset


@pytest.mark.slow
@pytest.mark.parametrize('limit', [-2.0, 2.0])
@pytest.mark.parametrize('up', [1.0, -1.0])
def test_a_joint_is_not_sent_beyond_its_limit(arm: Arm, limit: float, up: float) -> None:
    """Under a weight and under a lift: one of them is made up for by a turn beyond the limit."""
    loop = Loop(arm)
    loop.plant.force = up * PAYLOAD
    loop.compensator.enable(True)
    limited = loop.run(1.0, np.array([limit, 0.3])).limited
    assert max(abs(loop.plant.angles[0]), abs(limit + loop.offsets[0])) < 2.0 + 1e-4
    assert limited == (up < 0.0)


def following(arm: Arm, **chosen: Any) -> Loop:
    loop = Loop(arm, **chosen)
    loop.plant.force = PAYLOAD
    loop.run(0.4)
    loop.compensator.enable(True)
    assert loop.run(0.6).state is State.FOLLOWING
    return loop


def reporting(arm: Arm) -> Loop:
    """The same with a controller that tells the offsets that it applies."""
    loop = Loop(arm, takeover=True)
    loop.plant.force = PAYLOAD
    loop.compensator.enable(True)
    assert loop.run(1.6).state is State.FOLLOWING
    return loop


def observed(loop: Loop, **changed: object) -> Observed:
    return Observed(loop.t, loop.plant.end().deflection, CERTAIN)._replace(**changed)  # type: ignore[arg-type]


NAN = shift(math.nan, 0.0, 0.0)


@pytest.mark.parametrize(
    ('changed', 'why'),
    [
        ({'deflection': NAN}, 'not finite'),
        ({'covariance': np.full((6, 6), np.inf)}, 'not finite'),
        ({'covariance': np.eye(6) * 1e-4}, 'uncertain by more than 0.001'),
        ({'covariance': -np.eye(6)}, 'does not say how certain'),
        ({'covariance': np.zeros((6, 6))}, 'does not say how certain'),
        ({'covariance': np.eye(6) * 5e-324}, 'does not say how certain'),
        ({'deflection': shift(0.0, 0.5, 0.0)}, 'a deflection of 0.5 is more than the links can have'),
        ({'deflection': shift(1e308, 0.0, 0.0)}, 'more than the links can have'),
        ({'age': 0.2}, 'older than 0.08 s'),
        ({'age': -0.2}, 'ahead of our clock'),
        ({'deflection': shift(0.1, 0.0, 0.0)}, 'jumps by'),
    ],
)
def test_offsets_hold_from_bad_to_good_deflections(arm: Arm, changed: dict[str, object], why: str) -> None:
    loop = following(arm)
    before = loop.offsets
    loop.t += PERIOD
    loop.compensator.joints(loop.t, loop.plant.angles)
    command = loop.compensator.observe(loop.t, observed(loop, **{'t': loop.t, **changed}))
    assert command.state is State.HOLDING
    assert why in command.why
    assert np.array_equal(command.offsets, before)
    command = loop.run(PERIOD * 20)
    assert command.state is State.HOLDING
    assert np.array_equal(command.offsets, before)
    assert loop.run(PERIOD * 10).state is State.FOLLOWING


def test_deflection_is_followed_up_to_max_sd(arm: Arm) -> None:
    # A power of two has an exact square.
    bound = 2.0**-10
    loop = following(arm, max_sd=bound)
    for sd, state in ((bound, State.FOLLOWING), (math.nextafter(bound, 1.0), State.HOLDING)):
        loop.t += PERIOD
        loop.compensator.joints(loop.t, loop.plant.angles)
        covariance = np.eye(6) * sd**2
        assert loop.compensator.observe(loop.t, observed(loop, t=loop.t, covariance=covariance)).state is state


@pytest.mark.parametrize('lost', ['deflection', 'joints'])
def test_it_holds_within_a_tenth_of_a_second_of_the_last_word(arm: Arm, lost: str) -> None:
    loop = following(arm)
    before = loop.offsets
    for n in range(1, 11):
        now = loop.t + 0.01 * n
        if lost == 'joints':
            command = loop.compensator.observe(now, observed(loop, t=now))
        else:
            loop.compensator.joints(now, loop.plant.angles)
            command = loop.compensator.watch(now)
    assert command.state is State.HOLDING
    assert ('joints' in command.why) == (lost == 'joints')
    held = command.offsets
    assert np.array_equal(loop.compensator.watch(loop.t + 5.0).offsets, held)
    if lost == 'deflection':
        assert np.array_equal(held, before)


def test_the_hand_over_has_no_step(arm: Arm) -> None:
    loop = following(arm)
    before = loop.offsets
    loop.compensator.enable(False)
    command = loop.run(PERIOD)
    assert command.state is State.RELEASING
    assert np.abs(command.offsets - before).max() <= 0.1 * PERIOD * 1.001
    assert loop.run(0.3).state is State.OFF
    assert not loop.offsets.any()
    loop.compensator.enable(True)
    assert np.abs(loop.run(PERIOD).offsets).max() <= 0.1 * PERIOD * 1.001


def test_it_goes_back_to_zero_without_deflections_too(arm: Arm) -> None:
    loop = following(arm)
    loop.compensator.enable(False)
    for n in range(200):
        command = loop.compensator.watch(loop.t + 0.01 * n)
    assert command.state is State.OFF
    assert not command.offsets.any()


def test_a_vibration_is_hardly_followed(arm: Arm) -> None:
    loop = Loop(arm)
    loop.plant = SimulatedArm(read_chain(EXAMPLE).chain, ELBOW, damping=0.003)
    loop.compensator.enable(True)
    # More would be a jump, at which the offsets hold.
    loop.plant.force = 0.25 * PAYLOAD
    # It swings at 12 Hz about the load's deflection, by as much as that.
    offsets = np.array([loop.run(PERIOD).offsets for _ in range(90)])[-20:]
    swing = np.ptp(offsets, axis=0) / 2.0
    assert np.all(swing < 0.1 * np.abs(offsets.mean(axis=0)))


@pytest.mark.parametrize(
    ('chosen', 'message'),
    [
        ({'axes': ('x', 'u')}, 'each must be one of x, y, z, rx, ry, rz'),
        ({'axes': ()}, 'axes = .*must be a list of names'),
        ({'axes': ('x', 'x')}, 'axes: none may be there twice'),
        ({'output': 'torques'}, 'output = .torques.: must be one of offsets, commands'),
        ({'max_rate': 0.0}, 'max_rate = 0.0 rad/s or m/s: must be above 0'),
        ({'stale': math.nan}, 'stale = nan s: must be finite'),
        ({'good': 0}, 'good = 0: must be at least 1'),
    ],
)
def test_settings_are_checked(chosen: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CompensatorSettings(**chosen)  # type: ignore[arg-type]


LARGEST = dict.fromkeys(('max_offset', 'max_rate', 'damping', 'max_sd', 'jump', 'max_deflection', 'follow_error'), 10.0)
MOST = {
    'max_joint_speed': 1000.0,
    **LARGEST,
    'time_constant': 100.0,
    'stale': 10.0,
    'good': 10_000,
    'release_after': 1e6,
}
OF_SHAPER = {'frequency': 1000.0, 'max_step': 10.0, 'lead': 1.0}


@pytest.mark.parametrize(('name', 'most'), [*MOST.items(), *OF_SHAPER.items()])
def test_a_setting_is_within_its_bounds(name: str, most: float) -> None:
    of: Any = CompensatorSettings if name in MOST else ShaperSettings
    assert getattr(of(**{name: most}), name) == most
    assert (SETTINGS if name in MOST else SHAPING).parameters[name].live is (name != 'frequency')
    with pytest.raises(ConfigError, match=f'{name} = .*at most'):
        of(**{name: most + 1 if name == 'good' else most * 1.001})
    if name in LARGEST or name == 'max_joint_speed':
        with pytest.raises(ConfigError, match=f'{name} = 0.0 .*must be above 0'):
            of(**{name: 0.0})


def test_bending_is_shaped_unless_modes_are_named() -> None:
    assert ShaperSettings().modes == ('bending',)
    assert ShaperSettings(frequency=0.1).frequency == 0.1
    with pytest.raises(ConfigError, match=r'frequency = 0.09 Hz: must be at least 0.1'):
        ShaperSettings(frequency=0.09)


def test_modes_are_those_of_the_rig_file(tmp_path: Path) -> None:
    rig = tmp_path / 'rig.yaml'
    chosen = ShaperSettings(params_file=str(rig), shaper='zvd')
    text = '/**:\n  ros__parameters:\n    amplifier.noise: 1e-3\n'
    for key, value in (('bending_frequency', 13.5), ('bending_damping_ratio', 0.03)):
        rig.write_text(text)
        with pytest.raises(ConfigError, match=f'rig.yaml: has no dynamics.{key}; `psd-deflection identify` finds it'):
            shaper_of(chosen)
        text += f'    dynamics.{key}: {value}\n'
    rig.write_text(text)
    words = 'ZVD for 13.5 Hz, damping ratio 0.03; motions take 74 ms longer'
    assert shaper_of(chosen) == (shaper('zvd', 13.5, 0.03), words)


def test_controller_text_expires(arm: Arm) -> None:
    compensator = Compensator(arm, CompensatorSettings())
    assert compensator.controller_text(0.0) == 'nothing'
    compensator.controller_has(0.0, np.array([0.1, -2e-6]))
    assert compensator.controller_text(FOREIGN_S) == '0.100000, -0.000002'
    assert compensator.controller_text(math.nextafter(FOREIGN_S, math.inf)) == 'nothing'


def test_before_the_first_deflection_there_is_no_offset(arm: Arm) -> None:
    compensator = Compensator(arm, CompensatorSettings())
    compensator.enable(True)
    command = compensator.watch(0.0)
    assert (command.state, command.why) == (State.HOLDING, 'no deflection yet')
    assert not command.offsets.any()
    command = compensator.observe(0.0, Observed(0.0, IDENTITY, CERTAIN))
    assert command.why == 'the positions of the joints are not known'
    compensator.joints(0.0, np.array([0.0, math.nan]))
    assert compensator.observe(0.0, Observed(0.0, IDENTITY, CERTAIN)).state is State.HOLDING


def test_joints_that_leap_hold_the_offsets(arm: Arm) -> None:
    loop = following(arm)
    before = loop.offsets
    loop.compensator.joints(loop.t + PERIOD, loop.plant.angles + np.array([1.0, 0.0]))
    command = loop.compensator.watch(loop.t + PERIOD)
    assert command.state is State.HOLDING
    assert 'the positions of the joints leap by 1' in command.why
    assert np.array_equal(command.offsets, before)


def test_two_nodes_that_report_different_joints_hold_the_offsets(arm: Arm) -> None:
    loop = following(arm)
    before = loop.offsets
    for n in range(1, 10):
        now = loop.t + PERIOD * n
        loop.compensator.joints(now, loop.plant.angles + (0.05 if n % 2 else 0.0))
        loop.compensator.observe(now, observed(loop, t=now))
        command = loop.send(now)
    assert 'go to and fro by 0.05' in command.why
    assert np.array_equal(command.offsets[1:], before[1:]) or loop.step() <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize('step', [3600.0, -3600.0])
def test_clock_step_holds_offsets_for_some_estimates(arm: Arm, step: float) -> None:
    """That of the estimator and ours: the stamps change, and their ages do not."""
    loop = following(arm)
    before = loop.offsets
    states = set()
    for n in range(1, 60):
        now = loop.t + PERIOD * n
        loop.compensator.joints(now, loop.plant.angles)
        loop.compensator.observe(now, observed(loop, t=now + step))
        command = loop.send(now)
        states.add(command.state)
        assert n > 20 or step > 0.0 or np.array_equal(command.offsets, before)
    assert command.state is State.FOLLOWING
    assert (State.HOLDING in states) == (step < 0.0)
    assert loop.step() <= 1.0 + 1e-9


def test_positions_that_were_old_when_they_came_are_not_new(arm: Arm) -> None:
    loop = following(arm)
    loop.compensator.joints(loop.t, loop.plant.angles, age=0.07)
    loop.compensator.observe(loop.t + PERIOD, observed(loop, t=loop.t + PERIOD))
    assert loop.send(loop.t + PERIOD).why == 'no positions of the joints for 0.08 s'


def test_a_deflection_that_was_old_when_it_came_is_not_new(arm: Arm) -> None:
    loop = following(arm)
    now = loop.t + PERIOD
    loop.compensator.observe(now, observed(loop, t=now, age=0.07))
    loop.compensator.joints(now + PERIOD, loop.plant.angles)
    assert loop.send(now + PERIOD).why == 'no deflection for 0.08 s'


def test_offsets_that_are_held_for_long_go_back_to_zero(arm: Arm) -> None:
    loop = following(arm)
    held = np.abs(loop.offsets).max()
    began, now = loop.t, loop.t
    command = loop.send(now)
    while command.state is not State.OFF:
        now += 0.01
        command = loop.send(now)
    assert now - began == pytest.approx(0.08 + 10.0 + held / 0.1, abs=0.2)
    assert not loop.offsets.any()
    assert not loop.compensator.enabled
    assert loop.step() <= 1.0 + 1e-9


@pytest.mark.slow
def test_offsets_of_an_arm_that_stands_stay_however_long_it_does(arm: Arm) -> None:
    """If they went back meanwhile, it would leap by all of them when it runs again."""
    loop = following(arm)
    held = loop.offsets
    loop.compensator.stop('the robot does not run')
    assert loop.run(30.0).state is State.HOLDING
    assert np.array_equal(loop.offsets, held)


def test_time_counts_from_when_the_last_one_was_sent(arm: Arm) -> None:
    """One that leaves late is followed by a small step."""
    loop = following(arm)
    loop.compensator.enable(False)
    first = loop.compensator.watch(loop.t + 0.01)
    loop.compensator.sent(loop.t + 0.05, first)
    second = loop.compensator.watch(loop.t + 0.06)
    assert np.abs(second.offsets - first.offsets).max() == pytest.approx(0.1 * 0.01)
    # After a pause it is one of a tenth of a second at most.
    loop = following(arm, max_rate=0.01)
    loop.compensator.enable(False)
    before = loop.offsets
    assert np.abs(loop.compensator.watch(loop.t + 5.0).offsets - before).max() == pytest.approx(0.01 * 0.1)


@pytest.mark.parametrize(('period', 'first'), [(0.02, 70), (0.04, 65)])
def test_slope_is_known_0_2_s_after_joint_and_offset_rest(period: float, first: int) -> None:
    response, known = JointResponse(1), []
    for n in range(100):
        moved = np.array([0.02 * min(max(n - 50, 0), 10) / 10])
        response.add(period * n, moved, moved, 0.01)
        known.append(bool(response.known()[0]))
    assert known.index(True) == first


@pytest.mark.parametrize(
    ('period', 'way'),
    [(0.02, np.arange(11) / 10), (0.25, [*(0.0, 0.1) * 4, 0.0, 0.945, 1.0])],
    ids=['long', 'last step'],
)
def test_motion_before_first_rest_gives_no_slope(period: float, way: Sequence[float]) -> None:
    response = JointResponse(1)
    for n in range(100):
        moved = np.array([0.02 * way[min(n, 10)]])
        response.add(period * n, moved, moved, 0.01)
    assert not response.known()[0]


@pytest.mark.parametrize(
    ('late', 'slope', 'wrong'), [(0, 0.5, 1), (24, 0.5, 1), (26, 0.5, None), (0, 4.0, 1), (0, 5.1, None)]
)
def test_one_fit_is_enough_beside_a_right_joint(late: int, slope: float, wrong: int | None) -> None:
    """The second joint moves by ``slope`` of its offset, ``late`` periods after the first by all of its own."""
    response, joints = JointResponse(2), []
    for n in range(130):
        offsets = 0.02 * np.clip(np.array([n - 50, n - 50 - late]) / 10, 0.0, 1.0)
        joints.append(response.add(0.02 * n, offsets * (1.0, slope), offsets, 0.01))
    assert next((joint for joint in joints if joint is not None), None) == wrong


def test_a_fit_of_more_than_a_minute_begins_anew() -> None:
    """A controller that adds half of an offset, after one that added all of it: a fit of both would say more."""
    response, slopes = JointResponse(1), []
    response.begin(np.zeros(1))
    for t in np.arange(0.0, 66.0, 0.02):
        first, later = 0.02 * np.clip([t - 1.0, t - 64.0], 0.0, 0.5)
        response.add(t, np.array([first + 0.5 * later]), np.array([first + later]), 0.01)
        slopes.append(response.slopes[0])
    assert slopes[150] == pytest.approx(1.0, abs=1e-6)
    assert slopes[-1] == pytest.approx(0.5, abs=1e-6)


def test_an_arm_that_stands_still_is_not_asked_for_more(arm: Arm) -> None:
    """A protective stop: the offsets hold after ``follow_error``, and stay so until they are enabled again."""
    loop = following(arm)
    stopped = loop.plant.angles.copy()
    loop.plant.force = 2.0 * PAYLOAD
    at = loop.plant.end().deflection
    before = loop.offsets
    for n in range(300):
        now = loop.t + PERIOD * (n + 1)
        loop.compensator.joints(now, stopped)
        moved = Transform(at.rotation, at.position * (1.0 + 0.01 * min(n, 250)))
        loop.compensator.observe(now, Observed(now, moved, CERTAIN))
        command = loop.compensator.watch(now)
    assert command.state is State.HOLDING
    assert command.why == 'the joints do not move with the offsets'
    assert np.abs(command.offsets - before).max() < 0.01 + 0.1 * 2 * PERIOD
    loop.t = now
    loop.compensator.enable(True)
    assert loop.run(1.0).state is State.FOLLOWING


@pytest.mark.slow
@pytest.mark.parametrize('how', [{}, {'takeover': True}, {'output': 'commands'}], ids=repr)
def test_seldom_reporting_arm_is_still_following(arm: Arm, how: dict[str, Any]) -> None:
    loop = following(arm, stale=0.5, jump=1.0, **how)
    before = loop.offsets
    loop.plant.force = 4.0 * PAYLOAD
    loop.whys.clear()
    # Between two messages the offsets may move by 0.028; 0.01 from what the arm does is one that does not follow.
    command = loop.run(3.0, report_every=14)
    assert (command.state, loop.whys) == (State.FOLLOWING, {''})
    assert np.abs(command.offsets - before).max() > 0.02


@pytest.mark.slow
def test_what_the_controller_applies_is_where_it_begins(arm: Arm) -> None:
    """After a kill and a restart the controller still has the offsets of before, and nobody enabled the new one."""
    loop = following(arm)
    killed = loop.offsets.copy()
    loop.compensator = again = Compensator(arm, CompensatorSettings(axes=('x', 'z')))
    again.enable(True)
    assert loop.run(0.6).why == 'the controller does not tell the offsets that it applies'
    again.enable(False)
    loop.reports, count = True, len(loop.sent)
    assert loop.run(0.6).state is State.OFF
    assert len(loop.sent) == count
    again.enable(True)
    command = loop.run(1.2)
    assert np.array_equal(loop.sent[count][1], killed)
    assert loop.step() <= 1.0 + 1e-9
    assert command.state is State.FOLLOWING
    assert command.offsets == pytest.approx(killed, abs=1e-3)
    assert loop.error() == pytest.approx(command.residual, abs=1e-4)


def test_controller_with_other_offsets_is_sent_no_more(arm: Arm) -> None:
    loop = reporting(arm)
    before, count = loop.offsets, len(loop.sent)
    for n in range(1, 30):
        loop.compensator.joints(loop.t + PERIOD * n, loop.plant.angles)
        loop.compensator.controller_has(loop.t + PERIOD * n, before + 0.02)
        loop.compensator.observe(loop.t + PERIOD * n, observed(loop, t=loop.t + PERIOD * n))
        command = loop.send(loop.t + PERIOD * n)
        assert command.state is State.HOLDING
    assert 'is 0.02 from what it was sent' in command.why
    assert (len(loop.sent) - count) * PERIOD == pytest.approx(0.3, abs=1.1 * PERIOD)
    assert math.isnan(command.residual)
    # To go on is a decision of a person; it goes on from where the controller is, when the rate allows for that.
    loop.t, loop.offsets = loop.t + PERIOD * 30, before + 0.02
    assert loop.run(1.0).why == command.why
    loop.compensator.enable(True)
    assert loop.run(1.0).state is State.FOLLOWING
    assert loop.step() <= 1.0 + 1e-9


@pytest.mark.slow
def test_controller_restarted_at_zero_gets_no_step(arm: Arm) -> None:
    """It ends, so nothing is sent. It comes back with none, and is led from there to those that are needed."""
    loop = reporting(arm)
    needed = loop.offsets
    loop.reports = False
    assert loop.run(0.1).why == 'the controller does not tell the offsets that it applies'
    count = len(loop.sent)
    loop.run(0.2)
    assert len(loop.sent) == count
    loop.reports, loop.offsets = True, np.zeros(2)
    loop.run(2.0)
    assert not loop.sent[count][1].any()
    assert loop.offsets == pytest.approx(needed, abs=1e-3)
    assert loop.step() <= 1.0 + 1e-9


@pytest.mark.parametrize(('late', 'after'), [(0.9, State.FOLLOWING), (1.1, State.HOLDING)])
def test_a_robot_may_report_its_stop_a_second_late(arm: Arm, late: float, after: State) -> None:
    loop = Loop(arm, takeover=True, applies=0.0)
    loop.compensator.enable(True)
    loop.run(1.0)
    loop.plant.force = PAYLOAD
    assert loop.run(0.58).why == 'the joints do not move with the offsets'
    loop.run(late)
    loop.compensator.stop('the robot does not run')
    loop.run(0.3)
    loop.applies = 1.0
    loop.compensator.stop('')
    assert loop.run(3.0).state is after


def test_switch_off_in_silence_returns_offsets_later(arm: Arm) -> None:
    loop = reporting(arm)
    loop.reports = False
    loop.run(0.1)
    loop.compensator.enable(False)
    offsets, count = loop.offsets.copy(), len(loop.sent)
    assert offsets.any()
    assert loop.run(0.5).state is State.OFF
    assert len(loop.sent) == count
    assert np.array_equal(loop.offsets, offsets)
    loop.reports = True
    loop.compensator.stop(OTHER_PUBLISHER, other_publisher=True)
    loop.run(0.2)
    assert len(loop.sent) == count
    loop.compensator.stop('')
    assert loop.run(float(np.abs(offsets).max()) / 0.1 + 0.1).state is State.OFF
    assert not loop.offsets.any()
    assert loop.step() <= 1.0 + 1e-9
    count = len(loop.sent)
    loop.run(0.5)
    assert len(loop.sent) == count


def test_switch_off_while_robot_stands_returns_offsets(arm: Arm) -> None:
    loop = reporting(arm)
    loop.compensator.stop('the robot does not run')
    loop.reports = False
    loop.run(0.4)
    loop.compensator.enable(False)
    loop.reports = True
    assert np.any(loop.offsets)
    assert loop.run(float(np.abs(loop.offsets).max()) / 0.1 + 0.1).state is State.OFF
    assert not loop.offsets.any()
    assert loop.step() <= 1.0 + 1e-9


def test_controller_offsets_above_max_are_not_adopted(arm: Arm) -> None:
    loop = Loop(arm, takeover=True, max_offset=0.0625)
    loop.offsets = np.array([0.0, math.nextafter(0.0625, 1.0)])
    loop.compensator.enable(True)
    assert loop.run(1.0).why == 'the controller applies 0.0625 at elbow: beyond max_offset'
    assert not loop.sent
    loop.offsets = adopted = np.array([0.0, 0.0625])
    loop.run(PERIOD)
    assert np.array_equal(loop.sent[0][1], adopted)


def noisy(sd: float, step: float = 0.0) -> Callable[[FloatArray], FloatArray]:
    """Encoders with noise (rad) and steps."""
    noise = np.random.default_rng(1)

    def measured(angles: FloatArray) -> FloatArray:
        read = angles + noise.normal(size=len(angles)) * sd
        return np.round(read / step) * step if step else read

    return measured


@pytest.mark.slow
@pytest.mark.parametrize('how', [{}, {'takeover': True}, {'output': 'commands'}], ids=repr)
@pytest.mark.parametrize('encoder', [(0.0, 0.0), (1e-4, 0.0), (0.0, 3e-4), (2e-5, 1e-4)], ids=repr)
@pytest.mark.parametrize('applies', [-1.0, 0.0, 0.3, 0.7, 1.0, 1.35, 2.0])
def test_a_controller_of_another_sign_or_scale_holds(
    arm: Arm, applies: float, encoder: tuple[float, float], how: dict[str, Any]
) -> None:
    """It tells what it was sent, whatever it does."""
    loop = Loop(arm, applies=applies, **how)
    loop.measured = noisy(*encoder)
    loop.plant.force = PAYLOAD
    loop.run(0.4)
    loop.compensator.enable(True)
    command = loop.run(PERIOD)
    assert math.isnan(command.residual)
    command = loop.run(2.5)
    if applies == 1.0:
        assert (command.state, command.why) == (State.FOLLOWING, '')
        assert command.residual == pytest.approx(loop.error(), abs=1e-3)
    else:
        assert command.state is State.HOLDING
        assert math.isnan(command.residual)
        words = command.why.split()
        if 'of its offset' in command.why:
            slope, half_width = float(words[3]), float(words[5])
            assert slope == pytest.approx(applies, abs=half_width)
        else:
            assert applies == 0.0 or how.get('output') == 'commands'


@pytest.mark.parametrize(('applies', 'after'), [(1.09, State.FOLLOWING), (1.18, State.HOLDING)])
def test_until_offsets_move_the_joints_nothing_is_verified(arm: Arm, applies: float, after: State) -> None:
    loop = Loop(arm, takeover=True, applies=applies)
    loop.measured = noisy(1e-5)
    loop.compensator.enable(True)
    command = loop.run(3.0)
    assert (command.state, command.why) == (State.FOLLOWING, UNVERIFIED)
    assert math.isnan(command.residual)
    loop.plant.force = PAYLOAD
    assert loop.run(2.5).state is after


def test_a_controller_that_changes_its_scale_holds(arm: Arm) -> None:
    loop = reporting(arm)
    assert loop.run(1.0).why == ''
    loop.applies = 1.5
    loop.run(1.0)
    loop.plant.force = -PAYLOAD
    loop.run(4.0)
    loop.plant.force = PAYLOAD
    command = loop.run(4.0)
    assert 'of its offset, must be 1' in command.why
    assert math.isnan(command.residual)


def test_joints_are_not_blamed_for_offsets_on_their_way(arm: Arm) -> None:
    """Offsets move for 60 ms, then no deflection comes; the controller has the offsets half a second later."""
    loop = reporting(arm)
    for n in range(6):
        loop.plant.force = PAYLOAD * (0.5 + 0.5 * (n % 2))
        before = loop.offsets
        for period in range(28):
            loop.t += PERIOD
            loop.plant.step(ELBOW + before, PERIOD)
            loop.compensator.joints(loop.t, loop.plant.angles)
            loop.compensator.controller_has(loop.t, before)
            if period < 3:
                loop.compensator.observe(loop.t, observed(loop, t=loop.t))
            loop.whys.add(loop.send(loop.t).why)
        assert np.abs(loop.offsets - before).max() > 1e-3
        assert not loop.compensator.response.candidates
        loop.run(2.2)
    assert not [why for why in loop.whys if 'of its offset' in why]


@pytest.mark.slow
@pytest.mark.parametrize('delayed', [0.0, 0.02, 0.3])
def test_an_arm_that_moves_by_itself_is_not_blamed(arm: Arm, delayed: float) -> None:
    """Motions begin with the loads that they cause, of all sizes; then the slope is as it was."""
    loop = reporting(arm)
    rng, at = np.random.default_rng(7), ELBOW
    for n in range(20):
        to = at + rng.normal(size=2) * rng.choice([0.03, 0.1, 0.5])
        begun = loop.t
        while loop.t < begun + 1.0:
            share = min((loop.t - begun) / 0.6, 1.0)
            if loop.t - begun >= delayed:
                loop.plant.force = PAYLOAD * (0.7 + 0.3 * math.cos(n))
            loop.run(PERIOD, at + (to - at) * share**2 * (3.0 - 2.0 * share))
        at = to
    assert not [why for why in loop.whys if 'of its offset' in why]


def test_with_commands_the_arm_keeps_the_pose_that_it_had(arm: Arm) -> None:
    loop = Loop(arm, output='commands')
    compensator = loop.compensator
    loop.plant.force = PAYLOAD
    assert loop.run(0.2).positions is None
    compensator.enable(True)
    command = loop.run(2.0)
    assert command.positions is not None
    assert (command.state, command.limited) == (State.FOLLOWING, False)
    assert command.residual < 1e-4
    assert command.positions == pytest.approx(ELBOW + command.offsets, abs=1e-9)
    assert loop.step() <= 1.0 + 1e-9


@pytest.mark.slow
@pytest.mark.parametrize('droop', [0.0, 0.005])
def test_commands_start_at_controller_command(arm: Arm, droop: float) -> None:
    """However far the servos leave the joints below it, and however often it is enabled."""
    loop = Loop(arm, output='commands')
    loop.droop = droop
    loop.plant.force = PAYLOAD
    for _ in range(5):
        loop.run(0.4)
        before, count = loop.has, len(loop.sent)
        loop.compensator.enable(True)
        loop.run(0.6)
        assert np.array_equal(loop.sent[count][1], before)
        loop.compensator.enable(False)
        loop.run(0.4)
        assert loop.has == pytest.approx(ELBOW, abs=1e-12)
    assert loop.step() <= 1.0 + 1e-9


@pytest.mark.parametrize('disabled', [True, False])
def test_offsets_in_a_command_outlast_silence(arm: Arm, disabled: bool) -> None:
    """A controller that tells nothing for a while keeps them: that is said, and they are not taken for its pose."""
    loop = Loop(arm, output='commands')
    loop.plant.force = PAYLOAD
    loop.run(0.4)
    loop.compensator.enable(True)
    loop.run(0.6)
    loop.reports, held = False, loop.has - ELBOW
    assert np.abs(held).max() > 1e-3
    if disabled:
        loop.run(0.2)
        loop.compensator.enable(False)
        command = loop.run(0.4)
        assert (command.state, command.foreign, command.sends) == (State.OFF, True, False)
        assert 'the command of the controller keeps ' in command.why
    else:
        loop.run(0.6)
    np.testing.assert_allclose(loop.compensator.remaining_offsets, loop.has - ELBOW, atol=1e-12)
    loop.reports = True
    if not disabled:
        assert loop.run(1.0).state is State.FOLLOWING
        assert loop.error() < 1e-4
        loop.compensator.enable(False)
    command = loop.run(0.6)
    assert loop.has == pytest.approx(ELBOW, abs=1e-12)
    assert (command.state, command.foreign) == (State.OFF, False)
    assert loop.step() <= 1.0 + 1e-9


def test_a_command_of_somebody_else_keeps_nothing_from_here(arm: Arm) -> None:
    loop = Loop(arm, output='commands')
    loop.plant.force = PAYLOAD
    loop.compensator.enable(True)
    loop.run(1.0)
    loop.reports = False
    loop.compensator.enable(False)
    loop.run(0.2)
    loop.reports, loop.has, count = True, ELBOW + 0.02, len(loop.sent)
    command = loop.run(0.6, ELBOW + 0.02)
    assert (command.state, command.foreign, len(loop.sent)) == (State.OFF, False, count)
    assert not loop.compensator.remaining_offsets.any()


@pytest.mark.parametrize('output', ['commands', 'offsets'])
def test_a_report_older_than_the_last_command_begins_nothing(arm: Arm, output: str) -> None:
    """Enabled right after a release, it would begin there, and creep by as much each time."""
    loop = Loop(arm, output=output, takeover=True)
    loop.plant.force = PAYLOAD
    loop.run(0.4)
    loop.compensator.enable(True)
    loop.run(0.6)
    loop.compensator.enable(False)
    while loop.run(PERIOD).state is not State.OFF:
        pass
    (_, before), (_, last) = loop.sent[-2:]
    assert np.abs(before - last).max() > 1e-5
    loop.t += PERIOD
    loop.compensator.controller_has(loop.t, before)
    loop.compensator.enable(True)
    command = loop.send(loop.t)
    assert (command.sends, command.why) == (False, 'the controller does not yet report what it was sent last')
    count = len(loop.sent)
    loop.run(0.2)
    assert np.array_equal(loop.sent[count][1], last)


@pytest.mark.parametrize(
    ('reports', 'away', 'why'),
    [(False, 0.0, 'does not tell the command that it has'), (True, 0.05, 'is 0.05 from the command of the controller')],
)
def test_with_commands_an_unknown_or_far_command_is_rejected(arm: Arm, reports: bool, away: float, why: str) -> None:
    loop = Loop(arm, output='commands')
    loop.reports, loop.droop = reports, away
    loop.compensator.enable(True)
    command = loop.run(1.0)
    assert (command.state, command.sends, loop.sent) == (State.HOLDING, False, [])
    assert why in command.why


def test_earlier_offsets_are_removed_on_request_only(arm: Arm) -> None:
    loop = following(arm)
    held = loop.offsets.copy()
    loop.compensator, loop.reports, count = Compensator(arm, CompensatorSettings(axes=('x', 'z'))), True, len(loop.sent)
    command = loop.run(0.6)
    worst = int(np.abs(held).argmax())
    assert (command.state, command.foreign, len(loop.sent)) == (State.OFF, True, count)
    assert command.why == f'the controller applies {held[worst]:.3g} at {arm.names[worst]}, which is not sent from here'
    assert np.array_equal(loop.compensator.remaining_offsets, held)
    loop.compensator.enable(False)
    command = loop.run(float(np.abs(held).max()) / 0.1 + 0.6)
    assert not loop.offsets.any()
    assert not command.foreign
    assert loop.step() <= 1.0 + 1e-9


def test_commands_hold_for_stopped_or_moved_arm(arm: Arm) -> None:
    """Commands of before would move it back at once when its controller runs again."""
    loop = Loop(arm, output='commands')
    loop.plant.force = PAYLOAD
    loop.compensator.enable(True)
    before = loop.run(1.0).offsets
    stopped, start = loop.plant.angles + 0.03, loop.t
    for n in range(1, 40):
        loop.t = start + PERIOD * n
        loop.compensator.joints(loop.t, stopped)
        loop.compensator.controller_has(loop.t, loop.has)
        loop.compensator.observe(loop.t, observed(loop, t=loop.t))
        command = loop.send(loop.t)
        assert np.array_equal(command.offsets, before) or not command.sends
    assert command.state is State.HOLDING
    assert 'is 0.03 from what it was sent' in command.why
    assert not command.sends
    loop.compensator.enable(False)
    assert loop.send(loop.t + PERIOD).state is State.OFF
    assert loop.step() <= 1.0 + 1e-9


@pytest.mark.parametrize('why', ['the robot does not run', 'another node publishes /compensator/offsets'])
def test_it_holds_while_it_is_stopped(arm: Arm, why: str) -> None:
    loop = following(arm)
    before = loop.offsets
    loop.compensator.stop(why)
    command = loop.run(0.5)
    assert (command.state, command.why) == (State.HOLDING, why)
    assert np.array_equal(command.offsets, before)
    loop.compensator.stop('')
    assert loop.send(loop.t + 1.0).why == 'no deflection for 0.08 s'
    assert loop.run(0.6).state is State.FOLLOWING


NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True), st.floats(-1.0, 1.0), st.sampled_from([0.0, 1e300, 5e-324, -1e308])
)
EVENT = st.one_of(
    st.tuples(st.just('joints'), st.tuples(NUMBERS, NUMBERS)),
    st.tuples(st.just('deflection'), st.tuples(NUMBERS, NUMBERS, NUMBERS)),
    st.tuples(st.just('covariance'), NUMBERS),
    st.tuples(st.just('age'), NUMBERS),
    st.tuples(st.just('applied'), st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))),
    st.tuples(st.just('enable'), st.booleans()),
    st.tuples(st.just('stop'), st.sampled_from(['', 'the robot does not run', OTHER_PUBLISHER])),
    st.tuples(st.just('pause'), st.floats(-1.0, 5.0)),
    st.tuples(st.just('clock'), st.floats(-1e5, 1e5)),
    st.tuples(st.just('late'), st.floats(0.0, 0.5)),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(EVENT, max_size=30), st.sampled_from(['offsets', 'commands']), st.booleans())
def test_whatever_comes_no_step_is_larger_than_the_rate_allows(
    events: list[tuple[str, Any]], output: str, takeover: bool
) -> None:
    arm = read_arm(EXAMPLE.with_suffix('.urdf'), 'tool')
    good = CompensatorSettings(axes=('x', 'z'), output=output, good=2, takeover=takeover)
    compensator = Compensator(arm, good)
    compensator.enable(True)
    now, clock, has = 0.0, 0.0, ELBOW if output == 'commands' else np.zeros(2)
    sent: list[tuple[float, FloatArray]] = []
    good_ones: list[tuple[str, Any]] = [('good', None)] * 3
    for kind, value in [item for event in events for item in (event, *good_ones)]:
        now += 0.02
        late = 0.0
        age, covariance, deflection, joints, applied = 0.0, CERTAIN, shift(1e-3, 0.0, 2e-3), ELBOW, has
        with np.errstate(over='ignore', invalid='ignore'):
            if kind == 'enable':
                compensator.enable(value)
            elif kind == 'stop':
                compensator.stop(value, other_publisher=value == OTHER_PUBLISHER)
            elif kind == 'pause':
                now += max(value, 0.0)
            elif kind == 'clock':
                clock += value
            elif kind == 'late':
                late = value
            elif kind == 'applied':
                applied = has = np.array(value)
            elif kind == 'joints':
                joints = np.array(value)
            elif kind == 'deflection':
                deflection = shift(*value)
            elif kind == 'covariance':
                covariance = np.eye(6) * value
            elif kind == 'age':
                age = value
            compensator.joints(now, joints)
            compensator.controller_has(now, applied)
            compensator.observe(now, Observed(now + clock, deflection, covariance, age))
            command = compensator.watch(now)
        if command.sends:
            has = command.offsets if command.positions is None else command.positions
            now += late
            sent.append((now, has))
            compensator.sent(now, command)
    assert largest_step([t for t, _ in sent], [v for _, v in sent], 0.1) <= 1.0 + 1e-6
