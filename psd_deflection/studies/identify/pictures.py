"""The pictures of the page of identify."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import welch

from psd_deflection.arms.shapers import KINDS, Shaper, shaper
from psd_deflection.base.pages import picture, table
from psd_deflection.records import FloatArray
from psd_deflection.studies.axes import SHOWN, SHOWN_UNITS, SYMBOLS
from psd_deflection.studies.identify.axis_modes import AxisModes
from psd_deflection.studies.study import PageSection

MEASURED, FITTED, MARK = '#4c72b0', '#c44e52', '#555555'
DRAWN = 6000


@dataclass(frozen=True)
class DrawnModes:
    """What is drawn: ``poses`` (n, 3), their ``rate``, Hz, modes and recommended shapers of each axis."""

    poses: FloatArray
    rate: float
    axes: Sequence[AxisModes]
    shapers: Sequence[Shaper | None]


def sections(found: DrawnModes) -> list[PageSection]:
    """The page below the sentences."""
    out = [PageSection('Spectra', (picture(_spectra(found), 'spectrum of each axis with its modes'),))]
    if any(a.stretches for a in found.axes):
        out.append(PageSection('Ring-downs', (picture(_ring_downs(found), 'ring-downs and their fits'),)))
    if any(a.modes for a in found.axes):
        words = (
            '<p class=quiet>Share of the vibration that is left if the frequency is another. '
            'The recommended one is the shortest that leaves at most 5 % about the mode.</p>'
        )
        drawn = picture(_shapers(found), 'what is left of the vibration over the frequency, for each shaper')
        rows = table(('axis', 'shaper', 'longer by, ms', 'impulses'), _shaper_rows(found))
        out.append(PageSection('Input shapers', (words, drawn, rows)))
    return out


def _shaper_rows(found: DrawnModes) -> list[tuple[str, str, str, str]]:
    rows = []
    for i, axis in enumerate(found.axes):
        if not axis.modes:
            continue
        best = found.shapers[i]
        for kind in KINDS:
            one = shaper(kind, axis.modes[0].frequency, axis.modes[0].damping)
            name = kind.upper() + (' (recommended)' if best is not None and best.name == kind else '')
            pairs = ', '.join(f'{s:.4f} at {1e3 * t:.2f} ms' for t, s in zip(one.times, one.sizes, strict=True))
            rows.append((SYMBOLS[i], name, f'{1e3 * one.duration:.1f}', pairs))
    return rows


def _spectra(found: DrawnModes) -> Figure:
    figure = Figure(figsize=(10, 6.5), layout='constrained')
    for i, axis in enumerate(figure.subplots(3, 1, sharex=True)):
        samples = found.poses[:, i]
        there = np.flatnonzero(np.isfinite(samples))
        filled = np.interp(np.arange(len(samples)), there, samples[there])
        f, p = welch(filled, found.rate, nperseg=min(len(filled), int(8 * found.rate)))
        shown = (f > 0.3) & (f < 0.25 * found.rate)
        axis.loglog(f[shown], SHOWN[i] * np.sqrt(p[shown]), color=MEASURED, lw=0.9)
        for mode in found.axes[i].modes:
            axis.axvline(mode.frequency, color=FITTED, lw=1)
            axis.annotate(
                f'{mode.frequency:.3f} Hz', (mode.frequency, 0.9), xycoords=('data', 'axes fraction'), fontsize=9
            )
        axis.set_ylabel(f'{SYMBOLS[i]} / {SHOWN_UNITS[i]}/√Hz')
        axis.grid(alpha=0.25, which='both')
    axis.set_xlabel('frequency / Hz')
    return figure


def _ring_downs(found: DrawnModes) -> Figure:
    figure = Figure(figsize=(10, 7), layout='constrained')
    for i, axis in enumerate(figure.subplots(3, 1)):
        modes = found.axes[i]
        axis.set_ylabel(f'{SYMBOLS[i]} / {SHOWN_UNITS[i]}')
        axis.grid(alpha=0.25)
        if not modes.stretches:
            axis.text(0.5, 0.5, 'no ring-down', ha='center', va='center', transform=axis.transAxes, color=MARK)
            continue
        first, last = max(
            modes.stretches, key=lambda s: np.nanmax(np.abs(modes.fitted[s[0] : s[1]] - modes.fitted[s[1] - 1]))
        )
        last = min(last, first + DRAWN)
        t = np.arange(first, last) / found.rate
        axis.plot(t, SHOWN[i] * found.poses[first:last, i], '.', ms=2, color=MEASURED, label='samples')
        axis.plot(t, SHOWN[i] * modes.fitted[first:last], color=FITTED, lw=0.8, label='fit')
        axis.legend(loc='upper right', ncols=2, frameon=False)
    axis.set_xlabel('time / s')
    return figure


def _shapers(found: DrawnModes) -> Figure:
    figure = Figure(figsize=(10, 3.4), layout='constrained')
    for i, axis in enumerate(figure.subplots(1, 3, sharey=True)):
        axis.set_xlabel(f'{SYMBOLS[i]}: frequency / Hz')
        axis.grid(alpha=0.25)
        if not found.axes[i].modes:
            continue
        mode = found.axes[i].modes[0]
        best = found.shapers[i]
        f = np.linspace(0.6 * mode.frequency, 1.4 * mode.frequency, 300)
        for kind in KINDS:
            thick = 2.2 if best is not None and best.name == kind else 0.9
            left = shaper(kind, mode.frequency, mode.damping).residual(f, mode.damping)
            axis.plot(f, 100.0 * left, lw=thick, label=kind.upper())
        axis.axvline(mode.frequency, color=MARK, lw=0.8, ls='--')
        axis.legend(frameon=False, fontsize=8)
    figure.supylabel('vibration left / %')
    return figure
