# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every parameter of a rig, declared once: type, default, unit, bounds and a sentence. Checks, ``psd-deflection
params``, the node's descriptors and the documentation are derived; how the node runs is in
:mod:`psd_deflection.rig.running`."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from psd_deflection.records import MOST_PSDS
from psd_deflection.rig.parameters import Parameter, Section, parameter
from psd_deflection.rig.running import AcquisitionConfig, MonitorConfig

FRAME_PREFIX = 'frame_prefix'
SIMULATED = 'simulated'
"""Set by the node: whether its samples are those of the simulated rig. A file of ``ros2 param dump`` has it too."""
ROS_OWN = ('use_sim_time', 'start_type_description_service')
QOS_OVERRIDES_PREFIX = 'qos_overrides.'
LEAST_BITS, MOST_BITS = 8, 24
AXES = ('x', '-x', 'y', '-y')
SENSOR_TYPES = ('duolateral', 'tetralateral', 'pincushion', 'quadrant')


@dataclass(frozen=True, slots=True)
class LinkConfig:
    """The link."""

    length: float = parameter(0.585, 'm', 'length L of the link', above=0.0, maximum=1000.0)
    outer_radius: float = parameter(0.0159, 'm', 'outer radius of the tube', above=0.0, maximum=10.0)
    inner_radius: float = parameter(0.0138, 'm', 'inner radius of the tube', minimum=0.0, maximum=10.0)
    youngs_modulus: float = parameter(69e9, 'Pa', "Young's modulus E", above=0.0, maximum=1e13)
    shear_modulus: float = parameter(24e9, 'Pa', 'shear modulus G', above=0.0, maximum=1e13)
    slope_ratio: float = parameter(
        1.5, '', 'k of the tip slope, φ = -k ΔY/L: 3/2 for a tip force, 2 for a tip moment', minimum=0.0, maximum=10.0
    )

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
    """One detector."""

    type: str = parameter('duolateral', '', 'sensor type', choices=SENSOR_TYPES)
    center: tuple[float, float] = parameter(
        (0.0, 0.0), 'm', 'centre of the PSD in link_tip (x, y)', minimum=-10.0, maximum=10.0
    )
    height: float = parameter(
        0.0, 'm', 'sensitive surface above the tip section, along +Z', minimum=-10.0, maximum=10.0
    )
    active_area: tuple[float, float] = parameter(
        (0.010, 0.010), 'm', 'active area (width, height)', above=0.0, maximum=1.0
    )
    spot_radius: float = parameter(
        0.5e-3, 'm', 'radius of the laser spot on it, to 1/e^2 of the peak', above=0.0, maximum=0.1
    )
    zero: tuple[float, float] = parameter(
        (0.0, 0.0), 'm', 'dot on the unloaded link (x, y); ~/zero sets it', minimum=-0.5, maximum=0.5, live=True
    )
    sensitivity: tuple[float, float] = parameter(
        (0.0, 0.0), 'm/V', 'dot travel per volt on x and on y; 0: amplifier.sensitivity', minimum=0.0, maximum=1.0
    )
    noise: tuple[float, float] = parameter(
        (0.0, 0.0), 'V', 'noise of x and of y, rms per sample; 0: amplifier.noise', minimum=0.0, maximum=10.0
    )
    dark: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0),
        'V',
        'its x, y and sum with its laser off: the light that is taken off each reading; sum 0: none',
        minimum=-1000.0,
        maximum=1000.0,
    )
    axes: tuple[str, str] = parameter(
        ('x', 'y'),
        '',
        'which channels of the device are its x and its y, with their signs: [-y, x] '
        "(write +y, or 'y' in quotes: ROS takes a bare y for true)",
        choices=AXES,
        synonyms=(('+x', 'x'), ('+y', 'y')),
    )


@dataclass(frozen=True, slots=True)
class BeamConfig:
    """One laser beam."""

    angle: tuple[float, float] = parameter(
        (0.0, 0.0), 'rad', 'lean of the beam on its way to the tip, towards +X and +Y', minimum=-0.5, maximum=0.5
    )


@dataclass(frozen=True, slots=True)
class CalibrationConfig:
    """What a calibration left open; `psd-deflection calibrate` writes it."""

    names: tuple[str, ...] = parameter(
        ('none',), '', 'calibrated parameters, such as psd_1.rotation; none: the rig was not calibrated'
    )
    sds: tuple[float, ...] = parameter((0.0,), '', 'standard deviation of each, in SI units', minimum=0.0, maximum=1e9)
    correlations: tuple[float, ...] = parameter(
        (0.0,),
        '',
        'correlations between them: each with those before it, the second name first; 0: none',
        minimum=-1.0,
        maximum=1.0,
    )
    source: str = parameter('', '', 'recordings (by hash), software and date of the calibration')
    range: tuple[float, ...] = parameter(
        (0.0,),
        '',
        'poses that it was made with: least ΔX, ΔY (m), θ (rad), then the largest; 0: not known, nothing is said',
        minimum=-1000.0,
        maximum=1000.0,
    )


@dataclass(frozen=True, slots=True)
class AmplifierConfig:
    """The amplifier of both detectors."""

    sensitivity: float = parameter(
        0.5e-3, 'm/V', 'dot travel per volt on x and y, unless psd_N.sensitivity is set', above=0.0, maximum=1.0
    )
    sum_nominal: float = parameter(5.0, 'V', 'sum signal with the laser on', above=0.0, maximum=100.0)
    noise: float = parameter(
        2e-3, 'V', 'noise, rms per sample and channel, unless psd_N.noise is set', above=0.0, maximum=10.0
    )


@dataclass(frozen=True, slots=True)
class ConverterConfig:
    """The analogue-to-digital converter."""

    bits: int = parameter(16, '', 'bits of the converter', minimum=LEAST_BITS, maximum=MOST_BITS)
    full_scale: float = parameter(10.0, 'V', 'range is ± this', above=0.0, maximum=1000.0)
    sample_rate_hz: float = parameter(1000.0, 'Hz', 'samples per second', minimum=1.0, maximum=10_000.0)

    @property
    def volts_per_count(self) -> float:
        """One step, V."""
        return self.full_scale / float(2 ** (self.bits - 1))


@dataclass(frozen=True, slots=True)
class DynamicsConfig:
    """The link's first bending mode (X and Y alike) and its first torsion mode; the simulation uses them."""

    bending_frequency: float = parameter(14.0, 'Hz', 'first bending mode', above=0.0, maximum=1e4)
    bending_damping_ratio: float = parameter(0.02, '', 'its damping ratio', minimum=0.0, maximum=0.99)
    torsion_frequency: float = parameter(21.0, 'Hz', 'first torsion mode', above=0.0, maximum=1e4)
    torsion_damping_ratio: float = parameter(0.02, '', 'its damping ratio', minimum=0.0, maximum=0.99)


@dataclass(frozen=True, slots=True)
class EstimatorConfig:
    """How samples become estimates."""

    block_size: int = parameter(20, 'samples', 'samples averaged for one estimate', minimum=1, maximum=1000)
    min_samples: int = parameter(
        10,
        'samples',
        'a block with fewer samples has no estimate; one of a smaller block_size needs all of them',
        minimum=1,
        maximum=1000,
    )
    decimation: int = parameter(
        1,
        'blocks',
        'of so many blocks one has a wrench, dots and the answers of the other solvers; the estimate of solver and the '
        'samples are of every block, so that small blocks cost less',
        minimum=1,
        maximum=1000,
    )
    sum_min: float = parameter(
        2.5, 'V', 'a sum signal below this means that the laser is lost', minimum=0.0, maximum=100.0, live=True
    )
    sum_max: float = parameter(
        7.5,
        'V',
        'a sum signal above this means that other light falls on the detector',
        above=0.0,
        maximum=100.0,
        live=True,
    )
    covariance: str = parameter(
        'total',
        '',
        'what the covariances hold: the noise measured in the stream after 100 blocks and what calibration.* leaves '
        'open (total), or that noise alone (measured, or noise)',
        choices=('total', 'measured'),
        synonyms=(('noise', 'measured'),),
    )
    consistency: str = parameter(
        'widen',
        '',
        'when the readings contradict each other: widen the covariance, reject the block, or only report it',
        choices=('widen', 'reject', 'report'),
    )
    splitter: bool = parameter(
        False, '', 'both detectors share two lasers over a beam splitter (thesis 5.4): one lost halves both sums'
    )
    degraded: str = parameter(
        'none',
        '',
        'with one detector lost: none (no estimate), hold (translation with the last twist), zero (with no twist)',
        choices=('none', 'hold', 'zero'),
        # YAML, and so ROS, reads off as false.
        synonyms=(('off', 'none'), (False, 'none')),
        live=True,
    )
    frozen: str = parameter(
        'report',
        '',
        'a detector whose values do not change by one bit: report it in /diagnostics, or also reject its blocks',
        choices=('report', 'reject'),
        live=True,
    )
    twist_sd: float = parameter(
        0.01,
        'rad',
        'standard deviation of the twist if it is not measured (degraded)',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    twist_hold: float = parameter(
        0.1,
        's',
        'time after which a held twist counts for nothing: its variance has grown to twist_sd^2 (degraded: hold)',
        above=0.0,
        maximum=1e6,
        live=True,
    )
    arrangement: str = parameter(
        'auto',
        '',
        'where the PSDs are: on the tip plate, lasers at the base (tip), or the other way round (base); auto: base '
        'with solver: base_pair, else tip',
        choices=('auto', 'tip', 'base'),
    )
    solver: str = parameter('exact', '', 'the solver whose answer is /link_tip/deflection')
    solvers: tuple[str, ...] = parameter(
        ('exact', 'wls', 'iterative'), '', 'solvers that run; each has a topic /link_tip/SOLVER/deflection'
    )
    wls_weights: str = parameter(
        'inverse_variance',
        '',
        'weights of wls: from the noise, or the row scaling of the thesis',
        name='wls.weights',
        choices=('inverse_variance', 'thesis'),
    )
    base_pair_assume: str = parameter(
        'beam',
        '',
        'what base_pair assumes: tilts that follow the deflection (beam), or no twist (needs two planes)',
        name='base_pair.assume',
        choices=('beam', 'no_twist'),
    )
    minimum_tilt_angles: str = parameter(
        'rotation',
        '',
        "what minimum_tilt publishes: twist and tilts of one rotation, or the base line's azimuth as the twist",
        name='minimum_tilt.angles',
        choices=('rotation', 'azimuth'),
    )
    filter: str = parameter(
        'none',
        '',
        'filter of the motion, /link_tip/velocity and /link_tip/filtered/deflection: none, or modal (Kalman filter on '
        'dynamics.*)',
        choices=('none', 'modal'),
        # YAML, and so ROS, reads off as false.
        synonyms=(('off', 'none'), (False, 'none')),
    )
    filter_ahead: float = parameter(
        0.0,
        's',
        'the filter predicts the motion so long after the last sample: the transport delay of who uses it',
        minimum=0.0,
        maximum=1.0,
    )
    filter_coast: float = parameter(
        0.5, 's', 'the filter goes on without samples for at most so long', minimum=0.0, maximum=60.0
    )
    filter_load_walk: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0),
        '',
        'process noise of the filter: how far fx, fy (N) and tz (N m) wander in the root of a second; 0 0 0: estimated',
        minimum=0.0,
        maximum=1e6,
    )
    wls_row_scaling: tuple[float, float, float, float] = parameter(
        (0.03, 0.5, 10.0, 0.1),
        '',
        "the thesis's row scaling of x1, y1, x2, y2 (weights are its squares), used when wls.weights is thesis",
        name='wls.row_scaling',
        above=0.0,
        maximum=1e6,
    )


LINK = Section(LinkConfig, 'link.')
PSDS = (Section(PsdConfig, 'psd_1.', center=(0.0, 0.070)), Section(PsdConfig, 'psd_2.', center=(-0.100, 0.0)))
BEAMS = (Section(BeamConfig, 'beam_1.'), Section(BeamConfig, 'beam_2.'))
MORE_PSDS = tuple((Section(PsdConfig, f'psd_{n}.'), Section(BeamConfig, f'beam_{n}.')) for n in range(3, MOST_PSDS + 1))
"""PSDs that a rig may have, each with its beam: it has those whose ``center`` is given."""
CALIBRATION = Section(CalibrationConfig, 'calibration.')
AMPLIFIER = Section(AmplifierConfig, 'amplifier.')
CONVERTER = Section(ConverterConfig, 'converter.')
DYNAMICS = Section(DynamicsConfig, 'dynamics.')
ESTIMATOR = Section(EstimatorConfig)
ACQUISITION = Section(AcquisitionConfig)
MONITOR = Section(MonitorConfig)

SECTIONS: tuple[Section[Any], ...] = (
    LINK,
    *PSDS,
    *BEAMS,
    AMPLIFIER,
    CONVERTER,
    DYNAMICS,
    CALIBRATION,
    ESTIMATOR,
    ACQUISITION,
    MONITOR,
)
PARAMETERS: tuple[Parameter, ...] = tuple(p for section in SECTIONS for p in section.parameters.values())
"""The parameters of every rig, in the order in which they are listed."""
MORE_PARAMETERS: tuple[tuple[Parameter, ...], ...] = tuple(
    tuple(p for section in pair for p in section.parameters.values()) for pair in MORE_PSDS
)
"""Those of PSD 3 and its beam, of PSD 4 and its beam ...: a rig has them if it has the PSD."""
BY_NAME: Mapping[str, Parameter] = MappingProxyType(
    {p.name: p for p in (*PARAMETERS, *(p for more in MORE_PARAMETERS for p in more))}
)
MEASURES = tuple(
    p
    for section in (LINK, *PSDS, AMPLIFIER, CONVERTER, DYNAMICS)
    for p in section.parameters.values()
    # A default of 0 says that there is nothing; any other one is a measure of the thesis rig.
    if p.kind.startswith('double') and np.any(p.default)
)
"""What somebody measures on a rig: its default is the thesis rig's."""
DESCRIPTION = (
    *(
        p.name
        for section in (LINK, *PSDS, *BEAMS, AMPLIFIER, CONVERTER, DYNAMICS, CALIBRATION, ESTIMATOR)
        for p in section.parameters.values()
    ),
    *(ACQUISITION.parameters[name].name for name in ('psds_exchanged', 'latency_offset', 'thorlabs_x_sign')),
)
"""Parameters that describe the rig and how it is evaluated; the others say how the node runs on one machine."""
ZEROS = tuple(f'psd_{n}.zero' for n in range(1, MOST_PSDS + 1))
"""The parameters that ``~/zero`` sets, one for each detector that a rig may have."""
