"""Parameter files of ROS 2 (``/**: ros__parameters:``), read and edited without ROS.

What a file says comes out as flat values (``link.length``); :mod:`psd_deflection.config` checks them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from psd_deflection.errors import ConfigError
from psd_deflection.foreign_yaml import YamlError, edited, text_of_file, tree_of_text

MAX_KEYS = 10_000

EFFECTS_PREFIX = 'effects.'
"""Keys below it describe simulated effects; ``psd_deflection.simulation`` checks them."""


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
        found = [body['ros__parameters'] for name, body in tree.items() if name in sections]
        for body in found:
            for key in [k for k in body if k == EFFECTS_PREFIX.rstrip('.') or str(k).startswith(EFFECTS_PREFIX)]:
                del body[key]
        if effects:
            found[-1][EFFECTS_PREFIX.rstrip('.')] = effects

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
        else:
            out[name] = value
        if len(out) > MAX_KEYS:
            raise ConfigError(f'{source}: more than {MAX_KEYS} parameters')
