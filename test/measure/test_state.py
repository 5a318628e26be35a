# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the pipeline and its parts remember: each takes its own, what fits none is said, and then no bit differs."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from blind import generator
from psd_deflection.measure.estimation import HELD, ZERO_VARIANCES
from psd_deflection.measure.health import FROZEN, LOUD
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.state import load_states
from psd_deflection.measure.uncertainty.block_estimator import (
    CANDIDATES,
    DRIFT,
    HUM,
    MOVES,
    NOISE,
    PSDS,
    STEPS,
    VIBRATION,
)
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.model.simulation.tip_load import TIP_LOADS
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import (
    ENVIRONMENT,
    KNOWN_LOAD,
    BlockStatus,
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
    memory = ran(rig).snapshot(rig)
    assert memory is not None
    other = Pipeline(rig)
    other.apply(memory)
    assert other.mismatches == []
    again = other.snapshot(rig)
    assert again is not None
    reported = dict(memory.values)
    assert {name: reported[name] for name, _ in again.values} == dict(again.values)


@pytest.mark.parametrize(
    'name', ['state.noise', 'state.noise_segment', 'state.psds.0_1', 'state.motion', 'state.unseen']
)
@pytest.mark.parametrize('value', [(1.0,), 'words', 3.0, (float('nan'),)])
def test_a_value_that_does_not_fit_is_named_with_its_part(name: str, value: float | str | tuple[float, ...]) -> None:
    rig = load_rig(overrides=MODAL)
    memory = ran(rig).snapshot(rig)
    assert memory is not None
    wrong = {**dict(memory.values), name: value}
    pipeline = Pipeline(rig)
    pipeline.apply(ParameterChange(memory.t_ns, memory.block, tuple(wrong.items())))
    (message,) = pipeline.mismatches
    assert 'does not go on from what was recorded' in message
    assert list(pipeline.process(chunk(rig, 2)))


def test_a_value_of_no_part_is_named() -> None:
    pipeline = Pipeline(load_rig())
    pipeline.apply(ParameterChange(0, 0, (('state.motion', (1.0,)), ('state.psds.0_2', (1.0,)))))
    assert any('state.motion: no part of this rig remembers such a value' in message for message in pipeline.mismatches)
    assert any('two or more of 2 PSDs' in message for message in pipeline.mismatches)
    pipeline.apply(ParameterChange(0, 0, ((ENVIRONMENT[0], 'noon'),)))
    assert 'expected a number' in pipeline.mismatches[0]
    assert load_states((), {}) == []


def test_a_replay_says_what_it_cannot_go_on_from(tmp_path: Path) -> None:
    rig = load_rig(overrides=MODAL)
    memory = ran(rig).snapshot(rig)
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


def humming(volts: FloatArray) -> None:
    volts += 0.01 * np.sin(2.0 * np.pi * 0.06 * np.arange(len(volts)))[:, None] * (1.0, 0.8, 1.0, 0.9, 1.1, 1.0)


def faint(volts: FloatArray) -> None:
    volts[:, 1::3] += 7e-4 * np.sin(2.0 * np.pi * 0.187 * np.arange(len(volts)))[:, None]


def drifting(volts: FloatArray) -> None:
    volts[:] = volts[np.arange(7000) % 2900]
    volts[:, 0] += 2e-6 * np.arange(7000)


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
    'hums': Case(HUM, (99, 171), humming),
    'drifts': Case(DRIFT, (130, 271), drifting),
    'moves': Case(MOVES, (151,)),
    'may vibrate': Case(CANDIDATES, (60,), faint),
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
        memory = live.snapshot(rig)
        assert memory is not None
        assert memory.block == start
        replay.apply(memory)
        without.apply(streams.without(memory, case.state) if start > 1 else ParameterChange(0, 0, ()))
        expected, again, other = (
            reported(p.process(streams.chunk(volts[20 * start :], 20 * start))) for p in (live, replay, without)
        )
        assert replay.mismatches == []
        assert again == expected, start
        assert other != expected, start


def volts(seconds: int, seed: int, dead: int | None = None) -> generator.Array:
    """At rest, 50 N from 3.007 s on; every seventh sample's noise larger."""
    n = seconds * 1000
    loads = np.zeros((n, 3))
    loads[3007:] = (0.0, -50.0, -29.25)
    out = generator.Generator(loads, np.zeros(n), 0.585).clean([])
    out += generator.electronic_noise(n, seed, sigmas=(3e-3,) * 6, memory=0.4)
    if dead is not None:
        out[:, dead] = 0.0
    return generator.output(out, [])


def estimates(records: list[Record]) -> list[DeflectionEstimate]:
    return [r for r in records if isinstance(r, DeflectionEstimate)]


def loads_of(records: list[Record]) -> list[TipLoad]:
    return [r for r in records if isinstance(r, TipLoad)]


def test_the_sag_is_in_a_zero_that_was_taken() -> None:
    rig = load_rig(overrides={'effects.c.name': 'self_weight', 'effects.c.weight_per_length': 2.0})
    pipeline = Pipeline(rig)
    counts = RigSimulator(rig, 1).step(np.zeros((4000, 3))).counts
    for half in (slice(0, 2000), slice(2000, 4000)):
        seq = np.arange(half.start, half.stop)
        raw = RawChunk(seq, seq * 1_000_000, counts[half], np.zeros(len(seq), np.uint8), rig.converter.volts_per_count)
        records = list(pipeline.process(raw))
        assert np.mean([r.fy for r in loads_of(records)]) == pytest.approx(0.0, abs=2e-3)
        assert pipeline.zero() is not None
    # The sag of 20 um is in the zero now.
    assert np.mean([e.dy for e in estimates(records)]) == pytest.approx(0.0, abs=1e-7)


DRIFTS = {
    'effects.a.name': 'thermal_drift',
    'effects.a.psd': 1,
    'effects.a.x': 1e-6,
    'effects.b.name': 'laser_pointing_drift',
    'effects.b.psd': 2,
    'effects.b.rate_y': 1e-5,
}


@pytest.mark.parametrize('name', ENVIRONMENT)
def test_what_is_known_of_the_surroundings_replays_to_the_bit(name: str) -> None:
    """The first time, the first temperature, the last temperature."""
    rig = load_rig(overrides=DRIFTS)
    samples = volts(1, 1)
    live, replay, without = Pipeline(rig), Pipeline(rig), Pipeline(rig)
    live.temperature(21.5)
    list(live.process(streams.chunk(samples[:400])))
    live.temperature(24.0)
    list(live.process(streams.chunk(samples[400:600], 400)))
    memory = live.snapshot(rig)
    assert memory is not None
    assert dict(memory.values)[name] == dict(zip(ENVIRONMENT, (0.0, 21.5, 24.0), strict=True))[name]
    rest = streams.chunk(samples[600:], 600)
    expected = estimates(list(live.process(rest)))
    replay.apply(memory)
    assert estimates(list(replay.process(rest))) == expected
    without.apply(streams.without(memory, name))
    assert estimates(list(without.process(rest))) != expected


def test_what_was_changed_is_remembered() -> None:
    """Numbers, words, lists and truth values; not what was changed back."""
    rig = load_rig()
    live, replay = Pipeline(rig), Pipeline(rig)
    live.change({'psd_2.zero': (1e-5, -2e-5), 'sum_min': 0.5, 'degraded': 'hold', 'twist_sd': 0.5})
    live.change({'twist_sd': rig.values['twist_sd'], 'frozen': 'reject'})  # type: ignore[dict-item]
    memory = live.snapshot(rig)
    assert memory is not None
    wanted = {'psd_2.zero': (1e-5, -2e-5), 'sum_min': 0.5, 'degraded': 'hold', 'frozen': 'reject'}
    assert dict(memory.values) == wanted
    replay.apply(memory)
    assert replay.rig == live.rig != rig


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        (HELD, (0.0, 1.0)),
        (FROZEN, (4.0,)),
        (LOUD, (1.0, 2.0)),
        (ZERO_VARIANCES, (1e-12, 1e-12)),
        (KNOWN_LOAD, (0.0, 0.0, 1.0, 0.0)),
    ],
)
def test_a_memory_of_another_length_is_left_out_and_reported(name: str, value: tuple[float, ...]) -> None:
    rig = load_rig(overrides={'filter': 'modal', 'degraded': 'hold'})
    pipeline, fresh = Pipeline(rig), Pipeline(rig)
    pipeline.apply(ParameterChange(0, 0, ((name, value),)))
    (message,) = pipeline.mismatches
    assert f'{name}: {len(value)} numbers; expected ' in message
    assert pipeline.snapshot(rig) == fresh.snapshot(rig)
    assert pipeline.estimation.zero_variances == ()
    samples = streams.chunk(volts(1, 1)[:200])
    assert list(map(str, pipeline.process(samples))) == list(map(str, fresh.process(samples)))


def run(rig: Rig, samples: generator.Array) -> tuple[Pipeline, list[Record]]:
    pipeline = Pipeline(rig)
    return pipeline, list(pipeline.process(streams.chunk(samples)))


def test_a_dead_reading_is_widened_named_and_rejected_if_asked() -> None:
    samples = volts(9, 2, dead=1)
    pipeline, records = run(load_rig(), samples)
    late = [e for e in estimates(records) if e.primary and e.block > 200]
    # y1 of 2.2 mm is missing: the truth is inside three of the widened standard deviations.
    assert all(e.chi_square > 1e4 for e in late)
    assert all(abs(e.dy + 2.2272e-3) < 3.0 * e.covariance[4] ** 0.5 for e in late[-50:])
    assert all(abs(e.dy + 2.2272e-3) > 1e-4 for e in late[-50:])
    assert pipeline.estimator.most_likely_wrong() == 'y1 does not move with the others'
    _, records = run(load_rig(overrides={'consistency': 'reject'}), samples)
    spots = [s for s in records if isinstance(s, SpotMeans) and s.index > 200]
    assert {s.status for s in spots} == {BlockStatus.INCONSISTENT}
    assert 'contradict' in spots[0].reason
    _, records = run(load_rig(overrides={'consistency': 'report'}), samples)
    assert max(e.covariance[4] for e in estimates(records) if e.block > 300) < 1e-12
