"""How the dots of a recording answered to its loads, by linear regression on what the link model expects.

Each load alone moves the expected pose through the link's compliance and its first mode; its movement on each channel
is the slope of that channel's block means on the expected pose. A constant and a straight line in time are fitted with
them: where the dots were before load, and drift. Loads that always came together cannot be told apart and count as one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.records import DOT_CHANNELS, FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.check.wirings import PushResponse, pattern, scales_of

LOADS = ('fx', 'fy', 'tz')
TOGETHER = 0.95
"""Loads whose expected poses are correlated more than this count as one."""

FEWEST_BLOCKS = 8


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
    static = loads @ LinkStatics.from_rig(rig).compliance
    poses = _moved(rig, static, period)
    n = len(volts) // size
    dots = _block_means(volts[: n * size, DOT_CHANNELS], n) * rig.amplifier.sensitivity
    means, held = (p[: n * size].reshape(n, size, 3).mean(axis=1) for p in (poses, static))
    present = np.isfinite(dots).all(axis=1)
    if int(present.sum()) < FEWEST_BLOCKS:
        raise RecordingError(f'{int(present.sum())} blocks of samples: at least {FEWEST_BLOCKS} are needed')
    t = np.arange(n) * size * period
    groups = _groups(held[present], means[present], pattern(rig))
    peaks = [float(np.abs(means[present][:, group[0]]).max()) for group in groups]
    columns = [means[:, group[0]] / peak for group, peak in zip(groups, peaks, strict=True)]
    design = np.column_stack([*columns, np.ones(n), t - t.mean()])[present]
    slopes, sd = _regression(design, dots[present])
    pushes = []
    for i, (group, peak) in enumerate(zip(groups, peaks, strict=True)):
        # Loads that came together ring apart: their proportion is that of the held loads.
        first = held[present][:, group[0]]
        largest = [peak * _slope(first, held[present][:, k]) if k in group else 0.0 for k in range(3)]
        names = tuple(LOADS[k] for k in group)
        pushes.append(PushResponse(names, slopes[i], sd[i], pattern(rig) @ np.array(largest), scales=scales_of(rig)))
    return Responses(tuple(pushes), slopes[-1], sd[-1])


def _moved(rig: Rig, static: FloatArray, period: float) -> FloatArray:
    """What the link's modes make of the poses (n, 3) at which the loads would settle."""
    d = rig.dynamics
    bending = mode_coefficients(d.bending_frequency, d.bending_damping_ratio, period)
    torsion = mode_coefficients(d.torsion_frequency, d.torsion_damping_ratio, period)
    return np.column_stack([Filter(c)(static[:, i]) for i, c in enumerate((bending, bending, torsion))])


def _block_means(samples: FloatArray, n: int) -> FloatArray:
    """Means (n, c) over the samples that are there; NaN for a block without any."""
    parts = samples.reshape(n, -1, samples.shape[1])
    there = np.isfinite(parts)
    count = there.sum(axis=1)
    total = np.where(there, parts, 0.0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _groups(poses: FloatArray, moved: FloatArray, per_pose: FloatArray) -> list[list[int]]:
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


def _slope(x: FloatArray, y: FloatArray) -> float:
    x = x - x.mean()
    return float(x @ (y - y.mean()) / (x @ x))


def _regression(design: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slopes (k, c) of ``values`` (n, c) on ``design`` (n, k) and their standard deviations.

    These count the correlation of one block's rest with the next one's, so that hum, ringing and drift widen them.
    """
    inverse = np.linalg.pinv(design)
    slopes = inverse @ values
    rest = values - design @ slopes
    variance = (rest**2).sum(axis=0) / max(len(design) - design.shape[1], 1)
    ahead = (rest[1:] * rest[:-1]).sum(axis=0) / np.maximum((rest**2).sum(axis=0), np.finfo(float).tiny)
    colour = np.clip(ahead, 0.0, 0.98)
    wider = (1.0 + colour) / (1.0 - colour)
    spread = (inverse**2).sum(axis=1)
    return slopes, np.sqrt(spread[:, None] * (variance * wider)[None, :])
