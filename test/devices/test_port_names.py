# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the parameter ``port`` may name."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.base.errors import ConfigError
from psd_deflection.devices.port_names import Address, has_baud, network_address
from psd_deflection.devices.port_search import candidate_ports, is_pattern
from psd_deflection.devices.registry import make_source
from psd_deflection.rig.config import load_rig


@pytest.mark.parametrize(
    ('name', 'address'),
    [
        ('socket://rig-pi.local:4000', Address('socket', 'rig-pi.local', 4000)),
        ('SOCKET://192.168.1.20:65535', Address('socket', '192.168.1.20', 65535)),
        ('socket://[::1]:1', Address('socket', '::1', 1)),
        ('udp://0.0.0.0:4000', Address('udp', '0.0.0.0', 4000)),
        ('udp://[fe80::1%eth0]:4000', Address('udp', 'fe80::1%eth0', 4000)),
        ('rfc2217://rig:2217', Address('rfc2217', 'rig', 2217)),
        ('rfc2217://rig:2217?ign_set_control', Address('rfc2217', 'rig', 2217, 'ign_set_control')),
        ('/dev/ttyACM0', None),
        ('/dev/serial/by-id/usb-Arduino_[1]', None),
        ('rig_port', None),
        ('TCPIP0::192.168.1.20::INSTR', None),
    ],
)
def test_a_name(name: str, address: Address | None) -> None:
    assert network_address(name) == address
    assert has_baud(name) == (address is None or address.scheme == 'rfc2217')


@pytest.mark.parametrize(
    ('name', 'message'),
    [
        ('tcp://rig:4000', 'rfc2217://HOST:PORT or udp://HOST:PORT; did you mean socket://'),
        ('sockt://rig:4000', 'did you mean socket'),
        ('http://rig:80', 'must be a serial port, socket://HOST:PORT, rfc2217://HOST:PORT or udp://HOST:PORT'),
        ('socket://rig', 'must be socket://HOST:PORT'),
        ('socket://:4000', 'must be socket://HOST:PORT'),
        ('socket://::1:4000', r'IPv6 stands in brackets: \[::1\]'),
        ('socket://rig:0', 'the last number must be at least 1 and at most 65535'),
        ('udp://rig:65536', 'the last number must be at least 1 and at most 65535'),
        ('socket://rig:40 00', 'must be socket://HOST:PORT'),
        ('socket://rig:4000/path', 'must be socket://HOST:PORT'),
        ('socket://rig:4000?logging=debug', 'must be socket://HOST:PORT'),
        ('rfc2217://rig:4000?logging=debug', r'or rfc2217://HOST:PORT\?ign_set_control'),
        ('socket://' + 'x' * 5000, 'must be socket'),
    ],
)
def test_invalid_port_reports_key_value_and_bounds(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        make_source(load_rig(overrides={'port': name}))
    assert str(error.value).startswith(f'port = {name[:20]!r}'[:-1])
    assert len(str(error.value)) < 400
    assert '\n' not in str(error.value)


@given(st.text(max_size=60))
def test_no_name_is_a_crash(rest: str) -> None:
    for name in (rest, f'socket://{rest}', f'udp://{rest}:4000', f'rfc2217://rig:{rest}'):
        try:
            address = network_address(name)
        except ConfigError:
            continue
        else:
            assert address is None or 1 <= address.port <= 65535


def test_a_device_that_must_be_asked_is_not_looked_for_over_udp() -> None:
    ten_volts = {'converter.bits': 16, 'converter.full_scale': 10.0}
    for source, port in (('dataq', 'udp://0.0.0.0:4000'), ('thorlabs', 'socket://a:1,udp://0.0.0.0:4000')):
        with pytest.raises(
            ConfigError, match=rf'source = {source}: port = .udp://0\.0\.0\.0:4000.: the device sends only'
        ):
            make_source(load_rig(overrides={'source': source, 'port': port, **ten_volts}))


def test_network_port_is_no_pattern_without_candidates() -> None:
    assert not is_pattern('socket://[::1]:4000')
    assert is_pattern('/dev/ttyACM[01]')
    assert candidate_ports('socket://rig:4000', 'T-1') == []
