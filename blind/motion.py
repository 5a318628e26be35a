# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How well the filter of the motion does: ``python -m blind.motion --runs 20``."""

import copy
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter, savgol_filter
from scipy.stats import chi2

from blind.campaign import chunk as chunk_of
from blind.campaign import options, watched
from blind.generator import EI, GJ, MM_PER_V, PLACES, RATE, SIGMA, Array, flat_dots, output
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import BaseAcceleration, RawChunk, TipMotion
from psd_deflection.rig.config import Rig, load_rig

LENGTH = 0.585
GIVES = (LENGTH**3 / (3.0 * EI), LENGTH**3 / (3.0 * EI), LENGTH / GJ)
MODES = ((14.0, 0.02), (14.0, 0.02), (21.0, 0.02))
REST, BLOCK = 3.0, 20
AXES = ('dX', 'dY', 'theta')
KINDS = ('steps', 'chirp', 'operation', 'joint')
UNTOLD = 'untold'  # As ``joint``, but the filter is told nothing.
BEHIND = 0.3  # So far behind the base is the point about which joints turn it, m.
FASTEST = (6.0, 6.0, 15.0)
"""Largest angular acceleration about x, y and z, rad/s^2; twice as much in the middle of a raised cosine."""
REPORTED = 4  # Samples from one message about the base's acceleration to the next.
PARTS = 2  # Steps of Runge and Kutta in a sample.
UNSEEN = 100  # Samples that do not come.
BANDS = 8  # Bands of frequency of a chirp.
LATER = np.arange(1, BLOCK + 1) / RATE


@dataclass(frozen=True)
class Run:
    """One link in motion at 1 kHz. ``loads`` (n, 3), ``pose`` (n, 3), ``velocity`` (n, 3): truth; ``volts`` (n, 6).
    ``reported``: of the base, in order."""

    loads: Array
    pose: Array
    velocity: Array
    volts: Array
    reported: tuple[BaseAcceleration, ...] = ()


def loads_of(kind: str, seconds: float, rng: np.random.Generator) -> Array:
    """Loads (n, 3), N, N, N m; each is held for a sample."""
    n, rest = int(seconds * RATE), int(REST * RATE)
    out, most = np.zeros((n, 3)), np.array([20.0, 20.0, 2.0])
    if kind == 'steps':
        for axis in range(3):
            at = rest
            while at < n:
                out[at:, axis] = most[axis] * rng.uniform(-1.0, 1.0)
                at += int(RATE * rng.exponential(1.5)) + 1
    elif kind == 'chirp':
        t = np.arange(n - rest) / RATE
        for axis in range(3):
            low, high = 0.5, 1.2 * MODES[axis][0]
            phase = 2.0 * math.pi * (low * t + 0.5 * (high - low) / (seconds - REST) * t * t)
            out[rest:, axis] = 0.1 * most[axis] * np.sin(phase)
    else:
        for axis in range(3):
            # A force that forgets in 0.2 s.
            decay = math.exp(-1.0 / (RATE * 0.2))
            new = rng.normal(0.0, 0.2 * most[axis] * math.sqrt(1.0 - decay * decay), n - rest)
            out[rest:, axis] = lfilter([1.0], [1.0, -decay], new)
    return out


def moved(loads: Array) -> tuple[Array, Array]:
    """Pose and velocity (n, 3) at each sample; the sample sees the loads before it."""
    pose, velocity = np.empty_like(loads), np.empty_like(loads)
    for axis, (hertz, zeta) in enumerate(MODES):
        w = 2.0 * math.pi * hertz
        step = expm(np.array([[0.0, 1.0, 0.0], [-w * w, -2.0 * zeta * w, w * w], [0.0, 0.0, 0.0]]) / RATE)
        (a, b, c), (d, e, f), _ = step.tolist()
        q = v = 0.0
        for i, u in enumerate((GIVES[axis] * loads[:, axis]).tolist()):
            pose[i, axis], velocity[i, axis] = q, v
            q, v = a * q + b * v + c * u, d * q + e * v + f * u
    return pose, velocity


def joint_motion(t: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Rates of turn (n, 3), rad/s, and angular accelerations (n, 3), rad/s^2, at times ``t`` of a base on three joints.
    Each joint moves again and again: it speeds up, goes on and slows down, with steps of the acceleration or with
    raised cosines."""
    rate, acceleration = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for axis, most in enumerate(FASTEST):
        begin = REST
        while begin < t[-1]:
            peak, smooth = most * rng.uniform(-1.0, 1.0), bool(rng.integers(2))
            long, cruise, rest = np.round(RATE * rng.uniform((0.1, 0.0, 0.0), (0.3, 0.3, 0.5))) / RATE
            for sign, start in ((1.0, begin), (-1.0, begin + long + cruise)):
                share = np.clip((t - start) / long, 0.0, 1.0)
                angle = 2.0 * math.pi * share
                now = (t > start) & (t < start + long)
                acceleration[now, axis] += sign * peak * (1.0 - np.cos(angle[now]) if smooth else 1.0)
                rate[:, axis] += sign * peak * long * (share - np.sin(angle) / (2.0 * math.pi) if smooth else share)
            begin += 2.0 * long + cruise + rest
    return rate, acceleration


def swung(seconds: float, rng: np.random.Generator) -> tuple[Array, Array, tuple[BaseAcceleration, ...]]:
    """Pose and velocity (n, 3) of a link without load whose base turns, and what is told of the base. In the frame of
    the base the tip is a mass on springs; what its base does to it is base + alpha x r + omega x (omega x r) + 2 omega
    x r', with r = (dX, dY, L), by Runge and Kutta."""
    n, h = round(seconds * RATE), 1.0 / (RATE * PARTS)
    # Each step from just after its begin to just before its end.
    t = (np.arange(n * PARTS)[:, None] * h + np.array([1e-9, 0.5 * h, h - 1e-9])).ravel()
    rates, accelerations = joint_motion(t, rng)
    offset = np.array([0.0, 0.0, BEHIND])
    base = np.cross(accelerations, offset) + np.cross(rates, np.cross(rates, offset))
    (wx, wy, wz), (ax, ay, az) = rates.T, accelerations.T
    w, zeta = 2.0 * math.pi * np.array(MODES)[:, 0], np.array(MODES)[:, 1]
    system, force = np.zeros((len(t), 6, 6)), np.zeros((len(t), 6))
    system[:, :3, 3:], system[:, 3:, :3], system[:, 3:, 3:] = np.eye(3), -np.diag(w * w), -np.diag(2.0 * zeta * w)
    system[:, 3, 0] += wy * wy + wz * wz
    system[:, 4, 1] += wx * wx + wz * wz
    system[:, 3, 1] = az - wx * wy
    system[:, 4, 0] = -az - wx * wy
    system[:, 3, 4], system[:, 4, 3] = 2.0 * wz, -2.0 * wz
    force[:, 3] = -base[:, 0] - LENGTH * (ay + wx * wz)
    force[:, 4] = -base[:, 1] - LENGTH * (wy * wz - ax)
    force[:, 5] = -az
    out, y = np.empty((n, 6)), np.zeros(6)
    for i in range(n * PARTS):
        if i % PARTS == 0:
            out[i // PARTS] = y
        (a0, a1, a2), (f0, f1, f2) = system[3 * i : 3 * i + 3], force[3 * i : 3 * i + 3]
        k1 = a0 @ y + f0
        k2 = a1 @ (y + 0.5 * h * k1) + f1
        k3 = a1 @ (y + 0.5 * h * k2) + f1
        k4 = a2 @ (y + h * k3) + f2
        y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    # The mean over the time for which each holds: how far the rate of turn goes in it.
    reported = tuple(
        BaseAcceleration(i * REPORTED * 1_000_000, tuple(np.cross(mean, offset).tolist()), tuple(mean.tolist()))
        for i, mean in enumerate(accelerations[1::3].reshape(-1, PARTS * REPORTED, 3).mean(axis=1))
    )
    return out[:, :3], out[:, 3:], reported


def make(kind: str, seconds: float, seed: int) -> Run:
    rng = np.random.default_rng(seed)
    if kind in ('joint', UNTOLD):
        pose, velocity, reported = swung(seconds, rng)
        volts = volts_of(pose, np.random.default_rng([seed, 1]))
        return Run(np.zeros_like(pose), pose, velocity, volts, reported if kind == 'joint' else ())
    return run_of(loads_of(kind, seconds, rng), seed)


def run_of(loads: Array, seed: int) -> Run:
    pose, velocity = moved(loads)
    return Run(loads, pose, velocity, volts_of(pose, np.random.default_rng([seed, 1])))


def biased(run: Run, share: float) -> Run:
    """Return the same run, with all that is told of the base too large by ``share``."""

    def larger(vector: tuple[float, ...]) -> tuple[float, ...]:
        return tuple((1.0 + share) * v for v in vector)

    reported = tuple(BaseAcceleration(m.t_ns, larger(m.linear), larger(m.angular)) for m in run.reported)
    return replace(run, reported=reported)


def volts_of(pose: Array, rng: np.random.Generator) -> Array:
    """Readings (n, 6) of the poses (n, 3), with the rig's noise and converter."""
    volts = np.full((len(pose), 6), 5.0)
    volts[:, [0, 1, 3, 4]] = flat_dots(pose) / MM_PER_V
    return output(volts + rng.normal(0.0, SIGMA, volts.shape), [])


@dataclass(frozen=True)
class Result:
    """Of B blocks in motion; (B, 3) unless said otherwise. ``velocity``, ``velocity_sd``: error of the velocity at the
    end of a block, and the standard deviation that it is given. ``smoothed``: error of the best Savitzky-Golay filter
    in the middle. ``squares``: NIS of a block. ``predicted``, ``held`` (20 B, 3): error of the pose at each sample
    until the next block is there. ``pose``, ``pose_sd``. ``unseen``: error of the pose 100 ms after the block if no
    more samples come, in standard deviations; NaN in the last five."""

    velocity: Array
    velocity_sd: Array
    smoothed: Array
    squares: Array
    predicted: Array
    held: Array
    pose: Array
    pose_sd: Array
    unseen: Array


def chunk(run: Run, block: int) -> RawChunk:
    """Block number ``block`` of the run."""
    return chunk_of(run.volts[BLOCK * block : BLOCK * (block + 1)], BLOCK * block)


def rig_of(changes: Mapping[str, object] | None = None) -> Rig:
    return load_rig(None, {'filter': 'modal', 'solvers': ['exact'], **(changes or {})})


def pose_of(volts: Array) -> Array:
    """Pose (n, 3) of readings (n, 6): the base line between the dots gives the twist."""
    (l1, l2), dots = (complex(*place) for place in PLACES), MM_PER_V * volts
    q1, q2 = l1 + dots[:, 0] + 1j * dots[:, 1], l2 + dots[:, 3] + 1j * dots[:, 4]
    rotation = (l1 - l2) / (q1 - q2)
    rotation /= np.abs(rotation)
    moved_by = 0.5 * (l1 + l2) - rotation * 0.5 * (q1 + q2)
    return np.column_stack((moved_by.real, moved_by.imag, np.angle(rotation)))


def _smoothed(run: Run, part: slice) -> Array:
    """Error of the velocity (B, 3) in the middle of the blocks, by the Savitzky-Golay filter that does best."""
    means = pose_of(run.volts).reshape(-1, BLOCK, 3).mean(axis=1)
    inside = run.velocity.reshape(-1, BLOCK, 3)
    truth = 0.5 * (inside[:, BLOCK // 2 - 1] + inside[:, BLOCK // 2])
    out = np.empty_like(truth[part])
    for axis in range(3):
        tried = [
            savgol_filter(means[:, axis], window, order, deriv=1, delta=BLOCK / RATE)[part] - truth[part, axis]
            for window in (3, 5, 7, 9, 11)
            for order in range(1, min(window, 7))
        ]
        out[:, axis] = min(tried, key=rms)
    return out


def rms(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def evaluate(run: Run, rig: Rig, late: int = 0) -> Result:
    """Return the run through the pipeline, against the truth. What is told of the base comes ``late`` samples after its
    stamp."""
    pipeline = Pipeline(rig)
    motion = pipeline.motion_filter
    if motion is None:
        raise ValueError('the rig asks for no filter')
    blocks = len(run.volts) // BLOCK
    reported = list(run.reported)

    def there(message: BaseAcceleration) -> int:
        return round(message.t_ns / 1e9 * RATE) + late

    velocity, velocity_sd, squares = np.zeros((blocks, 3)), np.zeros((blocks, 3)), np.zeros((blocks, 3))
    pose, pose_sd = np.zeros((blocks, 3)), np.zeros((blocks, 3))
    predicted, held = np.zeros((blocks * BLOCK, 3)), np.zeros((blocks * BLOCK, 3))
    unseen = np.full((blocks, 3), np.nan)
    first = int(REST * RATE) // BLOCK
    for block in range(blocks):
        before = motion.innovations
        while reported and there(reported[0]) < BLOCK * (block + 1):
            pipeline.accelerate(reported.pop(0))
        for record in pipeline.process(chunk(run, block)):
            if isinstance(record, TipMotion):
                at = BLOCK * (block + 1) - 1
                velocity[block] = np.array([record.vx, record.vy, record.vtheta]) - run.velocity[at]
                velocity_sd[block] = np.sqrt(record.velocity_covariance[::4])
                pose[block] = np.array([record.dx, record.dy, record.theta]) - run.pose[at]
                pose_sd[block] = np.sqrt(record.covariance[::4])
        squares[block] = motion.innovations.since(before).squares
        estimate = pipeline.last_estimate
        if estimate is None:
            raise RuntimeError(f'block {block} has no estimate')
        if first - 1 <= block < blocks - 1:
            ahead = slice(BLOCK * (block + 1), BLOCK * (block + 2))
            predicted[ahead] = motion.predicted(LATER).pose - run.pose[ahead]
            held[ahead] = np.array(estimate.pose) - run.pose[ahead]
        at = BLOCK * (block + 1) - 1 + UNSEEN
        if at < len(run.pose):
            # No samples, but messages go on.
            meanwhile = copy.deepcopy(motion)
            for message in reported[: sum(there(message) <= at for message in reported[: UNSEEN + 1])]:
                meanwhile.inertia.notify(message, message.t_ns)
            later = meanwhile.predicted(np.array([UNSEEN / RATE]))
            unseen[block] = (later.pose[0] - run.pose[at]) / np.sqrt(later.variance[0])
    part, samples = slice(first, blocks), slice(first * BLOCK, blocks * BLOCK)
    first_four = velocity[part], velocity_sd[part], _smoothed(run, part), squares[part]
    return Result(*first_four, predicted[samples], held[samples], pose[part], pose_sd[part], unseen[part])


@dataclass(frozen=True)
class Figures:
    """Of one axis; rms values in m, rad, m/s, rad/s. ``velocity``: error, ``velocity_sd``: what the filter says of it,
    ``smoothed``: that of Savitzky and Golay. ``nis`` a sample; ``inside``: share of the blocks whose NIS is in its 95 %
    band. ``predicted``, ``held``: errors of the pose."""

    velocity: float
    velocity_sd: float
    smoothed: float
    nis: float
    inside: float
    predicted: float
    held: float


def figures(results: Iterable[Result]) -> list[Figures]:
    results = list(results)
    low, high = (float(chi2.ppf(p, BLOCK)) for p in (0.025, 0.975))
    out = []
    for axis in range(3):
        velocity, velocity_sd, smoothed, squares, predicted, held = (
            np.concatenate([getattr(result, name)[:, axis] for result in results])
            for name in ('velocity', 'velocity_sd', 'smoothed', 'squares', 'predicted', 'held')
        )
        inside = float(np.mean((squares > low) & (squares < high)))
        nis = float(squares.mean()) / BLOCK
        out.append(Figures(rms(velocity), rms(velocity_sd), rms(smoothed), nis, inside, rms(predicted), rms(held)))
    return out


def by_frequency(results: Iterable[Result]) -> list[float]:
    """Largest ratio of predicted to held rms error over the bands of a chirp up to the mode, of each axis."""
    results = list(results)
    out = []
    for axis in range(3):
        ratios = []
        # From 0.5 Hz to 1.2 times the mode, evenly in time.
        below = math.floor(BANDS * (1.0 - 0.5 / MODES[axis][0]) / (1.2 - 0.5 / MODES[axis][0]))
        for band in range(below):
            predicted, held = (
                np.concatenate([np.array_split(getattr(r, name)[:, axis], BANDS)[band] for r in results])
                for name in ('predicted', 'held')
            )
            ratios.append(rms(predicted) / rms(held))
        out.append(max(ratios))
    return out


def table(by_kind: Mapping[str, list[Figures]]) -> str:
    rows = ['| motion | axis | velocity | own | / own | / Savitzky-Golay | NIS | inside | predicted | held |']
    rows.append('|---' * 10 + '|')
    for kind, axes in by_kind.items():
        for name, f in zip(AXES, axes, strict=True):
            unit, micro = ('mm/s', 'µm') if name != 'theta' else ('mrad/s', 'µrad')
            ratio = f.velocity / f.velocity_sd
            cells = [f'{f.velocity * 1e3:.3f} {unit}', f'{f.velocity_sd * 1e3:.3f}', f'{ratio:.2f}']
            cells += [f'{f.velocity / f.smoothed:.3f}', f'{f.nis:.3f}', f'{f.inside:.1%}']
            errors = f'{f.predicted * 1e6:.1f} {micro} | {f.held * 1e6:.1f} |'
            rows.append(' | '.join([f'| {kind}', name, *cells, errors]))
    return '\n'.join(rows)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument('--runs', type=int, default=20, help='of each kind of motion')
    parser.add_argument('--seconds', type=float, default=23.0, help='of a run, the first three at rest')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--kinds', nargs='+', choices=(*KINDS, UNTOLD), default=(*KINDS, UNTOLD))
    parser.add_argument('--bias', type=float, default=0.0, help='share by which what is told of the base is too large')
    parser.add_argument('--late', type=int, default=0, help='it comes so many samples after its stamp')
    args = parser.parse_args()
    evaluated: dict[str, list[Result]] = {}
    for kind in args.kinds:
        seeds = range(args.seed, args.seed + args.runs)
        runs = (biased(make(kind, args.seconds, seed), args.bias) for seed in watched(seeds, kind))
        evaluated[kind] = [evaluate(run, rig_of(), args.late) for run in runs]
    print(table({kind: figures(results) for kind, results in evaluated.items()}))
    if 'chirp' in evaluated:
        ratios = ', '.join(f'{a} {r:.2f}' for a, r in zip(AXES, by_frequency(evaluated['chirp']), strict=True))
        print(f'predicted / held at its worst up to the mode: {ratios}')
    for kind, results in evaluated.items():
        unseen = np.concatenate([r.unseen for r in results])
        inside = np.mean(np.abs(unseen[np.isfinite(unseen[:, 0])]) < 3.0, axis=0)
        shares = ', '.join(f'{a} {share:.1%}' for a, share in zip(AXES, inside, strict=True))
        print(f'{kind}: inside three standard deviations after {UNSEEN} ms without samples: {shares}')


if __name__ == '__main__':
    main()
