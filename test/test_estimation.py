"""The uncertainty of an estimate by rules of one line: a held twist, half the light, light from elsewhere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np
import pytest

from psd_deflection.config import load_rig
from psd_deflection.estimation import Estimation, Readings
from psd_deflection.misalignment.model import INDEX
from psd_deflection.pipeline import Pipeline
from psd_deflection.records import DeflectionEstimate, FloatArray, RawChunk
from psd_deflection.solvers.interface import SolverStatus

MEAN = {'block_fit': 'mean', 'covariance': 'file'}


def chunk(volts: FloatArray, first: int = 0) -> RawChunk:
    seq = np.arange(first, first + len(volts))
    return RawChunk(seq, seq * 1_000_000, volts.astype(np.float32), np.zeros(len(seq), np.uint8))


def estimates(volts: FloatArray, values: Mapping[str, object]) -> list[DeflectionEstimate]:
    """The primary ones of blocks of 20."""
    pipeline = Pipeline(load_rig(overrides=values))
    return [r for r in pipeline.process(chunk(volts)) if isinstance(r, DeflectionEstimate) and r.primary]


def at_rest(blocks: int, total: float = 5.0) -> FloatArray:
    volts = np.zeros((20 * blocks, 6))
    volts[:, 2::3] = total
    return volts


@pytest.mark.parametrize('seconds', [0.02, 0.5])
def test_the_variance_of_a_held_twist_grows_to_that_of_any_twist(seconds: float) -> None:
    """Ornstein-Uhlenbeck: v + s^2 (1 - exp(-t/T)), and the variance of the translation by the lever of the twist."""
    blocks = 1 + round(seconds / 0.02)
    volts = at_rest(blocks)
    volts[20:, :3] = 0.0
    found = estimates(volts, {**MEAN, 'degraded': 'hold', 'twist_sd': 0.01, 'twist_hold': 0.7})
    assert len(found) == blocks
    first, last = (np.array(e.covariance).reshape(3, 3) for e in (found[0], found[-1]))
    want = first[2, 2] + 1e-4 * (1.0 - math.exp(-seconds / 0.7))
    assert last[2, 2] == pytest.approx(want, rel=1e-11, abs=0.0)
    assert found[-1].theta == found[0].theta
    # PSD 2 is 0.1 m from the tip's axis along -X: a twist moves its dot in y.
    assert last[1, 1] - last[0, 0] == pytest.approx(0.1**2 * want, rel=1e-3)


def test_half_the_light_doubles_the_noise_of_the_readings() -> None:
    values = {**MEAN, 'splitter': True}
    (full,), (half,) = (np.array([e.covariance for e in estimates(at_rest(1, v), values)]) for v in (5.0, 2.5))
    np.testing.assert_allclose(half, 4.0 * full, rtol=1e-9, atol=1e-24)


def test_other_light_may_come_from_anywhere_on_the_active_area() -> None:
    """A share b of light from a place that is uniform over the length L: variance (b L/2)^2/3 in each reading."""
    length, share = 10e-3, (8.0 - 5.0) / 8.0
    dark, bright = (np.array(estimates(at_rest(1, v), MEAN)[0].covariance) for v in (5.0, 8.0))
    # Readings of one variance v: that of the twist is v over the sum of squares about the middle of the base line.
    own = dark[8] * (0.1**2 + 0.07**2) / 2.0
    np.testing.assert_allclose(bright, dark * (1.0 + (share * length / 2.0) ** 2 / 3.0 / own), rtol=1e-6, atol=1e-20)


def calibrated(**sds: float) -> dict[str, object]:
    """A calibration that left these standard deviations; a name with ``__`` for the dot."""
    left = {name.replace('__', '.'): sd for name, sd in sds.items()}
    return {'calibration.names': [*INDEX], 'calibration.sds': [left.get(name, 0.0) for name in INDEX]}


def test_the_chi_square_allows_for_what_a_calibration_left_open() -> None:
    """r = a e with a = (n, -n)/sqrt 2 along the base line: r^2 over a C a, to which a zero's s^2 adds a_x^2 s^2."""
    volts = at_rest(1)
    volts[:, 0] = 20e-6 / 5e-4
    sure, unsure = (estimates(volts, calibrated(psd_1__zero_x=sd))[0] for sd in (0.0, 3e-6))
    square = 0.1**2 / (0.1**2 + 0.07**2) / 2.0
    own = square * (20e-6) ** 2 / sure.chi_square
    assert own == pytest.approx((2e-3 * 5e-4) ** 2 / 20.0, rel=0.05)
    assert unsure.chi_square == pytest.approx(square * (20e-6) ** 2 / (own + square * (3e-6) ** 2), rel=1e-3)


@pytest.mark.parametrize(('name', 'adds'), [('psd_2__zero_x', (0,)), ('psd_2__zero_y', (1,)), ('psd_1__zero_x', ())])
def test_the_translation_by_one_detector_is_as_unsure_as_its_zero(name: str, adds: tuple[int, ...]) -> None:
    volts = at_rest(2)
    volts[20:, :3] = 0.0
    sure, unsure = (
        np.array(estimates(volts, {**calibrated(**{name: sd}), 'degraded': 'hold'})[1].covariance).reshape(3, 3)
        for sd in (0.0, 3e-6)
    )
    more = (unsure - sure).diagonal()
    # The twist that is held is unsure as well, with the lever of PSD 2 along X.
    want = [9e-12 if axis in adds else 0.0 for axis in (0, 1)]
    np.testing.assert_allclose([more[0], more[1] - 0.1**2 * more[2]], want, rtol=1e-2, atol=1e-14)


def test_a_reading_that_contradicts_the_others_widens_the_covariance_of_a_mean_too() -> None:
    volts = at_rest(1)
    volts[:, 0] = 1e-3 / 5e-4
    (widened,), (reported,) = (estimates(volts, {**MEAN, 'consistency': c}) for c in ('widen', 'report'))
    assert widened.pose == reported.pose
    # The truth is rest.
    assert max(np.abs(widened.pose) / np.sqrt(np.array(widened.covariance)[[0, 4, 8]])) < 2.0
    assert max(np.abs(reported.pose) / np.sqrt(np.array(reported.covariance)[[0, 4, 8]])) > 100.0


def test_a_solver_that_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    estimation = Estimation(load_rig(overrides={'solver': 'wls'}), ())
    failed = SimpleNamespace(status=SolverStatus.NOT_CONVERGED)
    monkeypatch.setattr(type(estimation.primary), 'solve', lambda *_: failed)
    assert estimation._solve(0, Readings((0.0,) * 4, (1e-12,) * 4)) == (None, 'wls: not converged')
