# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The model of the readings against the optics of blind/, its derivatives, and a rig file's effects as parameters."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from blind import misaligned
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.correction import Correction
from psd_deflection.model.misalignment import model
from psd_deflection.model.misalignment.rig import CLAMP, dots_by_parameters, known_of_rig, rig_values, vector_of_rig
from psd_deflection.model.simulation.catalogue import FOLDERS, catalogue, effects_to_values
from psd_deflection.model.simulation.declaration import CALIBRATED_OF_LINK, CALIBRATED_OF_PSD, PLACED_OF_PSD
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, load_rig, replace_values, rig_from_values

LENGTH = 0.585


@pytest.fixture
def truth() -> dict[str, float]:
    return misaligned.draw(np.random.default_rng(1))


@pytest.fixture
def poses() -> FloatArray:
    return np.asarray(np.random.default_rng(2).uniform(-1.0, 1.0, (3, 50)) * np.array([[3e-3], [3e-3], [0.03]]))


def vector_of(truth: dict[str, float]) -> FloatArray:
    out = np.array([truth.get(d.name, 0.0) for d in model.ALL])
    out[model.ZERO :] = misaligned.dots(truth, np.zeros((1, 3)))[0]
    return out


def test_the_readings_are_those_of_rays_in_space(truth: dict[str, float], poses: FloatArray) -> None:
    ours = model.readings(vector_of(truth), poses, LENGTH)
    assert ours == pytest.approx(misaligned.dots(truth, poses.T).T, abs=1e-11)


def test_the_derivatives_are_those_of_the_readings(truth: dict[str, float], poses: FloatArray) -> None:
    p = vector_of(truth)
    ours = model.by_parameters(p, poses, LENGTH)
    for i in range(model.COUNT):
        step = np.zeros(model.COUNT)
        step[i] = 1e-2 * model.TOLERANCES[i]
        slope = (model.readings(p + step, poses, LENGTH) - model.readings(p - step, poses, LENGTH)) / (2.0 * step[i])
        assert ours[:, i] == pytest.approx(slope, rel=1e-4, abs=1e-10 / model.TOLERANCES[i]), model.ALL[i].name
    flat = model.by_pose(p, np.zeros((3, 1)), LENGTH)[:, :, 0]
    assert flat == pytest.approx(np.array([[-1, 0, 0.07], [0, -1, 0], [-1, 0, 0], [0, -1, 0.1]]), abs=0.03)


def test_error_of_a_parameter_moves_corrected_dots(truth: dict[str, float], poses: FloatArray) -> None:
    """What is read by the true parameters, corrected by wrong ones, of a strongly bent response."""
    p = vector_of(truth)
    p[model.INDEX['psd_1.nonlinearity']] = p[model.INDEX['psd_2.nonlinearity']] = 8000.0
    ours = dots_by_parameters(p, poses, LENGTH)
    for i in range(model.COUNT):
        step = np.zeros(model.COUNT)
        step[i] = 1e-2 * model.TOLERANCES[i]
        ends = []
        for read in (model.readings(p + step, poses, LENGTH), model.readings(p - step, poses, LENGTH)):
            ends.append(np.concatenate([model.response_of(p, n).place(read[2 * n], read[2 * n + 1]) for n in (0, 1)]))
        slope = (ends[0] - ends[1]) / (2.0 * step[i])
        assert pytest.approx(slope, rel=1e-4, abs=1e-10 / model.TOLERANCES[i]) == ours[:, :, i].T, model.ALL[i].name


def test_a_place_is_read_and_found_again(truth: dict[str, float]) -> None:
    p = vector_of(truth)
    p[model.INDEX['psd_2.nonlinearity']] = -3000.0
    x, y = np.random.default_rng(3).uniform(-5e-3, 5e-3, (2, 100))
    response = model.response_of(p, 1)
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
            {'calibration.names': ['psd_1.height'], 'calibration.sds': [1e-3], 'calibration.correlations': [0.5]},
            '1 values for 1 names; must be 0',
        ),
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
    at = [model.INDEX['psd_1.height'], model.INDEX['psd_2.height']]
    assert known.covariance[np.ix_(at, at)] == pytest.approx(np.array([[1e-6, -1e-6], [-1e-6, 4e-6]]))
    assert known.covariance[0, 0] == pytest.approx(model.TOLERANCES[0] ** 2)


RIG = load_rig()
OWN = """
from psd_deflection.model.simulation.declaration import PSD, Effect, EffectParameter

def _apply(samples, values, state):
    samples.dots[2 * (int(values['psd']) - 1)] *= 1.0 + values['x']

def _correct(reading, values):
    reading.dots[2 * (int(values['psd']) - 1)] /= 1.0 + values['x']

EFFECT = Effect(
    name='my_gain', stage='psd', summary='-', equation='-', source='-', needs='-', point='dots', order=5,
    parameters=(PSD, EffectParameter('x', '', -0.5, 0.5, 1e-3, 'of x')),
    apply=_apply, correct=_correct, calibrated_as={'x': 'gain_x'},
)
"""


def test_user_effect_is_calibrated_as_declared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'my_gain.py').write_text(OWN)
    monkeypatch.setenv(FOLDERS, str(tmp_path))
    assert catalogue()['my_gain'].calibrated_as == {'x': 'gain_x'}
    listed = {'effects.a.name': 'my_gain', 'effects.a.psd': 2, 'effects.a.x': 0.01}
    rig = load_rig(overrides=listed)
    vector = vector_of_rig(rig)
    assert vector.other_effects == []
    at = model.INDEX['psd_2.gain_x']
    assert vector.values[at] == 0.01
    # What a calibration finds goes into the effect that the file has; of others into the package's own.
    values = vector.values.copy()
    values[at] = 0.012
    values[model.INDEX['psd_1.rotation']] = model.TOLERANCES[model.INDEX['psd_1.rotation']]
    _, effects = rig_values(vector, values, vector.clamp)
    of_psd = [a for a in effects if 'psd' in a.values]
    assert [(a.effect.name, a.values['psd']) for a in of_psd] == [('sensor_rotation', 1.0), ('my_gain', 2.0)]
    assert of_psd[1].values['x'] == 0.012
    dots = np.array([[0.0, 0.0, 1.01e-3, 0.0]])
    assert Correction.from_rig(rig).apply(dots)[0, 2] == pytest.approx(1e-3)
    values[model.INDEX['psd_2.gain_y']] = 0.004
    for known, want in ((vector, ['my_gain', 'sensor_gain']), (vector_of_rig(RIG), ['sensor_gain'])):
        _, effects = rig_values(known, values, vector.clamp)
        gains = [a for a in effects if a.effect.name.endswith('gain')]
        assert [a.effect.name for a in gains] == want
        assert gains[-1].values['y'] == 0.004


@pytest.mark.parametrize(
    ('name', 'called', 'words'),
    [
        ('sensor_gain', {'z': 'gain_x'}, r"calibrated_as = .'z': 'gain_x'.: must name parameters"),
        ('sensor_gain', {'x': 'gain_x'}, 'calibrated_as: y: not named; a calibration finds all'),
        ('sensor_gain', {'x': 'gain_x', 'y': 'gian_y'}, "y = 'gian_y': a calibration finds of a PSD: rotation, gain_x"),
        ('sensor_gain', {'x': 'gain_x', 'y': 'link.slope_ratio'}, "y = 'link.slope_ratio': a calibration finds"),
        ('sensor_gain', {'x': 'gain_x', 'y': 'gain_x'}, 'has a name twice'),
        (
            'sensor_gain',
            {'x': 'gain_x', 'y': 'height'},
            'center_x, center_y, height, aimed need an effect of their own',
        ),
        ('plane_tilt', {'slope_ratio': 'gain_x'}, 'a calibration finds of the link: link.slope_ratio, clamp'),
    ],
)
def test_a_declaration_that_a_calibration_cannot_use_is_rejected(name: str, called: dict[str, str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        replace(catalogue()[name], calibrated_as=called)


def test_what_a_declaration_may_name_is_what_a_calibration_finds() -> None:
    of_psd = {name.removeprefix('psd_1.') for name in model.INDEX if name.startswith('psd_1.') and '.zero' not in name}
    assert {*CALIBRATED_OF_PSD, *PLACED_OF_PSD} == of_psd | {'aimed'}
    assert set(CALIBRATED_OF_LINK) == {*CLAMP, 'link.slope_ratio'}


def test_wrong_user_effect_is_rejected_if_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'my_gain.py').write_text(OWN.replace("'gain_x'", "'gian_x'"))
    monkeypatch.setenv(FOLDERS, str(tmp_path))
    with pytest.raises(ConfigError, match=r'my_gain.py: holds no effect .*gian_x'):
        vector_of_rig(load_rig(overrides={'effects.a.name': 'my_gain', 'effects.a.psd': 2, 'effects.a.x': 0.01}))
    vector = vector_of_rig(RIG)
    values = vector.values.copy()
    values[model.INDEX['psd_2.gain_x']] = 0.012
    _, effects = rig_values(vector, values, vector.clamp)
    assert [a.effect.name for a in effects if 'psd' in a.values] == ['sensor_gain']


def test_two_effects_that_give_one_parameter_are_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / 'my_gain.py').write_text(OWN)
    monkeypatch.setenv(FOLDERS, str(tmp_path))
    user = {'effects.a.name': 'my_gain', 'effects.a.psd': 2, 'effects.a.x': 0.01}
    ours = {'effects.b.name': 'sensor_gain', 'effects.b.psd': 2}
    with pytest.raises(ConfigError, match=r'my_gain \(psd 2\) and sensor_gain \(psd 2\): both give psd_2.gain_x'):
        vector_of_rig(load_rig(overrides={**user, **ours, 'effects.b.x': 0.01}))
    # They share no parameter: this one's x is off, or it is of the other PSD.
    for apart in ({'effects.b.y': 0.01}, {'effects.b.x': 0.01, 'effects.b.psd': 1}):
        assert vector_of_rig(load_rig(overrides={**user, **ours, **apart})).values[model.INDEX['psd_2.gain_x']] == 0.01


def test_an_effect_listed_twice_is_rejected() -> None:
    twice = {f'effects.{key}.{name}': value for key in 'ab' for name, value in
             {'name': 'sensor_gain', 'psd': 1, 'x': 0.01}.items()}  # fmt: skip
    with pytest.raises(ConfigError, match='listed twice'):
        vector_of_rig(load_rig(overrides=twice))


@pytest.mark.parametrize('fitted', [-0.006, 0.0, 0.3])
def test_undetermined_slope_ratio_is_written_valid(fitted: float) -> None:
    vector = vector_of_rig(RIG)
    p = vector.values.copy()
    p[model.INDEX['link.slope_ratio']] = fitted
    values, effects = rig_values(vector, p, vector.clamp)
    assert values['link.slope_ratio'] == max(fitted, 0.0)
    tilts = [a.values['slope_ratio'] for a in effects if 'slope_ratio' in a.values]
    assert tilts == ([fitted] if fitted > 0.0 else [])
    replace_values(RIG, values)
    # The caller's own numbers stay.
    assert p[model.INDEX['link.slope_ratio']] == fitted
