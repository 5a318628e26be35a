# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Appendix B: every cell of both tables agrees with the thesis, or is an erratum that can be explained."""

from __future__ import annotations

import json
import math
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from psd_deflection.model.link.section import TubeSection
from psd_deflection.studies.thesis.scaling import (
    BASE_SECTION,
    COLUMNS,
    ERRATA_B1,
    ERRATA_B2,
    FORCE,
    MATERIALS,
    YOUNGS_MODULUS,
    TableCell,
    round_as,
    table_b1,
    table_b1_cases,
    table_b2,
    torsion_to_bending_ratio,
    torsion_to_bending_ratio_exact,
)

CONSTANTS: dict[str, Any] = json.loads(
    (Path(__file__).parents[2] / 'data' / 'golden.json').read_text(encoding='utf-8')
)['constants']
CASES = table_b1_cases()

FITTED_YOUNGS_MODULUS = 68.9e9
"""Pa: the value that Table B1's bending deflections of cases 1 and 5 were computed with (an erratum)."""


@pytest.mark.parametrize(
    ('modulus', 'key'), [(YOUNGS_MODULUS, 'table_b1_E69'), (FITTED_YOUNGS_MODULUS, 'table_b1_E68.9')]
)
def test_table_b1_at_full_precision(modulus: float, key: str) -> None:
    rows = [
        [
            float(number),
            link.length,
            link.section.second_moment,
            link.section.polar_moment,
            link.section.outer_radius,
            link.section.inner_radius,
            link.bending(FORCE),
            link.twist(FORCE),
            link.tip_by_twist(FORCE),
            link.tip_by_twist(FORCE, small_angle=True),
            link.tip_total(FORCE),
            link.tip_total(FORCE, small_angle=True),
        ]
        for number, _, link in table_b1_cases(modulus)
    ]
    assert len(rows) == len(CONSTANTS[key])
    for row, golden in zip(rows, CONSTANTS[key], strict=True):
        assert row == pytest.approx(golden, rel=1e-12)


def test_table_b1_cells_agree_or_are_explained_errata() -> None:
    cells = table_b1()
    assert [(c.row, c.column) for c in cells] == [(str(n), column) for n in range(1, 7) for column in COLUMNS]
    assert {(int(c.row), c.column) for c in cells if not c.agrees} == set(ERRATA_B1)
    assert all(c.erratum for c in cells if not c.agrees)


def _explained(number: int, column: str) -> Decimal:
    """The value that the reason given for an erratum says was printed."""
    case = CASES[number - 1].link
    fitted = table_b1_cases(FITTED_YOUNGS_MODULUS)[number - 1].link
    loose = TubeSection.from_mean(2.0 * round(BASE_SECTION.mean_radius, 5), BASE_SECTION.wall)
    value = {
        (1, 'bend'): fitted.bending(FORCE),
        (2, 'D total'): 1e3 * case.tip_total(FORCE, small_angle=True),
        (5, 'I'): loose.second_moment,
        (5, 'J'): loose.polar_moment,
        (5, 'bend'): fitted.bending(FORCE),
        (6, 'J'): 2.0 * 3.47e-7,
    }[number, column]
    return round_as(value, next(c.printed for c in table_b1() if (c.row, c.column) == (str(number), column)))


@pytest.mark.parametrize(('number', 'column'), list(ERRATA_B1))
def test_the_reason_of_an_erratum_gives_the_printed_value(number: int, column: str) -> None:
    printed = next(c.printed for c in table_b1() if (c.row, c.column) == (str(number), column))
    assert _explained(number, column) == Decimal(printed)


def test_table_b2() -> None:
    cells = table_b2()
    assert {c.row: c.computed for c in cells} == pytest.approx(CONSTANTS['tbr'], rel=1e-15)
    assert [c.row for c in cells if not c.agrees] == list(ERRATA_B2)
    assert round_as(cells[-1].computed, '1.68') == Decimal('1.64')


def test_ratio_depends_on_link_lengths_unless_equal() -> None:
    # Conclusion 3 of the appendix holds only because L_CD = L_BC.
    aluminium = MATERIALS[0]
    one = torsion_to_bending_ratio(aluminium.youngs_modulus, aluminium.shear_modulus)
    link = CASES[0].link
    force, length_cd = 1e-3, 0.3
    statics = link.statics
    by_twist = length_cd * statics.deflection(0.0, 0.0, force * length_cd)[2]
    bending = statics.deflection(0.0, force, 0.0)[1]
    assert by_twist / bending == pytest.approx(one * (length_cd / link.length) ** 2, rel=1e-12)
    assert torsion_to_bending_ratio(69e9, 24e9, length_cd / link.length) == pytest.approx(by_twist / bending, rel=1e-12)


def test_the_sine_form_of_the_ratio() -> None:
    # With the extra L inside the sine, as B-5 prints it first, it would be 2.52.
    link = CASES[0].link
    assert torsion_to_bending_ratio_exact(link, FORCE) == pytest.approx(4.312221, abs=5e-7)
    printed = math.sin(link.twist(FORCE) * link.length) * link.length / link.bending(FORCE)
    assert printed == pytest.approx(2.52, abs=5e-3)


def test_a_cell_is_compared_at_the_digits_that_are_printed() -> None:
    assert TableCell('', '', 0.0799, '0.08', '').agrees
    assert not TableCell('', '', 0.0799, '0.080001', '').agrees
    assert round_as(2.6726e-3, '2.68e-3') == Decimal('2.67e-3')
