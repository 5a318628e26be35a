# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The sections of the page of discover, for readers who have not seen the experiment."""

import html
import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from psd_deflection.base.charts import SMALL, Chart, Colour, Panel, Series, TimeAxis
from psd_deflection.base.drawings import CELL, BarColumn, Bars, Drawing, Matrix
from psd_deflection.base.pages import table
from psd_deflection.model.simulation.declaration import EffectParameter
from psd_deflection.model.simulation.laws import VARIABLES
from psd_deflection.records import FloatArray, channel_names
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover.conclusion import Conclusion, RigConclusion, other_causes
from psd_deflection.studies.discover.law_features import known_values
from psd_deflection.studies.discover.laws import FoundLaw
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.predictive import Predictive
from psd_deflection.studies.discover.search.screen import Score
from psd_deflection.studies.discover.search.smooth import Smooth
from psd_deflection.studies.discover.search.weighing import NamedEffect, Unknown
from psd_deflection.studies.discover.thresholds import BANDS
from psd_deflection.studies.discover.trees import parameters_of, size_of
from psd_deflection.studies.loads.plate_motion import dots_of
from psd_deflection.studies.study import PageSection

BEFORE: Final = 'red'
AFTER: Final = 'blue'


def _residual_chart(discovery: Conclusion) -> Chart:
    ws = discovery.workspace
    before, after = ws.displayed(discovery.search.null.difference), ws.displayed(discovery.fit.difference)
    along, times = ws.along()
    # A gap between recordings.
    t = np.concatenate([np.append(part, part[-1]) for part in times])
    panels = []
    for row, label in enumerate(_labels(ws)):
        curves = (
            Series('before', t, _joined(b[row] for b in before), BEFORE),
            Series('after', t, _joined(a[row] for a in after), AFTER),
        )
        panels.append(Panel(curves, along, label))
    return Chart('measured minus simulated, before and after', panels)


def _joined(parts: Iterable[FloatArray]) -> FloatArray:
    """Return one after the other, with no value after each."""
    return np.concatenate([np.append(part, np.nan) for part in parts])


def _labels(ws: Comparison) -> list[str]:
    pairs = zip(ws.channels, ws.display_units, strict=True)
    return [f'{name} / {unit}' if unit else name for name, unit in pairs]


def _against_chart(discovery: Conclusion) -> Chart | None:
    """What was missing against each input and position, in the channel where the effects changed most."""
    ws = discovery.workspace
    tables = ws.displayed(discovery.search.null.difference), ws.displayed(discovery.fit.difference)
    gaps = list(discovery.per_channel.values())
    row = max(range(len(gaps)), key=lambda c: (gaps[c][0] ** 2 - gaps[c][1] ** 2) / max(gaps[c][0] ** 2, 1e-300))
    before, after = (np.concatenate([t[row] for t in table]) for table in tables)
    panels = []
    for name, values in ws.against().items():
        at = np.concatenate(values)
        if np.any(np.isfinite(at)) and np.nanmax(at) > np.nanmin(at):
            curves = (Series('before', at, before, BEFORE, 'points'), Series('after', at, after, AFTER, 'points'))
            panels.append(Panel(curves, name, _labels(ws)[row], height=SMALL))
    words = f'measured minus simulated {ws.channels[row]} against loads and position'
    return Chart(words, panels, beside=min(3, len(panels))) if panels else None


def _function_chart(discovery: Conclusion, function: Smooth) -> Chart:
    """What remains without a name, and the smooth function, against each input, by channel."""
    ws = discovery.workspace
    against: list[tuple[str | TimeAxis, list[FloatArray]]] = list(ws.against().items())
    # The last ones are the readings.
    inputs = against[: len(against) - len(ws.channels)] or [ws.along()]
    value, residual = ws.displayed(function.tables), ws.displayed(discovery.fit.difference)
    panels = []
    for row, label in enumerate(_labels(ws)):
        remains, smooth = (np.concatenate([t[row] for t in table]) for table in (residual, value))
        for along, at in inputs:
            x = np.concatenate(at)
            curves = (
                Series('remains', x, remains, BEFORE, 'points'),
                Series('smooth function', x, smooth, AFTER, 'points'),
            )
            panels.append(Panel(curves, along, label, height=SMALL))
    return Chart(f'a smooth function of {" and ".join(function.variables)}', panels, beside=len(inputs))


def _spectrum(rows: FloatArray, period: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies, Hz, and power density, unit of ``rows`` squared per Hz, mean over the rows (k, n)."""
    from scipy.signal import periodogram

    frequency, power = periodogram(np.nan_to_num(rows), 1.0 / period, window='hann', detrend=False)
    # Log-spaced averages: in a raw periodogram scatter hides the lines.
    edges = np.geomspace(frequency[1], frequency[-1], 90)
    index = np.digitize(frequency[1:], edges)
    total = power[:, 1:].mean(axis=0)
    keep = np.unique(index)
    return (
        np.array([frequency[1:][index == k].mean() for k in keep]),
        np.array([total[index == k].mean() for k in keep]),
    )


def _spectrum_chart(discovery: RigConclusion) -> Chart:
    ws = discovery.workspace
    o, size = ws.observations[0], ws.fine[0]
    curves = []
    fits: tuple[tuple[Fit, Colour, str], ...] = (
        (discovery.search.null, BEFORE, 'before'),
        (discovery.fit, AFTER, 'after'),
    )
    for fit, colour, name in fits:
        f, p = _spectrum(dots_of(o.rig, fit.difference[0]), o.period * size)
        curves.append(Series(name, f, np.sqrt(p) * 1e6, colour))
    words = f'spectrum of the residual, mean of {" ".join(ws.channels)} ({o.name})'
    return Chart(words, [Panel(curves, 'frequency / Hz', 'density / µm/√Hz', log='x, y', height=240)])


def _waterfall(discovery: Conclusion) -> Bars:
    scale, unit = discovery.workspace.display_scale
    steps: list[tuple[str, float, Colour]] = [(n, scale * v, AFTER) for n, v in discovery.waterfall]
    steps[0] = (*steps[0][:2], BEFORE)
    steps[-1] = (*steps[-1][:2], 'quiet')
    steps.insert(-1, ('on unseen load cases', scale * discovery.gap_heldout_after, 'green'))
    # Nobody may know the noise.
    names, values, colours = zip(*(s for s in steps if np.isfinite(s[1])), strict=True)
    # Linear, from zero: the length of a bar is the size of the gap. The numbers say what is too short to be seen.
    column = BarColumn(f'gap, rms, {unit}' if unit else 'gap, rms', values, max(values))
    return Bars('the gap, step by step', names, colours, [column], discovery.workspace.digits)


def _where_matrix(discovery: Conclusion) -> tuple[str, Matrix]:
    of_rig = isinstance(discovery, RigConclusion)
    ws = discovery.workspace
    bands = [f'{a:g}-{b:g}' for a, b in itertools.pairwise(BANDS)] if of_rig else ['']
    names = channel_names(len(ws.channels) // 2) if of_rig else ws.channels
    shown = discovery.where.map
    most = float(np.clip(np.nanmax(shown), 8.0, 60.0))
    # With a gap between channels.
    labels = [f'{name} {band}'.strip() for name in names for band in (*bands, '')][:-1]
    labels = ['' if of_rig and label in names else label for label in labels]
    parts = [np.pad(shown[:, c, :], ((0, 0), (0, 1)), constant_values=np.nan) for c in range(len(names))]
    spans = discovery.where.spans
    spans_in_words = [f'{a:.1f}-{b:.1f} s' if of_rig else ws.names[i] for i, a, b in spans]
    height = max(4, min(CELL, 400 // len(spans)))
    every = -(-CELL // height)
    rows = [name if i % every == 0 else '' for i, name in enumerate(spans_in_words)]
    across = ' and band in Hz' if of_rig else ''
    words = f'where: load case (down) by channel{across} (across), before; darkest: {most:.0f} σ above noise and more'
    drawn = Matrix(words, np.hstack(parts)[:, :-1], rows, labels, most, height)
    return f'<p class=quiet>{html.escape(words)}</p>', drawn


def _sd_text(parameter: EffectParameter, sd: float) -> str:
    """``sd``; of one that exceeds the range of the parameter, that these recordings do not determine it."""
    return 'not determined' if sd > parameter.maximum - parameter.minimum else f'{sd:.2g}'


def _effect_section(effect: NamedEffect) -> str:
    e = effect.active.effect
    out = [
        f'<h3>{html.escape(effect.active.label)}</h3><p>{html.escape(e.summary)}: <i>{html.escape(e.equation)}</i> '
        f'(stage {e.stage}; {html.escape(e.source)})</p>'
    ]
    rows: list[tuple[object, ...]] = []
    for name, v in parameters_of(effect).items():
        if isinstance(v, dict):
            rows.append((name, f'{v["value"]:.6g}', _sd_text(e.parameter(name), v['sd']), v['unit']))
        else:
            rows.append((name, v, '', ''))
    out.append(table(('parameter', 'value', '± sd', 'unit'), rows))
    if effect.fitted_alternatives:
        fitted = [(r.active.label, size_of(r), f'{r.delta_bic:+.1f}') for r in effect.fitted_alternatives]
        out.append('<p>What explains these recordings nearly as well in its place:</p>')
        out.append(table(('alternative', 'fitted', 'BIC worse by'), fitted))
    if effect.suggestion is not None:
        out.append(f'<p>To decide: {html.escape(effect.suggestion.text)}.</p>')
    out.append('<details><summary>Evidence</summary>')
    out.append(
        f'<p>BIC better by {effect.delta_bic:.1f}; library-wide p {effect.p:.2g}; log-likelihood on unseen '
        f'load cases {effect.heldout.gain:+.1f} ± {effect.heldout.error:.1f}.</p>'
    )
    if effect.alternatives:
        verdicts = {True: 'cannot be distinguished', False: 'worse'}
        alternatives = [
            (n, f'{loss:.1f}', f'{bic:.1f}', verdicts[n in effect.equivalent]) for n, loss, bic in effect.alternatives
        ]
        out.append(table(('in its place', 'chi-square lost', 'BIC worse by', 'verdict'), alternatives))
    out.append('</details>')
    return ''.join(out)


def _law_chart(discovery: RigConclusion, found_law: FoundLaw) -> Chart:
    """What is missing and what the law leaves against its first variable, in the channel where it shows most."""
    ws, name = discovery.workspace, found_law.law.variables[0]
    _, alone = ws.residual([*ws.base, *found_law.fit.nuisance, *found_law.beside])
    missing, residual = ws.block_dots(alone), ws.block_dots(found_law.fit.difference)
    moved = np.concatenate([a - b for a, b in zip(missing, residual, strict=True)], axis=1)
    row = int(np.argmax(np.nansum(moved**2, axis=1)))
    scale, unit = (1e3, f'm{VARIABLES[name]}') if VARIABLES[name] in ('m', 'rad') else (1.0, VARIABLES[name])
    at = np.concatenate(known_values(ws, found_law.beside, name)) * scale
    before, after = (np.concatenate([b[row] for b in blocks]) * 1e6 for blocks in (missing, residual))
    law = (Series('missing', at, before, BEFORE, 'points'), Series('law', at, moved[row] * 1e6, 'text', 'points'))
    along, label = f'{name} / {unit}', f'{ws.channels[row]} / µm'
    panels = [
        Panel(law, along, label, height=SMALL),
        Panel((Series('left with the law', at, after, AFTER, 'points'),), along, label, height=SMALL),
    ]
    return Chart(f'measured minus simulated {ws.channels[row]} against {name}, block means', panels, beside=2)


def _law_section(discovery: RigConclusion, found_law: FoundLaw) -> list[str | Drawing]:
    law = found_law.law
    expressions = '<br>'.join(html.escape(e.expression) for e in found_law.laws)
    out: list[str | Drawing] = [f'<h3>A law for it</h3><p>{expressions}</p>']
    beside = ', '.join(a.label for a in found_law.beside)
    out.append(
        f'<p>Stage {law.stage}, {law.kind}; it shows on {", ".join(found_law.channels)}'
        f'{f"; fitted beside {html.escape(beside)}" if beside else ""}. On unseen load cases '
        f'{1e6 * found_law.heldout_gap:.3f} µm remain. BIC better by {found_law.delta_bic:.1f}; p over all terms that '
        f'were tried {found_law.p:.2g}; log-likelihood on unseen load cases {found_law.heldout.gain:+.1f} ± '
        f'{found_law.heldout.error:.1f}. It is an empirical law and not in model.yaml unless it is adopted.</p>'
    )
    if law.kind != 'variance':
        out.append(_law_chart(discovery, found_law))
    if found_law.equivalent:
        rows = [(e.stage, ', '.join(e.variables), e.expression) for e in found_law.equivalent]
        out.append('<p>This recording cannot tell it from:</p>')
        out.append(table(('stage', 'depends on', 'law'), rows))
    return out


def _where_table(discovery: Conclusion) -> str:
    names = discovery.workspace.names
    rows = [
        (
            c.channel,
            names[c.recording],
            f'{c.when[0]:.1f}-{c.when[1]:.1f} s',
            f'{c.band[0]:g}-{c.band[1]:g} Hz',
            ', '.join(c.depends_on),
            f'{c.statistic:.1f}',
            f'{c.p:.2g}',
        )
        for c in discovery.where.cells
        if c.p < 0.05
    ]
    if not rows:
        return '<p>Nowhere beyond noise.</p>'
    return table(('channel', 'recording', 'when', 'band', 'depends on', 'σ', 'p'), rows)


def _value(finding: Finding) -> str:
    return '' if finding.value is None else ', '.join(f'{v:.5g}' for v in np.ravel(finding.value).tolist())


def sections(discovery: Conclusion) -> list[PageSection]:
    """Return the gap step by step, what is missing, what is unknown, before and after, how it was found."""
    of_rig = discovery if isinstance(discovery, RigConclusion) else None
    out = [PageSection('', (_waterfall(discovery),))]
    if of_rig is not None and of_rig.setup:
        wrong = [(f.name, f.where, _value(f), f.fix, ', '.join(other_causes(f))) for f in of_rig.setup]
        head = ('mistake', 'where', 'value', 'what puts it right', 'explains it as well')
        most = len(head) if any(row[-1] for row in wrong) else -1
        out.append(PageSection('Set-up', (table(head[:most], [row[:most] for row in wrong]),)))
    effects = [_effect_section(e) for e in discovery.effects] or ['<p>No effect is named.</p>']
    out.append(PageSection('What', (*effects, *_nuisance(discovery), *_rehearsed(discovery))))
    law = [] if of_rig is None or of_rig.law is None else _law_section(of_rig, of_rig.law)
    if discovery.unexplained and discovery.prediction is not None:
        out.append(PageSection('What predicts', tuple(_predicts(discovery, discovery.prediction))))
    if discovery.unknown or law:
        function = None if discovery.remainder is None else discovery.remainder.function
        shown = [] if function is None else [_function_chart(discovery, function)]
        out.append(PageSection('Unknown', (*map(_unknown, discovery.unknown), *law, *shown)))
    out.append(PageSection('Before and after', tuple(_before_and_after(discovery))))
    out.append(PageSection('How it was found', tuple(_how(discovery))))
    return out


def _predicts(discovery: Conclusion, prediction: Predictive) -> list[str]:
    ws = discovery.workspace
    rows = [(t.name, f'{t.value:.4g}', t.unit, f'{t.weight:.2f}') for t in prediction.terms]
    words = f'<p>{html.escape(prediction.sentence(ws))} Terms and sizes were chosen anew without each unseen part.</p>'
    return [words, table(('term', 'value, shrunk', 'unit', 'weight, 0 to 1'), rows)]


def _nuisance(discovery: Conclusion) -> list[str]:
    if not discovery.nuisance:
        return []
    fitted = [
        (a.label, name, f'{a.values[name]:.6g}', _sd_text(a.effect.parameter(name), sd), a.effect.parameter(name).unit)
        for a, sds in discovery.nuisance
        for name, sd in sds.items()
    ]
    head = ('effect', 'parameter', 'value', '± sd', 'unit')
    return ['<p>Fitted in every model, and no finding:</p>', table(head, fitted)]


def _rehearsed(discovery: Conclusion) -> list[str]:
    if discovery.rehearsal is None:
        return []
    tree = discovery.rehearsal.tree()
    rows = [('the same', tree['again']), *((', '.join(o['effects']), o['times']) for o in tree['otherwise'])]
    return [f'<p>{html.escape(discovery.rehearsal.sentences()[0])}</p>', table(('named by', 'rehearsals'), rows)]


def _unknown(u: Unknown) -> str:
    where = 'is not in the model' if u.unexplained else 'the effects stand in for it in the model'
    share = f'{100 * u.explains:.0f} % of what was to be explained'
    return f'<p>{html.escape(u.signature)}. It is {share}; {where}.</p>'


def _before_and_after(discovery: Conclusion) -> list[str | Drawing]:
    out: list[str | Drawing] = [_residual_chart(discovery)]
    against = _against_chart(discovery)
    if against is not None:
        out.append(against)
    factor = 1.0
    if isinstance(discovery, RigConclusion):
        out.append(_spectrum_chart(discovery))
        factor = discovery.workspace.display_scale[0]
    channels = [
        (n, *(f'{factor * v:.4g}' for v in (*gaps, discovery.heldout_per_channel[n])), unit)
        for (n, gaps), unit in zip(discovery.per_channel.items(), discovery.workspace.display_units, strict=True)
    ]
    return [*out, table(('gap, rms', 'before', 'after', 'on unseen load cases', 'unit'), channels)]


def _how(discovery: Conclusion) -> list[str | Drawing]:
    first: dict[str, Score] = {}
    for score in discovery.search.first_scores:
        first.setdefault(score.candidate.effect.name, score)
    rows = [(n, f'{s.gain:.1f}', s.dof, f'{s.p:.2g}') for n, s in list(first.items())[:10]]
    trace = '; '.join(discovery.search.trace) or 'nothing passed the screen'
    return [
        '<details><summary>Where simulation and data part</summary>',
        *_where_matrix(discovery),
        _where_table(discovery),
        '</details><details><summary>Candidates at first sight</summary>',
        '<p class=quiet>Gain in chi-square if added alone, to first order.</p>',
        table(('effect', 'gain', 'parameters', 'p'), rows),
        '</details><details><summary>Steps</summary>',
        f'<p class=quiet>{html.escape(trace)}; {discovery.simulations} forward simulations.</p></details>',
    ]


@dataclass(frozen=True, eq=False, repr=False)
class Discovery(RigConclusion):
    """See :class:`~psd_deflection.studies.discover.conclusion.RigConclusion`."""

    def sections(self) -> Iterable[PageSection]:
        """Return the gap step by step, what is missing, what is unknown, before and after, how it was found."""
        return sections(self)
