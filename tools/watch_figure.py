# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw docs/figures/watch.png: three events and when they are seen. ``python -m tools.watch_figure [FILE]``."""

from __future__ import annotations

import sys

import numpy as np
from matplotlib.figure import Figure

from blind.generator import MM_PER_V
from blind.watch import BLOCK, HELD_FROM_S, RATE, SIZES, Chain, happened

SEED = 4
CHANNELS = {'x1': 0, 'y1': 1, 'x2': 3, 'y2': 4}


def main() -> int:
    """Draw the figure."""
    target = sys.argv[1] if len(sys.argv) > 1 else 'docs/figures/watch.png'
    figure = Figure(figsize=(10, 3.2), layout='constrained')
    axes = figure.subplots(1, len(SIZES))
    held = round(HELD_FROM_S * RATE)
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
    return 0


if __name__ == '__main__':
    sys.exit(main())
