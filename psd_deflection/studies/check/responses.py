# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How the dots of a recording answered to its loads, by linear regression on the dots that the simulation shows.

The simulation has the plate's geometry and the ringing of both modes. So what is left of a regression on its dots is
wiring, gain, noise and drift. Each channel is a combination of the four simulated dots, whatever the wiring is; a
constant and a straight line in time are fitted with them: where the dots were before load, and drift. The movement by a
load is that combination of the dots that the load alone moves, at rest. Loads that always came together cannot be
determined apart and count as one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import DOT_CHANNELS, FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.check.wirings import PushResponse, pattern, scales_of

LOADS = ('fx', 'fy', 'tz')
TOGETHER = 0.95
"""Loads whose expected poses are correlated more than this count as one."""

FEWEST_BLOCKS = 8
LEAST_MOVED = 1e-6
"""Combinations of the simulated dots that move by less than this share of the largest say nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Responses:
    """``pushes``: one for each load that was applied. ``drift``, ``drift_sd`` (4,): m/s, of the device's channels."""

    pushes: tuple[PushResponse, ...]
    drift: FloatArray
    drift_sd: FloatArray


def responses(rig: Rig, volts: FloatArray, loads: FloatArray) -> Responses:
    """``volts`` (n, 6) of the device's channels, NaN if a sample is lost; ``loads`` (n, 3), N, N, N m, held.

    Raises RecordingError if there are too few blocks.
    """
    size, period = rig.estimator.block_size, 1.0 / rig.converter.sample_rate_hz
    n = len(volts) // size
    dots = block_means(volts[: n * size, DOT_CHANNELS], n) * rig.amplifier.sensitivity
    present = np.isfinite(dots).all(axis=1)
    if int(present.sum()) < FEWEST_BLOCKS:
        raise RecordingError(f'{int(present.sum())} blocks of samples: at least {FEWEST_BLOCKS} are needed')
    static = loads @ LinkStatics.from_rig(rig).compliance
    poses = _moved(rig, static, period)
    means, held = (p[: n * size].reshape(n, size, 3).mean(axis=1) for p in (poses, static))
    shown = _simulated(rig, loads)[: n * size].reshape(n, size, 4).mean(axis=1)
    t = np.arange(n) * size * period
    design = np.column_stack((shown - shown[present].mean(axis=0), np.ones(n), t - t.mean()))[present]
    slopes, covariance, variance = least_squares_fit(design, dots[present])
    pushes = []
    for group in load_groups(held[present], means[present], pattern(rig)):
        most = int(np.argmax(np.abs(held[present][:, group[0]])))
        alone = np.zeros((2, 3))
        alone[1, group] = loads[: n * size].reshape(n, size, 3).mean(axis=1)[present][most, group]
        before, after = _simulated(rig, alone, settled=True)
        # The way that the push is named.
        expected = np.sign(alone[1, group[0]]) * (after - before)
        moved = np.append(expected, (0.0, 0.0))
        names = tuple(LOADS[k] for k in group)
        sd = np.sqrt(moved @ covariance @ moved * variance)
        pushes.append(PushResponse(names, moved @ slopes, sd, expected, scales=scales_of(rig)))
    return Responses(tuple(pushes), slopes[-1], np.sqrt(covariance[-1, -1] * variance))


def _simulated(rig: Rig, loads: FloatArray, *, settled: bool = False) -> FloatArray:
    """Dots x1 y1 x2 y2 (n, 4), m, under ``loads`` (n, 3), N, N, N m; ``settled``: at rest under each."""
    return np.asarray(ForwardModel(rig, settled=settled).run(loads).true_dots.T)


def _moved(rig: Rig, static: FloatArray, period: float) -> FloatArray:
    """What the link's modes make of the poses (n, 3) at which the loads would settle."""
    d = rig.dynamics
    bending = mode_coefficients(d.bending_frequency, d.bending_damping_ratio, period)
    torsion = mode_coefficients(d.torsion_frequency, d.torsion_damping_ratio, period)
    return np.column_stack([Filter(c)(static[:, i]) for i, c in enumerate((bending, bending, torsion))])


def block_means(samples: FloatArray, n: int) -> FloatArray:
    """Means (n, c) over the samples that are there; NaN for a block without any."""
    parts = samples.reshape(n, -1, samples.shape[1])
    there = np.isfinite(parts)
    count = there.sum(axis=1)
    total = np.where(there, parts, 0.0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def load_groups(poses: FloatArray, moved: FloatArray, per_pose: FloatArray) -> list[list[int]]:
    """The applied loads, those together that always came together. ``poses`` (n, 3): held; ``moved`` (n, 3): rung."""
    size = np.minimum(np.ptp(poses, axis=0), np.ptp(moved, axis=0)) * np.linalg.norm(per_pose, axis=0)
    applied = [int(i) for i in np.argsort(-size) if size[i] > 0.0]
    out: list[list[int]] = []
    for i in applied:
        for group in out:
            if abs(np.corrcoef(poses[:, i], poses[:, group[0]])[0, 1]) > TOGETHER:
                group.append(i)
                break
        else:
            out.append([i])
    return sorted((sorted(group) for group in out), key=lambda group: group[0])


def least_squares_fit(design: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Slopes (k, c) of ``values`` (n, c) on ``design`` (n, k), their spread (k, k) per variance, the variances (c,).

    The variances count the correlation of one block's rest with the next one's, so that hum, ringing and drift widen
    them.
    """
    size = np.abs(design).max(axis=0)
    # The four dots in one unit: their proportions count.
    size[:4] = size[:4].max()
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv(design / size, rcond=LEAST_MOVED) / size[:, None]
    slopes = inverse @ values
    rest = values - design @ slopes
    variance = (rest**2).sum(axis=0) / max(len(design) - design.shape[1], 1)
    ahead = (rest[1:] * rest[:-1]).sum(axis=0) / np.maximum((rest**2).sum(axis=0), np.finfo(float).tiny)
    colour = np.clip(ahead, 0.0, 0.98)
    return slopes, inverse @ inverse.T, variance * (1.0 + colour) / (1.0 - colour)
