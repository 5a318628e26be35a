# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The page of :mod:`blind.redone`: figures 5.12 to 5.29 and Table 5.1 of the thesis anew."""

import base64
import html
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blind.generator import Array
from psd_deflection.base.charts import SMALL, Chart, Colour, Panel, Series
from psd_deflection.base.charts import drawn as drawn_chart
from psd_deflection.base.pages import page, table

SHOWN = (('theta', 2, 'θ / °', math.degrees(1.0)), ('dx', 0, 'ΔX / mm', 1e3), ('dy', 1, 'ΔY / mm', 1e3))
"""Axes in the order of the thesis: name, column, label, factor."""
SYMBOLS = {'theta': 'θ', 'dx': 'ΔX', 'dy': 'ΔY'}
STYLES: dict[str, tuple[str, Colour]] = {
    'wls_sidebar': ('weights [0.03, 0.5, 10, 0.1]', 'red'),
    'wls_link': ('weights [3, 0.5, 10, 0.1]', 'orange'),
    'wls': ('WLS', 'green'),
    'iterative': ('iterative', 'violet'),
    'exact': ('exact', 'blue'),
}
PRINTED = {'theta': ('-7.4 %', '1.5 %'), 'dx': ('84 %', '21 %'), 'dy': ('5.8 %', '5.2 %')}
"""Table 5.1 of the thesis: iterative, weighted least squares."""
NUMBERS = {'sidebar_right_50N': '5.12-5.14', 'sidebar_right_30N': '5.15-5.17', 'sidebar_right_10N': '5.18-5.20'}
NUMBERS |= {'link_50N': '5.21-5.26', 'link_30N': '5.27-5.29'}
CALM = 1.0  # s at the end of a recording in which the link rests under its weight.


class Curves(NamedTuple):
    """``t`` (n,) s; ``poses``: by method (n, 3), m, m, rad."""

    t: Array
    poses: Mapping[str, Array]


def page_of(
    folder: Path,
    forces: Sequence[float],
    summary: Mapping[str, Any],
    drawn: Mapping[str, Mapping[str, Curves]],
    cameras: Mapping[str, Mapping[str, Array]],
    answers: Mapping[str, Mapping[str, Any]],
    truth: Mapping[str, float],
    typed: Sequence[str],
) -> str:
    """Return the page, pictures inside."""
    return page(
        'The experiment of the thesis, redone', _body(folder, forces, summary, drawn, cameras, answers, truth, typed)
    )


def _body(
    folder: Path,
    forces: Sequence[float],
    summary: Mapping[str, Any],
    drawn: Mapping[str, Mapping[str, Curves]],
    cameras: Mapping[str, Mapping[str, Array]],
    answers: Mapping[str, Mapping[str, Any]],
    truth: Mapping[str, float],
    typed: Sequence[str],
) -> Iterator[str]:
    largest = f'{forces[0]:.0f}'
    yield '<h1>The experiment of the thesis, redone</h1>'
    yield f'<p class=verdict>{html.escape(verdict(summary))}</p>'
    yield (
        '<p>The rig is simulated and differs from its rig file in every gain, turn, centre, height and beam. '
        'Weights hang on the sidebar, 0.585 m from the link, on either side, and then on the link itself. '
        'A camera with a clock of its own looks at three discs on the tip. '
        '<code>calibrate</code> sees the recordings of the sidebar only. The '
        'recordings on the link are judged by the true pose, which only the simulation knows.</p>'
    )
    yield from _camera_frame(folder, f'sidebar_right_{largest}N')
    yield '<h2>The weight moves to the link</h2>'
    yield (
        '<p class=quiet>Largest error of all instants, in percent of the deflection at 50 N '
        f'({1e3 * summary["deflection"]["across"]:.2f} mm; {math.degrees(summary["deflection"]["twist"]):.3f}°). '
        f'Wanted after calibration: at most {100 * summary["limit"]:g} %.</p>'
    )
    yield _on_the_link(forces, summary, answers)
    one = summary['shares']['one_side']
    yield (
        f'<p>Hung on one side only, the weight turns and bends the link in the same proportion at every load. '
        f'Even an ideal calibration then leaves 0.4 % in θ on the link; this one, by the right side alone, leaves '
        f'{100 * one["theta"]:.2f} %. So the weight has to hang on both sides.</p>'
    )
    yield '<h2>Table 5.1 anew</h2>'
    yield (
        f'<p class=quiet>Error relative to the camera, {largest} N on the sidebar at rest. ΔX is '
        '0.12 mm: a µm is almost a percent of it. The first two columns are those of the thesis.</p>'
    )
    yield _table_51(f'sidebar_right_{largest}N', drawn, cameras)
    yield '<h2>Figures 5.12 to 5.29 anew</h2>'
    yield (
        '<p class=quiet>Above: the rig as its file says, with the zero taken before the load. Below: calibrated. '
        'θ is positive counter-clockwise (the thesis has it the other way round).</p>'
    )
    for name, two in drawn.items():
        place, weight = name.rsplit('_', 1)
        where = 'the link' if place == 'link' else 'the sidebar'
        number = f'Figures {NUMBERS[name]}: ' if name in NUMBERS else ''
        title = f'{number}{weight[:-1]} N on {where}'
        yield f'<h3>{title}</h3>'
        yield drawn_chart(_over_time(title, two, cameras[name], place == 'link'))
    yield '<h2>What was hidden</h2>'
    yield table(('parameter', 'true value, SI units'), [(name, f'{value:+.5g}') for name, value in truth.items()])
    yield '<h2>What calibrate says</h2>'
    yield ''.join(f'<p>{html.escape(line)}</p>' for line in summary['calibrate'])
    yield '<h2>Commands</h2>'
    lines = html.escape('\n'.join(dict.fromkeys(typed)))
    yield f'<pre role="group" tabindex="0" aria-label="commands">{lines}</pre>'


def verdict(summary: Mapping[str, Any]) -> str:
    """Return the answer in two sentences."""
    after, before = (summary['shares'][stem] for stem in ('after', 'before_sidebar'))
    words = ', '.join(f'{SYMBOLS[axis]} {100 * after[axis]:.3f} %' for axis in SYMBOLS)
    old = ', '.join(f'{SYMBOLS[axis]} {100 * before[axis]:.1f} %' for axis in SYMBOLS)
    holds = 'holds' if summary['holds'] else 'does not hold'
    return (
        f'Calibrated on the sidebar alone, the rig is at most {words} of the 50 N deflection off on the link: '
        f'the bound of {100 * summary["limit"]:g} % {holds}. '
        f'Weights tuned by hand on the sidebar, without calibration: {old}.'
    )


def _camera_frame(folder: Path, name: str) -> Iterator[str]:
    code = base64.b64encode((folder / f'{name}.png').read_bytes()).decode()
    yield f'<img width="320" alt="the target: three white discs on black" src="data:image/png;base64,{code}">'


def _on_the_link(forces: Sequence[float], summary: Mapping[str, Any], answers: Mapping[str, Mapping[str, Any]]) -> str:
    scale = {axis: summary['deflection']['twist' if axis == 'theta' else 'across'] for axis in SYMBOLS}
    rows = []
    for words, stem in (('rig file', 'before'), ('calibrated', 'after')):
        for method, (label, _) in STYLES.items():
            solver, _, weights = method.partition('_')
            cells = []
            for force in forces:
                found = answers[f'link_{force:.0f}N'][f'{stem}{"_" if weights else ""}{weights} truth']['solvers'][
                    solver
                ]
                cells += [f'{100 * found[axis]["largest"] / scale[axis]:.3f}' for axis in SYMBOLS]
            rows.append((words if method == 'wls_sidebar' else '', label, *cells))
    head = [f'{force:.0f} N, {SYMBOLS[axis]}' for force in forces for axis in SYMBOLS]
    return table(('rig', 'method', *head), rows)


def relative_errors(curves: Curves, camera: Mapping[str, Array]) -> dict[str, Array]:
    """By method (3,): the mean at the end of a recording over that of the camera, less one."""
    late = curves.t > curves.t[-1] - CALM
    observed = camera['t'] > camera['t'][-1] - CALM
    reference = np.array([np.nanmean(camera[axis][observed]) for axis in ('dx', 'dy', 'theta')])
    return {method: poses[late].mean(axis=0) / reference - 1.0 for method, poses in curves.poses.items()}


def _table_51(name: str, drawn: Mapping[str, Mapping[str, Curves]], cameras: Mapping[str, Mapping[str, Array]]) -> str:
    methods = ('wls_sidebar', 'wls', 'iterative', 'exact')
    errors = {stem: relative_errors(curves, cameras[name]) for stem, curves in drawn[name].items()}
    rows = []
    for axis, column, _, _ in SHOWN:
        cells = [f'{100 * errors[stem][m][column]:+.2f} %' for stem in ('before', 'after') for m in methods]
        rows.append((SYMBOLS[axis], *PRINTED[axis], *cells))
    labels = ('by hand', 'WLS', 'iterative', 'exact')
    head = ('', 'thesis: iterative', 'thesis: WLS', *(f'before: {n}' for n in labels), *(f'after: {n}' for n in labels))
    return table(head, rows)


def _over_time(words: str, two: Mapping[str, Curves], camera: Mapping[str, Array], on_link: bool) -> Chart:
    panels = []
    for stem, curves in two.items():
        rig = {'before': 'rig file', 'after': 'calibrated'}[stem]
        for name, column, label, factor in SHOWN:
            series = [
                Series(STYLES[m][0], curves.t, factor * curves.poses[m][:, column], STYLES[m][1])
                for m in STYLES
                if on_link or m != 'wls_link'
            ]
            series.append(Series('camera', camera['t'], factor * camera[name], 'text', 'points'))
            panels.append(Panel(series, 'time / s', f'{rig}: {label}', height=SMALL))
    return Chart(f'{words}: camera and methods over time', panels, beside=3)
