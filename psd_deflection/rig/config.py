# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rig: the frozen sections that checked values make.

:func:`rig_from_values` makes the frozen :class:`Rig` from flat values (``link.length``), which the
node has from rclpy; :func:`load_rig` has them from a parameter file.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.tables import html_table
from psd_deflection.base.text import did_you_mean
from psd_deflection.records import FloatArray
from psd_deflection.rig.declarations import (
    ACQUISITION,
    AMPLIFIER,
    BEAMS,
    BY_NAME,
    CALIBRATION,
    CONVERTER,
    DYNAMICS,
    ESTIMATOR,
    LINK,
    MEASURES,
    MONITOR,
    MORE_PARAMETERS,
    MORE_PSDS,
    PARAMETERS,
    PSDS,
    QOS_OVERRIDES_PREFIX,
    ROS_OWN,
    SIMULATED,
    ZEROS,
    AmplifierConfig,
    BeamConfig,
    CalibrationConfig,
    ConverterConfig,
    DynamicsConfig,
    EstimatorConfig,
    LinkConfig,
    PsdConfig,
)
from psd_deflection.rig.parameter_files import EFFECTS_PREFIX, flattened, read_parameter_file
from psd_deflection.rig.parameters import Parameter, Section, Value, check_value, shown
from psd_deflection.rig.running import AcquisitionConfig, MonitorConfig

_ORDERED = (('link.inner_radius', 'less than', 'link.outer_radius'), ('sum_min', 'less than', 'sum_max'))
BASE_SOLVER = 'base_pair'
"""The solver that alone says ``arrangement: base``."""
_COMPARE = {'less than': operator.lt, 'at most': operator.le}


@dataclass(frozen=True, slots=True, repr=False)
class Rig:
    """The whole parameter set. ``values``: the flat values that it was made of, including defaults.

    ``effects``: the keys below ``effects.``, without that prefix.
    """

    link: LinkConfig
    psds: tuple[PsdConfig, ...]
    beams: tuple[BeamConfig, ...]
    amplifier: AmplifierConfig
    converter: ConverterConfig
    dynamics: DynamicsConfig
    calibration: CalibrationConfig
    estimator: EstimatorConfig
    acquisition: AcquisitionConfig
    monitor: MonitorConfig
    values: Mapping[str, Value] = field(repr=False)
    effects: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        changed = [p.with_value(self.values[p.name]) for p in self.parameters if self.values[p.name] != p.default]
        keys = sorted({key.partition('.')[0] for key in self.effects})
        words = ', '.join([*changed, *(f'{EFFECTS_PREFIX}{name}' for name in keys)])
        return f'<Rig {words}>' if words else '<Rig of the thesis>'

    def _repr_html_(self) -> str:
        flat = self.flat()
        return html_table(
            'Rig',
            (
                (name, BY_NAME[name].with_value(value).partition(' = ')[2] if name in BY_NAME else value)
                for name, value in flat.items()
            ),
        )

    def __reduce__(self) -> tuple[Callable[..., Rig], tuple[dict[str, object]]]:
        """Pickles and copies are made of the flat values."""
        return rig_from_values, (self.flat(),)

    def replace(self, **changes: object) -> Rig:
        """The same rig with some values changed: ``rig.replace(link={'length': 1.0}, block_size=10)``.

        ``changes``: with dots or as maps, as for :func:`psd_deflection.load_rig`. Raises
        ConfigError, which names parameter, value and bound.
        """
        return replace_values(self, flattened(changes, 'replace'), 'replace')

    def flat(self) -> dict[str, object]:
        """All values under their flat names, including simulated effects; :func:`rig_from_values` reads them."""
        return {**self.values, **{EFFECTS_PREFIX + key: value for key, value in self.effects.items()}}

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters that it has, in the order in which they are listed."""
        return (*PARAMETERS, *(p for more in MORE_PARAMETERS[: len(self.psds) - 2] for p in more))

    @property
    def zeros_by_name(self) -> dict[str, Value]:
        """The unloaded dots, m, by parameter name."""
        return {name: self.values[name] for name in ZEROS[: len(self.psds)]}

    @property
    def psds_at_base(self) -> bool:
        """Whether the PSDs are at the base and the lasers on the tip plate.

        Files and recordings from before ``arrangement`` existed say it by the name of their solver.
        """
        at = self.estimator.arrangement
        return at == 'base' or (at == 'auto' and self.estimator.solver == BASE_SOLVER)

    @property
    def centers(self) -> FloatArray:
        """c_i, (number of PSDs, 2), m."""
        return np.array([p.center for p in self.psds], dtype=np.float64)

    @property
    def zeros(self) -> FloatArray:
        """m_i0, (number of PSDs, 2), m."""
        return np.array([p.zero for p in self.psds], dtype=np.float64)

    @property
    def heights(self) -> FloatArray:
        """h_i, (number of PSDs,), m."""
        return np.array([p.height for p in self.psds], dtype=np.float64)

    @property
    def beam_slopes(self) -> FloatArray:
        """Lean of each beam along X and Y, (number of PSDs, 2), m/m."""
        return np.tan([b.angle for b in self.beams])

    @property
    def sensitivities(self) -> FloatArray:
        """Dot travel per volt on x and y, (number of PSDs, 2), m/V."""
        return np.array([[given or self.amplifier.sensitivity for given in p.sensitivity] for p in self.psds])

    @property
    def noises(self) -> FloatArray:
        """Noise of x, y and sum, rms per sample, (number of PSDs, 3), V."""
        return np.array([[given or self.amplifier.noise for given in (*p.noise, 0.0)] for p in self.psds])


def rig_from_values(values: Mapping[str, object], source: str = 'parameters') -> Rig:
    """Make a :class:`Rig` from flat values; missing values take their defaults.

    Parameters of the node that are not of the rig are ignored, because ``ros2 param dump`` writes
    them too. Raises ConfigError for an unknown key (with the nearest known one), a wrong type, a
    value out of bounds, or values that contradict each other.
    """
    return _rig({p.name: p.default for p in PARAMETERS}, {}, values, source)


def replace_values(rig: Rig, changes: Mapping[str, object], source: str = 'override') -> Rig:
    """The same rig with some values changed; they are checked like any others. Raises ConfigError."""
    return _rig(rig.values, rig.effects, changes, source)


def _rig(values: Mapping[str, Value], effects: Mapping[str, Any], changes: Mapping[str, object], source: str) -> Rig:
    """The rig of ``values``, already checked, and ``changes``, checked here."""
    v = dict(values)
    effects = dict(effects)
    for key, value in changes.items():
        if key.startswith(EFFECTS_PREFIX):
            effects[key.removeprefix(EFFECTS_PREFIX)] = value
        elif key in BY_NAME:
            v[key] = check_value(BY_NAME[key], value, source)
        elif key not in (*ROS_OWN, SIMULATED) and not key.startswith(QOS_OVERRIDES_PREFIX):
            raise ConfigError(
                f'{source}: {key} = {shown(value)}: no parameter of that name{did_you_mean(key, BY_NAME)}'
            )
    more = _more_psds(v, source)
    _check_together(v, source)
    return Rig(
        link=LINK.of(v),
        psds=tuple(psd.of(v) for psd in (*PSDS, *(psd for psd, _ in more))),
        beams=tuple(beam.of(v) for beam in (*BEAMS, *(beam for _, beam in more))),
        amplifier=AMPLIFIER.of(v),
        converter=CONVERTER.of(v),
        dynamics=DYNAMICS.of(v),
        calibration=CALIBRATION.of(v),
        estimator=ESTIMATOR.of(v),
        acquisition=ACQUISITION.of(v),
        monitor=MONITOR.of(v),
        values=MappingProxyType(v),
        effects=MappingProxyType(effects),
    )


def _more_psds(v: dict[str, Value], source: str) -> tuple[tuple[Section[PsdConfig], Section[BeamConfig]], ...]:
    """The sections of the PSDs beyond the second that ``v`` describes; what it does not say of them is added.

    Raises ConfigError if one has no centre, or the numbers have a gap.
    """
    given = [next((p.name for p in parameters if p.name in v), '') for parameters in MORE_PARAMETERS]
    count = max((i for i, name in enumerate(given, start=1) if name), default=0)
    for i, parameters in enumerate(MORE_PARAMETERS[:count]):
        name = MORE_PSDS[i][0].parameters['center'].name
        if name not in v:
            of = given[i] or given[count - 1]
            raise ConfigError(f'{source}: {of} is given without {name}: say where PSD {i + 3} is; PSDs have no gaps')
        for p in parameters:
            v.setdefault(p.name, p.default)
    return MORE_PSDS[:count]


def _check_together(v: dict[str, Any], source: str) -> None:
    """Raise ConfigError if values contradict each other; let ``solver`` run even if ``solvers`` does not name it."""
    for lower, relation, upper in _ORDERED:
        if not _COMPARE[relation](v[lower], v[upper]):
            low, high = (BY_NAME[name].with_value(v[name]) for name in (lower, upper))
            raise ConfigError(f'{source}: {low}: must be {relation} {high}')
    _check_wiring(v, source)
    if v['solver'] not in v['solvers']:
        v['solvers'] = [v['solver'], *v['solvers']]
    if len(set(v['solvers'])) != len(v['solvers']):
        raise ConfigError(f'{source}: solvers = {v["solvers"]!r}: a name is there twice')


def _check_wiring(v: Mapping[str, Any], source: str) -> None:
    """Raise ConfigError if a channel is used twice."""
    for p in (section.parameters['axes'] for section in (*PSDS, *(psd for psd, _ in MORE_PSDS))):
        if p.name in v and sorted(axis[-1] for axis in v[p.name]) != ['x', 'y']:
            raise ConfigError(f'{source}: {p.with_value(v[p.name])}: must name x once and y once')


def check_two_psds(rig: Rig, what: str) -> None:
    """Raise ConfigError if ``rig`` has more than two PSDs, for ``what`` is made for two."""
    if len(rig.psds) > 2:
        raise ConfigError(f'psd_3.center is given: {what} takes rigs of two PSDs, this one has {len(rig.psds)}')


def left_as_in_the_thesis(values: Mapping[str, object]) -> tuple[str, ...]:
    """Measures of the thesis rig that ``values`` (flat) still have, each as ``NAME = VALUE UNIT``.

    Somebody who describes another rig forgets some of them, and each then counts as measured. Empty
    if ``values`` describe no other rig: nothing of them differs.
    """
    same = [p.with_value(p.default) for p in MEASURES if values.get(p.name, p.default) == p.default]
    return tuple(same) if len(same) < len(MEASURES) else ()


def load_rig(path: str | Path | None = None, overrides: Mapping[str, object] | None = None) -> Rig:
    """The rig of a parameter file (default: the thesis rig's values), with overrides on top."""
    values = read_parameter_file(path) if path is not None else {}
    rig = rig_from_values(values, str(path) if path is not None else 'defaults')
    return replace_values(rig, overrides) if overrides else rig
