# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The records that the pipeline passes on, frozen, SI, times in integer nanoseconds: :class:`RawChunk` (counts),
:class:`SampleBlock`, :class:`SpotMeans`, :class:`DeflectionEstimate` of each solver, :class:`TipLoad`."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Counts = npt.NDArray[np.int16] | npt.NDArray[np.int32]

MOST_PSDS = 6
"""A rig has two to this many PSDs."""


@functools.cache
def channel_names(psds: int) -> tuple[str, ...]:
    """The order of the channels everywhere (on the wire, in recordings, in arrays): x1 y1 sum1 x2 y2 sum2 ..."""
    return tuple(f'{quantity}{n}' for n in range(1, psds + 1) for quantity in ('x', 'y', 'sum'))


@functools.cache
def dot_names(psds: int) -> tuple[str, ...]:
    """The channels that are coordinates of the dots: x1 y1 x2 y2 ..."""
    return tuple(f'{axis}{n}' for n in range(1, psds + 1) for axis in 'xy')


@functools.cache
def dot_channels(psds: int) -> tuple[int, ...]:
    """Places of :func:`dot_names` among :func:`channel_names`."""
    return tuple(3 * n + axis for n in range(psds) for axis in (0, 1))


CHANNELS = channel_names(2)
"""The channels of two PSDs."""

DOT_CHANNELS = dot_channels(2)
"""Which of ``CHANNELS`` are coordinates of the dots: x1, y1, x2, y2."""

FLAG_OVER_RANGE = 1
"""SAMPLE flags, bit 0: the device saw a channel over range."""

FLAG_DEVICE_DROPPED = 2
"""SAMPLE flags, bit 1: the device dropped samples before this one."""


class BlockStatus(IntEnum):
    """Whether a block has an estimate and, if not, why."""

    OK = 0
    TOO_FEW_SAMPLES = 1
    LASER_LOST = 2
    SATURATED = 3
    OUTSIDE_ACTIVE_AREA = 4
    NOT_SOLVED = 5
    FROZEN = 6
    INCONSISTENT = 7


@dataclass(frozen=True, slots=True, eq=False)
class RawChunk:
    """Samples as they arrived, in order; not necessarily a whole block.

    ``seq`` int64 (n,): the sample number, extended beyond the 32 bits of the protocol. ``t_ns``
    int64 (n,): when each sample was taken, ROS time, ns. ``readings`` (n, 3P) of P PSDs: int16 or int32 converter
    counts, or float32 volts, in the order of :func:`channel_names`. ``flags`` uint8 (n,): as in the
    protocol. ``volts_per_count``: V per count; None if ``readings`` are already volts.
    """

    seq: IntArray
    t_ns: IntArray
    readings: Counts | npt.NDArray[np.float32]
    flags: npt.NDArray[np.uint8]
    volts_per_count: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SampleBlock:
    """The samples of one block that arrived; lost samples are left out, never filled in.

    ``index``: seq // block_size. ``seq`` int64 (n,), ``t_ns`` int64 (n,) ROS time in ns,
    ``volts`` float32 (n, 3P), ``flags`` uint8 (n,), n >= 1.
    """

    index: int
    seq: IntArray
    t_ns: IntArray
    volts: npt.NDArray[np.float32]
    flags: npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class SpotMeans:
    """The dots averaged over one block.

    ``t_ns``: middle of the block. ``dots``: (x1, y1, x2, y2, ...), m, from each PSD's centre.
    ``sums``: (sum1, sum2, ...), V. ``covariance`` (2P, 2P): sample covariance of the dots, m^2 (zeros if
    fewer than two samples are present). ``present`` + ``lost`` = block size. ``reason`` is empty
    when ``status`` is OK. ``findings``: warnings that do not prevent an estimate. ``excluded``: PSDs (from 1) that
    the estimate was made without, if the others were enough for it. ``published``: whether the dots are; of most blocks
    they are not, if the parameter ``decimation`` says so.
    """

    t_ns: int
    index: int
    dots: tuple[float, ...]
    sums: tuple[float, ...]
    covariance: FloatArray
    present: int
    lost: int
    status: BlockStatus
    reason: str
    findings: tuple[str, ...] = ()
    excluded: tuple[int, ...] = ()
    published: bool = True


class DeflectionEstimate(NamedTuple):
    """One solver's answer for one block (a NamedTuple: it is made 50 to 150 times a second).

    ``dx``, ``dy`` m; ``theta``, ``phi``, ``omega`` rad, right-hand positive about Z, X, Y.
    ``covariance``: 3 x 3 of (dx, dy, theta), row by row, m^2, m rad, rad^2.
    ``residual_rms``: rms of the dot residuals, m. ``primary``: True for the estimate that is
    published as ``/link_tip/deflection``. ``chi_square``: of the redundant readings, one degree of
    freedom each (one with two PSDs); NaN if they were not checked. ``on_own_topic``: whether it is
    published on its solver's topic; the primary one of most blocks is not, if the parameter
    ``decimation`` says so.
    """

    t_ns: int
    block: int
    solver: str
    dx: float
    dy: float
    theta: float
    phi: float
    omega: float
    covariance: tuple[float, ...]
    residual_rms: float
    primary: bool
    chi_square: float = math.nan
    on_own_topic: bool = True

    @property
    def pose(self) -> tuple[float, float, float]:
        """(dx, dy, theta)."""
        return self.dx, self.dy, self.theta

    @property
    def variances(self) -> tuple[float, float, float]:
        """The diagonal of ``covariance``: of dx m^2, dy m^2, theta rad^2."""
        return self.covariance[0], self.covariance[4], self.covariance[8]


class TipLoad(NamedTuple):
    """The load at the tip that the link model needs for an estimate, in ``link_tip_rest``: N, N, N m."""

    t_ns: int
    fx: float
    fy: float
    tz: float


class TipMotion(NamedTuple):
    """The tip's pose and velocity by the filter, at the end of a block or a stated time later.

    ``dx``, ``dy`` m; ``theta``, ``phi``, ``omega`` rad (the filter has no tilts: 0); ``vx``, ``vy`` m/s, ``vtheta``
    rad/s. ``covariance``, ``velocity_covariance``: 3 x 3 of (x, y, theta), row by row. ``coasted``: time since the
    last sample that was used, s.
    """

    t_ns: int
    block: int
    dx: float
    dy: float
    theta: float
    phi: float
    omega: float
    covariance: tuple[float, ...]
    vx: float
    vy: float
    vtheta: float
    velocity_covariance: tuple[float, ...]
    coasted: float = 0.0


class EndEffectorDeflection(NamedTuple):
    """Where the end effector of a chain of links is, in the frame of its rigid pose.

    ``position`` m; ``quaternion`` (x, y, z, w); ``covariance``: 6 x 6 row by row, of position and of rotation about
    the fixed axes, m^2, m rad, rad^2.
    """

    t_ns: int
    position: tuple[float, ...]
    quaternion: tuple[float, ...]
    covariance: tuple[float, ...]


class AppliedLoad(NamedTuple):
    """A known load at the tip centroid in ``link_tip_rest``, held until the next one: N, N, N m."""

    t_ns: int
    fx: float
    fy: float
    tz: float


class Mark(NamedTuple):
    """A moment that somebody marked ("bumped it here"); ``t_ns`` is when the mark arrived."""

    t_ns: int
    text: str


class Moment(NamedTuple):
    """A mark on the axis of an answer: ``t`` s from where the axis is 0, for recordings after one another too."""

    t: float
    text: str


class BaseAcceleration(NamedTuple):
    """A known acceleration of the link's base in ``link_base``, without gravity, held until the next one.

    ``linear`` (3,): of the base's origin, m/s^2. ``angular`` (3,): rad/s^2.
    """

    t_ns: int
    linear: tuple[float, ...]
    angular: tuple[float, ...]


class ReferencePose(NamedTuple):
    """An independent measurement of the tip: m, m, rad."""

    t_ns: int
    dx: float
    dy: float
    theta: float


class ReferenceWithCovariance(NamedTuple):
    """The same with its uncertainty: m, m, rad; tilts in rad; ``covariance`` as of :class:`DeflectionEstimate`."""

    t_ns: int
    dx: float
    dy: float
    theta: float
    phi: float
    omega: float
    covariance: tuple[float, ...]


class TemperatureReading(NamedTuple):
    """Ambient temperature, degrees Celsius (as sensor_msgs/Temperature has it)."""

    t_ns: int
    celsius: float


ENVIRONMENT = ('environment.start_ns', 'environment.first_temperature', 'environment.temperature')
"""Recorded changes other than parameters: time of the first sample (ns), degrees Celsius then and
now.
"""


RESTART = 'device.restart'
CLOCK_STEP = 'clock.step'
"""A step of the time map, s: samples before it were stamped so much too late (negative) or too early."""
CLOCK_SQUEEZED = 'clock.squeezed'
"""Samples after a step back, whose stamps are 1 ns apart, so that time does not go back."""
"""Recorded with the block in which a restarted device went on: the last sample number before, the first after.
The numbers between belong to no sample.
"""


KNOWN_LOAD = 'input.load'
"""Recorded with the block from which on the filter knows of a load: seconds and nanoseconds of its stamp, N, N, N m."""


class ParameterChange(NamedTuple):
    """A value that affects the estimates and was changed during the run.

    These are parameters (set by ``~/zero`` or live), the names in :data:`ENVIRONMENT`, :data:`RESTART` and
    :data:`KNOWN_LOAD`.
    ``values``: names and checked values; they apply from block ``block`` on. The change is
    recorded, and replay applies it at the same block.
    """

    t_ns: int
    block: int
    values: tuple[tuple[str, float | str | tuple[float, ...]], ...]


class RigState(NamedTuple):
    """What a reader needs to evaluate the samples: sent at the start and after each change.

    ``parameters``: all of them, flat, as they are from block ``block`` on. ``hello``: the device's, or None.
    ``changed``: the values of the :class:`ParameterChange` that it was sent for, {} if there was none.
    ``version``: of the software. ``t_ns``: time of the change, 0 at the start. ``made_with``: what computes
    (:mod:`psd_deflection.recordings.provenance`). ``memory``: what the pipeline remembers before block ``block``
    (:meth:`psd_deflection.measure.pipeline.Pipeline.snapshot`), {} if that is nothing; None if it is not told.
    """

    t_ns: int
    block: int
    parameters: Mapping[str, object]
    hello: Mapping[str, object] | None
    changed: Mapping[str, object]
    version: str
    made_with: Mapping[str, str] = MappingProxyType({})
    memory: Mapping[str, object] | None = None


class DiagnosticEntry(NamedTuple):
    """One diagnostic status: ``level`` 0 OK, 1 WARN, 2 ERROR, 3 STALE, as diagnostic_msgs has
    them.
    """

    name: str
    level: int
    message: str
    values: tuple[tuple[str, str], ...]


class DiagnosticReport(NamedTuple):
    """What is published on ``/diagnostics``, once a second. ``hardware_id``: the device's serial number."""

    t_ns: int
    entries: tuple[DiagnosticEntry, ...]
    hardware_id: str = ''


Record = (
    SampleBlock
    | SpotMeans
    | DeflectionEstimate
    | TipLoad
    | TipMotion
    | AppliedLoad
    | Mark
    | BaseAcceleration
    | ReferencePose
    | ReferenceWithCovariance
    | TemperatureReading
    | DiagnosticReport
    | ParameterChange
    | RigState
)
