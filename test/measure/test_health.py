# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults of the optics one by one, what the node makes of one detector alone, and that replay agrees."""

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.plate import Geometry
from psd_deflection.model.solvers.subset import OnePsd
from psd_deflection.records import BlockStatus, Counts, DeflectionEstimate, Record, SpotMeans, TipLoad
from psd_deflection.rig.config import Rig, load_rig
from test.measure.test_pipeline import STEP, chunk_of, still

POSE = (4e-4, -3e-4, 0.004)
SIZE = 20


def dark(counts: Counts, psd: int, blocks: slice) -> Counts:
    out = counts.copy()
    rows = slice(blocks.start * SIZE, blocks.stop * SIZE)
    out[rows, 3 * psd - 3 : 3 * psd] %= 13
    return out


def records_of(pipeline: Pipeline, counts: Counts, first: int = 0) -> list[Record]:
    return list(pipeline.process(chunk_of(counts, first)))


def primaries(records: list[Record]) -> dict[int, DeflectionEstimate]:
    return {r.block: r for r in records if isinstance(r, DeflectionEstimate) and r.primary}


def spots(records: list[Record]) -> list[SpotMeans]:
    return [r for r in records if isinstance(r, SpotMeans)]


def moving(n: int, pose: tuple[float, float, float] = POSE, seed: int = 3) -> Counts:
    return still(pose, n * SIZE, seed)


@pytest.mark.parametrize('psd', [1, 2])
def test_the_translation_of_one_psd_is_exact_where_the_twist_is(psd: int) -> None:
    rig = load_rig()
    dx, dy, theta = POSE
    c, s = np.cos(theta), np.sin(theta)
    x, y = rig.centers[psd - 1]
    dot = (c * (x - dx) + s * (y - dy) - x, -s * (x - dx) + c * (y - dy) - y)
    got = OnePsd(Geometry.from_rig(rig)).solve(psd - 1, dot, (1e-12, 1e-12), theta, 1e-6)
    assert got[0] == pytest.approx(dx, abs=1e-15)
    assert got[1] == pytest.approx(dy, abs=1e-15)


def test_off_is_the_default_and_nothing_is_estimated() -> None:
    pipeline = Pipeline(load_rig())
    records = records_of(pipeline, dark(moving(12), 2, slice(4, 8)))
    assert sorted(primaries(records)) == [0, 1, 2, 3, 8, 9, 10, 11]
    assert (pipeline.counters.degraded, pipeline.counters.rejected) == (0, {'laser_lost': 4})


@pytest.mark.parametrize('psd', [1, 2])
@pytest.mark.parametrize('rule', ['hold', 'zero'])
def test_translation_follows_rule_after_laser_loss(psd: int, rule: str) -> None:
    rig = load_rig(overrides={'degraded': rule})
    pipeline = Pipeline(rig)
    records = records_of(pipeline, dark(moving(40), psd, slice(10, 30)))
    by_block = primaries(records)
    assert sorted(by_block) == list(range(40))
    full = by_block[9]
    for block in range(10, 30):
        e = by_block[block]
        assert (e.solver, e.theta) == ('one_psd', full.theta if rule == 'hold' else 0.0)
        # What is claimed holds: the error is within four of its standard deviations.
        error = np.array([e.dx - POSE[0], e.dy - POSE[1], e.theta - POSE[2]])
        covariance = np.reshape(e.covariance, (3, 3))
        assert (np.abs(error) < 4 * np.sqrt(np.diag(covariance))).all()
        assert np.linalg.eigvalsh(covariance).min() > 0
        assert e.covariance[8] > full.covariance[8]
    assert by_block[30].solver == 'exact'
    # What a block shows of motion differs from block to block, and with it the covariance, by a few per cent.
    np.testing.assert_allclose(by_block[30].covariance, full.covariance, rtol=0.1)
    assert (pipeline.counters.degraded, pipeline.counters.rejected) == (20, {})
    statuses = [s.status for s in spots(records)]
    assert statuses[10:30] == [BlockStatus.LASER_LOST] * 20
    loads = {r.t_ns for r in records if isinstance(r, TipLoad)}
    assert not loads & {by_block[b].t_ns for b in range(10, 30)}
    pipeline = Pipeline(rig)
    records_of(pipeline, dark(moving(10), psd, slice(5, 10)))
    assert pipeline.zero() is None


def test_saturation_is_reported_with_range_parameter() -> None:
    counts = moving(1)
    counts[3, 2] = 32767
    (spot, *_) = [r for r in records_of(Pipeline(load_rig()), counts) if isinstance(r, SpotMeans)]
    assert spot.reason == 'sum1 saturated: 10.000 V, converter.full_scale is 10 V'


def test_frozen_detector_is_reported_or_rejected() -> None:
    counts = moving(12)
    counts[2 * SIZE : 10 * SIZE, 0:3] = counts[2 * SIZE, 0:3]
    quiet = Pipeline(load_rig())
    assert {s.status for s in spots(records_of(quiet, counts[: 8 * SIZE]))} == {BlockStatus.OK}
    assert quiet.counters.findings['psd_1 stands still'] == 2
    records = records_of(Pipeline(load_rig(overrides={'frozen': 'reject'})), counts)
    statuses = [s.status for s in spots(records)]
    assert statuses == [BlockStatus.OK] * 6 + [BlockStatus.FROZEN] * 4 + [BlockStatus.OK] * 2
    assert 'psd_1 stands still: no bit has moved for 5 blocks' in [s.reason for s in spots(records)]


def findings_of(rig: Rig, counts: Counts) -> tuple[SpotMeans, DeflectionEstimate | None]:
    records = records_of(Pipeline(rig), counts)
    (spot,) = spots(records)
    return spot, primaries(records).get(0)


def noisy_blocks(blocks: int, volts: float) -> Counts:
    """PSD 2's x with white noise of so many V rms."""
    counts = moving(blocks)
    noise = np.random.default_rng(7).normal(0.0, volts / STEP, blocks * SIZE)
    counts[:, 3] = np.rint(noise).astype(np.int16)
    return counts


def levels_of(pipeline: Pipeline, counts: Counts, first: int = 0) -> list[float]:
    """The level, mV, that each finding names."""
    noisy = [f for spot in spots(records_of(pipeline, counts, first)) for f in spot.findings if 'is noisy' in f]
    return [float(f.partition(': ')[2].removesuffix(' mV a sample')) for f in noisy]


def test_the_noise_that_is_named_is_that_of_many_blocks() -> None:
    levels = levels_of(Pipeline(load_rig()), noisy_blocks(100, 0.02))
    assert len(levels) > 95
    assert levels[-1] == pytest.approx(20.0, rel=0.1)
    # One block alone tells it within a quarter, and the largest of three channels is more than each.
    assert max(abs(level / 20.0 - 1.0) for level in levels[50:]) < 0.12


def test_a_burst_of_noise_is_not_named_after_what_came_before() -> None:
    counts = noisy_blocks(60, 0.02)
    counts[30 * SIZE : 50 * SIZE, 3] = 0
    counts[50 * SIZE :, 3] = np.rint(4.0 * counts[50 * SIZE :, 3]).astype(np.int16)
    levels = levels_of(Pipeline(load_rig()), counts)
    assert levels[-1] == pytest.approx(80.0, rel=0.25)


def test_other_light_is_reported_and_widens_the_covariance() -> None:
    counts = moving(1)
    _, clean = findings_of(load_rig(), counts)
    lit = counts.copy()
    lit[:, 2] = np.int16(round(8.0 / STEP))
    spot, estimate = findings_of(load_rig(), lit)
    assert 'psd_1 sees other light' in spot.findings[0]
    assert clean is not None
    assert estimate is not None
    # A share of 3/8 of the light, spread over 10 mm: a millimetre, at an arm of 0.12 m.
    assert estimate.covariance[8] ** 0.5 == pytest.approx(3 / 8 * 5e-3 / 3**0.5 / 0.122, rel=0.2)
    assert estimate.covariance[8] > 1e4 * clean.covariance[8]


def test_other_light_on_the_only_detector_widens() -> None:
    """Also once the noise is measured, and the other detector is dark."""
    counts = np.concatenate([moving(150)] * 2)
    counts[3000:, 2] = np.int16(round(8.0 / STEP))
    counts[5900:, 5] = 0
    records = records_of(Pipeline(load_rig(overrides={'degraded': 'zero'})), counts)
    last = [r for r in records if isinstance(r, DeflectionEstimate)][-1]
    assert last.solver == 'one_psd'
    assert last.covariance[0] ** 0.5 > 0.9 * 3 / 8 * 5e-3 / 3**0.5


@pytest.fixture
def half_lit() -> Counts:
    counts = moving(1)
    counts[:, 2] //= 2
    counts[:, 5] //= 2
    return counts


def test_laser_loss_with_splitter_is_not_fatal(half_lit: Counts) -> None:
    spot, estimate = findings_of(load_rig(overrides={'splitter': True}), half_lit)
    assert spot.status is BlockStatus.OK
    assert spot.findings == ('one of the two lasers is out: half the light on both detectors',)
    assert estimate is not None
    _, full = findings_of(load_rig(overrides={'splitter': True}), moving(1))
    assert full is not None
    np.testing.assert_allclose(np.array(estimate.covariance), 4 * np.array(full.covariance), rtol=1e-9, atol=1e-30)
    # A detector that lost its own beam is lost with the splitter too; without it, half the light is none.
    assert findings_of(load_rig(overrides={'splitter': True}), dark(moving(1), 1, slice(0, 1)))[0].status == 2
    half_lit[:, [2, 5]] -= 40
    assert findings_of(load_rig(), half_lit)[0].status is BlockStatus.LASER_LOST


def test_degraded_rule_change_applies_from_next_block() -> None:
    pipeline = Pipeline(load_rig())
    counts = dark(moving(20), 1, slice(5, 15))
    first = primaries(records_of(pipeline, counts[: 10 * SIZE]))
    change = pipeline.change({'degraded': 'zero'})
    second = primaries(records_of(pipeline, counts[10 * SIZE :], 10 * SIZE))
    assert (sorted(first), sorted(second)) == ([0, 1, 2, 3, 4], list(range(10, 20)))
    assert change.values == (('degraded', 'zero'),)


def test_outside_the_calibrated_range_the_block_says_so() -> None:
    dx, dy, theta = POSE
    observed = (-1e-3, -1e-3, -0.01, 1e-3, 1e-3, 0.01)
    inside = spots(records_of(Pipeline(load_rig(overrides={'calibration.range': list(observed)})), moving(10)))
    assert not [f for s in inside for f in s.findings]
    for axis, (name, shown) in enumerate((('dX', dx * 1e3), ('dY', dy * 1e3), ('theta', np.degrees(theta)))):
        narrow = list(observed)
        # Its largest, or its least, just short of the pose.
        narrow[axis + 3 if shown > 0.0 else axis] = 0.9 * POSE[axis]
        pipeline = Pipeline(load_rig(overrides={'calibration.range': narrow}))
        message = [f for s in spots(records_of(pipeline, moving(10))) for f in s.findings]
        assert len(message) == 10
        assert all(f.startswith(f'outside the calibrated range: {name} {shown:.1g}') for f in message)
        assert pipeline.counters.findings == {'outside the calibrated range': 10}


@pytest.mark.parametrize('given', [[1.0], [0.0, 0.0], [0.0, 0.0, 1.0, 1.0, 1.0, 0.5]])
def test_a_range_that_is_none_is_rejected(given: list[float]) -> None:
    with pytest.raises(ConfigError, match=r'calibration\.range: '):
        Pipeline(load_rig(overrides={'calibration.range': given}))
