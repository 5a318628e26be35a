# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page of a recording: one file with its data, drawn by the scripts of the live page."""

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

import psd_deflection.run.monitor
from psd_deflection import __version__
from psd_deflection.base.charts import CHARTS, UPLOT, UPLOT_STYLE, joined, packed, safe, text
from psd_deflection.records import AppliedLoad, FloatArray, Mark, ReferencePose, dot_names
from psd_deflection.rig.config import Rig

PAGE = Path(psd_deflection.run.monitor.__file__).parent / 'page'
STYLES = (UPLOT_STYLE, PAGE / 'style.css', PAGE / 'recording.css')

KEYS = {
    'shift': (('ΔX', 'dx', 1, True), ('ΔY', 'dy', 4, True)),
    'theta': (('θ', 'theta', 1, True),),
    'load': (('Fx', 'dx', 1, False), ('Fy', 'dy', 2, False), ('Tz', 'theta', 3, False)),
}
"""For each plot: words, colour, series and whether it has a band."""


def _keys(psds: int) -> dict[str, tuple[tuple[str, str, int, bool], ...]]:
    """``KEYS`` and those of so many PSDs."""
    colors = ('dx', 'dy', *(f'x{n}' for n in range(3, psds + 1)))
    sums = tuple((f'sum {n}', color, n, False) for n, color in enumerate(colors, start=1))
    dots = tuple((name, name, i, False) for i, name in enumerate(dot_names(psds), start=1))
    return {**KEYS, 'sums': sums, 'spectrum': dots}


CAPTIONS = {
    'shift': 'µm, band ±2 sd',
    'theta': 'mdeg, band ±2 sd',
    'load': 'known load, N and N·m',
    'sums': 'V',
    'spectrum': 'µm/√Hz over Hz',
}


class DrawnInputs(NamedTuple):
    """Inputs of the recording: known loads, references, when the zero was taken (ns), and marks.

    ``start_ns``: the time from which the page counts.
    """

    loads: list[AppliedLoad]
    references: list[ReferencePose]
    zeros: list[int]
    start_ns: int
    marks: Sequence[Mark] = ()

    def seconds(self, t_ns: int) -> float:
        """A time on the page, s."""
        return (t_ns - self.start_ns) / 1e9

    def content(self, end: float) -> dict[str, object]:
        """For the page's script; the last load is held until ``end``, s."""
        loads, references = self.loads, self.references
        marks: list[tuple[float, list[object]]] = [
            (self.seconds(load.t_ns), ['load', load.fx, load.fy, load.tz]) for load in loads
        ]
        marks += [(self.seconds(z), ['zero']) for z in self.zeros]
        marks += [(self.seconds(mark.t_ns), ['mark', mark.text]) for mark in self.marks]
        held: dict[str, str] = {}
        if loads:
            times = [self.seconds(load.t_ns) for load in loads]
            held['t'] = packed([*times, max(end, times[-1])], np.float64)
            for i, name in enumerate(('fx', 'fy', 'tz'), start=1):
                held[name] = packed([load[i] for load in (*loads, loads[-1])])
        poses = enumerate(('dx', 'dy', 'theta'), start=1)
        return {
            'marks': [[t, *words] for t, words in sorted(marks, key=lambda mark: mark[0])],
            'loads': held,
            'references': {
                't': packed([self.seconds(r.t_ns) for r in references], np.float64),
                **{name: packed([r[i] for r in references]) for i, name in poses},
            },
        }


def plot_page(
    title: str,
    table: Mapping[str, FloatArray],
    spectrum: tuple[FloatArray, FloatArray] | None,
    inputs: DrawnInputs,
    rig: Rig,
    summary: Sequence[tuple[str, str]],
) -> str:
    """The page as text.

    ``table``: as ``Drawn.table`` makes it. ``spectrum``: frequencies (k,) Hz and densities (2P, k)
    m/sqrt(Hz). ``summary``: names and values for its table.
    """
    content = {
        'columns': {n: packed(v, np.float64 if n == 't' else np.float32) for n, v in table.items()},
        **inputs.content(float(table['t'][-1])),
        'spectrum': None
        if spectrum is None
        else {'f': packed(spectrum[0]), 'density': [packed(row) for row in spectrum[1]]},
        'modes': [['bending', rig.dynamics.bending_frequency], ['torsion', rig.dynamics.torsion_frequency]],
        'active_areas': [psd.active_area for psd in rig.psds],
        'sum_nominal': rig.amplifier.sum_nominal,
    }
    keys = _keys(len(rig.psds))
    shown = [name for name in keys if (name != 'load' or inputs.loads) and (name != 'spectrum' or spectrum is not None)]
    rows = ''.join(f'<tr><th scope="row">{html.escape(k)}</th><td>{html.escape(v)}</td></tr>' for k, v in summary)
    detectors = ''.join(
        f'<figure class="detector"><figcaption>PSD {n}</figcaption>'
        f'<canvas role="img" aria-label="dots on the active area of PSD {n}"></canvas></figure>'
        for n in range(1, len(rig.psds) + 1)
    )
    name = html.escape(title)
    figures = ''.join(_figure(plot, keys[plot]) for plot in shown)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{name}</title><style>{"".join(map(text, STYLES))}</style></head><body>'
        f'<header><div class="title"><h1>{name}</h1> <span id="range" class="quiet"></span></div><div class="tools">'
        '<span class="quiet">drag over a trace to look closer</span>'
        '<button id="whole" type="button" aria-disabled="true">All of it</button></div></header>'
        f'<main class="drawn"><section class="traces" aria-label="traces">{figures}</section>'
        f'<section class="side" aria-label="summary"><div class="detectors">{detectors}</div>'
        f'<div class="card"><h2>Summary</h2><table>{rows}</table><p class="quiet">psd_deflection {__version__}; '
        f'<code>psd-deflection plot {name}</code></p></div></section></main>'
        f'<noscript>This page draws with JavaScript.</noscript>'
        f'<script type="application/json" id="recording">{safe(json.dumps(content))}</script>'
        f'<script>{text(UPLOT)}</script>'
        f'<script type="module">{joined(CHARTS, PAGE / "recording.js")}</script></body></html>\n'
    )


def _figure(name: str, shown: Sequence[tuple[str, str, int, bool]]) -> str:
    keys = ' '.join(
        f'<button type="button" class="key c-{color}" data-plot="{name}" data-series="{series}"'
        f'{" data-band" if band else ""} aria-pressed="true">{words} <output></output></button>'
        for words, color, series, band in shown
    )
    more = '<span class="quiet references" hidden>○ reference</span>' if name in ('shift', 'theta') else ''
    lost = '<span class="key c-bad">lost samples</span>' if name == 'theta' else ''
    unit = ' data-unit="Hz"' if name == 'spectrum' else ''
    size = {'shift': ' tall', 'sums': ' short', 'load': ' short'}.get(name, '')
    return (
        f'<figure class="plot{size}"><figcaption>{keys} <span class="quiet">{CAPTIONS[name]}</span> {more}{lost}'
        f'<output class="at quiet right" data-plot="{name}"{unit}></output></figcaption>'
        f'<div id="plot_{name}"></div></figure>'
    )
