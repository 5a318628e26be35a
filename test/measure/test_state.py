# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the parts of the pipeline remember: each takes its own, and what fits none is said."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from blind import generator
from psd_deflection.measure.estimation import HELD
from psd_deflection.measure.health import FROZEN, LOUD
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.state import load_states
from psd_deflection.measure.uncertainty.block_estimator import NOISE, PSDS, STEPS, VIBRATION
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.model.simulation.tip_load import TIP_LOADS
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import (
    ENVIRONMENT,
    DeflectionEstimate,
    FloatArray,
    ParameterChange,
    RawChunk,
    Record,
    SpotMeans,
    TipLoad,
)
from psd_deflection.rig.config import Rig, load_rig
from test import streams

MODAL = {'filter': 'modal', 'degraded': 'hold'}


def chunk(rig: Rig, blocks: int) -> RawChunk:
    seq = np.arange(20 * blocks)
    counts = RigSimulator(rig, 3).step(np.zeros((len(seq), 3))).counts
    return RawChunk(seq, seq * 1_000_000, counts, np.zeros(len(seq), np.uint8), rig.converter.volts_per_count)


def ran(rig: Rig, blocks: int = 30) -> Pipeline:
    pipeline = Pipeline(rig)
    list(pipeline.process(chunk(rig, blocks)))
    return pipeline


def test_every_value_belongs_to_one_part_and_comes_back() -> None:
    rig = load_rig(overrides=MODAL)
    memory = ran(rig).memory(rig)
    assert memory is not None
    other = Pipeline(rig)
    other.apply(memory)
    assert other.misfits == []
    again = other.memory(rig)
    assert again is not None
    reported = dict(memory.values)
    assert {name: reported[name] for name, _ in again.values} == dict(again.values)


@pytest.mark.parametrize(
    'name', ['state.noise', 'state.noise_segment', 'state.psds.0_1', 'state.motion', 'state.unseen']
)
@pytest.mark.parametrize('value', [(1.0,), 'words', 3.0, (float('nan'),)])
def test_a_value_that_does_not_fit_is_named_with_its_part(name: str, value: float | str | tuple[float, ...]) -> None:
    rig = load_rig(overrides=MODAL)
    memory = ran(rig).memory(rig)
    assert memory is not None
    wrong = {**dict(memory.values), name: value}
    pipeline = Pipeline(rig)
    pipeline.apply(ParameterChange(memory.t_ns, memory.block, tuple(wrong.items())))
    (message,) = pipeline.misfits
    assert 'does not go on from what was recorded' in message
    assert list(pipeline.process(chunk(rig, 2)))


def test_a_value_of_no_part_is_named() -> None:
    pipeline = Pipeline(load_rig())
    pipeline.apply(ParameterChange(0, 0, (('state.motion', (1.0,)), ('state.psds.0_2', (1.0,)))))
    assert any('state.motion: no part of this rig remembers such a value' in message for message in pipeline.misfits)
    assert any('two or more of 2 PSDs' in message for message in pipeline.misfits)
    pipeline.apply(ParameterChange(0, 0, ((ENVIRONMENT[0], 'noon'),)))
    assert 'expected a number' in pipeline.misfits[0]
    assert load_states((), {}) == []


def test_a_replay_says_what_it_cannot_go_on_from(tmp_path: Path) -> None:
    rig = load_rig(overrides=MODAL)
    memory = ran(rig).memory(rig)
    assert memory is not None
    plain = load_rig()
    with BagWriter(tmp_path / 'bag', rig_values=plain.flat()) as bag:
        bag.put(ParameterChange(memory.t_ns, 0, memory.values))
        for record in Pipeline(plain).process(chunk(plain, 5)):
            bag.put(record)
    recording = open_recording(tmp_path / 'bag')
    assert list(replayed(recording, Pipeline(rig_at_start(recording))))
    assert any('state.motion: no part of this rig' in warning for warning in recording.warnings)


def pushed() -> FloatArray:
    loads = np.zeros((7000, 3))
    loads[3007:] = (0.0, -50.0, -29.25)
    out = generator.Generator(loads, np.zeros(7000), 0.585).clean([])
    out += generator.electronic_noise(7000, 1, sigmas=(3e-3,) * 6, memory=0.4)
    return generator.output(out, [])


def dead(volts: FloatArray) -> None:
    volts[:, 1] = 0.0


def vibrating(volts: FloatArray) -> None:
    volts[:, 1::3] += 0.04 * np.sin(2.0 * np.pi * 0.087 * np.arange(len(volts)))[:, None]


def coarse(volts: FloatArray) -> None:
    volts[:] = np.rint(volts * 2**10 / 20.0) * 20.0 / 2**10


def dark(volts: FloatArray) -> None:
    volts[4000:6000, 3:6] = 1e-3


def stuck(volts: FloatArray) -> None:
    volts[3500:6000, :3] = volts[3500, :3]


def noisy(volts: FloatArray) -> None:
    volts[:, 3] += 0.02 * np.random.default_rng(3).normal(size=len(volts))


class Case(NamedTuple):
    """A rig and its stream; blocks at which a recording begins; the state without which the records differ."""

    state: str
    starts: tuple[int, ...]
    spoil: Callable[[FloatArray], None] = lambda volts: None
    rig: Mapping[str, object] = {}


LINK = {
    'effects.a.name': 'creep',
    'effects.a.amplitude': 0.1,
    'effects.b.name': 'clamp_friction',
    'effects.b.width': 1e-3,
    'effects.c.name': 'self_weight',
    'effects.c.weight_per_length': 2.0,
}
THIRD = {'psd_3.center': [0.08, -0.06]}
CASES = {
    'sound': Case(NOISE, (1, 40, 130, 251)),
    'y1 dead': Case(PSDS + '0_1', (99,), dead),
    'vibrates': Case(VIBRATION, (99, 171), vibrating),
    'ten bits': Case(STEPS, (160,), coarse),
    'PSD 2 dark': Case(HELD, (212, 260), dark, {'degraded': 'hold'}),
    'PSD 1 stands still': Case(FROZEN, (178,), stuck, {'frozen': 'reject'}),
    'x2 noisy': Case(LOUD, (20,), noisy),
    'effects of the link': Case(TIP_LOADS, (151, 251), rig=LINK),
    'PSD 3 does not follow': Case(PSDS + '0_1_2', (151,), rig=THIRD),
    'fit of two of three PSDs': Case(PSDS + '0_1', (200,), rig=THIRD),
}


def reported(records: Iterable[Record]) -> list[str]:
    return [repr(r) for r in records if isinstance(r, DeflectionEstimate | TipLoad | SpotMeans)]


SLOW = ('ten bits', 'fit of two of three PSDs')


@pytest.mark.parametrize('label', [pytest.param(c, marks=pytest.mark.slow) if c in SLOW else c for c in CASES])
def test_a_recording_begun_at_any_block_replays_to_the_bit(label: str) -> None:
    case, volts = CASES[label], pushed()
    rig = load_rig(overrides=case.rig)
    case.spoil(volts)
    if len(rig.psds) == 3:
        volts = np.column_stack((volts, generator.electronic_noise(7000, 2)[:, :3] + (0.0, 0.0, 5.0)))
    for start in case.starts:
        live, replay, without = (Pipeline(rig) for _ in range(3))
        list(live.process(streams.chunk(volts[: 20 * start])))
        memory = live.memory(rig)
        assert memory is not None
        assert memory.block == start
        replay.apply(memory)
        without.apply(streams.without(memory, case.state) if start > 1 else ParameterChange(0, 0, ()))
        expected, again, other = (
            reported(p.process(streams.chunk(volts[20 * start :], 20 * start))) for p in (live, replay, without)
        )
        assert replay.misfits == []
        assert again == expected, start
        assert other != expected, start
