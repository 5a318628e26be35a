# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads what a certificate is made from: the folder of a calibration, and the fields of the page."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.foreign_yaml import tree_of_file
from psd_deflection.base.sanitize import sanitize
from psd_deflection.base.spelling import did_you_mean
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.budget.certificate_page import FIELDS

LONGEST = 10_000_000
"""Bytes of a calibration.json: one of 30 parameters has some 40 kB."""
LONGEST_WORDS = 200
"""Characters of one field, and of what a message repeats."""


def read_calibration(folder: Path) -> tuple[Rig, dict[str, Any]]:
    """Return the calibrated rig and the tree of calibration.json in ``folder``.

    Raises ConfigError if a file or a key is missing, if a value is none that calibrate writes, or if the calibration
    was rejected.
    """
    rig = load_rig(folder / 'rig.yaml')
    path = folder / 'calibration.json'
    try:
        if path.stat().st_size > LONGEST:
            raise ConfigError(f'{path}: more than {LONGEST} bytes; give the folder of a calibration')
        tree = json.loads(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
    except (ValueError, RecursionError):
        raise ConfigError(f'{path}: no JSON; give the folder of a calibration') from None
    _check(tree, path)
    return rig, tree


def _check(tree: Any, path: Path) -> None:
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: no map; give the folder of a calibration')
    if tree.get('rejected'):
        raise ConfigError(f'{path}: rejected: the calibration was rejected, and there is nothing to certify')
    if tree.get('kind') != 'reference':
        raise ConfigError(
            f'{path}: kind = {_words(tree.get("kind"))}: its scale is traceable to nothing; calibrate with a reference'
        )
    for name, one in _map(tree, 'parameters', path).items():
        words = f'parameters.{_words(name)}'
        if not isinstance(one, dict) or not all(_is_number(one.get(key)) for key in ('value', 'used')):
            raise ConfigError(f'{path}: {words}: needs the numbers value and used; calibrate again')
    reference = _map(tree, 'reference', path)
    for key in ('rows', 'outliers'):
        if not _is_number(reference.get(key)):
            raise ConfigError(f'{path}: reference.{key}: not a number; calibrate again')
    _check_range(_map(tree, 'range', path), path)
    _check_provenance(_map(tree, 'provenance', path), path)


def _check_range(calibrated_range: Mapping[str, Any], path: Path) -> None:
    for key in ('low', 'high'):
        ends = calibrated_range.get(key)
        if not isinstance(ends, list) or len(ends) != 3 or not all(map(_is_number, ends)):
            raise ConfigError(f'{path}: range.{key}: must be three numbers; calibrate again')


def _check_provenance(given: dict[str, Any], path: Path) -> None:
    runs = given.get('recordings')
    if not isinstance(runs, list) or not all(isinstance(r, dict) and {'name', 'sha256'} <= r.keys() for r in runs):
        raise ConfigError(f'{path}: provenance.recordings: must be maps with name and sha256; calibrate again')
    for run in runs:
        warm = run.get('temperature')
        if warm is not None and not (isinstance(warm, list) and all(map(_is_number, warm))):
            raise ConfigError(f'{path}: provenance.recordings.temperature: must be numbers; calibrate again')
    given.setdefault('date', '')


def _words(value: object) -> str:
    return sanitize(str(value), LONGEST_WORDS)


def _map(tree: Mapping[str, Any], key: str, path: Path) -> dict[str, Any]:
    value = tree.get(key)
    if not isinstance(value, dict):
        raise ConfigError(f'{path}: {key}: not there; calibrate again with this version')
    return value


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def read_fields(path: str | None) -> dict[str, str]:
    """Return the fields of the page of a YAML file, printable; none without a file.

    Raises ConfigError naming the file and the field.
    """
    if path is None:
        return {}
    tree = tree_of_file(Path(path), 'file of fields')
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: fields are lines of "name: words"')
    out = {}
    for name, words in tree.items():
        if name not in FIELDS:
            raise ConfigError(f'{path}: {_words(name)}: no such field{did_you_mean(str(name), FIELDS)}')
        if isinstance(words, dict | list):
            raise ConfigError(f'{path}: {name}: must be words or a number')
        out[str(name)] = '' if words is None else _words(words)
    return out
