"""The page and the JSON of ``psd-deflection validate``."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from psd_deflection.base.pages import page, picture, table
from psd_deflection.studies.validate.agreement import AXES, UNITS, Agreement, Validated

SYMBOLS = ('ΔX', 'ΔY', 'θ')
SHOWN = (1e6, 1e6, math.degrees(1e3))
SHOWN_UNITS = ('µm', 'µm', 'mdeg')
MEASURED, REFERENCE, DIFFERENCE, LIMIT = '#4c72b0', '#c44e52', '#333333', '#8c8c8c'
DRAWN = 4000
"""Points of a picture at most."""


def sentences(found: Validated, solver: str, refused: Mapping[str, int]) -> list[str]:
    """What a person wants to know first. ``refused``: references without an answer, by reason."""
    out = []
    if found.offset is not None:
        out.append(found.offset.sentence)
        if found.applied:
            out.append('The offset is removed in what follows.')
        elif found.offset.told and abs(found.offset.value) > 1.96 * found.offset.sd:
            out.append('It is not removed in what follows; --align removes it.')
    for i, name in enumerate(SYMBOLS):
        a = found.agreements[solver][i]
        text = (
            f'{name}: the estimate is {_pm(a.bias, a.bias_sd, i)} off on average; 95 % of the differences lie between '
            f'{SHOWN[i] * a.limits[0]:+.1f} and {SHOWN[i] * a.limits[1]:+.1f} {SHOWN_UNITS[i]}'
        )
        if math.isfinite(a.scale):
            text += f'; it is {100.0 * a.scale:+.3f} ± {196.0 * a.scale_sd:.3f} % larger'
        out.append(text + '.')
    if math.isfinite(found.covered[0]):
        cover = ', '.join(f'{n} {100.0 * c:.1f} %' for n, c in zip(SYMBOLS, found.covered, strict=True))
        out.append(f'Differences within 1.96 standard deviations of both instruments (95 % expected): {cover}.')
    total = len(found.t) + found.left_out
    if found.left_out:
        out.append(f'{found.left_out} of {total} references have no samples about them and are left out.')
    if refused:
        reasons = ', '.join(f'{reason} {count}' for reason, count in sorted(refused.items()))
        out.append(f'The reference gave no answer {sum(refused.values())} times: {reasons}.')
    return out


def _pm(value: float, sd: float, axis: int) -> str:
    return f'{SHOWN[axis] * value:+.2f} ± {196e-2 * SHOWN[axis] * sd:.2f} {SHOWN_UNITS[axis]}'


def rows(found: Validated) -> list[list[str]]:
    """The table of all solvers, its head first: errors as in Table 5.1 of the thesis, with bias, scale and noise."""
    out = [['solver', 'axis', 'unit', 'bias', 'scale %', 'noise', 'rms', 'largest', '% of deflection']]
    for name, three in found.agreements.items():
        for i, a in enumerate(three):
            out.append(
                [
                    name if i == 0 else '',
                    SYMBOLS[i],
                    SHOWN_UNITS[i],
                    f'{SHOWN[i] * a.bias:+.2f}',
                    f'{100.0 * a.scale:+.3f}' if math.isfinite(a.scale) else '-',
                    f'{SHOWN[i] * a.noise:.2f}',
                    f'{SHOWN[i] * a.rms:.2f}',
                    f'{SHOWN[i] * a.largest:.2f}',
                    f'{100.0 * a.share:.2f}' if math.isfinite(a.share) else '-',
                ]
            )
    return out


def as_json(found: Validated, solver: str, refused: Mapping[str, int]) -> dict[str, Any]:
    """``validate.json``, in SI units."""
    offset = found.offset
    return {
        'solver': solver,
        'references': len(found.t),
        'left_out': found.left_out,
        'refused': dict(refused),
        'offset': {
            'value': offset.value,
            'sd': offset.sd,
            'interval': list(offset.interval),
            'drift': offset.drift,
            'drift_sd': offset.drift_sd,
            'told': offset.told,
            'rivals': list(offset.rivals),
            'applied': found.applied,
            'unit': 's',
            'sentence': offset.sentence,
        },
        'solvers': {
            name: {axis: {'unit': unit, **_json(a)} for axis, unit, a in zip(AXES, UNITS, three, strict=True)}
            for name, three in found.agreements.items()
        },
        'covered': dict(zip(AXES, found.covered, strict=True)),
    }


def _json(a: Agreement) -> dict[str, Any]:
    return {
        'bias': a.bias,
        'bias_sd': a.bias_sd,
        'limits': list(a.limits),
        'scale': a.scale,
        'scale_sd': a.scale_sd,
        'noise': a.noise,
        'rms': a.rms,
        'largest': a.largest,
        'share': a.share,
    }


def report_html(found: Validated, solver: str, refused: Mapping[str, int], sources: Mapping[str, str]) -> str:
    """The page, pictures inside. ``sources``: what was compared, by name."""
    said = sentences(found, solver, refused)
    body = ['<h1>Estimate against reference</h1>']
    body.append(f'<p class=verdict>{html.escape(said[0])}</p>')
    body += [f'<p>{html.escape(text)}</p>' for text in said[1:]]
    head, *cells = rows(found)
    body += [
        '<h2>Every solver</h2>',
        '<p class=quiet>Estimate minus reference. The last column is the rms in percent of the largest deflection.</p>',
        table(head, cells),
    ]
    body += [
        '<h2>Over time</h2>',
        picture(_over_time(found, solver), 'estimate and reference over time, and differences'),
    ]
    body += [
        '<h2>Agreement</h2>',
        '<p class=quiet>Differences over means (Bland and Altman 1986): the lines are the bias and the limits '
        'within which 95 % of the differences lie.</p>',
        picture(_bland_altman(found, solver), 'differences over means'),
        '<h2>One against the other</h2>',
        picture(_scatter(found, solver), 'estimate over reference'),
        '<h2>What was compared</h2>',
        table(('what', 'from'), list(sources.items())),
    ]
    return page('psd-deflection validate', body)


def _thinned(found: Validated, solver: str) -> tuple[Any, Any, Any]:
    every = max(1, math.ceil(len(found.t) / DRAWN))
    return found.t[::every], found.estimates[solver][::every], found.reference[::every]


def _over_time(found: Validated, solver: str) -> Figure:
    t, estimate, reference = _thinned(found, solver)
    figure = Figure(figsize=(10, 8), layout='constrained')
    axes = figure.subplots(6, 1, sharex=True, height_ratios=[2, 1] * 3)
    for i in range(3):
        upper, lower = axes[2 * i], axes[2 * i + 1]
        upper.plot(t, SHOWN[i] * estimate[:, i], color=MEASURED, lw=0.9, label=f'estimate ({solver})')
        upper.plot(t, SHOWN[i] * reference[:, i], 'o', ms=2.5, mfc='none', color=REFERENCE, label='reference')
        upper.set_ylabel(f'{SYMBOLS[i]} / {SHOWN_UNITS[i]}')
        lower.plot(t, SHOWN[i] * (estimate - reference)[:, i], '.', ms=2, color=DIFFERENCE)
        lower.set_ylabel('difference')
        for axis in (upper, lower):
            axis.grid(alpha=0.25)
    axes[0].legend(loc='upper right', ncols=2, frameon=False)
    axes[-1].set_xlabel('time / s, by the clock of the samples')
    return figure


def _bland_altman(found: Validated, solver: str) -> Figure:
    _, estimate, reference = _thinned(found, solver)
    figure = Figure(figsize=(10, 3.6), layout='constrained')
    for i, axis in enumerate(figure.subplots(1, 3)):
        a = found.agreements[solver][i]
        mean = SHOWN[i] * 0.5 * (estimate + reference)[:, i]
        axis.plot(mean, SHOWN[i] * (estimate - reference)[:, i], '.', ms=3, color=MEASURED)
        axis.axhline(SHOWN[i] * a.bias, color=DIFFERENCE, lw=1)
        for limit in a.limits:
            axis.axhline(SHOWN[i] * limit, color=LIMIT, lw=1, ls='--')
        axis.set_xlabel(f'mean of both, {SYMBOLS[i]} / {SHOWN_UNITS[i]}')
        axis.set_ylabel(f'difference / {SHOWN_UNITS[i]}')
        axis.grid(alpha=0.25)
    return figure


def _scatter(found: Validated, solver: str) -> Figure:
    _, estimate, reference = _thinned(found, solver)
    figure = Figure(figsize=(10, 3.6), layout='constrained')
    for i, axis in enumerate(figure.subplots(1, 3)):
        axis.plot(SHOWN[i] * reference[:, i], SHOWN[i] * estimate[:, i], '.', ms=3, color=MEASURED)
        both = np.concatenate([reference[:, i], estimate[:, i]])
        ends = SHOWN[i] * np.array([np.nanmin(both), np.nanmax(both)])
        axis.plot(ends, ends, color=LIMIT, lw=1)
        axis.set_xlabel(f'reference {SYMBOLS[i]} / {SHOWN_UNITS[i]}')
        axis.set_ylabel(f'estimate / {SHOWN_UNITS[i]}')
        axis.grid(alpha=0.25)
    return figure
