# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw docs/figures/motion.png: a switched load and a lost laser. ``python -m tools.motion_figure [FILE]``."""

from __future__ import annotations

import sys

import matplotlib as mpl

mpl.use('Agg')
import matplotlib.pyplot as plt
import numpy as np
from scipy.signal import savgol_filter

from blind import motion
from blind.generator import RATE
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import TipMotion

STEP, DARK, END = 3.095, (3.4, 3.6), 3.8
"""s: when the load is switched, when laser 2 is off, the end."""


def main() -> None:
    """Write the picture."""
    target = sys.argv[1] if len(sys.argv) > 1 else 'docs/figures/motion.png'
    loads = np.zeros((int(END * RATE), 3))
    loads[int(STEP * RATE) :, 0] = 10.0
    run = motion.run_of(loads, 1)
    dark = slice(*(int(t * RATE) for t in DARK))
    means = motion.pose_of(run.volts).reshape(-1, motion.BLOCK, 3).mean(axis=1)
    run.volts[dark, 3:] = 0.0
    pipeline = Pipeline(motion.rig_of())
    moved = [
        record
        for block in range(len(loads) // motion.BLOCK)
        for record in pipeline.process(motion.chunk(run, block))
        if isinstance(record, TipMotion)
    ]
    t = np.arange(len(loads)) / RATE
    at = np.array([m.t_ns for m in moved]) / 1e9
    middle = (np.arange(len(means)) + 0.5) * motion.BLOCK / RATE
    slope = savgol_filter(means[:, 0], 5, 3, deriv=1, delta=motion.BLOCK / RATE)
    figure, (above, below) = plt.subplots(2, 1, figsize=(8.0, 5.2), sharex=True, layout='constrained')
    rows = (
        (
            above,
            run.velocity[:, 0],
            [m.vx for m in moved],
            [m.velocity_covariance[0] for m in moved],
            'mm/s',
        ),
        (below, run.pose[:, 0], [m.dx for m in moved], [m.covariance[0] for m in moved], 'mm'),
    )
    for axes, truth, found, variance, label in rows:
        axes.plot(t, truth * 1e3, color='0.4', linewidth=1.0, label='truth')
        axes.errorbar(at, np.array(found) * 1e3, 3e3 * np.sqrt(variance), fmt='.', capsize=2, label='filter, ±3 sd')
        axes.axvspan(*DARK, color='0.92', label='laser 2 off')
        axes.set(ylabel=f'ΔX ({label})', xlim=(3.05, END))
        axes.grid(alpha=0.3)
    above.plot(middle, slope * 1e3, '--', color='tab:red', linewidth=0.9, label='Savitzky-Golay, block means')
    above.legend(ncols=2, fontsize=8)
    below.set(xlabel='time (s)')
    figure.savefig(target, dpi=120)


if __name__ == '__main__':
    main()
