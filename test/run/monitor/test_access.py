# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import socket

import pytest

from psd_deflection.run.monitor.access import is_loopback, is_own_host, is_own_page, is_token

OWN = socket.gethostname().lower()


@pytest.mark.parametrize(
    ('host', 'address', 'own'),
    [
        ('127.0.0.1:8790', '127.0.0.1', True),
        ('localhost:8790', '127.0.0.1', True),
        ('LOCALHOST', '127.0.0.1', True),
        ('[::1]:8790', '127.0.0.1', True),
        ('localhost.:8790', '127.0.0.1', True),
        # A foreign name that was made to point here.
        ('evil.example:8790', '127.0.0.1', False),
        ('localhost.evil.example', '127.0.0.1', False),
        ('127.0.0.1.evil.example', '127.0.0.1', False),
        ('192.0.2.1', '127.0.0.1', False),
        ('', '127.0.0.1', False),
        ('[::1', '127.0.0.1', False),
        ('evil.example', '0.0.0.0', False),
        ('192.0.2.1:8790', '0.0.0.0', True),
        ('[2001:db8::1]:8790', '::', True),
        (f'{OWN}:8790', '0.0.0.0', True),
        (f'{OWN}.local', '0.0.0.0', True),
        ('rig.example', 'rig.example', True),
        ('127.0.0.1%25x', '127.0.0.1', False),
        ('[::1%eth0]:8790', '127.0.0.1', True),
        ('127.0.0.1/.evil.example', '127.0.0.1', False),
        ('127.0.0.1#.evil.example', '127.0.0.1', False),
        ('evil.example@127.0.0.1', '127.0.0.1', False),
        ('127.0.0.1:8790:1', '127.0.0.1', False),
    ],
)
def test_a_host_header_must_name_this_machine(host: str, address: str, own: bool) -> None:
    assert is_own_host(host, address) is own


@pytest.mark.parametrize(
    ('headers', 'own'),
    [
        ({'Host': '127.0.0.1:8790'}, True),
        ({'Host': '127.0.0.1:8790', 'Origin': 'http://127.0.0.1:8790'}, True),
        ({'Host': '127.0.0.1:8790', 'Origin': 'http://127.0.0.1:8790', 'Sec-Fetch-Site': 'same-origin'}, True),
        ({'Host': '127.0.0.1:8790', 'Sec-Fetch-Site': 'none'}, True),
        ({'Host': '127.0.0.1:8790', 'Origin': 'http://127.0.0.1:8000'}, False),
        ({'Host': '127.0.0.1:8790', 'Origin': 'http://localhost:8790'}, False),
        ({'Host': '127.0.0.1:8790', 'Origin': 'https://evil.example'}, False),
        ({'Host': '127.0.0.1:8790', 'Origin': 'null'}, False),
        ({'Host': '127.0.0.1:8790', 'Sec-Fetch-Site': 'cross-site'}, False),
        ({'Host': '127.0.0.1:8790', 'Sec-Fetch-Site': 'same-site'}, False),
    ],
)
def test_a_request_must_come_from_our_own_page_or_from_none(headers: dict[str, str], own: bool) -> None:
    assert is_own_page(headers) is own


def test_only_loopback_is_loopback() -> None:
    assert all(map(is_loopback, ('127.0.0.1', '127.1.2.3', '::1', 'localhost')))
    assert is_loopback('127.0.0.1%x') is True
    assert not any(map(is_loopback, ('0.0.0.0', '::', '192.0.2.1', 'rig', '')))


def test_a_token_is_right_or_wrong() -> None:
    assert is_token('abc', 'abc')
    assert not any(is_token(given, 'abc') for given in (None, '', 'ab', 'abcd', 'ähc', 'ab\udce9'))
