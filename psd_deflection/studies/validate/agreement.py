"""What two instruments that measured the same motion differ by.

Bland and Altman (Lancet 327, 307, 1986): differences over means, the bias and the limits within which 95 % of the
differences lie. Beside it the differences are split into bias, scale and noise: the reference is regressed on the
estimate, because the estimate is the less noisy of the two, and a noisy cause would shrink the slope.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.records import FloatArray
from psd_deflection.studies.validate.clock import FEWEST, Offset, clock_offset, variance_of_sum
from psd_deflection.studies.validate.motion import Motion, Solve

AXES = ('dx', 'dy', 'theta')
UNITS = ('m', 'm', 'rad')


@dataclass(frozen=True)
class Agreement:
    """Estimate minus reference on one axis, in m or rad.

    ``bias``: mean difference. ``limits``: bias ± 1.96 standard deviations of the differences. ``scale``: by how much
    the estimate is larger, as a share. ``noise``: standard deviation of what bias and scale leave. ``rms``,
    ``largest``: of the differences. ``share``: ``rms`` as a share of the largest deflection of the reference. ``*_sd``:
    standard deviations of the figures. ``scale`` and ``share`` are NaN if the link did not move along this axis.
    """

    bias: float
    bias_sd: float
    limits: tuple[float, float]
    scale: float
    scale_sd: float
    noise: float
    rms: float
    largest: float
    share: float


@dataclass(frozen=True)
class Validated:
    """The answer of :func:`validate`.

    ``t`` (k,), s, when the references were taken by the clock of the samples; ``reference`` (k, 3), m, m, rad;
    ``estimates``: of each solver at these times (k, 3), NaN if it has no answer. ``agreements``: of each solver, for
    dX, dY, theta. ``offset``: between the clocks, None if it was not looked for; ``applied``: whether it was removed.
    ``covered``: share of differences within 1.96 standard deviations of estimate and reference together, for each
    axis; NaN if the reference does not state its own. ``left_out``: references without samples about them.
    """

    t: FloatArray
    reference: FloatArray
    estimates: dict[str, FloatArray]
    agreements: dict[str, tuple[Agreement, Agreement, Agreement]]
    offset: Offset
    applied: bool
    covered: tuple[float, float, float]
    left_out: int


def agreement(estimate: FloatArray, reference: FloatArray) -> Agreement:
    """Compare ``estimate`` (k,) with ``reference`` (k,), both finite, of one axis."""
    k = len(estimate)
    difference = estimate - reference
    bias = float(difference.mean())
    spread = difference - bias
    sd = float(np.sqrt((spread * spread).sum() / (k - 1)))
    centred = estimate - estimate.mean()
    power = float(centred @ centred)
    slope, slope_sd, noise = math.nan, math.nan, sd
    if power > 0.0:
        slope = float(centred @ reference) / power
        left = reference - reference.mean() - slope * centred
        noise = float(np.sqrt((left * left).sum() / (k - 2)))
        slope_sd = math.sqrt(max(variance_of_sum(centred * left), noise**2 * power)) / power
        # Without motion the slope is that of noise on noise.
        if not (slope > 0.2 and slope_sd < 0.1):
            slope, slope_sd = math.nan, math.nan
            noise = sd
    rms = float(np.sqrt((difference * difference).mean()))
    deflection = float(np.abs(reference).max())
    return Agreement(
        bias=bias,
        bias_sd=math.sqrt(max(variance_of_sum(spread), sd * sd * k)) / k,
        limits=(bias - 1.96 * sd, bias + 1.96 * sd),
        scale=1.0 / slope - 1.0,
        scale_sd=slope_sd / slope**2,
        noise=noise,
        rms=rms,
        largest=float(np.abs(difference).max()),
        share=rms / deflection if math.isfinite(slope) else math.nan,
    )


def validate(
    motion: Motion,
    solvers: dict[str, Solve],
    t: FloatArray,
    reference: FloatArray,
    sd: FloatArray | None,
    estimate_sd: FloatArray,
    *,
    align: bool,
    largest: float,
    exposure: float,
) -> Validated:
    """Compare the motion, as each of ``solvers`` (the first is the rig's) has it, with a reference.

    ``t`` (k,), s, by the reference's clock, increasing. ``reference`` (k, 3), m, m, rad; ``sd`` (k, 3) of it if it is
    known. ``estimate_sd`` (3,): of the published estimates. ``align``: remove the offset between the clocks if
    it is told. ``largest``: offset that is looked for, s. ``exposure``: of the reference, s.
    Raises RecordingError if fewer than 20 references lie within the motion.
    """
    offset = clock_offset(motion, t, reference, largest=largest, exposure=exposure)
    applied = align and offset.told
    at = t + offset.value if applied else t
    dots, _, _ = motion.dots_at(at, exposure)
    there = np.isfinite(dots).all(axis=1)
    if there.sum() < FEWEST:
        raise RecordingError(
            f'{int(there.sum())} references lie within the recording by their stamps; at least {FEWEST} are needed '
            f'(with the offset between the clocks removed there may be more: --align)'
        )
    kept, dots = reference[there], dots[there]
    estimates = {name: solve(dots) for name, solve in solvers.items()}
    agreements = {}
    for name, poses in estimates.items():
        good = np.isfinite(poses).all(axis=1)
        if good.sum() >= FEWEST:
            first, second, third = (agreement(poses[good, i], kept[good, i]) for i in range(3))
            agreements[name] = (first, second, third)
    covered = (math.nan, math.nan, math.nan)
    primary = next(iter(solvers))
    if sd is not None and primary in agreements:
        error = estimates[primary] - kept
        both = np.sqrt(sd[there] ** 2 + estimate_sd**2)
        x, y, twist = (float(v) for v in np.nanmean(np.abs(error) <= 1.96 * both, axis=0))
        covered = (x, y, twist)
    return Validated(at[there], kept, estimates, agreements, offset, applied, covered, int((~there).sum()))
