"""Effects in the notation of the command line: ``NAME,KEY=VALUE,...``."""

from __future__ import annotations

from collections.abc import Sequence

from psd_deflection.config import EFFECTS_PREFIX, Rig, replace_values
from psd_deflection.errors import ConfigError
from psd_deflection.simulation.catalogue import effects_of_rig


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
