# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameter files: what is none is rejected by name, and a file of a user keeps its comments."""

from __future__ import annotations

from pathlib import Path

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.parameter_files import flat_parameters, read_parameter_file, with_effects_section, with_values


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('a: [1', ':'),
        ('[]', 'not a ROS 2 parameter file'),
        ('x: 1', 'ros__parameters'),
        ('other:\n  ros__parameters:\n    a: 1', 'no parameters for /** or estimator'),
        ('!!python/object/apply:os.system ["true"]', 'malformed'),
    ],
)
def test_a_malformed_file_is_rejected_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        read_parameter_file(path)
    assert 'mine.yaml' in str(error.value)
    assert message in str(error.value)


@pytest.mark.parametrize(('content', 'why'), [(None, r'Is a directory'), (b'\xd0\xff', 'it is no text')])
def test_what_is_no_text_is_no_parameter_file(tmp_path: Path, content: bytes | None, why: str) -> None:
    path = tmp_path / 'rig.yaml'
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf'rig\.yaml: cannot be read as a parameter file \({why}\)$'):
        load_rig(path)


USERS_FILE = """\
# Our rig in the cellar.
/**:
  ros__parameters:
    link: {length: 0.8, youngs_modulus: 69e9}  # measured
    degraded: off
    psd_2:
      center: [-0.100, 0.0]   # drilled 2024-03-01
      axes: ['y', x]
    bag_dir: "over/there"
    effects:                  # from the first run
      creep: {amplitude: 0.03, time_constant: 5.0}
    # The port follows.
    port: /dev/ttyACM0
other_node:
  ros__parameters: {rate: 010}
"""


def test_effects_are_put_into_the_users_file(tmp_path: Path) -> None:
    path = tmp_path / 'rig.yaml'
    path.write_text(USERS_FILE)
    rotation = {'name': 'sensor_rotation', 'psd': 2, 'angle': 0.01}
    out = with_effects_section(USERS_FILE, {'sensor_rotation_2': rotation}, path)
    for kept in ('# Our rig in the cellar.', '# measured', '# drilled 2024-03-01', '# The port follows.', 'rate: 010'):
        assert kept in out
    assert 'link: {length: 0.8, youngs_modulus: 69e9}' in out
    assert "axes: ['y', x]" in out
    assert 'creep' not in out
    before = load_rig(path)
    path.write_text(out)
    after = load_rig(path)
    assert after.values == before.values
    assert dict(after.effects) == {f'sensor_rotation_2.{key}': value for key, value in rotation.items()}
    # Without effects it is the file without its own.
    path.write_text(with_effects_section(USERS_FILE, {}, path))
    assert load_rig(path).effects == {}


@pytest.mark.parametrize(
    ('text', 'why'),
    [
        ('/**:\n  ros__parameters:\n    block_size: 10\n    block_size: 20\n', 'block_size is there twice'),
        ('/**:\n  ros__parameters: {a: &a [x, x, x, x, x, x, x, x, x], ' + ', '.join(
            f'{chr(98 + i)}: &{chr(98 + i)} [{", ".join([f"*{chr(97 + i)}"] * 9)}]' for i in range(6)) + '}\n',
         'aliases stand for more than'),
        ('/**:\n  ros__parameters: {block_size: !!python/object/apply:os.system [ls]}\n', 'malformed YAML'),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_edited_is_rejected(text: str, why: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=why) as caught:
        with_effects_section(text, {'creep': {'amplitude': 0.1}}, tmp_path / 'rig.yaml')
    assert str(tmp_path / 'rig.yaml') in str(caught.value)


def test_values_are_written_where_they_are() -> None:
    """Nested, dotted and in a section of the node; numbers that YAML 1.1 takes for text."""
    text = '/**:\n  ros__parameters:\n    psd_1.height: 0.0 # mm\n    psd_2:\n      center: [0.1, 0.2] # both\n'
    out = with_values(
        text,
        {'psd_1.height': 1e-05, 'psd_2.center': [0.3, 0.4], 'psd_2.height': -3e-05},
        'Calibrated by us',
        Path('rig.yaml'),
    )
    assert flat_parameters(out, Path('rig.yaml')) == {
        'psd_1.height': pytest.approx(1e-05, rel=1e-12),
        'psd_2.center': [0.3, 0.4],
        'psd_2.height': pytest.approx(-3e-05, rel=1e-12),
    }
    assert out.startswith('# Calibrated by us\n')
    assert '[0.3, 0.4] # both' in out
    assert '# mm' in out
    assert (
        with_values(out, {'psd_1.height': 0.25}, 'Calibrated by them', Path('rig.yaml')).count('# Calibrated by') == 1
    )
    # The name of a recording is a stranger's: a line end in it begins no line.
    reported = with_values(text, {}, 'Calibrated by x from a\nlink.length: 3', Path('rig.yaml'))
    assert flat_parameters(reported, Path('rig.yaml')) == flat_parameters(text, Path('rig.yaml'))
