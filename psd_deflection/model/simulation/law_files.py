# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads the YAML file of a law: what is wrong with it is said with file, key, value and what is
allowed."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.foreign_yaml import tree_of_file, tree_of_text
from psd_deflection.base.text import did_you_mean
from psd_deflection.model.simulation.declaration import STAGES, Stage
from psd_deflection.model.simulation.laws import ANY, DOTS, FORMS, SUMS, TARGETS, Law, LawTerm
from psd_deflection.rig.parameters import Parameter, check_value

_FREE = (-math.inf, math.inf)


def read_law(path: Path) -> Law:
    """The law of a file. Raises ConfigError naming file, key, value and what is allowed."""
    return _law_of(tree_of_file(path, 'law'), path)


def law_of_text(text: str, source: str) -> Law:
    """The law of the text that a rig file or a recording has as ``source``. Raises ConfigError as :func:`read_law`."""
    return _law_of(tree_of_text(text, Path(source)), Path(source))


def _law_of(tree: object, path: Path) -> Law:
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: must be a map with name, stage, acts_on and terms')
    if 'name' not in tree:
        raise ConfigError(f'{path}: name is missing')
    first = _part(path, '', tree, tree)
    listed = tree.get('further', [])
    if not isinstance(listed, list):
        raise ConfigError(f'{path}: further = {listed!r}: must be a list of maps with acts_on and terms')
    further = [_part(path, f'further[{i}].', body, tree) for i, body in enumerate(listed)]
    targets = [part.acts_on for part in (first, *further)]
    if twice := [name for name in dict.fromkeys(targets) if targets.count(name) > 1]:
        raise ConfigError(f'{path}: further: {", ".join(twice)} is there twice: put its terms together')
    return dataclasses.replace(first, further=tuple(further))


def _part(path: Path, at: str, tree: object, full: Mapping[str, object]) -> Law:
    """What the law does to one target; ``at``: where in the file."""
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: {at.rstrip(".")} = {tree!r}: must be a map with acts_on and terms')
    for key in ('acts_on', 'terms'):
        if key not in tree:
            raise ConfigError(f'{path}: {at}{key} is missing')
    acts_on = _one_of(path, f'{at}acts_on', tree['acts_on'], TARGETS)
    stage = _one_of(path, f'{at}stage', tree.get('stage', TARGETS[acts_on].stage), STAGES)
    listed = tree['terms']
    if not isinstance(listed, list) or not listed:
        raise ConfigError(f'{path}: {at}terms = {listed!r}: must be a list of at least one term')
    terms = tuple(_term(path, f'{at}terms[{i}]', body, acts_on) for i, body in enumerate(listed))
    if len({t.kind == 'variance' for t in terms}) > 1:
        raise ConfigError(f'{path}: {at}terms: jitter stands alone; write a law of its own for the other terms')
    if terms[0].kind == 'variance' and acts_on not in (*DOTS, *SUMS):
        raise ConfigError(f'{path}: {at}acts_on = {acts_on!r}: jitter acts on x1, y1, sum1 and those of the other PSDs')
    return Law(str(full['name']), cast(Stage, stage), acts_on, terms, str(tree.get('summary', '')))


def _one_of(path: Path, key: str, value: object, allowed: Mapping[str, object] | Sequence[str]) -> str:
    if not isinstance(value, str) or value not in allowed:
        hint = did_you_mean(str(value), list(allowed)) or f'; it may be {", ".join(allowed)}'
        raise ConfigError(f'{path}: {key} = {value!r}: unknown{hint}')
    return value


def _number(
    path: Path, key: str, body: Mapping[str, object], default: float | None = None, within: tuple[float, float] = _FREE
) -> float:
    declared = Parameter(key, 'double', default, '', '', *within)
    return cast(float, check_value(declared, body.get(key.rpartition('.')[2], default), str(path)))


def _term(path: Path, at: str, body: object, acts_on: str) -> LawTerm:
    if not isinstance(body, dict):
        raise ConfigError(f'{path}: {at} = {body!r}: must be a map with form, of and coefficient')
    name = _one_of(path, f'{at}.form', body.get('form'), FORMS)
    form, of = FORMS[name], body.get('of', [])
    if not isinstance(of, list) or (not of and name != 'switched'):
        raise ConfigError(f'{path}: {at}.of = {of!r}: must be a list of variables')
    for variable in of:
        _one_of(path, f'{at}.of', variable, TARGETS[acts_on].variables)
    declared = Parameter(f'{at}.times', 'double_array', [], 's', '')
    times = cast(list[float], check_value(declared, body.get('times', []), str(path)))
    if times != sorted(times):
        raise ConfigError(f'{path}: {at}.times = {times!r}: must be a list of rising times, s')
    if bool(times) != (name == 'switched'):
        raise ConfigError(f'{path}: {at}.times = {times!r}: a switched term, and no other, has times')
    shapes = {}
    for key in (*form.fitted, *form.fixed):
        _, low, high = form.fitted.get(key, ('v', *ANY))
        shapes[key] = _number(path, f'{at}.{key}', body, within=(low, high))
    listed = body.get('sd', {})
    sd = {k: _number(path, f'{at}.sd.{k}', listed) for k in listed} if isinstance(listed, dict) else {}
    return LawTerm(name, tuple(of), _number(path, f'{at}.coefficient', body), shapes, tuple(times), sd)
