# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The table of `make campaign NAME=nodes`: no cell is empty, and a failure is seen."""

from __future__ import annotations

from typing import Any, Literal

import pytest

from tools.nodes import Table


def report(
    check: str,
    node: str,
    outcome: Literal['passed', 'failed', 'skipped'],
    when: Literal['setup', 'call', 'teardown'] = 'call',
    why: Any = None,
) -> pytest.TestReport:
    nodeid = f'test/ros/test_conformance.py::test_{check}[{node}]'
    return pytest.TestReport(nodeid, ('', 0, ''), {}, outcome, why, when)


def table(*reports: pytest.TestReport) -> Table:
    made = Table()
    for each in reports:
        made.pytest_runtest_logreport(each)
    return made


def test_each_check_has_its_row_and_each_reason_its_note() -> None:
    made = table(
        report('log_is_there', 'chain', 'passed', 'setup'),
        report('log_is_there', 'chain', 'passed'),
        report('log_is_there', 'shaper', 'passed'),
        report('frame_is_rejected', 'chain', 'passed'),
        report('frame_is_rejected', 'shaper', 'skipped', why=('file', 1, 'Skipped: there is no frame')),
    )
    assert made.lines() == [
        '                    chain   shaper',
        'log is there         yes     yes',
        'frame is rejected    yes     (1)',
        '',
        '(1) there is no frame',
    ]
    assert made.complete()


@pytest.mark.parametrize('when', ['setup', 'call', 'teardown'])
def test_a_failure_anywhere_is_a_no(when: Literal['setup', 'call', 'teardown']) -> None:
    reports = [report('log_is_there', 'chain', 'passed'), report('log_is_there', 'chain', 'failed', when)]
    assert 'NO' in table(*reports).lines()[1]
    assert not table(*reports).complete()


def test_a_cell_that_nobody_filled_is_no_answer() -> None:
    reports = [report('a', 'chain', 'passed'), report('a', 'shaper', 'passed'), report('b', 'chain', 'passed')]
    assert table(*reports[:2]).complete()
    assert not table(*reports).complete()
    assert not table().complete()
