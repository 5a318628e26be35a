# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Lines that come again and again."""

from __future__ import annotations

from psd_deflection.base.log import WARNING, texts
from psd_deflection.run.rate_limited_log import FIRST_WAIT_S, LONGEST_WAIT_S, MOST_REASONS, RateLimitedLog


def test_line_per_second_for_a_day_is_few_lines() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for k in range(86_400):
        # The words may differ each time: it is the kind that counts.
        rate_limited_log.log('hello', f'HELLO {k} rejected', WARNING, 1000.0 + k)
    assert logged[:2] == ['HELLO 0 rejected', 'HELLO 10 rejected (and 9 more like it)']
    assert len(logged) < 40
    rate_limited_log.settle(1000.0 + 86_400 + LONGEST_WAIT_S)
    last = logged.pop()
    counted = sum(int(line.split('(and ')[1].split()[0]) for line in logged if '(and ' in line)
    assert counted + len(logged) + int(last.split(' more in')[0]) == 86_400


def test_what_was_counted_is_reported_when_it_is_due() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for _ in range(3):
        rate_limited_log.log('restart', 'started anew', WARNING, 5.0)
    assert logged == ['started anew']
    rate_limited_log.settle(5.0 + 0.9 * FIRST_WAIT_S)
    assert len(logged) == 1
    rate_limited_log.settle(5.0 + FIRST_WAIT_S)
    # It may be over by now, so the line says when it was.
    assert logged[1:] == ['2 more in the last 10 s: started anew']
    rate_limited_log.settle(1e6)
    assert len(logged) == 2


def test_first_lines_and_those_after_quiet_are_logged() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for k in range(5):
        rate_limited_log.log('away', f'gone {k}', WARNING, float(k), at_once=3)
    assert logged == ['gone 0', 'gone 1', 'gone 2']
    rate_limited_log.settle(1e5)
    rate_limited_log.log('away', 'gone again', WARNING, 2e5, at_once=3)
    assert logged[3:] == ['2 more in the last 99998 s: gone 4', 'gone again']


def test_new_reason_is_logged_at_once_and_counts_alone() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for k in range(5):
        rate_limited_log.log('load', f"frame_id 'world{k}' at {k}.5e-3 s", WARNING, 100.0 + k)
    rate_limited_log.log('load', 'force x = nan', WARNING, 105.0)
    rate_limited_log.log('load', 'force x = nan', WARNING, 105.1)
    assert logged == ["frame_id 'world0' at 0.5e-3 s", 'force x = nan']
    rate_limited_log.settle(116.0)
    assert logged[2:] == [
        "4 more in the last 16 s: frame_id 'world4' at 4.5e-3 s",
        '1 more in the last 11 s: force x = nan',
    ]


def test_reasons_without_end_are_few_lines_and_none_is_forgotten() -> None:
    logged: list[str] = []
    rate_limited_log = RateLimitedLog(texts(logged.append))
    for k in range(1000):
        rate_limited_log.log('load', 'x' * (k + 1), WARNING, 100.0)
    assert len(logged) == MOST_REASONS + 1
    rate_limited_log.settle(1e6)
    assert logged[-1].startswith(f'{1000 - MOST_REASONS - 1} more in the last ')
    # Those that are quiet make room.
    rate_limited_log.log('load', 'another', WARNING, 2e6)
    assert logged[-1] == 'another'
