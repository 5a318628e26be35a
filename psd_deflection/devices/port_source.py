# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Common base of the sources on one port: open it, give up, close, and reject use before the port is open."""

import threading
from collections.abc import Mapping, Sequence

from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.devices.port import OpenPort, has_baud, network_address
from psd_deflection.devices.ports import open_port
from psd_deflection.devices.source import Notice, Source
from psd_deflection.devices.udp_port import Datagrams


class PortSource(Source):
    """A source on one port. ``_port`` is the open port, None if it is closed.

    ``datagrams``: what it wants of datagrams. Raises ConfigError if ``name`` is no name of a port.
    """

    datagrams: Datagrams | None = None

    def __init__(self, name: str) -> None:
        network_address(name)
        self.name = name
        self._port: OpenPort | None = None
        self._given_up = threading.Event()

    def open_port(self, baud: int, *, rtscts: bool = False) -> OpenPort:
        """Open the port ``name``; raises DeviceError that says what to do."""
        self._port = open_port(self.name, baud, rtscts=rtscts, given_up=self._given_up, datagrams=self.datagrams)
        return self._port

    def _opened(self) -> OpenPort:
        if self._port is None:
            raise DeviceError(f'{self.name}: not open')
        return self._port

    def _notices(self) -> Sequence[Notice]:
        """What a person should be told of the port."""
        return () if self._port is None else self._port.notices()

    def _describe_port(self, what: str, baud: int) -> Mapping[str, str]:
        """``what`` on the port, and the port's own state."""
        # Another thread may close it meanwhile.
        port = self._port
        speed = f', {baud} baud' if has_baud(self.name) else ''
        return {'source': f'{what} on {self.name}{speed}', **({} if port is None else port.describe())}

    def _is_speed_right(self, baud: int) -> str:
        """The question for a port on which bytes come that make no sense."""
        return f'is the baud rate ({baud}) right' if has_baud(self.name) else 'is the line speed at the other end right'

    def give_up(self) -> None:
        """Stop waiting for the device."""
        self._given_up.set()

    def close(self) -> None:
        """Give the port back."""
        port, self._port = self._port, None
        if port is not None:
            port.close()


def reject_datagrams(source: str, *names: str) -> None:
    """Raise ConfigError if one of these ports takes datagrams, for a device that sends only when it is asked."""
    for name in names:
        address = network_address(name)
        if address is not None and address.scheme == 'udp':
            raise ConfigError(
                f'source = {source}: port = {name!r}: the device sends only when it is asked, and over udp:// there is '
                'nobody to ask; use socket:// or rfc2217://'
            )
