"""The sections of the page of discover, for readers who have not seen the experiment."""

from __future__ import annotations

import html
import itertools

import numpy as np
from matplotlib.figure import Figure

from psd_deflection.base.pages import picture, table
from psd_deflection.model.simulation.laws import VARIABLES
from psd_deflection.records import CHANNELS, DOT_CHANNELS, FloatArray
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover.conclusion import Conclusion, RigConclusion, parameters_of, size_of
from psd_deflection.studies.discover.laws.law_features import known_values
from psd_deflection.studies.discover.laws.laws import FoundLaw
from psd_deflection.studies.discover.search.screen import Score
from psd_deflection.studies.discover.search.smooth import Smooth
from psd_deflection.studies.discover.search.trust import BANDS
from psd_deflection.studies.discover.search.weighing import NamedEffect, Unknown
from psd_deflection.studies.study import PageSection

BEFORE, AFTER, HELD, FLOOR = '#c44e52', '#4c72b0', '#55a868', '#8c8c8c'
DOTS = ('x1', 'y1', 'x2', 'y2')


def _residual_figure(discovery: Conclusion) -> Figure:
    ws = discovery.workspace
    before, after = ws.shown(discovery.search.null.difference), ws.shown(discovery.fit.difference)
    along, times = next(iter(ws.against().items()))
    count = len(ws.channels)
    figure = Figure(figsize=(10, 1.6 + 1.2 * count), layout='constrained')
    axes = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    mark = '.-' if sum(len(t) for t in times) < 200 else '-'
    for i, (t, b, a) in enumerate(zip(times, before, after, strict=True)):
        for row, axis in enumerate(axes):
            axis.plot(t, b[row], mark, color=BEFORE, lw=0.8, label='before' if i == 0 else None)
            axis.plot(t, a[row], mark, color=AFTER, lw=0.8, label='after' if i == 0 else None)
    for axis, name, unit in zip(axes, ws.channels, ws.units_shown, strict=True):
        axis.set_ylabel(f'{name} / {unit}' if unit else name)
        axis.grid(alpha=0.25)
    axes[0].legend(loc='upper right', ncols=2, frameon=False)
    axes[-1].set_xlabel(along)
    figure.suptitle('measured minus simulated')
    return figure


def _against_figure(discovery: Conclusion) -> Figure | None:
    """What was missing against each input and position, in the channel where the effects changed most."""
    ws = discovery.workspace
    tables = ws.shown(discovery.search.null.difference), ws.shown(discovery.fit.difference)
    gaps = list(discovery.per_channel.values())
    row = max(range(len(gaps)), key=lambda c: (gaps[c][0] ** 2 - gaps[c][1] ** 2) / max(gaps[c][0], 1e-300) ** 2)
    before, after = (np.concatenate([t[row] for t in table]) for table in tables)
    varied = []
    for name, values in list(ws.against().items())[1:]:
        at = np.concatenate(values)
        if np.any(np.isfinite(at)) and np.nanmax(at) > np.nanmin(at):
            varied.append((name, at))
    if not varied:
        return None
    columns = min(4, len(varied))
    rows = -(-len(varied) // columns)
    figure = Figure(figsize=(10, 0.6 + 2.4 * rows), layout='constrained')
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    for axis, (name, at) in zip(axes, varied, strict=False):
        axis.plot(at, before, '.', ms=2.5, color=BEFORE, label='before')
        axis.plot(at, after, '.', ms=2.5, color=AFTER, label='after')
        axis.set_xlabel(name)
        axis.grid(alpha=0.25)
    for axis in axes[len(varied) :]:
        axis.set_visible(False)
    axes[0].legend(frameon=False)
    unit = ws.units_shown[row]
    axes[0].set_ylabel(f'{ws.channels[row]} / {unit}' if unit else ws.channels[row])
    figure.suptitle(f'measured minus simulated {ws.channels[row]} against loads and position')
    return figure


def _function_figure(discovery: Conclusion, function: Smooth) -> Figure:
    """What remains without a name, and the smooth function, against each input, by channel."""
    ws = discovery.workspace
    against = list(ws.against().items())
    # The last ones are the readings.
    inputs = against[1 : len(against) - len(ws.channels)] or against[:1]
    value, left = ws.shown(function.tables), ws.shown(discovery.fit.difference)
    figure = Figure(figsize=(10, 0.6 + 2.2 * len(ws.channels)), layout='constrained')
    axes = figure.subplots(len(ws.channels), len(inputs), sharex='col', sharey='row', squeeze=False)
    for row, name, unit, own in zip(range(len(ws.channels)), ws.channels, ws.units_shown, axes, strict=True):
        for axis, (along, at) in zip(own, inputs, strict=True):
            x = np.concatenate(at)
            axis.plot(x, np.concatenate([t[row] for t in left]), '.', ms=4, color=BEFORE, label='remains')
            axis.plot(x, np.concatenate([t[row] for t in value]), '.', ms=4, color=AFTER, label='smooth function')
            axis.grid(alpha=0.25)
            if row == len(ws.channels) - 1:
                axis.set_xlabel(along)
        own[0].set_ylabel(f'{name} / {unit}' if unit else name)
    axes[0, 0].legend(frameon=False)
    figure.suptitle(f'a smooth function of {" and ".join(function.variables)}')
    return figure


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


def _spectrum_figure(discovery: RigConclusion) -> Figure:
    ws = discovery.workspace
    figure = Figure(figsize=(10, 3.2), layout='constrained')
    axis = figure.subplots()
    o, size = ws.observations[0], ws.fine[0]
    rows = list(DOT_CHANNELS)
    for fit, color, name in (
        (discovery.search.null, BEFORE, 'before'),
        (discovery.fit, AFTER, 'after'),
    ):
        dots = fit.difference[0][rows] * o.rig.sensitivities.reshape(4, 1)
        f, p = _spectrum(dots, o.period * size)
        axis.loglog(f, np.sqrt(p) * 1e6, color=color, lw=1.2, label=name)
    axis.set_xlabel('frequency / Hz')
    axis.set_ylabel('µm / √Hz')
    axis.grid(alpha=0.25, which='both')
    axis.legend(frameon=False)
    figure.suptitle(f'spectrum of the residual, mean of x1 y1 x2 y2 ({o.name})')
    return figure


def _waterfall_figure(discovery: Conclusion) -> Figure:
    scale, unit = discovery.workspace.scale_shown
    bars = [(n, scale * v, AFTER) for n, v in discovery.waterfall]
    bars[0] = (*bars[0][:2], BEFORE)
    bars[-1] = (*bars[-1][:2], FLOOR)
    bars.insert(-1, ('on unseen load cases', scale * discovery.gap_heldout_after, HELD))
    # Nobody may know the noise.
    bars = [b for b in bars if np.isfinite(b[1])]
    names, values, colors = zip(*bars, strict=True)
    figure = Figure(figsize=(10, 0.6 + 0.42 * len(bars)), layout='constrained')
    axis = figure.subplots()
    # By position, not by name: an effect may appear twice, once for each PSD.
    axis.barh(range(len(bars)), values, color=colors)
    axis.set_yticks(range(len(bars)), names)
    axis.invert_yaxis()
    # Linear, from zero: the length of a bar is the size of the gap. The numbers say what is too short to be seen.
    axis.set_xlim(0.0, 1.18 * max(values))
    for i, v in enumerate(values):
        axis.text(v + 0.01 * max(values), i, f'{v:{discovery.workspace.digits}} {unit}', va='center', fontsize=9)
    axis.set_xlabel(f'gap, rms, {unit}')
    return figure


def _where_figure(discovery: Conclusion) -> Figure:
    shown = np.clip(discovery.where.map, 0.0, 60.0)
    of_rig = isinstance(discovery, RigConclusion)
    bands = [f'{a:g}-{b:g}' for a, b in itertools.pairwise(BANDS)] if of_rig else ['']
    names = CHANNELS if of_rig else discovery.workspace.channels
    figure = Figure(figsize=(10, 3.4), layout='constrained')
    # One image of all channels, with gaps: axes for each of them took longer than all other pictures together.
    axis, gap = figure.subplots(), int(of_rig)
    width = len(bands) + gap
    parts = [np.pad(shown[:, c, :], ((0, 0), (0, gap)), constant_values=np.nan) for c in range(len(names))]
    picture = axis.imshow(
        np.hstack(parts)[:, : len(names) * width - gap],
        aspect='auto',
        cmap='magma_r',
        vmin=0.0,
        vmax=max(8.0, float(shown.max())),
    )
    places = [c * width + i for c in range(len(names)) for i in range(len(bands))]
    axis.set_xticks(places, bands * len(names), rotation=90, fontsize=7)
    for c, name in enumerate(names):
        axis.text(c * width + 0.5 * (len(bands) - 1), -0.6, name, ha='center', va='bottom', fontsize=10)
    spans = discovery.where.spans
    ticks = range(0, len(spans), max(1, len(spans) // 12))
    told = [f'{a:.1f}-{b:.1f} s' if of_rig else discovery.workspace.names[i] for i, a, b in spans]
    axis.set_yticks(ticks, [told[i] for i in ticks], fontsize=7)
    figure.colorbar(picture, ax=axis, label='σ above noise')
    across = ' by band in Hz (across)' if of_rig else ''
    figure.suptitle(f'where: load case (down){across} by channel, before')
    return figure


def _effect_section(effect: NamedEffect) -> str:
    e = effect.active.effect
    out = [
        f'<h3>{html.escape(effect.active.label)}</h3><p>{html.escape(e.summary)}: <i>{html.escape(e.equation)}</i> '
        f'(stage {e.stage}; {html.escape(e.source)})</p>'
    ]
    rows: list[tuple[object, ...]] = []
    for name, v in parameters_of(effect).items():
        if isinstance(v, dict):
            rows.append((name, f'{v["value"]:.6g}', f'{v["sd"]:.2g}', v['unit']))
        else:
            rows.append((name, v, '', ''))
    out.append(table(('parameter', 'value', '± sd', 'unit'), rows))
    if effect.rivals:
        fitted = [(r.active.label, size_of(r), f'{r.delta_bic:+.1f}') for r in effect.rivals]
        out.append('<p>What explains these recordings nearly as well in its place:</p>')
        out.append(table(('rival', 'fitted', 'BIC worse by'), fitted))
    if effect.suggestion is not None:
        out.append(f'<p>To decide: {html.escape(effect.suggestion.text)}.</p>')
    out.append('<details><summary>Evidence</summary>')
    out.append(
        f'<p>BIC better by {effect.delta_bic:.1f}; library-wide p {effect.p:.2g}; log-likelihood on unseen '
        f'load cases {effect.heldout.gain:+.1f} ± {effect.heldout.error:.1f}.</p>'
    )
    if effect.alternatives:
        told = {True: 'cannot be told apart', False: 'worse'}
        others = [
            (n, f'{loss:.1f}', f'{bic:.1f}', told[n in effect.equivalent]) for n, loss, bic in effect.alternatives
        ]
        out.append(table(('in its place', 'chi-square lost', 'BIC worse by', 'verdict'), others))
    out.append('</details>')
    return ''.join(out)


def _law_figure(discovery: RigConclusion, found: FoundLaw) -> Figure:
    """What is missing and what the law leaves against its first variable, in the channel where it shows most."""
    ws, name = discovery.workspace, found.law.variables[0]
    _, alone = ws.residual([*ws.base, *found.fit.nuisance, *found.beside])
    missing, left = ws.block_dots(alone), ws.block_dots(found.fit.difference)
    moved = np.concatenate([a - b for a, b in zip(missing, left, strict=True)], axis=1)
    row = int(np.argmax(np.nansum(moved**2, axis=1)))
    axis_values = known_values(ws, found.beside, name)
    scale, unit = (1e3, f'm{VARIABLES[name]}') if VARIABLES[name] in ('m', 'rad') else (1.0, VARIABLES[name])
    figure = Figure(figsize=(10, 3.4), layout='constrained')
    axes = figure.subplots(1, 2, sharey=True)
    at = np.concatenate(axis_values) * scale
    before, after = (np.concatenate([b[row] for b in blocks]) * 1e6 for blocks in (missing, left))
    axes[0].plot(at, before, '.', ms=2, color=BEFORE, label='missing')
    axes[0].plot(at, moved[row] * 1e6, '.', ms=1.5, color='black', label='law')
    axes[1].plot(at, after, '.', ms=2, color=AFTER, label='left with the law')
    for axis in axes:
        axis.set_xlabel(f'{name} / {unit}')
        axis.grid(alpha=0.25)
        axis.legend(frameon=False)
    axes[0].set_ylabel(f'{DOTS[row]} / µm')
    figure.suptitle(f'measured minus simulated {DOTS[row]} against {name}, block means')
    return figure


def _law_section(discovery: RigConclusion, found: FoundLaw) -> str:
    law = found.law
    out = [f'<h3>A law for it</h3><p>{"<br>".join(html.escape(e.expression) for e in found.laws)}</p>']
    beside = ', '.join(a.label for a in found.beside)
    out.append(
        f'<p>Stage {law.stage}, {law.kind}; it shows on {", ".join(found.channels)}'
        f'{f"; fitted beside {html.escape(beside)}" if beside else ""}. On unseen load cases '
        f'{1e6 * found.heldout_gap:.3f} µm remain. BIC better by {found.delta_bic:.1f}; p over all terms that '
        f'were tried {found.p:.2g}; log-likelihood on unseen load cases {found.heldout.gain:+.1f} ± '
        f'{found.heldout.error:.1f}. It is an empirical law and not in model.yaml unless it is adopted.</p>'
    )
    if law.kind != 'variance':
        out.append(picture(_law_figure(discovery, found), 'what is missing against its variable, with the law'))
    if found.equivalent:
        rows = [(e.stage, ', '.join(e.variables), e.expression) for e in found.equivalent]
        out.append('<p>This recording cannot tell it from:</p>')
        out.append(table(('stage', 'depends on', 'law'), rows))
    return ''.join(out)


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
    """The gap step by step, what is missing, what is unknown, before and after, how it was found."""
    of_rig = discovery if isinstance(discovery, RigConclusion) else None
    out = [PageSection('', (picture(_waterfall_figure(discovery), 'the gap, step by step'),))]
    if of_rig is not None and of_rig.setup:
        wrong = [(f.name, f.where, _value(f), f.fix) for f in of_rig.setup]
        out.append(PageSection('Set-up', (table(('mistake', 'where', 'value', 'what puts it right'), wrong),)))
    effects = [_effect_section(e) for e in discovery.effects] or ['<p>No effect is named.</p>']
    out.append(PageSection('What', (*effects, *_nuisance(discovery))))
    law = () if of_rig is None or of_rig.law is None else (_law_section(of_rig, of_rig.law),)
    if discovery.unknown or law:
        function = None if discovery.remainder is None else discovery.remainder.function
        drawn = [] if function is None else [picture(_function_figure(discovery, function), 'the smooth function')]
        out.append(PageSection('Unknown', (*map(_unknown, discovery.unknown), *law, *drawn)))
    out.append(PageSection('Before and after', tuple(_before_and_after(discovery))))
    out.append(PageSection('How it was found', tuple(_how(discovery))))
    return out


def _nuisance(discovery: Conclusion) -> list[str]:
    if not discovery.nuisance:
        return []
    fitted = [
        (a.label, name, f'{a.values[name]:.6g}', f'{sd:.2g}', a.effect.parameter(name).unit)
        for a, sds in discovery.nuisance
        for name, sd in sds.items()
    ]
    head = ('effect', 'parameter', 'value', '± sd', 'unit')
    return ['<p>Fitted in every model, and no finding:</p>', table(head, fitted)]


def _unknown(u: Unknown) -> str:
    where = 'is not in the model' if u.remains else 'the effects stand in for it in the model'
    share = f'{100 * u.explains:.0f} % of what was to be explained'
    return f'<p>{html.escape(u.signature)}. It is {share}; {where}.</p>'


def _before_and_after(discovery: Conclusion) -> list[str]:
    out = [picture(_residual_figure(discovery), 'residual before and after')]
    against = _against_figure(discovery)
    if against is not None:
        out.append(picture(against, 'residual before and after against loads and position'))
    factor = 1.0
    if isinstance(discovery, RigConclusion):
        out.append(picture(_spectrum_figure(discovery), 'spectrum before and after'))
        factor = discovery.workspace.scale_shown[0]
    channels = [
        (n, *(f'{factor * v:.4g}' for v in (*gaps, discovery.heldout_per_channel[n])), unit)
        for (n, gaps), unit in zip(discovery.per_channel.items(), discovery.workspace.units_shown, strict=True)
    ]
    return [*out, table(('gap, rms', 'before', 'after', 'on unseen load cases', 'unit'), channels)]


def _how(discovery: Conclusion) -> list[str]:
    first: dict[str, Score] = {}
    for score in discovery.search.first_scores:
        first.setdefault(score.candidate.effect.name, score)
    rows = [(n, f'{s.gain:.1f}', s.dof, f'{s.p:.2g}') for n, s in list(first.items())[:10]]
    trace = '; '.join(discovery.search.trace) or 'nothing passed the screen'
    return [
        '<details><summary>Where simulation and data part</summary>',
        picture(_where_figure(discovery), 'where simulation and data part'),
        _where_table(discovery),
        '</details><details><summary>Candidates at first sight</summary>',
        '<p class=quiet>Gain in chi-square if added alone, to first order.</p>',
        table(('effect', 'gain', 'parameters', 'p'), rows),
        '</details><details><summary>Steps</summary>',
        f'<p class=quiet>{html.escape(trace)}; {discovery.simulations} forward simulations.</p></details>',
    ]
