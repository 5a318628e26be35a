"""The output of discover: result.json and model.yaml (docs/discover.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from psd_deflection import __version__
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover.discover import Discovery
from psd_deflection.studies.discover.laws.laws import FoundLaw
from psd_deflection.studies.discover.search.ties import ties
from psd_deflection.studies.discover.search.weighing import Conclusion, NamedEffect, Rival


def _number(value: float) -> float:
    # JSON has no infinity; for a chi-square or standard deviation this is as good.
    if math.isnan(value):
        return 0.0
    return float(min(max(value, -1e300), 1e300))


def parameters_of(effect: NamedEffect | Rival) -> dict[str, Any]:
    """Choices as numbers, the rest with standard deviation and unit."""
    return _fitted(effect.active, effect.sd)


def _fitted(active: ActiveEffect, sds: Mapping[str, float]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for p in active.effect.parameters:
        value = active.values[p.name]
        if p.kind == 'choice':
            out[p.name] = int(value)
        elif math.isfinite(value):
            out[p.name] = {'value': _number(value), 'sd': _number(sds.get(p.name, 0.0)), 'unit': p.unit}
    return out


def result(discovery: Conclusion) -> dict[str, Any]:
    """The tree of result.json: the same for the rig and for another plant, which has neither set-up nor law."""
    of_rig = discovery if isinstance(discovery, Discovery) else None
    law = None if of_rig is None else of_rig.law
    where = [
        {
            'channel': c.channel,
            'recording': discovery.workspace.names[c.recording],
            'when': [c.when[0], c.when[1]],
            'band_hz': [c.band[0], c.band[1]],
            'depends_on': list(c.depends_on),
            'statistic': _number(c.statistic),
            'p': min(max(c.p, 0.0), 1.0),
        }
        for c in discovery.where.cells
        if c.p < 0.05
    ]
    effects = [
        {
            'name': e.active.effect.name,
            'stage': e.active.effect.stage,
            'parameters': parameters_of(e),
            'equivalent': list(e.equivalent),
            'evidence': {
                'delta_bic': _number(e.delta_bic),
                'p': _number(e.p),
                'heldout_gain': _number(e.heldout.gain),
                'heldout_gain_error': _number(e.heldout.error),
            },
            'suggested_experiment': None if e.suggestion is None else e.suggestion.text,
            'rivals': [
                {
                    'name': r.active.effect.name,
                    'parameters': parameters_of(r),
                    'delta_bic': _number(r.delta_bic),
                }
                for r in e.rivals
            ],
        }
        for e in discovery.effects
    ]
    unknown = [
        {
            'signature': u.signature,
            'depends_on': list(u.depends_on),
            'explains': u.explains,
            'rms': u.rms,
            'law': None if i or law is None else law_of(law),
        }
        for i, u in enumerate(discovery.unknown)
    ]
    return {
        'verdict': discovery.verdict,
        'where': where,
        'effects': effects,
        'unknown': unknown,
        'ties': [
            {
                'share': {'value': t.share, 'sd': t.sd},
                'frequencies_moved': t.moves,
                'causes': [{'name': c.name, 'factor': {'value': c.factor, 'sd': c.sd}} for c in t.causes],
                'sentence': t.sentence,
            }
            for t in ties(discovery.effects)
        ],
        'setup': [
            {
                'name': f.name,
                'where': f.where,
                'value': f.value,
                'fix': f.fix,
                'evidence': _number(f.evidence),
                'equivalent': list(f.equivalent),
            }
            for f in (() if of_rig is None else of_rig.setup)
        ],
        'moves': None if of_rig is None else dict(zip(('dx_m', 'dy_m', 'theta_rad'), of_rig.moves, strict=True)),
        'remaining': {'rms': discovery.gap_after, 'floors': discovery.floors},
        'gap': {
            'unit': discovery.workspace.unit,
            'before': discovery.gap_before,
            'after': discovery.gap_after,
            'floor': discovery.gap_floor if math.isfinite(discovery.gap_floor) else None,
            'heldout_before': discovery.gap_heldout_before,
            'heldout_after': discovery.gap_heldout_after,
            'per_channel': {
                k: {'before': a, 'after': b, 'heldout': discovery.heldout_per_channel[k]}
                for k, (a, b) in discovery.per_channel.items()
            },
        },
        'nuisance': [{'name': a.effect.name, 'parameters': _fitted(a, sd)} for a, sd in discovery.nuisance],
        'provenance': provenance(discovery),
    }


def law_of(found: FoundLaw) -> dict[str, Any]:
    """The tree of ``law``."""
    law = found.law
    return {
        'stage': law.stage,
        'acts_on': law.acts_on,
        'channels': list(found.channels),
        'variables': list(law.variables),
        'kind': law.kind,
        'expression': law.expression,
        'further': [e.expression for e in found.further],
        'heldout_after': found.heldout_gap,
        'beside': [a.label for a in found.beside],
        'equivalent': [
            {'stage': e.stage, 'acts_on': e.acts_on, 'variables': list(e.variables), 'expression': e.expression}
            for e in found.equivalent
        ],
        'evidence': {
            'delta_bic': _number(found.delta_bic),
            'p': _number(found.p),
            'heldout_gain': _number(found.heldout.gain),
            'heldout_gain_error': _number(found.heldout.error),
        },
    }


def provenance(discovery: Conclusion) -> dict[str, Any]:
    """Hashes, seed, version and cost."""
    return {
        'version': __version__,
        'seed': discovery.seed,
        'forward_simulations': discovery.simulations,
        'recordings': discovery.workspace.provenance(),
    }


def size_of(effect: NamedEffect | Rival) -> str:
    """The fitted amplitudes with their standard deviations, for a person: ``angle 0.00399 ± 2e-05 rad``."""
    out = []
    for p in effect.active.effect.parameters:
        value, sd = effect.active.values[p.name], effect.sd.get(p.name, 0.0)
        if p.kind == 'amplitude' and p.name in effect.sd and abs(value) > 2.0 * sd:
            digits = 1 if sd <= 0.0 else 2 + math.floor(math.log10(abs(value) / sd))
            out.append(f'{p.name} {value:.{min(digits, 6)}g} ± {sd:.1g} {p.unit}'.rstrip())
    return ', '.join(out)


def _left(discovery: Conclusion) -> str:
    """What remains, and how many floors it is."""
    after, floor = (
        discovery.workspace.worded(v, discovery.workspace.digits) for v in (discovery.gap_after, discovery.gap_floor)
    )
    if not math.isfinite(discovery.gap_floor):
        return after
    return f'{after}, {discovery.floors:.2f} times what noise alone leaves ({floor})'


def _setup(discovery: Discovery) -> str:
    """What is wrong with the set-up, in a sentence, or nothing."""
    where: dict[str, dict[str, None]] = {}
    for f in discovery.setup:
        where.setdefault(f.name, {})[f'{f.where}{_seconds(f)}'] = None
    names = [f'{name} ({"; ".join(places)})' for name, places in where.items()]
    return f'The set-up is not as the rig file or the recording says: {", ".join(names)}. ' if names else ''


def _seconds(finding: Finding) -> str:
    """How late a load was noted, or how long it took."""
    if finding.value is None or finding.name not in ('load_time', 'load_ramp'):
        return ''
    late = '' if finding.name == 'load_ramp' else ' late' if finding.value > 0.0 else ' early'
    return f', {abs(finding.value):.2g} s{late}'


def sentence(discovery: Conclusion) -> str:
    """The verdict in one sentence, after one about the set-up if that is wrong."""
    if not isinstance(discovery, Discovery):
        return _missing(discovery) + _tied(discovery)
    return (
        _setup(discovery)
        + _missing(discovery, ' besides' if discovery.setup else '')
        + _tied(discovery)
        + _moved(discovery)
        + _law(discovery)
    )


def _tied(discovery: Conclusion) -> str:
    """The one cause that two effects may have, in two sentences, or nothing."""
    return ''.join(' ' + t.sentence for t in ties(discovery.effects))


def _moved(discovery: Discovery) -> str:
    """What the effects do to an estimate, in a sentence, or nothing."""
    if not discovery.effects:
        return ''
    dx, dy, theta = (1e6 * v for v in discovery.moves)
    them = 'it' if len(discovery.effects) == 1 else 'them'
    return f' Without {them} an estimate is wrong by up to ΔX {dx:.3g} µm, ΔY {dy:.3g} µm, θ {theta:.3g} µrad.'


def _law(discovery: Discovery) -> str:
    """The law for what is unknown, in a sentence, or nothing."""
    if discovery.law is None:
        return ''
    found = discovery.law
    expressions = '; '.join(e.expression for e in found.laws)
    words = f' What remains follows a law ({found.law.stage}, {found.law.kind}): {expressions}'
    beside = [a.effect.name for a in found.beside]
    named = {e.active.effect.name for e in discovery.effects}
    with_law = f'; on unseen load cases it leaves {1e6 * found.heldout_gap:.3f} µm'
    also = f', beside {", ".join(beside)}' if beside and set(beside) != named else ''
    return f'{words}{also}{with_law}.'


def _missing(discovery: Conclusion, besides: str = '') -> str:
    ws, left = discovery.workspace, _left(discovery)
    before = f'{ws.scale_shown[0] * discovery.gap_before:{ws.digits}}'
    if discovery.verdict == 'nothing_missing':
        if not math.isfinite(discovery.gap_floor):
            # Without a stated noise nobody knows whether what remains is noise.
            return f'Nothing in the library helps{besides}; {left} remains, and no noise is stated to hold it against.'
        return f'Nothing is missing{besides}: the gap is {left}.'
    parts = []
    for e in discovery.effects:
        text = e.active.label
        if e.equivalent:
            text += f' (or {", ".join(e.equivalent)}: this data cannot tell)'
        parts.append(text)
    sizes = '; '.join(f'{e.active.effect.name} {size}' for e in discovery.effects if (size := size_of(e)))
    fitted = f' Fitted: {sizes}.' if sizes else ''
    named = ' and '.join(parts)
    if discovery.verdict == 'effects_found':
        is_are, them = ('is', 'it') if len(parts) == 1 else ('are', 'them')
        return f'{named} {is_are} missing from the model; adding {them} closes the gap from {before} to {left}.{fitted}'
    if not any(u.remains for u in discovery.unknown):
        return (
            f'{named} close the gap from {before} to {left}, but their sizes '
            f'are tied: one effect that is not in the catalogue is likelier.'
        )
    if named:
        explains = 'explains' if len(parts) == 1 else 'explain'
        return (
            f'{named} {explains} part, but an unknown effect remains: the gap goes from {before} '
            f'{ws.scale_shown[1]} to {left}.{fitted}'
        )
    return f'An effect that is not in the catalogue: the gap is {left}.'
