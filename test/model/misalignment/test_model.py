# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The model of the readings against the optics of blind/, and its derivatives against differences of the whole."""

from __future__ import annotations

import numpy as np
import pytest

from blind import misaligned
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.correction import Correction
from psd_deflection.model.misalignment.model import (
    ALL,
    COUNT,
    INDEX,
    TOLERANCES,
    ZERO,
    by_parameters,
    by_pose,
    readings,
    response_of,
)
from psd_deflection.model.misalignment.rig import known_of_rig, rig_values, vector_of_rig
from psd_deflection.model.simulation.catalogue import effects_to_values
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, rig_from_values

LENGTH = 0.585


@pytest.fixture
def truth() -> dict[str, float]:
    return misaligned.draw(np.random.default_rng(1))


@pytest.fixture
def poses() -> FloatArray:
    return np.asarray(np.random.default_rng(2).uniform(-1.0, 1.0, (3, 50)) * np.array([[3e-3], [3e-3], [0.03]]))


def vector_of(truth: dict[str, float]) -> FloatArray:
    out = np.array([truth.get(d.name, 0.0) for d in ALL])
    out[ZERO:] = misaligned.dots(truth, np.zeros((1, 3)))[0]
    return out


def test_the_readings_are_those_of_rays_in_space(truth: dict[str, float], poses: FloatArray) -> None:
    ours = readings(vector_of(truth), poses, LENGTH)
    assert ours == pytest.approx(misaligned.dots(truth, poses.T).T, abs=1e-11)


def test_the_derivatives_are_those_of_the_readings(truth: dict[str, float], poses: FloatArray) -> None:
    p = vector_of(truth)
    ours = by_parameters(p, poses, LENGTH)
    for i in range(COUNT):
        step = np.zeros(COUNT)
        step[i] = 1e-2 * TOLERANCES[i]
        slope = (readings(p + step, poses, LENGTH) - readings(p - step, poses, LENGTH)) / (2.0 * step[i])
        assert ours[:, i] == pytest.approx(slope, rel=1e-4, abs=1e-10 / TOLERANCES[i]), ALL[i].name
    flat = by_pose(p, np.zeros((3, 1)), LENGTH)[:, :, 0]
    assert flat == pytest.approx(np.array([[-1, 0, 0.07], [0, -1, 0], [-1, 0, 0], [0, -1, 0.1]]), abs=0.03)


def test_a_place_is_read_and_found_again(truth: dict[str, float]) -> None:
    p = vector_of(truth)
    p[INDEX['psd_2.nonlinearity']] = -3000.0
    x, y = np.random.default_rng(3).uniform(-5e-3, 5e-3, (2, 100))
    response = response_of(p, 1)
    assert np.array(response.place(*response.reading(x, y))) == pytest.approx(np.array([x, y]), abs=1e-15)


def test_a_rig_file_of_a_vector_corrects_the_dots(truth: dict[str, float], poses: FloatArray) -> None:
    """Effects, centres, heights and beams of the file: what the pipeline corrects is a flat plate's readings."""
    nominal = rig_from_values({})
    values, effects = rig_values(vector_of_rig(nominal), vector_of(truth), {
        'clamp.bending_compliance': 0.0, 'clamp.torsional_compliance': 0.0,
    })  # fmt: skip
    flat = {f'effects.{key}.{name}': v for key, body in effects_to_values(effects).items() for name, v in body.items()}
    rig = rig_from_values({**values, **flat})
    again = vector_of_rig(rig)
    assert again.values == pytest.approx(vector_of(truth), rel=1e-9, abs=1e-12)
    corrected = Correction.from_rig(rig).apply(misaligned.dots(truth, poses.T))
    c, s = np.cos(poses[2]), np.sin(poses[2])
    for i in range(2):
        center, zero = np.array(rig.psds[i].center), np.array(rig.psds[i].zero)
        u, v = (center + zero)[:, None] - poses[:2]
        plate = np.stack((c * u + s * v, c * v - s * u)) - center[:, None]
        assert pytest.approx(plate, abs=2e-9) == corrected[:, 2 * i : 2 * i + 2].T


@pytest.mark.parametrize(
    ('values', 'words'),
    [
        ({'calibration.names': ['psd_1.rotatoin']}, 'no parameter of a calibration; did you mean psd_1.rotation'),
        ({'calibration.names': ['psd_1.height', 'psd_1.height']}, 'a name is there twice'),
        ({'calibration.names': ['psd_1.height'], 'calibration.sds': [1e-3, 1e-3]}, '2 values for 1 calibration.names'),
        (
            {
                'calibration.names': ['psd_1.height', 'psd_2.height', 'psd_1.rotation'],
                'calibration.sds': [1e-3, 1e-3, 1e-3],
                'calibration.correlations': [0.5, 0.5],
            },
            '2 values for 3 names; must be 3',
        ),
        (
            {
                'calibration.names': ['psd_1.height', 'psd_2.height', 'psd_1.rotation'],
                'calibration.sds': [1e-3, 1e-3, 1e-3],
                'calibration.correlations': [0.9, 0.9, -0.9],
            },
            'contradict each other',
        ),
    ],
)
def test_a_covariance_that_is_none_is_rejected(values: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        known_of_rig(rig_from_values(values))


def test_stated_deviations_and_correlations_are_taken() -> None:
    rig: Rig = rig_from_values(
        {
            'calibration.names': ['psd_1.height', 'psd_2.height'],
            'calibration.sds': [1e-3, 2e-3],
            'calibration.correlations': [-0.5],
        }
    )
    known = known_of_rig(rig)
    at = [INDEX['psd_1.height'], INDEX['psd_2.height']]
    assert known.covariance[np.ix_(at, at)] == pytest.approx(np.array([[1e-6, -1e-6], [-1e-6, 4e-6]]))
    assert known.covariance[0, 0] == pytest.approx(TOLERANCES[0] ** 2)
