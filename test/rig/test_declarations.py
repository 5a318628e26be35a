# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Declared parameters: a field is all that one costs, and each reaches its field."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.rig.config import Rig, load_rig, replace_values, rig_from_values
from psd_deflection.rig.declarations import BY_NAME, LINK, PARAMETERS, LinkConfig
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
    # The ways lead to the same rig.
    assert rig_from_values(rig.flat()) == rig == load_rig(overrides={name: value})


def flattened(rig: Rig) -> list[object]:
    """The fields of all sections, in the order in which parameters are listed."""
    sections: tuple[Any, ...] = (rig.link, *rig.psds, *rig.beams, rig.amplifier, rig.converter)
    sections += (rig.dynamics, rig.calibration, rig.estimator, rig.acquisition, rig.monitor)
    return [getattr(section, f.name) for section in sections for f in fields(section)]
