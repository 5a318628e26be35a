"""Writes a calibration into the text of a rig file; everything else stays as it was, comments too."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from psd_deflection.errors import ConfigError
from psd_deflection.foreign_yaml import YamlError, edited
from psd_deflection.parameter_files import flat_parameters

HEADER = '# Calibrated by '


def with_values(text: str, values: Mapping[str, object], source: str, path: Path) -> str:
    """``text`` of a parameter file with flat ``values`` and, above it, where they come from.

    ``path``: for a message. Raises ConfigError if the file cannot be edited so that it says the same otherwise.
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
    kept = ''.join(line for line in out.splitlines(keepends=True) if not line.startswith(HEADER))
    return f'{HEADER}{source}\n{kept}'


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
    found = []
    for cut in range(1, len(path) + 1):
        key = '.'.join(path[:cut])
        if key not in body:
            continue
        if cut == len(path):
            found.append((body, key))
        elif isinstance(body[key], dict):
            found += _places(body[key], path[cut:])
    return found


def _new(body: Any, path: list[str]) -> tuple[Any, str]:
    """A place for the key: in its section if that is there."""
    for key in path[:-1]:
        body = body.setdefault(key, {})
    return body, path[-1]
