# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Opens a port by its name: a serial port of this machine, or a port of the network by its scheme."""

from __future__ import annotations

import threading

from psd_deflection.devices.port import OpenPort
from psd_deflection.devices.port_names import network_address
from psd_deflection.devices.serial_port import SerialPort
from psd_deflection.devices.udp_port import Datagrams


def open_port(
    name: str,
    baud: int,
    *,
    rtscts: bool = False,
    given_up: threading.Event | None = None,
    datagrams: Datagrams | None = None,
) -> OpenPort:
    """Open the port ``name`` at ``baud`` (if it has a line speed), with ``rtscts`` (if it has those lines).

    ``given_up``: ends every wait for it once it is set, that for a connection too. ``datagrams``: what is wanted of
    them, for ``udp://``.
    Raises DeviceError with the name if it cannot be opened, ConfigError if it is no name of a port.
    """
    address = network_address(name)
    if address is None:
        return SerialPort(name, baud, rtscts, given_up)
    if address.scheme == 'socket':
        from psd_deflection.devices.tcp_port import TcpPort

        return TcpPort(name, address, given_up)
    if address.scheme == 'udp':
        from psd_deflection.devices.udp_port import UdpPort

        return UdpPort(name, address, datagrams, given_up)
    from psd_deflection.devices.rfc2217_port import Rfc2217Port

    return Rfc2217Port(name, address, baud, rtscts=rtscts, given_up=given_up)
