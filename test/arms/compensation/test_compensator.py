"""The offsets: what they reach, their limits, and when they hold."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.simulated_arm import SimulatedArm
from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.arms.chains.transform import IDENTITY, Transform, shift
from psd_deflection.arms.compensation.arm import Arm, read_arm
from psd_deflection.arms.compensation.compensator import Command, Compensator, CompensatorSettings, Observed, State
from psd_deflection.base.errors import ConfigError
from psd_deflection.records import FloatArray

HERE = Path(__file__).parent
EXAMPLE = HERE.parents[2] / 'config' / 'two_links.yaml'
PERIOD = 0.02
ELBOW = np.array([1.2, 0.6])
PAYLOAD = np.array([0.0, 0.0, -40.0])
CERTAIN = np.eye(6) * 1e-12


@pytest.fixture(scope='module')
def arm() -> Arm:
    return read_arm(EXAMPLE.with_suffix('.urdf'), 'tool')


class Loop:
    """A compensator that sees a simulated arm through estimates of noise; ``commands`` is what it said."""

    def __init__(self, arm: Arm, dry: bool = False, **chosen: float) -> None:
        given: dict[str, Any] = {'takeover': False, **chosen}
        self.compensator = Compensator(arm, CompensatorSettings(axes=('x', 'z'), **given), dry)
        self.plant = SimulatedArm(read_chain(EXAMPLE).chain, ELBOW, damping=0.1)
        self.offsets = np.zeros(2)
        self.dry = dry
        self.t = 0.0
        self.noise = np.random.default_rng(3)

    def run(self, seconds: float, wanted: FloatArray = ELBOW) -> Command:
        """Let the arm be moved to ``wanted`` at once, and the compensator act."""
        for _ in range(round(seconds / PERIOD)):
            self.t += PERIOD
            self.plant.step(wanted + (0.0 if self.dry else self.offsets), PERIOD)
            self.compensator.joints(self.t, self.plant.angles)
            at = self.plant.end().deflection
            noisy = Transform(at.rotation, at.position + self.noise.normal(size=3) * 1e-6)
            self.compensator.observe(self.t, Observed(self.t, noisy, CERTAIN))
            command = self.compensator.watch(self.t)
            self.offsets = command.offsets
        return command

    def error(self, wanted: FloatArray = ELBOW) -> float:
        """Distance of the end effector from where it would be if no link bent."""
        rigid = self.plant.chain.rigid(wanted.tolist())
        return float(np.linalg.norm(self.plant.end().deflected.position - rigid.position))


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
    # Elsewhere too, and without the payload.
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
        loop.compensator.enable(True)
        loop.run(1.6)
    assert dry.offsets == pytest.approx(wet.offsets, rel=0.05)
    assert dry.error() > 30 * wet.error()


def test_offsets_stay_within_their_limits(arm: Arm) -> None:
    loop = Loop(arm, max_offset=1e-3, max_rate=0.002)
    loop.plant.force = PAYLOAD
    loop.run(1.0)
    loop.compensator.enable(True)
    before = loop.offsets
    for _ in range(80):
        command = loop.run(PERIOD)
        assert np.abs(command.offsets - before).max() <= 0.002 * PERIOD * (1 + 1e-9)
        before = command.offsets
    assert np.abs(before).max() == pytest.approx(1e-3)
    assert command.limited


def test_a_joint_is_not_sent_beyond_its_limit(arm: Arm) -> None:
    loop = Loop(arm)
    loop.plant.force = PAYLOAD
    at_limit = np.array([-2.0, 0.3])
    loop.compensator.enable(True)
    loop.run(1.0, at_limit)
    assert loop.offsets[0] > -1e-4
    assert loop.plant.angles[0] > -2.0 - 1e-4


def following(arm: Arm) -> Loop:
    loop = Loop(arm)
    loop.plant.force = PAYLOAD
    loop.run(0.4)
    loop.compensator.enable(True)
    assert loop.run(0.6).state is State.FOLLOWING
    return loop


def seen(loop: Loop, **changed: object) -> Observed:
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
        ({'deflection': shift(0.0, 0.5, 0.0)}, 'a deflection of 0.5 is more than the links can have'),
        ({'deflection': shift(1e308, 0.0, 0.0)}, 'more than the links can have'),
        ({'age': 0.2}, 'older than 0.08 s'),
        ({'age': -0.2}, 'ahead of our clock'),
        ({'deflection': shift(0.1, 0.0, 0.0)}, 'jumps by'),
    ],
)
def test_a_bad_deflection_is_not_followed_and_good_ones_are_again(
    arm: Arm, changed: dict[str, object], why: str
) -> None:
    loop = following(arm)
    before = loop.offsets
    loop.t += PERIOD
    loop.compensator.joints(loop.t, loop.plant.angles)
    command = loop.compensator.observe(loop.t, seen(loop, **{'t': loop.t, **changed}))
    assert command.state is State.HOLDING
    assert why in command.why
    assert np.array_equal(command.offsets, before)
    command = loop.run(PERIOD * 20)
    assert command.state is State.HOLDING
    assert np.array_equal(command.offsets, before)
    assert loop.run(PERIOD * 10).state is State.FOLLOWING


@pytest.mark.parametrize('lost', ['deflection', 'joints'])
def test_it_holds_within_a_tenth_of_a_second_of_the_last_word(arm: Arm, lost: str) -> None:
    loop = following(arm)
    before = loop.offsets
    for n in range(1, 11):
        now = loop.t + 0.01 * n
        if lost == 'joints':
            command = loop.compensator.observe(now, seen(loop, t=now))
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


def test_what_the_controller_applies_is_where_it_begins(arm: Arm) -> None:
    """After a restart: the controller still has the offsets of before."""
    loop = following(arm)
    applied = loop.offsets.copy()
    loop.compensator = again = Compensator(arm, CompensatorSettings(axes=('x', 'z')))
    again.enable(True)
    assert loop.run(0.6).why == 'the controller has not told the offsets that it applies'
    assert again.waits
    again.enable(False)
    loop.offsets = applied.copy()
    again.applied(applied)
    # Nobody has enabled it, so it is silent, whatever the controller has.
    assert again.watch(loop.t).state is State.OFF
    again.enable(True)
    assert np.array_equal(again.watch(loop.t).offsets, applied)
    for _ in range(60):
        again.applied(loop.offsets)
        before = loop.offsets
        command = loop.run(PERIOD)
        assert np.abs(command.offsets - before).max() <= 0.1 * PERIOD * 1.001
    assert command.state is State.FOLLOWING
    assert command.offsets == pytest.approx(applied, abs=1e-3)
    # It applies something else: nobody knows why, so the offsets hold.
    for _ in range(30):
        again.applied(np.zeros(2))
        command = loop.run(PERIOD)
    assert command.state is State.HOLDING
    assert 'from what it was sent' in command.why


def test_with_commands_the_arm_keeps_the_pose_that_it_had(arm: Arm) -> None:
    loop = Loop(arm, output='commands')  # type: ignore[arg-type]
    compensator = loop.compensator
    loop.plant.force = PAYLOAD
    loop.run(0.2)
    assert compensator.commands() is None
    compensator.enable(True)
    asked = ELBOW
    for _ in range(100):
        before = asked
        command = loop.run(PERIOD)
        commanded = compensator.commands()
        assert commanded is not None
        asked = commanded
        assert np.abs(asked - before).max() <= 0.1 * PERIOD * 1.001
    assert command.state is State.FOLLOWING
    assert command.residual < 1e-4
    assert asked == pytest.approx(ELBOW + command.offsets, abs=1e-9)
    # The arm stops: it is seen at once that the joints are elsewhere.
    stopped = loop.plant.angles + 0.03
    for n in range(40):
        compensator.joints(loop.t + PERIOD * n, stopped)
        compensator.observe(loop.t + PERIOD * n, Observed(loop.t + PERIOD * n, loop.plant.end().deflection, CERTAIN))
        command = compensator.watch(loop.t + PERIOD * n)
    assert command.state is State.HOLDING
    assert 'is 0.03 from what it was sent' in command.why


@pytest.mark.parametrize('why', ['the robot does not run', 'another node publishes /compensator/offsets'])
def test_it_holds_while_it_is_stopped(arm: Arm, why: str) -> None:
    loop = following(arm)
    before = loop.offsets
    loop.compensator.stop(why)
    command = loop.run(0.5)
    assert (command.state, command.why) == (State.HOLDING, why)
    assert np.array_equal(command.offsets, before)
    loop.compensator.stop('')
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
    st.tuples(st.just('stop'), st.sampled_from(['', 'the robot does not run'])),
    st.tuples(st.just('pause'), st.floats(-1.0, 5.0)),
)


@settings(max_examples=300, deadline=None)
@given(st.lists(EVENT, max_size=30), st.sampled_from(['offsets', 'commands']))
def test_whatever_comes_no_step_is_larger_than_the_rate_allows(events: list[tuple[str, Any]], output: str) -> None:
    arm = read_arm(EXAMPLE.with_suffix('.urdf'), 'tool')
    good = CompensatorSettings(axes=('x', 'z'), output=output, good=2)
    compensator = Compensator(arm, good)
    compensator.enable(True)
    now, sent, began = 0.0, None, False
    good_ones: list[tuple[str, Any]] = [('good', None)] * 3
    for kind, value in [one for event in events for one in (event, *good_ones)]:
        then = now
        now += 0.02
        age, covariance, deflection, joints = 0.0, CERTAIN, shift(1e-3, 0.0, 2e-3), ELBOW
        with np.errstate(over='ignore', invalid='ignore'):
            if kind == 'enable':
                compensator.enable(value)
            elif kind == 'stop':
                compensator.stop(value)
            elif kind == 'pause':
                now += max(value, 0.0)
            elif kind == 'applied':
                compensator.applied(np.array(value))
            elif kind == 'joints':
                joints = np.array(value)
            elif kind == 'deflection':
                deflection = shift(*value)
            elif kind == 'covariance':
                covariance = np.eye(6) * value
            elif kind == 'age':
                age = value
            compensator.joints(now, joints)
            compensator.observe(now, Observed(now, deflection, covariance, age))
            command = compensator.watch(now)
        assert np.all(np.isfinite(command.offsets))
        # Silent, it may be told where the controller is.
        if sent is not None and began:
            assert np.abs(command.offsets - sent).max() <= 0.1 * (now - then) * (1.0 + 1e-9)
        began = command.state is not State.OFF and not compensator.waits
        sent = command.offsets
