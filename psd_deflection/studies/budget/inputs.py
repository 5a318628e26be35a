# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The inputs of the budget besides the rig file, each with default, unit, bounds and source: a tolerance is the
half-width of a uniform distribution, a "typical" value a standard deviation, an "assumption" a guess to replace
first."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import cast

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.foreign_yaml import tree_of_file
from psd_deflection.base.text import did_you_mean
from psd_deflection.rig.parameters import Parameter, check_value


@dataclass(frozen=True, slots=True)
class Input:
    """A parameter (its bounds are checked like a rig's) and where its default comes from."""

    parameter: Parameter
    source: str


def _input(
    name: str, default: float, unit: str, what: str, source: str, maximum: float, *, above: float | None = None
) -> Input:
    minimum = None if above is not None else 0.0
    return Input(Parameter(name, 'double', default, unit, what, minimum=minimum, maximum=maximum, above=above), source)


INPUTS: tuple[Input, ...] = (
    # The light.
    _input('laser_wavelength', 650e-9, 'm', 'wavelength', 'assumption: red diode module', 1e-5, above=1e-8),
    _input(
        'laser_diameter', 1e-3, 'm', '1/e^2 diameter at the diode', 'assumption: collimated module', 0.05, above=1e-6
    ),
    _input('laser_power', 0.5e-3, 'W', 'power on the sensor', 'thesis 5.1: less than 1 mW', 1.0, above=0.0),
    _input(
        'profile_change',
        1e-3,
        '',
        "wander of the spot's centroid, typical, over its diameter",
        'assumption: to be measured on the rig',
        1.0,
    ),
    _input(
        'pointing_drift', 10e-6, 'rad', 'turn of a beam since zeroing, typical', 'assumption: warmed-up module', 0.1
    ),
    # The sensor.
    _input('responsivity', 0.4, 'A/W', 'of the sensor at the wavelength', 'silicon at 650 nm', 2.0, above=0.0),
    _input('dark_current', 500e-9, 'A', 'largest', 'Hamamatsu S1880 data sheet: 500 nA maximum (1 nA typical)', 1e-3),
    _input(
        'nonlinearity',
        1e-3,
        '',
        'largest error over the central 80 %, over the length of the area',
        'data sheets of duolateral sensors: 0.05 to 0.3 %',
        0.1,
    ),
    _input('drift_coefficient', 40e-6, '1/K', 'largest drift over the length', 'On-Trak: less than 40 ppm/K', 1e-2),
    # The surroundings.
    _input('temperature', 293.15, 'K', 'of the air', 'laboratory', 353.15, above=223.15),
    _input(
        'temperature_change', 5.0, 'K', 'of the sensors since zeroing, typical', 'assumption: a day in a hall', 100.0
    ),
    _input('air_gradient', 10.0, 'K/m', 'across the beams, typical', 'assumption: a warm joint near by', 1e3),
    _input(
        'air_step', 10.0, 'K', 'at a boundary in the beam, typical', 'assumption: the step of the 3.4 example', 500.0
    ),
    _input('air_step_angle', 0.0873, 'rad', "of the beam to that boundary's normal", 'assumption: 5 deg', 1.4),
    _input(
        'interference', 5e-3, 'V', 'amplitude of mains hum, typical, any phase', 'assumption: unshielded leads', 10.0
    ),
    _input(
        'interference_frequency',
        60.0,
        'Hz',
        'of the hum',
        '60 Hz mains: a mean of 20 samples at 1 kHz nulls 50 Hz',
        1e6,
        above=0.0,
    ),
    # The installation.
    _input('rotation_tolerance', 8.7e-3, 'rad', 'sensor about Z, ±', 'assumption: 0.5 deg, set by its edge', 0.5),
    _input('tilt_tolerance', 8.7e-3, 'rad', 'sensor about its X and Y, ±', 'assumption: 0.5 deg', 0.5),
    _input('beam_tolerance', 3.5e-3, 'rad', 'beam out of parallel, x and y, ±', 'assumption: 2 mm over the link', 0.5),
    _input('center_tolerance', 0.5e-3, 'm', 'sensor centre, x and y, ±', 'assumption: measured with a rule', 0.1),
    _input('height_tolerance', 1e-3, 'm', 'sensor surface along Z, ±', 'assumption: measured with a rule', 0.1),
    _input('gain_tolerance', 2e-3, '', 'sensitivity, each channel, ±', 'assumption: calibrated on a stage', 0.5),
    _input('expansion_coefficient', 23.6e-6, '1/K', "of the sensors' bracket", 'aluminium 6061', 1e-3),
    _input('bracket_temperature', 1.0, 'K', 'bracket against base, change since zeroing, typical', 'assumption', 100.0),
    _input(
        'slope_ratio_tolerance',
        0.5,
        '',
        'of k, ±',
        'k is 1 for a link that turns in its clamp, 2 for a tip moment',
        5.0,
    ),
    # The computation.
    _input(
        'zero_blocks', 1.0, 'blocks', 'averaged for the stored zero', "a zero is one estimate's block", 1e6, above=0.0
    ),
    # How well the deviations themselves are known.
    _input(
        'noise_freedom',
        999.0,
        '',
        'degrees of freedom of the measured noise',
        'assumption: the noise of a second at 1 kHz',
        1e9,
        above=0.0,
    ),
    _input(
        'assumption_doubt',
        0.25,
        '',
        'relative standard uncertainty of a deviation that is an assumption; 0: known',
        'JCGM 100:2008, G.4.2, example: 25 % gives 8 degrees of freedom',
        10.0,
    ),
    _input('iteration_tolerance', 0.1e-3, 'm', 'stop rule of thesis_iteration', 'thesis, appendix D', 0.01),
    _input('iteration_step', 1.745329e-4, 'rad', 'angle step of thesis_iteration', 'thesis: 0.01 deg', 0.1),
)

REFERENCE_INPUTS: tuple[Input, ...] = (
    _input(
        'reference_scale',
        1e-4,
        '',
        'relative standard uncertainty of the lengths of the reference',
        'assumption: a printed target measured with a rule; its certificate has it',
        0.1,
    ),
    _input(
        'reference_angle_scale',
        1e-4,
        '',
        'relative standard uncertainty of the angles of the reference',
        'assumption: as its lengths; its certificate has it',
        0.1,
    ),
)
"""Further ones of a certificate: what no calibration can see of its own reference."""

INPUT_BY_NAME: Mapping[str, Input] = MappingProxyType({i.parameter.name: i for i in (*INPUTS, *REFERENCE_INPUTS)})


def is_assumed(name: str, value: float) -> bool:
    """Return whether ``value`` of an input is a guess: the default, whose source is an assumption."""
    input_quantity = INPUT_BY_NAME[name]
    return input_quantity.source.startswith('assumption') and value == input_quantity.parameter.default


def read_inputs(
    path: str | Path | None = None,
    settings: Mapping[str, object] | None = None,
    source: str = 'settings',
    declared: Sequence[Input] = INPUTS,
) -> dict[str, float]:
    """Return all inputs that are ``declared``.

    ``settings`` override the YAML file (``name: value`` lines), which overrides the defaults. ``source``: where
    ``settings`` come from, for messages.

    Raises ConfigError naming the source, the input, the value and the bound.
    """
    values = {i.parameter.name: float(i.parameter.default) for i in declared}
    for place, given in ((str(path), _read(Path(path)) if path is not None else {}), (source, settings or {})):
        for name, value in given.items():
            input_quantity = INPUT_BY_NAME.get(str(name))
            if input_quantity is None or input_quantity.parameter.name not in values:
                hint = did_you_mean(str(name), values)
                raise ConfigError(f'{place}: {name} = {value!r}: no such input{hint}')
            values[str(name)] = cast(float, check_value(input_quantity.parameter, value, place))
    return values


def _read(path: Path) -> dict[object, object]:
    tree = tree_of_file(path, 'file of inputs')
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: inputs are lines of "name: value"')
    return tree
