# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw docs/figures/block_fit.png: what a block gives of a motion. ``python tools/block_fit_figure.py [FILE]``."""

from __future__ import annotations

import sys

import matplotlib as mpl

mpl.use('Agg')
import matplotlib.pyplot as plt
import numpy as np

from psd_deflection.measure.uncertainty.block_fit import basis

SIZE, RATE = 20, 1000.0


def gain(orders: int, frequency: np.ndarray) -> np.ndarray:
    """Of a motion at ``frequency``, Hz: its part that the fit of so many orders gives at the block's middle."""
    q = basis(SIZE)[:, :orders]
    s = np.arange(SIZE) - 0.5 * (SIZE - 1)
    # The middle's weights: even polynomials through the places, at 0.
    powers = np.stack([s**k for k in range(orders)], axis=1)
    weights = q @ (q.T @ powers) @ np.linalg.inv(powers.T @ powers)
    middle = weights[:, 0]
    return np.asarray(np.cos(2.0 * np.pi * np.outer(frequency, s) / RATE) @ middle)


def main() -> None:
    """Write the picture."""
    target = sys.argv[1] if len(sys.argv) > 1 else 'docs/figures/block_fit.png'
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


if __name__ == '__main__':
    main()
