# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The gallery says what the program says: its cases are run again."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools import gallery
from tools.gallery_cases import CASES, STUDIES, Case

pytestmark = pytest.mark.slow


def test_every_case_is_on_the_page_with_its_picture() -> None:
    message = gallery.kept()
    assert list(message) == [case.name for study in STUDIES for case in CASES if case.study == study]
    # Nothing on the page was written by hand.
    assert gallery.PAGE.read_text() == gallery.page(message)
    assert {path.stem for path in gallery.FIGURES.glob('*.png')} == set(message)


@pytest.mark.parametrize('case', CASES, ids=lambda case: str(case.name))
def test_the_program_says_what_the_page_has(case: Case, tmp_path: Path) -> None:
    message = gallery.answered(case, tmp_path)
    assert gallery.same(message, gallery.kept()[case.name]), message


def test_answers_are_the_same_if_words_agree_and_numbers_nearly_do() -> None:
    assert gallery.same('y2 jumps by 40.1 µm at 7 s', 'y2 jumps by 40.0 µm at 7 s')
    assert not gallery.same('y2 jumps by 40.1 µm', 'y1 jumps by 40.1 µm')
    assert not gallery.same('y2 jumps by 50 µm', 'y2 jumps by 40 µm')
    assert gallery.same('+0.01 ± 0.03 µm', '-0.01 ± 0.03 µm')
    assert not gallery.same('+0.05 ± 0.03 µm', '-0.01 ± 0.03 µm')
    assert gallery.same('angle 0.009975 ± 3e-05 rad', 'angle 0.009976 ± 2e-05 rad')
    assert not gallery.same('from 2 ring-downs', 'from 3 ring-downs')
    assert not gallery.same('y2 is dead', 'y2 is dead, y1 too')
