# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pings: when they are due, whose answer counts, and when they end."""

from unittest.mock import Mock

import pytest

from psd_deflection.devices.source import PortClosedError, Source
from psd_deflection.run.hello import PING_S, UNANSWERED, Pinger

pytestmark = pytest.mark.slow


@pytest.fixture
def source() -> Mock:
    made = Mock(spec=Source)
    made.ping.return_value = True
    return made


def cookie_of(source: Mock) -> int:
    (cookie,) = source.ping.call_args.args
    return int(cookie)


def test_one_is_due_at_once_and_the_next_at_a_random_time(source: Mock) -> None:
    waits = []
    for _ in range(50):
        pinger = Pinger()
        assert pinger.is_due(0.0)
        assert pinger.ask(source, 10.0, 0)
        assert not pinger.is_due(10.0 + 0.99 * PING_S[0])
        assert pinger.is_due(10.0 + 1.01 * PING_S[1])
        waits.append(next(k for k in range(1000) if pinger.is_due(10.0 + k * 1e-3)))
    assert len(set(waits)) > 10


def test_late_answer_returns_send_time_of_question(source: Mock) -> None:
    pinger = Pinger()
    pinger.ask(source, 0.0, 111)
    first = cookie_of(source)
    pinger.ask(source, 1.0, 222)
    # Seconds late: how late the line is.
    assert pinger.answered(first) == 111
    assert pinger.answered(first) is None
    assert pinger.answered(cookie_of(source)) == 222
    assert pinger.answered(cookie_of(source)) is None
    assert pinger.answered(0) is None


def test_device_with_unanswered_pings_is_asked_no_more(source: Mock) -> None:
    pinger = Pinger()
    for k in range(UNANSWERED):
        assert pinger.is_due(float(k))
        pinger.ask(source, float(k), k)
    assert not pinger.is_due(1e9)


def test_one_answer_makes_up_for_those_before(source: Mock) -> None:
    pinger = Pinger()
    for k in range(UNANSWERED - 1):
        pinger.ask(source, float(k), k)
    assert pinger.answered(cookie_of(source)) is not None
    pinger.ask(source, 100.0, 0)
    assert pinger.is_due(200.0)


def test_a_source_that_cannot_be_asked_is_asked_once(source: Mock) -> None:
    source.ping.return_value = False
    pinger = Pinger()
    assert not pinger.ask(source, 0.0, 0)
    assert not pinger.is_due(1e9)


def test_a_port_that_goes_away_meanwhile_is_the_callers_to_see(source: Mock) -> None:
    source.ping.side_effect = PortClosedError('gone')
    with pytest.raises(PortClosedError):
        Pinger().ask(source, 0.0, 0)
