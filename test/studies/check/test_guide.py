# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The guide at the bench: pushes are seen without a key, however clumsy the hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from psd_deflection.base.errors import DeviceError
from psd_deflection.base.log import null_log, texts
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig, rig_from_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.run.guided import run_guided
from psd_deflection.studies.check.checkup import CheckProblem, check
from psd_deflection.studies.check.guide import Guide, Phase, directions
from psd_deflection.studies.check.result import RIGHT, WRONG, Checkup, levels
from psd_deflection.studies.check.wirings import WIRINGS, parameters

BLOCK = 20


class Bench:
    """A rig (``world``) and a hand: ``tremor`` is its unsteadiness, a share of the push."""

    def __init__(self, world: Rig, seed: int, tremor: float = 0.05) -> None:
        self._rig = RigSimulator(world, seed)
        self._chance = np.random.default_rng(seed)
        self._tremor = tremor
        self._volts_per_count = world.converter.volts_per_count

    def block(self, load: FloatArray) -> FloatArray:
        shaken = load * (1.0 + self._tremor * self._chance.standard_normal())
        counts = self._rig.step(np.tile(shaken, (BLOCK, 1))).counts
        return (counts * self._volts_per_count).astype(np.float32).astype(np.float64)


def led(known: Rig, bench: Bench, hand: tuple[FloatArray, ...], most: float = 60.0) -> tuple[Guide, list[str]]:
    """The guide after all pushes; the hand takes a third of a second to do what it reads."""
    guide = Guide(known)
    message: list[str] = []
    now, wanted = np.zeros(3), np.zeros(3)
    late: list[FloatArray] = [np.zeros(3)] * 16
    for _ in range(round(most * 50)):
        if guide.phase is Phase.DONE:
            break
        wanted = hand[guide.number] if guide.phase is Phase.PUSH else np.zeros(3)
        late.append(wanted)
        now = late.pop(0)
        message.append(guide.feed(bench.block(now)))
    return guide, [text for text in message if text]


def hand_of(rig: Rig, size: float, clumsy: float = 0.0) -> tuple[FloatArray, ...]:
    """Loads that move a dot by ``size`` m; ``clumsy``: the share that goes astray. A turn shifts the tip as well."""
    to_load = 1.0 / np.diag(LinkStatics.from_rig(rig).compliance)
    x, y, rotation = np.array([size, clumsy * size, 0.0]), np.array([-clumsy * size, size, 0.0]), size / 0.07
    twist = np.array([5.0 * clumsy * size, -5.0 * clumsy * size, rotation])
    return x * to_load, y * to_load, twist * to_load


def verdict(known: Rig, guide: Guide) -> Checkup:
    return check(CheckProblem(known, guide.pushes, levels(known, guide.rest()), *guide.drift()))


@pytest.mark.slow
@pytest.mark.parametrize('number', range(0, 128, 18))
@pytest.mark.parametrize('clumsy', [math.tan(math.radians(20.0))])
def test_a_wiring_is_named_by_hand(number: int, clumsy: float) -> None:
    wiring, known = WIRINGS[number], load_rig()
    world = rig_from_values(parameters(wiring, Wiring()))
    guide, message = led(known, Bench(world, number), hand_of(known, 0.2e-3, clumsy))
    assert guide.phase is Phase.DONE
    assert sum(text.startswith('Got it: ') for text in message) == 3
    checkup = verdict(known, guide)
    assert (checkup.verdict, dict(checkup.values)) == (WRONG if number else RIGHT, parameters(wiring, Wiring()))
    # A hand's turn shifts the tip, so exchanged PSDs look like a turn the other way; that is said.
    if wiring == Wiring(exchanged=True):
        assert checkup.findings[0].equivalent == ('load_sign of tz',)


def test_a_turn_the_other_way_is_reported_beside_exchanged_psds() -> None:
    known = load_rig()
    x, y, rotation = hand_of(known, 0.2e-3, 0.1)
    guide, _ = led(known, Bench(known, 1), (x, y, -rotation))
    checkup = verdict(known, guide)
    assert ([f.name for f in checkup.findings], checkup.findings[0].equivalent) == (['psd_swap'], ('load_sign of tz',))


MICRO = 1e-6
WAIT = 500
"""Blocks of ten seconds."""


class Fed:
    """A guide that gets blocks whose dots are told, m; ``message``: what it answered to each."""

    def __init__(self, known: Rig | None = None) -> None:
        self.known = known or load_rig()
        self.guide = Guide(self.known)
        self.message: list[str] = []

    def feed(self, dots: tuple[float, float, float, float], blocks: int = 1, shaking: float = 0.0) -> list[str]:
        """``blocks`` at these ``dots``; ``shaking``: one after the other to either side of it on y1, m."""
        volts = np.full((BLOCK, 6), 5.0)
        answers = []
        for _ in range(blocks):
            side = shaking if len(self.message) % 2 else -shaking
            moved = np.add(dots, (0.0, side, 0.0, 0.0))
            volts[:, [0, 1, 3, 4]] = moved / self.known.amplifier.sensitivity
            answers.append(self.guide.feed(volts.copy()))
            self.message.append(answers[-1])
        return answers

    def at(self, phase: Phase, progress: float | None = None) -> bool:
        """Whether that is waited for, and so far."""
        reached = self.guide.progress
        return self.guide.phase is phase and (progress is None or math.isclose(reached, progress, abs_tol=1e-9))

    def rested(self, shaking: float = 0.0) -> Fed:
        """After the first rest, two seconds of it."""
        self.feed(NOTHING, 100, shaking)
        assert self.at(Phase.PUSH)
        return self


NOTHING = (0.0, 0.0, 0.0, 0.0)
FAR = (0.0, 300 * MICRO, 0.0, -400 * MICRO)
"""Half a millimetre away."""


def test_rest_takes_2_s_and_push_and_release_0_6_s() -> None:
    fed = Fed()
    guide = fed.guide
    assert fed.at(Phase.REST, 0.0)
    assert (guide.number, guide.pushes) == (0, [])
    assert (guide.moved.tolist(), guide.prompt()) == ([0.0] * 4, 'Leave the link alone.')
    for number in range(1, 100):
        fed.feed(NOTHING)
        assert fed.at(Phase.REST, number / 100)
    fed.feed(NOTHING)
    assert fed.at(Phase.PUSH, 0.0)
    for number, name in enumerate(('Push the tip along +X', 'Push the tip along +Y', 'Turn the tip'), start=1):
        assert guide.number == number - 1
        assert guide.prompt().startswith(f'{number} of 3: {name}')
        for held in range(1, 30):
            fed.feed(FAR)
            assert fed.at(Phase.PUSH, held / 30)
        assert guide.moved == pytest.approx(np.array(FAR))
        assert fed.feed(FAR) == ['Got it: x1 +0, y1 +300, x2 +0, y2 -400 µm.']
        assert fed.at(Phase.RELEASE, 0.0)
        assert guide.prompt() == 'Let go.'
        for back in range(1, 30):
            fed.feed(NOTHING)
            assert fed.at(Phase.RELEASE, back / 30)
        fed.feed(NOTHING)
        assert len(guide.pushes) == number
    assert fed.at(Phase.DONE)
    assert (guide.number, guide.prompt()) == (3, 'Done.')
    assert (fed.feed(FAR), [p.loads for p in guide.pushes]) == ([''], [('fx',), ('fy',), ('tz',)])
    assert [p.only_twist for p in guide.pushes] == [False, False, True]
    assert not any(p.sized for p in guide.pushes)
    assert [p.expected.tolist() for p in guide.pushes] == [[-1, 0, -1, 0], [0, -1, 0, -1], [0.07, 0, 0, 0.1]]


def test_pieces_of_any_length_count_by_their_samples() -> None:
    fed = Fed()
    volts = np.full((1990, 6), 5.0)
    fed.guide.feed(volts)
    assert fed.at(Phase.REST, 0.995)
    fed.guide.feed(volts[:10])
    assert fed.at(Phase.PUSH)
    assert len(fed.guide.rest()) == 2000
    # The oldest pieces go as soon as the others are enough.
    moving = Fed()
    moving.feed((0.0, 0.0, 0.0, 50 * MICRO), 30)
    moving.feed(NOTHING, 99)
    assert moving.at(Phase.REST)
    moving.feed(NOTHING)
    assert moving.at(Phase.PUSH)
    assert len(moving.guide.rest()) == 2000


@pytest.mark.parametrize(('shaking', 'rests'), [(1.10 * MICRO, True), (1.14 * MICRO, False)])
def test_rest_motion_limit_is_five_times_block_noise(shaking: float, rests: bool) -> None:
    # 2 mV are 1 um a sample; of a block of 20 five deviations are 1.118 um.
    fed = Fed()
    message = fed.feed(NOTHING, WAIT - 1, shaking)
    assert fed.at(Phase.REST) is not rests
    if not rests:
        assert fed.guide.progress == 0.0
        assert not any(message)
        assert fed.feed(NOTHING, 2, shaking).count('It still moves by 1.1 µm rms: leave it alone.') == 1
        # Once in ten seconds, and after half a minute it is taken as it is.
        assert fed.feed(NOTHING, WAIT - 2, shaking) == [''] * (WAIT - 2)
        assert fed.feed(NOTHING, 4, shaking).count('It still moves by 1.1 µm rms: leave it alone.') == 1
        fed.feed(NOTHING, WAIT - 4, shaking)
        assert fed.at(Phase.REST)
        fed.feed(NOTHING, 3, shaking)
        assert fed.at(Phase.PUSH)


def test_rest_motion_limit_is_at_least_a_tenth_of_push() -> None:
    quiet = load_rig(overrides={'amplifier.noise': 1e-5})
    for shaking, rests in ((0.99 * MICRO, True), (1.01 * MICRO, False)):
        fed = Fed(quiet)
        fed.feed(NOTHING, 110, shaking)
        assert fed.at(Phase.PUSH) is rests


@pytest.mark.slow
@pytest.mark.parametrize(
    ('shaking', 'size', 'taken'),
    [
        # Ten micrometres at least,
        (0.0, 9.9, False),
        (0.0, 10.1, True),
        # or ten times as far as the dots wander at rest: 1 um on y1, the noise of two seconds, 0.224 um, on the others.
        (1.0, 10.7, False),
        (1.0, 10.8, True),
    ],
)
def test_a_push_stands_out_of_the_rest(shaking: float, size: float, taken: bool) -> None:
    assert 10.0 * math.sqrt(1.0 + 3.0 * 0.2236**2) == pytest.approx(10.724, abs=1e-3)
    fed = Fed().rested(shaking * MICRO)
    message = fed.feed((size * MICRO, 0.0, 0.0, 0.0), WAIT + 1)
    assert fed.at(Phase.RELEASE) is taken
    if not taken:
        assert fed.guide.progress == 0.0
        assert [text for text in message if text] == [f'No push yet: the dots have moved by {size:.1f} µm.']
        assert message[WAIT - 2] == ''


@pytest.mark.parametrize(('shaking', 'taken'), [(149.0, True), (151.0, False)])
def test_push_is_held_if_it_moves_below_three_tenths(shaking: float, taken: bool) -> None:
    message = Fed().rested().feed(FAR, WAIT + 1, shaking * MICRO)
    assert any(text.startswith('Got it') for text in message) is taken
    assert ('Hold it steadier.' in message) is not taken


def test_dot_at_range_end_is_reported_though_held() -> None:
    # Two counts below 10 V are the end; half a millimetre is a volt.
    step = 20.0 / 2**16
    for volt, ends in ((10.0 - 2.0 * step, True), (10.0 - 2.5 * step, False)):
        message = Fed().rested().feed((0.0, 0.0, -volt * 5e-4, 0.0), WAIT + 1)
        assert ('A dot is at the end of its PSD: push less.' in message) is ends
        assert any(text.startswith('Got it') for text in message) is not ends


@pytest.mark.parametrize(
    ('size', 'shaking', 'free'), [(74.0, 0.0, True), (76.0, 0.0, False), (0.0, 74.0, True), (0.0, 76.0, False)]
)
def test_a_push_is_let_go_within_a_seventh_of_it(size: float, shaking: float, free: bool) -> None:
    # Half a millimetre: 0.15 of it are 75 um.
    fed = Fed().rested()
    fed.feed(FAR, 30)
    message = fed.feed((0.0, 0.0, size * MICRO, 0.0), 30, shaking * MICRO)
    assert len(fed.guide.pushes) == free
    if not free:
        assert fed.guide.progress == 0.0
        message += fed.feed((0.0, 0.0, size * MICRO, 0.0), WAIT - 28, shaking * MICRO)
        assert [text for text in message if text] == ['Let go of the link.']


def test_a_push_is_relative_to_the_rests_around_it() -> None:
    fed = Fed().rested(MICRO)
    fed.feed(FAR, 30, 20 * MICRO)
    fed.feed((4 * MICRO, 0.0, 0.0, -6 * MICRO), 30)
    (taken,) = fed.guide.pushes
    assert taken.channels == pytest.approx([-2e-6, 300e-6, 0.0, -397e-6])
    # At rest y1 wandered by 1 um, the others by the noise, 1 um a sample, of 2000; y1 was held by 20 um, of 30 blocks.
    rest = 1e-6 * math.sqrt(100 * 1e-3 / 2.0)
    held = 20e-6 / math.sqrt(30.0)
    wanted = [math.hypot(rest, 2e-6), math.hypot(1e-6, held), rest, math.hypot(rest, 3e-6)]
    assert taken.sd == pytest.approx(wanted)
    # The next one is against that rest.
    fed.feed((4 * MICRO, 100 * MICRO, 0.0, -6 * MICRO), 30)
    assert fed.guide.moved == pytest.approx([0.0, 1e-4, 0.0, 0.0], abs=1e-12)
    fed.feed((4 * MICRO, 0.0, 0.0, -6 * MICRO), 30)
    assert fed.guide.pushes[1].channels == pytest.approx([0.0, 1e-4, 0.0, 0.0], abs=1e-12)
    assert fed.guide.pushes[1].sd == pytest.approx([rest, 1e-6, rest, rest])
    # From the first rest, at 2 s, to the last, at 4.4 s, with what handling may shift: 2 um.
    drift, sd = fed.guide.drift()
    assert drift == pytest.approx(np.array([4e-6, 0.0, 0.0, -6e-6]) / 2.4)
    assert sd == pytest.approx((np.array([rest, 1e-6, rest, rest]) + 2e-6) / 2.4)
    assert (fed.guide.rest().shape, fed.guide.rest()[:, 2].tolist()) == ((2000, 6), [5.0] * 2000)


def test_a_push_at_the_end_of_the_range_is_filled_and_no_more() -> None:
    fed = Fed().rested()
    volts = np.full((35, 6), 9.9999)
    for _ in range(30):
        assert fed.guide.feed(volts) == ''
    assert fed.at(Phase.PUSH, 1.0)


def test_one_rest_alone_has_no_drift() -> None:
    drift, sd = Fed().rested().guide.drift()
    assert drift.tolist() == [0.0] * 4
    # In the time of one sample.
    assert (sd > 1e-3).all()


def test_landmark_is_outermost_psd_along_axis() -> None:
    rig = load_rig(overrides={'psd_1.center': [0.03, -0.08], 'psd_2.center': [-0.02, 0.05]})
    first, second, _ = directions(rig)
    assert first == 'Push the tip along +X (towards the PSD at x 30 mm, y -80 mm) and hold it.'
    assert second == 'Push the tip along +Y (away from the PSD at x 30 mm, y -80 mm) and hold it.'


@pytest.mark.slow
def test_the_simulated_rig_and_hand_show_a_wrong_wiring() -> None:
    logged: list[str] = []
    shown: list[float] = []
    world = load_rig(overrides={'psd_1.axes': ['-y', 'x'], 'psds_exchanged': True})
    checkup = run_guided(load_rig(), world, texts(logged.append), lambda guide: shown.append(guide.progress))
    assert (checkup.verdict, dict(checkup.values)) == (WRONG, {'psds_exchanged': True, 'psd_1.axes': ['-y', 'x']})
    prompts = [text[:12] for text in logged if text.startswith(('Leave', '1 of', '2 of', '3 of', 'Let go'))]
    assert prompts == ['Leave the li', '1 of 3: Push', 'Let go.', '2 of 3: Push', 'Let go.', '3 of 3: Turn', 'Let go.']
    assert max(shown) > 0.9


@pytest.mark.slow
def test_a_port_where_nothing_is_is_rejected(tmp_path: Any) -> None:
    rig = load_rig(overrides={'port': str(tmp_path / 'nothing')})
    with pytest.raises(DeviceError, match='no such port'):
        run_guided(rig, rig, null_log, lambda guide: None)
