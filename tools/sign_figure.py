# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw docs/figures/sign_convention.png: the positive directions. ``python tools/sign_figure.py [FILE]``."""

from __future__ import annotations

import sys
from typing import Any

import matplotlib as mpl

mpl.use('Agg')
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, FancyArrowPatch, Rectangle

_BLUE, _ORANGE, _GREEN, _RED, _GREY = '#1f6fb4', '#e07b1a', '#2f9455', '#c23b3b', '#777777'


def _arrow(ax: Any, start: tuple[float, float], end: tuple[float, float], color: str, **options: Any) -> None:
    ax.add_patch(FancyArrowPatch(start, end, arrowstyle='-|>', mutation_scale=12, color=color, **options))


def sign_convention() -> Figure:
    """Plate, PSDs and beams, and the positive direction of each quantity."""
    figure, (front, side, top) = plt.subplots(1, 3, figsize=(9.6, 4.2), width_ratios=(1.35, 1, 1), layout='constrained')
    for ax in (front, side, top):
        ax.set_aspect('equal')
        ax.axis('off')
    theta = np.radians(14.0)
    d = np.array([22.0, -16.0])
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    centers = np.array([[0.0, 70.0], [-100.0, 0.0]])
    front.add_patch(Circle((0, 0), 13, fill=False, color=_GREY, ls='--'))
    front.add_patch(Circle(tuple(d), 13, fill=False, color=_BLUE, lw=1.5))
    for i, c in enumerate(centers):
        front.add_patch(Rectangle(tuple(c - 15), 30, 30, fill=False, color=_GREY, ls='--'))
        moved = turn @ c + d
        corners = (turn @ np.array([[-15, 15, 15, -15, -15], [-15, -15, 15, 15, -15]])).T + moved
        front.plot(*corners.T, color=_BLUE, lw=1.5)
        front.plot(*zip(d, moved, strict=True), color=_BLUE, lw=0.8)
        front.plot(*c, 'o', color=_RED, ms=7)
        front.annotate(f'beam {i + 1}, PSD {i + 1}', c, (c[0] - 18, c[1] + 24), color=_RED)
    _arrow(front, (0, 0), (55, 0), 'black')
    _arrow(front, (0, 0), (0, 45), 'black')
    front.text(57, -3, 'X')
    front.text(-12, 40, 'Y')
    _arrow(front, (0, 0), (d[0], d[1]), _GREEN, lw=2)
    front.text(d[0] + 16, d[1] - 6, '(dX, dY)', color=_GREEN)
    front.add_patch(Arc(tuple(d), 70, 70, theta1=90, theta2=90 + np.degrees(theta), color=_ORANGE, lw=2))
    front.plot([d[0], d[0]], [d[1], d[1] + 44], color=_ORANGE, lw=0.8, ls=':')
    front.text(d[0] + 4, d[1] + 32, '+theta', color=_ORANGE)
    front.set(xlim=(-135, 85), ylim=(-72, 120))
    front.set_title(
        'from beyond the tip, looking at the base\n(Z towards you; from the lasers, +theta is clockwise)', fontsize=9
    )
    for ax, axis, angle, title in (
        (side, 'Y', 'phi', 'from the side: +phi leans\nthe tip towards -Y'),
        (top, 'X', 'omega', 'from above: +omega leans\nthe tip towards +X'),
    ):
        z = np.linspace(0, 100, 50)
        sag = (-1 if axis == 'Y' else 1) * 28 * (z / 100) ** 2 * (3 - z / 100) / 2
        ax.plot(z, 0 * z, color=_GREY, ls='--')
        ax.plot(z, sag, color=_BLUE, lw=2.5)
        slope = (sag[-1] - sag[-2]) / (z[-1] - z[-2])
        out = np.array([1.0, slope]) / np.hypot(1.0, slope)
        tip = np.array([100.0, sag[-1]])
        plate = np.outer([-1.0, 1.0], [-out[1], out[0]]) * 26 + tip
        ax.plot(*plate.T, color=_BLUE, lw=4)
        _arrow(ax, (100, 0), (130, 0), _GREY, ls='--')
        _arrow(ax, (tip[0], tip[1]), (tip[0] + 30 * out[0], tip[1] + 30 * out[1]), _ORANGE, lw=2)
        ax.text(tip[0] + 33, tip[1] + 26 * slope, f'+{angle}', color=_ORANGE)
        _arrow(ax, (100, 0), (100, sag[-1]), _GREEN, lw=2)
        ax.text(68, sag[-1] * 0.9 + 5, f'd{axis} {"<" if axis == "Y" else ">"} 0', color=_GREEN)
        _arrow(ax, (0, 0), (0, 32), 'black')
        ax.text(-3, 36, axis)
        ax.text(134, -3, 'Z')
        ax.plot([0, 112], [20 if axis == 'Y' else -22] * 2, color=_RED, lw=1)
        ax.text(4, 23 if axis == 'Y' else -19, 'beam', color=_RED)
        ax.set(xlim=(-12, 150), ylim=(-62, 62))
        ax.set_title(title, fontsize=9)
    return figure


def main() -> None:
    """Write the picture."""
    target = sys.argv[1] if len(sys.argv) > 1 else 'docs/figures/sign_convention.png'
    # No date or version in the file: the same figure is the same bytes.
    with plt.rc_context({'figure.dpi': 110, 'font.size': 9}):
        sign_convention().savefig(target, metadata={'Software': None})


if __name__ == '__main__':
    main()
