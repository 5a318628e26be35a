# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make bench``: the error of the estimates against the simulated truth, beside the lower bound for any method."""

import argparse

import numpy as np

from blind.generator import flat_dots
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.simulation.loads import constant, direct, sidebar
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.records import DeflectionEstimate, FloatArray, RawChunk
from psd_deflection.rig.config import Rig, load_rig

SETTLED_S = 10.0  # Time after the load step when the modes have decayed.
CASES = {'unloaded': (0.0, 0.0, 0.0)}
CASES |= {f'{f:g} N on the sidebar': sidebar(f) for f in (10.0, 30.0, 50.0)}
CASES |= {f'{f:g} N on the link': direct(f) for f in (10.0, 30.0, 50.0)}


def bound(rig: Rig, pose: FloatArray) -> FloatArray:
    """Least standard deviations of dX, dY (m) and theta (rad) of one block's mean."""
    steps = (1e-7, 1e-7, 1e-6)
    h = np.diag(steps)
    jacobian = ((flat_dots(pose + h) - flat_dots(pose - h)) / (2 * h.sum(axis=1, keepdims=True))).T
    variances = dot_noise_variances(rig) / rig.estimator.block_size
    information = (jacobian.T / variances) @ jacobian
    return np.asarray(np.sqrt(np.linalg.inv(information).diagonal()))


def errors(rig: Rig, load: tuple[float, float, float], blocks: int) -> tuple[FloatArray, FloatArray]:
    """Error of each estimate (n, 3) and the mean true pose (3,)."""
    rate, size = rig.converter.sample_rate_hz, rig.estimator.block_size
    skipped = round(SETTLED_S * rate / size) * size
    simulated = RigSimulator(rig, seed=1).step(constant(load, (skipped + blocks * size) / rate, rate).loads)
    counts, pose, pipeline = simulated.counts[skipped:], simulated.pose[skipped:], Pipeline(rig)
    seq = np.arange(len(counts))
    t_ns = np.rint(seq * 1e9 / rate).astype(np.int64)
    chunk = RawChunk(seq, t_ns, counts, np.zeros(len(seq), np.uint8), rig.converter.volts_per_count)
    records = [*pipeline.process(chunk), *pipeline.flush()]
    estimates = np.array([(r.dx, r.dy, r.theta) for r in records if isinstance(r, DeflectionEstimate) and r.primary])
    truth = pose.reshape(-1, size, 3).mean(axis=1)
    return estimates - truth[: len(estimates)], truth.mean(axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--blocks', type=int, default=5000, help='blocks of each load case')
    blocks = parser.parse_args().blocks
    rig = load_rig()
    print(f'rms error against the simulated truth, {blocks} blocks a load case; in brackets over the Cramér–Rao bound')
    unit, worst = np.array([1e6, 1e6, np.degrees(1e3)]), 0.0
    for name, load in CASES.items():
        error, pose = errors(rig, load, blocks)
        rms = np.sqrt((error**2).mean(axis=0))
        ratio = rms / bound(rig, pose)
        worst = max(worst, float(ratio.max()))
        cells = zip(('dX', 'dY', 'theta'), rms * unit, ratio, ('um', 'um', 'mdeg'), strict=True)
        print(f'  {name:20}' + ''.join(f'  {n} {v:.3f} {u} ({r:.2f})' for n, v, r, u in cells))
    print(f'  largest ratio {worst:.2f} (bound 1.1)')


if __name__ == '__main__':
    main()
