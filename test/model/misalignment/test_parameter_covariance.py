# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The covariance of a calibrated rig: against many rigs whose parameters are wrong by what the file says."""

import numpy as np
import pytest

from psd_deflection.measure.estimation import SYSTEMATIC, ZERO_VARIANCES
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.misalignment.model import COUNT, INDEX, readings
from psd_deflection.model.misalignment.rig import ParameterCovariance, known_of_rig, vector_of_rig
from psd_deflection.records import DeflectionEstimate, FloatArray, ParameterChange, RawChunk, Record, TipMotion
from psd_deflection.rig.config import Rig, rig_from_values
from test import streams

NAMES = ['psd_1.rotation', 'psd_1.gain_x', 'psd_2.gain_y', 'psd_2.center_x', 'psd_1.zero_x']
SDS = [0.005, 0.004, 0.003, 2e-4, 3e-6]
POSE = (1.5e-3, -2e-3, 0.015)


def calibrated(**more: object) -> Rig:
    rest = [n for n in INDEX if n not in NAMES]
    values = {'calibration.names': [*NAMES, *rest], 'calibration.sds': [*SDS, *([0.0] * len(rest))]}
    return rig_from_values({**values, 'solvers': ['exact', 'wls', 'iterative', 'ols'], **more})


def chunk_of(dots: FloatArray, first: int = 0) -> RawChunk:
    n = len(dots)
    volts = np.full((n, 6), 5.0)
    volts[:, [0, 1, 3, 4]] = dots / 5e-4
    seq = np.arange(first, first + n)
    return RawChunk(seq, seq * 1_000_000, volts.astype(np.float32), np.zeros(n, np.uint8))


def estimates(records: list[Record]) -> dict[str, DeflectionEstimate]:
    return {r.solver: r for r in records if isinstance(r, DeflectionEstimate)}


def still(rig: Rig, pose: tuple[float, ...], n: int) -> FloatArray:
    p = vector_of_rig(rig).as_used
    return np.repeat(readings(p, np.array(pose)[:, None], rig.link.length).T, n, axis=0)


@pytest.mark.slow
def test_every_solver_spreads_as_rigs_that_differ_by_that_much() -> None:
    """300 rigs drawn from the file's covariance show the same pose; the file knows none of them."""
    # Each rig is a jump for the one that measures; only the parameters are asked about.
    rig = calibrated(consistency='report')
    rng = np.random.default_rng(1)
    p = vector_of_rig(rig).as_used
    known = known_of_rig(rig).covariance
    drawn = p + rng.multivariate_normal(np.zeros(COUNT), known, 300)
    pose = np.array(POSE)[:, None]
    dots = np.concatenate([readings(q, pose, rig.link.length) for q in drawn], axis=1).T
    pipeline = Pipeline(rig)
    solved: dict[str, list[tuple[float, ...]]] = {}
    reported: dict[str, DeflectionEstimate] = {}
    for i, row in enumerate(dots):
        for name, e in estimates([*pipeline.process(chunk_of(np.repeat(row[None], 20, axis=0), 20 * i))]).items():
            solved.setdefault(name, []).append(e.pose)
            reported.setdefault(name, e)
    for name, poses in solved.items():
        observed, message = np.cov(np.array(poses).T), np.array(reported[name].covariance).reshape(3, 3)
        sd = np.sqrt(np.diag(observed))
        assert np.sqrt(np.diag(message)) == pytest.approx(sd, rel=0.17), name
        assert message / np.outer(sd, sd) == pytest.approx(observed / np.outer(sd, sd), abs=0.25), name


def test_the_polynomial_is_what_it_stands_for() -> None:
    from psd_deflection.model.misalignment.rig import dots_by_parameters

    rig = calibrated()
    parameter_covariance = ParameterCovariance.from_rig(rig)
    assert parameter_covariance is not None
    rng = np.random.default_rng(2)
    for dx, dy, theta in rng.uniform(-1.0, 1.0, (20, 3)) * (4e-3, 4e-3, 0.04):
        slopes = dots_by_parameters(vector_of_rig(rig).as_used, np.array([[dx], [dy], [theta]]), 0.585)[0]
        wanted = slopes @ known_of_rig(rig).covariance @ slopes.T
        factor = parameter_covariance.factor(dx, dy, theta)
        assert factor @ factor.T == pytest.approx(wanted, rel=2e-3, abs=1e-3 * float(np.diag(wanted).max()))


def test_a_zero_taken_now_replaces_what_the_file_left_open() -> None:
    """Next to the zero nothing but the noise of zero and block is left, whatever the gains are."""
    rig = calibrated()
    rng = np.random.default_rng(3)
    dots = still(rig, (0.0, 0.0, 0.0), 1200) + rng.normal(0.0, 1e-6, (1200, 4))
    pipeline = Pipeline(rig)
    before = estimates([*pipeline.process(chunk_of(dots[:600]))])['exact']
    change = pipeline.zero()
    assert change is not None
    variances = dict(change.values)[ZERO_VARIANCES]
    assert isinstance(variances, tuple)
    # 1 um a sample, 20 a block, 25 blocks.
    assert np.sqrt(variances) == pytest.approx(np.full(4, 1e-6 / 500**0.5), rel=0.5)
    records = [*pipeline.process(chunk_of(dots[600:], 600))]
    after = estimates(records)['exact']
    assert before.covariance[0] ** 0.5 > 0.9e-6
    assert after.covariance[0] ** 0.5 < 0.5e-6
    for reported in (change, pipeline.snapshot(rig)):
        assert isinstance(reported, ParameterChange)
        assert ZERO_VARIANCES in dict(reported.values)
    other = Pipeline(rig)
    list(other.process(chunk_of(dots[:600])))
    other.apply(change)
    assert next(other.process(chunk_of(dots[600:], 600))) == records[0]


@pytest.mark.parametrize('blocks', [1, 2, 25])
def test_zero_variance_is_block_variance_over_count(blocks: int) -> None:
    """What scatters by more than the noise says is believed; of one block there is only what the noise says."""
    rig = calibrated()
    places = np.random.default_rng(4).normal(0.0, [1e-6, 1e-9, 1e-6, 1e-9], (blocks, 4))
    pipeline = Pipeline(rig)
    list(pipeline.process(chunk_of(np.repeat(places, 20, axis=0))))
    change = pipeline.zero()
    assert change is not None
    noise = 5e-4**2 * (2e-3**2 + (10.0 / 2**15) ** 2 / 12.0) / 20.0
    scatter = ((places - places.mean(axis=0)) ** 2).sum(axis=0) / max(blocks - 1, 1)
    wanted = np.maximum(scatter, noise) / blocks
    np.testing.assert_allclose(pipeline.estimation.zero_variances, wanted, rtol=1e-3)
    assert dict(change.values)[ZERO_VARIANCES] == pipeline.estimation.zero_variances


def test_a_zero_from_elsewhere_is_taken_for_one_of_25_blocks() -> None:
    pipeline = Pipeline(calibrated())
    pipeline.change({'psd_1.zero': (0.0, 1e-6)})
    noise = 5e-4**2 * (2e-3**2 + (10.0 / 2**15) ** 2 / 12.0) / 20.0
    np.testing.assert_allclose(pipeline.estimation.zero_variances, [noise / 25.0] * 4, rtol=1e-9)
    assert pipeline.tip_loads.zeroed
    other = Pipeline(calibrated())
    other.change({'sum_min': 0.5})
    assert (other.estimation.zero_variances, other.tip_loads.zeroed) == ((), False)


def test_systematic_covariance_of_filter_is_restored() -> None:
    """A recording begins with a block in the dark: its motion is as unsure as that of the run."""
    rig = calibrated(filter='modal')
    live, replay, without = Pipeline(rig), Pipeline(rig), Pipeline(rig)
    list(live.process(chunk_of(still(rig, POSE, 200))))
    memory = live.snapshot(rig)
    assert memory is not None
    reported = dict(memory.values)[SYSTEMATIC]
    assert live.estimation.systematic is not None
    assert reported == tuple(live.estimation.systematic.ravel().tolist())
    replay.apply(memory)
    without.apply(streams.without(memory, SYSTEMATIC))
    dark = chunk_of(still(rig, POSE, 20), 200)
    dark.readings[:, :3] = 0.0
    moved = [[r for r in pipeline.process(dark) if isinstance(r, TipMotion)] for pipeline in (live, replay, without)]
    assert moved[0] == moved[1]
    more = np.array(moved[0][0].covariance) - moved[2][0].covariance
    np.testing.assert_allclose(more, reported, rtol=1e-6)
