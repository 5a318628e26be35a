# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Maps the names that ``source:`` of a rig file may have to devices, including plug-ins of other packages.

A plug-in declares an entry point of the group ``psd_deflection.sources``. Its object is a
:class:`~psd_deflection.devices.device.Device`, or only a class derived from
:class:`~psd_deflection.devices.source.Source`, made with the rig alone::

    [options.entry_points]
    psd_deflection.sources =
        my_converter = my_package.source:MyConverter
"""

import importlib
from collections.abc import Iterator
from importlib.metadata import entry_points
from types import MappingProxyType

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.plugins import loaded
from psd_deflection.base.text import did_you_mean
from psd_deflection.devices.device import Device
from psd_deflection.devices.source import Source
from psd_deflection.rig.config import Rig

GROUP = 'psd_deflection.sources'

DEVICES: MappingProxyType[str, str] = MappingProxyType(
    {
        'serial': 'psd_deflection.devices.contract_frames',
        'dataq': 'psd_deflection.devices.dataq',
        'thorlabs': 'psd_deflection.devices.thorlabs',
        'lines': 'psd_deflection.devices.text_lines',
        'replay': 'psd_deflection.devices.replay',
    }
)
"""Name to the module with its ``DEVICE``, the default first; a module is imported when its device is needed."""


def find_device(name: str) -> Device:
    """The device of that name.

    Raises ConfigError for a name that is neither ours nor a plug-in's, and for a plug-in that cannot be loaded.
    """
    if name in DEVICES:
        ours: Device = importlib.import_module(DEVICES[name]).DEVICE
        return ours
    points = [e for e in entry_points(group=GROUP) if e.name == name]
    if not points:
        known = source_names()
        raise ConfigError(f'source = {name!r}: must be one of {", ".join(known)}{did_you_mean(name, known)}')
    plug_in: object = loaded(f'source = {name!r}: {points[0].value} cannot be loaded', points[0].load)
    if isinstance(plug_in, type) and issubclass(plug_in, Source):
        return Device(name, f'plug-in {points[0].value}', plug_in)
    if not isinstance(plug_in, Device):
        raise ConfigError(
            f'source = {name!r}: {plug_in!r} is neither a psd_deflection.devices.Device nor derived from Source there'
        )
    if plug_in.name != name:
        raise ConfigError(f'source = {name!r}: {points[0].value} declares itself as {plug_in.name!r}; name both alike')
    return plug_in


def make_source(rig: Rig) -> Source:
    """The source that ``source:`` of the rig names, not yet opened.

    Raises ConfigError as :func:`find_device`, and if the rig does not suit that source.
    """
    device = find_device(rig.acquisition.source)
    if len(rig.psds) > device.most_psds:
        raise ConfigError(
            f'source = {device.name!r}: has inputs for {device.most_psds} PSDs, the rig file has {len(rig.psds)} '
            '(psd_N.center)'
        )
    return device.make(rig)


def source_names() -> list[str]:
    """Names of our devices, then of those of plug-ins."""
    return [*DEVICES, *sorted(e.name for e in entry_points(group=GROUP) if e.name not in DEVICES)]


def known_devices() -> tuple[list[Device], list[str]]:
    """Every device, and the errors of plug-ins that cannot be loaded."""
    devices: list[Device] = []
    rejections: list[str] = []
    for name in source_names():
        try:
            devices.append(find_device(name))
        except ConfigError as error:
            rejections.append(str(error))
    return devices, rejections


class SimulatedNames:
    """The names of the devices that can be simulated, as a container; a module is imported at the first look-up."""

    def __contains__(self, name: object) -> bool:
        try:
            return find_device(str(name)).simulate is not None
        except ConfigError:
            return False

    def __iter__(self) -> Iterator[str]:
        return (device.name for device in known_devices()[0] if device.simulate is not None)


SIMULATED = SimulatedNames()
