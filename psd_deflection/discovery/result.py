"""The output of discover: result.json and model.yaml (docs/discover.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from psd_deflection import __version__
from psd_deflection.config import DESCRIPTION, Rig
from psd_deflection.discovery.discover import Discovery, NamedEffect
from psd_deflection.simulation.catalogue import effects_to_values
from psd_deflection.simulation.declaration import ActiveEffect


def _number(value: float) -> float:
    # JSON has no infinity; for a chi-square or standard deviation this is as good.
    if math.isnan(value):
        return 0.0
    return float(min(max(value, -1e300), 1e300))


def parameters_of(effect: NamedEffect) -> dict[str, Any]:
    """Choices as numbers, the rest with standard deviation and unit."""
    out: dict[str, Any] = {}
    for p in effect.active.effect.parameters:
        value = effect.active.values[p.name]
        if p.kind == 'choice':
            out[p.name] = int(value)
        elif math.isfinite(value):
            sd = effect.sd.get(p.name, 0.0)
            out[p.name] = {'value': _number(value), 'sd': _number(sd), 'unit': p.unit}
    return out


def result(discovery: Discovery) -> dict[str, Any]:
    """The tree of result.json."""
    where = [
        {
            'channel': c.channel,
            'recording': discovery.workspace.observations[c.recording].name,
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
        }
        for e in discovery.effects
    ]
    unknown = [
        {'signature': u.signature, 'depends_on': list(u.depends_on), 'explains': u.explains} for u in discovery.unknown
    ]
    return {
        'verdict': discovery.verdict,
        'where': where,
        'effects': effects,
        'unknown': unknown,
        'gap': {
            'unit': 'm',
            'before': discovery.gap_before,
            'after': discovery.gap_after,
            'floor': discovery.gap_floor,
            'heldout_before': discovery.gap_heldout_before,
            'heldout_after': discovery.gap_heldout_after,
            'per_channel': {k: {'before': a, 'after': b} for k, (a, b) in discovery.per_channel.items()},
        },
        'provenance': provenance(discovery),
    }


def provenance(discovery: Discovery) -> dict[str, Any]:
    """Hashes, seed, version and cost."""
    return {
        'version': __version__,
        'seed': discovery.seed,
        'forward_simulations': discovery.simulations,
        'recordings': [
            {
                'name': o.name,
                'sha256': o.digest or o.hashed(),
                'seconds': o.duration,
                'rest_seconds': w.rest_seconds,
                'noise_v': [float(s) for s in w.sigma],
                'coloured': list(w.coloured),
            }
            for o, w in zip(discovery.workspace.observations, discovery.workspace.noise, strict=True)
        ],
    }


def _nested(flat: Mapping[str, object]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for key, value in flat.items():
        *path, last = key.split('.')
        at = tree
        for step in path:
            at = at.setdefault(step, {})
        at[last] = list(value) if isinstance(value, tuple) else value
    return tree


def model_yaml(rig: Rig, effects: Sequence[ActiveEffect]) -> str:
    """What describes the rig, as a ROS 2 parameter file with ``effects`` instead of its own.

    For a rig without a file of its own; :func:`psd_deflection.parameter_files.with_effects_section` adds them to a
    file. Port, folders and page are left out: they belong to a machine.
    """
    tree = _nested({name: rig.values[name] for name in DESCRIPTION})
    if effects:
        tree['effects'] = effects_to_values(effects)
    return yaml.safe_dump({'/**': {'ros__parameters': tree}}, sort_keys=False, allow_unicode=True)


def sentence(discovery: Discovery) -> str:
    """The verdict in one sentence."""
    floor, after, before = (1e6 * v for v in (discovery.gap_floor, discovery.gap_after, discovery.gap_before))
    if discovery.verdict == 'nothing_missing':
        return f'Nothing is missing: the gap of {before:.3f} µm is that of noise alone ({floor:.3f} µm).'
    parts = []
    for e in discovery.effects:
        text = e.active.label
        if e.equivalent:
            text += f' (or {", ".join(e.equivalent)}: this data cannot tell)'
        parts.append(text)
    named = ' and '.join(parts)
    if discovery.verdict == 'effects_found':
        is_are = 'is' if len(parts) == 1 else 'are'
        return (
            f'{named} {is_are} missing from the model; adding {"it" if len(parts) == 1 else "them"} '
            f'closes the gap from {before:.3f} to {after:.3f} µm (noise alone: {floor:.3f} µm).'
        )
    if not any(u.remains for u in discovery.unknown):
        return (
            f'{named} close the gap from {before:.3f} to {after:.3f} µm (noise alone: {floor:.3f} µm), but their sizes '
            f'are tied: one effect that is not in the catalogue is likelier.'
        )
    lead = (
        f'{named} explains part, but an unknown effect remains' if named else 'An effect that is not in the catalogue'
    )
    return f'{lead}: the gap is {after:.3f} µm (noise alone: {floor:.3f} µm).'
