# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pictures of the page of identify."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.signal import welch

from psd_deflection.base.axes import SHOWN, SHOWN_UNITS, SYMBOLS
from psd_deflection.base.charts import SMALL, Chart, Colour, Panel, Rule, Series, TimeAxis
from psd_deflection.base.pages import table
from psd_deflection.model.link.shapers import KINDS, Shaper, shaper
from psd_deflection.recordings.charts import FROM_FIRST
from psd_deflection.records import FloatArray, Moment
from psd_deflection.studies.identify.spectra import AxisModes
from psd_deflection.studies.study import PageSection

MEASURED: Final = 'blue'
FITTED: Final = 'red'
TONES: tuple[Colour, ...] = ('blue', 'red', 'green', 'violet')


@dataclass(frozen=True)
class DrawnModes:
    """What is drawn: ``poses`` (n, 3), their ``rate``, Hz, ``marks``, modes and recommended shapers of each axis."""

    poses: FloatArray
    rate: float
    marks: Sequence[Moment]
    axes: Sequence[AxisModes]
    shapers: Sequence[Shaper | None]


def sections(drawn: DrawnModes) -> list[PageSection]:
    """Return the page below the sentences."""
    out = [PageSection('Spectra', (_spectra(drawn),))]
    if any(a.stretches for a in drawn.axes):
        out.append(PageSection('Ring-downs', (_ring_downs(drawn),)))
    if any(a.modes for a in drawn.axes):
        words = (
            '<p class=quiet>Share of the vibration that is left if the frequency is another. '
            'The recommended one is the shortest that leaves at most 5 % about the mode.</p>'
        )
        rows = table(('axis', 'shaper', 'longer by, ms', 'impulses'), _shaper_rows(drawn))
        out.append(PageSection('Input shapers', (words, _shapers(drawn), rows)))
    return out


def _shaper_rows(drawn: DrawnModes) -> list[tuple[str, str, str, str]]:
    rows = []
    for i, axis in enumerate(drawn.axes):
        if not axis.modes:
            continue
        best = drawn.shapers[i]
        for kind in KINDS:
            impulses = shaper(kind, axis.modes[0].frequency, axis.modes[0].damping)
            name = kind.upper() + (' (recommended)' if best is not None and best.name == kind else '')
            pairs = ', '.join(
                f'{s:.4f} at {1e3 * t:.2f} ms' for t, s in zip(impulses.times, impulses.sizes, strict=True)
            )
            rows.append((SYMBOLS[i], name, f'{1e3 * impulses.duration:.1f}', pairs))
    return rows


def _spectra(drawn: DrawnModes) -> Chart:
    panels = []
    for i, axis in enumerate(drawn.axes):
        samples = drawn.poses[:, i]
        there = np.flatnonzero(np.isfinite(samples))
        filled = np.interp(np.arange(len(samples)), there, samples[there])
        f, p = welch(filled, drawn.rate, nperseg=min(len(filled), int(8 * drawn.rate)))
        shown = (f > 0.3) & (f < 0.25 * drawn.rate)
        curve = Series('', f[shown], SHOWN[i] * np.sqrt(p[shown]), MEASURED)
        rules = [Rule(mode.frequency, f'{mode.frequency:.3f} Hz', colour=FITTED) for mode in axis.modes]
        label = f'{SYMBOLS[i]} / {SHOWN_UNITS[i]}/√Hz'
        panels.append(Panel((curve,), 'frequency / Hz', label, log='x, y', rules=rules, height=180))
    return Chart('spectrum of each axis with its modes', panels)


def _ring_downs(drawn: DrawnModes) -> Chart:
    panels = []
    for i, modes in enumerate(drawn.axes):
        if not modes.stretches:
            continue
        first, last = max(
            modes.stretches, key=lambda s: np.nanmax(np.abs(modes.fitted[s[0] : s[1]] - modes.fitted[s[1] - 1]))
        )
        t = np.arange(first, last) / drawn.rate
        curves = (
            Series('samples', t, SHOWN[i] * drawn.poses[first:last, i], MEASURED, 'points'),
            Series('fit', t, SHOWN[i] * modes.fitted[first:last], FITTED),
        )
        along = TimeAxis(FROM_FIRST, drawn.marks, SYMBOLS[i])
        panels.append(Panel(curves, along, f'{SYMBOLS[i]} / {SHOWN_UNITS[i]}', height=180))
    return Chart('the largest ring-down of each axis and its fit', panels)


def _shapers(drawn: DrawnModes) -> Chart:
    panels = []
    for i, axis in enumerate(drawn.axes):
        if not axis.modes:
            continue
        mode, best = axis.modes[0], drawn.shapers[i]
        f = np.linspace(0.6 * mode.frequency, 1.4 * mode.frequency, 300)
        curves = []
        for kind, tone in zip(KINDS, TONES, strict=True):
            residual = shaper(kind, mode.frequency, mode.damping).residual(f, mode.damping)
            bold = best is not None and best.name == kind
            curves.append(Series(kind.upper(), f, 100.0 * residual, tone, bold=bold))
        rules = (Rule(mode.frequency),)
        panels.append(Panel(curves, f'{SYMBOLS[i]}: frequency / Hz', 'vibration left / %', rules=rules, height=SMALL))
    return Chart('what is left of the vibration over the frequency, for each shaper', panels, beside=3)
