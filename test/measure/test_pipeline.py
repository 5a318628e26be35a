# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pipeline on simulated samples: its accuracy against the bound, and what it rejects."""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from msg_adapters import DEFLECTION, DEFLECTION_WITH_COVARIANCE, SAMPLES, WRENCH, to_messages
from psd_deflection.cli.main import main
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation.loads import direct, sidebar
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.records import (
    ENVIRONMENT,
    KNOWN_LOAD,
    AppliedLoad,
    BaseAcceleration,
    BlockStatus,
    Counts,
    DeflectionEstimate,
    ParameterChange,
    RawChunk,
    Record,
    SampleBlock,
    SpotMeans,
    TipLoad,
    TipMotion,
)
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run.session_texts import why_no_zero

STEP = 10.0 / 32768


def chunk_of(counts: Counts, first: int = 0) -> RawChunk:
    seq = np.arange(first, first + len(counts))
    return RawChunk(seq, seq * 1_000_000, counts, np.zeros(len(counts), np.uint8), STEP)


def still(pose: tuple[float, float, float], n: int, seed: int) -> Counts:
    """Counts of a flat plate at rest in ``pose``: m = R(-theta)(l - d) - c, 2 mV noise, 16 bits."""
    dx, dy, theta = pose
    c, s = np.cos(theta), np.sin(theta)
    volts = []
    for x, y in ((0.0, 0.070), (-0.100, 0.0)):
        u, v = x - dx, y - dy
        volts += [(c * u + s * v - x) / 5e-4, (-s * u + c * v - y) / 5e-4, 5.0]
    noisy = np.array(volts) + np.random.default_rng(seed).normal(0.0, 2e-3, (n, 6))
    counts: npt.NDArray[np.int16] = np.rint(noisy / STEP).astype(np.int16)
    return counts


def run(step: Callable[..., Iterator[Record]], *chunk: RawChunk) -> list[Record]:
    return list(step(*chunk))


def estimates(records: list[Record], solver: str) -> npt.NDArray[np.float64]:
    return np.array(
        [(r.dx, r.dy, r.theta) for r in records if isinstance(r, DeflectionEstimate) and r.solver == solver]
    )


@pytest.fixture(scope='module')
def rig() -> Rig:
    return load_rig()


# What 2 um on each channel leave at best (Cramer-Rao, docs/methods.md), and what a mean of 20
# samples of 2 mV and one converter step leaves of 2 um.
BOUND_2UM = np.array([1.657e-6, 1.830e-6, np.deg2rad(1.328e-3)])
SCALE = np.sqrt(((2e-3) ** 2 + STEP**2 / 12) / 20) * 5e-4 / 2e-6


@pytest.mark.slow
@pytest.mark.parametrize('load', [(0.0, 0.0, 0.0), sidebar(10.0), sidebar(50.0), direct(30.0), (20.0, 5.0, -3.0)])
def test_rms_errors_are_within_a_tenth_of_the_cramer_rao_bound(rig: Rig, load: tuple[float, float, float]) -> None:
    pose = LinkStatics.from_rig(rig).deflection(*load)
    pipeline = Pipeline(rig)
    records = run(pipeline.process, chunk_of(still(pose, 20 * 2000, 7)))
    got = estimates(records, 'exact')
    assert len(got) == 2000
    rms = np.sqrt(((got - pose) ** 2).mean(axis=0))
    assert (rms <= 1.1 * BOUND_2UM * SCALE).all(), rms / (BOUND_2UM * SCALE)
    assert (rms >= 0.9 * BOUND_2UM * SCALE).all(), rms / (BOUND_2UM * SCALE)
    estimate = next(r for r in records if isinstance(r, DeflectionEstimate) and r.primary)
    stated = np.sqrt(np.array(estimate.covariance).reshape(3, 3).diagonal())
    np.testing.assert_allclose(stated, BOUND_2UM * SCALE, rtol=0.02)
    wrench = np.array([(r.fx, r.fy, r.tz) for r in records if isinstance(r, TipLoad)]).mean(axis=0)
    np.testing.assert_allclose(wrench, load, atol=5e-3)


def spots_of(records: list[Record]) -> SpotMeans:
    (spots,) = (r for r in records if isinstance(r, SpotMeans))
    return spots


REST = (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ('label', 'change', 'status', 'message'),
    [
        ('laser 1 off', lambda c: c.__setitem__((slice(3, 9), slice(0, 3)), 0), BlockStatus.LASER_LOST, 'laser 1'),
        ('laser 2 off', lambda c: c.__setitem__((slice(None), slice(3, 6)), 0), BlockStatus.LASER_LOST, 'laser 2'),
        ('y2 at the rail once', lambda c: c.__setitem__((4, 4), -32768), BlockStatus.SATURATED, 'y2'),
        ('x1 at the rail', lambda c: c.__setitem__((slice(None), 0), 32767), BlockStatus.SATURATED, 'x1'),
    ],
)
def test_untrusted_block_has_no_estimate_but_a_reason(
    rig: Rig, label: str, change: object, status: BlockStatus, message: str
) -> None:
    counts = still(REST, 20, 0)
    change(counts)  # type: ignore[operator]
    records = run(Pipeline(rig).process, chunk_of(counts))
    spots = spots_of(records)
    assert spots.status is status
    assert message in spots.reason
    assert not any(isinstance(r, DeflectionEstimate | TipLoad) for r in records)
    assert any(isinstance(r, SampleBlock) and len(r.seq) == 20 for r in records)


def test_the_device_flag_over_range_is_believed(rig: Rig) -> None:
    chunk = chunk_of(still(REST, 20, 0))
    chunk.flags[3] = 1
    assert spots_of(run(Pipeline(rig).process, chunk)).status is BlockStatus.SATURATED


def test_zero_takes_present_dots_from_next_block(rig: Rig) -> None:
    pipeline = Pipeline(rig)
    assert pipeline.zero() is None
    pose = (1e-4, -2e-4, 1e-3)
    before = run(pipeline.process, chunk_of(still(pose, 20 * 30, 5)))
    change = pipeline.zero()
    assert change is not None
    assert change.block == 30
    after = run(pipeline.process, chunk_of(still(pose, 20 * 30, 6), 600))
    assert abs(estimates(before, 'exact').mean(axis=0) - pose).max() < 1e-6
    assert abs(estimates(after, 'exact').mean(axis=0)).max() < 1e-6
    other = Pipeline(rig)
    run(other.process, chunk_of(still(pose, 20 * 30, 5)))
    other.apply(change)
    again = run(other.process, chunk_of(still(pose, 20 * 30, 6), 600))
    assert (estimates(again, 'exact') == estimates(after, 'exact')).all()


def test_a_zero_is_not_taken_across_an_outage(rig: Rig) -> None:
    pipeline = Pipeline(rig)
    run(pipeline.process, chunk_of(still(REST, 200, 1)))
    dark = still(REST, 20, 2)
    dark[:, :3] = 0
    assert why_no_zero(pipeline) == 'no good block yet'
    run(pipeline.process, chunk_of(dark, 200))
    assert pipeline.zero() is None
    assert why_no_zero(pipeline).startswith('no good block now: laser 1 lost')


def test_a_late_request_takes_the_dots_of_its_own_time(rig: Rig) -> None:
    pipeline, asked = Pipeline(rig), Pipeline(rig)
    pose = (1e-4, -2e-4, 1e-3)
    run(pipeline.process, chunk_of(still(REST, 600, 5)))
    run(asked.process, chunk_of(still(REST, 600, 5)))
    run(pipeline.process, chunk_of(still(pose, 1000, 6), 600))
    late, in_time = pipeline.zero(1.0), asked.zero()
    assert late is not None
    assert in_time is not None
    assert late.values == in_time.values
    assert pipeline.zero(1.7) is None
    assert why_no_zero(pipeline) == 'the request is 1.7 s old, and no good block of that time is kept; try again'
    run(pipeline.process, chunk_of(still(pose, 16_000, 7), 1600))
    assert pipeline.zero(15.4) is not None
    assert pipeline.zero(15.6) is None


def test_a_zero_forgets_what_was_before_an_unplugging(rig: Rig) -> None:
    pipeline = Pipeline(rig)
    pose = (1e-4, -2e-4, 1e-3)
    run(pipeline.process, chunk_of(still(REST, 200, 1)))
    run(pipeline.process, chunk_of(still(pose, 20, 2), 20_000))
    assert pipeline.zero() is not None
    after = run(pipeline.process, chunk_of(still(pose, 200, 3), 20_020))
    assert abs(estimates(after, 'exact').mean(axis=0)).max() < 2e-5


@pytest.mark.slow
@pytest.mark.parametrize(
    'effect',
    [
        {'name': 'sensor_rotation', 'psd': 2, 'angle': 0.02},
        {'name': 'sensor_gain', 'psd': 1, 'x': 0.02, 'y': -0.03},
        {'name': 'axis_crosstalk', 'psd': 1, 'xy': 0.01, 'yx': -0.01},
        {'name': 'sensor_nonlinearity', 'psd': 2, 'k': 2000.0},
        {'name': 'plane_tilt', 'slope_ratio': 1.5},
    ],
    ids=lambda e: str(e['name']),
)
def test_an_effect_in_the_rig_file_is_simulated_and_corrected(rig: Rig, effect: dict[str, object]) -> None:
    known = load_rig(overrides={f'effects.one.{k}': v for k, v in effect.items()})
    load = np.tile(sidebar(50.0), (20 * 400, 1))
    counts = RigSimulator(known, 4).step(load).counts
    pose = LinkStatics.from_rig(rig).deflection(*sidebar(50.0))
    blind, corrected = (
        abs(estimates(run(Pipeline(r).process, chunk_of(counts)), 'exact')[-50:].mean(axis=0) - pose)
        for r in (rig, known)
    )
    assert (corrected < [3e-7, 3e-7, 5e-6]).all()
    assert (blind > 3.0 * corrected).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ('effect', 'words'),
    [
        ({'name': 'thermal_drift', 'psd': 1, 'x': 3e-6, 'y': -2e-6}, ['--temperature', '20,30']),
        ({'name': 'refraction', 'x': 1e-6, 'y': 2e-6}, ['--temperature', '20,30']),
        ({'name': 'laser_pointing_drift', 'psd': 2, 'rate_x': 3e-6, 'rate_y': 1e-6}, []),
    ],
    ids=lambda e: str(e['name']) if isinstance(e, dict) else '',
)
def test_drift_in_rig_file_is_corrected_in_replay_too(
    rig: Rig, tmp_path: Path, capsys: pytest.CaptureFixture[str], effect: dict[str, object], words: list[str]
) -> None:
    model = tmp_path / 'model.yaml'
    body = ''.join(f'        {k}: {v}\n' for k, v in effect.items())
    model.write_text(f'/**:\n  ros__parameters:\n    effects:\n      one:\n{body}')
    bag = tmp_path / 'drifting'
    argv = ['simulate', '--params-file', str(model), '--loads', 'constant:0,0,0:4', '--out', str(bag), *words]
    assert main(argv) == 0
    recorded = open_recording(bag).estimates()['/link_tip/deflection'].pose
    assert (abs(recorded[-50:].mean(axis=0) - recorded[:50].mean(axis=0)) < [5e-7, 5e-7, 2e-6]).all()
    assert (abs(recorded.mean(axis=0)) < [3e-7, 3e-7, 2e-6]).all()
    assert main(['replay', str(bag), '--compare']) == 0
    assert 'no bit differs' in capsys.readouterr().out
    nominal = tmp_path / 'nominal.yaml'
    nominal.write_text('/**:\n  ros__parameters:\n    min_samples: 10\n')
    again = tmp_path / 'again.mcap'
    assert main(['replay', str(bag), '--params-file', str(nominal), '--out', str(again)]) == 0
    blind = open_recording(again).estimates()['/link_tip/deflection'].pose
    assert abs(blind[-50:].mean(axis=0) - blind[:50].mean(axis=0)).max() > 3e-6


def exact_chunk(dots: npt.NDArray[np.float64], first: int = 0) -> RawChunk:
    """Volts of these dots (n, 4), m, at 0.5 mm a volt, without noise."""
    n = len(dots)
    volts = np.full((n, 6), 5.0)
    volts[:, [0, 1, 3, 4]] = dots / 5e-4
    seq = np.arange(first, first + n)
    return RawChunk(seq, seq * 1_000_000, volts.astype(np.float32), np.zeros(n, np.uint8))


def test_a_zero_is_the_mean_of_the_last_half_second(rig: Rig) -> None:
    """25 blocks of 20 ms: of dots that creep by some nanometres a block, those of blocks 5 to 29."""
    dots = np.outer(np.repeat(np.arange(30.0), 20) * 1e-8, [1.0, 2.0, -1.0, 3.0])
    pipeline = Pipeline(rig)
    run(pipeline.process, exact_chunk(dots))
    change = pipeline.zero()
    assert change is not None
    values = dict(change.values)
    assert values['psd_1.zero'] == pytest.approx((17e-8, 34e-8), rel=1e-4)
    assert values['psd_2.zero'] == pytest.approx((-17e-8, 51e-8), rel=1e-4)
    assert pipeline.zero_rejected == ''


def test_a_zero_is_rejected_while_the_link_moves(rig: Rig) -> None:
    """14 Hz of 20 um on y1, which the mean of half a second would hide."""
    t = np.arange(600) * 1e-3
    dots = np.zeros((600, 4))
    dots[:, 1] = 20e-6 * np.sin(2.0 * np.pi * 14.0 * t)
    pipeline = Pipeline(rig)
    run(pipeline.process, exact_chunk(dots))
    assert pipeline.zero() is None
    assert re.fullmatch(
        r'the link moves: y1 varied by 1\d\.\d µm rms in the last 25 blocks, noise .*', why_no_zero(pipeline)
    )
    assert pipeline.rig.psds[0].zero == (0.0, 0.0)
    run(pipeline.process, exact_chunk(np.zeros((600, 4)), 600))
    assert pipeline.zero() is not None


def test_before_the_first_block_a_change_is_of_block_0_at_time_0(rig: Rig) -> None:
    assert Pipeline(rig).change({'psd_1.zero': (1e-5, 0.0)}) == ParameterChange(0, 0, (('psd_1.zero', (1e-5, 0.0)),))
    drifts = load_rig(overrides={'effects.a.name': 'thermal_drift', 'effects.a.psd': 1, 'effects.a.x': 1e-6})
    started, first, now = ENVIRONMENT
    assert Pipeline(drifts).temperature(21.5) == ParameterChange(0, 0, ((first, 21.5), (now, 21.5)))
    pipeline = Pipeline(drifts)
    pipeline.temperature(21.5)
    memory = pipeline.snapshot(drifts)
    assert memory is not None
    assert (memory.t_ns, memory.block) == (0, 0)
    records = run(pipeline.process, chunk_of(still(REST, 40, 0)))
    change = pipeline.temperature(22.5)
    assert change is not None
    assert (change.t_ns, change.block) == (spots_of(records[-2:]).t_ns, 2)
    assert dict(change.values) | {started: 0.0} == {started: 0.0, first: 21.5, now: 22.5}


def test_counters_count(rig: Rig) -> None:
    pipeline = Pipeline(rig)
    counts = still(REST, 110, 0)
    counts[20:60, :3] = 0
    counts[80:100, 3] = 32767
    run(pipeline.process, chunk_of(counts))
    run(pipeline.flush)
    # Blocks 0 and 3 are good, of block 5 half is there; lasers are lost in 1 and 2, block 4 is saturated.
    counters = pipeline.counters
    assert (counters.samples, counters.blocks, counters.estimates, counters.degraded) == (110, 6, 3, 0)
    assert counters.rejected == {'laser_lost': 2, 'saturated': 1}


def test_the_stamp_goes_by_the_rate_of_the_rig_file() -> None:
    """Of 20 samples at 2 Hz the first eleven came, at 0 to 5 s: the middle of the block is at 4.75 s."""
    pipeline = Pipeline(load_rig(overrides={'converter.sample_rate_hz': 2.0}))
    chunk = exact_chunk(np.zeros((11, 4)))
    run(pipeline.process, RawChunk(chunk.seq, chunk.seq * 500_000_000, chunk.readings, chunk.flags))
    assert spots_of(run(pipeline.flush)).t_ns == 4_750_000_000


def test_a_known_load_is_applied_again_at_its_nanosecond() -> None:
    """While the samples are lost the filter predicts what a load does that acts from then on."""
    rig = load_rig(overrides={'filter': 'modal'})
    live, again, rounded = Pipeline(rig), Pipeline(rig), Pipeline(rig)
    counts = still(REST, 20 * 12, 1)
    dark = counts[200:].copy()
    dark[:, :3] = 0
    motions = []
    for pipeline in (live, again, rounded):
        run(pipeline.process, chunk_of(counts[:200]))
        if pipeline is live:
            pipeline.load(AppliedLoad(0, 0.0, 0.0, 0.0))
            reported = pipeline.load(AppliedLoad(200_123_456, 3.0, -2.0, 1.0))
            assert reported is not None
            assert reported.values == ((KNOWN_LOAD, (0.0, 200_123_456.0, 3.0, -2.0, 1.0)),)
        else:
            pipeline.apply(ParameterChange(0, 0, ((KNOWN_LOAD, (0.0,) * 5),)))
            ns = 200_123_456.0 if pipeline is again else 205_000_000.0
            pipeline.apply(ParameterChange(0, 0, ((KNOWN_LOAD, (0.0, ns, 3.0, -2.0, 1.0)),)))
        motions.append([r for r in run(pipeline.process, chunk_of(dark, 200)) if isinstance(r, TipMotion)])
    assert len(motions[0]) == 2
    assert all(m.phi == m.omega == 0.0 for m in motions[0])
    assert motions[0] == motions[1] != motions[2]


def test_an_acceleration_is_there_after_the_last_block(rig: Rig) -> None:
    base = BaseAcceleration(5, (0.1, 0.0, 0.0), (0.0, 0.0, 0.0))
    for at in (None, 7):
        assert Pipeline(rig).accelerate(base, at) is None
    pipeline = Pipeline(load_rig(overrides={'filter': 'modal'}))
    assert pipeline.accelerate(base) is None
    run(pipeline.process, chunk_of(still(REST, 50, 1)))
    # The last sample of the last whole block came at 39 ms.
    assert pipeline.accelerate(base) == 39_000_001
    # A replay says when it was there.
    assert pipeline.accelerate(BaseAcceleration(6, base.linear, base.angular), 12_345) == 12_345
    assert Pipeline(pipeline.rig).accelerate(base, 12_345) == 12_345


@pytest.mark.slow
def test_known_drift_with_time_and_heat_is_removed() -> None:
    """A beam wanders by 1 mm/s, a PSD by 5 um/K: of readings that do so, a tip at rest is left."""
    values = {
        'effects.a.name': 'laser_pointing_drift',
        'effects.a.psd': 1,
        'effects.a.rate_x': 1e-3,
        'effects.b.name': 'thermal_drift',
        'effects.b.psd': 2,
        'effects.b.y': 5e-6,
    }
    pipeline = Pipeline(load_rig(overrides=values))
    dots = np.zeros((400, 4))
    dots[:, 0] = 1e-3 * np.arange(400) * 1e-3
    # Three degrees more from 0.2 s on; before, no temperature is known.
    dots[200:, 3] = 5e-6 * 3.0
    chunk = exact_chunk(dots)
    shown = []
    for part in (slice(0, 200), slice(200, 400)):
        if part.start:
            pipeline.temperature(20.0)
            pipeline.temperature(23.0)
        late = RawChunk(chunk.seq[part], 10**18 + chunk.t_ns[part], chunk.readings[part], chunk.flags[part])
        shown.append(estimates(run(pipeline.process, late), 'exact'))
    assert (np.abs(np.concatenate(shown)) < [1e-8, 1e-8, 1e-7]).all()


def test_effects_may_change_during_a_run() -> None:
    gain = {'name': 'sensor_gain', 'psd': 1, 'y': 0.1}
    pipeline = Pipeline(load_rig(overrides={f'effects.a.{k}': v for k, v in gain.items()}))
    pipeline.change({'effects.a.y': 0.25})
    dots = np.zeros((20, 4))
    dots[:, 1] = 1.25e-4
    dots[:, 3] = 1e-4
    np.testing.assert_allclose(
        estimates(run(pipeline.process, exact_chunk(dots)), 'exact'), [[0.0, -1e-4, 0.0]], atol=1e-9
    )


@pytest.mark.parametrize(('index', 'blocks'), [(25, 2), (26, 1)])
def test_a_zero_reaches_back_over_half_a_second_without_samples(rig: Rig, index: int, blocks: int) -> None:
    pipeline = Pipeline(rig)
    for first, x in ((0, 1e-6), (20 * index, 2e-6)):
        run(pipeline.process, exact_chunk(np.tile([x, 0.0, 0.0, 0.0], (20, 1)), first))
    change = pipeline.zero()
    assert change is not None
    assert dict(change.values)['psd_1.zero'] == pytest.approx((1.5e-6 if blocks == 2 else 2e-6, 0.0), abs=1e-10)


def test_filter_restarts_with_zero_only() -> None:
    pipeline = Pipeline(load_rig(overrides={'filter': 'modal'}))
    first = pipeline.motion_filter
    pipeline.change({'sum_min': 0.5})
    assert pipeline.motion_filter is first is not None
    pipeline.change({'psd_2.zero': (1e-6, 0.0)})
    assert pipeline.motion_filter is not first


def test_what_is_reported_of_a_block(rig: Rig) -> None:
    """Means and covariance of the samples that came, by hand; the time is that of the middle of the block."""
    volts = np.random.default_rng(1).normal(0.0, 2e-3, (20, 6))
    volts[:, [2, 5]] += (4.0, 5.0)
    seq = np.array([n for n in range(40, 60) if n not in (43, 50)])
    chunk = RawChunk(seq, seq * 1_000_000 + 7, volts[seq - 40].astype(np.float32), np.zeros(18, np.uint8))
    pipeline = Pipeline(rig)
    records = run(pipeline.process, chunk) + run(pipeline.flush)
    spots = spots_of(records)
    assert (spots.t_ns, spots.index, spots.present, spots.lost) == (49_500_007, 2, 18, 2)
    observed = volts[seq - 40].astype(np.float32).astype(float)
    np.testing.assert_allclose(spots.sums, observed[:, [2, 5]].mean(axis=0), rtol=1e-12)
    assert (spots.status, spots.reason, spots.findings, spots.excluded) == (BlockStatus.OK, '', (), ())
    assert isinstance(records[-1], SampleBlock)
    assert pipeline.last_spots is spots
    assert pipeline.last_estimate is records[0]


@pytest.mark.parametrize(('size', 'every'), [(1, 20), (5, 4), (20, 3)])
def test_decimation_keeps_estimates_and_thins_the_rest(size: int, every: int) -> None:
    counts = still((1e-4, -2e-4, 1e-3), 240 * size, 1)
    names = [DEFLECTION, DEFLECTION_WITH_COVARIANCE, SAMPLES, WRENCH, '/psd_1/spot', '/psd_2/spot']
    names += ['/link_tip/exact/deflection', '/link_tip/wls/deflection', '/link_tip/iterative/deflection']
    published: dict[int, Counter[str]] = {}
    poses: dict[int, list[tuple[float, ...]]] = {}
    for reported in (1, every):
        pipeline = Pipeline(load_rig(overrides={'block_size': size, 'decimation': reported}))
        records = list(pipeline.process(chunk_of(counts)))
        published[reported] = Counter(m.topic for record in records for m in to_messages(record))
        primary = [r for r in records if isinstance(r, DeflectionEstimate) and r.primary]
        poses[reported] = [(*r.pose, *r.covariance) for r in primary]
        assert [r.index for r in records if isinstance(r, SpotMeans)] == list(range(240))
        indices = [r.index for r in records if isinstance(r, SpotMeans) and r.published]
        assert indices == list(range(0, 240, reported))
        assert {r.block for r in records if isinstance(r, DeflectionEstimate) and not r.primary} == set(indices)
    assert published[1] == dict.fromkeys(names, 240)
    assert published[every] == dict.fromkeys(names[:3], 240) | dict.fromkeys(names[3:], 240 // every)
    assert poses[every] == poses[1]


@pytest.mark.slow
def test_decimated_recording_replays_bit_for_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = tmp_path / 'rig.yaml'
    model.write_text('/**:\n  ros__parameters:\n    block_size: 5\n    decimation: 4\n')
    bag = tmp_path / 'each_fifth'
    argv = ['simulate', '--params-file', str(model), '--loads', 'steps:0,0,0;0,-10,5:1', '--out', str(bag)]
    assert main(argv) == 0
    counts = Counter(m.channel.topic for m in open_recording(bag).messages())
    assert (counts[DEFLECTION], counts[WRENCH], counts['/psd_1/spot']) == (400, 100, 100)
    assert main(['replay', str(bag), '--compare', '--strict']) == 0
    assert 'no bit differs' in capsys.readouterr().out


@pytest.mark.parametrize(('size', 'lost', 'status'), [(1, 0, 'OK'), (4, 1, 'TOO_FEW_SAMPLES'), (20, 10, 'OK')])
def test_block_below_min_samples_needs_all_its_samples(size: int, lost: int, status: str) -> None:
    pipeline = Pipeline(load_rig(overrides={'block_size': size}))
    chunk = chunk_of(still((0.0, 0.0, 0.0), size - lost, 2))
    records = [*pipeline.process(chunk), *pipeline.flush()]
    assert [r.status.name for r in records if isinstance(r, SpotMeans)] == [status]
