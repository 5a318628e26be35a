# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The list of effects, how an effect is loaded, and how a rig file switches it on.

An effect is one file with one :class:`~psd_deflection.model.simulation.declaration.Effect` called
``EFFECT``; the file has the effect's name. Adding a file to ``effects/`` or to a folder of
``$PSD_DEFLECTION_EFFECTS`` adds an effect; in such a folder it may also be a law in YAML
(:mod:`.laws`). So does an entry point of the group ``psd_deflection.effects`` of another package.
In a rig file the effects are listed below ``effects:``, one map each, under any key::

    effects:
      sensor_rotation_2: {name: sensor_rotation, psd: 2, angle: 0.01}

This keeps the file a valid ROS 2 parameter file. A law has its text there too, as ``law:``, so that it needs no folder
where the file, or a recording made with it, is read.
"""

import contextlib
import functools
import importlib.util
import math
import os
import pkgutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.plugins import loaded
from psd_deflection.base.text import did_you_mean
from psd_deflection.model.simulation import effects as ours
from psd_deflection.model.simulation.declaration import PSD, ActiveEffect, Effect
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.rig.parameter_files import EFFECTS_PREFIX, flattened
from psd_deflection.rig.parameters import shown

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


LAW = 'law'
"""Key of the text of a law, among the parameters of an effect."""
GROUP = 'psd_deflection.effects'
FOLDERS = 'PSD_DEFLECTION_EFFECTS'

Place: TypeAlias = 'EntryPoint | Path'


def effect_folders() -> list[Path]:
    """Folders with the user's own effect files.

    Those that ``$PSD_DEFLECTION_EFFECTS`` lists, separated like those of ``$PATH``; if it is not
    set, ``psd_deflection/effects`` below ``$XDG_CONFIG_HOME`` (``~/.config``).
    """
    listed = os.environ.get(FOLDERS)
    if listed is None:
        listed = str(Path(os.environ.get('XDG_CONFIG_HOME') or '~/.config') / 'psd_deflection' / 'effects')
    try:
        return [Path(folder).expanduser() for folder in listed.split(os.pathsep) if folder]
    except RuntimeError:
        # A service may have no home directory.
        return []


def _places() -> dict[str, Place]:
    """Where each effect is, by name; nothing is imported. Raises ConfigError if two have one name."""
    # Imported here: it is slow, and a rig without effects does not need it.
    from importlib.metadata import EntryPoint, entry_points

    names = [module.name for module in pkgutil.iter_modules(ours.__path__)]
    places: dict[str, Place] = {name: EntryPoint(name, f'{ours.__name__}.{name}:EFFECT', GROUP) for name in names}
    plug_ins: list[tuple[str, Place]] = []
    for folder in dict.fromkeys(effect_folders()):
        try:
            files = sorted(f for f in folder.iterdir() if f.suffix in ('.py', '.yaml'))
        except OSError as error:
            # The default folder is optional, and a service may not be allowed to read a home.
            if FOLDERS in os.environ:
                raise ConfigError(f'{FOLDERS}: {folder}: cannot be read ({error.strerror or error})') from None
            continue
        plug_ins += [(f.stem, f) for f in files if f.stem.isidentifier() and not f.stem.startswith('_')]
    plug_ins += [(point.name, point) for point in entry_points(group=GROUP)]
    for name, place in plug_ins:
        if name in places:
            raise ConfigError(f'{_words(place)}: the effect {name} is in {_words(places[name])} already; rename one')
        places[name] = place
    return places


def _words(place: Place) -> str:
    return str(place) if isinstance(place, Path) else place.value


def effect_names() -> list[str]:
    """Every effect's name, without loading any. Raises ConfigError if two have one name."""
    return sorted(_places())


@functools.cache
def _of_file(path: Path, _written_ns: int) -> object:
    """What the file of an effect holds; read anew once it is written anew."""
    if path.suffix == '.yaml':
        # Imported here: it needs the filters, which a rig without laws does not.
        from psd_deflection.model.simulation.law_files import read_law
        from psd_deflection.model.simulation.laws import effect_of

        return effect_of(read_law(path))
    spec = importlib.util.spec_from_file_location(f'{__name__}.{path.stem}', path)
    if spec is None or spec.loader is None:
        raise ImportError(f'{path} is not a Python file')
    module = importlib.util.module_from_spec(spec)
    # Dataclasses in the file look up their module in sys.modules.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module.EFFECT


@functools.cache
def _of_text(text: str, source: str) -> Effect:
    # Imported here, as above.
    from psd_deflection.model.simulation.law_files import law_of_text
    from psd_deflection.model.simulation.laws import effect_of

    return effect_of(law_of_text(text, source))


def _load(name: str, place: Place) -> Effect:
    effect = loaded(
        f'{_words(place)}: holds no effect',
        lambda: _of_file(place, place.stat().st_mtime_ns) if isinstance(place, Path) else place.load(),
    )
    if not isinstance(effect, Effect):
        raise ConfigError(f'{_words(place)}: EFFECT = {effect!r}: must be an Effect')
    if effect.name != name:
        raise ConfigError(f'{_words(place)}: name = {effect.name!r}: must be {name!r}, like the file or entry point')
    return effect


def catalogue(psds: int = 2) -> Mapping[str, Effect]:
    """Every effect by name, as it is on a rig of so many ``psds``, in the order in which they act.

    Raises ConfigError if one cannot be loaded.
    """
    return {name: effect.on(psds) for name, effect in _loaded(_places()).items()}


def effects_for(psds: int) -> list[Effect]:
    """Every effect that a rig of so many ``psds`` may have, as it is there. Raises ConfigError as :func:`catalogue`."""
    return [effect for effect in catalogue(psds).values() if effect.least_psds <= psds]


def our_effects(*names: str) -> Mapping[str, Effect]:
    """The package's own effects and those of ``names``, by name, as of two PSDs.

    What else a user has is not loaded, so it cannot fail.
    """
    package_names = {module.name for module in pkgutil.iter_modules(ours.__path__)}
    effects = _loaded({name: place for name, place in _places().items() if name in package_names or name in names})
    return {name: effect.on(2) for name, effect in effects.items()}


def _loaded(places: Mapping[str, Place]) -> dict[str, Effect]:
    effects = [_load(name, place) for name, place in places.items()]
    return {e.name: e for e in sorted(effects, key=lambda e: e.rank)}


def make_active(name: str, values: Mapping[str, object], source: str, psds: int = 2) -> ActiveEffect:
    """Load this effect only, as it is on a rig of so many ``psds``, and check its parameters.

    Raises ConfigError naming source, key, value, bound, or the file that cannot be loaded.
    """
    return _made(name, values, source, _places(), psds)


def _made(name: str, values: Mapping[str, object], source: str, places: Mapping[str, Place], psds: int) -> ActiveEffect:
    effect = _effect(name, values, source, places).on(psds)
    values = {key: value for key, value in values.items() if key != LAW}
    known = [p.name for p in effect.parameters]
    for key in values:
        if key not in known:
            raise ConfigError(f'{source}: {key} = {values[key]!r}: {name} has the parameters {", ".join(known)}')
    out: dict[str, float] = {}
    for p in effect.parameters:
        if p.name not in values:
            if p.required:
                raise ConfigError(f'{source}: {p.name} is missing: {name} needs it ({p.description}, {p.unit or "1"})')
            out[p.name] = p.nominal
            continue
        out[p.name] = p.checked(values[p.name], source)
    sizes = [p.name for p in effect.parameters if p.kind == 'amplitude']
    if not any(name in values for name in sizes):
        raise ConfigError(
            f'{source}: {name} is off without {" or ".join(sizes)}: psd-deflection effects {name} explains them'
        )
    return ActiveEffect(effect, out)


def _effect(name: str, values: Mapping[str, object], source: str, places: Mapping[str, Place]) -> Effect:
    """The effect that ``values`` have the law of, or the one that is in its place."""
    if LAW in values:
        effect = _of_text(str(values[LAW]), f'{source}.{LAW}')
        if effect.name != name:
            raise ConfigError(f'{source}.{LAW}: name = {effect.name!r}: must be {name!r}, as in {source}.name')
        return effect
    if name not in places:
        meant = _called(name.lower(), places)
        hint = (
            f'; did you mean {meant}?'
            if meant
            else did_you_mean(name, places) or f'; there are: {", ".join(sorted(places))}'
        )
        folders = ', '.join(str(folder) for folder in effect_folders())
        yours = f' (one of your own is {name}.py or {name}.yaml in {folders}, see {FOLDERS})' if folders else ''
        raise ConfigError(f'{source}: name = {name!r}: no effect of that name{hint}{yours}')
    return _load(name, places[name])


def _called(word: str, places: Mapping[str, Place]) -> str:
    """The name of the effect that people call ``word``; nothing if none is called so."""
    for name, place in sorted(places.items()):
        # One that cannot be loaded is rejected where it is asked for.
        with contextlib.suppress(ConfigError):
            if word in _load(name, place).also:
                return name
    return ''


def with_laws(values: Mapping[str, object]) -> dict[str, object]:
    """Flat ``values`` of a rig with the text of each law that its effects are, for where their folder is not.

    As they were if the folders have none that can be read: these values are kept, and not used.
    """
    out = dict(values)
    groups = {key.split('.')[1] for key in values if key.startswith(EFFECTS_PREFIX) and key.count('.') == 2}
    try:
        places = _places() if groups else {}
        for group in sorted(groups):
            name = str(values.get(f'{EFFECTS_PREFIX}{group}.name', group))
            place = places.get(name)
            if isinstance(place, Path) and (law := _load(name, place).law):
                out.setdefault(f'{EFFECTS_PREFIX}{group}.{LAW}', law)
    except ConfigError:
        return dict(values)
    return out


def effects_of_rig(rig: Rig) -> list[ActiveEffect]:
    """The effects of a rig file, from flat keys ``KEY.name``, ``KEY.angle`` ...; raises ConfigError."""
    groups: dict[str, dict[str, object]] = {}
    for key, value in rig.effects.items():
        group, dot, name = key.partition('.')
        if not dot:
            raise ConfigError(f'effects.{key} = {value!r}: must be a map with the name and the parameters of an effect')
        groups.setdefault(group, {})[name] = value
    effects = []
    # Looked up once: it takes as long as a block.
    places = _places() if groups else {}
    for group, body in groups.items():
        name = str(body.pop('name', group))
        active = _made(name, body, f'effects.{group}', places, len(rig.psds))
        if PSD in active.effect.parameters and active.values[PSD.name] > len(rig.psds):
            raise ConfigError(
                f'effects.{group}: psd = {active.values[PSD.name]:g}: the rig has {len(rig.psds)} PSDs (psd_N.center)'
            )
        if active.effect.least_psds > len(rig.psds):
            raise ConfigError(
                f'effects.{group}: {name} is of a rig of {active.effect.least_psds} PSDs, this one has {len(rig.psds)} '
                '(psd_N.center)'
            )
        effects.append(active)
    return sort_effects(effects)


def sort_effects(effects: Sequence[ActiveEffect]) -> list[ActiveEffect]:
    """In the order in which they act."""
    return sorted(effects, key=lambda a: a.effect.rank)


def acting(effects: Sequence[ActiveEffect]) -> tuple[ActiveEffect, ...]:
    """The parts of ``effects``: ordered as these are, or as they act if one acts at several points."""
    parts = [part for active in effects for part in active.parts]
    return tuple(sort_effects(parts) if len(parts) > len(effects) else parts)


def effects_to_values(effects: Sequence[ActiveEffect]) -> dict[str, dict[str, object]]:
    """The map that goes below ``effects:`` in a rig file."""
    out: dict[str, dict[str, object]] = {}
    for active in effects:
        key = active.effect.name
        for p in active.effect.parameters:
            if p.kind == 'choice':
                key += f'_{active.values[p.name]:g}'
        base, n = key, 2
        while key in out:
            key, n = f'{base}_{n}', n + 1
        body: dict[str, object] = {'name': active.effect.name}
        for p in active.effect.parameters:
            value = float(active.values[p.name])
            if math.isfinite(value):
                body[p.name] = int(value) if p.kind == 'choice' else value
        if active.effect.law:
            body[LAW] = active.effect.law
        out[key] = body
    return out


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
