# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""List the effects that can be simulated, corrected and discovered; with a name, explain one.

An effect is physics beyond the nominal rig: a turned detector, a soft clamp, hum. `simulate --effect` adds it,
a rig file lists it below `effects:`, and `discover` finds it. Your own files are listed too.

  psd-deflection effects
  psd-deflection effects sensor_rotation
  psd-deflection effects --json
"""

import argparse
from typing import Any

from psd_deflection.base.errors import UsageError
from psd_deflection.base.tables import columns
from psd_deflection.base.text import did_you_mean
from psd_deflection.cli._report import print_json, show, show_text
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import STAGES, Effect, EffectParameter

_KINDS = {
    'amplitude': 'switches the effect on',
    'coupled': 'counts while the effect is on',
    'shape': 'counts while the effect is on',
    'phase': 'counts while its amplitude is not 0',
    'choice': 'a choice',
}

_CORRECTED = {
    'reading': 'in the reading, if the rig file lists it',
    'wrench': 'in the wrench of a link at rest, if the rig file lists it',
    '': 'no',
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('effect', metavar='NAME', nargs='?', help='explain this effect')
    parser.add_argument('--json', action='store_true', help='for programs: one JSON object, name to declaration')


def run(args: argparse.Namespace) -> int:
    """Print the list, or one effect."""
    known = catalogue()
    if args.effect is not None and args.effect not in known:
        raise UsageError(f'{args.effect}: no effect of that name{did_you_mean(args.effect, known)}')
    shown = sorted(known.values() if args.effect is None else [known[args.effect]], key=lambda e: e.rank)
    if args.json:
        print_json({e.name: as_json(e) for e in shown}, indent=2)
    elif args.effect is None:
        rows = [('effect', 'stage', 'what it does'), *((e.name, e.stage, e.summary) for e in shown)]
        show_text(columns(rows, align_left=3))
        show('', f'in the order in which they act: {", ".join(STAGES)}; psd-deflection effects NAME explains one')
    else:
        show(*explained(shown[0]))
    return 0


def explained(effect: Effect) -> list[str]:
    """One effect for a person, line by line."""
    out = [
        f'{effect.name}: {effect.summary}',
        f'  stage     {effect.stage}',
        f'  equation  {effect.equation}',
        f'  source    {effect.source}',
        f'  needs     {effect.needs}',
        f'  corrected {_CORRECTED[effect.corrected]}',
        '  parameters',
    ]
    for p in effect.parameters:
        unit = f' {p.unit}' if p.unit else ''
        default = (
            'must be given' if p.required else f'default {"that of the rig file" if p.of_rig else f"{p.nominal:g}"}'
        )
        out.append(f'    {p.name}: {p.description}{f" ({p.unit})" if p.unit else ""}')
        out.append(f'        {_bounds(p)}{unit if not p.choices else ""}; {default}; {_KINDS[p.kind]}')
    given = [f'{p.name}={p.choices[0]:g}' for p in effect.parameters if p.required]
    given += [f'{p.name}={example(p):g}' for p in effect.parameters if p.kind == 'amplitude'][:1]
    command = ','.join((effect.name, *given))
    return [*out, f'  try       psd-deflection simulate --out run --loads thesis --effect {command}']


def example(parameter: EffectParameter) -> float:
    """A value at which the effect shows: ten probes from off, within the bounds."""
    if parameter.grid:
        return parameter.grid[-1]
    off = 0.0 if parameter.of_rig else parameter.nominal
    return min(max(off + 10.0 * parameter.scale, parameter.minimum), parameter.maximum)


def as_json(effect: Effect) -> dict[str, Any]:
    """The declaration, as numbers and text."""
    return {
        'stage': effect.stage,
        'summary': effect.summary,
        'equation': effect.equation,
        'source': effect.source,
        'needs': effect.needs,
        'corrected': effect.corrected,
        'parameters': {
            p.name: {
                'unit': p.unit,
                'description': p.description,
                'kind': p.kind,
                'minimum': p.minimum,
                'maximum': p.maximum,
                'default': None if p.required or p.of_rig else p.nominal,
                'choices': list(p.choices),
                'required': p.required,
            }
            for p in effect.parameters
        },
    }


def _bounds(parameter: EffectParameter) -> str:
    if parameter.choices:
        return f'one of {", ".join(str(c) for c in parameter.choices)}'
    return f'{parameter.minimum:g} to {parameter.maximum:g}'
