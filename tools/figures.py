# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draws a picture of docs/figures: ``python -m tools.figures NAME [FILE]``, NAME of FIGURES."""

import sys

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.signal import savgol_filter

from blind import motion
from blind.campaign import chunk
from blind.generator import MM_PER_V, RATE
from blind.watch import BLOCK, HELD_FROM_S, SIZES, Chain, happened
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.uncertainty.block_fit import basis
from psd_deflection.records import TipMotion
from tools.program import ROOT


def gain(orders: int, frequency: np.ndarray) -> np.ndarray:
    """Of a motion at ``frequency``, Hz: its part that the fit of so many orders gives at the block's middle."""
    q = basis(BLOCK)[:, :orders]
    s = np.arange(BLOCK) - 0.5 * (BLOCK - 1)
    # The middle's weights: even polynomials through the places, at 0.
    powers = np.stack([s**k for k in range(orders)], axis=1)
    weights = q @ (q.T @ powers) @ np.linalg.inv(powers.T @ powers)
    middle = weights[:, 0]
    return np.asarray(np.cos(2.0 * np.pi * np.outer(frequency, s) / RATE) @ middle)


def block_fit(target: str) -> None:
    frequency = np.linspace(0.0, 120.0, 600)
    figure, axes = plt.subplots(figsize=(7.0, 3.6), layout='constrained')
    for orders, label in ((1, 'mean'), (3, 'poly, orders 0 to 2'), (5, 'poly, orders 0 to 4')):
        axes.plot(frequency, gain(orders, frequency), label=label)
    for mode, name in ((14.0, 'bending'), (21.0, 'torsion')):
        axes.axvline(mode, color='0.7', linewidth=0.8)
        axes.annotate(f'{name}\n{mode:g} Hz', (mode, -0.22), fontsize=8)
        print(f'{mode:g} Hz: mean {gain(1, np.array([mode]))[0]:.4f}, poly {gain(5, np.array([mode]))[0]:.6f}')
    axes.set(xlabel='motion (Hz)', ylabel='estimate over motion', ylim=(-0.3, 1.2), xlim=(0.0, 120.0))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(target, dpi=120)


STEP, DARK, END = 3.095, (3.4, 3.6), 3.8  # s: when the load is switched, when laser 2 is off, the end.


def switched(target: str) -> None:
    loads = np.zeros((int(END * RATE), 3))
    loads[int(STEP * RATE) :, 0] = 10.0
    run, dark = motion.run_of(loads, 1), slice(*(int(t * RATE) for t in DARK))
    means = motion.pose_of(run.volts).reshape(-1, motion.BLOCK, 3).mean(axis=1)
    run.volts[dark, 3:] = 0.0
    pipeline = Pipeline(motion.rig_of())
    moved = [
        record
        for block in range(0, len(loads), motion.BLOCK)
        for record in pipeline.process(chunk(run.volts[block : block + motion.BLOCK], block))
        if isinstance(record, TipMotion)
    ]
    t = np.arange(len(loads)) / RATE
    at = np.array([m.t_ns for m in moved]) / 1e9
    middle = (np.arange(len(means)) + 0.5) * motion.BLOCK / RATE
    slope = savgol_filter(means[:, 0], 5, 3, deriv=1, delta=motion.BLOCK / RATE)
    figure, (above, below) = plt.subplots(2, 1, figsize=(8.0, 5.2), sharex=True, layout='constrained')
    rows = (
        (above, run.velocity[:, 0], [m.vx for m in moved], [m.velocity_covariance[0] for m in moved], 'mm/s'),
        (below, run.pose[:, 0], [m.dx for m in moved], [m.covariance[0] for m in moved], 'mm'),
    )
    for axes, truth, filtered, variance, label in rows:
        axes.plot(t, truth * 1e3, color='0.4', linewidth=1.0, label='truth')
        axes.errorbar(at, np.array(filtered) * 1e3, 3e3 * np.sqrt(variance), fmt='.', capsize=2, label='filter, ±3 sd')
        axes.axvspan(*DARK, color='0.92', label='laser 2 off')
        axes.set(ylabel=f'ΔX ({label})', xlim=(3.05, END))
        axes.grid(alpha=0.3)
    above.plot(middle, slope * 1e3, '--', color='tab:red', linewidth=0.9, label='Savitzky-Golay, block means')
    above.legend(ncols=2, fontsize=8)
    below.set(xlabel='time (s)')
    figure.savefig(target, dpi=120)


SEED = 4
CHANNELS = {'x1': 0, 'y1': 1, 'x2': 3, 'y2': 4}


def events(target: str) -> None:
    figure = Figure(figsize=(10, 3.2), layout='constrained')
    axes, held = figure.subplots(1, len(SIZES)), round(HELD_FROM_S * RATE)
    for axis, (kind, size) in zip(axes, SIZES.items(), strict=True):
        load, volts, event = happened(kind, SEED)
        chain = Chain()
        chain.load((0.0, 0.0, 0.0))
        chain.feed(volts[:held])
        chain.load(load)
        chain.feed(volts[held:])
        alarm = chain.raised[0]
        channel = alarm.channel if alarm.channel in CHANNELS else alarm.also[0]
        means = volts[: len(volts) // BLOCK * BLOCK, CHANNELS[channel]].reshape(-1, BLOCK).mean(axis=1) * MM_PER_V
        t = (np.arange(len(means)) + 0.5) * BLOCK / RATE
        before = (t > event - 5.0) & (t < event)
        shown = (t > event - 5.0) & (t < event + 8.0)
        axis.plot(t[shown] - event, 1e6 * (means[shown] - means[before].mean()), '.', ms=2, color='tab:blue')
        axis.axvline(alarm.since_ns / 1e9 - event, color='black', ls=':', label='since')
        axis.axvline(alarm.observed_ns / 1e9 - event, color='tab:red', label='alarm')
        axis.set_title(f'{kind} of {size}', fontsize=10)
        axis.set_xlabel('time since the event / s')
        axis.set_ylabel(f'{channel} / µm')
        axis.grid(alpha=0.25)
    axes[0].legend(frameon=False)
    figure.savefig(target, dpi=110)


FIGURES = {'block_fit': block_fit, 'motion': switched, 'watch': events}


def main() -> int:
    name, *file = sys.argv[1:] or ['']
    if name not in FIGURES:
        print('NAME of', *FIGURES, file=sys.stderr)
        return 2
    FIGURES[name](file[0] if file else str(ROOT / 'docs' / 'figures' / f'{name}.png'))
    return 0


if __name__ == '__main__':
    sys.exit(main())
