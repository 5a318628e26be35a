"""Parameters: every refusal names the file, the key, the value and the bound."""

from __future__ import annotations

from pathlib import Path

import pytest

from psd_deflection.config import load_rig, read_parameter_file, rig_from_values
from psd_deflection.errors import ConfigError

RIG = Path(__file__).parent.parent / 'config' / 'thesis_rig.yaml'


def test_the_shipped_rig_file_is_the_default() -> None:
    assert load_rig(RIG).values == load_rig().values


@pytest.mark.parametrize(
    ('key', 'value', 'said'),
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
def test_a_bad_value_is_refused_by_name(key: str, value: object, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        rig_from_values({key: value}, 'rig.yaml')
    message = str(error.value)
    assert 'rig.yaml' in message
    assert key in message
    assert said in message


def test_a_dump_of_a_node_is_a_parameter_file() -> None:
    of_every_node = {
        'use_sim_time': False,
        'start_type_description_service': True,
        'qos_overrides./diagnostics.publisher.depth': 10,
    }
    assert rig_from_values({**load_rig().values, **of_every_node}) == load_rig()


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('a: [1', ':'),
        ('[]', 'not a ROS 2 parameter file'),
        ('x: 1', 'ros__parameters'),
        ('other:\n  ros__parameters:\n    a: 1', 'no parameters for /** or estimator'),
        ('!!python/object/apply:os.system ["true"]', 'malformed'),
    ],
)
def test_a_malformed_file_is_refused_by_name(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        read_parameter_file(path)
    assert 'mine.yaml' in str(error.value)
    assert said in str(error.value)


def test_a_number_that_yaml_takes_for_text_is_a_number_as_in_ros(tmp_path: Path) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text('/**:\n  ros__parameters:\n    link:\n      youngs_modulus: 70e9\n')
    assert load_rig(path).link.youngs_modulus == 70e9


def test_whole_bounds_are_written_whole() -> None:
    with pytest.raises(ConfigError, match='must be at least 1000000 and at most 1000000000000'):
        load_rig(overrides={'disk_reserve': 0})


@pytest.mark.parametrize(('content', 'why'), [(None, r'Is a directory'), (b'\xd0\xff', 'it is no text')])
def test_what_is_no_text_is_no_parameter_file(tmp_path: Path, content: bytes | None, why: str) -> None:
    path = tmp_path / 'rig.yaml'
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf'rig\.yaml: cannot be read as a parameter file \({why}\)$'):
        load_rig(path)
