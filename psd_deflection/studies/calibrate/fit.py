# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters and their covariance from rows of readings and poses: Gauss-Newton with the tolerances as a prior.

The reference y of row j is the pose with an error e (errors in variables). With the pose x_j computed from the readings
m_j, which is far more precise than y_j, and the derivatives taken there,

    r_j = m_j - f(x_j; p) - J_y (y_j - v_j tau - x_j) = J_p dp + n_j - J_y e_j,    C_j = J_y S_ref J_y^T + S_dots.

J_p, J_y: derivatives of f by parameters and by pose; n_j: noise of the dots, covariance S_dots; v_j: velocity of the
pose. The pose drops out, and generalised least squares with C_j is the joint answer for parameters and poses.
Derivatives at y_j would be correlated with its errors and bias the gains towards zero (attenuation). J_y is (4, 3):
along the direction that it does not reach, the one redundant reading, the reference's noise does not enter, and the
weight is that of the detectors. Known loads take the place of y, with the link's compliance; without either S_ref is as
good as infinite.

tau is the offset of the reference's clock. S_ref (three variances, multiplied row by row by those that
the reference states, if it does) and a factor on S_dots are variance components, estimated from the residuals in
alternation with p. Rows beyond ``FAR`` are outliers and count for nothing. If the reference's errors are correlated
from row to row, its rows are weighted as the smaller number of independent ones.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.misalignment.model import ALL, COUNT, TOLERANCES, ZERO, by_parameters, by_pose, readings
from psd_deflection.model.misalignment.rig import CLAMP, RigVector, known_of_rig, stated_sd, vector_of_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.calibrate.observation import Rows

Mask = np.ndarray[tuple[int], np.dtype[np.bool_]]
Kind = Literal['reference', 'loads', 'self']

NAMES = (*(p.name for p in ALL), *CLAMP, 'reference.clock')
SIZE = len(NAMES)
CLAMP_AT, CLOCK = COUNT, COUNT + 2
UNITS = (*(p.unit for p in ALL), *(['rad/(N m)'] * len(CLAMP)), 's')
REPORTED = (*range(ZERO), CLAMP_AT, CLAMP_AT + 1)
"""Parameters of calibration.json, by their index: the zero has a place of its own."""
CLOCK_SD = 0.005
"""s. Tolerance of the reference's clock, once the offset that is seen roughly is taken off."""
CLAMP_SHARE = 0.2
"""Tolerance of the clamp's compliance, as a share of the link's own."""
FAR = 27.0
"""Squared distance of an outlier, of four residuals: one good row in 50 000."""
STEPS, PASSES = 4, 4
ZERO_PASSES, SAME_ZERO = 4, 1e-8
"""Most repetitions of estimating the recordings' zeros and fitting again; the change of a zero, m, that ends them."""
_FREE = 1.0
"""Standard deviation, m and rad, of a pose that only the dots determine."""
_HUBER = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """``mean`` (SIZE,), ``covariance`` (SIZE, SIZE): what is known before the recordings."""

    mean: FloatArray
    covariance: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Standard deviations (SIZE,)."""
        return np.sqrt(np.diag(self.covariance))


def prior_of_rig(rig: Rig, vector: RigVector | None = None) -> Prior:
    """From the rig file: its values and standard deviations, or the tolerances that it need not give.

    Raises ConfigError for a standard deviation of 0, and as :func:`known_of_rig` does.
    """
    vector = vector_of_rig(rig) if vector is None else vector
    covariance = np.zeros((SIZE, SIZE))
    covariance[:COUNT, :COUNT] = known_of_rig(rig).covariance
    # The beams may have moved since: the file's zero counts only to within the default tolerance.
    covariance[ZERO:COUNT] = covariance[:, ZERO:COUNT] = 0.0
    covariance[ZERO:COUNT, ZERO:COUNT] = np.diag(TOLERANCES[ZERO:] ** 2)
    stated = stated_sd(rig)
    if exact := [name for name, sd in stated.items() if sd == 0.0 and name not in CLAMP]:
        raise ConfigError(f'calibration.sds: 0 for {exact[0]}: must be greater than 0, or it cannot be calibrated')
    compliance = (rig.link.length / rig.link.bending_stiffness, rig.link.length / rig.link.torsional_stiffness)
    # A tip force F gives L^3 F/3EI; a clamp that turns by c F L moves the tip by c F L^2.
    shares = (CLAMP_SHARE * compliance[0] / 3.0, CLAMP_SHARE * compliance[1])
    for i, (name, share) in enumerate(zip(CLAMP, shares, strict=True)):
        covariance[CLAMP_AT + i, CLAMP_AT + i] = (stated.get(name) or share) ** 2
    covariance[CLOCK, CLOCK] = CLOCK_SD**2
    mean = np.concatenate((vector.values, list(vector.clamp.values()), [0.0]))
    return Prior(mean, covariance)


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """``reference`` (3,): median standard deviations of the reference, m, m, rad. ``dots``: factor on the dots' noise.

    ``fewer``: rows that carry the information of one independent row, because the reference's errors are correlated.
    """

    reference: FloatArray
    dots: float = 1.0
    fewer: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Rows about one set of parameters: ``residual`` (n, 4) m, ``slopes`` (n, 4, SIZE), ``pose_slopes`` (n, 4, 3)."""

    residual: FloatArray
    slopes: FloatArray
    pose_slopes: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFit:
    """``values`` (SIZE,), ``covariance`` (SIZE, SIZE), ``information`` (SIZE, SIZE) of the rows alone.

    ``linear``: the rows about ``values``; ``weights`` (n,): 0 of an outlier. ``noise``: the variance components.
    ``free``: which parameters were fitted; the others keep the prior's mean and spread.
    """

    values: FloatArray
    covariance: FloatArray
    information: FloatArray
    linear: Linear
    weights: FloatArray
    noise: Noise
    free: Mask


def compliances(rig: Rig, z: FloatArray) -> FloatArray:
    """(3,): m/N, m/N, rad/(N m) of the tip, with the clamp of ``z``."""
    length = rig.link.length
    bending = length**3 / (3.0 * rig.link.bending_stiffness) + z[CLAMP_AT] * length**2
    return np.array([bending, bending, length / rig.link.torsional_stiffness + z[CLAMP_AT + 1]])


def linearised(rows: Rows, z: FloatArray, rig: Rig, kind: Kind) -> Linear:
    """Residuals and their derivatives at ``z`` (SIZE,)."""
    length = rig.link.length
    p = z[:COUNT]
    slopes = np.zeros((len(rows), 4, SIZE))
    pose = pose_of_readings(rows.dots, rows.variances, p, length)
    rotated = by_pose(p, pose.T, length).transpose(2, 0, 1)
    slopes[:, :, :COUNT] = by_parameters(p, pose.T, length).transpose(2, 0, 1)
    residual = rows.dots - readings(p, pose.T, length).T
    if kind == 'reference':
        residual -= np.einsum('nij,nj->ni', rotated, rows.pose - z[CLOCK] * rows.velocity - pose)
        slopes[:, :, CLOCK] = -np.einsum('nij,nj->ni', rotated, rows.velocity)
    elif kind == 'loads':
        residual -= np.einsum('nij,nj->ni', rotated, rows.loads * compliances(rig, z) - pose)
        fx, fy, tz = rows.loads.T
        flat = np.zeros_like(fx)
        bent = length**2 * np.stack((fx, fy, flat), axis=1)
        slopes[:, :, CLAMP_AT] = np.einsum('nij,nj->ni', rotated, bent)
        slopes[:, :, CLAMP_AT + 1] = rotated[:, :, 2] * tz[:, None]
    return Linear(residual, slopes, rotated)


def pose_of_readings(dots: FloatArray, variances: FloatArray, p: FloatArray, length: float) -> FloatArray:
    """Poses (n, 3) that fit the readings (n, 4) best by least squares, weighted by their ``variances`` (n, 4), m^2.

    Other weights would correlate the pose's errors with those of the redundant residual; with the derivatives taken at
    the pose, the gains would be biased.
    """
    root = 1.0 / np.sqrt(variances)

    def step(slopes: FloatArray, pose: FloatArray) -> FloatArray:
        residual = root * (dots - readings(p, pose.T, length).T)
        return np.asarray(np.einsum('nij,nj->ni', np.linalg.pinv(root[:, :, None] * slopes), residual))

    pose = np.zeros((len(dots), 3))
    pose = pose + step(by_pose(p, pose[:1].T, length).transpose(2, 0, 1), pose)
    slopes = by_pose(p, pose.T, length).transpose(2, 0, 1)
    # Each step leaves what the derivatives have changed since, a thousandth.
    for _ in range(3):
        pose = pose + step(slopes, pose)
    return pose


def weight_matrices(linear: Linear, rows: Rows, noise: Noise) -> FloatArray:
    """C^-1 (n, 4, 4), 1/m^2."""
    pose_scatter = linear.pose_slopes * (noise.reference * rows.sd)[:, None, :]
    covariance = np.einsum('nij,nkj->nik', pose_scatter, pose_scatter)
    covariance[:, range(4), range(4)] += noise.dots**2 * rows.variances
    return np.asarray(np.linalg.inv(covariance)) / noise.fewer


def fit(
    rows: Rows, rig: Rig, prior: Prior, kind: Kind = 'reference', *, free: Mask, start: CalibrationFit | None = None
) -> CalibrationFit:
    """Fit ``rows``. ``start``: an earlier fit of the same rows, to begin from.

    ``free``: parameters that are not fitted keep the prior's value; their spread enters the covariance of the rest.
    """
    z = prior.mean.copy() if start is None else start.values.copy()
    z[~free] = prior.mean[~free]
    noise = Noise(np.array([2e-4, 2e-4, 2e-3]), 3.0) if start is None else start.noise
    if kind == 'self':
        noise = Noise(np.full(3, _FREE), noise.dots)
    linear = linearised(rows, z, rig, kind)
    for number in range(0 if start is None else PASSES - 2, PASSES):
        for _ in range(STEPS):
            inverse = weight_matrices(linear, rows, noise)
            robust = _robust(linear, inverse, noise, kind, number)
            step, information = _step(linear, inverse, robust, z, prior, free, rows)
            z = z + step
            linear = linearised(rows, z, rig, kind)
            if np.all(np.abs(step) <= 1e-2 * np.sqrt(np.diag(posterior(information, prior, free)))):
                break
        noise = variance_components(linear, rows, robust, kind, number, information, prior)
    inverse = weight_matrices(linear, rows, noise)
    robust = _robust(linear, inverse, noise, kind, PASSES)
    _, information = _step(linear, inverse, robust, z, prior, free, rows)
    return CalibrationFit(z, posterior(information, prior, free), information, linear, robust, noise, free)


def _robust(linear: Linear, inverse: FloatArray, noise: Noise, kind: Kind, number: int) -> FloatArray:
    """Weights (n,): Huber's in the first pass, then 0 of outliers. Holds of a load are too few to cast one out."""
    distance = np.einsum('ni,nij,nj->n', linear.residual, inverse, linear.residual) * noise.fewer
    # Where most would be outliers it is the noise that is not known yet.
    if number == 0 or kind == 'loads' or np.mean(distance < FAR) < 0.5:
        return np.asarray(np.minimum(1.0, _HUBER / np.sqrt(np.maximum(distance, 1e-300))))
    return np.asarray(distance < FAR, dtype=np.float64)


def score_at(rows: Rows, z: FloatArray, rig: Rig, kind: Kind, best: CalibrationFit) -> tuple[FloatArray, FloatArray]:
    """J^T C^-1 r (SIZE,) and J^T C^-1 J (SIZE, SIZE) at ``z``, with the noise and the outliers of the fit ``best``."""
    linear = linearised(rows, z, rig, kind)
    inverse = weight_matrices(linear, rows, best.noise) * best.weights[:, None, None]
    return _normal(linear, inverse, rows)


def explained(
    rows: Rows, rig: Rig, prior: Prior, kind: Kind, free: Mask, best: CalibrationFit
) -> tuple[float, FloatArray]:
    """How well rows and ``prior`` go together, and the parameters (SIZE,) that fit both.

    The natural logarithm of the rows' probability, but for a constant, with the noise and the outliers of ``best``.
    """
    z = prior.mean.copy()
    z[ZERO:] = best.values[ZERO:]
    at = np.flatnonzero(free)
    for _ in range(STEPS):
        linear = linearised(rows, z, rig, kind)
        inverse = weight_matrices(linear, rows, best.noise)
        step, information = _step(linear, inverse, best.weights, z, prior, free, rows)
        z = z + step
    residual = linearised(rows, z, rig, kind).residual
    chi_square = float(np.einsum('ni,nij,nj,n->', residual, inverse, residual, best.weights))
    scale = prior.sd[at]
    p = prior.covariance[np.ix_(at, at)] / np.outer(scale, scale)
    away = (z - prior.mean)[at] / scale
    scaled_information = information[np.ix_(at, at)] * np.outer(scale, scale)
    log_determinant = float(np.linalg.slogdet(np.eye(len(at)) + p @ scaled_information)[1])
    return -0.5 * (chi_square + float(away @ np.linalg.solve(p, away)) + log_determinant), z


def refitted(full_fit: CalibrationFit, rows: Rows, prior: Prior, row_weights: FloatArray, free: Mask) -> FloatArray:
    """Return the parameters (SIZE,) fitted to the rows whose ``row_weights`` (n,) are 1, by one step from the full
    fit.
    """
    inverse = weight_matrices(full_fit.linear, rows, full_fit.noise)
    z = full_fit.values.copy()
    z[~free] = prior.mean[~free]
    shifted = Linear(residual_at(full_fit, z), full_fit.linear.slopes, full_fit.linear.pose_slopes)
    return z + _step(shifted, inverse, full_fit.weights * row_weights, z, prior, free, rows)[0]


def residual_at(full_fit: CalibrationFit, z: FloatArray) -> FloatArray:
    """Residuals (n, 4), m, for parameters near those of the fit, to first order."""
    return full_fit.linear.residual - full_fit.linear.slopes @ (z - full_fit.values)


def _step(
    linear: Linear, inverse: FloatArray, robust: FloatArray, z: FloatArray, prior: Prior, free: Mask, rows: Rows
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton's step (SIZE,) and the information (SIZE, SIZE) of the rows."""
    right, information = _normal(linear, inverse * robust[:, None, None], rows)
    at = np.flatnonzero(free)
    block = np.ix_(at, at)
    scale = prior.sd[at]
    precision = np.linalg.inv(prior.covariance[block] / np.outer(scale, scale))
    normal = precision + information[block] * np.outer(scale, scale)
    gradient = scale * right[at] - precision @ ((z - prior.mean)[at] / scale)
    step = np.zeros(SIZE)
    step[at] = scale * np.linalg.solve(normal, gradient)
    return step, information


def _normal(linear: Linear, inverse: FloatArray, rows: Rows) -> tuple[FloatArray, FloatArray]:
    """J^T C^-1 r (SIZE,) and J^T C^-1 J (SIZE, SIZE), ``inverse`` (n, 4, 4) being C^-1.

    Every recording after the first has a zero of its own, which is eliminated: its readings tell the parameters only
    what a constant offset of the four does not.
    """
    weighted = np.einsum('nij,njk->nik', inverse, linear.slopes)
    information = linear.slopes.reshape(-1, SIZE).T @ weighted.reshape(-1, SIZE)
    right = weighted.reshape(-1, SIZE).T @ linear.residual.ravel()
    for run in range(1, int(rows.run.max()) + 1):
        zero_information, shared, pull = _of_zero(linear, weighted, rows.run == run)
        right -= shared.T @ np.linalg.solve(zero_information, pull)
        information -= shared.T @ np.linalg.solve(zero_information, shared)
    return right, 0.5 * (information + information.T)


def _of_zero(linear: Linear, weighted: FloatArray, rows_of_run: Mask) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The normal equations of one recording's own zero: (4, 4), with the parameters (4, SIZE), right side (4,)."""
    zero = slice(ZERO, COUNT)
    by_zero = linear.slopes[rows_of_run][:, :, zero].reshape(-1, COUNT - ZERO).T
    shared = by_zero @ weighted[rows_of_run].reshape(-1, SIZE)
    pull = weighted[rows_of_run][:, :, zero].reshape(-1, COUNT - ZERO).T @ linear.residual[rows_of_run].ravel()
    return shared[:, zero] + np.diag(TOLERANCES[zero] ** -2), shared, pull


def with_common_zero(rows: Rows, rig: Rig, prior: Prior, kind: Kind, free: Mask) -> tuple[Rows, CalibrationFit]:
    """Return the rows as if all recordings had the zero of the first one, and their fit.

    The beams may have been aimed anew between two recordings, and a camera takes its rest anew. The offset is a
    change of the unloaded readings; what it does to the others follows from the model.
    """
    given, count = rows, int(rows.run.max()) + 1
    offsets = np.zeros((count, COUNT - ZERO))
    if count > 1:
        residual = linearised(rows, prior.mean, rig, kind).residual
        offsets += [np.median(residual[rows.run == run], axis=0) for run in range(count)]
        offsets -= offsets[0]
        rows = _moved(given, rig, prior.mean, offsets)
    best = fit(rows, rig, prior, kind, free=free)
    # The medians are as good as the reference; the one redundant reading knows its part much better.
    for _ in range(ZERO_PASSES if count > 1 else 0):
        inverse = weight_matrices(best.linear, rows, best.noise) * best.weights[:, None, None]
        weighted = np.einsum('nij,njk->nik', inverse, best.linear.slopes)
        before = offsets.copy()
        for run in range(1, count):
            zero_information, _, pull = _of_zero(best.linear, weighted, rows.run == run)
            offsets[run] += np.linalg.solve(zero_information, pull)
        if np.abs(offsets - before).max() < SAME_ZERO:
            break
        rows = _moved(given, rig, best.values, offsets)
        best = fit(rows, rig, prior, kind, free=free, start=best)
    return rows, best


def _moved(rows: Rows, rig: Rig, z: FloatArray, offsets: FloatArray) -> Rows:
    """The rows without ``offsets`` (recordings, 4), m, of the unloaded readings, by the model with ``z`` (SIZE,)."""
    length, dots = rig.link.length, rows.dots.copy()
    for run, offset in enumerate(offsets):
        if not offset.any():
            continue
        rows_of_run = rows.run == run
        moved = z[:COUNT].copy()
        moved[ZERO:] += offset
        pose = pose_of_readings(rows.dots[rows_of_run], rows.variances[rows_of_run], moved, length).T
        dots[rows_of_run] -= (readings(moved, pose, length) - readings(z[:COUNT], pose, length)).T
    return replace(rows, dots=dots)


def posterior(information: FloatArray, prior: Prior, free: Mask) -> FloatArray:
    """Covariance (SIZE, SIZE) of the fit, and of what was not fitted (Schmidt's consider covariance)."""
    scale = prior.sd
    p0 = prior.covariance / np.outer(scale, scale)
    info = information * np.outer(scale, scale)
    d, u = np.flatnonzero(free), np.flatnonzero(~free)
    # z_d - truth = A (prior error of d) + noise - P_d N_du (error of u); d and u may be correlated before.
    p_d = np.linalg.inv(np.linalg.inv(p0[np.ix_(d, d)]) + info[np.ix_(d, d)])
    out = np.zeros((SIZE, SIZE))
    out[np.ix_(d, d)] = p_d
    if len(u):
        prior_gain = p_d @ np.linalg.inv(p0[np.ix_(d, d)])
        by_u = -p_d @ info[np.ix_(d, u)]
        p_u, p_du = p0[np.ix_(u, u)], p0[np.ix_(d, u)]
        cross = prior_gain @ p_du @ by_u.T
        out[np.ix_(d, d)] += by_u @ p_u @ by_u.T + cross + cross.T
        out[np.ix_(d, u)] = prior_gain @ p_du + by_u @ p_u
        out[np.ix_(u, d)] = out[np.ix_(d, u)].T
        out[np.ix_(u, u)] = p_u
    return np.asarray(out * np.outer(scale, scale))


def variance_components(
    linear: Linear, rows: Rows, robust: FloatArray, kind: Kind, number: int, information: FloatArray, prior: Prior
) -> Noise:
    """Return the variance components from the residuals."""
    good = robust > 0.0 if number else np.ones(len(rows), dtype=bool)
    inverse = np.linalg.pinv(linear.pose_slopes)
    errors = (np.einsum('nij,nj->ni', inverse, linear.residual) / rows.sd)[good]
    # Two PSDs leave one direction that no pose reaches.
    across = np.linalg.svd(linear.pose_slopes)[0][:, :, 3]
    redundant = np.einsum('ni,ni->n', across, linear.residual)[good]
    expected = np.sqrt(np.einsum('ni,ni->n', across**2, rows.variances))[good]
    scale = prior.sd
    known = np.linalg.inv(
        np.linalg.inv(prior.covariance / np.outer(scale, scale)) + information * np.outer(scale, scale)
    )
    used = float(np.trace(known @ (information * np.outer(scale, scale))))
    # Each of the four equations of a row pays its part of the parameters that were fitted.
    share = max(1.0 - used / (4.0 * len(errors)), 0.2)
    robustly = number == 0 and kind != 'loads'
    dots = deviation_of(redundant / expected, robustly) / share**0.5
    if kind == 'self':
        return Noise(np.full(3, _FREE), max(dots, 0.3), 1.0)
    stated_variance = (np.einsum('nij,nj->ni', inverse**2, rows.variances) / rows.sd**2)[good].mean(axis=0) * dots**2
    observed_variance = np.array([deviation_of(e, robustly) ** 2 for e in errors.T]) / share
    reference = np.sqrt(np.maximum(observed_variance - stated_variance, 0.01 * stated_variance))
    return Noise(reference, max(dots, 0.3), fewer(errors, rows.run[good]))


def deviation_of(values: FloatArray, robustly: bool) -> float:
    """Return the standard deviation of values, by the median if ``robustly``."""
    if robustly:
        return float(1.4826 * np.median(np.abs(values - np.median(values))))
    return float(np.sqrt(np.mean(values**2)))


def fewer(errors: FloatArray, run: np.ndarray[tuple[int], np.dtype[np.int64]]) -> float:
    """Rows that carry the information of one independent row if ``errors`` (n, k) are a first-order autoregression.

    ``run`` (n,): which recording each row is of.
    """
    same = run[1:] == run[:-1]
    sums, worst = np.sum(errors**2, axis=0), 0.0
    for e, total in zip(errors.T, sums, strict=True):
        if total > 0.0:
            worst = max(worst, float(np.sum(e[1:] * e[:-1] * same) / total))
    if worst < 3.0 / len(errors) ** 0.5:
        return 1.0
    worst = min(worst, 0.98)
    return (1.0 + worst) / (1.0 - worst)
