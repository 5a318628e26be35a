# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What joins noise, fit and check: each part asked by itself, against what it should say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from psd_deflection.measure.uncertainty.consistency import ConsistencyCheck
from psd_deflection.measure.uncertainty.stamped import PlateModel, StampedDots
from psd_deflection.model.plate.plate import Tilts, flat_points, plate_points
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


def checked(contradict: bool) -> ConsistencyCheck:
    return ConsistencyCheck(1.0, contradict, (1e-6,) * 4, (0.0,) * 4)


def unknowns_of(tilts: Tilts) -> int:
    return 5 if tilts == 'free' else 3


@pytest.mark.parametrize('tilts', ['none', 'tied', 'bounded', 'free'])
@pytest.mark.parametrize('kept', [[0, 1, 2], [0, 2]])
def test_a_plate_model_leaves_what_it_does_not_explain_and_nothing_else(tilts: Tilts, kept: list[int]) -> None:
    if tilts == 'free' and len(kept) == 2:
        return
    rig = rig_of(3)
    model = PlateModel(rig, kept, tilts)
    k = {'none': 0.0, 'free': 0.0}.get(tilts, rig.link.slope_ratio / rig.link.length)
    rng = np.random.default_rng(1)
    poses = rng.uniform(-1.0, 1.0, (6, 5)) * (3e-3, 3e-3, 0.03, 0.01, 0.01)
    if tilts != 'free':
        poses[:, 3], poses[:, 4] = -k * poses[:, 1], k * poses[:, 0]
    heights = np.zeros(len(kept)) if tilts == 'none' else rig.heights[kept]
    beams = (rig.centers + rig.zeros)[kept]
    np.testing.assert_array_equal(model.beams, beams)
    exact = (plate_points(poses, beams, heights) - rig.centers[kept]).reshape(6, -1)
    assert np.abs(model.left(exact)).max() < 1e-10
    # Of small errors about rest: what least squares of the slopes leaves.
    errors = 1e-7 * rng.normal(size=(4, 2 * len(kept)))
    slopes = model.slopes_at((0.0,) * 5)
    assert slopes.shape == (2 * len(kept), unknowns_of(tilts))
    at_rest = rig.zeros[kept].ravel()
    want = errors - errors @ np.linalg.pinv(slopes).T @ slopes.T
    np.testing.assert_allclose(model.left(at_rest + errors), want, atol=1e-12)


def test_steps_from_rest_end_below_a_tenth_of_a_nanometre_at_the_largest_poses() -> None:
    """3 mm, 3 degrees and tilts of half a degree: after six steps more than a nanometre is left."""
    rig = rig_of(3)
    poses = np.array([[3e-3, -3e-3, 0.05, 0.01, 0.01]])
    model = PlateModel(rig, range(3), 'free')
    dots = (plate_points(poses, rig.centers + rig.zeros, rig.heights) - rig.centers).reshape(1, -1)
    assert np.abs(model.left(dots)).max() < 1e-10


def test_of_a_flat_plate_the_residual_is_computed_anew() -> None:
    """That of a method for small angles has its own error in it; another model's is taken as it is."""
    rig = rig_of(3)
    pose = np.array([2e-3, -3e-3, 0.05])
    dots = flat_points(pose, rig.centers + rig.zeros).ravel() - rig.centers.ravel()
    told = (1e-5,) * 6
    assert np.abs(PlateModel(rig, range(3), 'none').residual(tuple(dots.tolist()), told)).max() < 1e-15
    for tilts in ('tied', 'bounded', 'free'):
        assert PlateModel(rig, range(3), tilts).residual(tuple(dots.tolist()), told) == told


def test_of_blocks_that_agree_every_tenth_is_held_against_the_suspects(monkeypatch: pytest.MonkeyPatch) -> None:
    stamped, seen = StampedDots(rig_of()), []
    monkeypatch.setattr(stamped._suspect, 'add', lambda dots, errors: seen.append((dots, errors)))
    for block in range(25):
        stamped.suspect(block, (float(block),) * 4, checked(False))
    assert [d[0] for d, _ in seen] == [0.0, 10.0, 20.0]
    assert seen[0][1] == (1e-6,) * 4
    stamped.suspect(7, (7.0,) * 4, checked(True))
    assert len(seen) == 4
    # Of three PSDs another check names them.
    stamped.suspect(10, (7.0,) * 6, checked(True))
    assert len(seen) == 4


def test_words_say_where_the_noise_is_from() -> None:
    stamped = StampedDots(rig_of())
    assert stamped.noise_source() == 'of the rig file until it is measured'
    for rest, words in ((True, 'measured at rest'), (False, 'measured in motion')):
        stamped.noise._seen, stamped.noise.at_rest = 2, rest
        assert stamped.noise_source() == words
        assert dict(stamped.words())['covariance from'] == f'noise {words}'


def test_words_say_the_noise_of_each_reading_beside_the_rig_files() -> None:
    """In um, of a sample and of a mean of twenty, which has the root of a twentieth of it."""
    rig = rig_of(2, {'psd_1.noise': [4e-3, 2e-3], 'converter.bits': 24, 'psd_2.sensitivity': [1e-3, 5e-4]})
    words = dict(StampedDots(rig).noise_words())
    assert list(words) == [f'noise of {name} (um)' for name in ('x1', 'y1', 'x2', 'y2')]
    for name, um in (('x1', 2.0), ('y1', 1.0), ('x2', 2.0), ('y2', 1.0)):
        mean = um / 20.0**0.5
        said = f'{um:.3f} a sample (rig file {um:.3f}), {mean:.3f} a block ({mean:.3f})'
        assert words[f'noise of {name} (um)'] == said


def test_the_mean_of_fewer_samples_is_less_sure_by_their_number() -> None:
    stamped = StampedDots(rig_of())
    whole = stamped.noise.mean_sd() ** 2
    np.testing.assert_allclose(stamped.mean_variances(20), whole, rtol=1e-12)
    np.testing.assert_allclose(stamped.mean_variances(5), 4.0 * whole, rtol=1e-12)


def test_some_of_the_psds_have_their_own_noise() -> None:
    noise = {'psd_1.noise': [1e-3, 2e-3], 'psd_2.noise': [9e-3, 9e-3], 'psd_3.noise': [3e-3, 5e-3]}
    stamped = StampedDots(rig_of(3, noise, **{'converter.bits': 24}))
    some = stamped.some((0, 2), 'tied')
    fitted = stamped.fit_some(some, ALL, np.zeros((20, 6)))
    variances = np.diagonal(fitted.covariance)
    np.testing.assert_allclose(np.sqrt(variances / variances[0]), [1.0, 2.0, 3.0, 5.0], rtol=1e-3)


@pytest.mark.parametrize('psds', [2, 3])
def test_while_noise_is_unknown_readings_may_contradict_each_other_more(psds: int) -> None:
    stamped, times = StampedDots(rig_of(psds)), 16.0
    spread = 1e-12 * np.eye(2 * psds)
    limit = 25.0 if psds == 2 else float(stamped._redundancy._limit)  # type: ignore[union-attr]
    wrong = np.zeros(2 * psds)
    wrong[0] = 1e-6
    rest = tuple((stamped._rig.zeros.ravel()).tolist())

    def said(size: float) -> ConsistencyCheck:
        dots = tuple((np.array(rest) + size * wrong).tolist())
        left = tuple((size * wrong).tolist())
        return stamped.check(dots, left, spread, (0.0,) * 5)

    unit = said(1e-3).chi_square / 1e-6
    stamped.contradictions = 0
    assert not said((0.98 * times * limit / unit) ** 0.5).contradict
    assert stamped.contradictions == 0
    assert said((1.02 * times * limit / unit) ** 0.5).contradict
    assert stamped.contradictions == 1
    assert stamped.chi_square == pytest.approx(1.02 * times * limit, rel=1e-3)
    assert stamped.freedom == (1 if psds == 2 else 3)


@pytest.mark.parametrize('psds', [2, 3])
def test_new_zeros_are_those_of_a_rig_that_always_had_them(psds: int) -> None:
    old, new = rig_of(psds), rig_of(psds, {'psd_1.zero': [2e-3, 1e-3], 'psd_2.zero': [0.0, -1e-3]})
    moved, fresh = StampedDots(old), StampedDots(new)
    rng = np.random.default_rng(3)
    moved.set_zeros(new)
    samples = new.zeros.ravel() + 1e-6 * rng.normal(size=(20, 2 * psds))
    a, b = (of.fit(ALL, samples) for of in (moved, fresh))
    assert a.dots == b.dots
    np.testing.assert_array_equal(a.covariance, b.covariance)
    left = tuple(1e-6 * rng.normal(size=2 * psds))
    answers = [of.check(a.dots, left, a.covariance, (0.0,) * 5) for of in (moved, fresh)]
    assert answers[0] == answers[1]
    for of in (moved, fresh):
        for block in range(100):
            samples = new.zeros.ravel() + 1e-6 * np.random.default_rng(block).normal(size=(20, 2 * psds))
            of.learn(block, ALL, samples, VOLTS[:, : 3 * psds])
    np.testing.assert_array_equal(moved.noise.gamma, fresh.noise.gamma)


def contradicts(of: StampedDots, error: tuple[float, ...]) -> bool:
    dots = of._rig.zeros.ravel() + error
    return of.check(tuple(dots.tolist()), error, 1e-12 * np.eye(len(error)), (0.0,) * 5).contradict


def test_a_contradiction_is_forgotten_with_a_new_zero() -> None:
    for psds in (2, 3):
        stamped = StampedDots(rig_of(psds))
        wrong, right = (1e-4, *(0.0,) * (2 * psds - 1)), (0.0,) * (2 * psds)
        assert contradicts(stamped, wrong)
        assert contradicts(stamped, right)
        stamped.set_zeros(stamped._rig)
        assert not contradicts(stamped, right)


def test_the_first_blocks_of_a_second_change_no_noise_and_the_last_does() -> None:
    """Segments of 50 blocks; the fit then has the new noise, that of some PSDs too."""
    stamped = StampedDots(rig_of(3))
    some = stamped.some((0, 2), 'none')
    assert some is stamped.some((0, 2), 'none')
    rng = np.random.default_rng(4)
    changed = []
    for block in range(150):
        samples = stamped._rig.zeros.ravel() + 3e-6 * rng.normal(size=(20, 6))
        if stamped.learn(block, ALL, samples, VOLTS):
            changed.append(block)
    assert changed == [49, 99, 149]
    still = np.tile(stamped._rig.zeros.ravel(), (20, 1))
    whole, part = stamped.fit(ALL, still), stamped.fit_some(some, ALL, still)
    assert np.sqrt(np.diag(whole.covariance)) == pytest.approx(3e-6 / 20.0**0.5, rel=0.2)
    assert np.sqrt(np.diag(part.covariance)) == pytest.approx(3e-6 / 20.0**0.5, rel=0.2)
    assert len(part.dots) == 4
    assert not StampedDots(rig_of(), flat=False).learn(49, ALL, np.zeros((20, 4)), VOLTS[:, :6])


def test_misfits_are_counted() -> None:
    """A jump of a millimetre within a block: no polynomial of order 4 follows it."""
    stamped = StampedDots(rig_of(3))
    jump = np.tile(stamped._rig.zeros.ravel(), (20, 1))
    stamped.fit(ALL, jump)
    assert stamped.misfits == 0
    jump[10:] += 1e-3
    stamped.fit(ALL, jump)
    assert stamped.misfits == 1
    stamped.fit_some(stamped.some((0, 1), 'none'), ALL, jump)
    assert stamped.misfits == 2


def test_what_of_a_contradiction_is_remembered_goes_with_the_rule() -> None:
    for rule, kept in (('widen', (1.0, 2.0, 3.0)), ('report', (1.0,)), ('refuse', (1.0,))):
        one = StampedDots(rig_of(consistency=rule))
        assert 'state.residual' not in one.memory()
        one._consistency.held, one._consistency.mean, one._consistency.lasting = 1.0, 2.0, 3.0
        memory = one.memory()
        assert memory['state.residual'] == kept
        other = StampedDots(rig_of(consistency=rule))
        other.restore(memory)
        said = other._consistency
        assert (said.held, said.mean, said.lasting) == (*kept, 0.0, 0.0)[:3]
    assert set(StampedDots(rig_of(), flat=False).memory()) == {'state.block_fit'}
    assert set(StampedDots(rig_of()).memory()) == {'state.noise', 'state.block_fit'}


def test_the_fit_of_some_psds_goes_on_from_the_memory() -> None:
    one, other = StampedDots(rig_of(3)), StampedDots(rig_of(3))
    rng = np.random.default_rng(5)
    for _ in range(20):
        one.fit_some(one.some((0, 2), 'none'), ALL, 1e-5 * rng.normal(size=(20, 6)))
    memory = one.memory()
    assert 'state.psds.0_2' in memory
    other.restore(memory)
    assert other.memory()['state.psds.0_2'] == memory['state.psds.0_2']
    samples = 1e-5 * rng.normal(size=(20, 6))
    a, b = (of.fit_some(of.some((0, 2), 'none'), ALL, samples) for of in (one, other))
    assert a.dots == b.dots
    # One that was there before is begun anew.
    other.restore(memory)
    assert other.some((0, 2), 'none').state() == memory['state.psds.0_2']


def test_a_psd_that_is_left_out_is_named() -> None:
    stamped = StampedDots(rig_of(3))
    assert stamped.most_likely_wrong() == ''
    stamped.left_out = (2,)
    assert stamped.most_likely_wrong() == 'psd_2 does not fit the others and is left out'
    stamped.left_out = (1, 3)
    assert stamped.most_likely_wrong() == 'psd_1 and psd_3 does not fit the others and is left out'


@pytest.mark.parametrize(('tilts', 'freedom'), [('bounded', 0), ('none', 1)])
def test_of_a_tilt_that_is_not_known_nothing_is_redundant(tilts: Tilts, freedom: int) -> None:
    stamped = StampedDots(rig_of(3), tilts='free')
    some = stamped.some((0, 1), tilts)
    rest = tuple(stamped._rig.zeros[:2].ravel().tolist())
    args = rest, (0.0,) * 4, 1e-12 * np.eye(4), (0.0,) * 5
    assert stamped.agree(some, *args) == bool(freedom)
    assert stamped.check(*args, some=some).freedom == freedom
    assert stamped.freedom == freedom


def test_at_first_nothing_has_been_counted() -> None:
    of = StampedDots(rig_of())
    assert (of.contradictions, of.misfits, of.chi_square, of.freedom, of.left_out) == (0, 0, 0.0, 1, ())
    assert dict(of.words())['blocks whose readings contradict each other'] == '0'


@pytest.mark.parametrize('psds', [2, 3])
def test_noise_and_fit_go_on_from_the_memory(psds: int) -> None:
    one, other = (StampedDots(rig_of(psds)) for _ in range(2))
    rng = np.random.default_rng(6)
    for block in range(110):
        samples = one._rig.zeros.ravel() + 3e-6 * rng.normal(size=(20, 2 * psds))
        one.fit(ALL, samples)
        one.learn(block, ALL, samples, VOLTS[:, : 3 * psds])
    other.restore(one.memory())
    assert other.memory() == one.memory()
    samples = one._rig.zeros.ravel() + 3e-6 * rng.normal(size=(20, 2 * psds))
    a, b = one.fit(ALL, samples), other.fit(ALL, samples)
    assert a.dots == b.dots
    np.testing.assert_array_equal(a.covariance, b.covariance)
    # With nothing to go on from it begins anew.
    fresh = StampedDots(rig_of(psds))
    fresh.restore({})
    assert fresh.fit(ALL, samples).dots != a.dots


def test_the_base_line_is_between_the_places_of_the_dots() -> None:
    """Its direction and with it each reading's part: of centres that differ in both axes, and dots of centimetres."""
    stamped = StampedDots(rig_of(2, {'psd_1.center': [0.02, 0.07], 'psd_2.center': [-0.1, 0.03]}))
    dots = np.array([0.03, -0.01, -0.02, 0.015])
    residual = np.array([1e-6, -2e-6, 3e-6, 5e-6])
    spread = np.diag([1.0, 2.0, 3.0, 4.0]) * 1e-12
    way = np.array([0.02 + 0.1, 0.07 - 0.03]) + dots[:2] - dots[2:]
    a = np.concatenate((way, -way)) / np.hypot(*way) / 2.0**0.5
    got = stamped.check(tuple(dots.tolist()), tuple(residual.tolist()), spread)
    assert got.chi_square == pytest.approx((a @ residual) ** 2 / (a @ spread @ a), rel=1e-9)
    np.testing.assert_allclose(got.errors, (a @ residual) / a, rtol=1e-9)
