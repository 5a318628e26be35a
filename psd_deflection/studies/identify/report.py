"""The page and the JSON of ``psd-deflection identify``."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import welch

from psd_deflection.arms.shapers import KINDS, Shaper, recommended, shaper
from psd_deflection.base.pages import page, picture, table
from psd_deflection.records import FloatArray
from psd_deflection.studies.identify.modes import AxisModes

AXES = ('dx', 'dy', 'theta')
SYMBOLS = ('ΔX', 'ΔY', 'θ')
UNITS = ('m', 'm', 'rad')
SHOWN = (1e6, 1e6, math.degrees(1e3))
SHOWN_UNITS = ('µm', 'µm', 'mdeg')
MEASURED, FITTED, MARK = '#4c72b0', '#c44e52', '#555555'
DRAWN = 6000


@dataclass(frozen=True)
class Identified:
    """``poses`` (n, 3) of single samples, NaN if lost; ``rate``, Hz; ``axes``: the modes of dX, dY, theta."""

    poses: FloatArray
    rate: float
    axes: tuple[AxisModes, AxisModes, AxisModes]

    @property
    def values(self) -> dict[str, float]:
        """Parameters of the rig file. Bending is the surer of X and Y, for which the file has one value."""
        out: dict[str, float] = {}
        bending = [m for a in self.axes[:2] for m in a.modes[:1]]
        for name, modes in (('bending', bending), ('torsion', list(self.axes[2].modes[:1]))):
            if modes:
                best = min(modes, key=lambda m: m.frequency_sd / m.frequency)
                out[f'dynamics.{name}_frequency'] = float(f'{best.frequency:.8g}')
                out[f'dynamics.{name}_damping_ratio'] = float(f'{best.damping:.6g}')
        return out

    def shaper_of(self, axis: int) -> Shaper | None:
        """The shaper that is recommended for the loudest mode of an axis; None if it has none."""
        if not self.axes[axis].modes:
            return None
        mode = self.axes[axis].modes[0]
        return recommended(mode.frequency, mode.frequency_sd, mode.damping)


def sentences(found: Identified) -> list[str]:
    """One line for each mode, and the shaper."""
    out = []
    for i, axis in enumerate(found.axes):
        if not axis.modes:
            out.append(f'{SYMBOLS[i]}: no mode stands out of the noise. Knock on the link, or release a load.')
            continue
        how = f'{len(axis.stretches)} ring-downs' if axis.how == 'ring-down' else 'the spectrum in operation'
        for mode in axis.modes:
            out.append(
                f'{SYMBOLS[i]}: {_pm(mode.frequency, mode.frequency_sd)} Hz, damping ratio '
                f'{_pm(mode.damping, mode.damping_sd)} (95 %), '
                f'{SHOWN[i] * mode.amplitude:.1f} {SHOWN_UNITS[i]}, from {how}'
            )
        best = found.shaper_of(i)
        if best is not None:
            pairs = ', '.join(f'{s:.4f} at {1e3 * t:.1f} ms' for t, s in zip(best.times, best.sizes, strict=True))
            out.append(f'{SYMBOLS[i]}: input shaper {best.name.upper()}: {pairs}')
    return out


def _pm(value: float, sd: float) -> str:
    """Value and 95 % interval, with two digits of the latter."""
    half = 1.96 * sd
    digits = min(max(1 - math.floor(math.log10(half)), 0), 9) if 0.0 < half < math.inf else 6
    return f'{value:.{digits}f} ± {half:.{digits}f}'


def as_json(found: Identified) -> dict[str, Any]:
    """``identify.json``, SI units."""
    axes: dict[str, Any] = {}
    for i, name in enumerate(AXES):
        axis, best = found.axes[i], found.shaper_of(i)
        axes[name] = {
            'unit': UNITS[i],
            'how': axis.how,
            'noise': axis.noise,
            'stretches': [[a / found.rate, b / found.rate] for a, b in axis.stretches],
            'modes': [
                {
                    'frequency': m.frequency,
                    'frequency_sd': m.frequency_sd,
                    'damping_ratio': m.damping,
                    'damping_ratio_sd': m.damping_sd,
                    'amplitude': m.amplitude,
                }
                for m in axis.modes
            ],
            'shaper': None if best is None else {'name': best.name, 'times': best.times, 'sizes': best.sizes},
        }
    return {'axes': axes, 'parameters': found.values}


def report_html(found: Identified, sources: Mapping[str, str]) -> str:
    """The page, pictures inside. ``sources``: what it was made from, by name."""
    body = ['<h1>Modes of the link</h1>']
    body += [f'<p class=verdict>{html.escape(text)}</p>' for text in sentences(found)]
    body += ['<h2>Spectra</h2>', picture(_spectra(found), 'spectrum of each axis with its modes')]
    if any(a.stretches for a in found.axes):
        body += ['<h2>Ring-downs</h2>', picture(_ring_downs(found), 'ring-downs and their fits')]
    if any(a.modes for a in found.axes):
        body += [
            '<h2>Input shapers</h2>',
            '<p class=quiet>Share of the vibration that is left if the frequency is another. '
            'The recommended one is the shortest that leaves at most 5 % about the mode.</p>',
            picture(_shapers(found), 'what is left of the vibration over the frequency, for each shaper'),
            table(('axis', 'shaper', 'longer by, ms', 'impulses'), _shaper_rows(found)),
        ]
    body += ['<h2>Made from</h2>', table(('what', 'from'), list(sources.items()))]
    return page('psd-deflection identify', body)


def _shaper_rows(found: Identified) -> list[tuple[str, str, str, str]]:
    rows = []
    for i, axis in enumerate(found.axes):
        if not axis.modes:
            continue
        best = found.shaper_of(i)
        for kind in KINDS:
            one = shaper(kind, axis.modes[0].frequency, axis.modes[0].damping)
            name = kind.upper() + (' (recommended)' if best is not None and best.name == kind else '')
            pairs = ', '.join(f'{s:.4f} at {1e3 * t:.2f} ms' for t, s in zip(one.times, one.sizes, strict=True))
            rows.append((SYMBOLS[i], name, f'{1e3 * one.duration:.1f}', pairs))
    return rows


def _spectra(found: Identified) -> Figure:
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


def _ring_downs(found: Identified) -> Figure:
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


def _shapers(found: Identified) -> Figure:
    figure = Figure(figsize=(10, 3.4), layout='constrained')
    for i, axis in enumerate(figure.subplots(1, 3, sharey=True)):
        axis.set_xlabel(f'{SYMBOLS[i]}: frequency / Hz')
        axis.grid(alpha=0.25)
        if not found.axes[i].modes:
            continue
        mode = found.axes[i].modes[0]
        best = found.shaper_of(i)
        f = np.linspace(0.6 * mode.frequency, 1.4 * mode.frequency, 300)
        for kind in KINDS:
            thick = 2.2 if best is not None and best.name == kind else 0.9
            left = shaper(kind, mode.frequency, mode.damping).residual(f, mode.damping)
            axis.plot(f, 100.0 * left, lw=thick, label=kind.upper())
        axis.axvline(mode.frequency, color=MARK, lw=0.8, ls='--')
        axis.legend(frameon=False, fontsize=8)
    figure.supylabel('vibration left / %')
    return figure
