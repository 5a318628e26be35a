"""What can be set: the one list, with type, default, unit, bounds and a sentence for the reader.

The parameter files, the command line, the node and the documentation all read it.
:func:`check_value` refuses what does not fit, naming source, key, value and bound.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from psd_deflection.errors import ConfigError

Kind = Literal['double', 'integer', 'bool', 'string', 'double_array', 'string_array']
Value = float | int | bool | str | list[float] | list[str]

SENSOR_TYPES = ('duolateral', 'tetralateral', 'pincushion', 'quadrant')


@dataclass(frozen=True, slots=True)
class Parameter:
    """One thing that can be set. ``minimum``/``maximum`` hold for each element of an array.

    ``above``: an exclusive lower bound. ``live``: may change while the node runs. ``before``: what held before there
    was this parameter, and so what a recording that does not name it was made with; None: the default.
    """

    name: str
    kind: Kind
    default: Any
    unit: str
    description: str
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    length: int | None = None
    choices: tuple[str, ...] | None = None
    live: bool = False
    before: Any = None

    def bound_text(self) -> str:
        """The bounds in words, for an error message or ``--help``."""
        words = (('above', self.above), ('at least', self.minimum), ('at most', self.maximum))
        # Whole numbers as they are typed: nobody writes 1e+06 bytes.
        form = '.0f' if self.kind == 'integer' else 'g'
        parts = [f'{word} {bound:{form}}' for word, bound in words if bound is not None]
        return ' and '.join(parts)


def _psd(number: int, center: list[float]) -> list[Parameter]:
    p = f'psd_{number}.'
    return [
        Parameter(p + 'type', 'string', 'duolateral', '', 'sensor type', choices=SENSOR_TYPES),
        Parameter(
            p + 'center',
            'double_array',
            center,
            'm',
            'centre of the PSD in link_tip (x, y)',
            minimum=-10.0,
            maximum=10.0,
            length=2,
        ),
        Parameter(
            p + 'height',
            'double',
            0.0,
            'm',
            'sensitive surface above the tip section, along +Z',
            minimum=-10.0,
            maximum=10.0,
        ),
        Parameter(
            p + 'active_area',
            'double_array',
            [0.010, 0.010],
            'm',
            'active area (width, height)',
            above=0.0,
            maximum=1.0,
            length=2,
        ),
        Parameter(
            p + 'spot_radius',
            'double',
            0.5e-3,
            'm',
            'radius of the laser spot on it, to 1/e^2 of the peak',
            above=0.0,
            maximum=0.1,
        ),
        Parameter(
            p + 'zero',
            'double_array',
            [0.0, 0.0],
            'm',
            'dot on the unloaded link (x, y); ~/zero sets it',
            minimum=-0.5,
            maximum=0.5,
            length=2,
            live=True,
        ),
    ]


PARAMETERS: tuple[Parameter, ...] = (
    # The link.
    Parameter('link.length', 'double', 0.585, 'm', 'length L of the link', above=0.0, maximum=1000.0),
    Parameter('link.outer_radius', 'double', 0.0159, 'm', 'outer radius of the tube', above=0.0, maximum=10.0),
    Parameter('link.inner_radius', 'double', 0.0138, 'm', 'inner radius of the tube', minimum=0.0, maximum=10.0),
    Parameter('link.youngs_modulus', 'double', 69e9, 'Pa', "Young's modulus E", above=0.0, maximum=1e13),
    Parameter('link.shear_modulus', 'double', 24e9, 'Pa', 'shear modulus G', above=0.0, maximum=1e13),
    Parameter(
        'link.slope_ratio',
        'double',
        1.5,
        '',
        'k of the tip slope, phi = -k dY/L: 3/2 for a tip force, 2 for a tip moment',
        minimum=0.0,
        maximum=10.0,
    ),
    # The two detectors.
    *_psd(1, [0.0, 0.070]),
    *_psd(2, [-0.100, 0.0]),
    # Amplifier and converter.
    Parameter(
        'amplifier.sensitivity', 'double', 0.5e-3, 'm/V', 'dot travel per volt on x and y', above=0.0, maximum=1.0
    ),
    Parameter('amplifier.sum_nominal', 'double', 5.0, 'V', 'sum signal with the laser on', above=0.0, maximum=100.0),
    Parameter('amplifier.noise', 'double', 2e-3, 'V', 'noise, rms per sample and channel', above=0.0, maximum=10.0),
    Parameter('converter.bits', 'integer', 16, '', 'bits of the converter', minimum=8, maximum=16),
    Parameter('converter.full_scale', 'double', 10.0, 'V', 'range is +- this', above=0.0, maximum=1000.0),
    Parameter('converter.sample_rate_hz', 'double', 1000.0, 'Hz', 'samples per second', minimum=1.0, maximum=10_000.0),
    # The link's modes (used by the simulation).
    Parameter('dynamics.bending_frequency', 'double', 14.0, 'Hz', 'first bending mode', above=0.0, maximum=1e4),
    Parameter('dynamics.bending_damping_ratio', 'double', 0.02, '', 'its damping ratio', minimum=0.0, maximum=0.99),
    Parameter('dynamics.torsion_frequency', 'double', 21.0, 'Hz', 'first torsion mode', above=0.0, maximum=1e4),
    Parameter('dynamics.torsion_damping_ratio', 'double', 0.02, '', 'its damping ratio', minimum=0.0, maximum=0.99),
    # From samples to estimates.
    Parameter('block_size', 'integer', 20, 'samples', 'samples averaged for one estimate', minimum=1, maximum=1000),
    Parameter(
        'min_samples', 'integer', 10, 'samples', 'a block with fewer present has no estimate', minimum=1, maximum=1000
    ),
    Parameter(
        'block_fit',
        'string',
        'poly',
        '',
        'what a block gives: its mean, or a polynomial at the stamp (poly), which follows motion inside the block',
        choices=('mean', 'poly'),
        before='mean',
    ),
    Parameter(
        'covariance',
        'string',
        'measured',
        '',
        "noise behind the covariances: the rig file's, or measured in the stream after 100 blocks",
        choices=('file', 'measured'),
        before='file',
    ),
    Parameter(
        'consistency',
        'string',
        'widen',
        '',
        'when the four readings contradict each other: widen the covariance, refuse the block, or only report it',
        choices=('widen', 'refuse', 'report'),
        before='report',
    ),
    Parameter(
        'sum_min',
        'double',
        2.5,
        'V',
        'a sum signal below this means that the laser is lost',
        minimum=0.0,
        maximum=100.0,
        live=True,
    ),
    Parameter(
        'sum_max',
        'double',
        7.5,
        'V',
        'a sum signal above this means that other light falls on the detector',
        above=0.0,
        maximum=100.0,
        live=True,
    ),
    Parameter(
        'splitter',
        'bool',
        False,
        '',
        'both detectors share two lasers over a beam splitter (thesis 5.4): one lost halves both sums',
    ),
    Parameter(
        'degraded',
        'string',
        'off',
        '',
        'with one detector lost: off (no estimate), hold (translation with the last twist), zero (with no twist)',
        choices=('off', 'hold', 'zero'),
        live=True,
    ),
    Parameter(
        'frozen',
        'string',
        'report',
        '',
        'a detector of which no bit moves: report it in /diagnostics, or refuse its blocks as well',
        choices=('report', 'refuse'),
        live=True,
    ),
    Parameter(
        'twist_sd',
        'double',
        0.01,
        'rad',
        'standard deviation of the twist where it is not measured (degraded)',
        above=0.0,
        maximum=10.0,
        live=True,
    ),
    Parameter(
        'twist_hold',
        'double',
        0.1,
        's',
        'time in which a held twist is forgotten: its variance grows to twist_sd^2 (degraded: hold)',
        above=0.0,
        maximum=1e6,
        live=True,
    ),
    Parameter('solver', 'string', 'exact', '', 'the solver whose answer is /link_tip/deflection'),
    Parameter(
        'solvers',
        'string_array',
        ['exact', 'wls', 'iterative'],
        '',
        'solvers that run; each has a topic /link_tip/SOLVER/deflection',
    ),
    Parameter(
        'wls.weights',
        'string',
        'inverse_variance',
        '',
        'weights of wls: from the noise, or the row scaling of the thesis',
        choices=('inverse_variance', 'thesis'),
    ),
    Parameter(
        'wls.row_scaling',
        'double_array',
        [0.03, 0.5, 10.0, 0.1],
        '',
        "the thesis's row scaling of x1, y1, x2, y2 (weights are its squares), used when wls.weights is thesis",
        above=0.0,
        maximum=1e6,
        length=4,
    ),
    # Acquisition.
    Parameter(
        'source',
        'string',
        'serial',
        '',
        'what the device speaks: serial (our own frames), dataq, thorlabs, lines, replay, or the name of a plug-in',
    ),
    Parameter(
        'port',
        'string',
        '',
        '',
        'serial port (two with a comma between for thorlabs, a recording for replay); empty starts the simulated rig',
    ),
    Parameter(
        'baud', 'integer', 921_600, 'baud', 'line speed (USB-CDC devices ignore it)', minimum=1200, maximum=12_000_000
    ),
    Parameter(
        'latency_offset',
        'double',
        0.0,
        's',
        'constant delay of the link to take off every stamp',
        minimum=-1.0,
        maximum=1.0,
    ),
    Parameter(
        'queue_blocks', 'integer', 250, 'blocks', 'blocks that may wait for a slow consumer', minimum=2, maximum=100_000
    ),
    Parameter(
        'serial_number',
        'string',
        '',
        '',
        'serial number that the device must say (HELLO); with it the device is found again under another port name',
    ),
    # The node.
    Parameter('autostart', 'bool', True, '', 'configure and activate at start; false: wait for lifecycle transitions'),
    Parameter('keep_zero', 'bool', True, '', '~/zero holds for later runs with the same device as well'),
    Parameter(
        'zero_file',
        'string',
        '',
        '',
        'file in which the zero is kept; empty: by serial number below $XDG_STATE_HOME/psd_deflection',
    ),
    Parameter(
        'realtime', 'bool', True, '', 'ask for SCHED_FIFO (reader) and locked memory; the log says what was granted'
    ),
    Parameter(
        'thorlabs.x_sign',
        'double',
        1.0,
        '',
        'sign of x of both aligners, 1 or -1: which it is shows when a dot is moved',
        minimum=-1.0,
        maximum=1.0,
    ),
    Parameter(
        'replay.stamps',
        'string',
        'now',
        '',
        'times of replayed samples: of now in the recorded rhythm, or as recorded',
        choices=('now', 'recorded'),
    ),
    # Recording.
    Parameter('record', 'bool', False, '', 'record from the start'),
    Parameter('bag_dir', 'string', 'recordings', '', 'folder in which recordings are made'),
    Parameter(
        'bag_max_bytes',
        'integer',
        0,
        'bytes',
        'a file of a recording that is as large is ended and the next begun; 0: never',
        minimum=0,
        maximum=1_000_000_000_000,
    ),
    Parameter(
        'bag_max_duration',
        'double',
        0.0,
        's',
        'a file of a recording that is as long is ended and the next begun; 0: never',
        minimum=0.0,
        maximum=1e7,
    ),
    Parameter(
        'disk_reserve',
        'integer',
        500_000_000,
        'bytes',
        'recording stops before the disk has less room than this',
        minimum=1_000_000,
        maximum=1_000_000_000_000,
    ),
    Parameter(
        'disk_full',
        'string',
        'stop',
        '',
        "when the reserve is reached: stop, or delete the oldest file of this recording (never another's)",
        choices=('stop', 'delete_oldest'),
    ),
    # What is shown.
    Parameter('markers', 'bool', False, '', 'publish link, plate, beams and dots for RViz (/link_tip/markers)'),
    Parameter('markers_magnify', 'double', 10.0, '', 'how much larger they show displacements', above=0.0, maximum=1e4),
    Parameter('monitor', 'bool', False, '', 'serve the live page'),
    Parameter('monitor_address', 'string', '127.0.0.1', '', 'address it is served on; 0.0.0.0 shows it to the network'),
    Parameter(
        'monitor_port', 'integer', 8790, '', 'port it is served on; 0 takes any free one', minimum=0, maximum=65535
    ),
    Parameter('monitor_control', 'bool', False, '', 'let the page take the zero and record'),
)

BY_NAME: Mapping[str, Parameter] = MappingProxyType({p.name: p for p in PARAMETERS})


def check_value(parameter: Parameter, value: object, source: str) -> Value:
    """Return ``value`` as the parameter's type, or refuse it.

    Raises ConfigError naming ``source``, key, value and bound.
    """

    def refuse(why: str) -> ConfigError:
        unit = f' {parameter.unit}' if parameter.unit else ''
        return ConfigError(f'{source}: {parameter.name} = {value!r}{unit}: {why}')

    def number(v: object) -> float:
        if isinstance(v, str):
            # YAML 1.1 reads 69e9 as a string; ROS reads it as a number, and so do we.
            try:
                v = float(v)
            except ValueError:
                raise refuse('must be a number') from None
        if isinstance(v, bool) or not isinstance(v, (int, float)):
            raise refuse('must be a number')
        out = float(v)
        if not math.isfinite(out):
            raise refuse('must be finite')
        bounds = parameter.bound_text()
        if parameter.above is not None and out <= parameter.above:
            raise refuse(f'must be {bounds}')
        if parameter.minimum is not None and out < parameter.minimum:
            raise refuse(f'must be {bounds}')
        if parameter.maximum is not None and out > parameter.maximum:
            raise refuse(f'must be {bounds}')
        return out

    kind = parameter.kind
    if kind == 'double':
        return number(value)
    if kind == 'integer':
        if isinstance(value, bool) or not isinstance(value, int):
            raise refuse('must be a whole number')
        return int(number(value))
    if kind == 'bool':
        if not isinstance(value, bool):
            raise refuse('must be true or false')
        return value
    if kind == 'string':
        if not isinstance(value, str):
            raise refuse('must be text')
        if parameter.choices is not None and value not in parameter.choices:
            raise refuse(f'must be one of {", ".join(parameter.choices)}')
        return value
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
        raise refuse('must be a list')
    items = list(value)
    if parameter.length is not None and len(items) != parameter.length:
        raise refuse(f'must have {parameter.length} elements, has {len(items)}')
    if kind == 'double_array':
        return [number(v) for v in items]
    if not items or not all(isinstance(v, str) for v in items):
        raise refuse('must be a list of names')
    return [str(v) for v in items]
