# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the parameter ``port`` may name: a serial port, or a port of the network by its scheme."""

from __future__ import annotations

import re
from dataclasses import dataclass

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.spelling import did_you_mean
from psd_deflection.rig.parameters import shown

SCHEMES = ('socket', 'rfc2217', 'udp')
"""``socket``: bytes over TCP. ``rfc2217``: a serial port over TCP, with its speed. ``udp``: datagrams that come."""

FORMS = 'a serial port, socket://HOST:PORT, rfc2217://HOST:PORT or udp://HOST:PORT'

OPTION = 'ign_set_control'
"""The option of an rfc2217 address: for servers that do not answer what is set of the control lines."""

_OTHER_NAMES = {'tcp': 'socket', 'telnet': 'rfc2217'}
_URL = re.compile(r'([A-Za-z][A-Za-z0-9+.-]*)://(.*)', re.DOTALL)
_PLACE = re.compile(
    r'(?:\[(?P<six>[0-9A-Fa-f:.]+(?:%\w+)?)\]|(?P<host>[\w.-]+)):(?P<port>[0-9]{1,5})(?P<rest>.*)', re.DOTALL
)


@dataclass(frozen=True, slots=True)
class Address:
    """A port of the network. ``host``: a name or a number, without brackets. ``option``: what follows a ``?``."""

    scheme: str
    host: str
    port: int
    option: str = ''

    @property
    def has_baud(self) -> bool:
        """Whether a line speed can be set there."""
        return self.scheme == 'rfc2217'


def network_address(name: str, key: str = 'port', least: int = 1) -> Address | None:
    """The address that ``name`` gives, None if it names a port of this machine.

    ``least``: smallest number of a port. Raises ConfigError, which names ``key``, for another scheme, and for an
    address that is not complete.
    """
    url = _URL.fullmatch(name)
    if url is None:
        return None
    scheme = url[1].lower()
    if scheme not in SCHEMES:
        near = _OTHER_NAMES.get(scheme)
        hint = f'; did you mean {near}://?' if near else did_you_mean(scheme, SCHEMES)
        raise ConfigError(f'{key} = {shown(name)}: must be {FORMS}{hint}')
    place = _PLACE.fullmatch(url[2])
    form = f'{scheme}://HOST:PORT'
    if place is None:
        six = '; a number of IPv6 stands in brackets: [::1]' if url[2].count(':') > 1 else ''
        raise ConfigError(f'{key} = {shown(name)}: must be {form}{six}')
    port = int(place['port'])
    if not least <= port <= 65535:
        raise ConfigError(f'{key} = {shown(name)}: the last number must be at least {least} and at most 65535')
    option = place['rest'].removeprefix('?')
    if place['rest'] and not (scheme == 'rfc2217' and option == OPTION):
        also = f' or {form}?{OPTION}' if scheme == 'rfc2217' else ''
        raise ConfigError(f'{key} = {shown(name)}: must be {form}{also}')
    return Address(scheme, place['six'] or place['host'], port, option)


def has_baud(name: str) -> bool:
    """Whether the port of that name has a line speed. Raises ConfigError as :func:`network_address`."""
    address = network_address(name)
    return address is None or address.has_baud
