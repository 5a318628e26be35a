# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The sections of the page of calibrate."""

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


def sections(calibration: Calibration) -> list[PageSection]:
    """Return the page below the sentence."""
    open_words = (
        '<p class=quiet>Left open: the standard deviation over that of the rig file or its tolerance; 1: nothing was '
        'learnt, and the file keeps its value.</p>'
    )
    todo = ''.join(f'<li>{html.escape(words)}</li>' for words in advice(calibration))
    return [
        PageSection('Before and after', (_residuals(calibration), _gap(calibration))),
        PageSection('Parameters', (open_words, _parameters(calibration), *_correlations(calibration))),
        PageSection('What these recordings cannot determine', (_undetermined(calibration),)),
        PageSection('Noise', (_noise(calibration),)),
        *([PageSection('Dark levels and other light', (_dark(calibration),))] if calibration.dark else []),
        PageSection('What to do next', (f'<ul>{todo}</ul>',)),
    ]


def advice(calibration: Calibration) -> list[str]:
    """What a person should do with the answer."""
    out = []
    if calibration.rejected:
        out.append('Check the reference: its axes, units, signs and clock. The rig file was left as it is.')
    for name in calibration.widened:
        out.append(
            f'{name} is {in_words(NAMES.index(name), calibration.values[NAMES.index(name)])}: outside the tolerance of '
            'the file. Look at the mount; if it is right, state the tolerance in the file.'
        )
    for name in calibration.dropped:
        out.append(f'{name}: unseen motion rejects it, so the file keeps its value.')
    out += [f'To determine {" with ".join(d.parts)}: {d.needs}.' for d in calibration.undetermined[:4]]
    if calibration.kind == 'loads':
        out.append(
            'Known loads know the scale of the gains no better than the stiffness of the link and its clamp: '
            'a reference separates them.'
        )
    if calibration.kind == 'self':
        out.append(
            'The redundant reading knows relative gains and turns only; take the zero (~/zero) with the new file.'
        )
    out.append('Use the file: --params-file rig.yaml. Later: psd-deflection calibrate --check rig.yaml REC.')
    return out


def _parameters(calibration: Calibration) -> str:
    rows = []
    for i in (*REPORTED, *range(ZERO, COUNT)):
        sd, before = float(calibration.sd[i]), float(calibration.prior.sd[i])
        words = (in_words(i, float(calibration.prior.mean[i]), before), in_words(i, float(calibration.values[i]), sd))
        rows.append((NAMES[i], WORDS[NAMES[i]], *words, f'{sd / before:.2g}' if before else ''))
    return table(('parameter', 'meaning', 'rig file', 'calibrated', 'left open'), rows)


def _gap(calibration: Calibration) -> str:
    g = calibration.gap
    rows = [
        ('all motion', f'{g.before * 1e6:.3f} µm', f'{g.after * 1e6:.3f} µm'),
        ('motion that was not fitted', f'{g.heldout_before * 1e6:.3f} µm', f'{g.heldout_after * 1e6:.3f} µm'),
    ]
    return table(('reading minus model, rms', 'before', 'after'), rows)


def _undetermined(calibration: Calibration) -> str:
    if not calibration.undetermined:
        return '<p>Nothing: every parameter is determined.</p>'
    rows = []
    for d in calibration.undetermined:
        parts = ', '.join(f'{name} {part:+.2f}' for name, part in d.parts.items())
        how = 'keeps the value and the tolerance of the file' if len(d.parts) == 1 else 'move together'
        rows.append((parts, how, d.needs))
    return table(('direction, in units of the tolerances', '', 'what would determine it'), rows)


def _noise(calibration: Calibration) -> str:
    rows = [(name, f'{v * 1e3:.3f} mV a sample') for name, v in zip(CHANNEL_NAMES, calibration.noise, strict=True)]
    if calibration.kind == 'reference':
        x, y, theta = calibration.fit.noise.reference
        rows.append(('reference', f'{x * 1e6:.2f} µm, {y * 1e6:.2f} µm, {theta * MDEG:.2f} mdeg a frame'))
        clock = calibration.clock + float(calibration.values[CLOCK])
        rows.append(
            ('clock of the reference', f'add {clock * 1e3:.3f} ± {calibration.sd[CLOCK] * 1e3:.2g} ms to its times')
        )
        rows.append(
            ('outliers of the reference', f'{int(np.sum(calibration.fit.weights == 0.0))} of {len(calibration.rows)}')
        )
    return table(('what', 'noise, 1 sd'), rows)


def _dark(calibration: Calibration) -> str:
    rows = []
    for level in calibration.dark:
        x, y = (f'{v:.5f} ± {sd:.1g}' for v, sd in zip(level.volts[:2], level.sd[:2], strict=True))
        sums = f'{level.volts[2]:.5f} ± {level.sd[2]:.1g}'
        file = ', '.join(f'{v:g}' for v in level.before)
        place = ', '.join(f'{v * 1e3:+.2f}' for v in level.place)
        rows.append((f'psd_{level.psd}', x, y, sums, file, f'{level.share:.3%}', place, f'{level.residual * 1e6:.2g}'))
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


def _residuals(calibration: Calibration) -> Chart:
    before: Any = linearised(calibration.rows, calibration.used, calibration.rig, calibration.kind).residual
    after = calibration.fit.linear.residual
    starts = np.concatenate(([0.0], np.cumsum([run.t[-1] for run in calibration.runs])))
    t = calibration.rows.t + starts[calibration.rows.run]
    marks = [
        Moment(float(s) + t, text) for run, s in zip(calibration.runs, starts, strict=False) for t, text in run.marks
    ]
    along = TimeAxis(ONE_AFTER_ANOTHER, marks)
    panels = []
    for row, name in enumerate(CHANNEL_NAMES):
        curves = (
            Series('before', t, before[:, row] * 1e6, 'red', 'points'),
            Series('after', t, after[:, row] * 1e6, 'blue', 'points'),
        )
        low, high = np.percentile(np.concatenate([curve.y for curve in curves]), [0.5, 99.5])
        room = 0.2 * (high - low)
        panels.append(Panel(curves, along, f'{name} / µm', y_range=(low - room, high + room)))
    return Chart('reading minus model over time, before and after', panels)


def _correlations(calibration: Calibration) -> tuple[str | Matrix, ...]:
    at = [i for i in REPORTED if calibration.fit.free[i]]
    if not at:
        return ('<p>No parameter was free.</p>',)
    sd = calibration.sd[at]
    values = calibration.covariance[np.ix_(at, at)] / np.outer(sd, sd)
    names = [NAMES[i] for i in at]
    words = 'Correlations of the parameters: blue positive, red negative, darkest 1.'
    return f'<p class=quiet>{words}</p>', Matrix(words, values, names, names, most=1.0)
