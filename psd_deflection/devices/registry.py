"""Names to sources: what ``source:`` of a rig file may say, plug-ins of other packages included.

A plug-in declares an entry point of the group ``psd_deflection.sources`` whose object is a class
derived from :class:`~psd_deflection.devices.source.Source`, made with the rig alone::

    [options.entry_points]
    psd_deflection.sources =
        my_converter = my_package.source:MyConverter
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from importlib.metadata import entry_points
from types import MappingProxyType

from psd_deflection.config import Rig
from psd_deflection.devices.source import Source
from psd_deflection.errors import ConfigError, did_you_mean

GROUP = 'psd_deflection.sources'

SOURCES: MappingProxyType[str, str] = MappingProxyType(
    {
        'serial': 'psd_deflection.devices.contract_frames:ContractFrames',
        'dataq': 'psd_deflection.devices.dataq:Dataq',
        'thorlabs': 'psd_deflection.devices.thorlabs:ThorlabsPair',
        'lines': 'psd_deflection.devices.text_lines:TextLines',
        'replay': 'psd_deflection.devices.replay:Replay',
    }
)
"""Name to ``module:class``, the default first; a module is imported when its source is asked for."""


def make_source(rig: Rig) -> Source:
    """The source that ``source:`` of the rig names, not yet opened.

    Raises ConfigError for a name that is neither ours nor a plug-in's, for a plug-in that cannot be
    loaded, and where the rig cannot be for that source.
    """
    return _find(rig.acquisition.source)(rig)


def source_names() -> list[str]:
    """Ours, then those of plug-ins."""
    return [*SOURCES, *sorted(e.name for e in entry_points(group=GROUP) if e.name not in SOURCES)]


def _find(name: str) -> Callable[[Rig], Source]:
    if name in SOURCES:
        module, _, attribute = SOURCES[name].partition(':')
        found: object = getattr(importlib.import_module(module), attribute)
    else:
        points = [e for e in entry_points(group=GROUP) if e.name == name]
        if not points:
            known = source_names()
            raise ConfigError(f'source = {name!r}: must be one of {", ".join(known)}{did_you_mean(name, known)}')
        try:
            found = points[0].load()
        except Exception as error:
            # Whatever a stranger's module raises on import, the user needs its name and its cause.
            raise ConfigError(f'source = {name!r}: {points[0].value} cannot be loaded ({error!r})') from error
    if not (isinstance(found, type) and issubclass(found, Source)):
        raise ConfigError(f'source = {name!r}: {found!r} is not derived from psd_deflection.devices Source')
    return found
