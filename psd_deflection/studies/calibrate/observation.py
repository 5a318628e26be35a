# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One recording as arrays, and the rows that are fitted: the dots at the times of the reference, by polynomials of
degree 6 through 21 samples, which follow the modes to 1e-5, or means beside a reference in almost every sample."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.model.detector import VoltsToDots
from psd_deflection.model.misalignment.model import readings
from psd_deflection.model.misalignment.rig import vector_of_rig
from psd_deflection.records import CHANNELS, DOT_CHANNELS, FloatArray, IntArray, Moment
from psd_deflection.rig.config import Rig

SAMPLES_A_SIDE = 10
"""Samples before and after a time that are fitted by a polynomial: 21 ms at 1 kHz, a third of a bending period."""
DEGREE = 6
"""Degree of this polynomial."""
LEAST_PRESENT = 17
SETTLE = 0.5
"""Share of the time that a load is held which is not fitted: the link rings."""
LEAST_HOLD = 0.8
"""s. A load that is held for less says nothing of the link at rest."""
LEAST_ROWS = 20
CALM, CALM_LEAST = 0.25, 1.0 / 250.0
"""s, of a mean over a link at rest; the least variance of one over that of a sample."""

_OFFSETS = np.arange(-SAMPLES_A_SIDE, SAMPLES_A_SIDE + 1) / SAMPLES_A_SIDE
_BASIS = np.vander(_OFFSETS, DEGREE + 1, increasing=True)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationRun:
    """One recording. ``t`` (n,) s of the whole grid; ``volts`` (n, 6) V of the PSDs, NaN if a sample is lost.

    ``reference_t`` (m,) s, ``reference`` (m, 3) m, m, rad; ``loads`` (n, 3) N, N, N m, held, or None. ``digest``: of
    its source. ``reference_sd`` (m, 3): as the reference states them, None if it does not. ``exposure``: time over
    which each reference is a mean, s. ``marks``: from the first sample.
    """

    name: str
    t: FloatArray
    volts: FloatArray
    reference_t: FloatArray
    reference: FloatArray
    loads: FloatArray | None = None
    digest: str = ''
    reference_sd: FloatArray | None = None
    exposure: float = 0.0
    device: str = ''
    temperature: tuple[float, float] | None = None
    marks: tuple[Moment, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """``t`` (n,) s; ``run`` (n,): which recording. ``pose`` (n, 3): the reference, or zeros if there is none.

    ``dots`` (n, 4) m: as the detectors give them; ``variances`` (n, 4) of them by the noise alone. ``velocity``
    (n, 3): of the pose. ``loads`` (n, 3). ``rest`` (n,): whether the link has come to rest under its load.
    ``sd`` (n, 3): of the reference as it states them, in proportion; ones if it does not.
    """

    t: FloatArray
    run: IntArray
    pose: FloatArray
    dots: FloatArray
    variances: FloatArray
    velocity: FloatArray
    loads: FloatArray
    rest: np.ndarray[tuple[int], np.dtype[np.bool_]]
    sd: FloatArray

    def __len__(self) -> int:
        return len(self.t)

    def at(self, which: np.ndarray[tuple[int], np.dtype[np.bool_]] | IntArray) -> Rows:
        """Some of the rows."""
        return Rows(*(getattr(self, column.name)[which] for column in fields(self)))


@dataclass(slots=True)
class Smoothed:
    """Dots at times: ``dots``, ``speed`` (n, 4) m, m/s, ``gain`` (n,): variance of a dot over that of a sample."""

    dots: FloatArray
    speed: FloatArray
    gain: FloatArray
    good: np.ndarray[tuple[int], np.dtype[np.bool_]]
    squares: FloatArray = field(default_factory=lambda: np.empty((0, 4)))


def usable_dots(run: CalibrationRun, rig: Rig) -> FloatArray:
    """Dots (n, 4), m, as the detectors give them; NaN where a sample is lost, dark, saturated or has other light."""
    volts = run.volts.copy()
    full = 0.99 * rig.converter.full_scale
    for psd in range(2):
        with np.errstate(invalid='ignore'):
            v = volts[:, 3 * psd : 3 * psd + 3]
            bad = (np.abs(v[:, :2]) >= full).any(axis=1)
            bad |= (v[:, 2] < rig.estimator.sum_min) | (v[:, 2] > rig.estimator.sum_max)
        volts[bad] = np.nan
    return VoltsToDots.from_rig(rig).dots(volts.astype(np.float32))


def smoothed(dots: FloatArray, period: float, places: FloatArray, exposure: float = 0.0) -> Smoothed:
    """Return the polynomial through the samples about each of ``places`` (m,), in samples from the first.

    ``exposure``, s: the dots are the mean over so long about each place.
    """
    middle = np.clip(np.rint(places).astype(np.int64), 0, len(dots) - 1)
    index = middle[:, None] + np.arange(-SAMPLES_A_SIDE, SAMPLES_A_SIDE + 1)
    inside = (index >= 0) & (index < len(dots))
    window = dots[np.clip(index, 0, len(dots) - 1)]
    present = inside & np.isfinite(window).all(axis=2)
    mask = present.astype(np.float64)
    good = (
        (present.sum(axis=1) >= LEAST_PRESENT)
        & present[:, :SAMPLES_A_SIDE].any(axis=1)
        & present[:, SAMPLES_A_SIDE + 1 :].any(axis=1)
    )
    window = np.where(present[:, :, None], window, 0.0)
    normal = np.einsum('nw,wi,wj->nij', mask, _BASIS, _BASIS)
    normal[~good] = np.eye(DEGREE + 1)
    right = np.einsum('wi,nwc->nic', _BASIS, window)
    inverse = np.linalg.inv(normal)
    coefficients = inverse @ right
    at = (places - middle) / SAMPLES_A_SIDE
    basis = np.vander(at, DEGREE + 1, increasing=True)
    slope = np.zeros_like(basis)
    wide = 0.5 * exposure / (SAMPLES_A_SIDE * period)
    slope[:, 1:] = basis[:, :-1] * np.arange(1, DEGREE + 1)
    if wide > 0.0:
        power = np.arange(1, DEGREE + 2)
        basis = ((at[:, None] + wide) ** power - (at[:, None] - wide) ** power) / (2.0 * wide * power)
    fitted = np.einsum('wi,nic->nwc', _BASIS, coefficients)
    freedom = np.maximum(mask.sum(axis=1) - DEGREE - 1, 1.0)
    squares = (mask[:, :, None] * (window - fitted) ** 2).sum(axis=1) / freedom[:, None]
    return Smoothed(
        np.einsum('ni,nic->nc', basis, coefficients),
        np.einsum('ni,nic->nc', slope, coefficients) / (SAMPLES_A_SIDE * period),
        np.einsum('ni,nij,nj->n', basis, inverse, basis),
        good & (np.abs(places - middle) <= 0.51),
        squares,
    )


def noise_of(run: CalibrationRun, rig: Rig) -> FloatArray:
    """Noise (4,) of a sample of x1, y1, x2, y2, V rms, from what is left of the polynomials."""
    dots = usable_dots(run, rig)
    places = np.arange(SAMPLES_A_SIDE, len(dots) - SAMPLES_A_SIDE, 2 * SAMPLES_A_SIDE + 1, dtype=np.float64)
    s = smoothed(dots, 1.0, places)
    if not s.good.any():
        return rig.noises[:, :2].ravel()
    # The median is not moved by jumps; of chi-square over its 14 degrees of freedom it is 0.9531.
    variances = np.median(s.squares[s.good], axis=0) / 0.9531
    variances = variances / rig.sensitivities.ravel() ** 2 - rig.converter.volts_per_count**2 / 12.0
    return np.asarray(np.sqrt(np.maximum(variances, (0.1 * rig.converter.volts_per_count) ** 2)))


def at_rest(loads: FloatArray | None, t: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which samples belong to the second half of the time that a load is held."""
    out = np.zeros(len(t), dtype=bool)
    if loads is None:
        return out
    cuts = [0, *(np.flatnonzero(np.any(np.diff(loads, axis=0) != 0.0, axis=1)) + 1).tolist(), len(t)]
    for a, b in itertools.pairwise(cuts):
        held = t[b - 1] - t[a]
        if held >= LEAST_HOLD:
            out[a:b] = t[a:b] >= t[a] + SETTLE * held
    return out


def rows_of(run: CalibrationRun, rig: Rig, noise: FloatArray, *, delay: float = 0.0, blocks: bool = False) -> Rows:
    """Return the rows of one recording: one for each reference, or one a block if the reference is as fast as that.

    ``noise`` (4,) V. ``delay``: seconds to add to the reference's times. ``blocks``: one a block, without reference.
    Raises RecordingError if there are too few.
    """
    period = float(np.median(np.diff(run.t)))
    dots = usable_dots(run, rig)
    size = rig.estimator.block_size
    if blocks or not len(run.reference_t):
        times, poses = run.t[size // 2 :: size], None
    else:
        times, poses = run.reference_t + delay, run.reference
    places = np.interp(times, run.t, np.arange(len(run.t)), left=-np.inf, right=np.inf)
    inside = np.isfinite(places)
    places, times = places[inside], times[inside]
    stated = None if poses is None else run.reference_sd
    sd = np.full((len(places), 3), np.nan) if stated is None else stated[inside]
    s = smoothed(dots, period, places, 0.0 if poses is None else run.exposure)
    poses = np.zeros((len(places), 3)) if poses is None else poses[inside]
    loads = np.zeros((len(run.t), 3)) if run.loads is None else run.loads
    middle = np.clip(np.rint(places).astype(np.int64), 0, len(run.t) - 1)
    sample = rig.sensitivities.ravel() ** 2 * (noise**2 + rig.converter.volts_per_count**2 / 12.0)
    speed = s.speed @ _pose_of_dots(rig).T
    rows = Rows(
        times,
        np.zeros(len(times), np.int64),
        poses,
        s.dots,
        s.gain[:, None] * sample,
        speed,
        loads[middle],
        at_rest(run.loads, run.t)[middle],
        sd,
    ).at(s.good)
    if len(rows) > 1 and float(np.median(np.diff(rows.t))) < (size - 0.5) * period:
        rows = _block_means(rows, rig, size * period, sample / size)
    if len(rows) < LEAST_ROWS:
        what = 'blocks' if blocks else 'reference measurements with good samples about them'
        raise RecordingError(f'{run.name}: {len(rows)} {what}; a calibration needs at least {LEAST_ROWS}')
    return rows


def rest_means(rows: Rows, rig: Rig, noise: FloatArray) -> Rows:
    """Means over ``CALM`` of a link at rest under a known load, in which what still rings is small."""
    sample = rig.sensitivities.ravel() ** 2 * noise**2
    return _block_means(rows.at(rows.rest), rig, CALM, sample * CALM_LEAST)


def _pose_of_dots(rig: Rig) -> FloatArray:
    """(3, 4): how the pose goes with the dots of the nominal rig at rest."""
    x, y = (rig.centers + rig.zeros).T
    design = np.zeros((4, 3))
    design[0::2, 0] = design[1::2, 1] = -1.0
    design[0::2, 2], design[1::2, 2] = y, -x
    return np.asarray(np.linalg.pinv(design))


def _block_means(rows: Rows, rig: Rig, seconds: float, variances: FloatArray) -> Rows:
    """Means over blocks of ``seconds``. What the mean of a curved function differs by is taken off the dots."""
    block = np.floor((rows.t - rows.t[0]) / seconds).astype(np.int64)
    # Never over a change of the load.
    block += np.cumsum(np.any(np.diff(rows.loads, axis=0, prepend=rows.loads[:1]) != 0.0, axis=1))
    _, index, counts = np.unique(block, return_inverse=True, return_counts=True)

    def mean(values: FloatArray) -> FloatArray:
        out = np.zeros((len(counts), values.shape[1]))
        np.add.at(out, index, values)
        return out / counts[:, None]

    nominal = vector_of_rig(rig).values
    pose = mean(rows.pose)
    bent = mean(readings(nominal, rows.pose.T, rig.link.length).T) - readings(nominal, pose.T, rig.link.length).T
    first = np.flatnonzero(np.diff(index, prepend=-1))
    return Rows(
        mean(rows.t[:, None])[:, 0],
        rows.run[first],
        pose,
        mean(rows.dots) - bent,
        # Windows overlap: the mean is that of the samples of a block, or of all those of one window.
        np.maximum(mean(rows.variances) / counts[:, None], variances),
        mean(rows.velocity),
        rows.loads[first],
        rows.rest[first],
        np.sqrt(mean(rows.sd**2)),
    )


def joined(parts: Sequence[Rows]) -> Rows:
    """Return all rows, each with the number of its recording."""
    every = {column.name: np.concatenate([getattr(p, column.name) for p in parts]) for column in fields(Rows)}
    every['run'] = np.concatenate([np.full(len(p), i) for i, p in enumerate(parts)])
    sd = every['sd']
    # Only their proportions are believed: the fit finds their size. Recordings that do not state them have no part.
    every['sd'] = np.ones_like(sd) if np.isnan(sd).any() else sd / np.median(sd, axis=0)
    return Rows(**every)


CHANNEL_NAMES = tuple(CHANNELS[i] for i in DOT_CHANNELS)
"""x1, y1, x2, y2."""
