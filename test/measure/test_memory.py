# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the parts of the pipeline remember: each takes its own, and what fits none is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psd_deflection.measure.memory import restore
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import ENVIRONMENT, ParameterChange, RawChunk
from psd_deflection.rig.config import Rig, load_rig

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
    # Of a pipeline that has not seen a block it tells no noise; what it took is the same.
    assert again is not None
    told = dict(memory.values)
    assert {name: told[name] for name, _ in again.values} == dict(again.values)


@pytest.mark.parametrize(
    'name', ['state.noise', 'state.noise_segment', 'state.block_fit', 'state.motion', 'state.unseen']
)
@pytest.mark.parametrize('value', [(1.0,), 'words', 3.0, (float('nan'),)])
def test_a_value_that_does_not_fit_is_named_with_its_part(name: str, value: float | str | tuple[float, ...]) -> None:
    rig = load_rig(overrides=MODAL)
    memory = ran(rig).memory(rig)
    assert memory is not None
    wrong = {**dict(memory.values), name: value}
    pipeline = Pipeline(rig)
    pipeline.apply(memory._replace(values=tuple(wrong.items())))
    (said,) = pipeline.misfits
    assert 'does not go on from what was recorded' in said
    assert list(pipeline.process(chunk(rig, 2)))


def test_a_value_of_no_part_is_named() -> None:
    pipeline = Pipeline(load_rig())
    pipeline.apply(ParameterChange(0, 0, (('state.motion', (1.0,)), ('state.psds.0_2', (1.0,)))))
    assert any('state.motion: no part of this rig remembers such a value' in said for said in pipeline.misfits)
    assert any('two or more of 2 PSDs' in said for said in pipeline.misfits)
    pipeline.apply(ParameterChange(0, 0, ((ENVIRONMENT[0], 'noon'),)))
    assert 'expected a number' in pipeline.misfits[0]
    assert restore((), {}) == []


def test_a_replay_says_what_it_cannot_go_on_from(tmp_path: Path) -> None:
    rig = load_rig(overrides=MODAL)
    memory = ran(rig).memory(rig)
    assert memory is not None
    plain = load_rig()
    with BagWriter(tmp_path / 'bag', rig_values=plain.flat()) as bag:
        bag.put(memory._replace(block=0))
        for record in Pipeline(plain).process(chunk(plain, 5)):
            bag.put(record)
    recording = open_recording(tmp_path / 'bag')
    assert list(replayed(recording, Pipeline(rig_at_start(recording))))
    assert any('state.motion: no part of this rig' in warning for warning in recording.warnings)
