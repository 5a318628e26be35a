# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The sections of the page of calibrate."""

from __future__ import annotations

import html
from typing import Any

import numpy as np

from psd_deflection.base.axes import MDEG
from psd_deflection.base.charts import ONE_AFTER_ANOTHER, Chart, Panel, Series, TimeAxis
from psd_deflection.base.drawings import Matrix
from psd_deflection.base.pages import table
from psd_deflection.model.misalignment.model import COUNT, ZERO
from psd_deflection.records import Moment
from psd_deflection.studies.calibrate.calibrate import Calibration
from psd_deflection.studies.calibrate.fit import CLOCK, NAMES, REPORTED, linearised
from psd_deflection.studies.calibrate.observation import CHANNEL_NAMES
from psd_deflection.studies.calibrate.progress import WORDS, in_words
from psd_deflection.studies.study import PageSection


def sections(found: Calibration) -> list[PageSection]:
    """The page below the sentence."""
    open_words = (
        '<p class=quiet>Left open: the standard deviation over that of the rig file or its tolerance; 1: nothing was '
        'learnt, and the file keeps its value.</p>'
    )
    todo = ''.join(f'<li>{html.escape(words)}</li>' for words in advice(found))
    return [
        PageSection('Before and after', (_residuals(found), _gap(found))),
        PageSection('Parameters', (open_words, _parameters(found), *_correlations(found))),
        PageSection('What these recordings cannot determine', (_undetermined(found),)),
        PageSection('Noise', (_noise(found),)),
        *([PageSection('Dark levels and other light', (_dark(found),))] if found.dark else []),
        PageSection('What to do next', (f'<ul>{todo}</ul>',)),
    ]


def advice(found: Calibration) -> list[str]:
    """What a person should do with the answer."""
    out = []
    if found.refused:
        out.append('Check the reference: its axes, units, signs and clock. The rig file was left as it is.')
    for name in found.widened:
        out.append(
            f'{name} is {in_words(NAMES.index(name), found.values[NAMES.index(name)])}: outside the tolerance of the '
            f'file. Look at the mount; if it is right, state the tolerance in the file.'
        )
    for name in found.dropped:
        out.append(f'{name}: unseen motion refuses it, so the file keeps its value.')
    out += [f'To determine {" with ".join(d.parts)}: {d.needs}.' for d in found.undetermined[:4]]
    if found.kind == 'loads':
        out.append(
            'Known loads know the scale of the gains no better than the stiffness of the link and its clamp: '
            'a reference separates them.'
        )
    if found.kind == 'self':
        out.append(
            'The redundant reading knows relative gains and turns only; take the zero (~/zero) with the new file.'
        )
    out.append('Use the file: --params-file rig.yaml. Later: psd-deflection calibrate --check rig.yaml REC.')
    return out


def _parameters(found: Calibration) -> str:
    rows = []
    for i in (*REPORTED, *range(ZERO, COUNT)):
        sd, before = float(found.sd[i]), float(found.prior.sd[i])
        words = (in_words(i, float(found.prior.mean[i]), before), in_words(i, float(found.values[i]), sd))
        rows.append((NAMES[i], WORDS[NAMES[i]], *words, f'{sd / before:.2g}' if before else ''))
    return table(('parameter', 'meaning', 'rig file', 'calibrated', 'left open'), rows)


def _gap(found: Calibration) -> str:
    g = found.gap
    rows = [
        ('all motion', f'{g.before * 1e6:.3f} µm', f'{g.after * 1e6:.3f} µm'),
        ('motion that was not fitted', f'{g.heldout_before * 1e6:.3f} µm', f'{g.heldout_after * 1e6:.3f} µm'),
    ]
    return table(('reading minus model, rms', 'before', 'after'), rows)


def _undetermined(found: Calibration) -> str:
    if not found.undetermined:
        return '<p>Nothing: every parameter is determined.</p>'
    rows = []
    for d in found.undetermined:
        parts = ', '.join(f'{name} {part:+.2f}' for name, part in d.parts.items())
        how = 'keeps the value and the tolerance of the file' if len(d.parts) == 1 else 'move together'
        rows.append((parts, how, d.needs))
    return table(('direction, in units of the tolerances', '', 'what would determine it'), rows)


def _noise(found: Calibration) -> str:
    rows = [(name, f'{v * 1e3:.3f} mV a sample') for name, v in zip(CHANNEL_NAMES, found.noise, strict=True)]
    if found.kind == 'reference':
        x, y, theta = found.fit.noise.reference
        rows.append(('reference', f'{x * 1e6:.2f} µm, {y * 1e6:.2f} µm, {theta * MDEG:.2f} mdeg a frame'))
        clock = found.clock + float(found.values[CLOCK])
        rows.append(('clock of the reference', f'add {clock * 1e3:.3f} ± {found.sd[CLOCK] * 1e3:.2g} ms to its times'))
        rows.append(('outliers of the reference', f'{int(np.sum(found.fit.weights == 0.0))} of {len(found.rows)}'))
    return table(('what', 'noise, 1 sd'), rows)


def _dark(found: Calibration) -> str:
    rows = []
    for one in found.dark:
        x, y = (f'{v:.5f} ± {sd:.1g}' for v, sd in zip(one.volts[:2], one.sd[:2], strict=True))
        sums = f'{one.volts[2]:.5f} ± {one.sd[2]:.1g}'
        file = ', '.join(f'{v:g}' for v in one.before)
        place = ', '.join(f'{v * 1e3:+.2f}' for v in one.place)
        rows.append((f'psd_{one.psd}', x, y, sums, file, f'{one.share:.3%}', place, f'{one.residual * 1e6:.2g}'))
    words = (
        'With its laser off each PSD shows the other light: the estimate is freed of it by x, y and sum together. The '
        'calibration above is that of the laser alone. Measure the dark levels again when the light has changed.'
    )
    head = (
        '',
        'x, V',
        'y, V',
        'sum, V',
        'rig file, V',
        'share of the light',
        'it pulls to, mm',
        'left at the edge, µm',
    )
    return f'<p class=quiet>{words}</p>' + table(head, rows)


def _residuals(found: Calibration) -> Chart:
    before: Any = linearised(found.rows, found.used, found.rig, found.kind).residual
    after = found.fit.linear.residual
    starts = np.concatenate(([0.0], np.cumsum([run.t[-1] for run in found.runs])))
    t = found.rows.t + starts[found.rows.run]
    marks = [Moment(float(s) + t, text) for run, s in zip(found.runs, starts, strict=False) for t, text in run.marks]
    along = TimeAxis(ONE_AFTER_ANOTHER, marks)
    panels = []
    for row, name in enumerate(CHANNEL_NAMES):
        curves = (
            Series('before', t, before[:, row] * 1e6, 'red', 'points'),
            Series('after', t, after[:, row] * 1e6, 'blue', 'points'),
        )
        low, high = np.percentile(np.concatenate([one.y for one in curves]), [0.5, 99.5])
        room = 0.2 * (high - low)
        panels.append(Panel(curves, along, f'{name} / µm', y_range=(low - room, high + room)))
    return Chart('reading minus model over time, before and after', panels)


def _correlations(found: Calibration) -> tuple[str | Matrix, ...]:
    at = [i for i in REPORTED if found.fit.free[i]]
    if not at:
        return ('<p>No parameter was free.</p>',)
    sd = found.sd[at]
    values = found.covariance[np.ix_(at, at)] / np.outer(sd, sd)
    names = [NAMES[i] for i in at]
    words = 'Correlations of the parameters: blue positive, red negative, darkest 1.'
    return f'<p class=quiet>{words}</p>', Matrix(words, values, names, names, most=1.0)
