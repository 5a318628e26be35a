# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What validate says, prints and writes, against words and figures written down beside them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from psd_deflection.records import FloatArray
from psd_deflection.studies.validate.agreement import Agreement
from psd_deflection.studies.validate.clock import Offset
from psd_deflection.studies.validate.from_recordings import ValidateProblem
from psd_deflection.studies.validate.motion import Motion
from psd_deflection.studies.validate.result import Validated


def none(dots: FloatArray) -> FloatArray:
    return dots[:, :3]


LATE = Offset(0.0123, 1e-4, 0.0, 1e-6, True, (), 100)
X = Agreement(1.5e-6, 0.25e-6, (-2.5e-6, 5.5e-6), 0.004, 0.001, 2e-6, 3e-6, 4e-6, 0.05)
Y = Agreement(-2e-6, 0.5e-6, (-4e-6, 0.0), math.nan, math.nan, 5e-6, 6e-6, 7e-6, math.nan, mirrored=True)
# A milliradian is 57.3 mdeg.
TWIST = Agreement(1e-3, 1e-4, (-1e-3, 2e-3), -0.02, 0.005, 2e-3, 3e-3, 4e-3, 1.25)
PROBLEM = ValidateProblem(
    motion=Motion(np.arange(30.0), np.zeros((30, 4)), 1.0, none),
    solvers={'exact': none, 'wls': none},
    t=np.arange(4.0),
    reference=np.zeros((4, 3)),
    sd=None,
    rejected={},
    estimate_sd=np.ones(3),
    align=False,
    largest=1.0,
    exposure=0.0,
    sources={'recording': 'run.csv', 'reference': 'camera.csv'},
)
PLAIN = Validated(
    problem=PROBLEM,
    t=np.arange(4.0),
    reference=np.arange(12.0).reshape(4, 3),
    estimates={'exact': 10.0 * np.arange(12.0).reshape(4, 3), 'wls': np.full((4, 3), math.nan)},
    agreements={'exact': (X, Y, TWIST), 'wls': (Y, X, TWIST)},
    offset=LATE,
    applied=False,
    covered=(math.nan, math.nan, math.nan),
    excluded=0,
)


def test_a_plain_answer_has_the_clock_and_one_sentence_an_axis() -> None:
    assert PLAIN.sentences() == [
        LATE.sentence,
        'It is not removed in what follows; --align removes it.',
        'ΔX: the estimate is +1.50 ± 0.49 µm off on average; 95 % of the differences lie between -2.5 and +5.5 µm; '
        'it is +0.400 ± 0.196 % larger.',
        'ΔY: the estimate is -2.00 ± 0.98 µm off on average; 95 % of the differences lie between -4.0 and +0.0 µm; '
        'the reference moves the other way: turn its sign (of a camera, camera.view), '
        'or that of the readings if `psd-deflection check` says so.',
        'θ: the estimate is +57.30 ± 11.23 mdeg off on average; 95 % of the differences lie between -57.3 and '
        '+114.6 mdeg; it is -2.000 ± 0.980 % larger.',
    ]


@pytest.mark.parametrize(
    ('offset', 'applied', 'words'),
    [
        (LATE, True, 'The offset is removed in what follows.'),
        (LATE, False, 'It is not removed in what follows; --align removes it.'),
        (replace(LATE, value=-0.0123), False, 'It is not removed in what follows; --align removes it.'),
        # 0.19 ms with 0.1 ms of deviation is no offset, 0.2 ms is one.
        (replace(LATE, value=0.2e-3), False, 'It is not removed in what follows; --align removes it.'),
        (replace(LATE, value=0.19e-3), False, None),
        (replace(LATE, value=-0.19e-3), False, None),
        # It is large, but nobody knows how large.
        (replace(LATE, explained=False), False, None),
        (replace(LATE, alternatives=(0.2,)), False, None),
    ],
)
def test_offset_removal_is_reported_if_offset_exists(offset: Offset, applied: bool, words: str | None) -> None:
    message = replace(PLAIN, offset=offset, applied=applied).sentences()
    assert message[0] == offset.sentence
    assert len(message) == 4 + (words is not None)
    assert words is None or message[1] == words


def test_coverage_is_reported_if_reference_has_sd() -> None:
    message = replace(PLAIN, covered=(0.95, 0.5, 1.0)).sentences()
    assert len(message) == 6
    assert message[-1] == (
        'Differences within 1.96 standard deviations of both instruments (95 % expected): ΔX 95.0 %, ΔY 50.0 %, '
        'θ 100.0 %.'
    )


def test_what_was_left_out_and_rejected_is_counted() -> None:
    found = replace(PLAIN, excluded=3, problem=replace(PROBLEM, rejected={'too dark': 2, 'blurred': 5}))
    assert found.sentences()[-2:] == [
        '3 of 7 references have no samples about them and are left out.',
        'The reference gave no answer 7 times: blurred 5, too dark 2.',
    ]
    assert len(found.sentences()) == 7


def test_the_table_has_the_solvers_in_units_that_people_read() -> None:
    rows = PLAIN.rows()
    assert rows == [
        ['solver', 'axis', 'unit', 'bias', 'scale %', 'noise', 'rms', 'largest', '% of deflection'],
        ['exact', 'ΔX', 'µm', '+1.50', '+0.400', '2.00', '3.00', '4.00', '5.00'],
        ['', 'ΔY', 'µm', '-2.00', '-', '5.00', '6.00', '7.00', '-'],
        ['', 'θ', 'mdeg', '+57.30', '-2.000', '114.59', '171.89', '229.18', '125.00'],
        ['wls', 'ΔX', 'µm', '-2.00', '-', '5.00', '6.00', '7.00', '-'],
        ['', 'ΔY', 'µm', '+1.50', '+0.400', '2.00', '3.00', '4.00', '5.00'],
        ['', 'θ', 'mdeg', '+57.30', '-2.000', '114.59', '171.89', '229.18', '125.00'],
    ]
    lines = PLAIN.lines()
    assert lines[:6] == [*PLAIN.sentences(), '']
    assert [line.split() for line in lines[6:]][2:] == [[c for c in row if c] for row in rows[1:]]
    # Words lie to the left, numbers to the right.
    assert lines[9] == '        ΔY    µm     -2.00        -    5.00    6.00     7.00                -'


def test_programs_get_si_units() -> None:
    tree = replace(PLAIN, excluded=3, problem=replace(PROBLEM, rejected={'blurred': 5})).tree()
    assert tree['solver'] == 'exact'
    assert tree['references'] == 4
    assert tree['left_out'] == 3
    assert tree['rejected'] == {'blurred': 5}
    offset = tree['offset']
    assert offset['value'] == 0.0123
    assert offset['interval'] == pytest.approx((0.0123 - 0.196e-3, 0.0123 + 0.196e-3))
    assert (offset['determined'], offset['applied'], offset['unit']) == (True, False, 's')
    assert offset['sentence'] == LATE.sentence
    assert list(tree['solvers']) == ['exact', 'wls']
    assert [one['unit'] for one in tree['solvers']['exact'].values()] == ['m', 'm', 'rad']
    assert tree['solvers']['wls']['dy']['bias'] == 1.5e-6
    assert list(tree['covered']) == ['dx', 'dy', 'theta']
