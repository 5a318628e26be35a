# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The wiring of a rig file: which channel is which axis, applied alike to live samples and recorded ones."""

import itertools

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.devices.rig_feed import RigFeed
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.loads import constant
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import DeflectionEstimate, RawChunk, SampleBlock
from psd_deflection.rig.config import Rig, load_rig, rig_from_values
from psd_deflection.rig.wiring import Wiring

PAIRS = list(itertools.product(('x', '-x'), ('y', '-y')))
AXES = [*PAIRS, *((y, x) for x, y in PAIRS)]
WIRINGS = [Wiring(exchanged, axes) for exchanged in (False, True) for axes in itertools.product(AXES, AXES)]


def values_of(wiring: Wiring) -> dict[str, object]:
    axes: dict[str, object] = {f'psd_{number}.axes': list(axes) for number, axes in enumerate(wiring.axes, start=1)}
    return {'psds_exchanged': wiring.exchanged, **axes}


def records_of(world: Rig, known: Rig) -> tuple[list[DeflectionEstimate], list[SampleBlock]]:
    counts = RigSimulator(world, seed=4).step(constant((8.0, -20.0, 3.0), 0.4, 1000.0).loads).counts
    seq = np.arange(len(counts))
    chunk = RawChunk(seq, seq * 1_000_000, counts, np.zeros(len(seq), np.uint8), known.converter.volts_per_count)
    out = list(Pipeline(known).process(chunk))
    return [r for r in out if isinstance(r, DeflectionEstimate)], [r for r in out if isinstance(r, SampleBlock)]


def test_two_detectors_have_128_invertible_wirings() -> None:
    assert len(set(WIRINGS)) == 128
    assert [w for w in WIRINGS if w.nominal] == [Wiring()]
    volts = np.arange(1, 13, dtype=np.float32).reshape(2, 6)
    observed = set()
    for wiring in WIRINGS:
        out = wiring.to_psds(volts)
        assert out.dtype == np.float32
        np.testing.assert_array_equal(wiring.to_device(out), volts)
        observed.add(tuple(out[0].tolist()))
    assert len(observed) == 128


@pytest.mark.parametrize('wiring', [WIRINGS[1], WIRINGS[22], WIRINGS[77], WIRINGS[127]], ids=str)
def test_rig_file_with_wiring_gives_nominal_estimates(wiring: Wiring) -> None:
    nominal, straight = records_of(load_rig(), load_rig())
    known = rig_from_values(values_of(wiring))
    wired, blocks = records_of(known, known)
    assert wired == nominal
    np.testing.assert_array_equal(wiring.to_psds(blocks[0].volts), straight[0].volts)
    assert not np.array_equal(blocks[0].volts, straight[0].volts)
    mistaken, _ = records_of(known, load_rig())
    assert mistaken != nominal


def test_dark_detector_is_dark_on_its_wired_input() -> None:
    rig = rig_from_values({'psds_exchanged': True})
    feed = RigFeed(rig, lambda first, n: np.zeros((n, 3)), dark=[(1, 0, 10)])
    _, _, sum1, _, _, sum2 = feed.next()
    assert abs(sum2) < 20 < sum1


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'psd_1.axes': ['x', 'z']}, r"psd_1.axes = \['x', 'z'\]: each must be one of x, -x, y, -y"),
        ({'psd_2.axes': ['x', '-x']}, r'psd_2.axes = .*: must name x once and y once'),
        ({'psd_1.axes': ['x']}, r'must have 2 elements'),
        ({'psd_1.axes': [True, 'x']}, r'list of names'),
    ],
)
def test_a_wiring_that_cannot_be_is_rejected(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        rig_from_values(values, 'rig.yaml')


def test_only_the_first_two_detectors_are_exchanged() -> None:
    wiring = Wiring(True, (('x', 'y'), ('-y', 'x'), ('y', '-x')))
    assert [wiring.input_of(psd) for psd in (1, 2, 3)] == [2, 1, 3]
    assert wiring.columns == (3, 4, 5, 1, 0, 2, 7, 6, 8)
    assert wiring.signs == (1.0, 1.0, 1.0, -1.0, 1.0, 1.0, 1.0, -1.0, 1.0)
