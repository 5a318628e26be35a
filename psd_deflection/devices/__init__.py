# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Devices: where samples come from, and their simulated twins.

Everything that a plug-in needs is exported here; ``docs/devices/README.md`` shows how to write one. Importing
this package opens no port and computes nothing.
"""

from psd_deflection.devices.device import Answer, Device, LineDevice, PowerUp, Probe, ProtocolProbe
from psd_deflection.devices.source import (
    BadFrame,
    Clock,
    Event,
    HelloFrame,
    Notice,
    PortClosedError,
    Received,
    Sample,
    Source,
    SourceEndedError,
)

__all__ = [
    'Answer',
    'BadFrame',
    'Clock',
    'Device',
    'Event',
    'HelloFrame',
    'LineDevice',
    'Notice',
    'PortClosedError',
    'PowerUp',
    'Probe',
    'ProtocolProbe',
    'Received',
    'Sample',
    'Source',
    'SourceEndedError',
]
