"""The guide at the bench: pushes are seen without a key, however clumsy the hand."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig, rig_from_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.checkup import CheckProblem, check
from psd_deflection.studies.check.guide import Guide, Phase, directions
from psd_deflection.studies.check.levels import levels
from psd_deflection.studies.check.result import RIGHT, WRONG, Checkup
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
    said: list[str] = []
    now, wanted = np.zeros(3), np.zeros(3)
    late: list[FloatArray] = [np.zeros(3)] * 16
    for _ in range(round(most * 50)):
        if guide.phase is Phase.DONE:
            break
        wanted = hand[guide.number] if guide.phase is Phase.PUSH else np.zeros(3)
        late.append(wanted)
        now = late.pop(0)
        said.append(guide.feed(bench.block(now)))
    return guide, [text for text in said if text]


def hand_of(rig: Rig, size: float, clumsy: float = 0.0) -> tuple[FloatArray, ...]:
    """Loads that move a dot by ``size`` m; ``clumsy``: the share that goes astray. A turn shifts the tip as well."""
    to_load = 1.0 / np.diag(LinkStatics.from_rig(rig).compliance)
    x, y, turn = np.array([size, clumsy * size, 0.0]), np.array([-clumsy * size, size, 0.0]), size / 0.07
    twist = np.array([5.0 * clumsy * size, -5.0 * clumsy * size, turn])
    return x * to_load, y * to_load, twist * to_load


def verdict(known: Rig, guide: Guide) -> Checkup:
    return check(CheckProblem(known, guide.pushes, levels(known, guide.rest()), *guide.drift()))


@pytest.mark.parametrize('number', range(0, 128, 9))
@pytest.mark.parametrize('clumsy', [0.0, 0.3])
def test_a_wiring_is_named_by_hand(number: int, clumsy: float) -> None:
    wiring, known = WIRINGS[number], load_rig()
    world = rig_from_values(parameters(wiring, Wiring()))
    guide, said = led(known, Bench(world, number), hand_of(known, 0.2e-3, clumsy))
    assert guide.phase is Phase.DONE
    assert sum(text.startswith('Got it: ') for text in said) == 3
    found = verdict(known, guide)
    assert found.verdict == (WRONG if number else RIGHT)
    assert dict(found.values) == parameters(wiring, Wiring())
    # A hand's turn shifts the tip, so exchanged PSDs look like a turn the other way; that is said.
    if wiring == Wiring(exchanged=True):
        assert found.findings[0].equivalent == ('load_sign of tz',)


def test_a_turn_the_other_way_is_told_beside_exchanged_psds() -> None:
    known = load_rig()
    x, y, turn = hand_of(known, 0.2e-3, 0.1)
    guide, _ = led(known, Bench(known, 1), (x, y, -turn))
    found = verdict(known, guide)
    assert [f.name for f in found.findings] == ['psd_swap']
    assert found.findings[0].equivalent == ('load_sign of tz',)


def test_a_push_that_is_too_small_or_too_shaky_is_not_taken_and_said() -> None:
    known = load_rig()
    guide, said = led(known, Bench(known, 2), hand_of(known, 2e-6), most=30.0)
    assert (guide.phase, guide.number) == (Phase.PUSH, 0)
    assert any(text.startswith('No push yet: the dots have moved by') for text in said)
    guide, said = led(known, Bench(known, 3, tremor=1.0), hand_of(known, 0.2e-3), most=30.0)
    assert not guide.pushes
    assert 'Hold it steadier.' in said


def test_a_link_that_is_not_let_go_is_waited_for() -> None:
    known = load_rig()
    bench, guide = Bench(known, 4), Guide(known)
    push, _, _ = hand_of(known, 0.2e-3)
    said = [guide.feed(bench.block(np.zeros(3))) for _ in range(150)]
    said += [guide.feed(bench.block(push)) for _ in range(900)]
    assert guide.phase is Phase.RELEASE
    assert 'Let go of the link.' in said
    assert guide.prompt() == 'Let go.'


def test_a_link_that_moves_is_not_at_rest() -> None:
    known = load_rig()
    bench, guide = Bench(known, 5, tremor=1.0), Guide(known)
    push, _, _ = hand_of(known, 0.2e-3)
    said = [guide.feed(bench.block(push)) for _ in range(800)]
    assert guide.phase is Phase.REST
    assert any('leave it alone' in text for text in said)


def test_directions_have_a_psd_as_the_landmark() -> None:
    first, second, third = directions(load_rig())
    assert first == 'Push the tip along +X (away from the PSD at x -100 mm, y 0 mm) and hold it.'
    assert second == 'Push the tip along +Y (towards the PSD at x 0 mm, y 70 mm) and hold it.'
    assert 'clockwise' in third


def test_a_dot_at_its_end_is_said() -> None:
    known = load_rig()
    bench, guide = Bench(known, 6), Guide(known)
    push, _, _ = hand_of(known, 8e-3)

    def loads() -> Iterator[FloatArray]:
        yield from [np.zeros(3)] * 150
        yield from [push] * 700

    assert 'A dot is at the end of its PSD: push less.' in [guide.feed(bench.block(load)) for load in loads()]
