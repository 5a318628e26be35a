# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Finds the ports where a device may be: ttyACM0 may become ttyACM1 when a cable is unplugged and plugged in again.

``port`` may be a pattern (``/dev/ttyACM*``). Otherwise every USB serial port of the machine is a candidate,
besides the named port. A device is recognised by the serial number that it reports, never by the port's name.
"""

from __future__ import annotations

import glob

from serial.tools import list_ports

from psd_deflection.devices.port_names import network_address

MAX_PORTS = 64


def is_pattern(port: str) -> bool:
    """Whether ``port`` is a pattern, which may match several ports."""
    # [::1] is no pattern.
    return network_address(port) is None and glob.has_magic(port)


def matching(pattern: str) -> list[str]:
    """The ports that match the pattern now."""
    return sorted(glob.glob(pattern))[:MAX_PORTS]  # noqa: PTH207 - the pattern is a whole path


def candidate_ports(port: str, wanted_serial: str) -> list[str]:
    """Other ports where the device may have come back, the likeliest first.

    A port whose USB descriptor has ``wanted_serial`` goes first. A port of the network is one place.
    """
    if network_address(port) is not None:
        return []
    if is_pattern(port):
        return matching(port)
    ports = [p for p in list_ports.comports() if p.vid is not None and p.device != port]
    ports.sort(key=lambda p: (p.serial_number != wanted_serial, p.device))
    return [p.device for p in ports[:MAX_PORTS]]
