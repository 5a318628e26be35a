# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters: declared once, a field each; every rejection names file, key, value and bound; files keep comments."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.rig.config import Rig, left_as_in_the_thesis, load_rig, replace_values, rig_from_values
from psd_deflection.rig.declarations import BY_NAME, LINK, PARAMETERS, LinkConfig
from psd_deflection.rig.parameter_files import flat_parameters, read_parameter_file, with_effects_section, with_values
from psd_deflection.rig.parameters import Parameter, Section, Value, check_value, parameter


@dataclass(frozen=True, slots=True)
class HeavyLinkConfig(LinkConfig):
    """The link, with one field more: all that a new parameter costs."""

    mass: float = parameter(1.2, 'kg', 'mass of the link', name='payload.mass', above=0.0, maximum=100.0)
    points: tuple[float, ...] = parameter((0.0, 0.5), 'm', 'where it is fixed', minimum=0.0)


def test_a_field_is_all_that_a_parameter_costs() -> None:
    section = Section(HeavyLinkConfig, 'link.', points=(0.25,))
    names = [p.name for p in section.parameters.values()]
    assert names == [*(p.name for p in LINK.parameters.values()), 'link.payload.mass', 'link.points']
    mass, points = section.parameters['mass'], section.parameters['points']
    assert (mass.kind, mass.default, mass.unit, mass.bound_text()) == ('double', 1.2, 'kg', 'above 0 and at most 100')
    assert (points.kind, points.default, points.length) == ('double_array', [0.25], None)
    assert check_value(mass, 2, 'rig.yaml') == 2.0
    with pytest.raises(ConfigError, match=r'^rig\.yaml: link\.payload\.mass = 0 kg: must be above 0 and at most 100$'):
        check_value(mass, 0, 'rig.yaml')
    values = {p.name: p.default for p in section.parameters.values()}
    assert section.of({**values, 'link.payload.mass': 2.0, 'other': 1}) == HeavyLinkConfig(mass=2.0, points=(0.25,))


def another(p: Parameter) -> Value:
    """A legal value beside the default."""
    if p.choices is not None and p.kind == 'string_array':
        return list(reversed(p.default))
    if p.choices is not None:
        return p.choices[-1]
    match p.default:
        case bool():
            return not p.default
        case int():
            return p.default - 1 if p.default > (p.minimum or 0) else p.default + 1
        case float():
            return 0.99 * p.default if p.default else 0.01
        case list() if p.kind == 'double_array':
            return [0.99 * v if v else 0.01 for v in p.default]
        case list():
            return [*p.default, 'ols']
    return 'wls'


@pytest.mark.parametrize('name', [p.name for p in PARAMETERS])
def test_every_parameter_reaches_its_field_and_nothing_else(name: str) -> None:
    nominal, value = load_rig(), another(BY_NAME[name])
    rig = replace_values(nominal, {name: value})
    assert {k for k, v in rig.flat().items() if v != nominal.values[k]} == {name}
    before, after = flattened(nominal), flattened(rig)
    (changed,) = (i for i, (a, b) in enumerate(zip(before, after, strict=True)) if a != b)
    assert after[changed] == (tuple(value) if isinstance(value, list) else value)
    assert name == PARAMETERS[changed].name
    assert rig_from_values(rig.flat()) == rig == load_rig(overrides={name: value})


def flattened(rig: Rig) -> list[object]:
    """The fields of all sections, in the order in which parameters are listed."""
    sections: tuple[Any, ...] = (rig.link, *rig.psds, *rig.beams, rig.amplifier, rig.converter)
    sections += (rig.dynamics, rig.calibration, rig.estimator, rig.acquisition, rig.monitor)
    return [getattr(section, f.name) for section in sections for f in fields(section)]


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
        ('converter.bits', 25, 'at least 8 and at most 24'),
        ('psd_1.center', [1.0], '2 elements'),
        ('psd_1.center', 'here', 'list'),
        ('link.inner_radius', 0.02, 'link.outer_radius'),
        ('sum_min', 8.0, 'less than sum_max = 7.5 V'),
        ('link.lenght', 1.0, 'did you mean link.length'),
        ('wls.weights', 'mine', 'inverse_variance, thesis'),
        ('record', 'yes', 'true or false'),
        # Whole bounds are written whole.
        ('disk_reserve', 0, 'must be at least 1000000 and at most 1000000000000'),
        *(('degraded', word, 'degraded = ') for word in (True, 0, 'no', None)),
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
    for line in ('# Our rig in the cellar.', '# measured', '# drilled 2024-03-01', '# The port follows.', 'rate: 010'):
        assert line in out
    assert 'link: {length: 0.8, youngs_modulus: 69e9}' in out
    assert "axes: ['y', x]" in out
    assert 'creep' not in out
    before = load_rig(path)
    path.write_text(out)
    after = load_rig(path)
    assert after.values == before.values
    assert dict(after.effects) == {f'sensor_rotation_2.{key}': value for key, value in rotation.items()}
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
        ('/**:\n  ros__parameters: {device: -0.e1}\n', 'cannot be written again'),
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
