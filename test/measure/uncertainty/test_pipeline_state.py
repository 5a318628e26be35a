# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the pipeline remembers of noise, motion and contradictions: told in memory(), and then no bit differs."""

import numpy as np
import pytest

from blind import generator
from psd_deflection.measure.estimation import HELD, ZERO_VARIANCES
from psd_deflection.measure.health import FROZEN, LOUD
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import (
    ENVIRONMENT,
    KNOWN_LOAD,
    BlockStatus,
    DeflectionEstimate,
    ParameterChange,
    RawChunk,
    Record,
    SpotMeans,
    TipLoad,
)
from psd_deflection.rig.config import Rig, load_rig
from test import streams


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


def chunk(samples: generator.Array, first: int = 0) -> RawChunk:
    seq = np.arange(first, first + len(samples))
    return RawChunk(seq, seq * 1_000_000, samples.astype(np.float32), np.zeros(len(seq), np.uint8))


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
    list(live.process(chunk(samples[:400])))
    live.temperature(24.0)
    list(live.process(chunk(samples[400:600], 400)))
    memory = live.memory(rig)
    assert memory is not None
    assert dict(memory.values)[name] == dict(zip(ENVIRONMENT, (0.0, 21.5, 24.0), strict=True))[name]
    rest = chunk(samples[600:], 600)
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
    memory = live.memory(rig)
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
    (message,) = pipeline.misfits
    assert f'{name}: {len(value)} numbers; expected ' in message
    assert pipeline.memory(rig) == fresh.memory(rig)
    assert pipeline.estimation.zero_variances == ()
    samples = chunk(volts(1, 1)[:200])
    assert list(map(str, pipeline.process(samples))) == list(map(str, fresh.process(samples)))


def run(rig: Rig, samples: generator.Array) -> tuple[Pipeline, list[Record]]:
    pipeline = Pipeline(rig)
    return pipeline, list(pipeline.process(chunk(samples)))


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
