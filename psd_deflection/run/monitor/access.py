# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Who may see the page and who may press its buttons.

Any web page can make a browser send requests, also to 127.0.0.1. So a request must name this
machine as its host: otherwise a foreign name could point here (DNS rebinding). A request that
comes from a page must come from our page: otherwise any site could take the zero (cross-site request
forgery, cross-site websocket hijacking). If others on the network can reach the page, its
buttons also need a token.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import socket
from collections.abc import Mapping

_HOST = re.compile(r'(?:\[([0-9a-f:.]+(?:%[a-z0-9._-]+)?)\]|([a-z0-9._-]+))(?::[0-9]{1,5})?')


def host_name(host_header: str) -> str:
    """The name in a Host header, without port and brackets, lower case; '' if it is malformed."""
    found = _HOST.fullmatch(host_header.lower())
    return (found[1] or found[2]).rstrip('.') if found is not None else ''


def is_address(name: str) -> bool:
    """Whether ``name`` is an IP address, which no name server can redirect."""
    try:
        ipaddress.ip_address(name.partition('%')[0])
    except ValueError:
        return False
    return True


def is_loopback(address: str) -> bool:
    """Whether only this machine can reach a server bound to ``address``."""
    if address == 'localhost':
        return True
    return is_address(address) and ipaddress.ip_address(address.partition('%')[0]).is_loopback


def is_own_host(host_header: str, address: str) -> bool:
    """Whether the Host header names this machine: an address, localhost, or its host name."""
    name = host_name(host_header)
    if not name:
        return False
    if is_loopback(address):
        return is_loopback(name)
    own = socket.gethostname().lower()
    return is_address(name) or name in ('localhost', address.lower(), own, own + '.local')


def is_own_page(headers: Mapping[str, str]) -> bool:
    """Whether a request comes from our page, or from no page at all (curl has no Origin)."""
    if headers.get('Sec-Fetch-Site', 'same-origin') not in ('same-origin', 'none'):
        return False
    origin = headers.get('Origin')
    return origin is None or origin.lower() == f'http://{headers.get("Host", "").lower()}'


def is_token(given: str | None, expected: str) -> bool:
    """Whether the token is right, compared in constant time."""
    # A header may hold bytes that are not text; they appear as lone surrogates.
    return given is not None and hmac.compare_digest(
        given.encode(errors='surrogateescape'), expected.encode(errors='surrogateescape')
    )
