# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters: every rejection names the file, the key, the value and the bound."""

from __future__ import annotations

from pathlib import Path

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.rig.config import left_as_in_the_thesis, load_rig, replace_values, rig_from_values

RIG = Path(__file__).parents[2] / 'config' / 'thesis_rig.yaml'


def test_the_shipped_rig_file_is_the_default() -> None:
    assert load_rig(RIG).values == load_rig().values


@pytest.mark.parametrize(
    ('key', 'value', 'notice'),
    [
        ('amplifier.noise', -1.0, 'above 0'),
        ('amplifier.noise', 'loud', 'must be a number'),
        ('amplifier.noise', float('nan'), 'finite'),
        ('block_size', 2.5, 'whole number'),
        ('block_size', 0, 'at least 1'),
        ('psd_1.center', [1.0], '2 elements'),
        ('psd_1.center', 'here', 'list'),
        ('link.inner_radius', 0.02, 'link.outer_radius'),
        ('sum_min', 8.0, 'less than sum_max = 7.5 V'),
        ('link.lenght', 1.0, 'did you mean link.length'),
        ('wls.weights', 'mine', 'inverse_variance, thesis'),
        ('record', 'yes', 'true or false'),
    ],
)
def test_a_bad_value_is_rejected_by_name(key: str, value: object, notice: str) -> None:
    with pytest.raises(ConfigError) as error:
        rig_from_values({key: value}, 'rig.yaml')
    message = str(error.value)
    assert 'rig.yaml' in message
    assert key in message
    assert notice in message


def test_a_dump_of_a_node_is_a_parameter_file() -> None:
    of_every_node = {
        'use_sim_time': False,
        'simulated': True,
        'start_type_description_service': True,
        'qos_overrides./diagnostics.publisher.depth': 10,
    }
    assert rig_from_values({**load_rig().values, **of_every_node}) == load_rig()


def test_a_number_that_yaml_takes_for_text_is_a_number_as_in_ros(tmp_path: Path) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text('/**:\n  ros__parameters:\n    link:\n      youngs_modulus: 70e9\n')
    assert load_rig(path).link.youngs_modulus == 70e9


def test_whole_bounds_are_written_whole() -> None:
    with pytest.raises(ConfigError, match='must be at least 1000000 and at most 1000000000000'):
        load_rig(overrides={'disk_reserve': 0})


@pytest.mark.parametrize('value', [10**400, 10**6000, -(10**400)], ids=['long', 'longer', 'negative'])
def test_a_number_of_very_many_digits_is_rejected_like_any_other(value: int) -> None:
    with pytest.raises(ConfigError, match=r'^rig\.yaml: baud = .{0,400}: must be'):
        rig_from_values({'baud': value}, 'rig.yaml')


def test_a_message_does_not_repeat_a_whole_file() -> None:
    with pytest.raises(ConfigError, match='must be text') as error:
        rig_from_values({'port': [['x' * 1000] * 1000] * 1000}, 'rig.yaml')
    assert len(str(error.value)) < 5_000


def test_effects_stay_with_a_rig_that_is_changed() -> None:
    rig = load_rig(overrides={'effects.one.name': 'sensor_gain', 'effects.one.psd': 1})
    changed = replace_values(rig, {'effects.one.psd': 2, 'link.length': 0.5})
    assert changed.effects == {'one.name': 'sensor_gain', 'one.psd': 2}
    assert changed.flat() == {**rig.flat(), 'effects.one.psd': 2, 'link.length': 0.5}


def test_one_message_for_a_file_and_for_an_override(tmp_path: Path) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text('/**:\n  ros__parameters:\n    converter: {full_scale: -1}\n')
    why = r'converter\.full_scale = -1 V: must be above 0 and at most 1000$'
    with pytest.raises(ConfigError, match=rf'mine\.yaml: {why}'):
        load_rig(path)
    with pytest.raises(ConfigError, match=rf'^override: {why}'):
        load_rig(RIG, {'converter.full_scale': -1})


def test_what_another_rig_leaves_as_in_the_thesis_is_reported() -> None:
    assert left_as_in_the_thesis(load_rig().values) == ()
    # A parameter that measures nothing of the rig makes it no other one.
    assert left_as_in_the_thesis(load_rig(overrides={'block_size': 30}).values) == ()
    notice = left_as_in_the_thesis(load_rig(overrides={'link.length': 0.4}).values)
    assert 'dynamics.bending_frequency = 14.0 Hz' in notice
    assert not [text for text in notice if text.startswith(('link.length', 'psd_1.zero', 'port'))]


@pytest.mark.parametrize('word', ['none', 'off', False])
def test_no_estimate_from_one_detector_has_three_words(tmp_path: Path, word: str | bool) -> None:
    assert load_rig(None, {'degraded': word}).values['degraded'] == 'none'
    assert load_rig().estimator.degraded == 'none'
    file = tmp_path / 'rig.yaml'
    file.write_text(f'/**:\n  ros__parameters:\n    degraded: {word}\n')
    assert load_rig(file).estimator.degraded == 'none'


@pytest.mark.parametrize('word', [True, 0, 'no', None])
def test_other_words_for_it_are_rejected(word: object) -> None:
    with pytest.raises(ConfigError, match=r'degraded = '):
        load_rig(None, {'degraded': word})
