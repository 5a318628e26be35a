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
