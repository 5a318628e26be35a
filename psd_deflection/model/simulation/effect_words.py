# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects in the notation of the command line, ``NAME,KEY=VALUE,...``, and as a map like that of a rig file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.rig.parameter_files import EFFECTS_PREFIX, flattened
from psd_deflection.rig.parameters import shown


def with_effects(rig: Rig, words: Sequence[str], source: str) -> Rig:
    """``rig`` with the effects of ``words``, all checked. Raises ConfigError naming ``source``."""
    changes: dict[str, object] = {}
    for i, text in enumerate(words):
        name, *pairs = text.split(',')
        changes[f'{EFFECTS_PREFIX}effect_{i}.name'] = name
        for pair in pairs:
            key, equals, value = pair.partition('=')
            if not equals:
                raise ConfigError(f'{source} {text}: {pair!r} is not KEY=VALUE')
            changes[f'{EFFECTS_PREFIX}effect_{i}.{key}'] = value
    changed = replace_values(rig, changes, source) if changes else rig
    effects_of_rig(changed)
    return changed


def with_effects_of(rig: Rig, effects: str | Sequence[str] | Mapping[str, object], source: str) -> Rig:
    """``rig`` with ``effects``: words of the command line, or a map like that below ``effects:`` of a rig file.

    Raises ConfigError naming ``source``.
    """
    if isinstance(effects, str):
        effects = [effects]
    if isinstance(effects, Mapping):
        taken = {key.partition('.')[0] for key in rig.effects}
        tree = {
            # An effect of the rig file stays beside a hidden one of its name.
            f'hidden_{key}' if key in taken else key: {'name': key, **body} if isinstance(body, Mapping) else body
            for key, body in effects.items()
        }
        changed = replace_values(rig, flattened({EFFECTS_PREFIX.rstrip('.'): tree}, source), source)
        effects_of_rig(changed)
        return changed
    if not isinstance(effects, Sequence) or not all(isinstance(text, str) for text in effects):
        raise ConfigError(
            f"{source} = {shown(effects)}: must be ['NAME,KEY=VALUE,...'] or a map {{NAME: {{KEY: VALUE}}}}"
        )
    return with_effects(rig, effects, source)
