# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameter files of ROS 2 (``/**: ros__parameters:``), read and edited without ROS.

What a file says comes out as flat values (``link.length``); :mod:`psd_deflection.rig.config` checks them.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.foreign_yaml import YamlError, edited, text_of_file, tree_of_text
from psd_deflection.base.text import sanitize

MAX_KEYS = 10_000
LONGEST_SOURCE = 4000
"""Characters of the line that says where values come from, with names of recordings in it."""

EFFECTS_PREFIX = 'effects.'
"""Keys below it describe simulated effects; ``psd_deflection.model.simulation`` checks them."""


def read_parameter_file(path: str | Path, node_name: str = 'estimator') -> dict[str, object]:
    """Flat values of a ROS 2 parameter file: those for ``/**`` and for ``node_name``.

    Lists stay lists; maps become dotted keys. Raises ConfigError naming the file when it is
    missing, too large, not YAML, or not a parameter file.
    """
    path = Path(path)
    return flat_parameters(parameter_text(path), path, node_name)


def parameter_text(path: Path) -> str:
    """The text of a parameter file. Raises ConfigError naming the file when it is missing or too large."""
    return text_of_file(path, 'parameter file')


def flat_parameters(text: str, path: Path, node_name: str = 'estimator') -> dict[str, object]:
    """Flat values of the text of a parameter file, as of :func:`read_parameter_file`. Raises ConfigError."""
    tree = tree_of_text(text, path)
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: not a ROS 2 parameter file: expected "/**:" then "ros__parameters:"')
    flat: dict[str, object] = {}
    wanted = _sections_of(node_name)
    for name, body in tree.items():
        if not isinstance(body, dict) or not isinstance(body.get('ros__parameters'), dict):
            raise ConfigError(f'{path}: {name}: not a ROS 2 parameter file: "ros__parameters:" is missing below it')
        if name in wanted:
            flat.update(flattened(body['ros__parameters'], str(path)))
    if not any(name in wanted for name in tree):
        raise ConfigError(f'{path}: has no parameters for /** or {node_name} (found: {", ".join(map(str, tree))})')
    return flat


def _sections_of(node_name: str) -> tuple[str, ...]:
    """Names of the sections of a parameter file that a node reads."""
    return '/**', node_name, '/' + node_name, '/**/' + node_name


def with_effects_section(text: str, effects: Mapping[str, Mapping[str, object]], path: Path) -> str:
    """The text of a parameter file with ``effects`` instead of its own; all else is as it was, comments too.

    ``path``: for a message. Raises ConfigError if the file cannot be edited so that it says the same otherwise.
    """
    sections = _sections_of('estimator')

    def edit(tree: Any) -> None:
        bodies = [body['ros__parameters'] for name, body in tree.items() if name in sections]
        for body in bodies:
            for key in [k for k in body if k == EFFECTS_PREFIX.rstrip('.') or str(k).startswith(EFFECTS_PREFIX)]:
                del body[key]
        if effects:
            bodies[-1][EFFECTS_PREFIX.rstrip('.')] = effects

    wanted = {k: v for k, v in flat_parameters(text, path).items() if not k.startswith(EFFECTS_PREFIX)}
    wanted.update(flattened({EFFECTS_PREFIX.rstrip('.'): effects}, str(path)))
    try:
        out = edited(text, edit)
    except YamlError as error:
        raise ConfigError(f'{path}: {error}') from None
    # The editor reads YAML 1.2, ROS and our reader YAML 1.1.
    if flat_parameters(out, path) != wanted:
        raise ConfigError(f'{path}: cannot be written again with the same values')
    return out


def with_values(text: str, values: Mapping[str, object], source: str, path: Path) -> str:
    """``text`` of a parameter file with flat ``values``; everything else stays as it was, comments too.

    ``source``: where they come from, the first line of the file ('Calibrated by ...'). It takes the place of an older
    one that begins with the same two words. ``path``: for a message. Raises ConfigError if the file cannot be
    edited so that it says the same otherwise.
    """
    values = {name: _readable(value) for name, value in values.items()}

    def edit(tree: Any) -> None:
        bodies = [
            body['ros__parameters'] for body in tree.values() if isinstance(body, dict) and body.get('ros__parameters')
        ]
        for name, value in values.items():
            places = [place for body in bodies for place in _places(body, name.split('.'))]
            for holder, key in places or [_new(bodies[-1], name.split('.'))]:
                old = holder.get(key)
                if isinstance(value, list) and isinstance(old, list) and len(old) == len(value):
                    # In place: style and comment of the list stay.
                    old[:] = value
                else:
                    holder[key] = _in_a_line(value)

    wanted = {**flat_parameters(text, path), **values}
    try:
        out = edited(text, edit)
    except YamlError as error:
        raise ConfigError(f'{path}: {error}') from None
    if flat_parameters(out, path) != wanted:
        raise ConfigError(f'{path}: cannot be written again with the same values')
    older = '# ' + ' '.join(source.split()[:2]) + ' '
    retained = ''.join(line for line in out.splitlines(keepends=True) if not line.startswith(older))
    return f'# {sanitize(source, LONGEST_SOURCE)}\n{retained}'


def _readable(value: object) -> object:
    """``value``, or a float of its last digit away: YAML 1.1 takes 1e-05, which is how it is written, for text."""
    if isinstance(value, list):
        return [_readable(item) for item in value]
    if isinstance(value, float) and 'e' in repr(value) and '.' not in repr(value):
        return math.nextafter(value, math.inf)
    return value


def _in_a_line(value: object) -> object:
    """A list that is written as [a, b]."""
    from ruamel.yaml.comments import CommentedSeq

    if not isinstance(value, list):
        return value
    out = CommentedSeq(value)
    out.fa.set_flow_style()
    return out


def _places(body: Any, path: list[str]) -> list[tuple[Any, str]]:
    """Where the key is, as a map and its key: nested, dotted or in part."""
    places = []
    for cut in range(1, len(path) + 1):
        key = '.'.join(path[:cut])
        if key not in body:
            continue
        if cut == len(path):
            places.append((body, key))
        elif isinstance(body[key], dict):
            places += _places(body[key], path[cut:])
    return places


def _new(body: Any, path: list[str]) -> tuple[Any, str]:
    """A place for the key: in its section if that is there."""
    for key in path[:-1]:
        body = body.setdefault(key, {})
    return body, path[-1]


def flattened(tree: Mapping[Any, Any], source: str) -> dict[str, object]:
    """``tree`` with maps as dotted keys; lists stay lists. Raises ConfigError naming ``source``."""
    out: dict[str, object] = {}
    _flatten(tree, '', out, source, 0)
    return out


def _flatten(tree: Mapping[Any, Any], prefix: str, out: dict[str, object], source: str, depth: int) -> None:
    if depth > 8:
        raise ConfigError(f'{source}: {prefix} is nested too deep')
    for key, value in tree.items():
        name = f'{prefix}{key}'
        if isinstance(value, Mapping):
            _flatten(value, name + '.', out, source, depth + 1)
        elif name in out:
            raise ConfigError(f'{source}: {name} is there twice, as a dotted key and in a map')
        else:
            out[name] = value
        if len(out) > MAX_KEYS:
            raise ConfigError(f'{source}: more than {MAX_KEYS} parameters')


def nested(flat: Mapping[str, object]) -> dict[str, Any]:
    """Names with dots as maps in maps, the inverse of :func:`flattened`; tuples as lists."""
    tree: dict[str, Any] = {}
    for key, value in flat.items():
        *path, last = key.split('.')
        at = tree
        for step in path:
            at = at.setdefault(step, {})
        at[last] = list(value) if isinstance(value, tuple) else value
    return tree
