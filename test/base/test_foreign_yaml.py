# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""YAML and numbers of a stranger: plain types, bounded, one reading, and no exception but the declared one."""

import contextlib
import math
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from psd_deflection.base.errors import ConfigError, PsdDeflectionError, RecordingError
from psd_deflection.base.foreign_yaml import MAX_DEPTH, MAX_NODES, YamlError, edited, parse_yaml
from psd_deflection.base.plugins import optional
from psd_deflection.base.text import plain_number
from psd_deflection.cli.main import main
from psd_deflection.model.simulation.loads import load_history
from psd_deflection.recordings.read.bag_reader import read_information
from psd_deflection.rig.config import load_rig

TAGS = [
    *('x: !!bool foo', 'x: !!int ""', 'x: !!int "-"', 'x: !!int "0x"', 'x: !!float ""', 'x: !!timestamp foo'),
    *('x: !!timestamp 2001-99-99', 'x: !!binary "ä"', 'x: !!python/object/apply:os.system [true]', 'x: !!set [1]'),
    *('x: !!omap 1', '? [1]\n: 2', 'x: 1' + '0' * 5000, 'x: 1' + ':59' * 100_000, 'x: [1', 'x: "\\ud800"'),
    *('%YAML 9.9\n---\nx: 1', '--- 1\n--- 2', '[' * 100_000, 'x: &a [*a]', 'x: *nobody', '\x07'),
]


def merge_bomb() -> str:
    lines = ['m0: &m0 {k0: 1}']
    lines += [f'm{n}: &m{n} {{<<: [{", ".join([f"*m{n - 1}"] * 10)}]}}' for n in range(1, 10)]
    return '\n'.join(lines)


def alias_bomb() -> str:
    lines = ['a0: &a0 [' + ', '.join('x' * 10) + ']']
    lines += [f'a{n}: &a{n} [{", ".join([f"*a{n - 1}"] * 10)}]' for n in range(1, 9)]
    return '\n'.join(lines)


BOMBS = [merge_bomb(), alias_bomb(), '\n'.join(f'k{n}: {n}' for n in range(60_000))]


def readers(path: Path) -> list[type[PsdDeflectionError]]:
    """Every reader of such a file rejects this one; with what."""
    errors: list[type[PsdDeflectionError]] = []
    budget, discover = map(
        optional, ('psd_deflection.studies.budget.inputs', 'psd_deflection.studies.discover.from_recordings')
    )
    known: list[Callable[[Path], object]] = [load_rig, read_information, *([budget.read_inputs] if budget else [])]
    known += [lambda path: discover.read_observations([str(path)], None)] if discover else []
    for read in known:
        with pytest.raises(PsdDeflectionError) as error:
            read(path)
        assert path.name in str(error.value)
        assert len(str(error.value)) < 500
        errors.append(error.type)
    return errors


@pytest.mark.parametrize('text', TAGS)
def test_what_is_no_plain_tree_is_rejected_by_every_reader(tmp_path: Path, text: str) -> None:
    with pytest.raises(YamlError, match='malformed YAML'):
        parse_yaml(text)
    path = tmp_path / 'strange.yaml'
    path.write_text(text, encoding='utf-8')
    config, recording, *of_rooms = readers(path)
    assert (config, recording, {*of_rooms} - {ConfigError}) == (ConfigError, RecordingError, set())


@pytest.mark.parametrize('text', BOMBS, ids=['merge keys', 'aliases', 'keys'])
def test_a_bomb_is_rejected_before_it_is_built(tmp_path: Path, text: str) -> None:
    with pytest.raises(YamlError, match=f'more than {MAX_NODES} keys and values'):
        parse_yaml(text)
    path = tmp_path / 'bomb.yaml'
    path.write_text(text)
    readers(path)


@pytest.mark.parametrize(
    ('body', 'message'),
    [
        ('    baud: 9600\n    port: x\n    baud: 115200\n', r'mine\.yaml:5:5: baud is there twice, in lines 3 and 5'),
        ('    link: {length: 1.0, length: 2.0}\n', r'mine\.yaml:3:25: length is there twice, in lines 3 and 3'),
        (
            '    link.length: 1.0\n    link: {length: 2.0}\n',
            r'mine\.yaml: link\.length is there twice, as a dotted key',
        ),
    ],
)
def test_a_key_that_is_there_twice_is_rejected_with_its_lines(tmp_path: Path, body: str, message: str) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text('/**:\n  ros__parameters:\n' + body)
    with pytest.raises(ConfigError, match=message):
        load_rig(path)


def test_a_merge_key_and_what_overrides_it_are_not_doubled() -> None:
    assert parse_yaml('a: &a {x: 1, y: 2}\nb: {<<: *a, x: 3}\nc: {<<: *a}\n', unique=True) == {
        'a': {'x': 1, 'y': 2},
        'b': {'x': 3, 'y': 2},
        'c': {'x': 1, 'y': 2},
    }


def test_aliases_and_merge_keys_within_the_bound_are_as_ever() -> None:
    text = 'a: &a {x: 1, y: [1.5, two, 2001-01-01]}\nb: {<<: *a, z: 3}\nc: *a\n'
    assert parse_yaml(text) == yaml.safe_load(text)
    assert parse_yaml('') is None


def test_depth_is_bounded_and_a_long_text_is_not() -> None:
    assert parse_yaml('[' * MAX_DEPTH + ']' * MAX_DEPTH) is not None
    with pytest.raises(YamlError, match='nested deeper'):
        parse_yaml('[' * (MAX_DEPTH + 1) + ']' * (MAX_DEPTH + 1))
    assert parse_yaml('a: ' + 'x' * 100_000) == {'a': 'x' * 100_000}


WORDS = 'a 1 : - [ ] { } , &x *x <<: !!int !!bool !!set !!timestamp !!float " 0x 1e . 2001-01-01 | ? ! % --- ~'
PIECES = st.sampled_from(WORDS.split(' '))


@pytest.mark.slow
@given(st.lists(PIECES | st.sampled_from([' ', '  ', '\n', '\t']) | st.text(max_size=3), max_size=30).map(''.join))
def test_any_text_is_read_or_rejected(text: str) -> None:
    with contextlib.suppress(YamlError):
        parse_yaml(text)


@pytest.mark.parametrize('value', ['\ud800x', 'a\x1b[31m', 'a\nb'])
def test_a_text_that_cannot_be_printed_is_no_parameter(value: str) -> None:
    with pytest.raises(ConfigError, match=r'bag_dir = .*: must be text that can be printed'):
        load_rig(overrides={'bag_dir': value})


@given(st.floats(-1e300, 1e300, allow_subnormal=False), st.integers(0, 17))
@example(-1.629581928360124e-08, 0)
@example(1e-08, 0)
@example(-0.0, 0)
def test_numbers_are_written_again_to_the_last_bit(value: float, digits: int) -> None:
    """As our reader reads them, in the notation of whoever wrote the file."""
    for text in (f'a: {value:.{digits}e}\n', yaml.safe_dump({'a': value}), yaml.safe_dump({'a': [value, 1.0]})):
        assert parse_yaml(edited(text, lambda tree: None)) == parse_yaml(text)


ODD = ['-1_0', '1_000', '٣', '１', '0x10', '1e', '', 'one', '1 2']


@pytest.mark.parametrize('text', ODD)
def test_what_is_no_number_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match='is not a number'):
        plain_number(text)


@pytest.mark.parametrize('text', [' 1.5 ', '-3', '+.5', '69e9', '1e-05', '2.'])
def test_what_loggers_write_is_read_as_python_reads_it(text: str) -> None:
    assert plain_number(text) == float(text)


def test_what_is_not_finite_is_for_the_caller_to_judge() -> None:
    assert math.isnan(plain_number('nan'))
    assert plain_number('-Inf') == -math.inf


@pytest.mark.parametrize('text', ['-1_0', '٣'])
def test_parameters_loads_and_options_reject_it(text: str) -> None:
    with pytest.raises(ConfigError, match='must be a number'):
        load_rig(overrides={'link.length': text})
    with pytest.raises(ConfigError, match='not a list of numbers'):
        load_history(f'constant:0,{text},0:20', 1000.0)
    assert main(['load', '--url', 'http://127.0.0.1:1/', '--', '0', text, '0']) == 2
