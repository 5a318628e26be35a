# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How well ``validate`` tells the offset between two clocks: ``python -m blind.clock --runs 200``."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from blind.campaign import options, watched
from blind.generator import Array, flat_dots
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.solvers import solver_from_rig
from psd_deflection.rig.config import load_rig
from psd_deflection.studies.validate.clock import Motion, Offset, clock_offset

MODES = ((14.0, 2.0e-3), (14.0, -1.2e-3), (21.0, 8.0e-3))  # Hz, and m, m, rad a step.


Steps = tuple[float, ...]


def truth(t: Array, steps: Steps = (1.0, 3.7)) -> Array:
    """Poses (k, 3) at ``t``, s: steps up and down in turn, each with its ringing (damping ratio 0.02)."""
    out = np.zeros((len(t), 3))
    for number, start in enumerate(steps):
        since = np.clip(t - start, 0.0, None)
        for axis, (hertz, size) in enumerate(MODES):
            w = 2.0 * np.pi * hertz
            rung = 1.0 - np.exp(-0.02 * w * since) * np.cos(w * since)
            out[:, axis] += (-1.0) ** number * size * np.where(t > start, rung, 0.0)
    return out


@dataclass
class ClockRecording:
    """``t`` and ``dots`` of the samples; ``stamps``, s, and ``poses`` of a reference; ``offset`` that it is behind."""

    t: Array
    dots: Array
    stamps: Array
    poses: Array
    offset: float


REFERENCE_SD = np.array([10e-6, 10e-6, 3e-4])


def simulated(
    seed: int, *, seconds: float = 6.0, rate: float = 30.0, exposure: float = 0.008, steps: Steps = (1.0, 3.7)
) -> ClockRecording:
    """Samples at 1 kHz with 2 µm of noise, and a camera at ``rate`` a second that takes means over ``exposure``, s."""
    rng = np.random.default_rng(seed)
    t: Array = np.arange(int(1000 * seconds)) * np.float64(1e-3)
    offset = float(rng.uniform(-0.4, 0.4))
    middles = np.arange(0.0, seconds, 1.0 / rate) + float(rng.uniform(0.0, 1.0 / rate))
    within = np.linspace(-0.5, 0.5, 41) * exposure
    poses = np.mean([truth(middles + u, steps) for u in within], axis=0)
    dots = flat_dots(truth(t, steps)) + rng.normal(0.0, 2e-6, (len(t), 4))
    return ClockRecording(t, dots, middles - offset, poses + rng.normal(0.0, REFERENCE_SD, poses.shape), offset)


RIG = load_rig(None)
SOLVER = solver_from_rig('exact', RIG)
VARIANCES = dot_noise_variances(RIG) / RIG.estimator.block_size


def motion_of(t: Array, readings: Array) -> Motion:
    return Motion(t, readings, 1e-3, lambda d: SOLVER.solve_many(d, VARIANCES).pose)


@dataclass
class Score:
    """``errors``: of the offset, s. ``inside``: 95 % intervals that hold the truth. ``reported``: runs with an
    answer."""

    errors: list[float]
    inside: int = 0
    reported: int = 0


def scored(runs: Iterable[int], exposure: float = 0.008) -> Score:
    score = Score([])
    for seed in runs:
        run = simulated(seed, seconds=4.0, steps=(1.0, 2.7), exposure=exposure)
        offset: Offset = clock_offset(motion_of(run.t, run.dots), run.stamps, run.poses, exposure=exposure)
        low, high = offset.interval
        score.errors.append(offset.value - run.offset)
        score.inside += low <= run.offset <= high
        score.reported += offset.determined
    return score


def main() -> None:
    parser = options(__doc__)
    parser.add_argument('--runs', type=int, default=200, metavar='N')
    parser.add_argument('--first', type=int, default=1000, metavar='SEED')
    args = parser.parse_args()
    score = scored(watched(range(args.first, args.first + args.runs)))
    errors = np.abs(score.errors)
    print(f'offset told         {score.reported} of {args.runs}')
    print(f'inside its interval {100.0 * score.inside / args.runs:.1f} % (95 % expected)')
    print(f'error               {1e6 * np.sqrt((errors**2).mean()):.0f} µs rms, {1e6 * errors.max():.0f} µs at most')


if __name__ == '__main__':
    main()
