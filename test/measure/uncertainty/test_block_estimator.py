# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What joins noise, fit and check: each part asked by itself, against what it should say."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from psd_deflection.measure.uncertainty.block_estimator import BlockEstimator
from psd_deflection.measure.uncertainty.consistency import CONTRADICTS, ConsistencyResult
from psd_deflection.measure.uncertainty.noise import StreamNoise
from psd_deflection.measure.uncertainty.psd_set import PlateModel, PsdSet
from psd_deflection.measure.uncertainty.vibration import why_moving
from psd_deflection.model.plate.plate import Tilts, flat_points, plate_points
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig

THIRD: dict[str, Any] = {
    'psd_1.zero': [1e-3, -2e-3],
    'psd_2.height': 0.05,
    'psd_3.center': [0.08, -0.06],
    'psd_3.height': -0.03,
}
ALL = np.arange(20)
VOLTS = np.full((20, 9), 5.0)


def rig_of(psds: int = 2, named: Mapping[str, object] | None = None, **more: object) -> Rig:
    return load_rig(overrides={**(THIRD if psds == 3 else {}), **(named or {}), **more})


def unknowns_of(tilts: Tilts) -> int:
    return 5 if tilts == 'free' else 3


@pytest.mark.parametrize('tilts', ['none', 'tied', 'bounded', 'free'])
@pytest.mark.parametrize('subset', [[0, 1, 2], [0, 2]])
def test_plate_model_residual_is_the_unexplained_part(tilts: Tilts, subset: list[int]) -> None:
    if tilts == 'free' and len(subset) == 2:
        return
    rig = rig_of(3)
    model = PlateModel(rig, subset, tilts)
    k = {'none': 0.0, 'free': 0.0}.get(tilts, rig.link.slope_ratio / rig.link.length)
    rng = np.random.default_rng(1)
    poses = rng.uniform(-1.0, 1.0, (6, 5)) * (3e-3, 3e-3, 0.03, 0.01, 0.01)
    if tilts != 'free':
        poses[:, 3], poses[:, 4] = -k * poses[:, 1], k * poses[:, 0]
    heights = np.zeros(len(subset)) if tilts == 'none' else rig.heights[subset]
    beams = (rig.centers + rig.zeros)[subset]
    np.testing.assert_array_equal(model.beams, beams)
    exact = (plate_points(poses, beams, heights) - rig.centers[subset]).reshape(6, -1)
    assert np.abs(model.residuals(exact)).max() < 1e-10
    # Of small errors about rest: what least squares of the slopes leaves.
    errors = 1e-7 * rng.normal(size=(4, 2 * len(subset)))
    slopes = model.slopes_at((0.0,) * 5)
    assert slopes.shape == (2 * len(subset), unknowns_of(tilts))
    at_rest = rig.zeros[subset].ravel()
    want = errors - errors @ np.linalg.pinv(slopes).T @ slopes.T
    np.testing.assert_allclose(model.residuals(at_rest + errors), want, atol=1e-12)


def test_steps_from_rest_converge_at_largest_poses() -> None:
    """3 mm, 3 degrees and tilts of half a degree: after six steps more than a nanometre is left."""
    rig = rig_of(3)
    poses = np.array([[3e-3, -3e-3, 0.05, 0.01, 0.01]])
    model = PlateModel(rig, range(3), 'free')
    dots = (plate_points(poses, rig.centers + rig.zeros, rig.heights) - rig.centers).reshape(1, -1)
    assert np.abs(model.residuals(dots)).max() < 1e-10


def test_of_a_flat_plate_the_residual_is_computed_anew() -> None:
    """That of a method for small angles has its own error in it; another model's is taken as it is."""
    rig = rig_of(3)
    pose = np.array([2e-3, -3e-3, 0.05])
    dots = flat_points(pose, rig.centers + rig.zeros).ravel() - rig.centers.ravel()
    reported = (1e-5,) * 6
    assert np.abs(PlateModel(rig, range(3), 'none').residual(tuple(dots.tolist()), reported)).max() < 1e-15
    for tilts in ('tied', 'bounded', 'free'):
        assert PlateModel(rig, range(3), tilts).residual(tuple(dots.tolist()), reported) == reported


def checked(of: BlockEstimator, dots: FloatArray, residual: FloatArray, covariance: FloatArray) -> ConsistencyResult:
    args = tuple(dots.tolist()), tuple(residual.tolist()), covariance, (0.0,) * 5
    return of.check(of.full, of.full.unexplained(*args), None)


@pytest.mark.parametrize('psds', [2, 3])
def test_limits_are_wider_while_the_noise_is_unknown(psds: int) -> None:
    rig, times = rig_of(psds), 16.0
    of, rest = BlockEstimator(rig), rig.zeros.ravel()
    limit = times * float(chi2.isf(CONTRADICTS, 2 * psds - 3))
    error = 1e-9 * np.eye(2 * psds)[0]
    unit = checked(of, rest + error, error, 1e-12 * np.eye(2 * psds)).chi_square
    of.contradictions = 0
    for share, count in ((0.98, 0), (1.02, 1)):
        size = (share * limit / unit) ** 0.5
        checked(of, rest + size * error, size * error, 1e-12 * np.eye(2 * psds))
        assert of.contradictions == count
    assert of.chi_square == pytest.approx(1.02 * limit, rel=1e-3)
    assert of.freedom == 2 * psds - 3


@pytest.mark.parametrize('psds', [2, 3])
def test_new_zeros_are_those_of_a_rig_that_always_had_them(psds: int) -> None:
    old, new = rig_of(psds), rig_of(psds, {'psd_1.zero': [2e-3, 1e-3], 'psd_2.zero': [0.0, -1e-3]})
    moved, fresh = BlockEstimator(old), BlockEstimator(new)
    checked(moved, old.zeros.ravel(), 1e-3 * np.eye(2 * psds)[0], 1e-12 * np.eye(2 * psds))
    moved.set_zeros(new)
    rng = np.random.default_rng(3)
    samples, residual = (new.zeros.ravel() + 1e-6 * rng.normal(size=(n, 2 * psds)) for n in (20, 1))
    fitted, other = (of.full.fit.fit(ALL, samples) for of in (moved, fresh))
    assert fitted[0] == other[0]
    np.testing.assert_array_equal(fitted[1], other[1])
    answers = [checked(of, np.array(fitted[0]), residual[0], fitted[1]) for of in (moved, fresh)]
    assert answers[0] == answers[1]
    for of in (moved, fresh):
        for block in range(100):
            samples = new.zeros.ravel() + 1e-6 * np.random.default_rng(block).normal(size=(20, 2 * psds))
            of.learn(block, ALL, samples, VOLTS[:, : 3 * psds])
    np.testing.assert_array_equal(moved.noise.gamma, fresh.noise.gamma)


def test_segments_change_the_noise_of_all_sets() -> None:
    """Segments of 50 blocks; the fits then have the new noise."""
    rig = rig_of(3)
    of = BlockEstimator(rig)
    subset = of.subset((0, 2), 'none')
    assert subset is of.subset((0, 2), 'none')
    rng = np.random.default_rng(4)
    blocks = [rig.zeros.ravel() + 3e-6 * rng.normal(size=(20, 6)) for _ in range(150)]
    assert [b for b, samples in enumerate(blocks) if of.learn(b, ALL, samples, VOLTS)] == [49, 99, 149]
    still = np.tile(rig.zeros.ravel(), (20, 1))
    for psds, count in ((of.full, 6), (subset, 4)):
        dots, covariance, *_ = psds.fit.fit(ALL, still[:, psds.columns])
        assert np.sqrt(np.diag(covariance)) == pytest.approx(3e-6 / 20.0**0.5, rel=0.2)
        assert len(dots) == count
    # Dots that fall on one another have no direction in which they could be apart.
    one_point = (0.0, 0.0, *(rig.centers[0] - rig.centers[1]).tolist())
    of_two = PsdSet(rig_of(), (0, 1), 'none')
    assert of_two.unexplained(one_point, (0.0,) * 4, np.eye(4), (0.0,) * 5) is None
    assert not BlockEstimator(rig_of(), False).learn(49, ALL, np.zeros((20, 4)), VOLTS[:, :6])


def test_a_subset_has_the_noise_of_its_own_readings() -> None:
    rig, variance = rig_of(3), np.array([1.0, 2.0, 4.0, 8.0]) * 1e-12
    subset = PsdSet(rig, (0, 2), 'none')
    subset.set_noise(StreamNoise(20, rig.centers, rig.centers + rig.zeros, np.insert(variance, 2, (1e-10, 1e-10)), 0.0))
    fitted = subset.fit.fit(ALL, np.tile(rig.zeros.ravel(), (20, 1))[:, subset.columns])
    np.testing.assert_allclose(np.diag(fitted.covariance), variance / 20.0, rtol=0.1)


def test_the_base_line_is_between_the_places_of_the_dots() -> None:
    """Of centres that differ in both axes, and dots of centimetres."""
    of = BlockEstimator(rig_of(2, {'psd_1.center': [0.02, 0.07], 'psd_2.center': [-0.1, 0.03]}))
    dots, residual = np.array([0.03, -0.01, -0.02, 0.015]), np.array([1e-6, -2e-6, 3e-6, 5e-6])
    covariance = np.diag([1.0, 2.0, 3.0, 4.0]) * 1e-12
    way = np.array([0.02 + 0.1, 0.07 - 0.03]) + dots[:2] - dots[2:]
    a = np.concatenate((way, -way)) / np.hypot(*way) / 2.0**0.5
    got = checked(of, dots, residual, covariance)
    assert got.chi_square == pytest.approx((a @ residual) ** 2 / (a @ covariance @ a), rel=1e-9)
    np.testing.assert_allclose(got.errors, (a @ residual) / a, rtol=1e-9)


def test_nothing_is_redundant_while_the_tilt_is_only_bounded() -> None:
    rig = rig_of(3)
    of = BlockEstimator(rig, tilts='free')
    for tilts, freedom in (('bounded', 0), ('none', 1)):
        psds = BlockEstimator(rig, tilts='free').subset((0, 1), tilts)  # type: ignore[arg-type]
        residual = psds.unexplained(tuple(rig.zeros[:2].ravel().tolist()), (0.0,) * 4, 1e-12 * np.eye(4), (0.0,) * 5)
        assert of.check(psds, residual, None).freedom == freedom
        assert psds.check.agrees(residual, 1.0) == bool(freedom)


def moves(um: list[float], noise_um: float = 0.01) -> str:
    """What is said of blocks of which y1 goes through these places."""
    dots = np.zeros((len(um), 4))
    dots[:, 1] = 1e-6 * np.array(um)
    return why_moving(dots, ((1e-6 * noise_um) ** 2,) * 4)


def test_two_blocks_report_nothing_three_do() -> None:
    assert moves([0.0, 50.0]) == ''
    # From the first block to the mean of the others.
    assert moves([0.0, 2.01, 2.01]).startswith('the link moves: y1 varied by 1.2 µm rms in the last 3 blocks, noise')
    assert moves([0.0, 1.99, 1.99]) == ''
    # Of two at 0 and two at 1 m: 1/sqrt 3 m.
    message = moves([0.0, 0.0, 1e6, 1e6], noise_um=1e5)
    assert ' varied by 577350.3 µm rms in the last 4 blocks, noise explains 100000.0 µm; ' in message


@pytest.mark.parametrize(('noise_um', 'drifts', 'scatters'), [(0.01, 2.0, 10.0), (3.0, 15.0, 15.0)])
def test_moving_is_five_times_the_noise_and_micrometres(noise_um: float, drifts: float, scatters: float) -> None:
    for share, message in ((0.99, False), (1.01, True)):
        assert bool(moves([0.0, 0.0, share * drifts, share * drifts], noise_um)) == message
        # Of a, -a, a, -a the standard deviation is 2 a / sqrt 3.
        a = share * scatters * 3.0**0.5 / 2.0
        assert bool(moves([a, -a, a, -a], noise_um)) == message


@pytest.mark.parametrize(
    ('flat', 'words'), [(False, 'noise of the rig file'), (True, 'noise of the rig file until it is measured')]
)
def test_diagnostics_say_whose_noise_it_is(flat: bool, words: str) -> None:
    estimator = BlockEstimator(load_rig(), flat)
    assert dict(estimator.words())['covariance from'] == words
    assert len(estimator.words()) == (6 + len(estimator.noise_words()) if flat else 5)
    # 2 mV and a step of 0.3 mV are 1.001 um a sample; a mean of 20 has that over 4.47.
    assert estimator.noise_words()[0] == ('noise of x1 (um)', '1.001 a sample (rig file 1.001), 0.224 a block (0.224)')


@pytest.mark.parametrize(
    ('more', 'freedom'), [({}, 1), ({'psd_3.center': [0.08, -0.06], 'psd_4.center': [0.0, 0.1]}, 3)]
)
def test_diagnostics_say_how_probable_a_chi_square_is(more: dict[str, object], freedom: int) -> None:
    estimator = BlockEstimator(load_rig(overrides=more))
    estimator.chi_square, estimator.freedom = 6.0, freedom
    assert dict(estimator.words())['p of that chi-square'] == f'{chi2.sf(6.0, freedom):.2g}'
