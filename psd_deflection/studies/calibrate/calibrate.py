# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What recordings say of a rig. A parameter or direction whose standard deviation stays above ``OPEN`` of its tolerance
is undetermined: it keeps the file's value and tolerance. A prior that the recordings contradict is widened."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.model.misalignment.model import COUNT, INDEX, ZERO
from psd_deflection.model.misalignment.rig import RigVector, vector_of_rig
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.calibrate.dark import DarkLevel, check_effects
from psd_deflection.studies.calibrate.fit import (
    CLAMP_AT,
    CLOCK,
    NAMES,
    SIZE,
    CalibrationFit,
    Kind,
    Mask,
    Prior,
    compliances,
    fit,
    linearised,
    posterior,
    prior_of_rig,
    refitted,
    residual_at,
    weight_matrices,
    with_common_zero,
)
from psd_deflection.studies.calibrate.observation import (
    LEAST_HOLD,
    CalibrationRun,
    Rows,
    joined,
    noise_of,
    rest_means,
    rows_of,
    smoothed,
    usable_dots,
)

OPEN = 0.9
"""A standard deviation above this share of the tolerance: undetermined."""
SPOILT = 1.1
"""Largest factor by which holding one parameter may raise the standard deviation of another."""
CONTRADICTED = 3.5
"""A determined parameter that is further off than this, in standard deviations of the prior, had too small a
tolerance.
"""
WIDER = 10.0
WORSE = 1.01
"""A calibration is rejected if its gap on unseen motion exceeds the rig file's by this factor, or if its weighted
misfit there is larger at all.
"""
FOLDS = 8
"""Pieces of a recording; the even ones are predicted by a fit of the odd ones, and the other way round."""
OFTEN = 300
"""Number of the fastest rows, from which the clock's offset is found roughly."""
CLOCK_RANGE, CLOCK_STEP = 0.060, 0.004
"""The offset of the reference's clock is searched within ± the first, in steps of the second, s."""


class Direction(NamedTuple):
    """``parts``: parameter to its share, unit length in units of the tolerances. ``needs``: what would determine it."""

    parts: dict[str, float]
    needs: str


class Gap(NamedTuple):
    """rms of reading minus model, m (``self``: along the redundant direction).

    ``before``, ``heldout_before``: by the rig file. ``after``: by the fit. ``heldout_after``: each half of the rows by
    the fit of the other half.
    """

    before: float
    after: float
    heldout_before: float
    heldout_after: float


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """The answer. ``values``, ``sd`` by name of ``NAMES``; ``covariance`` (SIZE, SIZE).

    ``vector``: what the rig file says. ``prior``: the same, with the tolerances that the recordings contradict widened.
    ``noise`` (4,): of a sample of each reading, V rms. ``clock``: the rough offset of the reference's clock, s, which
    the rows have already; the full one is ``clock + values[CLOCK]``. ``rejected``: why the rig file was left as it is,
    or ''. ``widened``: parameters whose tolerance the recordings contradict. ``dropped``: terms that unseen motion
    rejected. ``rows``, ``fit``: for pictures. ``dark``: what was measured with the lasers off; ``rig`` has it already.
    """

    rig: Rig
    kind: Kind
    vector: RigVector
    prior: Prior
    fit: CalibrationFit
    rows: Rows
    runs: Sequence[CalibrationRun]
    noise: FloatArray
    gap: Gap
    undetermined: list[Direction]
    clock: float
    rejected: str = ''
    widened: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)
    dark: Sequence[DarkLevel] = ()

    @property
    def values(self) -> FloatArray:
        """Values (SIZE,)."""
        return self.fit.values

    @property
    def covariance(self) -> FloatArray:
        """Covariance (SIZE, SIZE)."""
        return self.fit.covariance

    @property
    def sd(self) -> FloatArray:
        """Standard deviations (SIZE,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def used(self) -> FloatArray:
        """Parameters (SIZE,) as the pipeline took them before the calibration."""
        return before_of(self.vector, self.prior)

    @property
    def reference_range(self) -> FloatArray | None:
        """Least and largest pose (2, 3), m, m, rad, of the reference where it counted; None without a reference."""
        poses = self.rows.pose[self.fit.weights > 0.0]
        return np.stack([poses.min(axis=0), poses.max(axis=0)]) if self.kind == 'reference' and len(poses) else None


def calibrate(
    runs: Sequence[CalibrationRun],
    rig: Rig,
    *,
    alone: bool = False,
    progress: Callable[[str], None] = lambda words: None,
) -> Calibration:
    """Calibrate ``rig`` by ``runs``; ``alone``: by the one redundant reading, without reference and loads.

    Raises RecordingError if a run has neither reference nor loads or too few of them, ConfigError for a rig that
    cannot be calibrated.
    """
    if rig.psds_at_base:
        raise ConfigError('PSDs at the base (arrangement) are not calibrated')
    check_effects(rig)
    progress('noise')
    noise = np.median([noise_of(run, rig) for run in runs], axis=0)
    kind = kind_of(runs, alone)
    vector = vector_of_rig(rig)
    prior = prior_of_rig(rig, vector)
    progress('rows')
    clock = coarse_delay(runs, rig, noise) if kind == 'reference' else 0.0
    parts = [rows_of(run, rig, noise, delay=clock, blocks=kind != 'reference') for run in runs]
    rows = joined(parts)
    if kind == 'loads':
        if not rows.rest.any():
            raise RecordingError(
                f'{runs[0].name}: no load is held for {LEAST_HOLD} s; hold each for some seconds, '
                f'or give a recording with a reference'
            )
        rows = rest_means(rows, rig, noise)
    progress('fitting')
    free = fitted_parameters(kind)
    rows, first = with_common_zero(rows, rig, prior, kind, free)
    first, prior, widened = believed_fit(first, rows, rig, prior, kind, free)
    free = _determined(first, prior, free)
    full_fit = fit(rows, rig, prior, kind, free=free, start=first)
    progress('held-out motion')
    full_fit, believed, dropped = _without_rejected_terms(full_fit, rows, rig, prior, kind)
    before = before_of(vector, prior)
    gap, worse = _heldout(full_fit, rows, rig, believed, kind, before)
    if kind == 'reference':
        full_fit = with_clamp(full_fit, rows, rig, prior)
    rejected = ''
    if worse:
        rejected = (
            f'on motion that was not fitted the calibrated rig predicts the readings worse than the rig file '
            f'({gap.heldout_after * 1e6:.2f} µm rms against {gap.heldout_before * 1e6:.2f} µm); '
            f'the rig file keeps its values'
        )
    return Calibration(
        rig,
        kind,
        vector,
        prior,
        full_fit,
        rows,
        runs,
        noise,
        gap,
        undetermined(full_fit, prior),
        clock,
        rejected,
        widened,
        dropped,
    )


def kind_of(runs: Sequence[CalibrationRun], alone: bool) -> Kind:
    """What the recordings are fitted to. Raises RecordingError if some have nothing."""
    if alone:
        return 'self'
    if all(len(run.reference_t) for run in runs):
        return 'reference'
    for run in runs:
        if run.loads is None:
            raise RecordingError(
                f'{run.name}: has neither a reference (CSV columns ref_dx, ref_dy, ref_theta; topic '
                f'/reference/deflection) nor known loads; --self takes a recording without either'
            )
    return 'loads'


def fitted_parameters(kind: Kind) -> Mask:
    """Which parameters the rows depend on."""
    free = np.ones(SIZE, dtype=bool)
    free[CLOCK] = kind == 'reference'
    free[CLAMP_AT : CLAMP_AT + 2] = kind == 'loads'
    return free


def before_of(vector: RigVector, prior: Prior) -> FloatArray:
    """Parameters (SIZE,) as the pipeline takes them before a calibration."""
    out = prior.mean.copy()
    out[:COUNT] = vector.as_used
    return out


def coarse_delay(runs: Sequence[CalibrationRun], rig: Rig, noise: FloatArray) -> float:
    """Seconds to add to the reference's times so that it fits the dots best, in steps; 0 if nothing moves."""
    costs = np.zeros(2 * round(CLOCK_RANGE / CLOCK_STEP) + 1)
    lates = (np.arange(len(costs)) - len(costs) // 2) * CLOCK_STEP
    for run in runs:
        rows = rows_of(run, rig, noise)
        quick = np.argsort(-np.abs(rows.velocity @ [1.0, 1.0, 0.1]))[:OFTEN]
        moving = rows.at(np.sort(quick))
        dots = usable_dots(run, rig)
        period = float(np.median(np.diff(run.t)))
        linear = linearised(moving, prior_of_rig(rig).mean, rig, 'reference')
        # The median is subtracted: it holds what does not depend on the clock, as nothing has been fitted yet.
        for i, delay in enumerate(lates):
            places = np.interp(moving.t + delay, run.t, np.arange(len(run.t)))
            s = smoothed(dots, period, places)
            off = linear.residual + s.dots - moving.dots
            off = off[s.good]
            if len(off):
                costs[i] += float(np.abs(off - np.median(off, axis=0)).mean())
    best = int(np.argmin(costs))
    middle = len(costs) // 2
    # Only a clear minimum counts: without motion the costs differ by noise alone.
    return float(lates[best]) if costs[best] < 0.9 * costs[middle] else 0.0


def believed_fit(
    first: CalibrationFit, rows: Rows, rig: Rig, prior: Prior, kind: Kind, free: Mask
) -> tuple[CalibrationFit, Prior, list[str]]:
    """Widen the prior of parameters that the rows contradict, the worst first, each once; the last are their names."""
    widened: list[int] = []
    while len(widened) < 6:
        sd = np.sqrt(np.diag(first.covariance))
        off = np.where(free & (sd < 0.7 * prior.sd), np.abs(first.values - prior.mean) / prior.sd, 0.0)
        off[widened] = 0.0
        worst = int(np.argmax(off))
        if off[worst] < CONTRADICTED:
            break
        widened.append(worst)
        covariance = prior.covariance.copy()
        covariance[worst] *= WIDER
        covariance[:, worst] *= WIDER
        prior = Prior(prior.mean, covariance)
        first = fit(rows, rig, prior, kind, free=free, start=first)
    return first, prior, [NAMES[i] for i in widened]


def _determined(first: CalibrationFit, prior: Prior, free: Mask) -> Mask:
    """Which parameters are fitted; the others are held at the file's values, the least known first.

    One is held only if no other standard deviation grows by more than ``SPOILT``: of parameters that the rows determine
    only together, such as a rotation and a crosstalk, none can be held without spoiling the others.
    """
    every = np.sqrt(np.diag(posterior(first.information, prior, free)))
    ratio = np.where(free, every / prior.sd, 0.0)
    held = free.copy()
    for i in np.argsort(-ratio):
        if ratio[i] <= OPEN:
            break
        held[i] = False
        if np.any((np.sqrt(np.diag(posterior(first.information, prior, held))) > SPOILT * every)[held]):
            held[i] = True
    return held


def _pieces(rows: Rows) -> IntArray:
    """Which of two halves each row belongs to: every second of ``FOLDS`` pieces of its recording."""
    out = np.zeros(len(rows), dtype=np.int64)
    for run in np.unique(rows.run):
        rows_of_run = np.flatnonzero(rows.run == run)
        out[rows_of_run] = (np.arange(len(rows_of_run)) * FOLDS // len(rows_of_run)) % 2
    return out


def _misfit(
    residual: FloatArray, full_fit: CalibrationFit, inverse: FloatArray, rows: Rows, kind: Kind
) -> tuple[FloatArray, FloatArray]:
    """Weighted and plain squares (n,) of ``residual`` (n, 4)."""
    weighted = np.einsum('ni,nij,nj->n', residual, inverse, residual) * full_fit.weights
    if kind == 'self':
        across = np.linalg.svd(full_fit.linear.pose_slopes)[0][:, :, 3]
        return weighted, np.einsum('ni,ni->n', across, residual) ** 2 * full_fit.weights
    return weighted, np.mean(residual**2, axis=1) * full_fit.weights


def _held_out(full_fit: CalibrationFit, rows: Rows, prior: Prior, free: Mask) -> FloatArray:
    """Residuals (n, 4) of each half of the rows by the parameters that the other half gives."""
    half = _pieces(rows)
    out = np.empty_like(full_fit.linear.residual)
    for number in (0, 1):
        z = refitted(full_fit, rows, prior, (half != number).astype(np.float64), free)
        out[half == number] = residual_at(full_fit, z)[half == number]
    return out


def _heldout(
    full_fit: CalibrationFit, rows: Rows, rig: Rig, prior: Prior, kind: Kind, before: FloatArray
) -> tuple[Gap, bool]:
    """Return the gaps, and whether unseen motion is predicted worse than with the rig file."""
    inverse = weight_matrices(full_fit.linear, rows, full_fit.noise)
    old, old_plain = _misfit(linearised(rows, before, rig, kind).residual, full_fit, inverse, rows, kind)
    _, new_plain = _misfit(full_fit.linear.residual, full_fit, inverse, rows, kind)
    new, held_plain = _misfit(_held_out(full_fit, rows, prior, full_fit.free), full_fit, inverse, rows, kind)

    def rms(plain: FloatArray) -> float:
        return float(np.sqrt(plain.sum() / max(full_fit.weights.sum(), 1.0)))

    gap = Gap(rms(old_plain), rms(new_plain), rms(old_plain), rms(held_plain))
    return gap, bool(new.sum() > old.sum() or gap.heldout_after > WORSE * gap.heldout_before)


def _without_rejected_terms(
    full_fit: CalibrationFit, rows: Rows, rig: Rig, prior: Prior, kind: Kind
) -> tuple[CalibrationFit, Prior, list[str]]:
    """Hold a non-linearity at the file's value if fitting it predicts unseen motion worse; narrow its prior all the
    same.
    """
    dropped: list[str] = []
    for name in ('psd_1.nonlinearity', 'psd_2.nonlinearity'):
        i = INDEX[name]
        if not full_fit.free[i]:
            continue
        without = full_fit.free.copy()
        without[i] = False
        inverse = weight_matrices(full_fit.linear, rows, full_fit.noise)
        costs = [
            _misfit(_held_out(full_fit, rows, prior, f), full_fit, inverse, rows, kind)[0]
            for f in (full_fit.free, without)
        ]
        more = costs[0] - costs[1]
        if more.sum() > 2.0 * float(np.sqrt(np.sum(more**2))):
            dropped.append(name)
            # Its new variance is the fitted variance plus the squared distance from the file's value.
            away = full_fit.covariance[i, i] + (full_fit.values[i] - prior.mean[i]) ** 2
            covariance = prior.covariance.copy()
            shrunk = min(1.0, float(away / covariance[i, i]) ** 0.5)
            covariance[i] *= shrunk
            covariance[:, i] *= shrunk
            prior = Prior(prior.mean, covariance)
            full_fit = fit(rows, rig, prior, kind, free=without, start=full_fit)
    return full_fit, prior, dropped


def with_clamp(full_fit: CalibrationFit, rows: Rows, rig: Rig, prior: Prior) -> CalibrationFit:
    """Return the fit with the clamp's compliances added, from the reference's poses at rest under known loads, if any.

    The link's stiffness is that of the rig file: at one length a soft clamp cannot be distinguished from a soft link.
    """
    rest = rows.rest & (full_fit.weights > 0.0)
    values, covariance, free = full_fit.values.copy(), full_fit.covariance.copy(), full_fit.free.copy()
    length = rig.link.length
    compliance = compliances(rig, np.zeros(SIZE))
    sds = full_fit.noise.reference
    for i, (axes, lever) in enumerate((((0, 1), length**2), ((2,), 1.0))):
        information = right = 0.0
        for axis in axes:
            load = rows.loads[rest, axis]
            if len(load) < 4 or not np.ptp(load) > 0.0:
                continue
            y = rows.pose[rest, axis] - load * compliance[axis]
            x = lever * (load - load.mean())
            scatter = max(float(np.std(y - np.polyval(np.polyfit(load, y, 1), load))), float(sds[axis]))
            information += float(x @ x) / (scatter**2 * full_fit.noise.fewer)
            right += float(x @ (y - y.mean())) / (scatter**2 * full_fit.noise.fewer)
        at = CLAMP_AT + i
        before = prior.covariance[at, at]
        after = 1.0 / (information + 1.0 / before)
        covariance[at] = covariance[:, at] = 0.0
        if after**0.5 > OPEN * before**0.5:
            values[at], covariance[at, at], free[at] = prior.mean[at], before, False
        else:
            values[at], covariance[at, at], free[at] = after * (right + prior.mean[at] / before), after, True
    return CalibrationFit(
        values, covariance, full_fit.information, full_fit.linear, full_fit.weights, full_fit.noise, free
    )


_NEEDS = {
    'rotation': 'forces along X and along Y, so that both dots move by millimetres',
    'gain': 'a motion of the dot along that axis, by forces along X and Y and a torque',
    'crosstalk': 'motions of the dot along both axes, one at a time',
    'center': 'a twist of 1° or more, in both directions',
    'height': 'forces of 50 N along X and Y: the height shows by the tilt of the plate',
    'nonlinearity': 'dots 3 mm or more from the centre',
    'angle': 'forces well above 50 N and a reference of a micrometre: the lean shows by the tilt of the plate',
    'slope_ratio': 'forces of 50 N along X and Y and a reference of some micrometres',
    'bending_compliance': 'known forces held for some seconds each',
    'torsional_compliance': 'known torques held for some seconds each',
    'zero': 'the unloaded link, with its reference',
}
MOTIONS = tuple(dict.fromkeys(_NEEDS.values()))
"""What determines parameters, the easiest first."""
ROTATED = (
    'nothing to do: a turned PSD and one whose axes are not at right angles read alike; what both add up to is known, '
    'and the estimates need no more'
)


def needs_of(names: Sequence[str]) -> str:
    """What would determine parameters that move together."""
    kinds = [name.partition('.')[2] for name in names]
    short = [next(k for k in _NEEDS if kind.startswith(k)) for kind in kinds]
    if set(short) == {'rotation', 'crosstalk'}:
        return ROTATED
    return '; '.join(dict.fromkeys(_NEEDS[k] for k in short))


def undetermined(full_fit: CalibrationFit, prior: Prior) -> list[Direction]:
    """Directions whose spread stays above ``OPEN`` of the tolerances: single parameters, then combinations."""
    # The zero is reported apart, and the clock is no parameter of the rig.
    reported = np.array([not ZERO <= i < COUNT and i != CLOCK for i in range(SIZE)])
    open_still = np.sqrt(np.diag(full_fit.covariance)) > OPEN * prior.sd
    held = np.flatnonzero(~full_fit.free & reported & open_still)
    out = [Direction({NAMES[i]: 1.0}, needs_of([NAMES[i]])) for i in held]
    # The clamp's were determined one by one.
    alone = np.isin(np.arange(SIZE), (CLAMP_AT, CLAMP_AT + 1)) & (np.diag(full_fit.information) == 0.0)
    at = np.flatnonzero(full_fit.free & reported & ~alone)
    if not len(at):
        return out
    block = np.ix_(at, at)
    sd = prior.sd[at]
    # In units of the prior's standard deviations; its correlations (of an earlier calibration) are in the posterior.
    size, vectors = np.linalg.eigh(posterior(full_fit.information, prior, full_fit.free)[block] / np.outer(sd, sd))
    open_ones = vectors[:, size > OPEN**2]
    for parts in _sparse(open_ones):
        named = {NAMES[at[i]]: float(round(parts[i], 4)) for i in np.argsort(-np.abs(parts)) if abs(parts[i]) > 0.15}
        out.append(Direction(named, needs_of(list(named))))
    return out


def _sparse(vectors: FloatArray) -> list[FloatArray]:
    """Directions (each of unit length) that span the columns of ``vectors`` (n, k), with few large parts each."""
    rest = vectors.copy()
    k = rest.shape[1]
    pivots: list[int] = []
    for column in range(k):
        sizes = np.abs(rest[:, column:]).max(axis=1)
        sizes[pivots] = 0.0
        row = int(np.argmax(sizes))
        swap = column + int(np.argmax(np.abs(rest[row, column:])))
        rest[:, [column, swap]] = rest[:, [swap, column]]
        rest[:, column] /= rest[row, column]
        for other in range(k):
            if other != column:
                rest[:, other] -= rest[row, other] * rest[:, column]
        pivots.append(row)
    return [column / np.linalg.norm(column) for column in rest.T]
