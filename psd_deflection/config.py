"""The rig: a parameter file or flat values in, frozen sections out; every bound checked.

:func:`load_rig` reads a ROS 2 parameter file (``/**: ros__parameters:``) without ROS;
:func:`rig_from_values` makes the frozen :class:`Rig` from flat values (``link.length``) and is what
the node calls with the values that rclpy gives it. What can be set is listed in
:mod:`psd_deflection.parameters`.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import yaml

from psd_deflection.errors import ConfigError
from psd_deflection.parameters import BY_NAME, PARAMETERS, Value, check_value
from psd_deflection.records import FloatArray

MAX_FILE_BYTES = 1_000_000
MAX_KEYS = 10_000

EFFECTS_PREFIX = 'effects.'
"""Keys below it describe simulated effects; ``psd_deflection.simulation`` checks them."""
ROS_OWN = ('use_sim_time', 'start_type_description_service')
QOS_OVERRIDES_PREFIX = 'qos_overrides.'


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """The link: m, Pa."""

    length: float
    outer_radius: float
    inner_radius: float
    youngs_modulus: float
    shear_modulus: float
    slope_ratio: float

    @property
    def second_moment(self) -> float:
        """I = pi/4 (Ro^4 - Ri^4), m^4."""
        return math.pi / 4.0 * (self.outer_radius**4 - self.inner_radius**4)

    @property
    def bending_stiffness(self) -> float:
        """EI, N m^2."""
        return self.youngs_modulus * self.second_moment

    @property
    def torsional_stiffness(self) -> float:
        """GJ, N m^2, with J = 2 I for a circular tube."""
        return self.shear_modulus * 2.0 * self.second_moment


@dataclass(frozen=True, slots=True)
class PsdConfig:
    """One detector: places in m."""

    type: str
    center: tuple[float, float]
    height: float
    active_area: tuple[float, float]
    spot_radius: float
    zero: tuple[float, float]


@dataclass(frozen=True, slots=True)
class AmplifierConfig:
    """``sensitivity`` m/V; ``sum_nominal`` V; ``noise`` V rms per sample and channel."""

    sensitivity: float
    sum_nominal: float
    noise: float


@dataclass(frozen=True, slots=True)
class ConverterConfig:
    """``full_scale`` V (range +-); ``sample_rate_hz`` Hz."""

    bits: int
    full_scale: float
    sample_rate_hz: float

    @property
    def volts_per_count(self) -> float:
        """One step, V."""
        return self.full_scale / float(2 ** (self.bits - 1))


@dataclass(frozen=True, slots=True)
class DynamicsConfig:
    """First bending (X and Y alike) and torsion mode: Hz and damping ratios."""

    bending_frequency: float
    bending_damping_ratio: float
    torsion_frequency: float
    torsion_damping_ratio: float


@dataclass(frozen=True, slots=True)
class EstimatorConfig:
    """How samples become estimates."""

    block_size: int
    min_samples: int
    sum_min: float
    sum_max: float
    block_fit: str
    covariance: str
    consistency: str
    splitter: bool
    degraded: str
    frozen: str
    twist_sd: float
    twist_hold: float
    solver: str
    solvers: tuple[str, ...]
    wls_weights: str
    wls_row_scaling: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class AcquisitionConfig:
    """Where samples come from and where they are kept."""

    source: str
    port: str
    baud: int
    latency_offset: float
    queue_blocks: int
    serial_number: str
    keep_zero: bool
    zero_file: str
    realtime: bool
    record: bool
    bag_dir: str
    bag_max_bytes: int
    bag_max_duration: float
    disk_reserve: int
    disk_full: str


@dataclass(frozen=True, slots=True)
class MonitorConfig:
    """The live page: whether, where, and whether its buttons work; markers for RViz, and how much magnified."""

    enabled: bool
    address: str
    port: int
    control: bool
    markers: bool
    markers_magnify: float


@dataclass(frozen=True, slots=True)
class Rig:
    """The whole parameter set. ``values`` is what it was made of, flat, defaults included."""

    link: LinkConfig
    psd_1: PsdConfig
    psd_2: PsdConfig
    amplifier: AmplifierConfig
    converter: ConverterConfig
    dynamics: DynamicsConfig
    estimator: EstimatorConfig
    acquisition: AcquisitionConfig
    monitor: MonitorConfig
    values: Mapping[str, Value] = field(repr=False)
    effects: Mapping[str, Any] = field(default_factory=dict)

    def flat(self) -> dict[str, object]:
        """All values under their flat names, those of the simulated effects too: :func:`rig_from_values` reads them."""
        return {**self.values, **{EFFECTS_PREFIX + key: value for key, value in self.effects.items()}}

    @property
    def psds(self) -> tuple[PsdConfig, PsdConfig]:
        """Both detectors, in order."""
        return (self.psd_1, self.psd_2)

    @property
    def centers(self) -> FloatArray:
        """c_i, (2, 2), m."""
        return np.array([p.center for p in self.psds], dtype=np.float64)

    @property
    def zeros(self) -> FloatArray:
        """m_i0, (2, 2), m."""
        return np.array([p.zero for p in self.psds], dtype=np.float64)

    @property
    def heights(self) -> FloatArray:
        """h_i, (2,), m."""
        return np.array([p.height for p in self.psds], dtype=np.float64)


def rig_from_values(values: Mapping[str, object], source: str = 'parameters') -> Rig:
    """Make a :class:`Rig` from flat values; what is missing takes its default.

    Parameters that every ROS node has are passed over: ``ros2 param dump`` writes them too. Raises ConfigError for
    an unknown key (with the nearest known one), a wrong type, a value out of bounds, or values that contradict each
    other.
    """
    effects: dict[str, Any] = {}
    got: dict[str, Value] = {p.name: p.default for p in PARAMETERS}
    for key, value in values.items():
        if key.startswith(EFFECTS_PREFIX):
            effects[key[len(EFFECTS_PREFIX) :]] = value
            continue
        if key in ROS_OWN or key.startswith(QOS_OVERRIDES_PREFIX):
            continue
        parameter = BY_NAME.get(key)
        if parameter is None:
            near = difflib.get_close_matches(key, BY_NAME, n=1)
            hint = f'; did you mean {near[0]}?' if near else ''
            raise ConfigError(f'{source}: {key} = {value!r}: no parameter of that name{hint}')
        got[key] = check_value(parameter, value, source)
    v: dict[str, Any] = dict(got)
    if v['link.inner_radius'] >= v['link.outer_radius']:
        raise ConfigError(
            f'{source}: link.inner_radius = {v["link.inner_radius"]} m: must be less than '
            f'link.outer_radius = {v["link.outer_radius"]} m'
        )
    if v['min_samples'] > v['block_size']:
        raise ConfigError(f'{source}: min_samples = {v["min_samples"]}: must be at most block_size = {v["block_size"]}')
    if v['sum_min'] >= v['sum_max']:
        raise ConfigError(f'{source}: sum_min = {v["sum_min"]} V: must be less than sum_max = {v["sum_max"]} V')
    if v['solver'] not in v['solvers']:
        v['solvers'] = [v['solver'], *v['solvers']]
        got['solvers'] = v['solvers']
    if len(set(v['solvers'])) != len(v['solvers']):
        raise ConfigError(f'{source}: solvers = {v["solvers"]!r}: a name is there twice')

    def section(prefix: str) -> dict[str, Any]:
        out = {}
        for p in PARAMETERS:
            if p.name.startswith(prefix + '.'):
                item = v[p.name]
                out[p.name[len(prefix) + 1 :]] = tuple(item) if isinstance(item, list) else item
        return out

    return Rig(
        link=LinkConfig(**section('link')),
        psd_1=PsdConfig(**section('psd_1')),
        psd_2=PsdConfig(**section('psd_2')),
        amplifier=AmplifierConfig(**section('amplifier')),
        converter=ConverterConfig(**section('converter')),
        dynamics=DynamicsConfig(**section('dynamics')),
        estimator=EstimatorConfig(
            block_size=v['block_size'],
            min_samples=v['min_samples'],
            sum_min=v['sum_min'],
            sum_max=v['sum_max'],
            block_fit=v['block_fit'],
            covariance=v['covariance'],
            consistency=v['consistency'],
            splitter=v['splitter'],
            degraded=v['degraded'],
            frozen=v['frozen'],
            twist_sd=v['twist_sd'],
            twist_hold=v['twist_hold'],
            solver=v['solver'],
            solvers=tuple(v['solvers']),
            wls_weights=v['wls.weights'],
            wls_row_scaling=tuple(v['wls.row_scaling']),
        ),
        acquisition=AcquisitionConfig(
            source=v['source'],
            port=v['port'],
            baud=v['baud'],
            latency_offset=v['latency_offset'],
            queue_blocks=v['queue_blocks'],
            serial_number=v['serial_number'],
            keep_zero=v['keep_zero'],
            zero_file=v['zero_file'],
            realtime=v['realtime'],
            record=v['record'],
            bag_dir=v['bag_dir'],
            bag_max_bytes=v['bag_max_bytes'],
            bag_max_duration=v['bag_max_duration'],
            disk_reserve=v['disk_reserve'],
            disk_full=v['disk_full'],
        ),
        monitor=MonitorConfig(
            enabled=v['monitor'],
            address=v['monitor_address'],
            port=v['monitor_port'],
            control=v['monitor_control'],
            markers=v['markers'],
            markers_magnify=v['markers_magnify'],
        ),
        values=MappingProxyType(got),
        effects=MappingProxyType(effects),
    )


def rig_as_recorded(values: Mapping[str, object], source: str) -> Rig:
    """The rig of a recording's parameters: one that they do not name was not there yet, and what held before it holds.

    A recording names every parameter of its time; one that names none (CSV) has today's defaults. Raises ConfigError
    as :func:`rig_from_values` does.
    """
    then = {p.name: p.before for p in PARAMETERS if p.before is not None} if values else {}
    return rig_from_values({**then, **values}, source)


def replace_values(rig: Rig, changes: Mapping[str, object], source: str = 'override') -> Rig:
    """The same rig with some values changed, checked like any others."""
    return rig_from_values({**rig.flat(), **changes}, source)


def read_parameter_file(path: str | Path, node_name: str = 'estimator') -> dict[str, object]:
    """Flat values of a ROS 2 parameter file: those for ``/**`` and for ``node_name``.

    Lists stay lists; maps become dotted keys. Raises ConfigError naming the file when it is
    missing, too large, not YAML, or not a parameter file.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise ConfigError(f'{path}: {size} bytes: a parameter file has at most {MAX_FILE_BYTES}')
        text = path.read_text(encoding='utf-8')
    except FileNotFoundError:
        raise ConfigError(f'{path}: no such parameter file') from None
    except OSError as error:
        raise ConfigError(f'{path}: cannot be read as a parameter file ({error.strerror or error})') from None
    except UnicodeDecodeError:
        raise ConfigError(f'{path}: cannot be read as a parameter file (it is no text)') from None
    try:
        tree = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, 'problem_mark', None)
        where = f':{mark.line + 1}:{mark.column + 1}' if mark is not None else ''
        problem = getattr(error, 'problem', None) or 'not YAML'
        raise ConfigError(f'{path}{where}: malformed YAML: {problem}') from None
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: not a ROS 2 parameter file: expected "/**:" then "ros__parameters:"')
    flat: dict[str, object] = {}
    wanted = ('/**', node_name, '/' + node_name, '/**/' + node_name)
    for name, body in tree.items():
        if not isinstance(body, dict) or not isinstance(body.get('ros__parameters'), dict):
            raise ConfigError(f'{path}: {name}: not a ROS 2 parameter file: "ros__parameters:" is missing below it')
        if name in wanted:
            _flatten(body['ros__parameters'], '', flat, path, 0)
    if not any(name in wanted for name in tree):
        raise ConfigError(f'{path}: has no parameters for /** or {node_name} (found: {", ".join(map(str, tree))})')
    return flat


def _flatten(tree: Mapping[Any, Any], prefix: str, out: dict[str, object], path: Path, depth: int) -> None:
    if depth > 8:
        raise ConfigError(f'{path}: {prefix} is nested too deep')
    for key, value in tree.items():
        name = f'{prefix}{key}'
        if isinstance(value, dict):
            _flatten(value, name + '.', out, path, depth + 1)
        else:
            out[name] = value
        if len(out) > MAX_KEYS:
            raise ConfigError(f'{path}: more than {MAX_KEYS} parameters')


def load_rig(path: str | Path | None = None, overrides: Mapping[str, object] | None = None) -> Rig:
    """The rig of a parameter file (default: the thesis rig's values), with overrides on top."""
    values = read_parameter_file(path) if path is not None else {}
    rig = rig_from_values(values, str(path) if path is not None else 'defaults')
    return replace_values(rig, overrides) if overrides else rig
