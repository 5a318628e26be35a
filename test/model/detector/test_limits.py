# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where a block stops being good: each limit from both sides, in numbers worked out by hand."""

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from psd_deflection.measure.averaging import BlockMeasures, measured
from psd_deflection.measure.health import Loudness, OpticsHealth, Verdict
from psd_deflection.records import FLAG_OVER_RANGE, BlockStatus, SampleBlock
from psd_deflection.rig.config import load_rig

STEP = 10.0 / 32768
GOOD = (0.5, -0.5, 5.0, 0.25, -0.25, 5.0)
DOTS = (2.5e-4, -2.5e-4, 1.25e-4, -1.25e-4)


def of(volts: npt.NDArray[np.float32], dots: tuple[float, ...] = ()) -> BlockMeasures:
    """The measures of a block with these ``dots`` as its means."""
    samples = np.zeros((len(volts), volts.shape[1] // 3 * 2))
    return measured([volts.astype(np.float32)], [samples])[0]._replace(means=dots)


def classify(
    volts: tuple[float, ...] = GOOD,
    dots: tuple[float, ...] = DOTS,
    *,
    present: int = 20,
    flag: int = 0,
    frozen: tuple[int, int] = (0, 0),
    outlier: tuple[float, ...] | None = None,
    **overrides: object,
) -> Verdict:
    """``outlier``: volts of a single sample of the block."""
    rig = load_rig(overrides={**overrides})
    rows = np.tile(np.array(volts, np.float32), (present, 1))
    if outlier is not None:
        rows[present // 2] = outlier
    flags = np.zeros(present, np.uint8)
    flags[3] = flag
    seq = np.arange(present)
    block = SampleBlock(0, seq, seq * 1_000_000, rows, flags)
    return OpticsHealth(rig).classify(block, of(rows, dots), frozen)


def changed(i: int, value: float) -> tuple[float, ...]:
    return (*GOOD[:i], value, *GOOD[i + 1 :])


@pytest.mark.parametrize(('psd', 'channel'), [(1, 2), (2, 5)])
def test_a_laser_is_lost_below_the_least_sum_even_in_one_sample(psd: int, channel: int) -> None:
    assert classify() == Verdict(BlockStatus.OK, '', 0)
    least = load_rig().estimator.sum_min
    lost = classify(outlier=changed(channel, least - 0.001))
    assert (lost.status, lost.faulty, lost.faults) == (BlockStatus.LASER_LOST, psd, frozenset({psd}))
    assert lost.reason == f'laser {psd} lost: sum {least - 0.001:.3f} V, below {least:g} V'
    assert classify(outlier=changed(channel, least + 0.001)).status is BlockStatus.OK
    # Half of it if two lasers share the detectors.
    assert classify(outlier=changed(channel, 0.5 * least + 0.001), splitter=True).status is BlockStatus.OK
    assert classify(outlier=changed(channel, 0.5 * least - 0.001), splitter=True).faulty == psd


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize('channel', range(6))
def test_a_channel_is_saturated_from_the_converters_last_step_on(channel: int, sign: float) -> None:
    if channel in (2, 5) and sign < 0.0:
        return
    name = ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')[channel]
    full = classify(outlier=changed(channel, sign * 32767 * STEP))
    assert (full.status, full.faulty) == (BlockStatus.SATURATED, 1 + channel // 3)
    assert full.reason == f'{name} saturated: 10.000 V, converter.full_scale is 10 V'
    assert classify(outlier=changed(channel, sign * 32765 * STEP)).status is BlockStatus.OK


def test_device_flag_blames_no_detector_without_cause() -> None:
    reported = classify(flag=FLAG_OVER_RANGE)
    assert (reported.status, reported.faulty) == (BlockStatus.SATURATED, 0)
    assert classify(changed(2, 0.0), flag=FLAG_OVER_RANGE).status is BlockStatus.LASER_LOST


@pytest.mark.parametrize(('blocks', 'status'), [(4, BlockStatus.OK), (5, BlockStatus.FROZEN)])
def test_frozen_detector_is_rejected_after_five_blocks(blocks: int, status: BlockStatus) -> None:
    for psd, frozen in ((1, (blocks, 0)), (2, (0, blocks))):
        got = classify_frozen(frozen)
        assert got.status is status
        assert got.faulty == (psd if status is BlockStatus.FROZEN else 0)
        assert classify(frozen=frozen).status is BlockStatus.OK


def classify_frozen(frozen: tuple[int, int]) -> Verdict:
    rig = load_rig()
    rig = dataclasses.replace(rig, estimator=dataclasses.replace(rig.estimator, frozen='reject'))
    rows = np.tile(np.array(GOOD, np.float32), (20, 1))
    block = SampleBlock(0, np.arange(20), np.arange(20) * 1_000_000, rows, np.zeros(20, np.uint8))
    return OpticsHealth(rig).classify(block, of(rows, DOTS), frozen)


@pytest.mark.parametrize('axis', range(4))
def test_a_dot_is_outside_beyond_half_the_active_area(axis: int) -> None:
    half = 4e-3 if axis % 2 else 3e-3
    areas: dict[str, Any] = {'psd_1.active_area': [6e-3, 8e-3], 'psd_2.active_area': [6e-3, 8e-3]}
    for sign in (1.0, -1.0):
        for off, status in ((1e-6, BlockStatus.OUTSIDE_ACTIVE_AREA), (-1e-6, BlockStatus.OK)):
            dots = list(DOTS)
            dots[axis] = sign * (half + off)
            got = classify(dots=tuple(dots), **areas)
            assert got.status is status
            assert got.faulty == (1 + axis // 2 if off > 0 else 0)


def test_too_few_samples_leave_no_detector_to_go_on_with() -> None:
    assert classify(present=10).status is BlockStatus.OK
    few = classify(present=9)
    assert (few.status, few.faulty) == (BlockStatus.TOO_FEW_SAMPLES, 0)
    assert few.reason == '9 of 20 samples, at least 10 are needed'
    # A lost laser says more; but the other detector has too few samples too.
    dark = classify(changed(2, 0.0), present=9)
    assert (dark.status, dark.faulty, dark.faults) == (BlockStatus.LASER_LOST, 0, frozenset({1}))


def test_worst_cause_is_first_and_both_psds_are_faulty() -> None:
    off = (1.0, 0.0, 1.25e-4, -1.25e-4)
    both = classify(changed(5, 0.0), off)
    assert (both.status, both.faulty, both.faults) == (BlockStatus.LASER_LOST, 0, frozenset({1, 2}))
    assert both.reason.startswith('laser 2')
    assert classify(changed(2, 0.0), off).reason.startswith('laser 1')
    assert classify(changed(3, 10.0), (*DOTS[:2], 1.0, 0.0)).status is BlockStatus.SATURATED


@pytest.mark.parametrize(('share', 'reported'), [(0.34, False), (0.36, True), (0.64, True), (0.66, False)])
def test_half_the_light_on_both_is_one_laser_of_two(share: float, reported: bool) -> None:
    nominal = load_rig().amplifier.sum_nominal
    volts = (*GOOD[:2], share * nominal, *GOOD[3:5], share * nominal)
    got = classify(volts, splitter=True)
    assert got.half_light == reported
    assert any('half the light' in f for f in got.findings) == reported
    assert not classify((*volts[:5], nominal), splitter=True).half_light
    assert not classify(volts).half_light


def test_other_light_or_clipped_spot_names_detector() -> None:
    most = load_rig().estimator.sum_max
    for psd, channel in ((1, 2), (2, 5)):
        assert classify(outlier=changed(channel, most + 0.01)).findings == (
            f'psd_{psd} sees other light: sum {most + 0.01:.3f} V, above {most:g} V',
        )
        assert classify(outlier=changed(channel, most - 0.01)).findings == ()
    area, radius = load_rig().psds[0].active_area, load_rig().psds[0].spot_radius
    for axis in range(4):
        edge = area[axis % 2] / 2.0 - radius
        for off, reported in ((1e-6, True), (-1e-6, False)):
            dots = (*DOTS[:axis], -edge - off, *DOTS[axis + 1 :])
            message = (f'psd_{1 + axis // 2}: the spot is clipped at the edge',) if reported else ()
            assert classify(dots=dots).findings == message


def test_faultless_detectors_are_sound_with_enough_samples() -> None:
    assert classify(changed(2, 0.0)).sound == (1,)
    assert classify(changed(5, 0.0)).sound == (0,)
    assert classify((*GOOD[:2], 0.0, *GOOD[3:5], 0.0)).sound == ()
    assert classify(changed(2, 0.0), present=9).sound == ()
    assert classify(changed(2, 0.0), present=10).sound == (1,)
    assert classify((*GOOD[:2], 0.0, *GOOD[3:5], 0.0)).reason.startswith('laser 1')


@pytest.mark.parametrize('channel', range(6))
def test_a_detector_is_still_if_x_y_and_sum_are(channel: int) -> None:
    health = OpticsHealth(load_rig())
    volts = np.tile(np.array(GOOD, np.float32), (10, 1))
    assert health.still(of(volts)) == (True, True)
    assert health.still(of(volts[:9])) == (False, False)
    for row in (0, 1, 9):
        moved = volts.copy()
        moved[row, channel] += np.float32(STEP)
        assert health.still(of(moved)) == ((False, True) if channel < 3 else (True, False))


@pytest.mark.parametrize(('noise', 'still'), [(STEP, False), (1.01 * STEP, True)])
def test_a_detector_of_noise_below_a_step_may_be_constant(noise: float, still: bool) -> None:
    volts = np.tile(np.array(GOOD, np.float32), (10, 1))
    assert OpticsHealth(load_rig(overrides={'amplifier.noise': noise})).still(of(volts)) == (still, still)


@pytest.mark.parametrize('channel', range(6))
@pytest.mark.parametrize('size', [10, 20])
def test_noise_is_separated_at_five_times_rig_noise(channel: int, size: int) -> None:
    """The third difference of a, -a, a ... is 8 a, that of white noise of s has the rms s sqrt(20)."""
    sigma = 1e-4
    rig = load_rig(overrides={'amplifier.noise': sigma, 'block_size': size, 'min_samples': size // 2})
    limit = 5.0 * np.sqrt(sigma**2 + STEP**2 / 12.0)
    for share, reported in ((0.99, 0), (1.01, 1)):
        volts = np.zeros((size, 6))
        volts[:, channel] = share * limit * np.sqrt(20.0) / 8.0 * (-1.0) ** np.arange(size)
        findings = OpticsHealth(rig).late_findings(
            of(volts.astype(np.float32)), Verdict(BlockStatus.OK, '', 0), (0, 0), Loudness()
        )
        assert findings == (f'psd_{1 + channel // 3} is noisy: {share * limit * 1e3:.1f} mV a sample',) * reported


def test_nine_sample_blocks_and_gaps_report_no_noise() -> None:
    volts = np.tile((-1.0) ** np.arange(20, dtype=np.float32)[:, None], (1, 6)).astype(np.float32)
    for size, present in ((9, 9), (20, 19)):
        rig = load_rig(overrides={'block_size': size, 'min_samples': 4})
        assert (
            OpticsHealth(rig).late_findings(of(volts[:present]), Verdict(BlockStatus.OK, '', 0), (0, 0), Loudness())
            == ()
        )


def test_a_frozen_detector_is_a_finding_unless_it_is_a_fault() -> None:
    volts = np.tile(np.array(GOOD, np.float32), (20, 1))
    health, ok = OpticsHealth(load_rig()), Verdict(BlockStatus.OK, '', 0)
    blamed = Verdict(BlockStatus.LASER_LOST, '', 2, faults=frozenset({2}))
    message = ('psd_1 stands still: no bit has moved for 5 blocks', 'psd_2 stands still: no bit has moved for 7 blocks')
    assert health.late_findings(of(volts), ok, (5, 7), Loudness()) == message
    assert health.late_findings(of(volts), ok, (4, 7), Loudness()) == message[1:]
    assert health.late_findings(of(volts), blamed, (5, 7), Loudness()) == message[:1]
    rejects = OpticsHealth(load_rig(overrides={'frozen': 'reject'}))
    assert rejects.late_findings(of(volts), ok, (5, 7), Loudness()) == ()


def test_other_light_counts_over_each_detectors_own_area() -> None:
    """Of three, whose larger sides are 6, 8 and 10 mm."""
    areas = {f'psd_{n}.active_area': [2e-3 * n, 4e-3 + 2e-3 * n] for n in (1, 2, 3)}
    rig = load_rig(overrides={'sum_max': 6.0, 'psd_3.center': [0.08, -0.06], **areas})
    share = (8.0 - rig.amplifier.sum_nominal) / 8.0
    want = [(share * half) ** 2 / 3.0 for half in (3e-3, 4e-3, 5e-3)]
    assert OpticsHealth(rig).background_variance((8.0,) * 3) == pytest.approx(want)
